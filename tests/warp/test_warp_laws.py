"""Laws of every kind of warp: images and labels go together, a batch goes one by one, and its numbers learn."""

import copy
import pickle
from functools import partial

import pytest
import torch

import camtorch as ct
from camtorch.poses.rotations import rotation_matrix
from camtorch.warp.affine import AffineWarp, HalvingWarp, made_like
from camtorch.warp.shifted import ShiftedWarp

SIZE, SMALL = (24, 32), (10, 14)
NUMBERS = {
    "focal": [11.0, 11.2, 15.5, 11.5],
    "lens": [0.02, -0.01, 0.004, -0.001],
    "wide": [8.0, 8.2, 6.5, 4.5],
    "turn": [0.03, -0.1, 0.05],
    "shift": [0.1, -0.05, 0.08],
    "normal": [0.1, 0.3, 1.0],
    "distance": 2.5,
    "readout": 0.02,
    "rates": [0.5, 1.8, 0.5],
}
LEVEL = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()
DEPTH = 1 + torch.rand(1, 1, *SMALL, generator=torch.Generator().manual_seed(1)).double()


def source(p):
    return ct.KannalaBrandt(p["focal"], p["lens"], image_size=SIZE)


def target(p):
    return ct.Pinhole(p["wide"], image_size=SMALL)


def pose(p):
    return ct.Extrinsics(p["turn"][..., None], p["shift"])


def shutter(p):
    return ct.RollingShutter(p["readout"], p["rates"])


def above(p):
    down = rotation_matrix(torch.tensor([0.6, 0, 0]).double()) @ LEVEL
    rotation = down.to(p["turn"]) @ rotation_matrix(p["turn"])
    place = p["shift"] + torch.tensor([0.0, 0, 2]).to(p["shift"])
    return ct.Extrinsics.from_matrix(rotation, -(rotation @ place[..., None])[..., 0])


CAMERAS = ("focal", "lens", "wide", "turn")
ROLLING, PLANE = (*CAMERAS, "readout", "rates"), (*CAMERAS, "shift", "normal", "distance")


def turned(kind, p, **options):
    return kind(source(p), target(p), rotation_matrix(p["turn"]), **options)


# what makes a warp of numbers by name, and which of them it takes
KINDS = {
    "turned": (lambda p: turned(ct.Warp, p), CAMERAS),
    "undone": (lambda p: turned(ct.ShutterWarp, p, shutter=shutter(p)), ROLLING),
    "rolling": (lambda p: turned(ct.ShutterWarp, p, target_shutter=shutter(p)), ROLLING),
    "plane": (lambda p: ct.PlaneWarp(source(p), target(p), pose(p), p["normal"], p["distance"]), PLANE),
    "above": (
        lambda p: ct.BirdsEye(source(p), above(p), x=(-1.0, 1), y=(0.5, 2), resolution=0.15),
        ("focal", "lens", "turn", "shift"),
    ),
    "depth": (lambda p: ct.Reproject(source(p), target(p), pose(p)), (*CAMERAS, "shift")),
}
WARPS = [kind for kind in KINDS if kind != "depth"]


def numbers(kind, batched=(), dtype=torch.float64):
    """What a kind takes; three of each that is batched."""
    found = {name: torch.tensor(NUMBERS[name], dtype=torch.float64) for name in KINDS[kind][1]}
    scales = torch.tensor([1.0, 1.1, 0.9]).double()
    found |= {name: torch.stack([found[name] * s for s in scales]) for name in batched}
    return {name: value.to(dtype) for name, value in found.items()}


def still(kind, batched=(), dtype=torch.float64):
    return KINDS[kind][0](numbers(kind, batched, dtype)).requires_grad_(False)


def made(warp, images):
    """The images that any kind of warp makes."""
    return warp(images, DEPTH.to(images.dtype), "distance")[0] if isinstance(warp, ct.Reproject) else warp(images)


def smooth(count=1, dtype=torch.float64, size=SIZE):
    """Images without detail that interpolation could lose."""
    v, u = torch.meshgrid(*(torch.arange(side, dtype=dtype) for side in size), indexing="ij")
    image = torch.stack((torch.sin(u / 5) * torch.cos(v / 4), u / size[1], v / size[0]))
    return torch.stack([image * (1 + 0.1 * i) for i in range(count)])


def results(warp, images, points):
    """Images and, of what moves labels, all of these."""
    if isinstance(warp, ct.Reproject):
        return [made(warp, images)]
    boxes, rays = torch.cat((points, points + 5), -1), torch.nn.functional.pad(points / 9 - 1, (0, 1), value=1.0)
    moved = [*warp.transform_points(points), *warp.transform_boxes(boxes), warp.transform_rays(rays)]
    return [warp(images), warp.valid_mask(), warp.grid(), *moved]


@pytest.mark.parametrize(("kind", "batched"), [(k, names) for k in KINDS for names in (*zip(KINDS[k][1]), KINDS[k][1])])
def test_a_batch_goes_one_by_one(kind, batched):
    many, images = still(kind, batched), smooth(3)
    points = torch.rand(3, 7, 2, generator=torch.Generator().manual_seed(0)).double() * 20
    whole = results(many, images, points)
    for i in (0, 2):
        single = {name: value[i] if name in batched else value for name, value in numbers(kind, batched).items()}
        alone = KINDS[kind][0](single).requires_grad_(False)
        for batch, one in zip(whole, results(alone, images[i : i + 1], points[i]), strict=True):
            row = batch[i] if len(batch) == 3 else batch[0]
            torch.testing.assert_close(row, one[0] if one.ndim == batch.ndim else one, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_all_that_it_is_made_of_learns(kind):
    names, values = zip(*numbers(kind).items(), strict=True)
    leaves = [value.clone().requires_grad_() for value in values]

    def image(images, *values):
        return made(KINDS[kind][0](dict(zip(names, values, strict=True))), images)

    # bilinear sampling is piecewise smooth: the step of the check must not cross a pixel boundary
    images = smooth()[:, :1].requires_grad_()
    assert torch.autograd.gradcheck(image, (images, *leaves), eps=1e-7, atol=1e-5, fast_mode=True)
    image(images, *leaves).square().sum().backward()
    assert all(leaf.grad.any() for leaf in leaves)


@pytest.mark.parametrize("kind", WARPS)
def test_the_image_agrees_with_the_points(kind):
    """An image of the coordinates, warped, holds the source coordinates from which points get to each pixel."""
    warp = still(kind)
    v, u = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) for side in SIZE), indexing="ij")
    back = warp(torch.stack((u, v))[None])[0].movedim(0, -1)
    seen, grid = warp.valid_mask()[0, 0], warp.target.pixel_grid().double()
    inside = seen & (back > 1).all(-1) & (back < torch.tensor([SIZE[1] - 2, SIZE[0] - 2])).all(-1)
    assert inside.sum() > 30
    moved, valid = warp.transform_points(back[inside])
    assert valid.all()
    torch.testing.assert_close(moved, grid[inside], rtol=0, atol=1e-7)
    again, valid = warp.inverse().transform_points(grid)
    assert torch.equal(valid, seen)
    torch.testing.assert_close(again[inside], back[inside], rtol=0, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_kept_until_something_changes(kind):
    warp, images = still(kind), smooth()
    before = made(warp, images)
    assert torch.equal(made(warp, images), before)
    tensors = dict((*warp.named_parameters(), *warp.named_buffers()))
    for name, tensor in tensors.items():
        if tensor.numel() == 0 or (kind == "above" and name == "normal"):
            continue
        tensor.data.mul_(1.02)
        changed = made(warp, images)
        assert not torch.equal(changed, before), name
        tensor.data.div_(1.02)
        torch.testing.assert_close(made(warp, images), before, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_copied_and_mapped(kind):
    warp, images = still(kind, dtype=torch.float32), smooth(2, torch.float32)
    expected = made(warp, images)
    for other in (copy.deepcopy(warp), pickle.loads(pickle.dumps(warp))):
        assert torch.equal(made(other, images), expected)
    if kind in WARPS:
        mapped = torch.func.vmap(lambda image: warp(image[None])[0])(images)
        torch.testing.assert_close(mapped, expected, rtol=0, atol=2e-4)


# kinds that augmentations make: two samples each
EDIT = torch.tensor([[[0.5, 0, 1], [0, 0.6, 2]], [[0.4, 0, 3], [0, 0.5, 1]]]).double()
DEPTHS = torch.ones(2, 1, *SIZE).double()
BATCHED = {
    "turned": lambda p: turned(HalvingWarp, p, antialias=None),
    "edited": lambda p: AffineWarp(source(p), target(p), EDIT.clone().requires_grad_(), None),
    "shifted": lambda p: turned(partial(ShiftedWarp, depth=DEPTHS, kind="z", shift=p["shift"]), p),
}


@pytest.mark.parametrize("kind", [*WARPS, *(f"augmented {kind}" for kind in BATCHED)])
def test_detached_and_row_by_row_it_keeps_all_that_it_is_made_of(kind):
    names = (*CAMERAS, "shift", "readout", "rates", "normal", "distance")
    given = {name: torch.tensor(NUMBERS[name]).double() * torch.tensor([[1.0], [1.1]]).double() for name in names}
    given = {name: value[:, 0] if name in ("readout", "distance") else value for name, value in given.items()}
    learning = BATCHED[kind.split()[1]](given) if "augmented" in kind else KINDS[kind][0](given)
    images, points = smooth(2), torch.rand(2, 7, 2).double() * 20
    expected, warp = results(learning, images, points), learning.detach()
    assert (type(warp), warp.options) == (type(learning), learning.options)
    assert not any(t.requires_grad for part in (warp, *warp.children()) for t in (*part.parameters(), *part.buffers()))
    numbers = dict((*warp.named_parameters(), *warp.named_buffers()))
    for name, number in (*learning.named_parameters(), *learning.named_buffers()):
        # a bird's eye has its target and its plane from its options
        if not (kind == "above" and name.startswith("target")):
            assert numbers[name].data_ptr() == number.data_ptr(), name
    assert warp.state_dict().keys() >= learning.state_dict().keys()
    for one, other in zip(results(warp, images, points), expected, strict=True):
        # relative too: points near the rim of the view land at pixels of any size
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)
    if "shifted" not in kind:
        back = warp.inverse()
        assert not any(t.requires_grad for t in (*back.parameters(), *back.buffers()))
        assert type(back) is (ct.PlaneWarp if kind == "above" else type(warp))
    if kind == "above":
        assert torch.equal(warp.grid_points, learning.grid_points)
    if kind in ("plane", "above"):
        return
    rotation = None if warp.rotation is None else warp.rotation[[1]]
    row = made_like(warp, warp.source[[1]], warp.target[[1]], rotation, warp.options, [1])
    assert isinstance(row, type(warp))
    for one, other in zip(results(row, images[1:], points[1:]), expected, strict=True):
        torch.testing.assert_close(one, other[1:], rtol=1e-9, atol=1e-9)


def test_how_often_an_image_is_halved_follows_the_cameras():
    p, images = {name: torch.tensor(NUMBERS[name]) for name in CAMERAS}, smooth(dtype=torch.float32)
    warp = turned(HalvingWarp, p, antialias=None).requires_grad_(False)
    whole = warp(images)
    warp.target.intrinsics.data[:2] /= 4
    assert not torch.equal(warp(images), whole)
    assert torch.equal(warp(images), warp.detach()(images))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.bool, torch.uint16, torch.float16, torch.float32])
@pytest.mark.parametrize("kind", KINDS)
def test_images_keep_their_dtype_and_integers_have_no_graph(kind, dtype):
    learning = KINDS[kind][0](numbers(kind)).requires_grad_(True)
    images = (200 * smooth()).abs().to(dtype)
    result, exact = made(learning, images) if kind != "depth" else learning(images, DEPTH)[0], None
    assert (result.dtype, result.requires_grad) == (dtype, dtype.is_floating_point)
    exact = made(still(kind), images.double()) if kind != "depth" else still(kind)(images.double(), DEPTH)[0]
    exact = (exact >= 0.5).double() if dtype == torch.bool else exact
    bound = {torch.bool: 0, torch.float16: 0.2, torch.float32: 0.02}.get(dtype, 0.51)
    assert (result.double() - exact).abs().max() <= bound
