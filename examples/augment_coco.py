"""Writes a COCO data set as other cameras would have seen it: images, keypoints, boxes and polygons.

python examples/augment_coco.py images/ labels.json camera.yml new/ --preset dms60 --seed 0

The draw of an image follows from its file name and the seed: a second run writes the same files over the first's.
Keypoints that leave the image become 0, 0, 0; annotations that leave it are left out, as are masks in runs of pixels.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from tqdm import tqdm  # type: ignore[import-untyped]

import camtorch as ct

PARTS = torch.linspace(0, 1, 17)[:-1, None]  # of the edges of polygons, which become curves


def area(polygon: torch.Tensor) -> float:
    """Return the area of a polygon (N, 2)."""
    return abs(float(torch.linalg.det(torch.stack([polygon, polygon.roll(-1, 0)], dim=-1)).sum())) / 2


def clip(polygon: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Return the part of a polygon (N, 2) on an image of a (height, width), by Sutherland and Hodgman."""
    for axis, limit, sign in ((0, 0, 1), (0, size[1], -1), (1, 0, 1), (1, size[0], -1)):
        depth = sign * (polygon[:, axis] - limit)
        after = depth.roll(-1)
        crossing = polygon + (polygon.roll(-1, 0) - polygon) * (depth / (depth - after))[:, None]
        kept = torch.stack([depth >= 0, (depth >= 0) != (after >= 0)], dim=1)
        polygon = torch.stack([polygon, crossing], dim=1)[kept]
    return polygon


def move(annotations: list[Any], image: torch.Tensor, camera: ct.Camera, augment: ct.data.Seeded, key: str) -> Any:
    """Return a sample of the new image, its camera, and its annotations."""
    # COCO's keypoints count from the middle of the first pixel, as camtorch's; boxes and polygons from its edge
    points = [torch.tensor(one.get("keypoints", [])).reshape(-1, 3).float() for one in annotations]
    boxes = torch.tensor([one["bbox"] for one in annotations]).reshape(-1, 2, 2).cumsum(1).flatten(1) - 0.5
    keypoints = torch.cat([torch.zeros(0, 3), *points])[:, :2]
    new = augment(image=image, keypoints=keypoints, boxes=boxes, camera=camera, key=key)
    target, turn, found, first = new["camera"], new["rotation"].T.double(), [], 0
    for one, old, box, is_there in zip(annotations, points, new["boxes"], new["boxes_valid"], strict=True):
        now, first = slice(first, first + len(old)), first + len(old)
        flags, outlines, polygons = old[:, 2:] * new["keypoints_valid"][now, None], [], one.get("segmentation", [])
        for polygon in [] if isinstance(polygons, dict) else polygons:
            corners = torch.tensor(polygon).reshape(-1, 1, 2).double() - 0.5
            rays, has_ray = camera.unproject((corners + (corners.roll(-1, 0) - corners) * PARTS).flatten(0, 1))
            places, valid = target.project(rays @ turn)
            outlines.append(clip(places[has_ray & valid] + 0.5, target.image_size))
        outlines = [outline for outline in outlines if area(outline) > 0]
        corners = torch.cat(outlines or [box.view(2, 2) + 0.5])
        low, high = (v.clamp(min=0).minimum(torch.tensor(target.image_size[::-1])) for v in corners.aminmax(dim=0))
        labels = {"bbox": torch.cat([low, high - low]).tolist(), "num_keypoints": int((flags > 0).sum())}
        labels |= {"area": sum(map(area, outlines)) or float((high - low).prod())}
        labels |= {"segmentation": [outline.flatten().tolist() for outline in outlines]}
        labels |= {"keypoints": torch.cat([new["keypoints"][now].where(flags > 0, 0), flags], dim=1).flatten().tolist()}
        found += [one | labels] if is_there and (high > low).all() else []
    return new | {"annotations": found}


def main(images: str, labels: str, camera: str, out: str, preset: str = "dms60", seed: int = 0) -> None:
    """Write the new images, and `labels.json` beside them, into the folder `out`."""
    lens, content = ct.load(camera).camera, json.loads(Path(labels).read_bytes())
    random = ct.augment.RandomCamera(preset, yaw=5, pitch=5, roll=10, fov="source", min_filled=0.9)
    augment, annotations = ct.data.Seeded(random, seed=seed), list[Any]()
    for entry in tqdm(content["images"]):
        image = torch.from_numpy(np.array(Image.open(Path(images, entry["file_name"])).convert("RGB"))).permute(2, 0, 1)
        own = [one for one in content["annotations"] if one["image_id"] == entry["id"]]
        new = move(own, image, lens, augment, entry["file_name"])
        annotations += new["annotations"]
        numbers = {name: values.tolist() for name, values in new["camera"].state_dict().items()}
        entry["camera"] = {"model": new["camera"].key, "image_size": new["camera"].image_size, **numbers}
        Path(out, entry["file_name"]).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(new["image"].permute(1, 2, 0).numpy()).save(Path(out, entry["file_name"]))
    Path(out, "labels.json").write_text(json.dumps(content | {"annotations": annotations}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    for word in ("images", "labels", "camera", "out"):
        parser.add_argument(word)
    parser.add_argument("--preset", default="dms60")
    parser.add_argument("--seed", type=int, default=0)
    main(**vars(parser.parse_args()))
