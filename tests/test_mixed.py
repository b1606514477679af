"""Batches of cameras of several models: to the bit what each camera gives by itself, and a camera in all it does."""

import copy

import pytest
import torch
from cameras import KEYS, make, real

import camtorch as ct

SIZE = (48, 64)
DIRECTIONS = {"project": 3, "unproject": 2}


def one_of_each(dtype=torch.float64):
    """A real camera of every model, as of images of one size, that learns."""
    cameras = []
    for key in KEYS:
        camera = next(iter(real(key).values()))
        camera.image_size = camera.image_size or (480, 640)
        camera = camera.resize(*SIZE)
        numbers = [t.detach().to(dtype).clone() for t in (camera.intrinsics, camera.distortion)]
        cameras.append(make(key, *numbers, image_size=SIZE))
    return cameras


def values(size, count, dtype=torch.float64):
    """(count, 101, size): points all around, or pixels; some that no camera takes."""
    torch.manual_seed(0)
    given = torch.randn(count, 101, size, dtype=dtype)
    if size == 2:
        given = (given * 0.3 + 0.5) * torch.tensor(SIZE[::-1])
    given[:, 0], given[:, 1, 0] = 0, torch.nan
    return given


def tensors(camera):
    return [t for t in (camera.intrinsics, camera.distortion) if t.numel()]


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_one_by_one_to_the_bit_with_gradients(direction):
    cameras = one_of_each() + one_of_each()[::-1]
    mixed = ct.Mixed(cameras)
    assert len(mixed.groups) == len(KEYS)
    given = values(DIRECTIONS[direction], len(cameras)).requires_grad_()
    result, valid = getattr(mixed, direction)(given)
    weight = torch.rand(result.shape[-2:], dtype=torch.float64)
    (result * weight).sum().backward()
    for i, camera in enumerate(cameras):
        alone = copy.deepcopy(camera)
        mine = given[i].detach().requires_grad_()
        expected, also = getattr(alone, direction)(mine)
        (expected * weight).sum().backward()
        assert torch.equal(result[i], expected), camera
        assert torch.equal(valid[i], also)
        assert torch.equal(given.grad[i], mine.grad), camera
        for tensor, its in zip(tensors(camera), tensors(alone), strict=True):
            assert torch.equal(tensor.grad, its.grad), camera
