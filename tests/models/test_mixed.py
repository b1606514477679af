"""Batches of cameras of several models: to the bit what each camera gives by itself, and a camera in all it does."""

import copy
import pickle

import pytest
import torch
from cameras import DISTINCT, KEYS, make, real
from test_laws import EDITS

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


def values(size, count, bad=True):
    """(count, 1025, size): points all around, or pixels; some that no camera takes."""
    torch.manual_seed(3)
    given = torch.randn(count, 1025, size, dtype=torch.float64)
    if size == 2:
        given = (given * 0.3 + 0.5) * torch.tensor(SIZE[::-1])
    if bad:
        given[:, 0], given[:, 1, 0] = 0, torch.nan
    return given


def tensors(camera):
    return [t for t in (camera.intrinsics, camera.distortion) if t.numel()]


@pytest.mark.parametrize("bad", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_one_by_one_to_the_bit_with_gradients(direction, bad):
    cameras = one_of_each()
    cameras += [copy.deepcopy(camera) for camera in cameras[::-1] if camera.key in DISTINCT]
    mixed = ct.Mixed(cameras)
    assert len(mixed.groups) == len(KEYS)
    given = values(DIRECTIONS[direction], len(cameras), bad).requires_grad_()
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


@pytest.mark.parametrize("as_source", [True, False])
def test_warps_are_those_of_each_camera_with_gradients(as_source):
    cameras = one_of_each()
    mixed, view = ct.Mixed(cameras), ct.Pinhole.from_fov(70, image_size=(17, 23)).double().requires_grad_(False)
    images = torch.rand(len(cameras), 2, *(SIZE if as_source else view.image_size), dtype=torch.float64)

    def warp(camera):
        return ct.Warp(camera, view) if as_source else ct.Warp(view, camera)

    result, points = warp(mixed)(images), torch.rand(len(cameras), 5, 2, dtype=torch.float64) * 15
    weight = torch.rand_like(result)
    (result * weight).sum().backward()
    moved = warp(mixed).transform_points(points)
    for i, camera in enumerate(cameras):
        alone = copy.deepcopy(camera)
        expected = warp(alone)(images[i : i + 1])
        (expected * weight[i]).sum().backward()
        assert torch.equal(result[i], expected[0]), camera
        for tensor, its in zip(tensors(camera), tensors(alone), strict=True):
            assert torch.equal(tensor.grad, its.grad), camera
        for both, of_one in zip(moved, warp(camera).transform_points(points[i]), strict=True):
            assert torch.equal(both[i], of_one), camera
    kept = warp(mixed.requires_grad_(False))
    before = kept(images)
    assert (before - result).abs().max() < 1e-12
    mixed[3].intrinsics.data[0] *= 1.1  # which a warp that keeps its grid has to see
    assert not torch.equal(kept(images)[3], before[3])


def models(learns=True):
    cameras = [
        ct.Pinhole([50.0, 50.0, 31.5, 23.5], image_size=SIZE),
        ct.BrownConrady([50.0, 50.0, 31.5, 23.5], [-0.1, 0.01, 0.0, 0.0], image_size=SIZE),
        ct.BrownConrady([50.0, 51.0, 31.5, 23.5], [-0.1, 0.01, 0.0, 0.0, 0.001], image_size=SIZE),
        ct.BrownConrady([52.0, 50.0, 31.5, 23.5], [-0.1, 0.01, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0], image_size=SIZE),
        ct.KannalaBrandt([30.0, 30.0, 31.5, 23.5], [0.02, -0.01, 0.003, -0.001], image_size=SIZE),
        ct.KannalaBrandt([31.0, 30.0, 31.5, 23.5], [0.01, -0.01, 0.003, -0.001], image_size=SIZE),
    ]
    return [camera.requires_grad_(learns) for camera in cameras]


def same(batch, cameras):
    """Whether a batch is of the same numbers as cameras, one by one."""
    return len(batch) == len(cameras) and all(
        type(one) is type(other) and all(map(torch.equal, tensors(one), tensors(other)))
        for one, other in zip(batch, cameras, strict=True)
    )


@pytest.mark.parametrize("edit", [edit for edit, *_ in EDITS.values()])
def test_edits_are_those_of_each_camera_and_gradients_go_there(edit):
    cameras = models()
    edited = edit(ct.Mixed(cameras))
    assert isinstance(edited, ct.Mixed)
    assert edited.image_size == edit(cameras[0]).image_size
    assert same(edited, [edit(camera) for camera in cameras])
    edited.intrinsics.sum().backward()
    assert all((camera.intrinsics.grad != 0).all() for camera in cameras)
    assert not any(p.requires_grad for p in edit(ct.Mixed(models(learns=False))).parameters())


def test_parts_and_members():
    cameras = models()
    mixed = ct.Mixed(cameras)
    assert (len(mixed), mixed.batch_shape) == (6, (6,))
    assert mixed[4] is cameras[4]
    assert mixed[-1] is cameras[5]
    assert list(mixed) == cameras
    for index in (slice(1, 5), [5, 0, 0], torch.tensor([1, 3]), torch.tensor([True] + [False] * 4 + [True])):
        rows = torch.arange(6)[index].tolist()
        part = mixed[index]
        assert isinstance(part, ct.Mixed)
        assert list(part) == [cameras[row] for row in rows]
        points = torch.randn(len(rows), 4, 3)
        assert torch.equal(part.project(points)[0][0], cameras[rows[0]].project(points[0])[0])
    assert "1 Pinhole(), 1 BrownConrady(k1 k2 p1 p2), 1 BrownConrady(k1 k2 p1 p2 k3)" in repr(mixed)
    assert "2 KannalaBrandt(k1 k2 k3 k4), image_size=(48, 64)" in repr(mixed)
    assert [rows for rows, _ in mixed.groups] == [[0], [1], [2], [3], [4, 5]]
    assert torch.equal(mixed.K[4], cameras[4].K)
    assert torch.equal(mixed.field_of_view[4], cameras[4].field_of_view)
    wide = ct.Mixed([cameras[0], models()[4].double()])
    assert wide.project(torch.randn(2, 3, 3))[0].dtype == torch.float64


def test_batches_mixed_batches_and_orders_among_the_cameras():
    cameras = models()
    intrinsics = torch.stack([c.intrinsics.detach() for c in cameras[4:]])
    batch = ct.KannalaBrandt(intrinsics, cameras[4].distortion.detach(), image_size=SIZE)
    mixed = ct.Mixed([cameras[0], batch, ct.Mixed([cameras[1]])])
    points = torch.randn(4, 7, 3)
    pixels, _ = mixed.project(points)
    assert torch.equal(pixels[1], cameras[4].project(points[1])[0])
    assert torch.equal(pixels[1:3], batch.project(points[1:3])[0])
    turned = ct.Mixed([cameras[0], batch, cameras[1]], order=[3, 2, 1, 0])
    assert torch.equal(turned.project(points.flip(0))[0], pixels.flip(0))
    assert torch.equal(mixed[torch.tensor([3, 2, 1, 0])].intrinsics, turned.intrinsics)
    again = ct.Mixed.of_groups(turned.groups)
    assert torch.equal(again.project(points)[0], turned.project(points)[0])


def test_it_is_a_module():
    mixed, points = ct.Mixed(models()), torch.randn(6, 3, 3)
    expected = mixed(points)[0]
    other = ct.Mixed(models())
    other[4].intrinsics.data += 1
    other.load_state_dict(mixed.state_dict())
    for twin in (other, copy.deepcopy(mixed), pickle.loads(pickle.dumps(mixed))):
        assert torch.equal(twin(points)[0], expected)
        twin[0].intrinsics.data += 1
    assert torch.equal(mixed(points)[0], expected)
    assert other.double()(points)[0].dtype == torch.float64
    assert other.half()[0].intrinsics.dtype == torch.float64  # never of less than float32
    doubled = {name: 2 * value for name, value in mixed.state_dict().items() if "intrinsics" in name}
    called = torch.func.functional_call(mixed, doubled, (points,))[0]
    valid = mixed(points)[1]
    assert torch.allclose(called[valid], 2 * expected[valid])
    assert mixed.to("meta").project(points.to("meta"))[0].shape == (6, 3, 2)


@pytest.mark.slow
def test_compiled_where_the_groups_are_fixed():
    mixed, images = ct.Mixed([models(learns=False)[i] for i in (4, 0, 5)]), torch.rand(3, 3, *SIZE)
    augment = ct.augment.RandomMount(yaw=2, pitch=2, roll=2, p=0.5)
    draw, points = augment.draw(3), torch.randn(3, 3, 3)

    def step(images):
        moved = augment(image=images, camera=mixed, draw=draw)
        return moved["image"], moved["camera"].rays(stride=8)[0], mixed.project(points)[0]

    for now, then in zip(torch.compile(step, fullgraph=True, backend="eager")(images), step(images), strict=True):
        assert torch.allclose(now, then, atol=1e-4)


@pytest.mark.parametrize("p", [1.0, 0.5])
def test_augmented_as_a_list_of_cameras_is(p):
    cameras, images = models(learns=False), torch.rand(6, 3, *SIZE)
    fields = {"image": images, "keypoints": torch.rand(6, 4, 2) * 40, "gaze": torch.randn(6, 3)}
    for augment in (
        ct.augment.Compose([ct.augment.RandomResizedCrop(SIZE, p=p), ct.augment.HorizontalFlip(p=p)]),
        ct.augment.RandomCamera(yaw=3, pitch=3, roll=3, p=p, min_filled=0.8),
        ct.augment.RandomLens("kannala_brandt", fov=(80, 90), p=p, min_filled=0),
    ):
        draw = augment.draw(6)
        listed = augment(**fields, camera=cameras, draw=draw)
        mixed = augment(**fields, camera=ct.Mixed(cameras), draw=draw)
        assert isinstance(mixed["camera"], ct.Mixed)
        assert same(mixed["camera"], listed["camera"])
        for name in ("image", "keypoints", "keypoints_valid", "gaze", "rotation"):
            assert torch.equal(mixed[name], listed[name]), name
        back = augment.inverse(mixed)
        assert same(back["camera"], cameras)
        assert (back["gaze"] - fields["gaze"]).abs().max() < 1e-5


def test_a_bad_row_is_invalid_and_its_camera_says_so():
    cameras = models()
    mixed = ct.Mixed(cameras)
    cameras[5].intrinsics.data[0] = -1
    with pytest.warns(UserWarning, match="intrinsics became unusable"):
        pixels, valid = mixed.project(torch.ones(6, 2, 3))
    assert not valid[5].any()
    assert valid[:5].all()
    assert torch.isfinite(pixels).all()
    mixed.project(torch.ones(6, 2, 3))  # once
