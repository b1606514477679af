"""What the sampler gives is the same on every CPU: each variant that this one can run, beside torch."""

import ctypes
import os
import shutil

import pytest
import torch

import camtorch as ct
from camtorch.native import sampler
from camtorch.native.build import VARIANTS, build
from camtorch.warp import sampling

LAYOUTS = (torch.contiguous_format, torch.channels_last)
SIZE = (75, 101)  # no multiple of any vector

# the last place of half; in float32 what positions of 100 pixels have, and on lattices sums of some such
MOST = {(torch.float16, 0): 1e-3, (torch.float16, 0.01): 1e-3, (torch.float32, 0): 1e-5, (torch.float32, 0.01): 5e-5}

COMPILER = any(map(shutil.which, (os.environ.get("CC", "cc"), "gcc", "clang")))
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not COMPILER, reason="no C compiler is here")]


def load(name, folder):
    loaded = ctypes.CDLL(str(build(folder, variants=["baseline", name])))
    loaded.camtorch_variant.restype = ctypes.c_char_p
    return loaded


@pytest.fixture(scope="module")
def baseline(tmp_path_factory):
    """The library that every CPU of this kind can run."""
    return load("baseline", tmp_path_factory.mktemp("baseline"))


@pytest.fixture(scope="module", params=list(VARIANTS))
def variant(request, baseline, tmp_path_factory):
    """A library of one kind of CPU."""
    name = request.param
    loaded = baseline if name == "baseline" else load(name, tmp_path_factory.mktemp(name))
    if loaded.camtorch_variant().decode() != name:
        pytest.skip(f"this CPU, or the compiler, knows no {name}")
    return loaded


def images(dtype):
    noise = torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(0))
    return noise.to(dtype) if dtype.is_floating_point else (noise * 250).to(dtype)


def sampled(monkeypatch, library, batch, tolerance, **options):
    """By a library, or by torch alone: of one camera, and of one for each image, the edge of a lens in view."""
    monkeypatch.setattr(sampling, "native_available", lambda: library is not None)
    monkeypatch.setattr(sampler, "library", lambda: library)
    source = ct.KannalaBrandt([50.0, 50, 50, 37], [-0.1, 0.01, 0.0, 0.0], image_size=SIZE).requires_grad_(False)
    wide, narrow = [150.0, 150, 154, 109], [180.0, 180, 140, 120]
    for intrinsics in (wide, [wide, narrow]):
        target = ct.Pinhole(intrinsics, image_size=(221, 309)).requires_grad_(False)
        yield ct.Warp(source, target, tolerance=tolerance, **options)(batch).double()


# every pair of a mode and a dtype, each with one padding and one layout
CASES = [
    (("zeros", "border", "reflection")[(i + j) % 3], mode, dtype, LAYOUTS[(i + j // 2) % 2])
    for i, mode in enumerate(("nearest", "bilinear", "bicubic"))
    for j, dtype in enumerate((torch.uint8, torch.uint16, torch.float16, torch.float32))
]


@pytest.mark.parametrize(("padding", "mode", "dtype", "layout"), CASES)
def test_every_variant_samples_as_torch_and_as_the_others_do(
    variant, baseline, monkeypatch, padding, mode, dtype, layout
):
    batch = images(dtype).contiguous(memory_format=layout)
    for tolerance, other in ((0, None), (0.01, baseline)):
        found, expected = (
            list(sampled(monkeypatch, library, batch, tolerance, mode=mode, padding_mode=padding))
            for library in (variant, other)
        )
        for here, there in zip(found, expected, strict=True):
            wrong = (here - there).abs()
            if mode == "nearest":  # halfway between two, either is
                assert (wrong > 0).double().mean() < 1e-3
            elif dtype.is_floating_point:
                assert wrong.max() <= MOST[dtype, tolerance]
            else:  # a level, where it is between two
                assert wrong.max() <= 1
                assert (wrong > 0).double().mean() < 0.01
