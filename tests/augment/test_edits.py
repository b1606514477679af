"""Edits with all that a sample holds: the camera, the labels and the image agree, along any chain of them."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from cameras import slow_unless

import camtorch as ct
import camtorch.augment.numpy
from camtorch.poses import rotations
from camtorch.values.arguments import TOLD
from camtorch.warp import sampling, together

A = ct.augment
SIZE = (48, 64)
DISTORTION = {
    ct.Pinhole: None,
    ct.BrownConrady: [-0.2, 0.05, 0.002, -0.003, 0.01, 0.0, 0.0, 0.0, 1e-3, 2e-3, -1e-3, 1e-3, 0.0, 0.01],
    ct.Fisheye624: [0.02, -0.01, 0.003, 0.0, 0.0, 0.0, 2e-3, -1e-3, 1e-3, 0.0, 2e-3, 1e-3],
    ct.OCamCalib: [0.01, -0.02, 0.0, -0.2, 0.01, 0.001],
}


def camera(model=ct.BrownConrady, dtype=torch.float64, size=SIZE):
    scale = size[0] / 48
    k = DISTORTION[model]
    numbers = [torch.tensor([60.0 * scale, 62.0 * scale, 33.0 * scale, 22.0 * scale], dtype=dtype)]
    numbers += [] if k is None else [torch.tensor(k, dtype=dtype)]
    return model(*numbers, image_size=size).requires_grad_(False)


def sample(lens, count=3, number=12, seed=0):
    generator = torch.Generator().manual_seed(seed)
    dtype = lens.intrinsics.dtype
    points = torch.randn(count, number, 3, generator=generator, dtype=torch.float64) * 0.3
    points = (points + torch.tensor([0.0, 0.0, 1.5])).to(dtype)
    pose = torch.eye(4).repeat(count, 1, 1).double()
    pose[:, :3, :3] = rotations.rotation_matrix(torch.randn(count, 3, generator=generator).double())
    pose[:, :3, 3] = torch.randn(count, 3, generator=generator).double() + 2
    return {
        "keypoints": lens.project(points)[0],
        "points": points,
        "gaze": torch.randn(count, 3, generator=generator).to(dtype),
        "head_pose": pose.to(dtype),
        "rvec": torch.randn(count, 3, generator=generator).to(dtype),
        "tvec": torch.randn(count, 3, generator=generator).to(dtype),
        "camera": lens,
    }


def missed(out):
    """The largest distance in pixels between keypoints and the points where the new camera sees them."""
    pixels, valid = out["camera"].project(out["points"])
    use = out["keypoints_valid"] & valid
    assert use.sum() > 3
    return (pixels - out["keypoints"]).norm(dim=-1)[use].max().item()


EDITS = {
    "hflip": lambda: A.HorizontalFlip(p=0.5),
    "vflip": lambda: A.VerticalFlip(p=1.0),
    "resize": lambda: A.Resize((30, 100)),
    "shorter": lambda: A.Resize(24),
    "pad": lambda: A.Pad((1, 2, 3, 4)),
    "pad to": lambda: A.Pad(size=(64, 64)),
    "centre": lambda: A.CenterCrop((60, 40)),
    "crop": lambda: A.RandomCrop(40),
    "resized crop": lambda: A.RandomResizedCrop(SIZE, scale=(0.3, 1.0)),
    "quarter turn": lambda: A.Rotate90(1),
    "half turns": lambda: A.Rotate90(step=2),
}


@pytest.mark.parametrize("model", slow_unless(lambda model: model is ct.Fisheye624, list(DISTORTION)))
@pytest.mark.parametrize("name", EDITS)
def test_the_camera_follows_every_edit(name, model):
    lens = camera(model)
    edit = EDITS[name]()
    given = sample(lens)
    out = edit(given)
    assert missed(out) < 1e-9
    assert edit.size_after(SIZE) == out["camera"].image_size
    back = edit.inverse(out)
    for key in ("keypoints", "points", "gaze", "head_pose"):
        torch.testing.assert_close(back[key], given[key], atol=1e-9, rtol=0)
    turns = [rotations.rotation_matrix(s["rvec"]) for s in (back, given)]
    torch.testing.assert_close(*turns, atol=1e-9, rtol=0)


# -- what an independent computation says

MIRRORS = {"hflip": np.diag([-1.0, 1, 1]), "vflip": np.diag([1.0, -1, 1])}


def by_numpy(image, pixels, name):
    """The image (H, W), pixels (N, 2), and what the rays become, by the definition of an edit."""
    (height, width), (u, v) = image.shape, pixels.T
    if name == "hflip":
        return image[:, ::-1], np.stack((width - 1 - u, v), 1), MIRRORS[name]
    if name == "vflip":
        return image[::-1], np.stack((u, height - 1 - v), 1), MIRRORS[name]
    if name == "turn":
        return np.rot90(image), np.stack((v, width - 1 - u), 1), np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    if name == "pad":
        return np.pad(image, ((2, 4), (1, 3))), pixels + np.array([1, 2]), np.eye(3)
    if name == "crop":
        top, left = (height - 30) // 2, (width - 40) // 2
        padded = np.pad(image, 100)[100 + top : 130 + top, 100 + left : 140 + left]
        return padded, pixels - np.array([left, top]), np.eye(3)
    assert name == "triple"
    return image.repeat(3, 0).repeat(3, 1), (pixels + 0.5) * 3 - 0.5, np.eye(3)


MAKERS = {
    "hflip": lambda size: A.HorizontalFlip(p=1.0),
    "vflip": lambda size: A.VerticalFlip(p=1.0),
    "turn": lambda size: A.Rotate90(1),
    "pad": lambda size: A.Pad((1, 2, 3, 4)),
    "crop": lambda size: A.CenterCrop((30, 40)),
    "triple": lambda size: A.Resize((3 * size[0], 3 * size[1])),
}


@pytest.mark.parametrize("names", [*MAKERS, "hflip triple pad turn vflip crop hflip"])
def test_an_independent_computation_agrees(names):
    names = names.split()
    lens = camera(ct.Fisheye624)
    given = sample(lens, count=1, number=5)
    depth = np.random.default_rng(0).uniform(1, 2, SIZE)
    total, pixels, shown, edits = np.eye(3), given["keypoints"][0].numpy(), depth, []
    for name in names:
        edits.append(MAKERS[name](shown.shape))
        shown, pixels, turn = by_numpy(shown, pixels, name)
        total = turn @ total
    chain = A.Compose(edits) if len(edits) > 1 else edits[0]
    maps = {"depth": depth, "distance_2": depth, "mask": (depth * 100).astype(np.int64)}
    maps |= {} if "triple" in names else {"image": depth[None]}  # which interpolates images
    out = chain(given, **{name: torch.from_numpy(value)[None] for name, value in maps.items()})
    mirror, pose = np.diag([np.linalg.det(total), 1, 1]), given["head_pose"][0].numpy()
    for name, found, expected in (
        ("keypoints", out["keypoints"][0], pixels),
        ("gaze", out["gaze"][0], total @ given["gaze"][0].numpy()),
        ("tvec", out["tvec"][0], total @ given["tvec"][0].numpy()),
        ("points", out["points"][0], given["points"][0].numpy() @ total.T),
        ("rotation", out["rotation"][0], total),
        ("head", out["head_pose"][0, :3, :3], total @ pose[:3, :3] @ mirror),
        ("place", out["head_pose"][0, :3, 3], total @ pose[:3, 3]),
        *[("rvec", *(rotations.rotation_matrix(s["rvec"][0]).numpy() for s in (out, given)))],
    ):
        expected = total @ expected @ mirror if name == "rvec" else expected
        np.testing.assert_allclose(found, expected, atol=1e-9 if name == "keypoints" else 1e-12, err_msg=name)
    assert np.linalg.det(out["head_pose"][0, :3, :3]) == pytest.approx(1)
    # where a crop cut something off, and the last camera sees it again, it is shown
    same = shown != 0 if "crop" in names else np.ones_like(shown, bool)
    for name in maps:
        expected = (shown * 100).astype(np.int64) if name == "mask" else shown
        assert out[name].shape[-2:] == shown.shape
        np.testing.assert_array_equal(out[name].numpy().reshape(shown.shape)[same], expected[same])


UNSIGNED = [torch.uint8, torch.uint16, torch.uint32, torch.uint64]


@pytest.mark.parametrize("dtype", [*UNSIGNED, torch.float32, torch.int64, torch.bool])
def test_whole_steps_copy_pixels(dtype):
    whole = torch.randint(2 if dtype == torch.bool else 200, (4, 3, *SIZE), generator=torch.Generator().manual_seed(0))
    how = {"mode": "nearest" if dtype in UNSIGNED[2:] or dtype == torch.int64 else "bilinear"}
    image, some = whole.to(dtype), A.HorizontalFlip(**how)
    torch.manual_seed(4)  # which mirrors some of the four
    for k in range(4):
        assert torch.equal(A.Rotate90(k, **how)(image=image)["image"].long(), torch.rot90(whole, k, (-2, -1)))
    padded = A.Pad((1, 2, 3, 4), fill=1, **how)(image=image)["image"]
    assert torch.equal(padded.long(), F.pad(whole, (1, 3, 2, 4), value=1))
    out = some(image=image, mask=image)
    assert 0 < some.last.mirrored.sum() < 4
    expected = torch.where(some.last.mirrored[:, None, None, None], whole.flip(-1), whole)
    for name in ("image", "mask"):
        assert out[name].dtype == dtype
        assert torch.equal(out[name].long(), expected)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_what_shrinks_is_what_torchvision_makes(dtype):
    image = torch.randint(0, 256, (3, 3, 96, 128), generator=torch.Generator().manual_seed(0)).to(dtype)

    def resized(image, size, antialias=False):
        return F.interpolate(image, size, mode="bilinear", antialias=antialias)

    assert torch.equal(A.Resize((20, 30))(image=image)["image"], resized(image, (20, 30), antialias=True))
    for size, options in (((200, 300), {}), ((20, 30), {"antialias": False})):
        out = A.Resize(size, **options)(image=image.float())["image"]
        torch.testing.assert_close(out, resized(image.float(), size), atol=0.01, rtol=0)
    crop = A.Compose([A.RandomResizedCrop((20, 30), scale=(0.5, 1.0)), A.HorizontalFlip()])
    out = crop(image=image, keypoints=torch.zeros(3, 1, 2))
    for i, part in enumerate(out["image"]):
        edges = torch.tensor([[-0.5, -0.5], [29.5, 19.5]])
        corners = crop.last.row(i).inverse().points(edges[None])[0][0] + 0.5
        (left, top), (right, bottom) = corners.amin(0).round().int().tolist(), corners.amax(0).round().int().tolist()
        expected = resized(image[i : i + 1, :, top:bottom, left:right], (20, 30), antialias=True)[0]
        assert torch.equal(part, expected.flip(-1) if bool(crop.last.mirrored[i]) else expected)


def scene(rays):
    """Smooth colours of the directions."""
    x, y, z = rays.unbind(-1)
    return torch.stack((x, y, x * y, z), -1).movedim(-1, -3)


def mixture(**options):
    return A.Compose(
        [
            A.RandomResizedCrop((96, 128), scale=(0.4, 0.9), ratio=(0.9, 1.1)),
            A.HorizontalFlip(),
            A.RandomLens("kannala_brandt", fov=(40, 50)),
            A.RandomMount(yaw=5, pitch=5, roll=20),
            A.Rotate90(step=2),
            A.VerticalFlip(),
        ],
        **options,
    )


@pytest.mark.parametrize("dtype", ["uint16", pytest.param("uint32", marks=pytest.mark.slow), "uint64"])
@pytest.mark.parametrize("name", ["flip", "mount", "turn", "pad"])
def test_chains_take_all_unsigned_integers(name, dtype):
    lens = ct.KannalaBrandt([200.0, 200, 159.5, 119.5], [0.01, 0, 0, 0], image_size=(240, 320))
    augment = {
        "flip": lambda **how: A.Compose([A.RandomResizedCrop(40), A.HorizontalFlip()], **how),
        "mount": lambda **how: A.Compose([A.RandomMount(yaw=10, camera=lens), A.RandomResizedCrop(40)], **how),
        "turn": lambda **how: A.Compose([A.CenterCrop(200), A.Rotate90(), A.Resize(20)], **how),
        "pad": lambda **how: A.Compose([A.HorizontalFlip(), A.CenterCrop((250, 400))], fill=(-1.0, 7.6, 3.0), **how),
    }[name](mode="bilinear" if dtype == "uint16" else "nearest")
    images = torch.randint(0, 256, (3, 3, 240, 320), generator=torch.Generator().manual_seed(0))
    for seed in range(5):
        for count in (3, 1):
            draw = augment.draw(count, torch.Generator().manual_seed(seed))
            # ids of signed integers: at exact halves of pixels the nearest one of floats may be the other one
            wide = images[:count].double() if dtype == "uint16" else images[:count]
            expected = augment(image=wide, draw=draw)["image"].clamp(min=0)
            moved = augment(image=images[:count].to(getattr(torch, dtype)), draw=draw)["image"]
            assert moved.dtype == getattr(torch, dtype)
            assert (moved.double() - expected).abs().max() <= 1  # two roundings
        array = images[0].permute(1, 2, 0).numpy().astype(dtype)
        single = camtorch.augment.numpy.Transform(augment)(image=array, draw=draw)
        assert (single["image"] == moved[0].permute(1, 2, 0).numpy()).all()


@pytest.mark.parametrize("antialias", [None, True])
def test_an_image_is_the_same_in_every_batch(antialias):
    images = torch.rand(6, 3, 120, 160, generator=torch.Generator().manual_seed(0))
    for parts in ([A.RandomResizedCrop(60)], [A.CenterCrop(100), A.Rotate90(), A.RandomResizedCrop(40)]):
        augment = A.Compose(parts, antialias=antialias)
        draw = augment.draw(6, torch.Generator().manual_seed(0))
        together = augment(image=images, draw=draw)["image"]
        for i in range(6):
            alone = augment(image=images[i : i + 1], draw={key: value[i : i + 1] for key, value in draw.items()})
            assert (alone["image"][0] - together[i]).abs().max() < 1e-4


@pytest.mark.parametrize("side", [12, 30, 90])
def test_images_that_shrink_are_smoothed_before_and_after_a_lens(side):
    lens = ct.Pinhole([200.0, 200, 159.5, 119.5], image_size=(240, 320)).requires_grad_(False)
    mount, resize = A.RandomMount(yaw=5, pitch=5), A.Resize((side, side))
    image, inner = torch.zeros(1, 1, 240, 320), slice(side // 3, -side // 3)
    image[..., ::2] = 1
    for parts in ([mount, resize], [resize, mount]):
        for images in (image, image.repeat(4, 1, 1, 1)):  # one sample, and a batch
            for antialias in (None, False):
                chain = A.Compose(parts, camera=lens, antialias=antialias)
                seen = chain(image=images, generator=torch.Generator().manual_seed(0))["image"][..., inner, inner]
                # stripes are grey from afar
                assert seen.std() > 0.2 if antialias is False else (seen - 0.5).abs().max() < 0.1


def test_only_edits_choose_what_to_antialias():
    image, lens = torch.rand(1, 3, 240, 320), ct.Pinhole([200.0, 200, 159.5, 119.5], image_size=(240, 320))
    still = {"yaw": None, "pitch": None, "roll": None, "zoom": (0.3, 0.3), "min_filled": 0, "camera": lens}
    mounts = [A.RandomMount(**still, antialias=antialias) for antialias in (None, False)]
    assert torch.equal(*(mount(image=image)["image"] for mount in mounts))
    made = A.Resize((60, 80))(image=image)["image"]
    plain = A.Resize((60, 80), antialias=False)
    for flag in ({"antialias": None}, {"_warps_decide": True}):  # of states before 0.5
        kept = A.Resize.__new__(A.Resize, (60, 80))
        state = {**vars(plain), **flag}
        kept.__setstate__(state)
        assert kept.antialias is None
        assert flag.items() <= state.items()
        assert state["options"]["antialias"] is plain.antialias is False
        assert torch.equal(kept(image=image)["image"], made)
    assert not torch.equal(plain(image=image)["image"], made)


def test_a_chain_shows_what_its_last_camera_sees():
    torch.manual_seed(1)  # which mirrors some of the four
    lens = camera(ct.Fisheye624, torch.float32, (96, 128))
    image = scene(lens.rays()[0]).expand(4, -1, -1, -1)
    out = mixture(valid_mask=True)(image=image, camera=lens, **{k: sample(lens, 4)[k] for k in ("keypoints", "points")})
    assert missed(out) < 1e-3
    rays, _ = out["camera"].rays()
    expected = scene(torch.einsum("bij,bhwi->bhwj", out["rotation"], rays))
    inner = -F.max_pool2d(-out["image_valid"].float(), 5, 1, 2) > 0
    error = (out["image"] - expected).abs() * inner
    assert inner.float().mean() > 0.5
    assert error.max() < 2e-3
    assert {int(d.sign()) for d in torch.linalg.det(out["rotation"])} == {-1, 1}


def test_a_chain_is_one_resampling(monkeypatch):
    lens, made = camera(dtype=torch.float32, size=(96, 128)), []

    def watched(real):
        def call(*arguments, **options):
            result = real(*arguments, **options)
            made.append(result is not None and len(result) > 0)
            return result

        return call

    call = camtorch.native.sampler.NativeJob
    for module, name in ((call, "__call__"), (sampling, "_within_memory"), (together.SampleCall, "__call__")):
        monkeypatch.setattr(module, name, watched(getattr(module, name)))
    mixture()(image=torch.randint(0, 256, (4, 3, 96, 128), dtype=torch.uint8), camera=lens)
    assert sum(made) == 1


def test_a_chain_is_its_parts_one_after_the_other():
    lens = camera(ct.Fisheye624)
    given, chain = sample(lens, count=5), mixture()
    nested = A.Compose([A.Compose(chain.parts[:2]), *chain.parts[2:]])
    outs = []
    for run in (chain, torch.nn.Sequential(*chain.augmentations), nested):
        torch.manual_seed(7)
        outs.append(run(given))
    out, steps, in_two = outs
    for name in ("points", "gaze", "head_pose", "rotation"):
        torch.testing.assert_close(out[name], steps[name], atol=1e-9, rtol=0)
    both = steps["keypoints_valid"]  # all the way
    assert bool((out["keypoints_valid"] >= both).all())
    assert both.float().mean() > 0.4
    torch.testing.assert_close(out["keypoints"][both], steps["keypoints"][both], atol=1e-9, rtol=0)
    torch.testing.assert_close(out["camera"].intrinsics, steps["camera"].intrinsics)
    torch.testing.assert_close(in_two["keypoints"], out["keypoints"], atol=1e-9, rtol=0)
    back = chain.inverse(chain(given, draw=chain.draw(5, torch.Generator().manual_seed(2))))
    torch.testing.assert_close(back["keypoints"], given["keypoints"], atol=1e-8, rtol=0)
    torch.testing.assert_close(back["head_pose"], given["head_pose"], atol=1e-9, rtol=0)


def test_rows_that_nothing_applies_to_stay():
    lens = camera(dtype=torch.float32)
    image = torch.rand(40, 1, *SIZE)
    chain = A.Compose([A.HorizontalFlip(), A.RandomLens(p=0.5), A.VerticalFlip(p=0.2)], camera=lens)
    out = chain(image=image, keypoints=torch.rand(40, 3, 2) * 40)
    still = (chain.last.rotation == torch.eye(3)).all((1, 2)) & (out["camera"].intrinsics == lens.intrinsics).all(1)
    assert 3 < still.sum() < 30
    assert torch.equal(out["image"][still], image[still])
    never = A.Compose([A.HorizontalFlip(p=1.0)], p=0.0)
    assert torch.equal(never(image=image)["image"], image)
    for skipped in (A.Resize(20, p=0), A.RandomResizedCrop(20, p=0), A.Compose([A.Resize(20, p=0)])):
        assert torch.equal(skipped(image=image)["image"], image)
    whole = A.Compose([A.HorizontalFlip(p=1.0)], same_on_batch=True, p=0.5)
    flipped = {tuple(whole(image=image)["rotation"][:, 0, 0].unique().tolist()) for _ in range(20)}
    assert flipped == {(1.0,), (-1.0,)}


def test_the_camera_of_a_single_sample_is_single_whatever_applies():
    lens = camera(dtype=torch.float32).requires_grad_(False)
    chain = A.Compose([A.RandomMount(p=0.5), A.RandomLens("dms130", fov="source", p=0.5)], camera=lens)
    outs = [chain(image=torch.rand(1, *SIZE)) for _ in range(12)]
    assert {(out["camera"].batch_shape, out["rotation"].shape) for out in outs} == {((), (3, 3))}
    assert {bool((out["camera"].intrinsics == lens.intrinsics).all()) for out in outs} == {True, False}


def test_light_and_colours_go_through_edits():
    lens = camera(dtype=torch.float32)
    image = torch.full((2, 3, *SIZE), 200, dtype=torch.uint8)
    shade = A.RandomLens(vignetting=0.6, chromatic=(0.02, 0.02), focal=(1.2, 1.2), centre=0, distortion=0, camera=lens)
    alone = shade(image=image, draw=(draw := shade.draw(2)))["image"]
    chain = A.Compose([shade, A.HorizontalFlip(p=1.0), A.Rotate90(1), A.Pad(3)])
    values = {f"0.{name}": value for name, value in draw.items()}
    out = chain(image=image, draw={**chain.draw(2), **values})["image"]
    expected = torch.rot90(alone.flip(-1), 1, (-2, -1)).int()
    assert (out[..., 4:-4, 4:-4].int() - expected[..., 1:-1, 1:-1]).abs().max() <= 2
    assert expected.float().std() > 10
    white = A.RandomLens(vignetting=0.0, focal=None, centre=None, distortion=None, camera=lens)
    moved = A.Compose([white, A.Pad(5)], padding_mode="border")(image=image)["image"]
    assert (moved == 200).all()  # no light is lost at a rim that goes on
    with pytest.raises(ValueError, match=r"be edits after chromatic and vignetting.* got RandomLens"):
        A.Compose([shade, A.RandomMount()])


@pytest.mark.parametrize("name", A.LANDMARKS)
def test_landmark_tables(name):
    order = A.LANDMARKS[name]
    assert name.endswith(str(len(order)))
    assert [order[i] for i in order] == list(range(len(order)))
    points, image = torch.rand(3, len(order), 2) * 40, torch.zeros(3, 1, *SIZE)
    flip = A.HorizontalFlip(p=1.0, landmarks=name)
    once = flip(keypoints=points, image=image)["keypoints"]
    assert torch.equal(once, (points * torch.tensor([-1, 1]) + torch.tensor([63, 0]))[:, list(order)])
    torch.testing.assert_close(flip(keypoints=once, image=image)["keypoints"], points)
    half_turn = A.Compose([flip, A.VerticalFlip(p=1.0, landmarks=name)])(keypoints=points, image=image)["keypoints"]
    torch.testing.assert_close(half_turn, torch.tensor([63.0, 47.0]) - points)


@pytest.mark.parametrize("name", ["ibug68", "wflw98", "lapa106"])
def test_landmarks_mirror_the_mean_face(name):
    """Of the mean face of a data set, every landmark's mirror image is nearest to the one that the table says."""
    face = torch.tensor(json.loads((Path(__file__).parents[1] / "files" / "mean_faces.json").read_text())[name])
    face = face - face.mean(0)
    # the face's own middle line, which leans a little
    mirrored = (face * torch.tensor([-1.0, 1.0]))[list(A.LANDMARKS[name])]
    u, _, v = torch.linalg.svd(mirrored.T @ face)
    mirrored = mirrored @ (u @ v)
    assert (mirrored - face).norm(dim=1).max() < 0.05
    nearest = torch.cdist(face, mirrored).argmin(1)
    # lips that are closed nearly touch
    assert (nearest == torch.arange(len(face))).float().mean() > 0.93


def test_coco_by_its_names():
    parts = ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    names = ["nose", *(f"{side}_{part}" for part in parts for side in ("left", "right"))]
    mirrored = [name.replace("left", "-").replace("right", "left").replace("-", "right") for name in names]
    assert list(A.LANDMARKS["coco17"]) == [names.index(name) for name in mirrored]


def test_landmarks_by_field_and_by_pairs():
    image, five, body = torch.zeros(2, 1, *SIZE), torch.rand(2, 5, 2) * 40, torch.rand(2, 17, 2) * 40
    flip, order = A.HorizontalFlip(p=1.0, landmarks=[(0, 1), (3, 4)]), [1, 0, 2, 4, 3]
    valid = torch.tensor([[True, False, True, True, True]] * 2)
    out = flip(image=image, landmarks=five, landmarks_valid=valid, points=torch.rand(2, 7, 3))
    assert torch.equal(out["landmarks"][..., 1], five[:, order, 1])
    assert out["landmarks_valid"][0].tolist() == [False, True, True, True, True]
    listed = flip(image=image, landmarks=[five[0], torch.rand(8, 2) * 40])
    assert torch.equal(listed["landmarks"][0], out["landmarks"][0])
    by_name = A.HorizontalFlip(p=1.0, landmarks={"keypoints": "coco17", "landmarks": order})
    both = by_name(image=image, landmarks=five, keypoints=body, points=torch.rand(2, 5, 3), keypoints_3=five)
    assert torch.equal(both["landmarks"], out["landmarks"])
    assert torch.equal(both["keypoints"][..., 1], body[:, list(A.LANDMARKS["coco17"]), 1])
    assert torch.equal(both["keypoints_3"][..., 1], five[..., 1])
    with pytest.raises(ValueError, match="keypoints must have 68 points, as landmarks has; got 5"):
        A.HorizontalFlip(p=1.0, landmarks="ibug68")(image=image, keypoints=five)
    for bad in ("ibug", [1, 2, 0], [(0, 1), (1, 2)], [(0, 1, 2)], [0, 0]):
        with pytest.raises(ValueError, match="landmarks must"):
            A.HorizontalFlip(landmarks=bad)


@pytest.mark.parametrize(("count", "name"), [(98, "wflw98"), (468, "mediapipe468"), (478, "mediapipe478")])
def test_a_mirrored_face_without_a_table_is_told_once(count, name):
    TOLD.clear()
    sample = {"image": torch.zeros(1, *SIZE), "keypoints": torch.rand(2, count, 2) * 40}
    with pytest.warns(UserWarning, match=f"keypoints holds {count} points, .* landmarks='{name}'") as told:
        [A.HorizontalFlip(p=1.0)(sample), A.VerticalFlip(p=1.0)(sample)]
    assert len(told) == 1
    TOLD.clear()
    kept = A.HorizontalFlip(p=1.0, landmarks={})(sample)["keypoints"]
    assert torch.equal(kept[..., 1], sample["keypoints"][..., 1])


def test_sizes_of_one_number_in_a_list_are_torchvisions():
    image = torch.rand(3, *SIZE)
    assert A.Resize([24])(image=image)["image"].shape == A.Resize(24)(image=image)["image"].shape == (3, 24, 32)
    assert A.CenterCrop((24,))(image=image)["image"].shape == (3, 24, 24)


def test_what_is_told_of_each_landmark_changes_places_with_it():
    tables = dict.fromkeys(("keypoints", "visibility"), "coco17")
    flip = A.HorizontalFlip(1.0, landmarks=tables)
    image, keypoints, flags = torch.rand(2, 3, *SIZE), torch.rand(2, 17, 2) * 40, torch.arange(34).view(2, 17)
    swapped = flags[:, list(A.LANDMARKS["coco17"])]
    assert torch.equal(flip(image=image, keypoints=keypoints, visibility=flags)["visibility"], swapped)
    lists = flip(image=image, keypoints=list(keypoints), visibility=list(flags))["visibility"]
    assert torch.equal(torch.stack(lists), swapped)
    one = flip(image=image[0], keypoints=keypoints[0], visibility=flags[0])
    assert torch.equal(one["visibility"], swapped[0])
    given = {"keypoints": keypoints[0].numpy(), "visibility": flags[0].numpy()}
    arrays = camtorch.augment.numpy.Transform(flip)(image=np.zeros((*SIZE, 3), np.uint8), **given)
    np.testing.assert_array_equal(arrays["visibility"], swapped[0].numpy())
    still = A.HorizontalFlip(0.0, landmarks=tables)(image=image, keypoints=keypoints, visibility=flags)
    assert torch.equal(still["visibility"], flags)
    for wrong, error in ((flags[0], "must be"), (flags[:1], "must be of 2 samples, as others; got 1")):
        with pytest.raises(ValueError, match=error):
            flip(image=image, keypoints=keypoints, visibility=wrong)
    with pytest.raises(TypeError, match="visibility has a table"):
        flip(image=image[0], keypoints=keypoints[0], visibility=[2] * 17)


def test_left_and_right_change_places():
    image, left, right = torch.zeros(6, 1, *SIZE), torch.randn(6, 3), torch.randn(6, 3)
    flip = A.HorizontalFlip()
    out = flip(image=image, gaze_left=left, gaze_right=right)
    rows, mirror = flip.last.mirrored, torch.tensor([-1.0, 1.0, 1.0])
    assert 0 < rows.sum() < 6
    torch.testing.assert_close(out["gaze_left"][rows], (right * mirror)[rows])
    assert torch.equal(out["gaze_left"][~rows], left[~rows])
    torch.testing.assert_close(out["gaze_right"][rows], (left * mirror)[rows])
    single = A.HorizontalFlip(p=1.0)(image=image[0], gaze_left=left[0], gaze_right=right[0])
    assert torch.equal(single["gaze_left"], right[0] * mirror)
    with pytest.raises(ValueError, match="gaze_left must have a gaze_right"):
        A.HorizontalFlip(p=0.0)(image=image, gaze_left=left)
    kept = A.HorizontalFlip(p=1.0, swap_sides=False)(image=image, gaze_left=left)
    assert torch.equal(kept["gaze_left"], left * mirror)


def test_a_mirrored_head_is_a_mirrored_model():
    """Points of a symmetric head, posed: the mirrored pose puts landmark i where the mirrored image shows it."""
    lens, pairs = camera(), [(i, i + 1) for i in range(0, 8, 2)]
    pose = sample(lens)["head_pose"]
    pose[:, :3, 3] = torch.tensor([0.1, -0.05, 1.5])
    for axis in range(3):
        half = torch.rand(4, 3).double() * 0.2
        other = half * (1 - 2 * torch.eye(3)[axis])
        model = torch.stack((half, other), 1).flatten(0, 1)
        flip = A.HorizontalFlip(p=1.0, landmarks=pairs, lateral_axis="xyz"[axis])
        before = lens.project(model @ pose[:, :3, :3].mT + pose[:, None, :3, 3])[0]
        out = flip(keypoints=before, head_pose=pose, camera=lens)
        new = out["head_pose"]
        seen = out["camera"].project(model @ new[:, :3, :3].mT + new[:, None, :3, 3])[0]
        torch.testing.assert_close(seen, out["keypoints"], atol=1e-9, rtol=0)


def test_samples_without_a_camera():
    edits, corners = A.Compose([A.Resize((24, 32)), A.HorizontalFlip(p=1.0), A.Pad(2)]), [[0.0, 0.0], [63.0, 47.0]]
    out = edits(image=torch.rand(3, *SIZE), keypoints=torch.tensor(corners), gaze=torch.ones(3))
    assert "camera" not in out
    assert out["image"].shape == (3, 28, 36)
    torch.testing.assert_close(out["keypoints"], torch.tensor([[33.25, 1.75], [1.75, 25.25]]))
    assert out["gaze"].tolist() == [-1.0, 1.0, 1.0]
    back = edits.inverse(image=out["image"], keypoints=out["keypoints"])
    torch.testing.assert_close(back["keypoints"], torch.tensor(corners), atol=1e-5, rtol=0)
    flip = A.HorizontalFlip(p=1.0)
    listed = flip(image=torch.rand(2, 1, 20, 30), keypoints=[torch.zeros(n, 2) for n in (1, 2)])
    assert [k[:, 0].tolist() for k in listed["keypoints"]] == [[29.0], [29.0, 29.0]]
    for edit, fields, text in (
        (flip, {"keypoints": torch.zeros(1, 2)}, "HorizontalFlip: the sample must have an image or a camera"),
        (A.Compose([flip, A.RandomLens()]), {"image": torch.rand(3, *SIZE)}, "Compose: the sample must have a camera"),
        (flip, {"image": torch.rand(*SIZE, 3)}, "channels first"),
    ):
        with pytest.raises(ValueError, match=text):
            edit(fields)


def test_pixels_without_a_ray_move_as_well():
    """A fisheye's black corners, and what somebody wrote there."""
    lens = ct.KannalaBrandt([20.0, 20, 31.5, 23.5], [-0.1, 0, 0, 0], image_size=SIZE).requires_grad_(False)
    corner = torch.tensor([[[1.0, 1.0]]])
    assert not lens.unproject(corner)[1].any()
    image = torch.rand(1, 1, *SIZE)
    out = A.Compose([A.HorizontalFlip(p=1.0), A.Pad(1)])(image=image, keypoints=corner, camera=lens)
    assert out["keypoints"].tolist() == [[[63.0, 2.0]]]
    assert out["keypoints_valid"].all()
    assert torch.equal(out["image"][..., 1:-1, 1:-1], image.flip(-1))
    pixels = torch.tensor([[[torch.nan, 1.0], [1e30, 0.0], [1.0, 1.0]]])
    bad = A.HorizontalFlip(p=1.0)(image=image, keypoints=pixels, camera=lens)
    assert bad["keypoints_valid"].tolist() == [[False, False, True]]
    assert torch.isfinite(bad["keypoints"]).all()


def test_cameras_of_several_models():
    cameras = [camera(model) for model in DISTORTION]
    given = [sample(lens, 1, seed=i) for i, lens in enumerate(cameras)]
    fields = {name: torch.cat([one[name] for one in given]) for name in ("keypoints", "points")}
    for many in (cameras, ct.Mixed(cameras)):
        chain = A.Compose([A.RandomResizedCrop(SIZE, scale=(0.5, 1)), A.HorizontalFlip(), A.RandomMount(p=0.5)])
        out = chain(image=torch.rand(4, 3, *SIZE), camera=many, **fields)
        for i, lens in enumerate(out["camera"]):
            pixels, valid = lens.project(out["points"][i])
            use = valid & out["keypoints_valid"][i]
            torch.testing.assert_close(pixels[use], out["keypoints"][i][use], atol=1e-9, rtol=0)
        assert type(out["camera"]) is type(many)


def test_wrong_arguments_are_told():
    image, size = torch.rand(2, 1, *SIZE), r"RandomCrop: size must be within the image's \(48, 64\); got \(50, 50\)"
    draw = {"apply": torch.ones(2, dtype=torch.bool), "times": torch.tensor([0.1, 0.3])}
    for make, text in (
        (lambda: A.Pad(), "either padding or size"),
        (lambda: A.Pad(-1), "none negative"),
        (lambda: A.Pad((1, 2, 3)), "padding must be one number"),
        (lambda: A.Resize((0, 3)), "Resize: size must be positive"),
        (lambda: A.Rotate90(0.5), "times must be a whole number"),
        (lambda: A.RandomResizedCrop(20, scale=(0.5, 2.0)), "scale must lie within"),
        (lambda: A.HorizontalFlip(min_filled=0.3), "unknown keyword .min_filled.; .*Augmentation has it"),
        (lambda: A.HorizontalFlip(lateral_axis="left"), "lateral_axis must be"),
        (lambda: A.Compose([]), "must hold at least one"),
        (lambda: A.Compose([torch.nn.Identity()]), "must be a list of augmentations of camtorch; got Identity"),
        (lambda: A.Compose([A.Resize(3, mode="nearest")]), "one mode; got 'nearest' of Resize. Pass it to Compose"),
        (lambda: A.Compose([A.HorizontalFlip(landmarks="ibug68"), A.VerticalFlip()]), "have equal landmarks"),
        (lambda: A.RandomCrop(50)(image=image), size),
        (lambda: A.Resize(20, p=0.5)(image=image), "images must keep their size .* with p < 1"),
        (lambda: A.Rotate90()(image=image, draw=draw), "same_on_batch=True turns all alike"),
    ):
        with pytest.raises((TypeError, ValueError), match=text):
            make()


@pytest.mark.parametrize("name", ["CenterCrop", "RandomCrop", "RandomResizedCrop"])
def test_boxes_stay_where_any_of_their_mask_does(name):
    corners = torch.rand(60, 2, 2) * torch.tensor([420.0, 340.0]) - 50
    boxes = torch.cat((corners.amin(1), corners.amax(1) + 2), -1).round()
    boxes[0] = torch.tensor([60.0, 40.0, 260.0, 200.0])
    pixels = torch.cartesian_prod(torch.arange(240), torch.arange(320)).flip(-1)
    masks = ((pixels >= boxes[:, None, :2]) & (pixels <= boxes[:, None, 2:])).all(-1).view(60, 240, 320)
    out = getattr(A, name)((112, 112))(image=torch.zeros(60, 1, 240, 320), mask=masks, boxes=boxes[:, None])
    shown, (moved, valid) = out["mask"].flatten(1).any(-1), (out[key][:, 0] for key in ("boxes", "boxes_valid"))
    assert shown.any()
    assert valid[shown].all()
    # what has no pixel of the mask ends within one of the image's edge, or was nowhere on the image
    near = (moved[:, :2] < 114).all(-1) & (moved[:, 2:] > -2).all(-1)
    assert not valid[~near].any()
    # nor is a sample that stays asked otherwise
    camera = ct.Pinhole([300.0, 300.0, 159.5, 119.5], image_size=(240, 320)).requires_grad_(False)
    boxes = torch.stack((boxes[0] + 400, 100 * boxes[0] - 9000))
    assert A.RandomMount(p=0.0, camera=camera)(boxes=boxes)["boxes_valid"].tolist() == [False, True]


def test_quarter_turns_of_several_models_are_told_of_where_images_are_one_tensor():
    cameras = [m.from_fov(60, image_size=(16, 24)).requires_grad_(False) for m in (ct.Pinhole, ct.KannalaBrandt)]
    draw = {"apply": torch.ones(2, dtype=torch.bool), "times": torch.tensor([0.1, 0.3])}
    change = A.Rotate90().change(cameras, draw)
    with pytest.raises(ValueError, match=r"in one size; got \[\(16, 24\), \(24, 16\)\]. same_on_batch"):
        change.images(torch.rand(2, 3, 16, 24))
    assert change.points(torch.zeros(2, 5, 2))[0].shape == (2, 5, 2)
