"""What a camera is asked most: its numbers, its field of view, its parts, and why a point has no pixel."""

import math

import numpy as np
import pytest
import torch
from cameras import DISTINCT, KEYS, each_kind, every_model, fan, make, one, spread

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
        assert (type(part), part.image_size) == (type(batch), SIZE)
        assert part.distortion_names == batch.distortion_names
        found = part.project(points.expand(*part.batch_shape, *points.shape))
        for mine, whole in zip(found, expected, strict=True):
            torch.testing.assert_close(mine, whole.flatten(0, 1)[places[index]])
    assert len(batch) == 2
    assert [len(row) for row in batch] == [3, 3]
    assert [[float(c.fx.detach()) for c in row] for row in batch] == batch.fx.tolist()


OF_RADIUS = {ct.Pinhole: lambda r: math.atan(r / 300), ct.KannalaBrandt: lambda r: r / 300}
OF_RADIUS |= {ct.Stereographic: lambda r: 2 * math.atan(r / 600)}
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


SMALL = (60, 80)


def camera_of(key, dtype=torch.float32, learns=True):
    return one(key).to(dtype).replace(image_size=SMALL).requires_grad_(learns)


def numbers(camera):
    return torch.cat([t.expand(*camera.batch_shape, t.shape[-1]) for t in (camera.intrinsics, camera.distortion)], -1)


MADE = {
    "replace": lambda camera: camera.replace(image_size=SMALL),
    "clone": lambda camera: camera.clone(),
    "expand": lambda camera: camera.expand(2),
    "index": lambda camera: camera.expand(3)[1],
    "cat": lambda camera: ct.cat([camera, camera]),
    "torch.cat": lambda camera: torch.cat([camera, torch.stack((camera, camera), dim=0)]),
    "detach": lambda camera: camera.detach(),
}


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("way", MADE)
@each_kind
def test_what_is_made_of_a_camera_has_its_numbers_and_learns_where_it_does(key, way, learns):
    camera = camera_of(key, torch.float64, learns)
    made = MADE[way](camera)
    assert (type(made), made.image_size) == (type(camera), SMALL)
    assert made.distortion_names == camera.distortion_names
    assert made.intrinsics.dtype == torch.float64
    assert torch.equal(numbers(made), numbers(camera).expand_as(numbers(made)))
    assert made.intrinsics.requires_grad == (learns and way != "detach")
    if made.intrinsics.requires_grad:
        made.intrinsics.sum().backward()
        assert torch.equal(camera.intrinsics.grad, torch.full((4,), float(made.batch_shape.numel())).double())
    points = torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64)
    seen = made.project(points.expand(*made.batch_shape, 3))[0]
    assert torch.equal(seen, camera.project(points)[0].expand_as(seen))


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("key", KEYS)
def test_numbers_are_replaced(key, learns):
    camera = camera_of(key, torch.float64, learns)
    new = camera.replace(intrinsics=[30.0, 31.0, 40.0, 28.0], distortion=camera.distortion.tolist())
    assert new.intrinsics.tolist() == [30.0, 31.0, 40.0, 28.0]
    assert (new.intrinsics.dtype, new.intrinsics.requires_grad) == (torch.float64, learns)
    assert torch.equal(new.distortion, camera.distortion)
    batch = camera.replace(intrinsics=torch.ones(3, 4, dtype=torch.float64))
    assert batch.batch_shape == (3,)
    predicted = torch.full((2, 4), 30.0, dtype=torch.float64, requires_grad=True) * 2
    assert camera.replace(predicted).intrinsics is predicted
    assert camera.replace(predicted).distortion is camera.distortion


def test_a_copy_is_its_own_and_what_is_shared_is_not():
    camera = camera_of("brown_conrady", learns=False)
    clone, shared = camera.clone(), camera.detach()
    camera.intrinsics.data[0] = 33.0
    assert clone.fx != 33.0
    assert shared.fx == 33.0
    assert camera.replace(distortion=[0.1, 0.0, 0.0, 0.0, 0.2]).distortion_names[-1] == "k3"


def test_a_mixed_batch_is_a_value():
    members = [camera_of("pinhole"), camera_of("mei", learns=False)]
    mixed = ct.cat(members)
    for made in (mixed.clone(), mixed.detach(), mixed.replace(image_size=(6, 8)), mixed.expand(2), ct.cat([mixed])):
        assert isinstance(made, ct.Mixed)
        assert torch.equal(made.intrinsics, mixed.intrinsics)
        assert [type(one) for one in made] == [type(one) for one in members]
    assert mixed.replace(image_size=(6, 8))[1].image_size == (6, 8)
    assert not mixed.detach().intrinsics.requires_grad
    assert torch.equal(mixed.replace(torch.ones(2, 4)).intrinsics, torch.ones(2, 4))
    mixed.clone().intrinsics.sum().backward()
    assert torch.equal(members[0].intrinsics.grad, torch.ones(4))
    assert ct.cat([mixed, members[0]]).batch_shape == (3,)
    assert mixed[:1].expand(4).batch_shape == (4,)


def test_a_pose_is_a_value():
    pose = ct.Extrinsics([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])
    assert torch.equal(pose.expand(2, 3).matrix(), pose.matrix().expand(2, 3, 4, 4))
    assert not pose.detach().rotation.requires_grad
    assert pose.clone().rotation.requires_grad
    poses = ct.Extrinsics(torch.rand(4, 3), torch.rand(3))
    assert len(poses) == 4
    for index in (2, slice(1, 3)):
        torch.testing.assert_close(poses[index].matrix(), poses.matrix()[index])
    assert [p.batch_shape for p in poses] == [()] * 4


CAMERA = camera_of("kannala_brandt")


def test_numbers_are_replaced_by_those_of_another_order_with_a_warning_and_of_narrow_dtypes():
    with pytest.warns(UserWarning, match="Pass both focal lengths first"):
        CAMERA.replace([50.0, 39.5, 51.0, 29.5])
    assert CAMERA.replace(torch.tensor([50.0, 51.0, 39.5, 29.5]).half()).intrinsics.dtype == torch.float32
    assert CAMERA.replace(distortion=CAMERA.distortion.detach().bfloat16()).distortion.dtype == torch.float32


@pytest.mark.parametrize("camera", [CAMERA, ct.Mixed([CAMERA])], ids=["single", "mixed"])
def test_it_expands_to_any_whole_number_and_a_clone_made_at_inference_joins_a_graph(camera):
    for count in (4, np.int64(4), torch.tensor(4)):
        assert camera.expand(count).batch_shape == camera.expand((count,)).batch_shape == (4,)
    with torch.inference_mode():
        clone = camera.clone()
    points = torch.tensor([[0.1, 0.2, 1.0]]).requires_grad_()
    clone.project(points)[0].sum().backward()
    assert points.grad.any()
    assert not clone.intrinsics.requires_grad


def test_a_mixed_batch_keeps_precision_and_what_is_fixed():
    learning, pinhole = camera_of("kannala_brandt", torch.float64, True), camera_of("pinhole", torch.float64, True)
    numbers = [[30.1, 31.0, 31.5, 23.5]] * 3
    made = ct.Mixed([learning.detach(), learning, pinhole]).replace(numbers)
    assert made.intrinsics.tolist() == numbers
    assert [camera.intrinsics.requires_grad for camera in made] == [False, True, True]
    alike = ct.Mixed([pinhole.detach(), learning.detach()] * 2).replace(numbers[0])
    assert len(list(alike.parameters())) == 3  # stacked by model, not of each camera


def test_what_is_made_without_a_graph_is_fixed():
    batch = ct.Pinhole([[30.0, 31.0, 31.5, 23.5]] * 2, image_size=SMALL)
    with torch.no_grad():
        for made in (batch.expand(3, 2), batch[0], batch.clone()):
            assert isinstance(made.intrinsics, torch.nn.Parameter)
            assert not made.intrinsics.requires_grad
    leaf = torch.arange(30.0, 38.0)[:4].requires_grad_()
    ct.Pinhole(leaf, image_size=SMALL).crop(1, 2, 20, 30).project(torch.ones(3))[0].sum().backward()
    assert leaf.grad.any()


@pytest.mark.parametrize("p", [0.0, 0.5, 1.0])
def test_cameras_of_a_list_have_the_widest_dtype_and_their_own_gradients(p):
    learning, other = camera_of("kannala_brandt", torch.float32, True), camera_of("brown_conrady", torch.float64, True)
    cameras = [learning, learning.detach(), other]
    sample = {"camera": cameras, "image": [torch.rand(1, *SMALL)] * 3}
    found = ct.augment.RandomCamera(yaw=10, p=p, min_filled=0)(sample)["camera"]
    assert {made.intrinsics.dtype for made in found} == {torch.float64}
    sum(made.intrinsics.sum() for made in found).backward()
    assert [camera.intrinsics.grad is not None for camera in cameras] == [True, False, True]
