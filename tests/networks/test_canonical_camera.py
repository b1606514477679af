"""`CanonicalCamera`: images or depth as by cameras of one focal length, and back."""

import pytest
import torch

import camtorch as ct

SIZE = (48, 64)
F64 = {"dtype": torch.float64}


def camera(key="kannala_brandt", focal=40.0):
    lenses = {"pinhole": (), "kannala_brandt": ([0.02, -0.01, 0.0, 0.0],)}
    lenses |= {"brown_conrady": ([-0.1, 0.02, 0.001, -0.001],), "double_sphere": ([-0.2, 0.6],)}
    intrinsics = torch.tensor([focal, 1.1 * focal, 30.0, 25.0], **F64)
    coefficients = (torch.tensor(k, **F64) for k in lenses[key])
    return ct.MODELS[key](intrinsics, *coefficients, image_size=SIZE).requires_grad_(False)


def sample(**more):
    generator = torch.Generator().manual_seed(0)
    pose = torch.eye(4, **F64).repeat(3, 1, 1)
    pose[:, :3, 3] = torch.tensor([0.1, 0.2, 2.0], **F64)
    return {
        "image": torch.rand(3, 3, *SIZE, generator=generator, **F64),
        "depth": 1 + torch.rand(3, 1, *SIZE, generator=generator, **F64),
        "distance": 1 + torch.rand(3, *SIZE, generator=generator, **F64),
        "points": torch.randn(3, 5, 3, generator=generator, **F64) + torch.tensor([0.0, 0, 4], **F64),
        "gaze": torch.tensor([[0.0, 0.6, -0.8]], **F64).expand(3, 3),
        "head_pose": pose,
        "keypoints": 40 * torch.rand(3, 4, 2, generator=generator, **F64),
        **more,
    }


@pytest.mark.parametrize("key", ["pinhole", "kannala_brandt", "brown_conrady", "double_sphere"])
def test_the_focal_length_is_that_of_the_axis(key):
    one = camera(key)
    canonical = ct.CanonicalCamera(100.0)
    small = 1e-6
    ends = one.project(torch.tensor([[0.0, 0, 1], [small, 0, 1], [0, small, 1]], **F64))[0]
    slopes = (ends[1:] - ends[0]).norm(dim=-1) / small
    assert canonical.scale(one).item() == pytest.approx(100 / slopes.prod().sqrt().item(), rel=1e-6)


def test_depth_is_scaled_and_the_same_camera_sees_the_same():
    one, before = camera(), sample()
    canonical = ct.CanonicalCamera(100.0)
    after = canonical(before, camera=one)
    scale = 100 / (40 * 1.1**0.5)
    for name in ("depth", "distance", "points"):
        torch.testing.assert_close(after[name], scale * before[name])
    torch.testing.assert_close(after["head_pose"][:, :3, 3], scale * before["head_pose"][:, :3, 3])
    assert torch.equal(after["head_pose"][:, :3, :3], before["head_pose"][:, :3, :3])
    for name in ("image", "gaze", "keypoints"):
        assert torch.equal(after[name], before[name])
    assert after["camera"] is one
    torch.testing.assert_close(one.project(after["points"].flatten(0, 1)), one.project(before["points"].flatten(0, 1)))
    torch.testing.assert_close(after["scale"], torch.full((3,), scale, **F64))
    back = canonical.inverse(after)
    assert "scale" not in back
    for name, value in before.items():
        torch.testing.assert_close(back[name], value, rtol=1e-15, atol=0)


def test_images_are_scaled_to_exactly_that_focal_length():
    one, before = camera(), sample()
    canonical = ct.CanonicalCamera(60.0, scales="image")
    after = canonical(before, camera=one)
    scale = 60 / (40 * 1.1**0.5)
    new = after["camera"]
    assert new.image_size == (round(48 * scale), round(64 * scale)) == tuple(after["image"].shape[-2:])
    torch.testing.assert_close((new.fx * new.fy).sqrt(), torch.full((3,), 60.0, **F64))
    assert torch.equal(new.distortion, one.distortion.expand(3, -1))
    torch.testing.assert_close(after["points"], before["points"])
    assert after["depth"].shape[-2:] == new.image_size
    seen, _ = one.unproject(before["keypoints"].flatten(0, 1))
    torch.testing.assert_close(new.project(seen.view(3, 4, 3))[0], after["keypoints"])
    inside = after["depth"][..., 2:-2, 2:-2]
    assert 1 <= inside.min() <= inside.max() <= 2
    back = canonical.inverse(after)
    torch.testing.assert_close(back["keypoints"], before["keypoints"], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(back["camera"].intrinsics, one.intrinsics.expand(3, 4), rtol=1e-12, atol=1e-12)
    assert back["image"].shape == before["image"].shape
    assert "source_camera" not in back


def test_what_a_network_predicts_comes_back():
    one = camera(focal=100.0)
    canonical = ct.CanonicalCamera(50.0, scales="image", image_size=(32, 32))
    after = canonical(image=torch.rand(3, *SIZE, **F64), camera=one)
    assert after["image"].shape == (3, 32, 32)
    predicted = torch.full((32, 32), 3.0, **F64)
    back = canonical.inverse(depth=predicted, source_camera=after["source_camera"])
    assert back["depth"].shape == SIZE
    assert back["depth"][24, 32] == 3.0
    labels = ct.CanonicalCamera(50.0)
    back = labels.inverse(depth=torch.full(SIZE, 3.0, **F64), camera=one)
    torch.testing.assert_close(back["depth"], torch.full(SIZE, 3 * 2 * 1.1**0.5, **F64))


@pytest.mark.parametrize("scales", ["depth", "image"])
@pytest.mark.parametrize("kind", ["batch", "mixed", "list"])
def test_batches_of_cameras(scales, kind):
    keys = ["kannala_brandt"] * 3 if kind == "batch" else ["pinhole", "double_sphere", "pinhole"]
    cameras = [camera(key, focal) for key, focal in zip(keys, (30.0, 40.0, 55.0), strict=True)]
    several = cameras
    if kind == "batch":
        numbers = (torch.stack([getattr(c, name) for c in cameras]) for name in ("intrinsics", "distortion"))
        several = ct.KannalaBrandt(*numbers, image_size=SIZE).requires_grad_(False)
    elif kind == "mixed":
        several = ct.Mixed(cameras)
    canonical = ct.CanonicalCamera(50.0, scales=scales, image_size=(40, 40) if scales == "image" else None)
    before = sample()
    after = canonical(before, camera=several)
    for i, one in enumerate(cameras):
        alone = canonical({name: value[i] for name, value in before.items()}, camera=one)
        for name in before:
            torch.testing.assert_close(after[name][i], alone[name])
        torch.testing.assert_close(after["camera"][i].intrinsics, alone["camera"].intrinsics)
        torch.testing.assert_close(after["scale"][i], alone["scale"])
    back = canonical.inverse(after)
    torch.testing.assert_close(back["points"], before["points"])
    torch.testing.assert_close(back["keypoints"], before["keypoints"])


def test_gradients_reach_a_predicted_focal_length():
    head = ct.CameraHead(2, ct.Pinhole, image_size=SIZE)
    cameras = head(torch.ones(3, 2))
    depth = ct.CanonicalCamera(50.0).inverse(depth=torch.ones(3, 1, *SIZE), camera=cameras)["depth"]
    depth.mean().backward()
    assert head.linear.weight.grad[0].abs().min() > 0
