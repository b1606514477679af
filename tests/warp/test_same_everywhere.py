"""One answer everywhere: every case of `cases` is the same compiled, exported, without the library and on a device."""

import os
import subprocess
import sys

import cases
import pytest
import torch
from cameras import slow_unless
from pretended import tensors_of, try_cases

from camtorch.warp.options import MODES, PADDINGS

REFUSED = {"BoxCrop", "Compose: size, shutter", "RandomMount, shift", "RandomShutter"}
"""Calls that torch.compile refuses."""
INSIDE = ("Compose: mount", "Compose: crop, mount", "Compose: flip, lens", "RandomMount", "RandomLens", "RandomCamera")
LONG = ("labels: ShutterWarp", "Reproject, sweep", "losses.rays")
NOT_EXPORTED = (*INSIDE, *REFUSED, *LONG, "FaceNormalizer", "CanonicalCamera", "CameraHead", "labels: Plane")
"""Calls that torch.export refuses, or takes longest for."""
LONG_COMPILED = ("CameraHead", "Compose: mount", "Compose: crop, mount", "Compose: flip, lens", "FaceNormalizer")
LONG_COMPILED += ("RandomCamera", "RandomLens", "ShutterWarp", "labels:", "CenterCrop", "Compose: crop, crop")
LONG_COMPILED += ("Compose: crop, flip", "Compose: size", "RandomCrop", "RandomResized", "Resize,", "Rotate90")
LONG_COMPILED += ("VerticalFlip", "Pad", "BirdsEye", "Reproject, sweep", "Warp, float64")
"""Calls that torch.compile traces for long; its second trace (AOTAutograd) sees the like in others, as RandomMount."""
BOTH = {f"Warp, {mode}, {padding}" for mode in set(MODES) - {"bilinear"} for padding in set(PADDINGS) - {"zeros"}}
"""Not recorded: what is recorded asks for the mode or for the padding, and torch's sampler takes both as they are."""
NAMES = slow_unless("Warp, bilinear, zeros".__eq__, [name for name in cases.CASES if name not in REFUSED | BOTH])
every = pytest.mark.parametrize("name", NAMES)


def assert_same(found, expected):
    """Assert that tensors differ by a grey level at most, or 1e-3."""
    assert len(found) == len(expected)
    for here, there in zip(found, expected, strict=True):
        assert here.dtype == there.dtype
        least = 0 if there.dtype == torch.bool else 1e-3 if there.is_floating_point() else 1
        torch.testing.assert_close(here.double(), there.double(), atol=least, rtol=0, equal_nan=True)


@every
@torch.no_grad()
def test_compiled(name):
    if torch.__version__.startswith("2.10.") and name == "Warp, bilinear, zeros":
        pytest.skip("torch 2.10 compiles no property of a NamedTuple, which a Warp uses")
    program, inputs = cases.PROGRAMS[name].on("cpu")
    backend = "eager" if name.startswith(LONG_COMPILED) else "aot_eager"
    compiled = torch.compile(program, fullgraph=True, backend=backend)
    assert_same(list(tensors_of(compiled(*inputs))), cases.answer(name))


@every
@torch.no_grad()
def test_exported(name):
    if name.startswith(NOT_EXPORTED):
        pytest.skip("it is not exported")
    program, inputs = cases.PROGRAMS[name].on("cpu")
    exported = torch.export.export(program, tuple(inputs)).module()
    assert_same(list(tensors_of(exported(*inputs))), cases.answer(name))


@pytest.mark.slow
def test_without_the_compiled_library(tmp_path):
    command = [sys.executable, "-W", "error", cases.__file__, str(tmp_path / "answers.pt")]
    subprocess.run(command, env={**os.environ, "CAMTORCH_NATIVE": "0"}, check=True)
    for name, expected in torch.load(tmp_path / "answers.pt").items():
        assert_same(cases.answer(name), expected)


@pytest.mark.slow
def test_on_another_device():
    failed, table = try_cases("cases")
    assert not failed, table
