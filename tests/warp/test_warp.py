"""Laws of Warp: images, labels and derivatives move together."""

import math
import re
from functools import partial
from itertools import combinations

import pytest
import test_warp_laws
import torch
from cameras import SIZE, fisheye, make, pinhole, turn

import camtorch as ct
from camtorch.native.library import native_available

smooth = partial(test_warp_laws.smooth, size=SIZE)


@pytest.mark.parametrize("key", sorted(ct.MODELS))
def test_the_identity_warp_is_the_identity(key):
    camera = ct.MODELS[key](torch.tensor([60.0, 60.0, 31.5, 23.5], dtype=torch.float64), image_size=SIZE)
    warp = ct.Warp(camera, camera)
    images = smooth()
    # every pixel has a ray in these cameras, but for the corners of the one whose image ends at 90 degrees
    pixels = camera.pixel_grid()
    seen = camera.unproject(pixels)[1]
    assert seen.all() or key == "orthographic_fisheye"
    assert torch.equal(warp.valid_mask()[0, 0], seen)
    torch.testing.assert_close(warp(images), images * seen, atol=1e-12, rtol=0)
    moved, valid = warp.transform_points(pixels)
    assert torch.equal(valid, seen)
    torch.testing.assert_close(moved[seen], pixels[seen], atol=1e-10, rtol=0)


def test_boxes_enclose_the_curved_outline():
    # a source that bends straight edges outwards: the corners alone would cut the box off
    numbers = torch.tensor([300.0, 300, 320, 240], dtype=torch.float64)
    warp = ct.Warp(*(model(numbers, image_size=(480, 640)) for model in (ct.Pinhole, ct.KannalaBrandt)))
    box = torch.tensor([[100.0, 20.0, 540.0, 460.0]], dtype=torch.float64)
    moved, valid = warp.transform_boxes(box)
    assert valid.all()
    outline, _ = warp.transform_points(ct.augment.outlines(box, 5000)[0])
    expected = torch.cat((outline.amin(0), outline.amax(0)))
    torch.testing.assert_close(moved[0], expected, atol=0.03, rtol=0)
    assert moved[0, 0] < warp.transform_points(box[:, :2])[0][0, 0] - 1  # the corners would miss more than a pixel
    assert [tuple(result.shape) for result in warp.transform_boxes(torch.zeros(0, 4))] == [(0, 4), (0,)]
    assert warp.transform_points(torch.zeros(0, 2))[0].shape == (0, 2)


def test_boxes_with_their_corners_out_of_order_are_invalid():
    boxes = torch.tensor([[30.0, 20.0, 8.0, 25.0], [3.0, 20.0, 8.0, 5.0], [30.0, 20.0, 8.0, 5.0]])
    fine = torch.tensor([[3.0, 5.0, 3.0, 9.0], [3.0, 5.0, 8.0, 5.0], [3.0, 5.0, 3.0, 5.0], [3.0, 5.0, 8.0, 9.0]])
    camera = ct.Pinhole([30.0, 30.0, 19.5, 14.5], image_size=(30, 40))
    with pytest.raises(ValueError, match=r"Warp: boxes must be x1, y1, x2, y2.*boxes\[0\] = \[30.*x \+ width"):
        ct.Warp(camera, camera).transform_boxes(torch.cat((boxes, fine)))
    with torch.no_grad():  # a network's may be bad
        moved, valid = ct.Warp(camera, camera).transform_boxes(torch.cat((boxes, fine)))
    assert valid.tolist() == [False] * 3 + [True] * 4
    assert (moved[:3] == -1).all()
    torch.testing.assert_close(moved[3:], fine)
    for p in (0.0, 1.0):
        augmentation = ct.augment.RandomMount(yaw=(0, 0), pitch=(0, 0), roll=(0, 0), p=p, camera=camera)
        with pytest.raises(ValueError, match=r"boxes\[0\] = \[30.*x \+ width"):
            augmentation(boxes=torch.cat((boxes, fine)))
        assert augmentation(boxes=fine)["boxes_valid"].all()
        with torch.no_grad():
            assert torch.equal(augmentation.inverse(boxes=torch.cat((boxes, fine)))["boxes_valid"], valid)


NUMBERS = {
    "kannala_brandt": ([20, 20.5, 32, 23], [0.02, -0.01, 0.004, -0.001]),
    "small_circle": ([8, 8, 32, 23], [0.02, -0.01, 0.004, -0.001]),
    "brown_conrady": ([35, 35, 31, 24], [-0.5, 0.1, 0.001, 0.002]),
    "pinhole": ([40, 40, 31.5, 23.5], []),
    "equirectangular": ([20, 20, 31.5, 23.5], []),
}


def lens(name):
    """Two have an image circle or a fold within the image."""
    intrinsics, distortion = (torch.tensor(values, dtype=torch.float64) for values in NUMBERS[name])
    key = name.replace("small_circle", "kannala_brandt")
    return make(key, intrinsics, distortion, image_size=SIZE).requires_grad_(False)


@pytest.mark.parametrize(("source", "target"), [p for p in combinations(sorted(NUMBERS), 2) if p[0] != "pinhole"])
def test_a_box_is_on_the_image_if_a_ray_of_the_image_comes_back_inside(source, target):
    generator, fine = torch.Generator().manual_seed(len(source) * 100 + len(target)), 4
    for angles in ((12, -8, 30), (160, 40, 10)):
        height, width, top, left = torch.randint(8, 40, (4,), generator=generator).tolist()
        camera = lens(target).crop(top - 10, left - 10, height, width)
        large = camera.resize(height * fine, width * fine)
        warp = ct.Warp(lens(source), camera, turn(*angles, torch.float64))
        middles = torch.rand(40, 2, generator=generator, dtype=torch.float64) * 90 - 15
        sides = 10 ** (0.3 + 2 * torch.rand(40, 2, generator=generator, dtype=torch.float64))
        boxes = torch.cat((middles - sides / 2, middles + sides / 2), -1)
        moved, valid = warp.transform_boxes(boxes)
        # where four by four points of every pixel come from
        grid = ct.Warp(warp.source, large, warp.rotation).grid()[0]
        seen = (grid != -9).all(-1)
        places = ((grid + 1) * grid.new_tensor([SIZE[1], SIZE[0]]) - 1) / 2

        def inside(margin, boxes=boxes, places=places, seen=seen):
            low, high = (boxes[:, None, None, :2] <= places + margin), (boxes[:, None, None, 2:] >= places - margin)
            return (low & high).all(-1) & seen

        pixel = fine * torch.stack([(places - places.roll(1, dim)).abs().amax(-1) for dim in (0, 1)]).amax(0)[..., None]
        # what is a pixel thick, and more, is found; what is found is there to a pixel
        thick = -torch.nn.functional.max_pool2d(-inside(0.0).double(), 2 * fine + 1, 1, fine) > 0
        assert bool(valid[thick.flatten(1).any(-1)].all())
        if bool(seen.any()):
            assert not bool(valid[~inside(pixel).flatten(1).any(-1)].any())
        # of what its outline does not say the box knows to a step of the lattice
        pixels, step = (large.pixel_grid() + 0.5) / fine - 0.5, torch.tensor([width, height]) / 16 + 1
        rows = thick.flatten(1).any(-1) & warp.transform_points(boxes.unflatten(-1, (2, 2)))[1].all(-1)
        for box, there in zip(moved[rows], thick[rows], strict=True):
            assert bool((pixels[there] >= box[:2] - step).all() & (pixels[there] <= box[2:] + step).all())


def test_boxes_around_the_whole_image_are_on_it():
    camera = pinhole(dtype=torch.float64)
    around, beside = [-900.0, -900.0, 900.0, 900.0], [-900.0, -900.0, 900.0, -700.0]
    boxes = torch.tensor([around, beside, [-math.inf, -900.0, 900.0, 900.0]])
    for rotation in (None, turn(roll=40, dtype=torch.float64)):
        moved, valid = ct.Warp(camera, camera, rotation).transform_boxes(boxes)
        assert valid.tolist() == [True, False, False]
        assert bool((moved[0, :2] < -800).all() & (moved[0, 2:] > 800).all())
    # turned by 45 degrees: across a corner, and with a box about it that touches the image while it does not
    corner = torch.tensor([[-3.0, -3.0], [63.0, -3.0], [63.0, 50.0], [-3.0, 50.0]], dtype=torch.float64)
    diamond = torch.tensor([[-20.0, 3.0], [3.0, -20.0], [-20.0, -43.0], [-43.0, -20.0]], dtype=torch.float64)
    shifts = torch.tensor([[0.0, 0.0], [7.0, 7.0], [8.0, 8.0]], dtype=torch.float64)
    polygons = torch.cat((corner[None], diamond + shifts[:, None]))
    enclosing, valid = ct.Warp(camera, camera).enclose(polygons)
    assert valid.tolist() == [True, False, False, True]
    assert bool((enclosing[:, 2:] > 0).all())
    # no part of the outline has a ray: the box is that of what the image shows
    circle = lens("small_circle")
    boxes = torch.tensor([[-500.0, -500.0, 500.0, 500.0]] * 2, dtype=torch.float64, requires_grad=True)
    moved, valid = ct.Warp(circle, pinhole(dtype=torch.float64)).transform_boxes(boxes)
    assert valid.all()
    torch.testing.assert_close(moved[0].detach(), torch.tensor([-0.5, -0.5, 63.5, 47.5], dtype=torch.float64))
    moved.sum().backward()
    assert bool((boxes.grad == 0).all())
    behind = ct.Warp(circle, pinhole(dtype=torch.float64), turn(180, dtype=torch.float64))
    assert not behind.transform_boxes([[-500.0, -500.0, 0.0, 500.0]])[1]


def test_the_grid_is_kept_until_something_changes():
    rotation, straight = turn(30), ct.Warp(fisheye(), pinhole()).requires_grad_(False)
    warp = ct.Warp(fisheye(), pinhole(), rotation).requires_grad_(False)
    first, turned = straight.grid(), warp.grid()
    rotation.copy_(rotation.T.clone())
    assert torch.equal(warp.grid(), turned)  # plain values are copied
    warp.rotation = None
    assert torch.equal(warp.grid(), first)
    warp.source.intrinsics.requires_grad_(True)
    assert warp.grid().requires_grad
    warp.source.intrinsics.data.add_(1.0)
    warp.load_state_dict(straight.state_dict(), strict=True)
    with torch.no_grad():
        assert torch.equal(warp.grid(), first)
    warp.target = ct.Equirectangular([30.0, 30.0, 31.5, 23.5], image_size=SIZE).requires_grad_(False)
    assert not torch.equal(warp.grid(), first)


def test_a_grid_kept_from_inference_mode_serves_training():
    warp = ct.Warp(fisheye(), pinhole()).requires_grad_(False)
    with torch.inference_mode():
        warp(smooth(dtype=torch.float32))
    images = smooth(dtype=torch.float32).requires_grad_()
    warp(images).sum().backward()
    assert images.grad.abs().sum() > 0


@pytest.mark.slow
def test_export_takes_any_number_of_cameras_that_are_inputs(monkeypatch):
    # as if images were so large that little is kept: a comparison with that would bound the batch
    for name in ("warp.routes._MOST_KEPT_PIXELS", "rays.fields._MOST_KEPT_RAYS"):
        monkeypatch.setattr(f"camtorch.{name}", 10 * math.prod(SIZE))

    class Seen(torch.nn.Module):
        def forward(self, images, intrinsics):
            source = ct.Pinhole(intrinsics, image_size=SIZE)
            with torch.no_grad():
                rays, _ = source.rays()
            return ct.Warp(source, pinhole().requires_grad_(False), tolerance=0.0)(images), rays

    def given(count):
        images = smooth(dtype=torch.float32).expand(count, -1, -1, -1).contiguous()
        return images, pinhole().intrinsics.detach() * (1 + 0.2 * torch.linspace(0, 1, count)[:, None])

    exported = torch.export.export(Seen(), given(3), dynamic_shapes=({0: torch.export.Dim.AUTO},) * 2).module()
    for count in (1, 2, 8, 200):
        # positions in float32 are rounded by 1e-5 px, and the image ends within one
        torch.testing.assert_close(exported(*given(count)), Seen()(*given(count)), atol=1e-4, rtol=0)


def test_a_box_about_a_pole_encloses_it():
    camera = ct.KannalaBrandt([150.0, 150.0, 319.5, 239.5], [0.0, 0, 0, 0], image_size=(480, 640))
    panorama = ct.Equirectangular([640 / (2 * torch.pi)] * 2 + [319.5, 159.5], image_size=(320, 640))
    boxes, valid = ct.Warp(camera, panorama).transform_boxes([300.0, -20, 340, 20])
    assert valid
    assert boxes[1] <= 0
    assert boxes[2] - boxes[0] > 600


def test_transforms_of_functions():
    """Through a grid that is kept, too."""
    warp = ct.Warp(fisheye(dtype=torch.float64), pinhole(dtype=torch.float64), torch.nn.Parameter(turn(5).double()))
    images, state = smooth(), dict(warp.requires_grad_(False).named_parameters())
    assert set(state) == {"rotation", "source.intrinsics", "source.distortion", "target.intrinsics"}
    k = state["source.intrinsics"]

    def made(k):
        return torch.func.functional_call(warp, {"source.intrinsics": k}, (images,))

    expected = warp(images)
    assert not torch.equal(made(k + 1), expected)
    torch.testing.assert_close(torch.func.vmap(made)(torch.stack((k, k)))[1], expected, atol=1e-9, rtol=0)
    forward, reverse = (jacobian(lambda k: made(k).sum())(k) for jacobian in (torch.func.jacfwd, torch.func.jacrev))
    assert forward.all()
    torch.testing.assert_close(forward, reverse)


CHANGES = {
    "a focal length": lambda warp: warp.source.intrinsics.data[0].mul_(1.1),
    "the turn": lambda warp: warp.turned_by(torch.eye(3)),
    "the target": lambda warp: setattr(warp, "target", warp.source),
    "the mode": lambda warp: setattr(warp, "mode", "nearest"),
    "the padding": lambda warp: setattr(warp, "padding_mode", "border"),
    "the fill": lambda warp: setattr(warp, "fill", (9.0,)),
    "antialias": lambda warp: setattr(warp, "antialias", True),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_call_that_is_ready_follows_every_change(change):
    images = 255 * smooth(dtype=torch.float32)
    warp, later = (ct.Warp(fisheye().float(), pinhole().float(), turn(60)).requires_grad_(False) for _ in range(2))
    before = [warp(images) for _ in range(3)][-1]
    assert warp._kept.result.calls or not native_available()
    CHANGES[change](warp)
    CHANGES[change](later)
    after = warp(images)
    assert torch.equal(after, later(images))
    assert after.shape != before.shape or not torch.equal(after, before)


def test_the_rotation_that_the_error_about_a_vector_names_is_kept():
    camera, vector = ct.Pinhole.from_fov(70, image_size=(12, 16)), [0.1, 0.0, 0.0]
    with pytest.raises(ValueError, match="rotation must be") as error:
        ct.Warp(camera, camera, vector)
    code = re.search(r"Pass (ct\..*) for a rotation vector", str(error.value))[1]
    rotation = eval(code, {"ct": ct, "vector": vector})
    assert torch.equal(ct.Warp(camera, camera, rotation).state_dict()["rotation"], rotation)
