"""What the checks of the rows of the pages "Coming from" have in common; beside this is one file a library."""

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

CHECKS, TRAPS = {}, []
SIZE = (120, 160)
SLOW = [pytest.mark.slow]


def row(*keys, slow=False):
    """Register the check of the rows that begin with these names, module and all."""

    def register(check):
        param = pytest.param(check, id=keys[0], marks=SLOW if slow else [])
        assert not CHECKS.keys() & set(keys), keys
        CHECKS.update(dict.fromkeys(keys, param))
        return check

    return register


def equal(module, table, slow=False):
    """Register rows where the same comes out of both: names -> what gives pairs (ours, theirs[, atol])."""
    for names, pairs in table.items():
        row(*(f"{module}.{name}" for name in names.split()), slow=slow)(functools.partial(_are_close, pairs))


def _are_close(pairs):
    for pair in pairs():
        close(*pair)


def elsewhere(module, table):
    """Register rows that tests of other rooms hold to: names -> "room/file.py::name" of the test."""
    for names, test in table.items():
        row(*(f"{module}.{name}" for name in names.split()))(functools.partial(_is_there, *test.split("::")))


def _is_there(file, name):
    assert f"def {name}(" in (Path(__file__).parents[1] / file).read_text()


def trap(check, slow=False):
    """Register the check of what a page says under "Traps"."""
    name = f"{check.__module__.split('.')[-1]}: {check.__name__}"
    TRAPS.append(pytest.param(check, id=name, marks=SLOW if slow else []))
    return check


def close(ours, theirs, atol=1e-9):
    """The same shape, and the same numbers within atol; of images (H, W, C) but for two grey values, and the rim."""
    ours, theirs = (np.asarray(x.detach() if isinstance(x, torch.Tensor) else x) for x in (ours, theirs))
    assert ours.shape == theirs.shape
    if ours.dtype != np.uint8:
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=atol)
        return
    shown = ((theirs > 0) & (ours > 0)).all(-1)
    inner = cv2.erode(shown.astype(np.uint8), np.ones((5, 5)), borderValue=0) > 0
    assert inner.mean() > 0.2
    assert np.abs(ours.astype(int) - theirs.astype(int))[inner].max() <= 2


def points(count=50, low=(-1.5, -1.5, 1.5), high=(1.5, 1.5, 4.5), seed=0):
    """(N, 3) float64, before a camera."""
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def pixels(count=50, seed=0):
    """(N, 2) float64, on an image of SIZE."""
    return np.random.default_rng(seed).uniform((5, 5), (SIZE[1] - 5, SIZE[0] - 5), (count, 2))


def photograph():
    """(H, W, 3) uint8, smooth, so that how it is interpolated does not matter, and nowhere 0."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return (127 + 100 * np.stack([np.sin(x / 12 + i) * np.cos(y / 15 - i) for i in range(3)], -1)).astype(np.uint8)


def as_images(array):
    """(1, C, H, W) of an array (H, W, C)."""
    return torch.from_numpy(np.ascontiguousarray(array)).permute(2, 0, 1)[None]


def warped(warp):
    return warp(as_images(photograph()))[0].permute(1, 2, 0).numpy()


def plane(rays):
    """Points (..., 2) of rays at a depth of one."""
    return rays[..., :2] / rays[..., 2:]
