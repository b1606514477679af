import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import refused
from PIL import Image

import camtorch as ct
from camtorch._drawing import BOX, GAZE, POINT
from camtorch.cli import labels, sheet
from camtorch.cli.main import main

CAMERA = (
    "%YAML:1.0\n---\nimage_width: 96\nimage_height: 64\nfisheye_model: 1\n"
    "K: [40, 0, 47, 0, 40, 32, 0, 0, 1]\nD: [-0.02, 0.004, -0.003, 0.0006]\n"
)
LABELS = {
    "keypoints": [[20, 30], [60, 20], [500, 3]],
    "boxes": [[30, 20, 60, 50]],
    "gaze": [0.5, 0.3, -1],
    "gaze_from": [50, 30],
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with an image, its camera and labels; all images are small."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sheet, "NEW_SIZE", (96, 128))
    Path("camera.yml").write_text(CAMERA)
    Path("labels.json").write_text(json.dumps(LABELS))
    grey = np.full((64, 96, 3), 128, np.uint8)
    Image.fromarray(grey).save("in.png")
    return tmp_path


PHOTO = ("in.png", "--camera", "camera.yml", "--labels", "labels.json")


def augment(*words, expect=0):
    assert main(["augment", *map(str, words)]) == expect


def pixels(path):
    with Image.open(path) as image:
        return np.array(image.convert("RGB")).astype(int)


def camera():
    return ct.KannalaBrandt([40.0, 40, 47, 32], [-0.02, 0.004, -0.003, 0.0006], image_size=(64, 96)).requires_grad_(
        False
    )


def known_labels():
    path = Path("labels.json")
    return labels.labels_of(labels.read_json(path), path, camera())


def photograph(known=None, image=None):
    image = torch.full((3, 64, 96), 128, dtype=torch.uint8) if image is None else image
    return sheet.photograph(image, camera(), known, "in.png")


def near(image, x, y, colour):
    """How far the colour nearest to `colour` within a pixel of a place is from it."""
    x, y = round(x), round(y)
    part = image[y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3)
    return np.abs(part - colour).max(-1).min()


def test_a_sheet_of_an_image_with_its_labels(folder, capsys):
    augment(*PHOTO, "--size", "64x48", "--preset", "dms130", "-n", 5)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6
    assert lines[0].startswith("  1: yaw ")
    assert "2 of 3 points" in lines[0]
    assert lines[-1].startswith("augment.png: ")
    image = pixels("augment.png")
    for colour in (POINT, BOX, GAZE):
        assert (image == colour).all(-1).sum() > 50


def test_seeds_decide(folder, capsys):
    for name, seed, count in (("a", 1, 1), ("b", 1, 1), ("c", 2, 1), ("d", 1, 3)):
        augment(*PHOTO, "-n", count, "--seed", seed, "-o", f"{name}.png")
    lines = capsys.readouterr().out.splitlines()
    assert Path("a.png").read_bytes() == Path("b.png").read_bytes() != Path("c.png").read_bytes()
    assert lines[0] == lines[2] == lines[6] != lines[4]


@pytest.mark.parametrize("angles", [(12, 0, -5), (-70, 60, -150), (170, 5, 90)])
def test_options_reach_the_cameras(folder, capsys, angles):
    mount = [f"--{name}={v},{v}" for name, v in zip(("yaw", "pitch", "roll"), angles, strict=True)]
    words = [*mount, "--zoom", 0, "--fov", 100, "--preset", "surround190"]
    augment(*PHOTO, *words, "--size", "80x80", "-n", 1)
    line = capsys.readouterr().out.splitlines()[0]
    assert "yaw {:+.1f} degrees, pitch {:+.1f} degrees, roll {:+.1f} degrees, surround190".format(*angles) in line
    assert 85 < float(line.split("surround190, ")[1].split()[0]) < 115


@pytest.mark.slow
def test_mostly_empty_images_are_said_and_mended(folder, capsys):
    narrow = "image_width: 96\nimage_height: 64\nK: [96, 0, 47.5, 0, 96, 31.5, 0, 0, 1]"
    Path("narrow.yml").write_text(narrow)
    words = ["in.png", "--camera", "narrow.yml", "--preset", "dms130", "-n", 4, "--force"]

    def filled(*options):
        augment(*words, *options)
        told = capsys.readouterr()
        return [float(line.split(" % filled")[0].split()[-1]) for line in told.out.splitlines()[:-1]], told.err

    found, error = filled()
    assert max(found) < 50
    assert "of the new images shows nothing" in error
    assert "--min-filled 0.9" in error
    assert error.count("\n") == 1
    found, error = filled("--min-filled", 0.9)
    assert min(found) >= 89
    assert error == ""
    found, error = filled("--fov", "source", "--yaw", 0, "--pitch", 0, "--roll", 0)
    assert min(found) > 85
    assert error == ""


def test_the_list_of_presets(folder, capsys):
    augment("--list")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [*ct.augment.PRESETS, "real"]
    assert "EuRoC" in lines[2]
    assert not Path("augment.png").exists()


def test_marks_lie_where_labels_say(folder):
    view = photograph(known_labels())
    assert view.keypoints_valid.tolist() == [True, True, False]
    image = np.array(sheet.marked(view, 640, 960)).astype(int)
    assert image.shape == (640, 960, 3)
    for x, y in LABELS["keypoints"][:2]:
        assert near(image, 10 * x + 4.5, 10 * y + 4.5, POINT) < 8
    x1, y1, x2, y2 = (10 * c + 4.5 for c in LABELS["boxes"][0])
    for x, y in ((x1, (y1 + y2) / 2), (x2, (y1 + y2) / 2), ((x1 + x2) / 2, y1), ((x1 + x2) / 2, y2)):
        assert near(image, x, y, BOX) < 8
    ((start, end),) = sheet.arrows(view)
    assert math.dist(start, LABELS["gaze_from"]) < 1e-4
    middle = [10 * (s + e) / 2 + 4.5 for s, e in zip(start, end, strict=True)]
    assert near(image, *middle, GAZE) < 8
    assert (image != 128).any(-1).mean() < 0.05


@pytest.mark.parametrize(
    "preset", ["none", *(pytest.param(p, marks=pytest.mark.slow) for p in ("webcam", "surround190"))]
)
def test_labels_move_with_the_image(folder, preset):
    # a keypoint at each end of the arrow, and a spot of light at one
    plain = photograph(known_labels())
    ((start, end),) = sheet.arrows(plain)
    y, x = torch.meshgrid(torch.arange(64), torch.arange(96), indexing="ij")
    spot = 250 * torch.exp(-((x - start[0]) ** 2 + (y - start[1]) ** 2) / 8)
    known = known_labels()
    known.keypoints = torch.tensor([start, end], dtype=torch.float64)
    before = photograph(known, spot.byte().expand(3, -1, -1).contiguous())
    for view in sheet.augmented(before, sheet.lens(preset), 2, 0):
        ((start, end),) = sheet.arrows(view)
        torch.testing.assert_close(view.labels.keypoints.tolist(), [start, end], rtol=0, atol=1e-2)
        weight = (view.image[0].double() - 128).clamp(min=0) * (view.image[0] == view.image[2])
        y, x = torch.meshgrid(*(torch.arange(n) for n in weight.shape), indexing="ij")
        seen = [float((weight * c).sum() / weight.sum()) for c in (x, y)]
        assert math.dist(seen, start) < 0.6


def test_what_is_off_the_image_is_not_drawn(folder):
    known = labels.Labels(torch.tensor([[-5.0, 3.0]]), torch.tensor([[200.0, 5, 210, 9]]), *torch.zeros(2, 0, 3))
    assert (np.array(sheet.marked(photograph(known), 128, 192)) == 128).all()


@pytest.mark.parametrize("mode", ["LA", "P", "I;16"])
def test_kinds_of_image(folder, mode):
    grey = np.full((64, 96), 128, np.uint8)
    grey[:, :48] = 0
    image = Image.fromarray(grey.astype(np.uint16) * 30) if mode == "I;16" else Image.fromarray(grey).convert(mode)
    image.save("kind.tif")
    augment("kind.tif", "--camera", "camera.yml", "-n", 1, "-o", "out.png")
    assert (pixels("out.png") == POINT).all(-1).any()


def test_long_and_narrow_images(folder):
    for size in ("2000x20", "20x2000"):
        augment(*PHOTO, "-n", 2, "--size", size, "-o", "out.png", "--force")
        assert max(pixels("out.png").shape) < 2000


BAD = [
    ("", "no JSON"),
    ('{"keypoints": [[1, 2], [3', "no JSON"),
    ("[" * 100_000, "no JSON"),
    ("[[1, 2]]", "must be an object"),
    ('{"keypoints": [[1, NaN]]}', "no JSON: NaN is none; null is, or leave it out"),
    *(
        (f'{{"keypoints": {entry}}}', f"keypoints: must be [[x, y], ...], numbers between -1e6 and 1e6; got {got}")
        for entry, got in (
            ("3", "3"),
            ("[[1, 2], [3, 4, 5]]", "[3, 4, 5]"),
            ('[[1, "2"]]', '[1, "2"]'),
            ("[[1, 1" + 999 * "0" + "]]", "[1, 1000"),
        )
    ),
    ('{"keypoints": [[1, 1' + 9999 * "0" + "]]}", "labels.json: "),
    ('{"boxes": [[1, 2, 3, 4], [9, 2, 3, 4]]}', "boxes: x1 <= x2 and y1 <= y2 must hold; got [9.0, 2.0, 3.0, 4.0]"),
    ('{"boxes": [[1, 2, 3, 4]], "boxes_valid": true}', "boxes_valid: must be a list, true or false for each"),
    ('{"camera": {"model": "none"}}', "labels.json: states the camera, and so does --camera"),
    ('{"gaze": [0, 0, 0], "gaze_from": [3, 4]}', "gaze: a direction has a length"),
    ('{"gaze": [0, 0, 1], "gaze_from": [9000, 4]}', "gaze_from: the camera has no ray at [9000, 4]"),
]


def test_bad_labels_are_named(folder, capsys):
    for content, text in BAD:
        Path("labels.json").write_text(content)
        error = refused(capsys, "augment", *PHOTO)
        assert "labels.json" in error
        assert text in error
    assert not Path("augment.png").exists()


def test_a_photograph_without_labels_has_none_to_report(folder, capsys):
    augment(*PHOTO[: PHOTO.index("--labels")], "-n", 2)
    told = capsys.readouterr().out
    assert told.count("filled") == 2
    assert not any(word in told for word in ("points", "boxes", "labels"))


def test_the_labels_of_a_data_set_are_those_of_an_image(folder, capsys):
    Path("images").mkdir()
    Path("in.png").rename("images/in.png")
    labels = {"keypoints": [[20, 30], [60, 20]], "gaze": [0, 0, -1], "head_pose": np.eye(4).tolist(), "name": "a"}
    Path("images/in.json").write_text(json.dumps(labels))
    augment("images", "--dataset", "images", "--camera", "camera.yml", "-o", "new", "--jobs", 1)
    capsys.readouterr()
    augment("images/in.png", "--labels", "images/in.json", "--camera", "camera.yml", "-n", 1)
    told = capsys.readouterr()
    assert 'note: images/in.json: not shown: "gaze", "head_pose", "name"; a gaze needs gaze_from' in told.err
    assert " of 2 points" in told.out
    # what a data set is written with states its camera, and what of it is valid
    new = json.loads(Path("new/in.json").read_text())
    augment("new/in.png", "--labels", "new/in.json", "-n", 1, "-o", "again.png")
    assert f" of {sum(new['keypoints_valid'])} points" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("entries", "points"),
    [
        ({"keypoints": [[[20, 30]], [[60, 20]]], "keypoints_valid": [[True], [False]]}, 1),  # OpenCV's shape
        ({"keypoints": [[20, 30], [60, 20]], "boxes": None, "gaze": None, "camera": None}, 2),
        ({"keypoints": [[20, 30]], "gaze": [[0, 0, -1], [0.1, 0, -1]], "gaze_from": [40, 30]}, 1),
    ],
)
def test_forms_that_a_data_set_may_have_are_those_of_an_image(folder, capsys, entries, points):
    Path("in.json").write_text(json.dumps(entries))
    augment(".", "--dataset", ".", "--camera", "camera.yml", "-o", "new", "--jobs", 1)
    left = int(np.sum(json.loads(Path("new/in.json").read_text())["keypoints_valid"]))
    for name, camera, count in (("in", ("--camera", "camera.yml"), points), ("new/in", (), left)):
        capsys.readouterr()
        augment(f"{name}.png", "--labels", f"{name}.json", *camera, "-n", 1, "-o", "sheet.png", "--force")
        assert f" of {count} points" in capsys.readouterr().out


def test_of_a_file_of_coco_the_image_is_shown_whose_name_it_is(folder, capsys):
    numbers = ct.data.to_columns(camera(), "")
    stated = {name[1:]: value if isinstance(value, str) else value.tolist() for name, value in numbers.items()}
    images = [{"id": i, "file_name": f"{name}.png", "camera": stated} for i, name in enumerate(("in", "other"))]
    face = {"image_id": 0, "bbox": [10, 20, 30, 20], "keypoints": [20, 30, 2, 0, 0, 0, 60, 20, 1]}
    content = {"images": images, "annotations": [{"id": 1, **face}, {"id": 2, **face, "image_id": 1}]}
    Path("coco.json").write_text(json.dumps(content))
    augment("in.png", "--labels", "coco.json", "-n", 1)
    assert re.search(r"of 2 points, \d of 1 boxes", capsys.readouterr().out)
    Path("third.png").write_bytes(Path("in.png").read_bytes())
    error = refused(capsys, "augment", "third.png", "--labels", "coco.json", "-o", "third-sheet.png")
    assert "coco.json: 0 images have the name third.png" in error
