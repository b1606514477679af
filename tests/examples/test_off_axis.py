"""What a network loses off the axis: exact ones are right by `look_at`, and off by the angle in plain crops."""

import math
import sys
from types import SimpleNamespace

import numpy as np
import off_axis_faces
import pytest
import stress_test
import torch
from PIL import Image

import camtorch as ct

LENS = ct.KannalaBrandt.from_fov(150, image_size=(900, 1200)).double().requires_grad_(False)


def marker(path):
    """A photograph of three coloured discs: the first left, the second right, the third below."""
    y, x = np.mgrid[:240, :240].astype(float)
    image = np.full((240, 240, 3), 60.0)
    for channel, centre in enumerate([(80, 110), (160, 110), (120, 165)]):
        disc = np.clip(18.5 - np.hypot(x - centre[0], y - centre[1]), 0, 1)
        image[..., channel] += 180 * disc
    Image.fromarray(image.astype(np.uint8)).save(path)


def discs(images):
    """What a network would give that finds the discs, of a marker that looks into its camera."""
    images = images.float()
    side = torch.arange(images.shape[-1]).double()
    middle = images.sum(1, keepdim=True) - images.amax(1, keepdim=True) - images.amin(1, keepdim=True)
    weight = (images - middle - 5).clamp(min=0)
    weight = weight / weight.sum((2, 3), keepdim=True)
    landmarks = torch.stack(((weight.sum(2) * side).sum(-1), (weight.sum(3) * side).sum(-1)), -1)
    x, y = (landmarks[:, 1] - landmarks[:, 0]).unbind(-1)
    cos, sin, zero = x / torch.hypot(x, y), y / torch.hypot(x, y), 0 * x
    rotation = torch.stack((cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1), -1).view(-1, 3, 3)
    boxes = torch.cat((landmarks.amin(1), landmarks.amax(1)), -1)
    return {"rotation": rotation, "gaze": -rotation[..., 2], "landmarks": landmarks, "boxes": boxes}


def test_an_exact_network_is_right_by_look_at_and_off_by_the_angle_in_plain_crops(tmp_path, capsys):
    marker(tmp_path / "marker.png")
    camera, script, figure = (str(tmp_path / name) for name in ("camera.json", "predict.py", "stress.png"))
    ct.save(LENS, camera)
    (tmp_path / "predict.py").write_text("from test_off_axis import discs as predict")
    results = stress_test.main(script, str(tmp_path), camera, fov=12, out=figure)
    for angle in (15, 30, 45, 60):
        for kind in ("rotation", "gaze"):
            plain, ray, look = (results[kind, angle, way] for way in stress_test.WAYS)
            assert len(plain) == len(look) == (4 if angle < 60 else 2)  # the image is 112 degrees high
            assert np.allclose(plain, angle, atol=0.5)
            assert max(ray) < 0.5
            assert max(look) < 0.5
        assert max(results["landmarks", angle, "plain"] + results["landmarks", angle, "look_at"]) < 0.5
        assert max(results["shape", angle, "look_at"]) < 0.3
        assert max(results["boxes", angle, "look_at"]) < 5
    assert min(results["shape", 60, "plain"]) > 5 * max(results["shape", 60, "look_at"])
    assert max(results["rotation", stress_test.REPEATED, "look_at"]) < 1
    told = capsys.readouterr().out
    assert "rotation: loses" in told
    assert "with BoxCrop" in told
    with Image.open(figure) as image:
        assert np.asarray(image.convert("RGB")).std() > 20


@pytest.mark.slow
def test_a_box_tells_where_the_thing_is(tmp_path):
    marker(tmp_path / "marker.png")
    (photograph,) = stress_test.photographs([tmp_path / "marker.png"], 12, {"marker.png": [50, 60, 190, 200]})
    results = stress_test.study(discs, [photograph], LENS)
    assert max(results["rotation", 45, "look_at"]) < 0.5
    with pytest.raises(ValueError, match=r"one of each photograph; got none of 'marker\.png'"):
        stress_test.photographs([tmp_path / "marker.png"], 12, {})


@pytest.mark.slow
def test_a_thing_that_is_not_found_is_counted(tmp_path):
    marker(tmp_path / "marker.png")
    things = stress_test.photographs([tmp_path / "marker.png"], 12, None)

    def seldom(images):
        found = discs(images)["rotation"]
        found[1::2] = math.nan  # the reference is alone
        return {"rotation": found}

    results = stress_test.study(seldom, things, LENS)
    assert sum(results[stress_test.FOUND, 30, "plain"]) == 4 == len(results["rotation", 30, "ray"])
    assert results[stress_test.FOUND, 30, "look_at"] == [False] * 4
    assert results["rotation", 30, "look_at"] == []
    with pytest.raises(ValueError, match="must find a thing in a photograph"):
        stress_test.study(lambda images: {"gaze": torch.full((len(images), 3), math.nan)}, things, LENS)
    for wrong, words in (
        ({}, "must have some of rotation, gaze"),
        ({"gaze": torch.ones(2, 3)}, r"gaze must be \(1, 3\)"),
    ):
        with pytest.raises(ValueError, match=words):
            stress_test.study(lambda images, wrong=wrong: wrong, things, LENS)


HEAD = ct.Extrinsics([0.1, -0.2, 0.05], [0.01, 0.02, 0.6]).double()


@pytest.fixture
def landmarker(monkeypatch):
    """A MediaPipe that finds one head in square images, always the same."""
    flip = torch.diag(torch.tensor([1.0, -1, -1]).double())
    camera = ct.Pinhole.from_fov(25, image_size=stress_test.SIZE).double()
    pixels = camera.project(HEAD(ct.augment.face_points("mediapipe478")))[0].detach()
    points = [SimpleNamespace(x=(x + 0.5) / 512, y=(y + 0.5) / 512) for x, y in pixels.tolist()]
    matrix = torch.eye(4).double()
    matrix[:3, :3] = 1.01 * (flip @ HEAD.matrix()[:3, :3].detach() @ flip)  # scaled, in a frame of y up and z back
    found = SimpleNamespace(face_landmarks=[points], facial_transformation_matrixes=[matrix.numpy()])
    nothing = SimpleNamespace(face_landmarks=[], facial_transformation_matrixes=[])

    def create(options):
        assert options.output_facial_transformation_matrixes
        assert options.base_options.model_asset_path.endswith("face_landmarker.task")
        return SimpleNamespace(detect=lambda image: found if image.data.shape == (512, 512, 3) else nothing)

    vision = SimpleNamespace(
        FaceLandmarkerOptions=SimpleNamespace, FaceLandmarker=SimpleNamespace(create_from_options=create)
    )
    library = SimpleNamespace(
        tasks=SimpleNamespace(vision=vision, BaseOptions=SimpleNamespace),
        Image=SimpleNamespace, ImageFormat=SimpleNamespace(SRGB=1),
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "mediapipe", library)


def test_the_script_of_the_docstring_is_the_detector(landmarker):
    lines = stress_test.__doc__.split("it is\n")[1].split("In the table")[0]
    script = {}
    exec("\n".join(line[4:] for line in lines.splitlines()), script)
    images = torch.zeros(2, 3, 512, 512, dtype=torch.uint8)
    documented, used = script["predict"](images), off_axis_faces.mediapipe("face_landmarker.task")(images)
    assert documented.keys() == used.keys() == {"rotation", "landmarks"}
    for key, value in used.items():
        assert torch.equal(documented[key], value)
    torch.testing.assert_close(used["rotation"][1].double(), HEAD.matrix()[:3, :3].detach())


def test_faces_of_a_landmarker_that_always_finds_the_same(landmarker, tmp_path, monkeypatch, capsys):
    (tmp_path / "face_landmarker.task").touch()
    monkeypatch.setattr(off_axis_faces, "LENSES", {"fisheye": "Insta360 Go V3"})
    monkeypatch.setattr(off_axis_faces, "WINDOWS", (15,))
    monkeypatch.setattr(stress_test, "PLACES", [stress_test.Place(a, 0) for a in (stress_test.REPEATED, 0, 45)])
    faces = off_axis_faces.photographs(15)
    assert len(faces) == 20
    monkeypatch.setattr(off_axis_faces, "photographs", lambda window: faces[:2])
    model, figure, numbers = (str(tmp_path / name) for name in ("face_landmarker.task", "faces.png", "faces.json"))
    results = off_axis_faces.main("mediapipe", figure, model, numbers)["all"]
    assert np.allclose(results["rotation", 45, "plain"], 45, atol=0.5)
    assert max(results["rotation", 45, "ray"] + results["rotation", 45, "look_at"]) < 0.5
    assert max(results[off_axis_faces.SOLVED, 45, "look_at"]) < 1
    assert results[stress_test.FOUND, 45, "whole"] == [False, False]
    assert "| fisheye, photographs of 15 |" in capsys.readouterr().out
    with Image.open(figure) as image:
        assert np.asarray(image.convert("RGB")).std() > 20


def test_what_a_detector_lacks_is_said(tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=r"--model must be an existing face_landmarker\.task; got 'no\.task'"):
        off_axis_faces.made("mediapipe", "no.task")
    (tmp_path / "model.dat").touch()
    monkeypatch.setitem(sys.modules, "dlib", None)
    with pytest.raises(SystemExit, match="--detector dlib needs `pip install dlib-bin`"):
        off_axis_faces.made("dlib", str(tmp_path / "model.dat"))
