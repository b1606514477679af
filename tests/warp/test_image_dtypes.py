"""Laws of what images hold: ids of every width, pixels that are no numbers, and no pixels at all."""

from itertools import cycle

import numpy as np
import pytest
import torch
from cameras import fisheye, pinhole, turn

import camtorch as ct
from camtorch.warp.options import MODES, PADDINGS

SIZE = (40, 50)
OPTIONS = {"antialias": True}, {"fill": 3.0}, {"padding_mode": "border"}
INTEGERS = (torch.int8, torch.uint8, torch.int16, torch.uint16, torch.int32, torch.uint32, torch.int64, torch.uint64)
PINHOLE, FISHEYE = pinhole(SIZE), fisheye(SIZE, 0.4)


def ids(dtype, count=1):
    """The largest numbers of a dtype, each once: float64 holds few of them."""
    pixels = torch.arange(count * 2 * SIZE[0] * SIZE[1], dtype=torch.int64).view(count, 2, *SIZE)
    top = torch.iinfo(dtype).max
    if dtype == torch.uint64:
        return (-1 - pixels).view(torch.uint64)
    return (top - pixels % (top + 1)).to(dtype)


@pytest.mark.parametrize("dtype", INTEGERS)
def test_ids_come_out_exactly(dtype):
    padding_mode = PADDINGS[INTEGERS.index(dtype) % 3]
    warp = ct.Warp(FISHEYE, PINHOLE, turn(70, 5, 20), mode="nearest", padding_mode=padding_mode)
    given = ids(dtype, 2)
    # the place of each pixel, which a float holds, tells where it comes from
    place = torch.arange(SIZE[0] * SIZE[1], dtype=torch.float64).view(1, 1, *SIZE)
    origin = warp(place, fill=-1)[0, 0].long()
    assert (origin == -1).any()
    for fill in (0, 7, torch.iinfo(dtype).max):
        result = warp(given, fill=fill)
        assert result.dtype == dtype
        expected = [channel.flatten()[origin.clamp(min=0)].tolist() for channel in given.flatten(0, 1)]
        expected = np.where((origin == -1).numpy(), np.array(fill, dtype=object), np.array(expected, dtype=object))
        assert (np.array(result.flatten(0, 1).tolist(), dtype=object) == expected).all()


def test_ids_of_a_batch_of_cameras_and_in_transforms():
    rotations = torch.stack([turn(yaw, 0, 5) for yaw in (0, 30, 60)])
    warp = ct.Warp(FISHEYE, PINHOLE, rotations, mode="nearest")
    given = ids(torch.int64, 3)
    result = warp(given)
    for i in range(3):
        single = ct.Warp(FISHEYE, PINHOLE, rotations[i], mode="nearest")
        assert torch.equal(single(given[i : i + 1])[0], result[i])
    alone = ct.Warp(FISHEYE, PINHOLE, turn(20), mode="nearest")
    if torch.__version__.startswith("2.10."):
        pytest.skip("torch 2.10 has no rule for Tensor.view(dtype) in vmap")
    assert torch.equal(torch.func.vmap(lambda image: alone(image[None])[0])(given), alone(given))


@pytest.mark.parametrize(("mode", "padding_mode"), [*zip(MODES, cycle(PADDINGS))])
def test_wide_unsigned_integers_stay_in_range(mode, padding_mode):
    warp = ct.Warp(FISHEYE, PINHOLE, mode=mode, padding_mode=padding_mode)
    for dtype in (torch.uint16, torch.uint32, torch.uint64)[: 3 if mode == "nearest" else 1]:
        given = torch.full((1, 1, *SIZE), torch.iinfo(dtype).max, dtype=dtype)
        result = warp(given)
        assert result.dtype == dtype
        # half way at most is what float64 loses of the largest
        assert result[0, 0, 15:25, 20:30].to(torch.float64).min() >= float(torch.iinfo(dtype).max) * (1 - 1e-15)


@pytest.mark.parametrize("bad", [torch.inf, torch.nan])
@pytest.mark.parametrize("padding_mode", PADDINGS)
def test_a_pixel_that_is_no_number_stays_in_its_neighbourhood(padding_mode, bad):
    for rotation in (None, turn(3, 2, 5), turn(0, 0, 90)):
        warp = ct.Warp(PINHOLE, PINHOLE, rotation, mode="bicubic", padding_mode=padding_mode)
        for row, column in ((20, 25), (0, 0), (39, 13)):
            image = torch.rand(1, 2, *SIZE, generator=torch.Generator().manual_seed(0))
            expected = warp(image)
            # what a pixel has to say in every sample
            one = torch.zeros(1, 2, *SIZE)
            one[0, 0, row, column] = 1
            weight = warp(one)
            image[0, 0, row, column] = bad
            result = warp(image)
            finite = torch.isfinite(result)
            assert finite[weight == 0].all()
            assert not finite[weight.abs() > 1e-3].any()
            torch.testing.assert_close(result[finite], expected[finite], atol=1e-3, rtol=0)
            if rotation is None:
                assert (~finite).nonzero().tolist() == [[0, 0, row, column]]


@pytest.mark.parametrize(("mode", "options"), [*zip(MODES, cycle(OPTIONS))])
def test_no_channels_and_no_images_make_none(mode, options):
    for dtype in (torch.float32, torch.uint8, torch.int64)[: 3 if mode == "nearest" else 2]:
        for shape in ((2, 0), (0, 3), (0, 0)):
            result = ct.Warp(FISHEYE, PINHOLE, mode=mode, **options)(torch.zeros(*shape, *SIZE, dtype=dtype))
            assert (result.shape, result.dtype) == ((*shape, *SIZE), dtype)


def test_masks_and_grids_may_be_changed():
    for warp in (
        ct.Warp(FISHEYE, PINHOLE),
        ct.Warp(FISHEYE, PINHOLE).pin(),
        ct.Warp(FISHEYE, PINHOLE, tolerance=0.01),
        ct.Warp(FISHEYE, PINHOLE, torch.stack([turn(0), turn(9)]).expand(2, 3, 3)),
    ):
        grid, mask = warp.grid(), warp.valid_mask()
        expected = grid.clone(), mask.clone()
        grid.mul_(0)
        mask &= False
        assert torch.equal(warp.grid(), expected[0])
        assert torch.equal(warp.valid_mask(), expected[1])
