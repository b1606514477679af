"""Images whose channels come last in memory, as NumPy, OpenCV and Pillow have them: read and written where they lie."""

import warnings
from functools import cache, partial

import numpy as np
import PIL.Image
import pytest
import torch
from cameras import fisheye, needs_library
from torch.profiler import ProfilerActivity, profile

import camtorch as ct
import camtorch.augment.numpy

SIZE = (50, 70)
camera = partial(fisheye, size=SIZE, focal=0.7)


def colours(channels=3, dtype=np.uint8, size=SIZE):
    return np.random.default_rng(0).integers(0, 250, (*size, channels)).astype(dtype)


def _read_only(array):
    array = array.copy()
    array.flags.writeable = False
    return array


def _field(dtype):
    """Of a structured array, whose strides are no whole numbers of elements if those have several bytes."""
    pixels = np.zeros((*SIZE, 3), np.dtype([("flag", np.uint8), ("value", dtype)]))
    pixels["value"] = colours()
    return pixels["value"]


ARRAYS = {
    "plain": lambda: colours(),
    "a crop": lambda: colours(size=(60, 90))[4:54, 7:77],
    "RGB of RGBA": lambda: colours(4)[..., :3],
    "every second pixel": lambda: colours(size=(100, 140))[::2, ::2],
    "one channel": lambda: colours()[..., 1],
    "planes": lambda: np.moveaxis(np.ascontiguousarray(np.moveaxis(colours(), -1, 0)), 0, -1),
    "read-only": lambda: _read_only(colours()),
    "of a file": lambda: np.frombuffer(colours().tobytes(), np.uint8).reshape(*SIZE, 3),
    "repeated": lambda: np.broadcast_to(colours(1), (*SIZE, 3)),
    "uint16": lambda: colours(dtype=np.uint16),
    "float32": lambda: colours(dtype=np.float32),
    "bool": lambda: colours(dtype=bool),
    # which are copied
    "BGR": lambda: colours()[..., ::-1],
    "mirrored": lambda: colours()[:, ::-1],
    "upside down": lambda: colours()[::-1],
    "turned round, of 16 bits": lambda: colours(dtype=np.uint16)[::-1, ::-1, ::-1],
    "turned round, read-only": lambda: _read_only(colours())[::-1, ::-1],
    "of another byte order": lambda: colours(dtype=">u2"),
    "long doubles": lambda: colours(dtype=np.longdouble),
    "between other fields": lambda: _field(np.uint8),
    "between numbers": lambda: _field(np.float32),
    "one row": lambda: colours(size=(1, 48))[:, ::-1],  # numpy calls them contiguous
    "one column": lambda: colours(size=(48, 1))[::-1],
}


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("p", [0.0, 1.0])
def test_arrays_of_any_strides_come_out_dense_and_alone(name, p):
    array = ARRAYS[name]()
    before, dense = array.copy(), np.array(array, array.dtype.newbyteorder("="), order="C")
    mount = ct.augment.RandomMount(camera=camera(size=array.shape[:2]), min_filled=0, p=p)
    move, results = ct.augment.numpy.Transform(mount), []
    draw = mount.draw(1, torch.Generator().manual_seed(1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for image in (array, dense):
            mask = image if image.ndim == 2 else image[..., 0]
            fields = {"images": [image, image]} | ({"mask": mask} if image.dtype.itemsize <= 8 else {})
            out = move({"image": image, **fields}, draw=draw)
            results.append([out["image"], *out["images"], *([out["mask"]] if "mask" in out else [])])
    for one, other in zip(*results, strict=True):
        assert one.dtype == array.dtype
        assert one.flags.c_contiguous
        assert one.flags.writeable
        assert not np.may_share_memory(one, array)
        # planes are added up in another order; of uint8 a last bit decides about what is rounded
        atol = 1e-4 if array.dtype.kind == "f" else array.dtype.kind == "u"
        difference = np.abs(one.astype(np.float64) - other.astype(np.float64))
        assert difference.max() <= atol
        assert (difference > 1e-4).mean() < 0.01
    np.testing.assert_array_equal(array, before)
    if p == 0:
        np.testing.assert_array_equal(results[0][0], array)


def allocated(call, count):
    """What `call` gives, and the operators in it that took memory of so many bytes or more."""
    call()
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as seen:
        result = call()
    return result, [event.name for event in seen.events() if event.self_cpu_memory_usage >= count]


LARGE = (360, 480)


@needs_library
@pytest.mark.slow  # for the profiler
@pytest.mark.parametrize("read_only", [False, True])
def test_nothing_as_large_as_an_image_is_made_but_the_result(read_only):
    array = colours(size=(400, 500))[4:364, 7:487]
    array.flags.writeable = not read_only
    move = ct.augment.numpy.Transform(ct.augment.RandomMount(camera=camera(size=LARGE)))
    out, large = allocated(lambda: move(image=array), array.nbytes)
    assert large in ([], ["aten::empty"])  # none where the memory of results is kept
    assert out["image"].shape == array.shape


LAYOUTS = {
    "dense": lambda c: torch.from_numpy(colours(c))[None],
    "a crop": lambda c: torch.from_numpy(colours(c, size=(60, 90)))[None, 4:54, 7:77],
    "more channels": lambda c: torch.from_numpy(colours(c + 1))[None, ..., :c],
    "every second pixel": lambda c: torch.from_numpy(colours(c, size=(100, 140)))[None, ::2, ::2],
    "a batch": lambda c: torch.from_numpy(np.stack([colours(c), colours(c)])),
}


@cache
def dewarp(mode, tolerance):
    return ct.Dewarp(camera(), mode=mode, tolerance=tolerance)


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("name", LAYOUTS)
def test_channels_last_give_channels_last(name, index):
    mode = ("bilinear", "bilinear", "bicubic", "nearest")[index]
    dtype = (torch.uint8, torch.float32, torch.float16, torch.uint8)[index]
    images = LAYOUTS[name]((1, 3, 4, 5)[(index + len(name)) % 4]).to(dtype).permute(0, 3, 1, 2)
    planes = images.contiguous()
    for tolerance in (0.0, 0.01):
        moved, expected = dewarp(mode, tolerance)(images), dewarp(mode, tolerance)(planes)
        assert moved.is_contiguous(memory_format=torch.channels_last)
        assert expected.is_contiguous()
        difference = (moved.double() - expected.double()).abs()
        # of floats the last bits, of whole numbers what those decide
        atol = 250 * 8 * torch.finfo(dtype).eps if dtype.is_floating_point else 1.0
        assert float(difference.max()) <= atol
        assert float((difference > 0.5).double().mean()) < 0.01


def test_the_rule_holds_with_gradients_and_options():
    images = torch.from_numpy(colours(dtype=np.float32))[None].permute(0, 3, 1, 2).requires_grad_()
    for warp in (ct.Dewarp(camera()), ct.Dewarp(camera().requires_grad_()), ct.Dewarp(camera(), antialias=True)):
        moved = warp(images)
        assert moved.is_contiguous(memory_format=torch.channels_last)
        (gradient,) = torch.autograd.grad(moved.sum(), images)
        assert bool(torch.isfinite(gradient).all())
    for option in ({"fill": (1.0, 2.0, 3.0)}, {"padding_mode": "border"}, {"padding_mode": "reflection"}):
        assert ct.Dewarp(camera())(images, **option).is_contiguous(memory_format=torch.channels_last)


PAIR = ct.rectify(camera(), camera(), ct.Extrinsics([0.0, 0.02, 0.0], [-0.1, 0.0, 0.0])).requires_grad_(False)
FLOOR = ct.Extrinsics([1.2, 0.0, 0.0], [0.0, 1.0, 0.0]).requires_grad_(False)
TURNS = ct.augment.mount_rotation(*torch.tensor([[0.0, 30], [9, 0], [0, 20]]))
ROUND = ct.Equirectangular([70 / 2 / np.pi] * 2 + [34.5, 24.5], image_size=SIZE).requires_grad_(False)
WARPS = {
    "dewarp": lambda: ct.Dewarp(camera()),
    "learning": lambda: ct.Dewarp(camera().requires_grad_()),
    "nearest": lambda: ct.Warp(camera(), camera(), TURNS[1], mode="nearest"),
    "kept": lambda: ct.Warp(camera(), camera(), TURNS[1], padding_mode="border", antialias=True).pin(),
    "a panorama": lambda: ct.Warp(ROUND, camera(size=(30, 40)), TURNS[1]),
    "a plane": lambda: ct.PlaneWarp(camera(), camera(size=(30, 40)), FLOOR, (0.0, 0.0, 1.0), 2.0),
    "from above": lambda: ct.BirdsEye(camera(), FLOOR, x=(-2, 2), y=(0, 4), resolution=0.1),
    "a shutter": lambda: ct.ShutterWarp(camera(), camera(), shutter=ct.RollingShutter(0.02, [0.0, 2.0, 1.0])),
    "a box": lambda: ct.views.look_at(camera(), [10.0, 10, 40, 40], (24, 32)),
    "a mirror": lambda: ct.augment.HorizontalFlip().change(camera(), {"apply": torch.ones(1)}).parts[0].warp,
    "a map": lambda: ct.LookupMap(torch.rand(30, 40, 2, dtype=torch.float64) * 60, SIZE, "test", {}),
    "a pair": lambda: lambda images: PAIR(images, images)[1],
    "two cameras": lambda: ct.Warp(camera(), camera(size=(30, 40)), TURNS),
}
LAST = lambda images: images.movedim(-3, -1).numpy()  # noqa: E731
HELD = {  # what users hold of images (2, C, H, W), the same of a warp's result
    "single": (lambda images: images[0], lambda images: images[0]),
    "clips": (lambda images: images[:, None].expand(2, 3, -1, -1, -1), None),
    "clips of clips": (lambda images: images[:, None, None].expand(2, 1, 2, -1, -1, -1), None),
    "an array": (lambda images: LAST(images[0]), None),
    "arrays": (LAST, LAST),
    "grey": (lambda images: images[0, 0].numpy(), None),
    "upside down": (lambda images: _read_only(LAST(images.flip(-2))[0])[::-1], lambda images: LAST(images[0])),
    "Pillow": (lambda images: PIL.Image.fromarray(LAST(images[0, :3].byte())), None),
    "grey Pillow": (lambda images: PIL.Image.fromarray(images[0, 0].numpy()), None),
}


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32])
@pytest.mark.parametrize("name", WARPS)
def test_the_kind_of_an_image_comes_back(name, dtype):
    images, warp = torch.from_numpy(np.stack([colours(), colours()[::-1]])).movedim(-1, -3).to(dtype), WARPS[name]()
    expected, several = warp(images).detach(), name == "two cameras"
    for held, (give, back) in HELD.items():
        given = give(images)
        if held == "Pillow" and dtype != torch.uint8:
            continue
        if several and held in ("single", "Pillow", "grey Pillow"):
            with pytest.raises(ValueError, match=r"(2 cameras.* image\[None\]|2 images come out)"):
                warp(given)
            continue
        made, wanted = warp(given), (back or give)(expected)
        if several and given.ndim < 4:  # each of the cameras sees it
            seen = warp(images[:1])
            wanted = seen[:, 0].numpy() if held == "grey" else LAST(seen)
        made = made.detach() if type(made) is torch.Tensor else made
        assert type(made) is type(given), held
        assert "Pillow" not in held or made.mode == given.mode, held
        assert np.asarray(made).dtype == np.asarray(given).dtype, held
        within = 1e-3 if dtype == torch.float32 else 0
        np.testing.assert_allclose(np.asarray(made), np.asarray(wanted), rtol=0, atol=within, err_msg=held)
