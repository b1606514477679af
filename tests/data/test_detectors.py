"""Detectors' results: landmarks in their own conventions come out in ours, of faces that were and were not found."""

import json
from pathlib import Path
from types import SimpleNamespace as Result

import numpy as np
import pytest
import torch

import camtorch as ct

SIZE = (200, 300)
STORED = json.loads((Path(__file__).parents[1] / "files" / "detected_faces.json").read_text())


def mesh(faces, size=SIZE):
    parts = (faces + 0.5) / torch.tensor([size[1], size[0]])
    return [Result(landmark=[Result(x=x, y=y, z=0.0) for x, y in face]) for face in parts.tolist()]


def shape(points, box):
    parts = [Result(x=round(x), y=round(y)) for x, y in points.tolist()]
    sides = zip(("left", "top", "right", "bottom"), map(round, box), strict=True)
    rectangle = Result(**{name: lambda value=value: value for name, value in sides})
    return Result(part=parts.__getitem__, num_parts=len(parts), rect=rectangle)


def insight(points, boxes, name):
    none = {"landmark_2d_106": None, "landmark_3d_68": None, "kps": np.zeros((5, 2)), "pose": None}
    deep = torch.cat((points, torch.ones(*points.shape[:2], int("3d" in name))), -1).numpy()
    return [Result(**none | {"bbox": b.numpy() + 0.5, name: p}) for p, b in zip(deep, boxes, strict=True)]


def yolo(points, boxes):
    keypoints = Result(xy=points + 0.5, conf=torch.ones(points.shape[:2]))
    return [Result(boxes=Result(xyxy=boxes + 0.5), keypoints=keypoints)]


# name -> the number of landmarks, that of no face, what the detector gives of points and boxes, and the reader
DETECTORS = {
    "face_mesh": (468, 478, lambda p, b: Result(multi_face_landmarks=mesh(p) or None), "mediapipe"),
    "FaceLandmarker": (478, 478, lambda p, b: Result(face_landmarks=[f.landmark for f in mesh(p)]), "mediapipe"),
    "holistic": (478, 478, lambda p, b: Result(face_landmarks=(mesh(p)[:1] or [None])[0]), "mediapipe"),
    "insightface106": (106, 0, lambda p, b: insight(p, b, "landmark_2d_106"), "insightface"),
    "insightface68": (68, 0, lambda p, b: insight(p, b, "landmark_3d_68"), "insightface"),
    "insightface5": (5, 0, lambda p, b: insight(p + 0.5, b, "kps"), "insightface"),
    "ultralytics": (17, 17, yolo, "ultralytics"),
    "dlib": (68, 0, lambda p, b: list(map(shape, p, b.tolist())), "dlib"),
}


def read(result, reader, size=SIZE):
    return getattr(ct.data, f"from_{reader}")(result, *[size] * (reader == "mediapipe"))


@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("name", DETECTORS)
def test_pixels_count_from_the_middle_of_the_first_one(name, count):
    number, unknown, given, reader = DETECTORS[name]
    count = min(count, 1) if name == "holistic" else count
    points = torch.randint(0, 200, (count, number, 2), generator=torch.Generator().manual_seed(0)).float()
    boxes = torch.cat((points.amin(1), points.amax(1)), -1)
    with torch.inference_mode():
        result = given(points, boxes)
    fields = read(result, reader)
    torch.testing.assert_close(fields["keypoints"], points if count else torch.zeros(0, unknown, 2), atol=1e-3, rtol=0)
    torch.testing.assert_close(fields["boxes"], boxes, atol=1e-3, rtol=0)
    assert fields.get("keypoints_valid", torch.tensor(True)).all()
    table = {"landmarks": name} if name == "insightface106" else {}
    flip = ct.augment.HorizontalFlip(p=1.0, **table or {"landmarks": {}})
    moved = flip(image=torch.zeros(3, *SIZE), **fields)
    order = ct.augment.LANDMARKS[name] if table and count else range(fields["keypoints"].shape[1])
    torch.testing.assert_close(moved["keypoints"][..., 0], 299 - fields["keypoints"][:, list(order), 0])


def stored(detector, of):
    """Return what a detector found in a photograph, or in its mirror image, and the name of its landmarks."""
    size, points = STORED["image_size"], torch.tensor(STORED[of][detector])
    if detector == "dlib":
        return ct.data.from_dlib(shape(points, STORED[of]["rectangle"])), "ibug68"
    whole = points * torch.tensor([size[1], size[0]])
    return ct.data.from_mediapipe(Result(multi_face_landmarks=mesh(whole[None] - 0.5, size)), size), "mediapipe478"


@pytest.mark.parametrize("detector", ["mediapipe", "dlib"])
def test_a_mirrored_photograph_has_mirrored_landmarks_and_heads(detector):
    (fields, name), (mirrored, _) = (stored(detector, of) for of in ("photograph", "mirrored"))
    flip = ct.augment.HorizontalFlip(p=1.0, landmarks=name)
    moved = flip(image=torch.zeros(3, *STORED["image_size"]), **fields)
    away = (moved["keypoints"] - mirrored["keypoints"]).norm(dim=-1)
    width = float(fields["boxes"][0, 2] - fields["boxes"][0, 0])
    assert away.mean() < 0.02 * width
    camera = ct.Pinhole.from_fov(20, image_size=STORED["image_size"]).requires_grad_(False)
    face = ct.augment.face_points(name)
    weights = torch.ones(len(face)).index_fill(0, torch.arange(17 if detector == "dlib" else 0), 0.1)
    poses = [ct.solve_pnp(camera, face, one["keypoints"][0], weights=weights) for one in (fields, moved, mirrored)]
    assert max(pose.rms for pose in poses) < 0.05 * width
    angles = torch.rad2deg(torch.stack([ct.head_angles(pose) for pose in poses]))
    torch.testing.assert_close(angles[1], angles[0] * angles.new_tensor([1.0, -1.0, -1.0]), atol=0.01, rtol=0)
    torch.testing.assert_close(angles[2], angles[1], atol=4, rtol=0)
    torch.testing.assert_close(angles[0], angles.new_tensor([-11.0, 0.0, 3.0]), atol=3, rtol=0)  # of either detector


@pytest.mark.parametrize("wrong", [None, 3, "faces", [Result(x=1)], Result(detections=[]), torch.zeros(2, 3)], ids=repr)
@pytest.mark.parametrize("reader", ["mediapipe", "insightface", "ultralytics", "dlib"])
def test_what_no_detector_gave_is_refused(reader, wrong):
    with pytest.raises(TypeError, match=rf"from_{reader}: \w+ must .*; got "):
        read(wrong, reader)
    with pytest.raises(ValueError, match=r"results must be of one image; got 2"):
        ct.data.from_ultralytics(2 * yolo(torch.zeros(1, 17, 2), torch.zeros(1, 4)))
