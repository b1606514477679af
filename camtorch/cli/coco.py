"""Annotations in COCO's format: read, and moved with their image, as labels of a sample, from one camera to another.

Keypoints lie on a lattice whose whole numbers are the centres of pixels; boxes and polygons lie between the edges of
pixels, half a pixel further.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camtorch.augment.sample import KEEP, kind_of
from camtorch.cli.labels import Json, LabelsError, read_json

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Move = Callable[[Json], Json]
"""Labels of an image -> labels of the new one."""
_STEP = 8.0  # pixels: between points of a polygon's edge that are moved
_SAG = 0.1  # pixels by which a straight edge may miss the curve that it stands for
_COARSE = 8  # pixels between those of which it is asked whether the new image shows them
_PARTS = 64  # of a way of some hundred pixels, three times in turn
_LEAST = 0.01  # square pixels
_FARTHEST = 1e6  # pixels
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


def read(path: Path) -> DataSet:
    """A file of annotations.

    Raises:
        LabelsError: no JSON, or no images and annotations that belong together.
    """
    content = read_json(path, 'no file of COCO, which is an object with a list "images"')
    images, annotations = content.pop("images", None), content.pop("annotations", [])
    if not isinstance(images, list) or not isinstance(annotations, list):
        raise LabelsError(f'{path}: no file of COCO: "images" and "annotations" must be lists')
    of: dict[Any, list[tuple[int, Json]]] = {}
    for i, image in enumerate(images):
        if reason := _fault_of(image, of):
            raise LabelsError(f"{path}: images[{i}]: {reason}")
        of[image["id"]] = []
    for i, one in enumerate(annotations):
        if not isinstance(one, dict) or not isinstance(one.get("image_id"), (int, str)):
            raise LabelsError(f"{path}: annotations[{i}]: must be an object with an image_id")
        if one["image_id"] not in of:
            raise LabelsError(f"{path}: annotations[{i}]: no image has the id {one['image_id']!r:.60}")
        of[one["image_id"]].append((i, one))
    return DataSet(path, content, images, of)


def labels_of(path: Path, image: Path, size: tuple[int, int]) -> Json:
    """Keypoints that are labelled and boxes of one image, and its camera if stated, as a JSON of a sample has them.

    Raises:
        LabelsError: `read`'s; not one image of this name. ValueError: what is not as COCO has it.
    """
    data = read(path)
    named = [one for one in data.images if PurePosixPath(one["file_name"]).name == image.name]
    if len(named) != 1:
        raise LabelsError(f"{path}: {len(named)} images have the name {image.name}")
    keypoints: list[list[float]] = []
    boxes: list[list[float]] = []
    for i, one in data.annotations[named[0]["id"]]:
        try:
            parts = _Parts.of({**one, "segmentation": []}, size)
        except (ValueError, TypeError) as error:
            raise LabelsError(f"{path}: annotations[{i}]: {error}") from None
        if parts.keypoints is not None:
            keypoints += parts.keypoints[np.asarray(one["keypoints"][2::3]) > 0].tolist()
        boxes += [] if parts.box is None else parts.box.tolist()
    return {"keypoints": keypoints, "boxes": boxes, "camera": named[0].get("camera")}


def _fault_of(image: Any, known: Mapping[Any, object]) -> str:
    """What is wrong with an entry of an image."""
    if not isinstance(image, dict) or not isinstance(image.get("id"), (int, str)):
        return "must be an object with an id"
    name = image.get("file_name")
    if not isinstance(name, str) or not name or "\0" in name:
        return f"file_name must be the name of a file; got {name!r:.60}"
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        return f"file_name must lie within the folder of images; got {name!r:.60}"
    for side in ("width", "height"):
        if type(image.get(side, 0)) not in (int, float):
            return f"{side} must be a number; got {image[side]!r:.60}"
    return f"another one has the id {image['id']!r:.60}" if image["id"] in known else ""


# -- one image's annotations


@dataclass
class _Parts:
    """What of an annotation moves; pixels, whose centres are whole numbers."""

    entry: Json
    keypoints: Array | None = None
    """(N, 2)"""
    box: Array | None = None
    """(1, 4) x1, y1, x2, y2."""
    mask: NDArray[np.uint8] | None = None
    outlines: list[list[Array]] = field(default_factory=list)
    """Points along each edge of each polygon; both of its corners are among them."""
    turned: dict[str, str] = field(default_factory=dict)
    """Name of an entry in the camera's frame -> that of its label."""

    @classmethod
    def of(cls, one: Json, size: tuple[int, int]) -> _Parts:
        parts = cls(one)
        if one.get("keypoints"):
            parts.keypoints = _numbers(one["keypoints"], "keypoints", 3)[:, :2]
        if one.get("bbox"):
            numbers = _numbers(one["bbox"], "bbox", 4)
            if len(numbers) != 1 or numbers[0, 2:].min() < 0:
                raise ValueError(f"bbox must be [x, y, width, height]; got {one['bbox']!r:.80}")
            parts.box = np.concatenate([numbers[:, :2], numbers[:, :2] + numbers[:, 2:]], 1) - 0.5
        shape = one.get("segmentation") or []
        if isinstance(shape, Mapping):
            if shape.get("size") != list(size):
                raise ValueError(
                    f"segmentation has the size {shape.get('size')}, the image {list(size)}, height and width"
                )
            parts.mask = decoded(shape.get("counts"), size).astype(np.uint8)
        elif isinstance(shape, list):
            parts.outlines = [_outline(polygon) for polygon in shape]
        else:
            raise ValueError(f"segmentation must be a list of polygons, or an object of runs; got {shape!r:.80}")
        return parts

    def points(self) -> list[Array]:
        return [*([] if self.keypoints is None else [self.keypoints]), *map(np.concatenate, self.outlines)]


class Annotations:
    """The annotations of an image as labels of a sample, and what becomes of them.

    Args:
        entries: of one image.
        size: its (height, width).
        tell: hears of numbers that are not known and stay as they are.

    Raises:
        ValueError: what is not as COCO has it; the text names the annotation.
    """

    labels: Json
    """One field for all keypoints and corners of polygons, and one for all boxes: many fields take long to move."""

    def __init__(self, entries: Sequence[Json], size: tuple[int, int], tell: Callable[[str], None]):
        self._size, self._parts, self.labels = size, list[_Parts](), {}
        for i, one in enumerate(entries):
            try:
                parts = _Parts.of(one, size)
            except (ValueError, TypeError) as error:
                raise ValueError(f"annotation {one.get('id')!r:.40}: {error}") from None
            for name, value in one.items():
                try:
                    kind = None if name in _OWN else kind_of(name, value, {}, "")
                except ValueError:  # numbers
                    kind = KEEP
                if kind in _TURNED:
                    parts.turned[name] = f"{name}_{i}_of_annotation_{one.get('id')}"
                    self.labels[parts.turned[name]] = value
                elif kind is not None:
                    tell(f"{name!r} of annotations holds numbers that stay as they are")
            if parts.mask is not None:
                self.labels[f"mask_{i}"] = parts.mask
            self._parts.append(parts)
        points = [one for parts in self._parts for one in parts.points()]
        boxes = [parts.box for parts in self._parts if parts.box is not None]
        self._counts = {"keypoints": list(map(len, points)), "boxes": [1] * len(boxes)}
        for name, arrays in (("keypoints", points), ("boxes", boxes)):
            if arrays:
                self.labels[name] = np.concatenate(arrays)

    def moved(self, new: Json, move: Move) -> list[Json | None]:
        """The annotations after a change of the camera; None for those of which nothing is seen any more.

        Of keypoints those off the image get 0, 0, 0, and `num_keypoints` counts the others. Polygons are moved with
        points between their corners where edges get curved, end at the rim of what can be mapped, and are clipped; runs
        are moved as masks. The box is that of what is left of polygons or runs, else the one that encloses the moved
        box, clipped. The area is that of what is left, or the old one's part of its box. `gaze`, `head_pose` and other
        fields in the camera's frame turn with it.

        Args:
            new: `labels`, moved.
            move: moves others, as these were.
        """
        pieces = {name: self._split(new, name) for name in self._counts}
        return [self._moved(parts, i, new, pieces, move) for i, parts in enumerate(self._parts)]

    def _split(self, new: Json, name: str) -> Iterator[tuple[Array, Flags]]:
        """Places and validity, annotation by annotation."""
        counts = self._counts[name]
        if not counts:
            return iter(())
        ends = np.cumsum(counts)[:-1]
        return zip(*(np.split(np.asarray(new[name + mark]), ends) for mark in ("", "_valid")), strict=True)

    def _moved(
        self, parts: _Parts, i: int, new: Json, pieces: Mapping[str, Iterator[tuple[Array, Flags]]], move: Move
    ) -> Json | None:
        one, (height, width) = parts.entry, new["camera"]["image_size"]
        result = one | {name: new[label] for name, label in parts.turned.items()}
        is_seen, box, area = True, None, None
        if parts.keypoints is not None:
            places, valid = next(pieces["keypoints"])
            inside = ((parts.keypoints >= -0.5) & (parts.keypoints <= np.array(self._size[::-1]) - 0.5)).all(1)
            flags = np.asarray(one["keypoints"][2::3])
            shown = valid & inside & (flags > 0)
            rows = np.where(shown[:, None], np.column_stack([places, flags]), 0.0)
            result["keypoints"] = [n for x, y, v in rows.tolist() for n in (_rounded(x), _rounded(y), int(v))]
            result["num_keypoints"] = int(shown.sum())
            is_seen = bool(shown.any())
        if parts.box is not None:
            places, valid = next(pieces["boxes"])
            low, high = (places + 0.5).reshape(2, 2).clip(0, (width, height))
            if valid[0] and (high > low).all():
                box = [*low, *(high - low)]
                old, part = math.prod(one["bbox"][2:]), math.prod(high - low)
                area = one["area"] * part / old if old and type(one.get("area")) in (int, float) else None
        if parts.outlines:
            moved = [_polygon(edges, *next(pieces["keypoints"]), move, self._size) for edges in parts.outlines]
            clipped = [_clipped(polygon, width, height) for polygon in moved]
            polygons = [polygon + 0.5 for polygon in clipped if _area(polygon) >= _LEAST]
            result["segmentation"] = [[_rounded(v) for v in polygon.ravel()] for polygon in polygons]
            area, corners = sum(map(_area, polygons)), np.concatenate([np.zeros((0, 2)), *polygons])
            box = [*corners.min(0), *np.ptp(corners, 0)] if len(corners) else None
        elif parts.mask is not None:
            mask = new[f"mask_{i}"] > 0
            counts = encoded(mask, as_text=isinstance(one["segmentation"]["counts"], str))
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


def _numbers(values: Any, name: str, step: int) -> Array:
    if not isinstance(values, list) or len(values) % step or not all(type(v) in (int, float) for v in values):
        raise ValueError(f"{name} must be a list of numbers, {step} for each; got {values!r:.80}")
    if not all(abs(value) < _FARTHEST for value in values):  # NaN, too, and integers too large for a float
        raise ValueError(f"{name} must lie between -1e6 and 1e6; got {values!r:.80}")
    return np.asarray(values, np.float64).reshape(-1, step)


def _rounded(value: float) -> float:
    return round(float(value), 2) + 0.0  # a sum with zero has no negative one


# -- polygons


def _outline(polygon: Any) -> list[Array]:
    corners = _numbers(polygon, "segmentation", 2) - 0.5
    if len(corners) < 3:
        raise ValueError(f"segmentation: a polygon must have three corners; got {polygon}")
    ends = np.roll(corners, -1, 0)
    counts = np.maximum(np.ceil(np.linalg.norm(ends - corners, axis=1) / _STEP), 1).astype(int)
    edges = zip(corners, ends, counts.tolist(), strict=True)
    return [np.linspace(a, b, n + 1) if n > 1 else np.stack([a, b]) for a, b, n in edges]


def _polygon(edges: list[Array], places: Array, valid: Flags, move: Move, size: tuple[int, int]) -> Array:
    """What became of a polygon (K, 2): its corners, and as many points between them as its edges are curved."""
    there = valid | _has_place(places)
    if not there.all():
        places, there = _pulled_in(np.concatenate(edges), places, there, move, size)
    ends = np.cumsum([len(edge) for edge in edges])[:-1]
    pieces = zip(np.split(places, ends), np.split(there, ends), strict=True)
    corners = np.concatenate([_simplified(edge[there]) for edge, there in pieces])
    once: Array = corners[(corners != np.roll(corners, -1, 0)).any(1)]
    return once


def _has_place(places: Array) -> Flags:
    has: Flags = (places != -1).any(-1)
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


def _pulled_in(points: Array, places: Array, there: Flags, move: Move, size: tuple[int, int]) -> tuple[Array, Flags]:
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


# -- runs
#
# Down the columns, one after another, beginning with zeros; "Data format" of cocodataset.org. As a text each number is
# groups of five bits, the lowest first, with a sixth one where more follow, as characters from "0" on; from the fourth
# number on it is the difference to the one before last. pycocotools reads past the end of texts that are cut off.


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


def encoded(mask: Flags, *, as_text: bool) -> list[int] | str:
    """The runs of a mask (H, W)."""
    flat = np.concatenate([[False], mask.T.reshape(-1)])
    runs: list[int] = np.diff(np.flatnonzero(flat[1:] != flat[:-1]), prepend=0, append=mask.size).tolist()
    if not as_text:
        return runs
    text = ""
    for i, run in enumerate(runs):
        rest, more = run - runs[i - 2] if i > 2 else run, True
        while more:
            low, rest = rest & 31, rest >> 5
            more = rest != (-1 if low & 16 else 0)
            text += chr(low + 32 * more + 48)
    return text


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
