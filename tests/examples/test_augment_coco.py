"""A COCO folder as other cameras see it: labels lie where the new image shows what they label."""

import json
from pathlib import Path

import augment_coco
import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

import camtorch as ct

SIZE = (72, 96)
POLYGON = [20.0, 15.0, 70.0, 12.0, 66.0, 55.0, 45.0, 30.0, 24.0, 50.0]
CAMERAS = {
    "pinhole": ct.Pinhole([60.0, 60.0, 47.5, 35.5], image_size=SIZE).double(),
    "fisheye": ct.KannalaBrandt([40.0, 40.0, 47.0, 35.0], [0.02, -0.01, 0.003, -0.001], image_size=SIZE).double(),
}


def drawn(polygons):
    """The mask of polygons between pixel edges, drawn eight times as large."""
    large = Image.new("L", (SIZE[1] * 8, SIZE[0] * 8))
    for polygon in polygons:
        ImageDraw.Draw(large).polygon([8 * v - 0.5 for v in polygon], fill=1)
    return np.asarray(large).reshape(SIZE[0], 8, SIZE[1], 8).mean((1, 3)) > 0.5


@pytest.mark.parametrize("target", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("source", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("angles", [(0, 0, 0), (12, -8, 30), (60, 0, 0)])
def test_labels_move_with_the_image(source, target, angles):
    yaw, pitch, roll = ((angle, angle) for angle in angles)
    still = dict.fromkeys(("focal", "centre", "distortion", "crop"))
    augment = ct.augment.RandomCamera(target, yaw=yaw, pitch=pitch, roll=roll, min_filled=0, **still)
    mask = torch.from_numpy(drawn([POLYGON]))
    annotations = [
        {"id": 1, "segmentation": [POLYGON], "bbox": [20, 12, 50, 43], "area": 1, "category_id": 3},
        {"id": 2, "bbox": [20, 12, 50, 43], "keypoints": [30, 20, 2, 60, 18, 1, 45, 28, 0]},
        {"id": 3, "bbox": [20, 12, 50, 43], "segmentation": {"counts": [0], "size": SIZE}},
    ]
    source = source.requires_grad_(False)
    new = augment_coco.move(annotations, 255 * mask.expand(3, -1, -1).byte(), source, ct.data.Seeded(augment), "a")
    truth, found = new["image"][0].numpy() > 127, {one["id"]: one for one in new["annotations"]}
    if not truth.any():
        assert found.keys() <= {2, 3}
        return
    mine = drawn(found[1]["segmentation"])
    assert (mine ^ truth).sum() <= 0.04 * truth.sum() + 25  # along the edge alone
    assert abs(found[1]["area"] - mine.sum()) <= 0.04 * mine.sum() + 10
    rows, columns = np.nonzero(mine)
    x, y, w, h = found[1]["bbox"]
    assert np.allclose([x, y, x + w, y + h], [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], atol=2)
    assert found[1]["category_id"] == 3
    assert found[3]["segmentation"] == []
    warp = ct.Warp(source, new["camera"], new["rotation"])
    places, valid = warp.transform_points(torch.tensor([[30.0, 20.0], [60.0, 18.0]]))
    expected = [[*place, v] if ok else [0, 0, 0] for place, ok, v in zip(places.tolist(), valid, (2, 1), strict=True)]
    assert np.allclose(np.reshape(found[2]["keypoints"], (3, 3)), [*expected, [0, 0, 0]], atol=1e-3)
    assert found[2]["num_keypoints"] == int(valid.sum())


def test_a_folder_follows_from_its_names_and_the_seed(tmp_path):
    images, labels = tmp_path / "images", tmp_path / "labels.json"
    (images / "deep").mkdir(parents=True)
    ct.save(CAMERAS["fisheye"], tmp_path / "camera.yml", format="opencv")
    names = ["a.png", "deep/b.png"]
    for i, name in enumerate(names):
        pixels = np.random.default_rng(i).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(images / name)
    box = {"image_id": 1, "category_id": 1, "bbox": [30, 20, 30, 30], "keypoints": [45, 30, 2]}
    content = {"images": [{"id": i, "file_name": name} for i, name in enumerate(names)], "annotations": [box]}

    def made(content, out, **options):
        labels.write_text(json.dumps(content))
        augment_coco.main(str(images), str(labels), str(tmp_path / "camera.yml"), str(tmp_path / out), **options)
        return {str(p.relative_to(tmp_path / out)): p.read_bytes() for p in Path(tmp_path, out).rglob("*.*")}

    whole = made(content, "whole")
    assert whole.keys() == {*names, "labels.json"}
    (sample,) = ct.data.read(tmp_path / "whole" / "labels.json", "coco")
    assert sample["keypoints_valid"].tolist() == [True]
    low, high = sample["boxes"][0].view(2, 2)
    assert bool(((low < sample["keypoints"]) & (sample["keypoints"] < high)).all())
    alone = made(content | {"images": content["images"][1:]}, "alone")
    assert alone["deep/b.png"] == whole["deep/b.png"]
    assert made(content, "other", seed=1)["a.png"] != whole["a.png"]
