"""Panoramas of a whole turn: what is sampled across their seam and at their poles is what lies around there."""

import math

import pytest
import torch

import camtorch as ct
from camtorch.poses.rotations import mount_rotation
from camtorch.warp.affine import HalvingWarp

WIDE, TALL = 256, 128


def whole(key, dtype=torch.float64, centre=(WIDE - 1) / 2, size=(TALL, WIDE), learns=False):
    """A panorama that goes round in 256 pixels, across or down."""
    focal = WIDE / 2 / math.pi
    numbers = [focal, focal, centre, (size[0] - 1) / 2]
    if key in ("latlon", "transverse_cylindrical"):
        numbers, size = [focal, focal, numbers[3], numbers[2]], size[::-1]
    camera = ct.MODELS[key](torch.tensor(numbers, dtype=dtype), image_size=size)
    return camera.requires_grad_(learns)


def scene(rays):
    directions = torch.tensor([[0.8, 0.2, 0.4], [0.1, 0.9, -0.5], [-0.3, 0.5, 0.7]], dtype=rays.dtype)
    return 0.5 + 0.3 * torch.sin(2 * rays @ directions).mean(-1)


def image_of(camera):
    """What a panorama shows of the scene; written here, as a model gives no rays beyond half a turn."""
    fx, fy, cx, cy = camera.intrinsics.detach().double()
    u, v = camera.pixel_grid().double().unbind(-1)
    a, b = (u - cx) / fx, (v - cy) / fy
    rays = {
        "equirectangular": lambda: (a.sin() * b.cos(), b.sin(), a.cos() * b.cos()),
        "cylindrical": lambda: (a.sin(), b, a.cos()),
        "latlon": lambda: (a.sin(), b.sin() * a.cos(), b.cos() * a.cos()),
        "transverse_cylindrical": lambda: (a, b.sin(), b.cos()),
    }[camera.key]()
    return scene(torch.nn.functional.normalize(torch.stack(rays, -1), dim=-1))[None, None].to(camera.intrinsics.dtype)


def off(result, target, rotation, valid):
    """How far an image of the target is from the scene, at most."""
    rays = target.rays()[0].detach() @ rotation.to(target.intrinsics)
    return float(((result.detach() - scene(rays)).abs() * valid).max())


# in a pixel the scene changes by 0.015 at most; interpolation misses it by an eighth of its second difference, bicubic
# interpolation, which is no cubic's with a = -3/4, by more
MOST = {"bilinear": 2e-4, "nearest": 0.012, "bicubic": 2e-3}


@pytest.mark.parametrize(
    ("key", "centre", "dtype", "mode"),
    [
        ("equirectangular", 127.5, torch.float32, "bilinear"),
        ("equirectangular", 0.25, torch.float64, "nearest"),
        ("equirectangular", 0.25, torch.float32, "bicubic"),
        ("latlon", 127.5, torch.float64, "bicubic"),
        ("cylindrical", 127.5, torch.float32, "bilinear"),
        ("transverse_cylindrical", 127.5, torch.float32, "nearest"),
    ],
)
def test_a_cube_of_a_panorama_shows_the_scene(key, centre, dtype, mode):
    camera = whole(key, dtype, centre)
    image = image_of(camera)
    # of an odd size, faces look straight at the poles and along the seam
    for size in (40, 41):
        faces = ct.views.cube(camera, size, mode=mode)
        made, valid = faces(image), faces.valid_masks()
        # a cylinder ends up and down
        assert valid.all() or "cylindrical" in key
        shown = torch.stack([off_edge(warp, camera) for warp in faces], 1)
        for i, rotation in enumerate(faces.rotations):
            assert off(made[:, i], faces.view, rotation, (valid & shown)[:, i]) < MOST[mode]
        if "cylindrical" not in key and mode != "nearest":
            again, seen = faces.back(made)
            assert seen.all() or centre != 127.5
            assert float(((again - image).abs() * seen).max()) < 4e-3


def off_edge(warp, camera):
    """Which pixels lie two pixels away from edges that do not meet."""
    if "cylindrical" not in camera.key:
        return warp.valid_mask()
    return warp.grid()[..., 1 if camera.key == "cylindrical" else 0].abs()[:, None] < 1 - 4 / TALL


@pytest.mark.parametrize(("learns", "dtype"), [(False, torch.float32), (True, torch.float64)])
def test_what_shrinks_is_averaged_across_the_seam_and_not_along_it(dtype, learns):
    camera = whole("equirectangular", dtype, learns=learns)
    target = ct.Pinhole.from_fov(90, image_size=(17, 17)).to(dtype).requires_grad_(False)
    noise = 0.3 * (torch.rand(1, 1, TALL, WIDE, generator=torch.Generator().manual_seed(0), dtype=dtype) - 0.5)
    for yaw, pitch in ((180, 0), (0, 90), (180, -60)):
        rotation = mount_rotation(*torch.tensor([yaw, pitch, 10.0], dtype=dtype))
        for mode in ("bilinear", "bicubic"):
            warp = ct.Warp(camera, target, rotation, antialias=True, mode=mode)
            assert warp.valid_mask().all()
            # a pixel averages four or so, and sees the scene a little blurred
            assert off(warp(image_of(camera)), target, rotation, 1.0) < 0.01
            assert warp(noise).std() > 0.01


def test_images_that_are_halved_first_are_so_across_the_seam():
    camera, rotation = whole("equirectangular", torch.float32), mount_rotation(*torch.tensor([100.0, 50, 10]))
    target = camera.resize(20, 40)
    # as `augment.Compose` makes it of a mount and a smaller size
    warp = HalvingWarp(camera, target, rotation, antialias=None)
    assert warp(image_of(camera)).std() > 0.05
    assert off(warp(image_of(camera)), target, rotation, 1.0) < 0.01


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint16, torch.int32, torch.int64, torch.uint64, torch.float16])
def test_the_nearest_label_across_the_seam_is_exact(dtype):
    camera = whole("equirectangular")
    labels = torch.arange(TALL * WIDE).view(1, 1, TALL, WIDE)
    if dtype == torch.bool:
        labels = labels % 3 == 0
    elif dtype.is_floating_point:
        labels = (labels % 2048).to(dtype)
    else:
        labels = torch.tensor([torch.iinfo(dtype).max - i for i in range(TALL * WIDE)], dtype=dtype).view(labels.shape)
    warp = ct.Warp(camera, camera, mount_rotation(*torch.tensor([90.0, 0, 0]).double()), mode="nearest")
    assert torch.equal(warp(labels), torch.cat((labels[..., WIDE // 4 :], labels[..., : WIDE // 4]), -1))


@pytest.mark.slow
def test_every_way_to_make_the_images_agrees():
    camera, learner = (whole("equirectangular", torch.float32, learns=learns) for learns in (False, True))
    target = ct.Pinhole.from_fov(100, image_size=(80, 96)).requires_grad_(False)
    rotation = mount_rotation(*torch.tensor([170.0, 50, 20]))
    image = torch.cat([image_of(camera)] * 3, 1)
    warp, learning = (ct.Warp(source, target, rotation) for source in (camera, learner))
    expected = warp(image)
    assert off(expected[:, :1], target, rotation, 1.0) < 2e-4
    still = ct.Extrinsics.from_matrix(rotation.mT, torch.zeros(3))
    made = {
        "channels last": warp(image.contiguous(memory_format=torch.channels_last)),
        "pinned": ct.Warp(camera, target, rotation).pin()(image),
        "exact": ct.Warp(camera, target, rotation, tolerance=0)(image),
        "mapped": torch.func.vmap(lambda one: warp(one[None])[0])(image),
        "strips": torch.cat([part for _, part, _ in warp.strips(image, rows=13)], 2),
        "learning": learning(image),
        "at infinity": ct.Reproject(camera, target, still)(image, torch.ones(1, 1, 80, 96))[0],
        "compiled while it learns": torch.compile(learning, fullgraph=True, backend="eager")(image),
    }
    for how, result in made.items():
        # an image is as smooth as a thousandth of a pixel, and a float32 is as fine
        assert (result - expected).abs().max() < 1e-4, how
    assert made["channels last"].is_contiguous(memory_format=torch.channels_last)
    assert warp.valid_mask().all()


def test_the_ground_below_a_panorama_has_no_hole():
    camera = whole("equirectangular")
    level = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()
    pose = ct.Extrinsics.from_matrix(level, -level @ torch.tensor([0, 0, 1.0]).double()).requires_grad_(False)
    above = ct.BirdsEye(camera, pose, x=(-2.5, 2.5), y=(-2.5, 2.5), resolution=1.0 / 9)
    points = torch.cat((above.grid_points, -torch.ones(45, 45, 1).double()), -1)
    rays = torch.nn.functional.normalize(points, dim=-1) @ level.mT
    assert above.valid_mask().all()
    assert (above(image_of(camera))[0, 0] - scene(rays)).abs().max() < 2e-4


def test_gradients_pass_the_seam_and_the_poles():
    camera = whole("equirectangular", learns=True)
    target = ct.Pinhole.from_fov(60, image_size=(5, 5)).double().requires_grad_(False)
    image = image_of(camera).requires_grad_()
    for yaw, pitch in ((180.0, 0.0), (0.0, 90.0)):
        result = ct.Warp(camera, target, mount_rotation(*torch.tensor([yaw, pitch, 0]).double()))(image)
        for gradient in torch.autograd.grad(result.sum(), (image, camera.intrinsics)):
            assert gradient.isfinite().all()
            assert gradient.any()


@pytest.mark.parametrize("missing", [1.0, 40.0])
def test_less_than_a_whole_turn_ends_at_its_edges(missing):
    focal = (WIDE + missing) / 2 / math.pi
    camera = ct.Equirectangular([focal, focal, (WIDE - 1) / 2, (TALL - 1) / 2], image_size=(TALL, WIDE)).double()
    camera.requires_grad_(False)
    target = ct.Pinhole.from_fov(40, image_size=(64, 64)).double().requires_grad_(False)
    behind = ct.Warp(camera, target, mount_rotation(*torch.tensor([180.0, 0, 0]).double()))
    assert not behind.valid_mask().all()
    assert (behind(torch.ones(1, 1, TALL, WIDE).double())[0, 0, 32] < 0.999).any()
    # and one that becomes a whole turn is one
    camera.intrinsics[:2] = WIDE / 2 / math.pi
    assert behind.valid_mask().all()
    torch.testing.assert_close(behind(torch.ones(1, 1, TALL, WIDE).double()), torch.ones(1, 1, 64, 64).double())


@pytest.mark.parametrize("centre", [0.0, 100.0, 159.5])
def test_a_whole_turn_is_shown_wherever_it_begins(centre):
    """As a target too. Labels go where the image goes, if the model has rays for both of their pixels."""
    focal, image = 320 / (2 * math.pi), torch.rand(1, 1, 160, 320)
    middles = [focal, focal, centre, 79.5], [focal, focal, centre + 20, 79.5]
    panorama, straight = (ct.Equirectangular(m, image_size=(160, 320)).requires_grad_(False) for m in middles)
    views = ct.views.cube(panorama, size=90)
    ones, valid = views.back(views(torch.ones_like(image)))
    assert valid.all()
    torch.testing.assert_close(ones, torch.ones_like(image))
    warp = ct.Warp(panorama, straight)
    torch.testing.assert_close(warp(image), image.roll(20, -1), atol=5e-4, rtol=0)  # of float32 positions
    pixels = torch.rand(200, 2) * torch.tensor([319.0, 159.0])
    moved, valid = warp.transform_points(pixels)
    assert valid.sum() > 70
    torch.testing.assert_close(moved[valid, 0], (pixels[valid, 0] + 20.5) % 320 - 0.5, atol=1e-3, rtol=0)


@pytest.mark.parametrize("width", [4, 10, 16, 24])
@pytest.mark.parametrize("centre", [0.0, 0.25, 0.5, 1.0])
def test_a_tiny_panorama_shows_its_whole_turn(width, centre):
    focal = width / math.tau
    source = ct.Equirectangular([focal, focal, width * centre - 0.5, width / 4 - 0.5], image_size=(width // 2, width))
    target = ct.Pinhole([20.0, 20, 19.5, 19.5], image_size=(40, 40)).requires_grad_(False)
    for turn in (torch.eye(3), torch.diag(torch.tensor([-1.0, 1, -1]))):
        assert ct.Warp(source.requires_grad_(False), target, turn).valid_mask().all()
