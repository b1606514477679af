"""Laws of the native sampler: what torch samples, it samples too, wherever images lie and whoever calls."""

import math
import os
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager
from itertools import product

import pytest
import torch
from cameras import default_dtype_of_double, needs_library

import camtorch as ct
from camtorch.native import build as building
from camtorch.native import sampler
from camtorch.native.library import _find, library
from camtorch.native.structs import OUTSIDE
from camtorch.values.dtypes import widen
from camtorch.warp import grid_sample, sampling
from camtorch.warp.lattice import Lattice, PixelPositions
from camtorch.warp.options import MODES, PADDINGS, Sampler

FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
INTEGERS = (torch.bool, torch.uint8, torch.int8, torch.uint16, torch.int16, torch.int32, torch.int64)

pytestmark = needs_library


@contextmanager
def torch_alone():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grid_sample, "native_available", lambda: False)
        yield


@contextmanager
def counted():
    """How often the native sampler was called."""
    calls = []
    with pytest.MonkeyPatch.context() as patch:
        original = sampler.NativeJob.__call__
        patch.setattr(sampler.NativeJob, "__call__", lambda *a, **k: calls.append(1) or original(*a, **k))
        yield calls


def generator(seed):
    return torch.Generator().manual_seed(seed)


def pixels(dtype, shape, seed=0):
    """Noise over the whole range of a dtype, or of what float64 holds of it; floats from -1 to 1."""
    if dtype.is_floating_point:
        return (2 * torch.rand(shape, generator=generator(seed), dtype=torch.float64) - 1).to(dtype)
    if dtype == torch.bool:
        return torch.rand(shape, generator=generator(seed)) < 0.5
    info = torch.iinfo(dtype)
    low, high = max(info.min, -(2**52)), min(info.max, 2**52)
    return torch.randint(low, high + 1, shape, generator=generator(seed)).to(dtype)


def extent(dtype):
    """From the least to the largest pixel of `pixels`."""
    if dtype.is_floating_point or dtype == torch.bool:
        return 2.0 if dtype.is_floating_point else 1.0
    info = torch.iinfo(dtype)
    return float(min(info.max, 2**52)) - float(max(info.min, -(2**52)))


def spots(count, size, source, seed=0):
    """(count, *size, 2): positions of which most are on the image, some beyond its rim and a few far off."""
    grid = 2.4 * torch.rand(count, *size, 2, generator=generator(seed)) - 1.2
    sides = torch.tensor(source[::-1], dtype=torch.float32)
    places = grid.flatten(0, 2)
    # exactly on pixels, between two of them, on the first and last ones, and just beyond
    whole = torch.randint(-2, max(source) + 2, places.shape, generator=generator(seed + 1)) / 2
    special = (2 * whole + 1) / sides - 1
    pick = torch.rand(len(places), generator=generator(seed + 2))
    places[pick < 0.15] = special[pick < 0.15]
    places[pick > 0.98] = torch.tensor([-100.0, 100.0])
    places[(pick > 0.96) & (pick < 0.97)] = -9.0
    return grid


def between(grid, source):
    """(B, h, w): positions next to half-way between two pixels, where a rounding decides which is the nearest."""
    pixel = ((grid.double() + 1) * torch.tensor(source[::-1]) - 1) / 2
    return ((pixel - pixel.floor() - 0.5).abs() < 1e-4 * (1 + pixel.abs())).any(-1)


def compare(result, expected, mode, unsure, span):
    assert (result.dtype, result.shape) == (expected.dtype, expected.shape)
    if not result.numel():
        return
    unsure = unsure.unsqueeze(1).expand_as(result)
    if mode == "nearest":
        same = result == expected
        assert same[~unsure].all()
    elif result.dtype == torch.bool:
        # of two samples next to one half either may be true
        assert (result != expected)[~unsure].count_nonzero() <= 0.01 * result.numel() + 2
    elif result.dtype.is_floating_point:
        # positions of 160 px in float32 are some 1e-5 px off, in the sampler and in torch, on each kind of CPU others
        lost = 2e-5 * span + torch.finfo(result.dtype).eps * (result.dtype.itemsize < 4) * span
        assert (result.double() - expected.double()).abs().max() <= lost
    else:
        # float32 and float64 hold no larger whole numbers side by side
        rounding = 1 if result.dtype.itemsize < 4 else span * 2e-7
        off = (result.double() - expected.double()).abs()
        assert off.max() <= rounding
        if result.dtype.itemsize == 1:
            assert off[~unsure].count_nonzero() <= 0.01 * off.numel() + 2


def both(images, where, mode, padding, fill=(0.0,), span=None):
    """What the native sampler makes, which is what torch makes."""
    with counted() as calls:
        result = sampling.render(images, where, Sampler(mode, padding, fill))
    # what is computed in float32 is sampled so too, if nothing is to be filled in afterwards
    wide = padding == "zeros" and widen(images[:0]).dtype == torch.float32
    assert bool(calls) == (sampler.takes(images.dtype, mode) or wide)
    with torch_alone(), counted() as calls:
        expected = sampling.render(images, where, Sampler(mode, padding, fill))
    assert not calls
    compare(result, expected, mode, between(where.pixels.grid, images.shape[-2:]), span or extent(images.dtype))
    return result


def hwc(images):
    return images.contiguous(memory_format=torch.channels_last)


def cropped(images):
    larger = images.new_zeros(*images.shape[:-2], images.shape[-2] + 5, images.shape[-1] + 11)
    here = larger[..., 2:-3, 7:-4]
    return here.copy_(images)


LAYOUTS = {
    "contiguous": lambda images: images.contiguous(),
    "channels last": hwc,
    "cropped": cropped,
    "cropped, channels last": lambda images: hwc(torch.cat((images, images), -1))[..., : images.shape[-1]],
    "of an array": lambda images: torch.stack(list(images.movedim(1, -1))).movedim(-1, 1),
    "transposed": lambda images: images.mT.contiguous().mT,
    "every other pixel": lambda images: images.repeat_interleave(2, -1)[..., ::2],
    "every other channel": lambda images: images.repeat_interleave(2, 1)[:, ::2],
    "every other channel, channels last": lambda images: hwc(images.repeat_interleave(2, 1))[:, ::2],
    "images last": lambda images: images.movedim(0, -1).contiguous().movedim(-1, 0),
    "one column for all": lambda images: images[..., :1].expand(images.shape),
    "one row for all": lambda images: images[..., :1, :].expand(images.shape),
    "one row for all, channels last": lambda images: hwc(images)[..., :1, :].expand(images.shape),
    "one channel for all": lambda images: images[:, :1].expand(images.shape),
}


def fills(dtype, channels):
    if dtype == torch.bool:
        return (0.0,), (1.0,), (0.4,)
    # no further: what `1 - covered` is rounded by grows with it
    outside = 1.5 * torch.iinfo(dtype).max if not dtype.is_floating_point and dtype.itemsize < 4 else 3.0
    return (0.0,), (1.0,), (outside,), tuple(float(c) - 1.5 for c in range(channels))


@pytest.mark.usefixtures("each_variant")
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dtype", INTEGERS + FLOATS)
def test_every_image_is_sampled_as_torch_does(dtype, mode, padding):
    count, source, target = 2, (23, 37), (13, 30)
    where = PixelPositions(spots(count, target, source), torch.rand(count, *target, generator=generator(9)) < 0.9, None)
    if padding == "zeros":
        where.grid[~where.mapped] = OUTSIDE
    for i, (name, layout) in enumerate(LAYOUTS.items()):
        channels = (1, 3, 4, 2, 5, 7)[i % 6] if "last" not in name else (3, 4)[i % 2]
        images = pixels(dtype, (count, channels, *source), i)
        values = fills(dtype, channels)
        fill = values[i % len(values)]
        span = extent(dtype)
        if dtype.is_floating_point:
            # fills have a part in the range, and half precision has an end
            fill = tuple(max(min(value, 1.0), -1.0) for value in fill)
        given = layout(images)
        result = both(given, where, mode, padding, fill, span)
        if given.stride(1) == 1 and given.stride(3) == channels > 1:
            assert result.is_contiguous(memory_format=torch.channels_last) or not sampler.takes(dtype, mode)


SIZES = [(1, 1), (1, 2), (2, 1), (2, 2), (1, 9), (9, 1), (3, 2), (5, 7), (8, 8), (31, 33)]


@pytest.mark.usefixtures("each_variant")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_every_size_is_sampled_as_torch_does(dtype, mode):
    for i, source in enumerate(SIZES):
        for j, target in enumerate(SIZES):
            padding, channels = PADDINGS[(i + j) % 3], (1, 3, 4)[(i + j // 3) % 3]
            where = PixelPositions(spots(1, target, source, i), torch.ones(1, *target, dtype=torch.bool), None)
            images = pixels(dtype, (2, channels, *source), j)
            both(hwc(images) if j % 2 else images, where, mode, padding)


def gentle(count, size, source, zoom=1.0, turn=0.1):
    """(count, *size, 2): neighbours that lie next to each other, as those of cameras do."""
    v, u = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) - side / 2 for side in size), indexing="ij")
    turns = turn * (1 + torch.arange(count, dtype=torch.float64))[:, None, None]
    at = torch.stack((u * turns.cos() - v * turns.sin(), u * turns.sin() + v * turns.cos()), -1)
    return (zoom * at * 2 / torch.tensor(source[::-1])).float()


@pytest.mark.usefixtures("each_variant")
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_rows_that_read_rows_are_sampled_as_torch_does(dtype, mode, padding):
    """What is read of neighbouring pixels at once is theirs, at every zoom and turn."""
    cases = product(((48, 64), (60, 43), (5, 95)), (0.3217, 1.0, 2.5), (0.0, 0.02, 1.6))
    for i, (source, zoom, turn) in enumerate(cases):
        target = (50, (64, 71, 95)[i % 3])
        grid = gentle(2, target, source, zoom, turn)
        if turn == 0.0:  # the rim, and pixels themselves
            grid = grid - grid[:, :1, :1] - (1 - 1 / torch.tensor(source[::-1], dtype=torch.float32))
        where = PixelPositions(grid, torch.ones(2, *target, dtype=torch.bool), None)
        images = pixels(dtype, (2, (1, 3, 4)[i // 2 % 3], *source), i)
        both(hwc(images) if i % 2 else images, where, mode, padding, (1.0,))


@pytest.mark.usefixtures("each_variant")
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_every_layout_of_a_grid(dtype):
    source, target = (23, 37), (13, 30)
    base = spots(3, target, source)
    mapped = torch.ones(3, *target, dtype=torch.bool)
    images = pixels(dtype, (3, 3, *source))
    expected = both(images, PixelPositions(base, mapped, None), "bilinear", "zeros")
    layouts = {
        "planes": base.movedim(-1, 0).contiguous().movedim(0, -1),
        "cropped": torch.nn.functional.pad(base, (0, 3, 2, 9, 1, 1))[:, 1:-1, 2:-9, :2],
        "columns": base.transpose(1, 2).contiguous().transpose(1, 2),
        "images last": base.movedim(0, -1).contiguous().movedim(-1, 0),
        "float64": base.double(),
        "float64 planes": base.double().movedim(-1, 0).contiguous().movedim(0, -1),
    }
    for grid in layouts.values():
        assert torch.equal(both(images, PixelPositions(grid, mapped, None), "bilinear", "zeros"), expected)
    for grid in [base[:1], *(part.expand(base.shape) for part in (base[:1], base[:, :1], base[:, :, :1]))]:
        both(images, PixelPositions(grid, mapped[: len(grid)], None), "bilinear", "reflection")
    one = both(images[:1], PixelPositions(base, mapped, None), "bilinear", "border")
    assert torch.equal(one[1], both(images[:1], PixelPositions(base[1:2], mapped[:1], None), "bilinear", "border")[0])


@pytest.mark.usefixtures("each_variant")
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_positions_that_are_far_or_no_numbers(dtype, mode, padding):
    source, size = (23, 37), (4, 40)
    images = pixels(dtype, (1, 3, *source))
    for strange in (math.nan, math.inf, -math.inf, 1e30, -1e30, 3.4e38, 2.0**31, -(2.0**63), 1e-45):
        for both_axes in (False, True):
            grid = torch.zeros(1, *size, 2)
            grid[..., ::3, 0] = strange
            if both_axes:
                grid[..., 1] = strange
            where = PixelPositions(grid, torch.ones(1, *size, dtype=torch.bool), None)
            result = sampling.render(images, where, Sampler(mode, padding, (1.0,)))
            assert result.shape == (1, 3, *size)
            assert result.isfinite().all()
            if math.isnan(strange) or (padding == "zeros" and abs(strange) > 2):
                assert (result[..., ::3] == 1).all()
            if padding == "border" and abs(strange) > 2 and not both_axes:
                # half-way between two rows
                assert (result[..., ::3] == result[..., :1, :1]).all()
                edge = images[:, :, 11, 36 if strange > 1 else 0].double()
                assert ((result[:, :, 0, 0].double() - edge).abs() <= 1e-6 * extent(dtype)).all()


@pytest.mark.usefixtures("each_variant")
@pytest.mark.parametrize("source", [(3, 20000), (20000, 3), (1, 20000)])
def test_wide_images(source):
    """Twenty thousand pixels along a side, where float32 holds a thousandth of one."""
    v, u = (torch.linspace(-1.001, 1.001, n) for n in ((11, 5000) if source[1] > source[0] else (5000, 11)))
    grid = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)[None]
    where = PixelPositions(grid, torch.ones(grid.shape[:3], dtype=torch.bool), None)
    smooth = (torch.arange(math.prod(source)).view(1, 1, *source) / 400).sin().expand(1, 3, -1, -1)
    both(smooth.contiguous(), where, "bilinear", "zeros")
    both((100 + 100 * smooth).to(torch.uint8), where, "bilinear", "border")
    both((100 + 100 * smooth).to(torch.uint8), where, "nearest", "reflection")


def runs_here():
    """The variants that this CPU runs, the best one last."""
    names = list(building.VARIANTS)
    return names[: names.index(library().camtorch_variant().decode()) + 1]


def test_the_environment_forces_a_variant(each_variant, monkeypatch):
    library().camtorch_use(b"baseline")
    monkeypatch.setenv("CAMTORCH_CPU", each_variant.upper())
    assert _find.__wrapped__()[1] == each_variant
    monkeypatch.setenv("CAMTORCH_CPU", "avx3")
    with pytest.raises(ValueError, match=r"CAMTORCH_CPU must be one of baseline.* on this CPU; got 'avx3'"):
        _find.__wrapped__()


@pytest.mark.slow
def test_no_read_outside_and_nothing_undefined_in_any_variant(fuzzed):
    variants = {name: building.VARIANTS[name] for name in runs_here()}
    # the way without vectors is what the others are compared with
    all_ways = {"plain": ("-DCAMTORCH_PLAIN",)} | variants
    assert fuzzed("sampler_fuzz.c", ["sampler.c", "lattice.c"], all_ways, 4000, 250) == [*variants]


def kept(warp):
    return warp.positions("kept")


@pytest.mark.usefixtures("each_variant")
def test_lattices_of_a_batch_of_cameras_and_images():
    rotations = ct.augment.mount_rotation(torch.tensor([0.0, 10.0, 40.0]), torch.tensor(0.0), torch.tensor(5.0))
    source = ct.KannalaBrandt([100.0, 100, 80, 60], [0.02, -0.01, 0.004, -0.001], image_size=(120, 160))
    target = ct.Pinhole([80.0, 80, 80, 60], image_size=(101, 163))
    source, target = (camera.requires_grad_(False) for camera in (source, target))
    for dtype, mode, padding in product((torch.uint8, torch.float32), MODES, PADDINGS):
        images = pixels(dtype, (3, 3, 120, 160))
        batch = ct.Warp(source, target, rotations, tolerance=0.01, mode=mode, padding_mode=padding, fill=1)
        assert isinstance(kept(batch), Lattice)
        result = batch(images)
        assert torch.equal(batch(images[:1])[0], result[0])
        for i in range(3):
            alone = ct.Warp(source, target, rotations[i], tolerance=0.01, mode=mode, padding_mode=padding, fill=1)
            assert torch.equal(alone(images)[i], result[i])
            off = (alone(hwc(images))[i].double() - result[i].double()).abs().max()
            assert off <= (0 if mode == "nearest" else 1e-4 if dtype == torch.float32 else 1)
        both(hwc(images), kept(batch), "nearest", padding, (1.0,))


def warp_of(tolerance, scale=1):
    source = ct.KannalaBrandt([100.0, 100, 80, 60], [0.02, -0.01, 0.004, -0.001], image_size=(120, 160))
    target = ct.Pinhole([80.0, 80, 80, 60], image_size=(120, 160))
    source, target = (c.requires_grad_(False).resize(120 * scale, 160 * scale) for c in (source, target))
    return ct.Warp(source, target, tolerance=tolerance)


def warps():
    return [warp_of(tolerance) for tolerance in (0.0, 0.01)]


def images_of_floats():
    return torch.rand(2, 3, 120, 160, generator=generator(0))


class Wrapped(torch.Tensor):
    @staticmethod
    def __new__(cls, inner):
        return torch.Tensor._make_wrapper_subclass(cls, inner.shape, dtype=inner.dtype, strides=inner.stride())

    def __init__(self, inner):
        self.inner = inner

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        def bare(value):
            return value.inner if isinstance(value, cls) else value

        return function(*torch.utils._pytree.tree_map(bare, args), **torch.utils._pytree.tree_map(bare, kwargs or {}))


def negated(images):
    view = torch.complex(images, -images).conj().imag
    assert view.is_neg()
    return view


STRANGE = {
    "a subclass": lambda images: images.as_subclass(type("Image", (torch.Tensor,), {})),
    "a parameter": lambda images: torch.nn.Parameter(images, requires_grad=False),
    "wanting a gradient": lambda images: images.requires_grad_(),
    "to be negated": negated,
    "elsewhere": Wrapped,
    "of inference": lambda images: torch.inference_mode()(images.clone)(),
}


def test_a_mode_of_torch_alone_is_no_job(monkeypatch):
    monkeypatch.setitem(sampler.MODES, "lanczos", sampler.ModeOfSampling(-1, 0, 3))
    images = torch.zeros(1, 3, 8, 8)
    assert not sampler.takes(images.dtype, "lanczos")
    with pytest.raises(ValueError, match="mode must be one of nearest, bilinear, bicubic; got 'lanczos'"):
        sampler.NativeJob(images, (8, 8), "lanczos", "zeros", (0.0,) * 3, grid=torch.zeros(1, 8, 8, 2))


@pytest.mark.parametrize("kind", STRANGE)
@pytest.mark.parametrize("mode", MODES)
def test_strange_tensors_are_images(kind, mode):
    for warp in warps():
        expected = warp(images_of_floats(), mode=mode)
        for again in range(2):
            fresh = warp if again else ct.Warp(warp.source, warp.target, tolerance=warp.tolerance)
            with torch.no_grad():
                result = fresh(STRANGE[kind](images_of_floats()), mode=mode)
            torch.testing.assert_close(result.detach().as_subclass(torch.Tensor), expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize(("dtype", "mode"), [("uint8", "bilinear"), ("float32", "bicubic"), ("float16", "nearest")])
def test_another_default_device_or_dtype_changes_nothing(dtype, mode):
    dtype = getattr(torch, dtype)
    images = pixels(dtype, (2, 3, 120, 160))
    for warp, layout in product(warps(), ("contiguous", "channels last", "every other channel")):
        images = LAYOUTS[layout](images)
        expected = warp(images, mode=mode)

        def fresh(warp=warp):
            return ct.Warp(warp.source, warp.target, tolerance=warp.tolerance, mode=mode)

        for context in (torch.device("meta"), torch.autocast("cpu", dtype=torch.bfloat16), default_dtype_of_double()):
            with context:
                assert torch.equal(fresh()(images), expected)
                assert torch.equal(warp(images, mode=mode), expected)


@pytest.mark.parametrize("warp", warps())
def test_transforms_and_derivatives_take_their_own_way(warp):
    images = images_of_floats()
    expected = warp(images)
    mapped = torch.func.vmap(lambda image: warp(image[None])[0])(images)
    value, tangent = torch.func.jvp(warp, (images,), (images,))
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.unpack_dual(warp(torch.autograd.forward_ad.make_dual(images, images)))
    for result in (mapped, value, tangent, dual.primal, dual.tangent):
        torch.testing.assert_close(result, expected, atol=0.02, rtol=0)
    gradient = torch.func.grad(lambda one: warp(one).sum())(images)
    learning = images.clone().requires_grad_()
    warp(learning).sum().backward()
    torch.testing.assert_close(gradient, learning.grad)


@pytest.mark.parametrize("fill", [2**70, -(2**70), 2**63, 1e300])
def test_fills_of_any_size(fill):
    for warp in warps():
        for dtype in (torch.uint8, torch.int64, torch.float32, torch.float16, torch.bool):
            for mode in ("nearest", "bilinear")[: 1 if dtype == torch.int64 else 2]:
                assert warp(torch.zeros(1, 1, 120, 160, dtype=dtype), fill=fill, mode=mode).dtype == dtype


@contextmanager
def threads(count):
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def samples(count=2, seed=0):
    return pixels(torch.uint8, (count, 3, 480, 640), seed)


def test_many_threads_warp_at_once():
    warp, wrong = warp_of(0.01, 4), []
    given_images = [samples(2, seed) for seed in range(4)]
    expected = [warp(images) for images in given_images]

    def run(i):
        for k in range(10):
            n = (i + k) % 4
            if k % 3 == 0:
                torch.set_num_threads(1 + n)
            if not torch.equal(warp(given_images[n]), expected[n]):
                wrong.append((i, k))

    with threads(3):
        callers = [threading.Thread(target=run, args=(i,)) for i in range(6)]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join()
    assert not wrong


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # which may leave a child without its threads
def test_forks_while_others_warp():
    warp, images = warp_of(0.01, 4), samples()
    expected, ended = warp(images).numpy(), threading.Event()

    def run():
        while not ended.is_set():
            warp(images)

    with threads(2):
        others = [threading.Thread(target=run) for _ in range(2)]
        for other in others:
            other.start()
        children = []
        try:
            for _ in range(5):
                child = os.fork()
                if child == 0:
                    signal.alarm(60)
                    # by NumPy: torch's own threads are not there after a fork, and it would wait for them
                    good = all((warp(images).numpy() == expected).all() for _ in range(3))
                    os._exit(0 if good else 1)
                children.append(child)
        finally:
            ended.set()
            for other in others:
                other.join()
        assert [os.waitpid(child, 0)[1] for child in children] == [0] * 5
        assert (warp(images).numpy() == expected).all()


PEAK = """
import itertools
import torch
import camtorch as ct
from camtorch.native import memory

def told(key):
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(key)) * 1024

torch.set_num_threads(1)
cases = [("kept", 8, (720, 1280), *rest) for rest in itertools.product((torch.uint8, torch.float32), (0.01, 0.0))]
cases += [(kind, 1, (3000, 4000), torch.uint8, 0.01) for kind in ("fresh", "strips")]
for layout, case in itertools.product((torch.contiguous_format, torch.channels_last), cases):
    kind, count, size, dtype, tolerance = case
    intrinsics = [size[1] / 3, size[1] / 3, size[1] / 2, size[0] / 2]
    source = ct.KannalaBrandt(intrinsics, [0.02, -0.01, 0.004, -0.001], image_size=size).requires_grad_(False)
    warp = ct.Warp(source, ct.Pinhole(intrinsics, image_size=size).requires_grad_(False), tolerance=tolerance)
    images = torch.ones(count, 3, *size, dtype=dtype).contiguous(memory_format=layout)
    if kind == "kept":
        warp(images[:1])
    memory._idle.clear()
    before = told("VmRSS")
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    result = warp(images) if kind != "strips" else sum(1 for _ in warp.strips(images, rows=64))
    print(layout, case, (told("VmHWM") - before) / images.nbytes)
    del result, images
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/clear_refs"), reason="the system does not tell how much was used")
@pytest.mark.slow
def test_the_peak_of_memory_is_the_result():
    # what is given back is not to count as room for what comes
    here = os.environ | {"MALLOC_TRIM_THRESHOLD_": "0", "MALLOC_MMAP_THRESHOLD_": "65536"}
    done = subprocess.run([sys.executable, "-c", PEAK], capture_output=True, text=True, env=here, check=True)
    parts = {line.rpartition(" ")[0]: float(line.split()[-1]) for line in done.stdout.splitlines()}
    assert len(parts) == 12
    for what, part in parts.items():  # of strips a few
        assert 0.2 < part < 0.8 if "strips" in what else 0.9 < part <= 1.1, done.stdout
