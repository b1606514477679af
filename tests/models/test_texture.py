"""What a camera is asked most: its numbers, its field of view, its parts, and why a point has no pixel."""

import math

import pytest
import torch
from cameras import DISTINCT, each_kind, every_model, fan, make, one, spread

import camtorch as ct

SIZE = (480, 640)


def test_numbers_by_name():
    intrinsics = torch.arange(1.0, 25.0).view(3, 2, 4).requires_grad_()
    camera = ct.KannalaBrandt(intrinsics, torch.zeros(2, 4), image_size=SIZE)
    for i, name in enumerate(("fx", "fy", "cx", "cy")):
        assert torch.equal(getattr(camera, name), intrinsics[..., i])
    camera.cy.sum().backward()
    assert intrinsics.grad[..., 3].eq(1).all()
    assert not intrinsics.grad[..., :3].any()
    assert (camera.height, camera.width) == SIZE
    assert ct.UCM([1.0, 2.0, 3.0, 4.0], torch.zeros(5, 1)).fy.tolist() == [2.0] * 5


# -- parts of a batch


def batch_of(key):
    camera = spread(key)
    scales = torch.tensor([[1.0, 1.1, 0.9], [1.2, 0.8, 1.05]], dtype=torch.float64)[..., None]
    return make(key, camera.intrinsics.detach() * scales, camera.distortion.detach(), image_size=SIZE)


BOTH = torch.tensor([[True, False, True], [False, True, False]])
INDICES = [1, -1, (1, 2), slice(0, 1), (slice(None), 0), [1, 0], (..., 2), torch.tensor([False, True]), BOTH]


@each_kind
def test_parts_of_a_batch_are_its_cameras(key):
    batch = batch_of(key)
    points = fan(40, 4, 3)
    expected = batch.project(points.expand(2, 3, *points.shape))
    places = torch.arange(6).view(2, 3)
    for index in INDICES:
        part = batch[index]
        assert type(part) is type(batch)
        assert part.image_size == SIZE
        assert part.distortion_names == batch.distortion_names
        found = part.project(points.expand(*part.batch_shape, *points.shape))
        for mine, whole in zip(found, expected, strict=True):
            torch.testing.assert_close(mine, whole.flatten(0, 1)[places[index]])
    assert len(batch) == 2
    assert [len(row) for row in batch] == [3, 3]
    assert [[float(c.fx.detach()) for c in row] for row in batch] == batch.fx.tolist()


def test_gradients_of_a_part_are_the_batch_s_and_its_values_are_shared():
    camera = ct.KannalaBrandt(torch.tensor([[300.0, 300.0, 320.0, 240.0]] * 3), image_size=SIZE)
    camera[1].project(torch.ones(3))[0].sum().backward()
    assert camera.intrinsics.grad.any(-1).tolist() == [False, True, False]
    frozen = camera.requires_grad_(False)[1]
    assert not any(p.requires_grad for p in frozen.parameters())
    frozen.intrinsics[0] = 7.0  # as by a row of a tensor
    assert camera.intrinsics[1, 0] == 7


# -- field of view

OF_RADIUS = {
    ct.Pinhole: lambda r: math.atan(r / 300),
    ct.KannalaBrandt: lambda r: r / 300,
    ct.Stereographic: lambda r: 2 * math.atan(r / 600),
}
FIELDS = [
    *(
        (model, [300.0, 300.0, (width - 1) / 2, 239.5], (480, width), [2 * angle(r) for r in half])
        for width, half in ((640, (320, 240, 400)), (641, (320.5, 240, math.hypot(320.5, 240))))
        for model, angle in OF_RADIUS.items()
    ),
    (ct.Pinhole, [300.0, 300.0, 99.5, 239.5], SIZE, [math.atan(100 / 300) + math.atan(540 / 300)]),
    (ct.KannalaBrandt, [120.0, 120.0, 319.5, 239.5], SIZE, [640 / 120]),
    (ct.Equirectangular, [320 / math.pi] * 2 + [319.5, 159.5], (320, 640), [2 * math.pi, math.pi]),
]


@pytest.mark.parametrize(("model", "numbers", "size", "expected"), FIELDS)
def test_field_of_view_of_closed_forms(model, numbers, size, expected):
    camera = model(numbers, image_size=size).double()
    # where a panorama closes, what is left out is that of the search
    tolerance = {"abs": 1e-3} if model is ct.Equirectangular else {"rel": 1e-9}
    assert camera.field_of_view[: len(expected)].tolist() == pytest.approx(expected, **tolerance)
    assert not camera.field_of_view.requires_grad
    if numbers[2] == (size[1] - 1) / 2 and math.degrees(expected[0]) < 300:
        made = model.from_fov(math.degrees(expected[0]), image_size=size)
        assert made.fx.item() == pytest.approx(numbers[0], rel=1e-6)


@each_kind
def test_field_of_view_of_a_batch_is_that_of_its_cameras(key):
    batch = batch_of(key)
    assert batch.field_of_view.shape == (2, 3, 3)
    torch.testing.assert_close(batch.field_of_view[1, 2], batch[1, 2].field_of_view)


# -- from a field of view


@each_kind
@pytest.mark.parametrize(("axis", "degrees"), [("horizontal", 95), ("vertical", 25), ("diagonal", 60.5)])
def test_a_camera_of_a_field_of_view(key, axis, degrees):
    camera = ct.MODELS[key].from_fov(degrees, image_size=SIZE, axis=axis)
    found = camera.double().field_of_view[("horizontal", "vertical", "diagonal").index(axis)]
    assert math.degrees(found) == pytest.approx(degrees, abs=2e-5)  # float32 focal lengths
    assert camera.intrinsics[0] == camera.intrinsics[1]
    assert camera.intrinsics[2:].tolist() == [319.5, 239.5]
    assert camera.image_size == SIZE
    assert all(p.requires_grad for p in camera.parameters())


@pytest.mark.parametrize("key", [key for key in sorted(DISTINCT) if ct.MODELS[key].distortion_names])
def test_with_the_distortion_of_a_lens_and_in_a_batch(key):
    lens = one(key)
    degrees = lens.fov[0] * torch.tensor([0.5, 0.25, 0.4], dtype=torch.float64)
    for wanted in (degrees[0], degrees):
        camera = type(lens).from_fov(wanted, image_size=SIZE, distortion=lens.distortion.detach())
        assert camera.intrinsics.dtype == torch.float64
        assert torch.equal(camera.distortion, lens.distortion.expand_as(camera.distortion))
        torch.testing.assert_close(camera.fov[..., 0], wanted, rtol=1e-8, atol=0)
    several = ct.KannalaBrandt.from_fov(60, image_size=SIZE, distortion=torch.full((2, 2), 0.01))
    assert several.batch_shape == (2,)


# -- why a point has no pixel


@every_model
def test_every_point_is_explained(key):
    camera = one(key)
    points = torch.cat((fan(180, 9, 5), torch.tensor([[math.nan, 0, 1], [0, 0, 0], [math.inf, 0, 1], [0, 0, -1]])))
    valid = camera.project(points)[1]
    lines = camera.explain(points)
    assert len(lines) == len(points)
    for line, good in zip(lines, valid.tolist(), strict=True):
        assert (line == "valid") == good
        assert good or line.startswith(("not finite: (", "no direction: ", "the chart does not", "beyond the"))
    assert lines[-4] == "not finite: (nan, 0, 1)"
    assert lines[-3] == "no direction: (0, 0, 0) is the origin"


def test_reasons():
    # r = theta - theta^3 / 3 ends at 1 rad, 200 pixels from the centre
    fold = ct.KannalaBrandt([300.0, 300.0, 319.5, 239.5], [-1 / 3], image_size=SIZE).double()
    assert fold.field_of_view.tolist() == pytest.approx([2.0] * 3, abs=1e-3)
    ray = torch.tensor([0.0, math.sin(2.0), math.cos(2.0)], dtype=torch.float64)
    assert fold.explain(ray) == ["beyond the fold at 57.30 degrees: 114.59 degrees from the optical axis"]
    backward = fold.explain(torch.tensor([[0.0, 0.0, -2.0], [1e-6, 0.0, -1.0]]))
    assert backward[0] == "the chart does not cover it: the backward direction, where all azimuths meet"
    assert "90.00" not in backward[1]
    pinhole = ct.Pinhole([300.0, 300.0, 319.5, 239.5]).double()
    (line,) = pinhole.explain(ray)
    assert line.startswith("the chart does not cover it: 114.59 degrees from the optical axis; on this side it ends at")
    assert float(line.split()[-2]) == pytest.approx(90, abs=0.02)
    narrow = ct.Pinhole.from_fov(60, image_size=SIZE).explain(torch.tensor([[0.0, 0.0, -1.0]]))
    assert narrow == ["the chart does not cover it: the backward direction; on this side it ends at 90.00 degrees"]


def test_reasons_in_batches_and_of_cameras_that_learning_broke():
    camera = ct.Mei(torch.tensor([[300.0, 300.0, 319.5, 239.5]] * 4), torch.zeros(4, 5))
    with torch.no_grad():
        camera.intrinsics[1, 0], camera.intrinsics[2, 3], camera.distortion[3, 0] = -3.0, math.nan, -1.5
    with pytest.warns(UserWarning, match="Mei: intrinsics of camera 1 in the batch became unusable: fx = -3"):
        lines = camera.explain(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]).expand(4, 2, 3))
    assert lines[0] == "valid"
    assert lines[1].startswith("the chart does not cover it")
    assert lines[2:4] == ["the camera itself is unusable: fx = -3 is not positive"] * 2
    assert lines[4:6] == ["the camera itself is unusable: cy = nan"] * 2
    assert lines[6:] == ["the camera itself is unusable: the formula needs xi > -1"] * 2
