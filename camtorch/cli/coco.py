"""Annotations in COCO's format: read, and moved with their image, as labels of a sample, from one camera to another.

Keypoints lie on a lattice whose whole numbers are the centres of pixels; boxes and polygons lie between the edges of
pixels, half a pixel further.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camtorch.augment.sample import KEEP, kind_of
from camtorch.cli import rle
from camtorch.cli.labels import LabelsError

Json = dict[str, Any]
Array = NDArray[np.float64]
Move = Callable[[Json], Json]
"""Labels of an image -> labels of the new one."""
_STEP = 8.0  # pixels: between points of a polygon's edge that are moved
_SAG = 0.1  # pixels by which a straight edge may miss the curve that it stands for
_COARSE = 8  # pixels between those of which it is asked whether the new image shows them
_PARTS = 64  # of a way of some hundred pixels, three times in turn
_LEAST = 0.01  # square pixels
_FARTHEST = 1e6  # pixels
_PACKED = ("keypoints", "boxes")
_TURNED = ("gaze", "directions", "pitch_yaw", "points", "head_pose", "pose", "rvec", "tvec")
_OWN = ("id", "image_id", "category_id", "iscrowd", "area", "bbox", "segmentation", "keypoints", "num_keypoints")


@dataclass
class DataSet:
    """A file of annotations."""

    path: Path
    rest: Json
    """All but images and annotations."""
    images: list[Json]
    annotations: dict[Any, list[tuple[int, Json]]]
    """Id of an image -> its annotations, and their places in the file."""

    def of(self, image: Json) -> list[tuple[int, Json]]:
        """The annotations of an image."""
        return self.annotations.get(image["id"], [])


def read(path: Path) -> DataSet:
    """A file of annotations.

    Raises:
        LabelsError: no JSON, or no images and annotations that belong together.
    """
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise LabelsError(f"{path}: no JSON: {error}") from None
    if not isinstance(content, dict) or not isinstance(content.get("images"), list):
        raise LabelsError(f'{path}: no file of COCO, which is an object with a list "images"')
    images, annotations = content.pop("images"), content.pop("annotations", [])
    if not isinstance(annotations, list):
        raise LabelsError(f'{path}: "annotations" must be a list')
    of: dict[Any, list[tuple[int, Json]]] = {}
    for i, image in enumerate(images):
        if not isinstance(image, dict) or not isinstance(image.get("id"), (int, str)):
            raise LabelsError(f"{path}: images[{i}]: must be an object with an id")
        name = image.get("file_name")
        if not isinstance(name, str) or not name or "\0" in name:
            raise LabelsError(f"{path}: images[{i}]: file_name must be the name of a file; got {name!r:.60}")
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise LabelsError(f"{path}: images[{i}]: file_name must lie within the folder of images; got {name!r:.60}")
        for side in ("width", "height"):
            if type(image.get(side, 0)) not in (int, float):
                raise LabelsError(f"{path}: images[{i}]: {side} must be a number; got {image[side]!r:.60}")
        if image["id"] in of:
            raise LabelsError(f"{path}: images[{i}]: another one has the id {image['id']!r:.60}")
        of[image["id"]] = []
    for i, one in enumerate(annotations):
        if not isinstance(one, dict) or not isinstance(one.get("image_id"), (int, str)):
            raise LabelsError(f"{path}: annotations[{i}]: must be an object with an image_id")
        if one["image_id"] not in of:
            raise LabelsError(f"{path}: annotations[{i}]: no image has the id {one['image_id']!r:.60}")
        of[one["image_id"]].append((i, one))
    return DataSet(path, content, images, of)


# -- one image's annotations


def labels_of(annotations: Sequence[Json], size: tuple[int, int], tell: Callable[[str], None]) -> Json:
    """The annotations of an image of a (height, width) as labels of a sample, which `moved` takes up again.

    `tell` hears of numbers that are not known and stay as they are.

    Raises:
        ValueError: what is not as COCO has it; the text names the annotation.
    """
    labels: Json = {}
    for i, one in enumerate(annotations):
        try:
            labels |= _labels(one, i, size)
        except (ValueError, TypeError) as error:
            raise ValueError(f"annotation {one.get('id')!r:.40}: {error}") from None
        for name, value in one.items():
            try:
                kind = None if name in _OWN else kind_of(name, value, {}, "")
            except ValueError:  # numbers
                kind = KEEP
            if kind in _TURNED:
                labels[_turned(name, one, i)] = value
            elif kind is not None:
                tell(f"{name!r} of annotations holds numbers that stay as they are")
    return labels


def packed(labels: Json) -> Json:
    """Labels with one field for all keypoints and one for all boxes: many fields take long to move."""
    result = {name: value for name, value in labels.items() if not name.startswith(_PACKED)}
    for kind in _PACKED:
        if own := [value for name, value in labels.items() if name.startswith(kind)]:
            result[kind] = np.concatenate(own)
    return result


def _unpacked(labels: Json, new: Json) -> Json:
    """What became of `labels`, of what became of them packed."""
    new = dict(new)
    for kind in _PACKED:
        names = [name for name in labels if name.startswith(kind)]
        ends = np.cumsum([len(labels[name]) for name in names])[:-1]
        for mark in ("", "_valid"):
            if kind + mark in new:
                pieces = np.split(np.asarray(new.pop(kind + mark)), ends)
                new |= {name + mark: piece for name, piece in zip(names, pieces, strict=True)}
    return new


def _turned(name: str, one: Json, i: int) -> str:
    return f"{name}_{i}_of_annotation_{one.get('id')}"


def _labels(one: Json, i: int, size: tuple[int, int]) -> Json:
    labels: Json = {}
    if one.get("keypoints"):
        labels[f"keypoints_{i}"] = _numbers(one["keypoints"], "keypoints", 3)[:, :2]
    if one.get("bbox"):
        numbers = _numbers(one["bbox"], "bbox", 4)
        if len(numbers) != 1 or numbers[0, 2:].min() < 0:
            raise ValueError(f"bbox must be [x, y, width, height]; got {one['bbox']!r:.80}")
        labels[f"boxes_{i}"] = np.concatenate([numbers[:, :2], numbers[:, :2] + numbers[:, 2:]], 1) - 0.5
    runs = one.get("segmentation")
    if isinstance(runs, Mapping):
        if runs.get("size") != list(size):
            raise ValueError(f"segmentation has the size {runs.get('size')}, the image {list(size)}, height and width")
        labels[f"mask_{i}"] = rle.decode(runs.get("counts"), size).astype(np.uint8)
    for j, edges in enumerate(_outlines(one)):
        labels[f"keypoints_{i}_{j}"] = np.concatenate(edges)
    return labels


def _outlines(one: Json) -> list[list[Array]]:
    """Points along each edge of each polygon, between pixel centres; both of its corners are among them."""
    polygons = one.get("segmentation") or []
    if isinstance(polygons, Mapping):
        return []
    if not isinstance(polygons, list):
        raise ValueError(f"segmentation must be a list of polygons, or an object of runs; got {polygons!r:.80}")
    outlines = []
    for polygon in polygons:
        corners = _numbers(polygon, "segmentation", 2) - 0.5
        if len(corners) < 3:
            raise ValueError(f"segmentation: a polygon must have three corners; got {polygon}")
        ends = np.roll(corners, -1, 0)
        counts = np.maximum(np.ceil(np.linalg.norm(ends - corners, axis=1) / _STEP), 1).astype(int)
        edges = zip(corners, ends, counts.tolist(), strict=True)
        outlines.append([np.linspace(a, b, n + 1) if n > 1 else np.stack([a, b]) for a, b, n in edges])
    return outlines


def _numbers(values: Any, name: str, step: int) -> Array:
    if not isinstance(values, list) or len(values) % step or not all(type(v) in (int, float) for v in values):
        raise ValueError(f"{name} must be a list of numbers, {step} for each; got {values!r:.80}")
    if not all(abs(value) < _FARTHEST for value in values):  # NaN, too, and integers too large for a float
        raise ValueError(f"{name} must lie between -1e6 and 1e6; got {values!r:.80}")
    return np.asarray(values, np.float64).reshape(-1, step)


def moved(annotations: Sequence[Json], labels: Json, new: Json, move: Move, size: tuple[int, int]) -> list[Json | None]:
    """The annotations of an image after a change of its camera; None for those of which nothing is seen any more.

    Of keypoints those off the image get 0, 0, 0, and `num_keypoints` counts the others. Polygons are moved with points
    between their corners where edges get curved, end at the rim of what can be mapped, and are clipped; runs are moved
    as masks. The box is that of what is left of polygons or runs, else the one that encloses the moved box, clipped.
    The area is that of what is left, or the old one's part of its box. `gaze`, `head_pose` and other fields in the
    camera's frame turn with it.

    Args:
        annotations: of one image.
        labels: `labels_of` them.
        new: those labels, packed and moved.
        move: moves others, as these were.
        size: (height, width) of the image.
    """
    new = _unpacked(labels, new)
    return [_moved(one, i, labels, new, move, size) for i, one in enumerate(annotations)]


def _moved(one: Json, i: int, labels: Json, new: Json, move: Move, size: tuple[int, int]) -> Json | None:
    result = {name: new.get(_turned(name, one, i), value) for name, value in one.items()}
    height, width = new["camera"]["image_size"]
    is_seen, box, area = True, None, None
    if (name := f"keypoints_{i}") in labels:
        inside = ((labels[name] >= -0.5) & (labels[name] <= np.array(size[::-1]) - 0.5)).all(1)
        flags = np.asarray(one["keypoints"][2::3])
        shown = new[f"{name}_valid"] & inside & (flags > 0)
        rows = np.where(shown[:, None], np.column_stack([new[name], flags]), 0.0)
        result["keypoints"] = [n for x, y, v in rows.tolist() for n in (_rounded(x), _rounded(y), int(v))]
        result["num_keypoints"] = int(shown.sum())
        is_seen = bool(shown.any())
    if (name := f"boxes_{i}") in labels:
        low, high = (new[name] + 0.5).reshape(2, 2).clip(0, (width, height))
        if new[f"{name}_valid"][0] and (high > low).all():
            box = [*low, *(high - low)]
            old, part = math.prod(one["bbox"][2:]), math.prod(high - low)
            area = one["area"] * part / old if old and type(one.get("area")) in (int, float) else None
    if outlines := _outlines(one):
        polygons = [
            _clipped(_polygon(edges, f"keypoints_{i}_{j}", new, move, size), width, height)
            for j, edges in enumerate(outlines)
        ]
        polygons = [polygon + 0.5 for polygon in polygons if _area(polygon) >= _LEAST]
        result["segmentation"] = [[_rounded(v) for v in polygon.ravel()] for polygon in polygons]
        area, corners = sum(map(_area, polygons)), np.concatenate([np.zeros((0, 2)), *polygons])
        box = [*corners.min(0), *np.ptp(corners, 0)] if len(corners) else None
    elif (name := f"mask_{i}") in labels:
        mask = new[name] > 0
        counts = rle.encode(mask, as_text=isinstance(one["segmentation"]["counts"], str))
        result["segmentation"] = {**one["segmentation"], "counts": counts, "size": [height, width]}
        area, corners = int(mask.sum()), np.argwhere(mask)[:, ::-1]
        box = [*corners.min(0), *(np.ptp(corners, 0) + 1)] if len(corners) else None
    if one.get("bbox"):
        result["bbox"] = None if box is None else [_rounded(v) for v in box]
    if "area" in one and area is not None:
        result["area"] = _rounded(area)
    if one.get("bbox") or one.get("segmentation"):
        is_seen = box is not None
    return result if is_seen else None


def _rounded(value: float) -> float:
    return round(float(value), 2) + 0.0  # a sum with zero has no negative one


# -- polygons


def _polygon(edges: list[Array], name: str, new: Json, move: Move, size: tuple[int, int]) -> Array:
    """What became of a polygon (K, 2): its corners, and as many points between them as its edges are curved."""
    points, places = np.concatenate(edges), new[name]
    there = new[f"{name}_valid"] | _has_place(places)
    if not there.all():
        places, there = _pulled_in(points, places, there, move, size)
    ends = np.cumsum([len(edge) for edge in edges])[:-1]
    pieces = zip(np.split(places, ends), np.split(there, ends), strict=True)
    corners = np.concatenate([_simplified(edge[there]) for edge, there in pieces])
    once: Array = corners[(corners != np.roll(corners, -1, 0)).any(1)]
    return once


def _has_place(places: Array) -> NDArray[np.bool_]:
    has: NDArray[np.bool_] = (places != -1).any(-1)
    return has


def _simplified(line: Array) -> Array:
    """As few of the points of a line (K, 2) as stand for it, by Ramer, Douglas and Peucker."""
    if len(line) < 3:
        return line
    along, off = line[-1] - line[0], line - line[0]
    distance = np.abs(off[:, 0] * along[1] - off[:, 1] * along[0]) / max(math.hypot(*along), 1e-9)
    far = int(distance.argmax())
    if distance[far] <= _SAG:
        return np.stack([line[0], line[-1]])
    return np.concatenate([_simplified(line[: far + 1]), _simplified(line[far:])[1:]])


def _pulled_in(
    points: Array, places: Array, there: NDArray[np.bool_], move: Move, size: tuple[int, int]
) -> tuple[Array, NDArray[np.bool_]]:
    """Places of the points along a polygon, and which there are.

    What has no place takes that of the point where one last exists on the way to the middle of what the new image
    shows: an outline around all that can be mapped so becomes its rim.
    """
    lattice = np.stack(np.meshgrid(*(np.arange(0.0, side, _COARSE) for side in size[::-1])), -1).reshape(-1, 2)
    shown = lattice[np.asarray(move({"keypoints": lattice})["keypoints_valid"])]
    if not len(shown):
        return places, there
    middle = shown[np.linalg.norm(shown - shown.mean(0), axis=1).argmin()]
    # what lies beyond all that can be mapped, and not around it, stays away
    if not there.any() and not _holds(points, middle):
        return places, there
    lost = points[~there]
    rows, low, high = np.arange(len(lost)), np.zeros(len(lost)), np.ones(len(lost))
    for _ in range(3):
        shares = np.linspace(low, high, _PARTS + 1, axis=1)
        on_way = lost[:, None] + shares[..., None] * (middle - lost)[:, None]
        found = np.asarray(move({"keypoints": on_way.reshape(-1, 2)})["keypoints"]).reshape(on_way.shape)
        first = _has_place(found).argmax(1)
        low, high = shares[rows, np.maximum(first - 1, 0)], shares[rows, first]
    places = places.copy()
    places[~there] = found[rows, first]
    return places, np.ones_like(there)


def _holds(outline: Array, point: Array) -> bool:
    """Whether a point is within an outline (K, 2): a ray from it to the right crosses that an odd number of times."""
    (x1, y1), (x2, y2), (x, y) = outline.T, np.roll(outline, -1, 0).T, point
    crosses = (y1 > y) != (y2 > y)
    at = x1[crosses] + ((x2 - x1) * (y - y1))[crosses] / (y2 - y1)[crosses]
    return bool((at > x).sum() % 2)


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
