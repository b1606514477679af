"""Laws of large images and narrow dtypes: strips, tiles and parts change nothing, and memory stays bounded."""

import pytest
import torch
from cameras import fisheye, turn

import camtorch as ct
from camtorch.warp import routes, sampling
from camtorch.warp.options import MODES, PADDINGS

SIZE = (90, 120)


def pair(rotation=(30.0, 10.0, 25.0)):
    """From a lens to a wide target that looks aside: part of it is off the image, part has no ray."""
    source = fisheye(SIZE, 0.5)
    target = ct.Equirectangular([22.0, 22, 49.5, 34.5], image_size=(70, 100)).requires_grad_(False)
    return source, target, turn(*rotation)


def images(dtype, count=1):
    generator = torch.Generator().manual_seed(0)
    return torch.randint(256, (count, 3, *SIZE), generator=generator).to(dtype)


@pytest.mark.parametrize(
    ("mode", "padding_mode", "dtype"),
    [
        (mode, padding_mode, (torch.uint8, torch.float16, torch.uint16 if i else torch.int32)[(i + j) % 3])
        for i, mode in enumerate(MODES)
        for j, padding_mode in enumerate(PADDINGS)
    ],
)
def test_tiles_of_a_large_image_change_nothing(dtype, mode, padding_mode, monkeypatch):
    for options in ({}, {"fill": (9, 8, 7)}, {"antialias": True}):
        one = ct.Warp(*pair(), mode=mode, padding_mode=padding_mode, **options)
        given = images(dtype, 2)
        expected = one(given.double())
        if dtype in (torch.uint8, torch.uint16):
            expected = expected.clamp(0, torch.iinfo(dtype).max)
        monkeypatch.setattr(sampling, "_CACHED_NUMBERS", 100)
        monkeypatch.setattr(sampling, "_TILE_SIDE", 32)
        result = one(given)
        monkeypatch.undo()
        assert result.dtype == dtype
        difference = (result.double() - expected).abs()
        # rounded are the positions, and integers; at a tie the nearest is another neighbour
        rounding = 0.15 if dtype.is_floating_point else 0.51
        assert (difference > rounding).double().mean() < (1e-3 if mode == "nearest" else 1e-5)


@pytest.mark.parametrize(("rows", "antialias"), [(1, False), (7, True), (16, False), (None, True)])
@pytest.mark.parametrize("cameras", [1, 2])
def test_strips_are_the_rows_of_the_whole(rows, antialias, cameras):
    *pair_of_them, turned = pair()
    turned = turned if cameras == 1 else torch.stack((turned, pair((0.0, 0, 5))[2]))
    one = ct.Warp(*pair_of_them, turned, antialias=antialias, fill=3.0)
    for given in (images(torch.uint8, 2), images(torch.float32)):
        strips = list(one.strips(given, rows=rows))
        assert [part.stop for part, _, _ in strips][-1] == 70
        assert [part.start for part, _, _ in strips] == [0, *(part.stop for part, _, _ in strips)][:-1]
        assert torch.equal(torch.cat([part for _, part, _ in strips], 2), one(given))
        assert torch.equal(torch.cat([valid for _, _, valid in strips], 2), one.valid_mask())


def test_long_grids_are_neither_made_at_once_nor_kept(monkeypatch):
    one = ct.Warp(*pair(), fill=2.0)
    given = images(torch.uint8)
    expected, mask = one(given), one.valid_mask()
    monkeypatch.setattr(routes, "_MOST_KEPT_PIXELS", 1000)
    monkeypatch.setattr(routes, "_STRIP_PIXELS", 1000)
    long = ct.Warp(*pair(), fill=2.0)
    assert torch.equal(long(given), expected)
    assert torch.equal(long.valid_mask(), mask)
    differentiable = given.double().requires_grad_()
    long(differentiable).sum().backward()
    assert differentiable.grad.abs().sum() > 0


def test_strips_have_no_graph_and_name_what_is_wrong():
    source, target, _ = pair()
    learning = ct.KannalaBrandt(source.intrinsics, source.distortion, image_size=SIZE)
    learning.requires_grad_(True)
    for _, part, _ in ct.Warp(learning, target).strips(images(torch.float32).requires_grad_(), rows=32):
        assert part.grad_fn is None
    with pytest.raises(ValueError, match="rows must be at least 1; got 0"):
        ct.Warp(source, target).strips(images(torch.uint8), rows=0)
