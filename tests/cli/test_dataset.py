"""`camtorch augment --dataset`: images and labels, the same by any number of processes, shards and interruptions."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

import camtorch as ct
from camtorch.cli import coco
from camtorch.cli.main import main

SIZE = (72, 96)
CAMERAS = {
    "pinhole": ct.Pinhole([60.0, 60.0, 47.5, 35.5], image_size=SIZE).double(),
    "fisheye": ct.KannalaBrandt([40.0, 40.0, 47.0, 35.0], [0.02, -0.01, 0.003, -0.001], image_size=SIZE).double(),
}


def fixed_change(source, target, angles):
    """From one camera to another."""
    augmentation = ct.augment.RandomLens(target, focal=None, centre=None, distortion=None)
    if any(angles):
        yaw, pitch, roll = ((angle, angle) for angle in angles)
        options = dict.fromkeys(("focal", "centre", "distortion", "crop"))
        augmentation = ct.augment.RandomCamera(target, yaw=yaw, pitch=pitch, roll=roll, **options)
    return fixed(augmentation, source)


def fixed(augmentation, source):
    """Moves labels from a camera always in the same way; and the warp."""
    draw = augmentation.draw(1)
    warp = augmentation.change(source.requires_grad_(False), draw).parts[0].warp
    return ct.data.MapSamples(warp), warp


def moved(annotations, change):
    """Annotations by a change of `fixed`."""
    moving = coco.Annotations(annotations, SIZE)
    return moving.moved(change[0]({"json": {"points": np.zeros(3), **moving.labels}})["json"])


def drawn(polygon):
    """The mask of a polygon between pixel edges, drawn eight times as large."""
    large = Image.new("L", (SIZE[1] * 8, SIZE[0] * 8))
    ImageDraw.Draw(large).polygon([8 * v - 0.5 for v in polygon], fill=1)
    return np.asarray(large).reshape(SIZE[0], 8, SIZE[1], 8).mean((1, 3)) > 0.5


# -- runs


def test_runs_are_those_of_coco():
    mask = np.zeros((6, 8), bool)
    mask[1:4, 2:7] = mask[5, 0] = True
    assert coco.encoded(mask) == [5, 1, 7, 3, 3, 3, 3, 3, 3, 3, 3, 3, 8]
    assert np.array_equal(coco.decoded("5172L00000005", mask.shape), mask)  # as pycocotools 2.0.11 writes it
    rng = np.random.default_rng(0)
    for part in (0.0, 0.02, 0.5, 1.0):
        mask = rng.random((37, 53)) < part
        mask[:, 20:40] ^= True
        assert np.array_equal(coco.decoded(coco.encoded(mask), mask.shape), mask)
    for counts, message in (
        ([5, 1], "counts are of 6 pixels, and the size says 8x6"),
        ([49, -1], "counts are no runs"),
        ("5172L0000000", "counts are of"),
        ("51o", "end within a number"),
        ("\x7f", "no runs"),
        (None, "no runs"),
    ):
        with pytest.raises(ValueError, match=message):
            coco.decoded(counts, (6, 8))


# -- annotations

POLYGON = [20.0, 15.0, 70.0, 12.0, 66.0, 55.0, 45.0, 30.0, 24.0, 50.0]


@pytest.mark.parametrize("target", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("source", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("angles", [(0, 0, 0), (12, -8, 30), (60, 0, 0)])
def test_annotations_move_with_the_image(source, target, angles):
    change = fixed_change(source, target, angles)
    mask = drawn(POLYGON)
    warp = change[1]
    truth = change[0]({"mask.npy": mask.astype(np.uint8), "json": {}})["mask.npy"] > 0
    annotations = [
        {"id": 1, "image_id": 1, "segmentation": [POLYGON], "bbox": [20, 12, 50, 43], "area": 1, "category_id": 3},
        {"id": 2, "area": 1, "segmentation": {"counts": coco.encoded(mask), "size": list(SIZE)}},
        {"id": 3, "image_id": 1, "bbox": [20.0, 12.0, 50.0, 43.0], "area": 1000.0},
        {"id": 4, "image_id": 1, "keypoints": [30, 20, 2, 60, 18, 1, 45, 28, 0], "num_keypoints": 2},
        {"id": 5, "image_id": 1, "caption": "a cat", "gaze": [0.0, 0.0, -1.0]},
    ]
    outline, runs, box, points, rest = moved(annotations, change)
    height, width = SIZE
    if outline is None:
        assert not truth.any()
    else:
        mine = np.any([drawn(polygon) for polygon in outline["segmentation"]], axis=0)
        # they differ along the edge alone
        assert (mine ^ truth).sum() <= 0.04 * truth.sum() + 25
        assert abs(outline["area"] - mine.sum()) <= 0.04 * mine.sum() + 10
        rows, columns = np.nonzero(mine)
        x, y, w, h = outline["bbox"]
        assert np.allclose([x, y, x + w, y + h], [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], atol=2)
        corners = np.concatenate([np.reshape(polygon, (-1, 2)) for polygon in outline["segmentation"]])
        assert (corners >= 0).all()
        assert (corners <= [width, height]).all()
        assert outline["category_id"] == 3
    assert (runs is None) == (not truth.any())
    if runs is not None:
        assert np.array_equal(coco.decoded(runs["segmentation"]["counts"], SIZE), truth)
        assert runs["area"] == truth.sum()
    if box is not None:
        x, y, w, h = box["bbox"]
        assert 0 <= x < x + w <= width + 0.01
        assert 0 <= y < y + h <= height + 0.01
        assert box["area"] == pytest.approx(1000 * w * h / (50 * 43), rel=1e-2)
        if outline is not None:
            assert x <= outline["bbox"][0] + 0.02
            assert y <= outline["bbox"][1] + 0.02
    places, valid = warp.transform_points(torch.tensor([[30.0, 20.0], [60.0, 18.0]], dtype=torch.float64))
    assert (points is None) == (not bool(valid.any()))
    if points is not None:
        assert points["num_keypoints"] == int(valid.sum())
        for i, v in enumerate((2, 1)):
            expected = [*places[i].tolist(), v] if valid[i] else [0, 0, 0]
            assert np.allclose(points["keypoints"][3 * i : 3 * i + 3], expected, atol=0.006)
        assert points["keypoints"][6:] == [0, 0, 0]
    assert rest["caption"] == "a cat"
    assert np.allclose(rest["gaze"], [0, 0, -1] if warp.rotation is None else -warp.rotation.reshape(3, 3)[:, 2])


def test_what_is_larger_than_the_image_fills_it():
    zoomed = ct.augment.RandomMount(zoom=(2, 2), yaw=(0, 0), pitch=(0, 0), roll=(20, 20))
    corners = [-10, -10, 106, -10, 106, 82, -10, 82]
    annotations = [{"id": 1, "bbox": [-10, -10, 116, 92]}, {"id": 2, "bbox": [0, 0, 1, 1], "segmentation": [corners]}]
    boxed, outlined = moved(annotations, fixed(zoomed, CAMERAS["pinhole"]))
    assert boxed["bbox"] == outlined["bbox"] == [0, 0, SIZE[1], SIZE[0]]
    beyond = [-90.0, -90.0, -60.0, -90.0, -60.0, -60.0, -90.0, -60.0]
    gone = [{"id": 3, "bbox": [-90, -90, 30, 30], "segmentation": [beyond]}]
    assert moved(gone, fixed(zoomed, CAMERAS["pinhole"])) == [None]


def test_wrong_annotations_are_told():
    change = fixed_change(CAMERAS["pinhole"], CAMERAS["pinhole"], (0, 0, 0))
    for entry, message in (
        ({"bbox": [1, 2, 3]}, "annotation 7: bbox must be a list of numbers, 4 for each"),
        ({"bbox": [1, 2, 3, 4, 5, 6, 7, 8]}, r"bbox must be \[x, y, width, height\]"),
        ({"bbox": [1, 2, -3, 4]}, r"bbox must be \[x, y, width, height\]"),
        ({"keypoints": [1, 2]}, "keypoints must be a list of numbers, 3 for each"),
        ({"keypoints": [1, 2, float("nan")]}, "keypoints must lie between"),
        ({"keypoints": [1, 10**400, 2]}, "keypoints must lie between"),
        ({"segmentation": 5}, "segmentation must be a list of polygons"),
        ({"segmentation": [[1, 2, 3, 4]]}, "a polygon must have three corners"),
        ({"segmentation": {"counts": [], "size": [1, 2]}}, r"size \[1, 2\], the image \[72, 96\]"),
    ):
        with pytest.raises(ValueError, match=message):
            moved([{"id": 7, **entry}], change)


# -- the command


def make(folder, count=3):
    """A data set, in COCO's format and with a file for each image."""
    (folder / "images" / "b").mkdir(parents=True)
    ct.save(CAMERAS["fisheye"], folder / "camera.json")
    rng = np.random.default_rng(0)
    entries, annotations = [], []
    for i in range(count):
        name = f"b/{i}.png" if i % 2 else f"{i}.jpg"
        noise = rng.integers(0, 255, (9, 12, 3), np.uint8)
        Image.fromarray(noise).resize(SIZE[::-1]).save(folder / "images" / name)
        entries.append({"id": 10 + i, "file_name": name, "height": SIZE[0], "width": SIZE[1], "weather": "rain"})
        common = {"image_id": 10 + i, "category_id": 1, "iscrowd": 0}
        annotations += [
            {**common, "id": 100 + i, "bbox": [20, 12, 50, 43], "area": 1500.0, "segmentation": [POLYGON]},
            {**common, "id": 200 + i, "bbox": [40, 30, 9, 9], "area": 81.0, "keypoints": [44, 33, 2, 0, 0, 0]},
        ]
        labels = {"keypoints": [[44, 33], [20, 3]], "gaze": [0.1, 0, -1], "gaze_from": [45, 30], "name": "a"}
        (folder / "images" / name).with_suffix(".json").write_text(json.dumps(labels))
    content = {"info": {"year": 2026}, "images": entries, "annotations": annotations, "categories": [{"id": 1}]}
    (folder / "labels.json").write_text(json.dumps(content))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make(tmp_path)
    return tmp_path


WORDS = ("augment", "images", "--dataset", "labels.json", "--camera", "camera.json", "--min-filled", "0.5")


def augment(*words, expect=0, start=WORDS, jobs=1):
    assert main([*start, "--jobs", str(jobs), *map(str, words)]) == expect


def files(folder):
    """Path -> bytes of all but what begins with a dot."""
    found = sorted(path for path in Path(folder).rglob("*") if path.is_file() and not path.name.startswith("."))
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def test_a_data_set_of_coco(folder, capsys):
    augment("--seed", 3, "-o", "new")
    out = capsys.readouterr().out
    assert out.startswith("new: 3 of 3 files made\nnew/labels.json: 3 of 3 images so far, ")
    new, old = (json.loads(Path(folder, "labels.json").read_text()) for folder in ("new", "."))
    for name in ("id", "file_name", "weather"):
        assert [image[name] for image in new["images"]] == [image[name] for image in old["images"]]
    assert {one["id"] for one in new["annotations"]} <= {one["id"] for one in old["annotations"]}
    assert (new["info"], new["categories"]) == (old["info"], old["categories"])
    augmentation = ct.augment.RandomCamera(min_filled=0.5, camera=ct.load("camera.json").camera)
    for entry in new["images"]:
        draw = augmentation.draw(1, ct.data.generator((entry["file_name"], 0), seed=3))
        moved = augmentation(keypoints=torch.tensor([[[44.0, 33.0]]]), draw=draw)
        assert entry["camera"]["intrinsics"] == moved["camera"].intrinsics[0].tolist()
        with Image.open(Path("new") / entry["file_name"]) as image:
            assert image.size == (entry["width"], entry["height"])
        (points,) = [one for one in new["annotations"] if one["image_id"] == entry["id"] and "keypoints" in one]
        assert np.allclose(points["keypoints"][:2], moved["keypoints"][0, 0], atol=0.01)
        assert (points["keypoints"][2:], points["num_keypoints"]) == ([2, 0, 0, 0], 1)
    # what was made states its cameras, and can be gone on from
    augment("-o", "again", start=("augment", "new", "--dataset", "new/labels.json"))
    again = json.loads(Path("again/labels.json").read_text())
    assert [image["id"] for image in again["images"]] == [10, 11, 12]
    augment(
        "-o", "third", start=("augment", "new", "--dataset", "new/labels.json", "--camera", "camera.json"), expect=1
    )
    assert "its labels state its camera, and so does --camera camera.json" in capsys.readouterr().err


def test_shards_and_a_run_that_goes_on_make_the_same(folder, capsys):
    augment("-o", "whole")
    whole = files("whole")
    assert whole.keys() == {"0.jpg", "b/1.png", "2.jpg", "labels.json"}
    for shard in ("2/2", "1/2"):
        augment("-o", "parts", "--shard", shard)
    assert "3 of 3 images so far" in capsys.readouterr().out.splitlines()[-1]
    assert files("parts") == whole
    Path("parts/2.jpg").unlink()
    Path("parts/labels.json").unlink()
    augment("-o", "parts", "--resume")
    assert "1 of 3 files made; 2 were there already" in capsys.readouterr().out
    assert files("parts") == whole
    # of a label that has changed one image is made anew
    labels = json.loads(Path("labels.json").read_text())
    labels["annotations"][0]["category_id"] = 5
    Path("labels.json").write_text(json.dumps(labels))
    augment("-o", "parts", "--resume")
    assert "1 of 3 files made; 2 were there already" in capsys.readouterr().out
    assert json.loads(files("parts")["labels.json"])["annotations"][0]["category_id"] == 5
    augment("-o", "parts", expect=2)
    assert "--resume goes on where a run was broken off, --force overwrites" in capsys.readouterr().err


def test_labels_in_files_of_their_own(folder, capsys):
    words = ("augment", "images", "--dataset", "images", "--camera", "camera.json", "--min-filled", "0.5")
    augment("-o", "new", "--seed", 1, start=words)
    assert set(files("new")) == {"0.jpg", "0.json", "2.jpg", "2.json", "b/1.png", "b/1.json"}
    labels = json.loads(Path("new/b/1.json").read_text())
    augmentation = ct.augment.RandomCamera(min_filled=0.5, camera=ct.load("camera.json").camera)
    draw = augmentation.draw(1, ct.data.generator(("b/1.png", 0), seed=1))
    points = torch.tensor([[44.0, 33.0], [20.0, 3.0], [45.0, 30.0]], dtype=torch.float64)
    gaze = torch.tensor([0.1, 0.0, -1.0], dtype=torch.float64)
    moved = augmentation(keypoints=points, gaze=gaze, draw=draw)
    assert [*labels["keypoints"], labels["gaze_from"]] == moved["keypoints"].tolist()
    assert [*labels["keypoints_valid"], labels["gaze_from_valid"]] == moved["keypoints_valid"].tolist()
    assert labels["gaze"] == moved["gaze"].tolist()
    assert labels["camera"]["intrinsics"] == moved["camera"].intrinsics.tolist()
    augment("-o", "again", start=("augment", "new", "--dataset", "new"))
    assert set(files("again")) == set(files("new"))
    Path("images/2.json").unlink()
    Path("images/0.json").write_text("{")
    Path("images/b/1.json").write_text('{"score": NaN}')
    augment("-o", "broken", start=words, expect=1)
    told = capsys.readouterr()
    assert "images/2.json: No such file or directory" in told.err
    assert "error: images/0.jpg: images/0.json: no JSON" in told.err
    assert "error: images/b/1.png: images/b/1.json: no JSON: NaN is none; null is, or leave it out" in told.err
    assert "broken: 0 of 3 files made; 3 failed" in told.out


def test_wrong_words_and_files_are_told(folder, capsys):
    def refused(*words, start=WORDS):
        augment("-o", "new", *words, start=start, expect=2)
        return capsys.readouterr().err

    assert "-n is for a sheet, without --dataset" in refused("-n", "2")
    assert "--jobs is for --dataset" in refused(start=("augment", "images/0.jpg"))
    assert "which images? camtorch augment FOLDER" in refused(start=("augment", "--dataset", "labels.json"))
    assert "into which folder?" in (augment(expect=2), capsys.readouterr().err)[1]
    assert "would overwrite" in refused("-o", "images")
    assert "labels.json: would overwrite labels.json, which is read" in refused(
        "-o", ".", start=("augment", "images/b", *WORDS[2:])
    )
    content = json.loads(Path("labels.json").read_text())
    for change, message in (
        ({"images": None}, "no file of COCO"),
        ({"images": [{"id": 1, "file_name": "../0.jpg"}]}, "file_name must lie within the folder of images"),
        ({"images": [*content["images"], content["images"][0]]}, "images[3]: must be an object with an id of its own"),
        ({"annotations": [{"image_id": 99}]}, "no image has the id 99"),
        ({"images": []}, "no image has the id 10"),
        ({"info": {"year": float("inf")}}, "labels.json: no JSON: Infinity is none"),
    ):
        Path("labels.json").write_text(json.dumps(content | change))
        assert message in refused()
    content["annotations"][0]["bbox"] = [1]
    content["images"][1]["file_name"] = "lost.png"
    content["images"][2]["width"] = 640
    Path("labels.json").write_text(json.dumps(content))
    augment("-o", "new", expect=1)
    told = capsys.readouterr()
    assert "error: images/0.jpg: annotation 100: bbox must be" in told.err
    assert "error: images/lost.png: No such file or directory" in told.err
    assert "error: images/2.jpg: it is 96x72, and its labels are for 640x72" in told.err
    assert not Path("new/labels.json").exists()  # as there is nothing to stand in it


def test_what_is_wrong_with_all_images_is_said_once_and_nothing_is_written(folder, capsys):
    half = ct.load("camera.json").camera.resize(SIZE[0] // 2, SIZE[1] // 2)
    ct.save(half, "half.json")
    for words, text in (
        ((*WORDS, "--zoom", "1"), "zoom must"),
        ((*WORDS[:4], "--zoom", "1"), "zoom must"),
        ((*WORDS, "--fov", "2"), "seems to be radians"),
        ((*WORDS[:5], "half.json"), "images/0.jpg is 96x72, but the camera in half.json is for 48x36; --rescale"),
    ):
        augment("-o", "new", start=words, expect=2)
        error = capsys.readouterr().err
        assert text in error
        assert error.count("\n") == 1
        assert not Path("new").exists()
    augment("-o", "new", "--rescale", start=(*WORDS[:5], "half.json"))
    assert "3 of 3 files made" in capsys.readouterr().out


@pytest.mark.slow
def test_ranks_and_processes_make_what_one_process_makes(folder):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    augment("-o", "whole")
    augment("-o", "two", jobs=2)
    ranks = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m", "camtorch"]
    subprocess.run([*ranks, *WORDS, "-o", "ranks"], env=environment, check=True, capture_output=True)
    assert files("ranks") == files("two") == files("whole")
