"""Laws of what images hold: ids of every width, pixels that are no numbers, wrong layouts, and no graph in vain."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)

import camtorch as ct
from camtorch.warp import sampling
from camtorch.warp.grid import locate

SIZE = (40, 50)
MODES = ("nearest", "bilinear", "bicubic")
PADDINGS = ("zeros", "border", "reflection")
INTEGERS = (torch.int8, torch.uint8, torch.int16, torch.uint16, torch.int32, torch.uint32, torch.int64, torch.uint64)


def pinhole(dtype=torch.float32, **options):
    intrinsics = torch.tensor([30.0, 30.0, 24.5, 19.5], dtype=dtype)
    return ct.Pinhole(intrinsics, image_size=SIZE, **options).requires_grad_(False)


def fisheye(dtype=torch.float32, learns=False):
    lens = torch.tensor([0.02, -0.01, 0.004, -0.001], dtype=dtype)
    camera = ct.KannalaBrandt(torch.tensor([20.0, 20, 25, 19], dtype=dtype), lens, image_size=SIZE)
    return camera.requires_grad_(learns)


def turn(*degrees, dtype=torch.float32):
    return ct.augment.mount_rotation(*(torch.tensor(float(d), dtype=dtype) for d in (*degrees, 0, 0)[:3]))


# -- ids


def ids(dtype, count=1):
    """The largest numbers of a dtype, each once: float64 holds few of them."""
    pixels = torch.arange(count * 2 * SIZE[0] * SIZE[1], dtype=torch.int64).view(count, 2, *SIZE)
    top = torch.iinfo(dtype).max
    if dtype == torch.uint64:
        return (-1 - pixels).view(torch.uint64)
    return (top - pixels % (top + 1)).to(dtype)


@pytest.mark.parametrize("padding_mode", PADDINGS)
@pytest.mark.parametrize("dtype", INTEGERS)
def test_ids_come_out_exactly(dtype, padding_mode):
    warp = ct.Warp(fisheye(), pinhole(), turn(70, 5, 20), mode="nearest", padding_mode=padding_mode)
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


def test_ids_of_a_batch_of_cameras_traced_and_in_transforms():
    rotations = torch.stack([turn(yaw, 0, 5) for yaw in (0, 30, 60)])
    warp = ct.Warp(fisheye(), pinhole(), rotations, mode="nearest")
    given = ids(torch.int64, 3)
    result = warp(given)
    for i in range(3):
        single = ct.Warp(fisheye(), pinhole(), rotations[i], mode="nearest")
        assert torch.equal(single(given[i : i + 1])[0], result[i])
    assert torch.equal(torch.compile(warp, fullgraph=True, backend="eager")(given), result)
    alone = ct.Warp(fisheye(), pinhole(), turn(20), mode="nearest")
    assert torch.equal(torch.func.vmap(lambda image: alone(image[None])[0])(given), alone(given))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.bool, torch.int32])
def test_narrow_dtypes_are_traced_as_they_are_run(dtype):
    warp = ct.Warp(fisheye(), pinhole(), turn(20), fill=1)
    given = torch.randint(200, (2, 3, *SIZE), generator=torch.Generator().manual_seed(0)).to(dtype)
    compiled = torch.compile(warp, fullgraph=True, backend="eager")(given)
    mapped = torch.func.vmap(lambda image: warp(image[None])[0])(given)
    for result in (compiled, mapped):
        assert result.dtype == dtype
        assert (result.double() - warp(given).double()).abs().max() <= (0 if dtype == torch.bool else 1)


@pytest.mark.parametrize("padding_mode", PADDINGS)
@pytest.mark.parametrize("mode", MODES)
def test_wide_unsigned_integers_stay_in_range(mode, padding_mode):
    warp = ct.Warp(fisheye(), pinhole(), mode=mode, padding_mode=padding_mode)
    for dtype in (torch.uint16, torch.uint32, torch.uint64):
        given = torch.full((1, 1, *SIZE), torch.iinfo(dtype).max, dtype=dtype)
        result = warp(given)
        assert result.dtype == dtype
        # half way at most is what float64 loses of the largest
        assert result[0, 0, 15:25, 20:30].to(torch.float64).min() >= float(torch.iinfo(dtype).max) * (1 - 1e-15)


# -- pixels that are no numbers


@pytest.mark.parametrize("bad", [torch.inf, torch.nan])
@pytest.mark.parametrize("padding_mode", PADDINGS)
def test_a_pixel_that_is_no_number_stays_in_its_neighbourhood(padding_mode, bad):
    for rotation in (None, turn(3, 2, 5), turn(0, 0, 90)):
        warp = ct.Warp(pinhole(), pinhole(), rotation, mode="bicubic", padding_mode=padding_mode)
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


def test_sampling_again_is_sampling():
    """The taps and weights of the samples that are mended are those of `grid_sample`."""
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(2, 3, 7, 9, generator=generator, dtype=torch.float64)
    grid = 5 * torch.rand(2, 30, 31, 2, generator=generator, dtype=torch.float64) - 2.5
    for padding_mode in PADDINGS:
        expected = F.grid_sample(images, grid, "bicubic", padding_mode, align_corners=False)
        result = torch.full_like(expected, torch.nan)
        sampling._sample_again(result, images, grid, padding_mode)
        torch.testing.assert_close(result, expected, atol=1e-12, rtol=0)


# -- layouts


@pytest.mark.parametrize(
    ("images", "error", "says"),
    [
        (torch.zeros(*SIZE, 3, dtype=torch.uint8), ValueError, r"\(40, 50, 3\), with the channels last.*2, 0, 1\)\[No"),
        (torch.zeros(2, *SIZE, 3), ValueError, r"channels last.*permute\(0, 3, 1, 2\)"),
        (torch.zeros(*SIZE), ValueError, r"\(B, C, H, W\); got shape \(40, 50\)"),
        (torch.zeros(2, *SIZE), ValueError, r"\(2, 40, 50\).*masks\[:, None\]"),
        (torch.zeros(1, 1, *SIZE, 3), ValueError, r"\(1, 1, 40, 50, 3\)"),
        (np.zeros((*SIZE, 3), np.uint8), TypeError, r"ndarray.*torch.from_numpy\(array\).permute"),
        (torch.zeros(1, 1, *SIZE, dtype=torch.complex64), TypeError, "complex64"),
        ([[1.0]], TypeError, "got list"),
    ],
)
def test_layouts_that_are_not_taken_are_named(images, error, says):
    with pytest.raises(error, match=says):
        ct.Warp(fisheye(), pinhole())(images)


@pytest.mark.parametrize("options", [{}, {"fill": 3.0}, {"antialias": True}, {"padding_mode": "border"}])
@pytest.mark.parametrize("mode", MODES)
def test_no_channels_and_no_images_make_none(mode, options):
    for dtype in (torch.float32, torch.uint8, torch.int64):
        for shape in ((2, 0), (0, 3), (0, 0)):
            result = ct.Warp(fisheye(), pinhole(), mode=mode, **options)(torch.zeros(*shape, *SIZE, dtype=dtype))
            assert result.shape == (*shape, *SIZE)
            assert result.dtype == dtype


# -- no graph in vain


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.bool])
@pytest.mark.parametrize("mode", MODES)
def test_integers_take_the_kept_grid_while_cameras_learn(dtype, mode):
    learning = ct.Warp(fisheye(learns=True), pinhole(), mode=mode, antialias=True)
    frozen = ct.Warp(fisheye(), pinhole(), mode=mode, antialias=True)
    given = torch.randint(2, (1, 3, *SIZE), generator=torch.Generator().manual_seed(0)).to(dtype)
    result = learning(given)
    assert result.grad_fn is None
    assert not result.requires_grad
    assert torch.equal(result, frozen(given))
    kept = learning._memos["zeros"]._kept
    assert kept is not None
    learning(given)
    assert learning._memos["zeros"]._kept is kept
    assert learning.valid_mask().grad_fn is None
    with torch.no_grad():
        learning(given.float())
    assert learning._memos["zeros"]._kept is kept
    # and a step of the optimizer is seen
    with torch.no_grad():
        learning.source.intrinsics.add_(3.0)
    assert not torch.equal(learning(given), result)
    assert learning(given.float()).requires_grad


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.uint8, torch.float64])
def test_float64_cameras_do_not_promote_images(dtype, learns):
    wide = ct.Warp(fisheye(torch.float64, learns), pinhole(torch.float64))
    images = (200 * torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(0))).to(dtype)
    result = wide(images)
    assert result.dtype == dtype
    assert result.requires_grad == (learns and dtype.is_floating_point)
    expected = ct.Warp(fisheye(), pinhole())(images.to(torch.float32))
    # two roundings of a position in float32, and of a value
    bound = 0.51 if dtype == torch.uint8 else 0.15 if dtype == torch.float16 else 0.02
    assert (result.double() - expected.double()).abs().max() < bound
    if learns and dtype.is_floating_point:
        result.sum().backward()
        assert wide.source.intrinsics.grad.dtype == torch.float64
        assert wide.source.intrinsics.grad.abs().sum() > 0


def test_float64_cameras_sample_float32_images_in_float32(monkeypatch):
    seen = []
    original = F.grid_sample
    monkeypatch.setattr(F, "grid_sample", lambda x, grid, *a, **k: seen.append((x, grid)) or original(x, grid, *a, **k))
    for dtype in (torch.float32, torch.uint8):
        ct.Warp(fisheye(torch.float64), pinhole(torch.float64))(torch.zeros(4, 3, *SIZE, dtype=dtype))
    for images, grid in seen:
        assert images.dtype == grid.dtype == torch.float32
        # one grid for all images, not a copy for each
        assert grid.untyped_storage().nbytes() == SIZE[0] * SIZE[1] * 8


# -- what is handed out belongs to the caller


def test_masks_and_grids_may_be_changed():
    for warp in (
        ct.Warp(fisheye(), pinhole()),
        ct.Warp(fisheye(), pinhole()).pin(),
        ct.Warp(fisheye(), pinhole(), tolerance=0.01),
        ct.Warp(fisheye(), pinhole(), torch.stack([turn(0), turn(9)]).expand(2, 3, 3)),
    ):
        grid, mask = warp.grid(), warp.valid_mask()
        expected = grid.clone(), mask.clone()
        grid.mul_(0)
        mask &= False
        assert torch.equal(warp.grid(), expected[0])
        assert torch.equal(warp.valid_mask(), expected[1])


def test_a_loaded_calibration_makes_its_grid_once(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr("camtorch.warp.warp.locate", lambda *a: made.append(a) or locate(*a))
    ct.save(fisheye(torch.float64), tmp_path / "camera.yaml", format="opencv")
    camera = ct.load(tmp_path / "camera.yaml").camera
    assert camera.intrinsics.dtype == torch.float64
    dewarp = ct.Dewarp(camera)
    for dtype in (torch.float32, torch.uint8, torch.float64, torch.float32):
        result = dewarp(torch.zeros(1, 3, *SIZE, dtype=dtype))
        assert result.grad_fn is None
        assert result.dtype == dtype
    assert len(made) == 1
