"""The sample files, and when two rigs are the same."""

import json
from pathlib import Path

import torch

import camtorch as ct
from camtorch.io import formats

FILES = Path(__file__).parent / "files"
MANIFEST = json.loads((FILES / "MANIFEST.json").read_text())
SUFFIXES = {name: names.suffixes[0] for name, names in formats.WRITTEN.items()}
POINT = (0.1, -0.2, 1.0)


def float64(values):
    return torch.tensor(values, dtype=torch.float64)


def tables(path):
    """Return the names and the rows of the tables in a text: a name in brackets, and rows of cells between arrows."""
    tables = (table.split("]\n") for table in path.read_text().split("\n\n[")[1:])
    return [(name, [row.split(" => ") for row in rows.splitlines()]) for name, rows in tables]


FAULTS = tables(FILES / "faults.txt")


def load(name):
    return ct.load(FILES / name)


def written(path, content):
    """The path, after text or bytes were written there."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def assert_same(a, b, atol=0.0):
    """The same rig: cameras to the last bit, poses to the rounding of what their rotations are written as."""
    assert list(a.cameras) == list(b.cameras)
    for one, other in zip(a.cameras.values(), b.cameras.values(), strict=True):
        assert (type(one), one.image_size) == (type(other), other.image_size)
        assert one.intrinsics.dtype == other.intrinsics.dtype == torch.float64
        assert torch.equal(one.intrinsics, other.intrinsics)
        assert torch.equal(one.distortion, other.distortion)
    assert list(a.extrinsics) == list(b.extrinsics)
    for one, other in zip(a.extrinsics.values(), b.extrinsics.values(), strict=True):
        there, here = one.matrix(), other.matrix()
        assert there.dtype == here.dtype == torch.float64
        limit = max(atol, 1e-15 * (8 + one.translation.norm().item()))
        assert torch.allclose(there, here, rtol=0, atol=limit)
    assert a.images == b.images


SAMPLES = sorted(path.name for path in FILES.iterdir() if path.name in MANIFEST and path.suffix != ".txt")
SAMPLES += ["cameras.txt"]
