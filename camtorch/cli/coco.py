"""Annotations in COCO's format, moved with their image, as labels of a sample, from one camera to another.

Keypoints lie on a lattice whose whole numbers are the centres of pixels; boxes and polygons lie between the edges of
pixels, half a pixel further.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from camtorch.augment.sample import kind_of
from camtorch.data.labelled import failing_at

Json = dict[str, Any]
Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
_STEP = 8.0  # pixels: between points of a polygon's edge that are moved
_LEAST = 0.01  # square pixels
_FARTHEST = 1e6  # pixels
_TURNED = ("gaze", "directions", "pitch_yaw", "points", "head_pose", "pose", "rvec", "tvec")
_OWN = ("id", "image_id", "category_id", "iscrowd", "area", "bbox", "segmentation", "keypoints", "num_keypoints")


def read_json(path: Path) -> Json:
    """The object in a file; a ValueError names the file and what is wrong with it."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is none; null is, or leave it out")

    with failing_at(path, "no JSON: ", ValueError, RecursionError):
        content = json.loads(path.read_bytes(), parse_constant=refuse)
    if not isinstance(content, dict):
        raise ValueError(f"{path}: must be an object; got {content!r:.60}")
    return content


def read(path: Path) -> tuple[Json, list[Json], dict[Any, list[tuple[int, Json]]]]:
    """What a file of annotations has beside images and annotations; images; and by the id of each its annotations and
    their places in the file.

    Raises:
        ValueError: no JSON, or no images and annotations that belong together.
    """
    content = read_json(path)
    images, annotations = content.pop("images", None), content.pop("annotations", [])
    if not isinstance(images, list) or not isinstance(annotations, list):
        raise ValueError(f'{path}: no file of COCO: "images" and "annotations" must be lists')
    of: dict[Any, list[tuple[int, Json]]] = {}
    for i, image in enumerate(images):
        if not isinstance(image, dict) or not isinstance(image.get("id"), (int, str)) or image["id"] in of:
            raise ValueError(f"{path}: images[{i}]: must be an object with an id of its own")
        name = image.get("file_name")
        parts = PurePosixPath(name if isinstance(name, str) and "\0" not in name else "")
        if not parts.name or parts.is_absolute() or ".." in parts.parts:
            raise ValueError(f"{path}: images[{i}]: file_name must lie within the folder of images; got {name!r:.60}")
        of[image["id"]] = []
    for i, one in enumerate(annotations):
        if not isinstance(one, dict) or not isinstance(one.get("image_id"), (int, str)):
            raise ValueError(f"{path}: annotations[{i}]: must be an object with an image_id")
        if one["image_id"] not in of:
            raise ValueError(f"{path}: annotations[{i}]: no image has the id {one['image_id']!r:.60}")
        of[one["image_id"]].append((i, one))
    return content, images, of


class Annotations:
    """The annotations of an image of a (height, width) as labels of a sample, and what becomes of them.

    Raises:
        ValueError: what is not as COCO has it; the text names the annotation.
    """

    labels: Json
    """One field for all keypoints and corners of polygons, and one for all boxes: many fields take long to move."""

    def __init__(self, entries: Sequence[Json], size: tuple[int, int]):
        self._entries, self.labels = entries, {}
        self._points, self._boxes, self._turned = list[list[Array]](), list[Array](), list[dict[str, str]]()
        for i, one in enumerate(entries):
            with failing_at(f"annotation {one.get('id')!r:.40}", "", ValueError, TypeError):
                self._add(i, one, size)
        nothing = np.zeros((0, 2))
        self.labels |= {"keypoints": np.concatenate([nothing, *itertools.chain(*self._points)])}
        self.labels |= {"boxes": np.concatenate([np.zeros((0, 4)), *self._boxes])}

    def _add(self, i: int, one: Json, size: tuple[int, int]) -> None:
        keypoints = _numbers(one.get("keypoints") or [], "keypoints", 3)[:, :2]
        box = _numbers(one.get("bbox") or [], "bbox", 4)
        if len(box) > 1 or (box[:, 2:] < 0).any():
            raise ValueError(f"bbox must be [x, y, width, height]; got {one['bbox']!r:.80}")
        shape = one.get("segmentation") or []
        if isinstance(shape, Mapping):
            if shape.get("size") != list(size):
                raise ValueError(
                    f"segmentation has the size {shape.get('size')}, the image {list(size)}, height and width"
                )
            self.labels[f"mask_{i}"] = decoded(shape.get("counts"), size).astype(np.uint8)
        elif not isinstance(shape, list):
            raise ValueError(f"segmentation must be a list of polygons, or an object of runs; got {shape!r:.80}")
        self._points.append([keypoints, *(() if isinstance(shape, Mapping) else map(_outline, shape))])
        self._boxes.append(np.concatenate([box[:, :2], box[:, :2] + box[:, 2:]], 1) - 0.5)
        turned = {}
        for name, value in one.items():
            if name not in _OWN and (name in _TURNED or name.startswith(tuple(f"{kind}_" for kind in _TURNED))):
                kind_of(name, value, {}, "augment")
                turned[name] = f"{name}_{i}_of_annotation_{one.get('id')}"
                self.labels[turned[name]] = value
        self._turned.append(turned)

    def moved(self, new: Json) -> list[Json | None]:
        """The annotations, of `labels` that were moved; None for those of which nothing is seen any more.

        Of keypoints those off the image get 0, 0, 0, and `num_keypoints` counts the others. Polygons have points every
        8 pixels, without those that have no place in the new image, and are clipped; runs are moved as masks. The box
        is that of what is left of polygons or runs, else the one that encloses the moved box, clipped. The area is that
        of what is left, or the old one's part of its box. `gaze`, `head_pose` and other fields in the camera's frame
        turn with it.
        """
        rows = (
            zip(np.asarray(new[name]), np.asarray(new[f"{name}_valid"]), strict=True) for name in ("keypoints", "boxes")
        )
        points, boxes = rows
        return [self._moved(i, one, new, points, boxes) for i, one in enumerate(self._entries)]

    def _moved(self, i: int, one: Json, new: Json, points: Iterator[Any], boxes: Iterator[Any]) -> Json | None:
        height, width = new["camera"]["image_size"]
        result = one | {name: new[label] for name, label in self._turned[i].items()}
        keypoints, *outlines = ([*itertools.islice(points, len(part))] for part in self._points[i])
        is_seen, box, area = True, None, None
        if keypoints:
            rows = [
                [_rounded(x), _rounded(y), int(flag)] if valid and flag > 0 else [0.0, 0.0, 0]
                for ((x, y), valid), flag in zip(keypoints, one["keypoints"][2::3], strict=True)
            ]
            result["keypoints"] = [*itertools.chain(*rows)]
            result["num_keypoints"] = sum(flag > 0 for *_, flag in rows)
            is_seen = result["num_keypoints"] > 0
        for places, valid in itertools.islice(boxes, len(self._boxes[i])):
            low, high = (places + 0.5).reshape(2, 2).clip(0, (width, height))
            if valid and (high > low).all():
                box, old = [*low, *(high - low)], math.prod(one["bbox"][2:])
                area = (
                    one["area"] * math.prod(high - low) / old
                    if old and isinstance(one.get("area"), (int, float))
                    else None
                )
        if outlines:
            there = (np.array([place for place, _ in outline if (place != -1).any()]) for outline in outlines)
            clipped = (_clipped(polygon, width, height) for polygon in there)
            polygons = [polygon + 0.5 for polygon in clipped if _area(polygon) >= _LEAST]
            result["segmentation"] = [[_rounded(v) for v in polygon.ravel()] for polygon in polygons]
            area, corners = sum(map(_area, polygons)), np.concatenate([np.zeros((0, 2)), *polygons])
            box = [*corners.min(0), *np.ptp(corners, 0)] if len(corners) else None
        elif f"mask_{i}" in new:
            mask = new[f"mask_{i}"] > 0
            result["segmentation"] = {**one["segmentation"], "counts": encoded(mask), "size": [height, width]}
            area, corners = int(mask.sum()), np.argwhere(mask)[:, ::-1]
            box = [*corners.min(0), *(np.ptp(corners, 0) + 1)] if len(corners) else None
        if one.get("bbox"):
            result["bbox"] = None if box is None else [_rounded(v) for v in box]
        if "area" in one and area is not None:
            result["area"] = _rounded(area)
        if one.get("bbox") or one.get("segmentation"):
            is_seen = box is not None
        return result if is_seen else None


def _numbers(values: Any, name: str, step: int) -> Array:
    if not isinstance(values, list) or len(values) % step or not all(type(v) in (int, float) for v in values):
        raise ValueError(f"{name} must be a list of numbers, {step} for each; got {values!r:.80}")
    if not all(abs(value) < _FARTHEST for value in values):  # NaN, too, and integers too large for a float
        raise ValueError(f"{name} must lie between -1e6 and 1e6; got {values!r:.80}")
    return np.asarray(values, np.float64).reshape(-1, step)


def _rounded(value: float) -> float:
    return round(float(value), 2) + 0.0  # a sum with zero has no negative one


# -- polygons


def _outline(polygon: Any) -> Array:
    """Points along a polygon, with its corners."""
    corners = _numbers(polygon, "segmentation", 2) - 0.5
    if len(corners) < 3:
        raise ValueError(f"segmentation: a polygon must have three corners; got {polygon}")
    ends = np.roll(corners, -1, 0)
    counts = np.maximum(np.ceil(np.linalg.norm(ends - corners, axis=1) / _STEP), 1).astype(int)
    edges = zip(corners, ends, counts.tolist(), strict=True)
    return np.concatenate([np.linspace(a, b, n, endpoint=False) for a, b, n in edges])


def _clipped(polygon: Array, width: int, height: int) -> Array:
    """The part of a polygon on an image, by Sutherland and Hodgman: parts are joined along the image's edge."""
    corners: list[list[float]] = polygon.tolist()
    for axis, limit, sign in ((0, -0.5, 1), (0, width - 0.5, -1), (1, -0.5, 1), (1, height - 0.5, -1)):
        before, corners = corners, []
        for a, b in zip(before[-1:] + before[:-1], before, strict=True):
            inside = sign * (a[axis] - limit) >= 0, sign * (b[axis] - limit) >= 0
            if inside[0] != inside[1]:
                other = a[1 - axis] + (limit - a[axis]) / (b[axis] - a[axis]) * (b[1 - axis] - a[1 - axis])
                corners.append([limit, other] if axis == 0 else [other, limit])
            if inside[1]:
                corners.append(b)
    return np.asarray(corners, np.float64).reshape(-1, 2)


def _area(polygon: Array) -> float:
    (x1, y1), (x2, y2) = polygon.T, np.roll(polygon, -1, 0).T
    return abs(float((x1 * y2 - x2 * y1).sum())) / 2


# -- runs
#
# Down the columns, one after another, beginning with zeros; "Data format" of cocodataset.org. As a text each number is
# groups of five bits, the lowest first, with a sixth one where more follow, as characters from "0" on; from the fourth
# number on it is the difference to the one before last. pycocotools shows what is in memory where runs are too short.


def decoded(counts: Any, size: tuple[int, int]) -> Flags:
    """A mask (H, W) of runs, a list or a text.

    Raises:
        ValueError: no such runs, or not of that many pixels.
    """
    runs, (height, width) = _of_text(counts) if isinstance(counts, str) else counts, size
    if not isinstance(runs, list) or not all(type(run) is int and 0 <= run < 1 << 32 for run in runs):
        raise ValueError("counts are no runs of pixels")
    if sum(runs) != height * width:
        raise ValueError(f"counts are of {sum(runs)} pixels, and the size says {width}x{height}")
    mask: Flags = np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T
    return mask


def encoded(mask: Flags) -> list[int]:
    """The runs of a mask (H, W)."""
    flat = np.concatenate([[False], mask.T.reshape(-1)])
    runs: list[int] = np.diff(np.flatnonzero(flat[1:] != flat[:-1]), prepend=0, append=mask.size).tolist()
    return runs


def _of_text(text: str) -> list[int]:
    runs: list[int] = []
    value = shift = 0
    for group in (ord(character) - 48 for character in text):
        if not 0 <= group < 64 or shift > 60:
            raise ValueError("counts are no runs of pixels")
        value |= (group & 31) << shift
        shift += 5
        if not group & 32:
            value -= group >> 4 << shift  # the sixth bit is 0 here, the fifth is the sign
            runs.append(value + runs[-2] if len(runs) > 2 else value)
            value = shift = 0
    if shift:
        raise ValueError("counts end within a number")
    return runs
