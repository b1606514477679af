"""`camtorch augment IMAGE`: a sheet of an image with its labels as other cameras see them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import command, pixels, refused
from PIL import Image

import camtorch as ct
from camtorch._drawing import BOX, GAZE, POINT
from camtorch.cli import sheet

LABELS = {
    "keypoints": [[20, 30], [60, 20], [500, 3]],
    "boxes": [[30, 20, 60, 50]],
    "gaze": [0.5, 0.3, -1],
    "gaze_from": [50, 30],
}
PHOTO = ("augment", "grey.png", "--camera", "lens.json")


@pytest.fixture
def folder(folder):
    """A grey image, its camera and labels."""
    ct.save(lens(), "lens.json")
    Path("labels.json").write_text(json.dumps(LABELS))
    Image.new("RGB", (96, 64), (128, 128, 128)).save("grey.png")
    return folder


def lens():
    camera = ct.KannalaBrandt([40.0, 40, 47, 32], [-0.02, 0.004, -0.003, 0.0006], image_size=(64, 96))
    return camera.double().requires_grad_(False)


def sample():
    """What the labels are as a sample."""
    values = {name: torch.tensor(LABELS[name], dtype=torch.float64) for name in ("keypoints", "boxes")}
    eyes, _ = lens().unproject(torch.tensor([LABELS["gaze_from"]], dtype=torch.float64))
    gaze = torch.tensor([LABELS["gaze"]], dtype=torch.float64)
    image = torch.full((3, 64, 96), 128, dtype=torch.uint8)
    valid = torch.tensor([True, True, False])
    return {"image": image, "camera": lens(), **values, "keypoints_valid": valid, "points": eyes, "gaze": gaze}


def near(image, x, y, colour):
    """How far the colour nearest to `colour` within a pixel of a place is from it."""
    x, y = round(x), round(y)
    part = image[y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3).astype(int)
    return np.abs(part - colour).max(-1).min()


def test_a_sheet_of_an_image_with_its_labels(folder, capsys):
    command(*PHOTO, "--labels", "labels.json", "--size", "64x48", "--preset", "dms130", "-n", 5)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6
    assert lines[0].startswith("  1: yaw ")
    assert "2 of 3 keypoints" in lines[0]
    assert lines[-1].startswith("augment.png: ")
    for colour in (POINT, BOX, GAZE):
        assert (pixels("augment.png") == colour).all(-1).sum() > 50
    for size in ("2000x20", "20x2000"):
        command(*PHOTO, "-n", 2, "--size", size, "-o", "out.png", "--force")
        assert max(pixels("out.png").shape) < 2500
    assert "keypoints" not in capsys.readouterr().out


def test_seeds_decide_and_options_reach_the_cameras(folder, capsys):
    for name, seed, count in (("a", 1, 1), ("b", 1, 1), ("c", 2, 1), ("d", 1, 3)):
        command(*PHOTO, "-n", count, "--seed", seed, "-o", f"{name}.png")
    lines = capsys.readouterr().out.splitlines()
    assert Path("a.png").read_bytes() == Path("b.png").read_bytes() != Path("c.png").read_bytes()
    assert lines[0] == lines[2] == lines[6] != lines[4]
    for angles in ((12, 0, -5), (-70, 60, -150)):
        mount = [f"--{name}={v},{v}" for name, v in zip(("yaw", "pitch", "roll"), angles, strict=True)]
        command(*PHOTO, *mount, "--zoom", 0, "--fov", 100, "--preset", "surround190", "-n", 1, "-o", "e.png", "--force")
        line = capsys.readouterr().out.splitlines()[0]
        assert "yaw {:+.1f} degrees, pitch {:+.1f} degrees, roll {:+.1f} degrees, surround190".format(*angles) in line
        assert 85 < float(line.split("surround190, ")[1].split()[0]) < 115


@pytest.mark.slow
def test_mostly_empty_images_are_said_and_mended(folder, capsys):
    ct.save(ct.Pinhole([96.0, 96, 47.5, 31.5], image_size=(64, 96)), "narrow.json")
    words = ["augment", "in.png", "--camera", "narrow.json", "--preset", "dms130", "-n", 4, "--force"]
    command(*words)
    error = capsys.readouterr().err
    assert "of the new images shows nothing" in error
    assert "--min-filled 0.9" in error
    command(*words, "--min-filled", 0.9)
    told = capsys.readouterr()
    assert told.err == ""
    assert min(float(line.split(" % filled")[0].split()[-1]) for line in told.out.splitlines()[:-1]) >= 89


def test_the_list_of_presets(folder, capsys):
    command("augment", "--list")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [*ct.augment.PRESETS, "real"]
    assert not Path("augment.png").exists()


def test_marks_lie_where_labels_say(folder):
    image = np.array(sheet.marked(sample(), 640, 960))
    assert image.shape == (640, 960, 3)
    for x, y in LABELS["keypoints"][:2]:
        assert near(image, 10 * x + 4.5, 10 * y + 4.5, POINT) < 8
    x1, y1, x2, y2 = (10 * c + 4.5 for c in LABELS["boxes"][0])
    for x, y in ((x1, (y1 + y2) / 2), (x2, (y1 + y2) / 2), ((x1 + x2) / 2, y1), ((x1 + x2) / 2, y2)):
        assert near(image, x, y, BOX) < 8
    ((start, end),) = sheet.arrows(sample())
    assert math.dist(start, LABELS["gaze_from"]) < 1e-4
    assert near(image, *(10 * (s + e) / 2 + 4.5 for s, e in zip(start, end, strict=True)), GAZE) < 8
    assert (image != 128).any(-1).mean() < 0.05
    # what is off the image is not drawn
    far = sample() | {"keypoints": torch.tensor([[-5.0, 3.0]] * 3), "boxes": torch.tensor([[200.0, 5, 210, 9]])}
    assert (
        np.array(sheet.marked({**far, "gaze": far["gaze"][:0], "points": far["points"][:0]}, 128, 192)) == 128
    ).all()


@pytest.mark.parametrize("preset", [None, pytest.param("surround190", marks=pytest.mark.slow)])
def test_arrows_move_with_the_keypoints_at_their_ends(preset):
    before = sample()
    ((start, end),) = sheet.arrows(before)
    before |= {"keypoints": torch.tensor([start, end], dtype=torch.float64), "keypoints_valid": torch.ones(2).bool()}
    new = ct.augment.RandomCamera(preset, min_filled=0)(before)
    ((start, end),) = sheet.arrows(new)
    torch.testing.assert_close(new["keypoints"].tolist(), [start, end], rtol=0, atol=1e-2)


BAD = [
    ("", "no JSON"),
    ("[" * 100_000, "no JSON"),
    ("[[1, 2]]", "must be an object"),
    ('{"keypoints": [[1, NaN]]}', "no JSON: NaN is none; null is, or leave it out"),
    ('{"keypoints": 3}', ""),
    ('{"keypoints": [[1, 2], [3, 4, 5]]}', ""),
    ('{"keypoints": [[1, "a"]]}', "could not convert"),
    ('{"keypoints": [[1, 2, 3]]}', "keypoints must be (N, 2) pixels"),
    ('{"keypoints": [[1, 1' + 999 * "0" + "]]}", ""),
    ('{"boxes": [[1, 2, 3, 4], [9, 2, 3, 4]]}', "with x1 <= x2 and y1 <= y2; got boxes[1] = [9.0, 2.0, 3.0, 4.0]"),
    ('{"boxes": [[1, 2, 3, 4]], "boxes_valid": [true, true]}', ""),
    ('{"camera": {"model": "none"}}', "labels.json: states the camera, and so does --camera"),
    ('{"gaze": [0, 1], "gaze_from": [3, 4]}', ""),
    ('{"gaze": [0, 0, 1], "gaze_from": [9000, 4]}', "gaze_from: the camera has no ray at [9000, 4]"),
    ('{"keypoints": "abc"}', "labels.json: keypoints: could not convert"),
    ('{"images": [], "annotations": []}', "labels of a data set in COCO's form, which --dataset takes"),
]


def test_bad_labels_are_named(folder, capsys):
    for content, text in BAD:
        Path("labels.json").write_text(content)
        error = refused(capsys, *PHOTO, "--labels", "labels.json")
        assert "labels.json: " in error
        assert text in error
    assert not Path("augment.png").exists()


@pytest.mark.parametrize(
    ("entries", "points"),
    [
        ({"keypoints": [[20, 30], [60, 20]], "boxes": None, "gaze": None, "camera": None}, 2),
        ({"keypoints": [[20, 30]], "gaze": [[0, 0, -1], [0.1, 0, -1]], "gaze_from": [40, 30], "name": "a"}, 1),
    ],
)
def test_the_labels_of_a_data_set_are_those_of_an_image(folder, capsys, entries, points):
    Path("grey.json").write_text(json.dumps(entries))
    Path("images").mkdir()
    Path("grey.png").rename("images/grey.png")
    command("augment", "images", "--dataset", ".", "--camera", "lens.json", "-o", "new", "--jobs", 1)
    # what a data set is written with states its camera, and what of it is valid
    for image, labels, camera in (
        ("images/grey.png", "grey.json", ["--camera", "lens.json"]),
        ("new/grey.png", "new/grey.json", []),
    ):
        capsys.readouterr()
        command("augment", image, "--labels", labels, *camera, "-n", 1, "-o", "sheet.png", "--force")
        assert f" of {points} keypoints" in capsys.readouterr().out
