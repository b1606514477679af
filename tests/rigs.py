"""The sample files, and when two rigs are the same."""

import json
from pathlib import Path

import torch

import camtorch as ct
from camtorch.io import formats

FILES = Path(__file__).parent / "files"
MANIFEST = json.loads((FILES / "MANIFEST.json").read_text())
SUFFIXES = {names.format: names.suffixes[0] for names in formats.NAMES_BY_FORMAT.values()}
POINT = (0.1, -0.2, 1.0)


def float64(values):
    return torch.tensor(values, dtype=torch.float64)


def load(name):
    """A sample file."""
    return ct.load(FILES / name)


def assert_same(a, b):
    """The same rig to the last bit."""
    assert list(a.cameras) == list(b.cameras)
    for one, other in zip(a.cameras.values(), b.cameras.values(), strict=True):
        assert type(one) is type(other)
        assert one.image_size == other.image_size
        assert one.intrinsics.dtype == other.intrinsics.dtype == torch.float64
        assert torch.equal(one.intrinsics, other.intrinsics)
        assert torch.equal(one.distortion, other.distortion)
    assert list(a.extrinsics) == list(b.extrinsics)
    for one, other in zip(a.extrinsics.values(), b.extrinsics.values(), strict=True):
        assert torch.equal(one.rotation, other.rotation)
        assert torch.equal(one.translation, other.translation)
    assert a.images == b.images


SAMPLES = sorted(path.name for path in FILES.iterdir() if path.name in MANIFEST and path.suffix != ".txt")
SAMPLES += ["cameras.txt"]
