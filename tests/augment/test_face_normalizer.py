"""The data normalisation of gaze estimation, against the published formulas."""

import json
from pathlib import Path

import pytest
import torch
from cameras import spread

import camtorch as ct
from camtorch.augment import FaceNormalizer
from camtorch.poses.rotations import rotation_vector

SIZE = (240, 320)


def published(camera_matrix, centre, head, focal, distance, size):
    """R and W of Zhang, Sugano, Bulling (ETRA 2018), as the code of ETH-XGaze writes them."""
    length = centre.norm()
    scale = distance / length
    normal = torch.tensor([[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1]], dtype=centre.dtype)
    forward = centre / length
    down = torch.linalg.cross(forward, head[:, 0])
    down = down / down.norm()
    right = torch.linalg.cross(down, forward)
    rotation = torch.stack((right / right.norm(), down, forward))
    stretch = torch.diag(torch.stack((torch.ones_like(scale), torch.ones_like(scale), scale)))
    return rotation, normal @ stretch @ rotation @ torch.linalg.inv(camera_matrix), scale


def batch(count=3, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(*shape, generator=generator, dtype=dtype) - 0.5

    pose = ct.Extrinsics(0.8 * rand(count, 3), 0.2 * rand(count, 3) + torch.tensor([0.0, 0, 0.65])).matrix().detach()
    gaze = torch.nn.functional.normalize(rand(count, 3) - torch.tensor([0.0, 0, 1.5]), dim=-1)
    return {"head_pose": pose, "gaze": gaze, "points": pose[:, None, :3, 3] + 0.1 * rand(count, 5, 3)}


@pytest.fixture
def pinhole():
    intrinsics = torch.tensor([300.0, 305.0, 161.0, 118.5], dtype=torch.float64)
    return ct.Pinhole(intrinsics, image_size=SIZE).requires_grad_(False)


def test_a_pinhole_is_normalised_as_published(pinhole):
    """An image of the coordinates holds, after the warp, W^-1 of every pixel."""
    sample = batch()
    v, u = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) for side in SIZE), indexing="ij")
    sample["image"] = torch.stack((u, v)).expand(3, -1, -1, -1)
    sample["keypoints"] = pinhole.project(sample["points"])[0]
    normalizer = FaceNormalizer(camera=pinhole, focal=600.0, distance=0.6, image_size=(96, 128))
    out = normalizer(sample)
    assert out["image"].shape == (3, 2, 96, 128)
    v, u = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) for side in (96, 128)), indexing="ij")
    grid = torch.stack((u, v, torch.ones_like(u)), -1)
    for i in range(3):
        pose = sample["head_pose"][i]
        rotation, homography, scale = published(pinhole.K, pose[:3, 3], pose[:3, :3], 600.0, 0.6, (96, 128))
        torch.testing.assert_close(out["rotation"][i], rotation)
        torch.testing.assert_close(out["scale"][i], scale)
        source = grid @ torch.linalg.inv(homography).T
        source = source[..., :2] / source[..., 2:]
        inside = (source > 0).all(-1) & (source < torch.tensor([SIZE[1] - 1, SIZE[0] - 1])).all(-1)
        assert inside.float().mean() > 0.5
        difference = (out["image"][i].movedim(0, -1) - source).norm(dim=-1)[inside]
        assert difference.max() < 0.01  # the map is from a lattice: a thousandth of a pixel
        moved = torch.cat((sample["keypoints"][i], torch.ones(5, 1, dtype=torch.float64)), -1) @ homography.T
        torch.testing.assert_close(out["keypoints"][i], moved[:, :2] / moved[:, 2:], atol=1e-8, rtol=0)
        torch.testing.assert_close(out["gaze"][i], rotation @ sample["gaze"][i], atol=1e-12, rtol=0)


@pytest.mark.parametrize("key", ["pinhole", "kannala_brandt", "fisheye624"])
def test_faces_come_to_lie_as_theory_says(key):
    """The face's centre in the middle, the head's x axis level, the size as from the wanted distance, for any lens."""
    camera, sample = spread(key).requires_grad_(False), batch()
    eyes = torch.tensor([[-0.032, 0, 0], [0.032, 0, 0]], dtype=torch.float64)  # of the head frame
    pose = sample["head_pose"]
    eyes = eyes @ pose[:, :3, :3].mT + pose[:, None, :3, 3]
    sample["points"] = torch.cat((pose[:, None, :3, 3], eyes), 1)
    sample["keypoints"] = camera.project(sample["points"])[0]
    out = FaceNormalizer(camera=camera, focal=960.0, distance=0.6)(sample)
    centre = out["keypoints"][:, 0]
    torch.testing.assert_close(centre, torch.full_like(centre, 112.0), atol=1e-6, rtol=0)
    across = out["rotation"] @ (eyes[:, 1] - eyes[:, 0])[..., None]
    assert across[:, 1].abs().max() < 1e-12
    # as a pinhole of that focal length sees the turned eyes after S = diag(1, 1, scale)
    turned = torch.einsum("bij,bnj->bni", out["rotation"], eyes)
    seen = 960 * turned[..., :2] / (turned[..., 2:] * out["scale"][:, None, None]) + 112
    torch.testing.assert_close(out["keypoints"][:, 1:], seen, atol=1e-6, rtol=0)
    projected, valid = out["camera"].project(out["points"])
    torch.testing.assert_close(projected, out["keypoints"], atol=1e-6, rtol=0)
    assert valid.all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_predictions_go_back(dtype):
    camera = spread("kannala_brandt", dtype).requires_grad_(False)
    sample = {name: value.to(dtype) for name, value in batch().items()}
    sample["keypoints"] = camera.project(sample["points"])[0]
    normalizer = FaceNormalizer(camera=camera, distance=0.6)
    out = normalizer(sample)
    one = normalizer({name: value[0] for name, value in sample.items()})
    torch.testing.assert_close(one["gaze"], out["gaze"][0])
    assert one["scale"].shape == ()
    limits = {"gaze": 1e-6, "points": 1e-6, "keypoints": 1e-3 if dtype == torch.float32 else 1e-9}
    for moved, given in ((out, sample), (one, {name: value[0] for name, value in sample.items()})):
        back = normalizer.inverse({name: value for name, value in moved.items() if name != "head_pose"})
        for name, atol in limits.items():
            torch.testing.assert_close(back[name], given[name], atol=atol, rtol=0)
        assert "rotation" not in back


def test_rotation_vectors_and_a_face_centre_of_its_own(pinhole):
    sample = batch()
    pose = ct.Extrinsics.from_matrix(sample["head_pose"])
    normalizer = FaceNormalizer(camera=pinhole, distance=0.6)
    by_matrix = normalizer(sample)
    vectors = {"rvec": pose.rotation.detach(), "tvec": pose.translation.detach(), "gaze": sample["gaze"]}
    by_vector = normalizer(vectors)
    torch.testing.assert_close(by_vector["rotation"], by_matrix["rotation"])
    turned = ct.Extrinsics(by_vector["rvec"], by_vector["tvec"]).matrix()
    torch.testing.assert_close(turned, by_matrix["head_pose"])
    centre = sample["head_pose"][:, :3, 3] + torch.tensor([0.0, 0.03, 0.0], dtype=torch.float64)
    aside = normalizer({**sample, "face_center": centre})
    straight = torch.einsum("bij,bj->bi", aside["rotation"], centre)
    torch.testing.assert_close(straight[:, :2], torch.zeros(3, 2, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(aside["face_center"], straight)


def test_what_cannot_be_normalised_says_why(pinhole):
    normalizer, sample = FaceNormalizer(camera=pinhole), batch()
    sample["head_pose"][0, :3, 3] = 0
    for call, text in (
        (lambda: normalizer(gaze=torch.rand(2, 3)), r"must have head_pose, or rvec and tvec; got gaze"),
        (lambda: normalizer(sample), "off the camera"),
        (lambda: normalizer(head_pose=torch.rand(2, 3)), r"head_pose must be .*; got shape \(2, 3\)"),
        (lambda: normalizer(batch()), "in the unit of the poses; .* distance=0.* distance=600"),
        (lambda: FaceNormalizer(distance=-1), "distance must be positive; got -1"),
        (lambda: normalizer.inverse(gaze=torch.rand(2, 3)), "must have camera, rotation, source_camera"),
    ):
        with pytest.raises(ValueError, match=text):
            call()


@pytest.mark.parametrize("name", ["ibug68", "wflw98", "lapa106", "insightface106", "mediapipe468", "mediapipe478"])
def test_the_generic_face_is_symmetric_and_of_the_size_of_a_face(name):
    points, mirror = ct.augment.face_points(name), torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(points[list(ct.augment.LANDMARKS[name])] * mirror, points, atol=1e-12, rtol=0)
    torch.testing.assert_close(points[:, 0].aminmax().max.item(), 0.077, atol=1e-3, rtol=0)
    for axis, extreme, place in ((2, 0, [0, 0.031, -0.048]), (1, 1, [0, 0.12, -0.014])):  # the nose's tip, the chin
        found = points[points[:, axis].aminmax()[extreme] == points[:, axis]]
        torch.testing.assert_close(found, points.new_tensor([place]), atol=1e-3, rtol=0)
    camera = ct.Pinhole.from_fov(40, image_size=(480, 640)).double()
    pose = ct.solve_pnp(camera, points, camera.project(points + torch.tensor([0.0, 0.02, 0.6]))[0])
    assert ct.head_angles(pose).abs().max() < 1e-6


@pytest.mark.parametrize("name", ["ibug68", "wflw98", "lapa106"])
def test_the_generic_face_lies_on_the_mean_face(name):
    mean = torch.tensor(json.loads((Path(__file__).parents[1] / "files" / "mean_faces.json").read_text())[name])
    front = torch.nn.functional.pad(ct.augment.face_points(name)[:, :2], (0, 1), value=1.0).float()
    away = (front @ torch.linalg.lstsq(front, mean).solution - mean).norm(dim=1)
    assert away.max() < 0.08
    assert away.mean() < 0.035


def test_insightface_by_the_landmarks_that_ibug_has():
    order = [43, 48, 49, 51, 50, 102, 103, 104, 105, 101, 72, 73, 74, 86, 78, 79, 80, 85, 84, 35, 41, 42, 39, 37, 36]
    order += [89, 95, 96, 93, 91, 90, 52, 64, 63, 71, 67, 68, 61, 58, 59, 53, 56, 55, 65, 66, 62, 70, 69, 57, 60, 54]
    assert torch.equal(ct.augment.face_points("insightface106")[order], ct.augment.face_points()[17:])
    assert [ct.augment.LANDMARKS["insightface106"][i] for i in (0, 1, 9, 16, 2, 44, 33)] == [0, 17, 25, 32, 18, 100, 87]


def test_a_pose_has_any_name_that_fields_give(pinhole):
    given, options = batch(), {"camera": pinhole, "focal": 600.0, "distance": 0.6}
    want = FaceNormalizer(**options)(given)
    out = FaceNormalizer(**options, fields={"head": "head_pose"})(head=given["head_pose"], gaze=given["gaze"])
    for name, other in (("head", "head_pose"), ("gaze", "gaze"), ("scale", "scale"), ("rotation", "rotation")):
        assert torch.equal(out[name], want[other])
    vectors = {"turn": rotation_vector(given["head_pose"][:, :3, :3]), "at": given["head_pose"][:, :3, 3]}
    out = FaceNormalizer(**options, fields={"turn": "rvec", "at": "tvec"})(vectors)
    torch.testing.assert_close(out["rotation"], want["rotation"])
    beside = {"head_pose": given["head_pose"], "head_pose_before": given["head_pose"].flip(0)}
    assert torch.equal(FaceNormalizer(**options)(beside)["rotation"], want["rotation"])
