"""Annotations in COCO's format: read, and moved with their image from one camera to another.

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

import torch
from torch import Tensor

from camtorch.augment.change import Change
from camtorch.augment.sample import KINDS, moves
from camtorch.camera import Camera
from camtorch.cli import rle
from camtorch.cli.labels import LabelsError
from camtorch.warp.warp import within

Json = dict[str, Any]
_STEP = 8.0  # pixels: between points of a polygon's edge that are moved
_SAG = 0.1  # pixels by which a straight edge may miss the curve that it stands for
_COARSE = 8  # pixels of the new image between those of which it is asked what they show
_HALVINGS = 24  # of a way of some hundred pixels: 1e-4 of one are left
_LEAST = 0.01  # square pixels
_FARTHEST = 1e6  # pixels
_3D = ("gaze", "directions", "pitch_yaw", "points", "head_pose", "pose", "rvec", "tvec")
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
    count: int
    """Of annotations."""

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
    known: set[Any] = set()
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
        if image["id"] in known:
            raise LabelsError(f"{path}: images[{i}]: another one has the id {image['id']!r:.60}")
        known.add(image["id"])
    of: dict[Any, list[tuple[int, Json]]] = {}
    for i, one in enumerate(annotations):
        if not isinstance(one, dict) or not isinstance(one.get("image_id"), (int, str)):
            raise LabelsError(f"{path}: annotations[{i}]: must be an object with an image_id")
        if one["image_id"] not in known:
            raise LabelsError(f"{path}: annotations[{i}]: no image has the id {one['image_id']!r:.60}")
        of.setdefault(one["image_id"], []).append((i, one))
    return DataSet(path, content, images, of, len(annotations))


def parts_of(camera: Camera) -> Json:
    """A camera as JSON."""
    return {
        "model": camera.key,
        "intrinsics": camera.intrinsics.detach().tolist(),
        "distortion": camera.distortion.detach().tolist(),
        "image_size": [camera.height, camera.width],
    }


# -- one image's annotations


@dataclass
class _Parts:
    """What of an annotation moves."""

    keypoints: Tensor | None
    """(N, 3) x, y, v."""
    polygons: list[Tensor]
    """(K, 2) each, between pixel centres."""
    mask: Tensor | None
    """(H, W) uint8."""
    box: Tensor | None
    """(4,) x1, y1, x2, y2, between pixel centres."""


def moved(
    annotations: Sequence[Json], change: Change, tell: Callable[[str], None] = lambda text: None
) -> list[Json | None]:
    """The annotations of an image after a change of its camera; None for those of which nothing is seen any more.

    Of keypoints those off the image get 0, 0, 0, and `num_keypoints` counts the others. Polygons are moved with points
    between their corners where edges get curved, end at the rim of what can be mapped, and are clipped; runs are moved
    as masks. The box is that of what is left of polygons or runs, else the one that encloses the moved box, clipped.
    The area is that of what is left, or the old one's part of its box. `gaze`, `head_pose` and other fields in the
    camera's frame turn with it.

    Args:
        annotations: of one image.
        change: of one sample.
        tell: hears of numbers that stay as they are.

    Raises:
        ValueError: what is not as COCO has it; the text names the annotation.
    """
    source, target = change.source[0], change.target[0]
    sizes = (source.height, source.width), (target.height, target.width)
    parts = [_parts(one, sizes[0]) for one in annotations]
    points = [part.keypoints[:, :2] for part in parts if part.keypoints is not None]
    edges = [_along(polygon) for part in parts for polygon in part.polygons]
    boxes = [part.box for part in parts if part.box is not None]
    masks = [part.mask for part in parts if part.mask is not None]
    counts = [len(one) for one in (*points, *edges)]
    some = torch.cat([*points, *edges, torch.zeros(0, 2, dtype=torch.float64)])
    everywhere, on_image = (value[0] for value in change.points(some[None]))
    on_image = on_image & source.contains(some)
    there = on_image | (everywhere != -1).any(-1)
    pieces = iter(zip(*(value.split(counts) for value in (everywhere, on_image, there)), strict=True))
    of_points = [next(pieces) for _ in points]
    of_edges = _pulled_in(edges, [(places, there) for places, _, there in pieces], change)
    of_boxes = zip(*(value[0] for value in change.boxes(torch.stack(boxes)[None])), strict=True) if boxes else ()
    of_masks = change.labels(torch.stack(masks)[None])[0] if masks else ()
    iterators = iter(of_points), iter(of_edges), iter(of_boxes), iter(of_masks)
    result = [_put(one, part, sizes[1], iterators) for one, part in zip(annotations, parts, strict=True)]
    for new in result:
        if new is not None:
            _turn(new, change, tell)
    return result


def _parts(one: Json, size: tuple[int, int]) -> _Parts:
    try:
        return _read_parts(one, size)
    except (ValueError, TypeError) as error:
        raise ValueError(f"annotation {one.get('id')!r:.40}: {error}") from None


def _read_parts(one: Json, size: tuple[int, int]) -> _Parts:
    keypoints = box = mask = None
    polygons = []
    if one.get("keypoints"):
        keypoints = _numbers(one["keypoints"], "keypoints", 3).reshape(-1, 3)
    if one.get("bbox"):
        numbers = _numbers(one["bbox"], "bbox", 4).tolist()
        if len(numbers) != 4 or min(numbers[2:]) < 0:
            raise ValueError(f"bbox must be [x, y, width, height]; got {one['bbox']!r:.80}")
        x, y, width, height = numbers
        box = torch.tensor([x, y, x + width, y + height], dtype=torch.float64) - 0.5
    segmentation = one.get("segmentation")
    if isinstance(segmentation, Mapping):
        stated = segmentation.get("size")
        if stated != list(size):
            raise ValueError(f"segmentation has the size {stated}, the image {list(size)}, height and width")
        mask = torch.from_numpy(rle.decode(segmentation.get("counts"), size).astype("uint8"))
    elif segmentation:
        if not isinstance(segmentation, list):
            raise ValueError(f"segmentation must be a list of polygons, or an object of runs; got {segmentation!r:.80}")
        for polygon in segmentation:
            corners = _numbers(polygon, "segmentation", 2).reshape(-1, 2) - 0.5
            if len(corners) < 3:
                raise ValueError(f"segmentation: a polygon must have three corners; got {polygon}")
            polygons.append(corners)
    return _Parts(keypoints, polygons, mask, box)


def _numbers(values: Any, name: str, step: int) -> Tensor:
    if not isinstance(values, list) or len(values) % step or not all(type(v) in (int, float) for v in values):
        raise ValueError(f"{name} must be a list of numbers, {step} for each; got {values!r:.80}")
    if not all(abs(value) < _FARTHEST for value in values):  # NaN, too, and integers too large for a float
        raise ValueError(f"{name} must lie between -1e6 and 1e6; got {values!r:.80}")
    return torch.tensor(values, dtype=torch.float64)


def _put(one: Json, part: _Parts, size: tuple[int, int], moved: tuple[Any, ...]) -> Json | None:
    """The annotation, of what has become of its parts, which are taken from iterators over those of all."""
    (of_points, of_edges, of_boxes, of_masks), (height, width) = moved, size
    new, is_seen = dict(one), part.keypoints is None
    if part.keypoints is not None:
        places, valid, _ = next(of_points)
        shown = valid & (part.keypoints[:, 2] > 0)
        rows = torch.where(shown[:, None], torch.cat((places, part.keypoints[:, 2:]), -1), 0.0)
        new["keypoints"] = [n for x, y, v in rows.tolist() for n in (_rounded(x), _rounded(y), int(v))]
        new["num_keypoints"] = int(shown.sum())
        is_seen = bool(shown.any())
    box = area = None
    if part.box is not None:
        outline, valid = next(of_boxes)
        limits = outline.new_tensor([width, height] * 2) - 0.5
        clipped = torch.minimum(outline.clamp(min=-0.5), limits) + 0.5
        x1, y1, x2, y2 = clipped.tolist()
        if bool(valid) and x2 > x1 and y2 > y1:
            box = [x1, y1, x2 - x1, y2 - y1]
            old = float((part.box[2:] - part.box[:2]).prod())
            area = one["area"] * box[2] * box[3] / old if old and type(one.get("area")) in (int, float) else None
    if part.polygons:
        clipped_polygons = [_clipped(_thinned(one, *next(of_edges)), width, height) for one in part.polygons]
        kept = [polygon for polygon in clipped_polygons if _area(polygon) >= _LEAST]
        new["segmentation"] = [[_rounded(v + 0.5) for corner in polygon for v in corner] for polygon in kept]
        area = sum(map(_area, kept))
        corners = [corner for polygon in kept for corner in polygon]
        box = _enclosing(corners) if corners else None
    elif part.mask is not None:
        mask = next(of_masks) > 0
        counts = rle.encode(mask.numpy(), as_text=isinstance(one["segmentation"]["counts"], str))
        new["segmentation"] = {**one["segmentation"], "counts": counts, "size": [height, width]}
        area = int(mask.sum())
        rows, columns = (mask.any(dim).nonzero() for dim in (1, 0))
        box = None
        if len(rows):
            left, top = int(columns[0]), int(rows[0])
            box = [left, top, int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top]
    if one.get("bbox"):
        new["bbox"] = None if box is None else [_rounded(v) for v in box]
    if "area" in one and area is not None:
        new["area"] = _rounded(area)
    if part.box is not None or part.polygons or part.mask is not None:
        is_seen = box is not None
    return new if is_seen else None


def _rounded(value: float) -> float:
    return round(value, 2) + 0.0  # a sum with zero has no negative one


def _turn(one: Json, change: Change, tell: Callable[[str], None]) -> None:
    """Move what is in the camera's frame."""
    for name, value in one.items():
        kind = max((k for k in _3D if name == k or name.startswith(k + "_")), key=len, default=None)
        if kind is None:
            if name not in _OWN and _holds_reals(value):
                tell(f"{name!r} of annotations holds numbers that stay as they are")
            continue
        field = KINDS[kind]
        try:
            tensor = torch.tensor(value, dtype=torch.float64)
        except (ValueError, TypeError):
            tensor = torch.zeros(0)
        if not field.dims <= tensor.ndim <= field.most_dims or tensor.shape[-1] not in field.last:
            which = f"annotation {one.get('id')!r:.40}: {name}"
            raise ValueError(f"{which} must be {field.shape.replace('B, ', '')}; got {value!r:.60}")
        one[name] = moves(kind, tensor)(change, tensor[None], {})[0].tolist()


def _holds_reals(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(map(_holds_reals, value.values()))
    return isinstance(value, list) and any(isinstance(item, float) or _holds_reals(item) for item in value)


# -- polygons


def _samples(corners: Tensor) -> list[int]:
    """Into how many pieces each edge is cut."""
    lengths = (corners.roll(-1, 0) - corners).norm(dim=-1)
    return [max(1, math.ceil(length / _STEP)) for length in lengths.tolist()]


def _along(corners: Tensor) -> Tensor:
    """Points along the edges of a polygon (K, 2), each edge from its corner on."""
    edges = zip(corners, corners.roll(-1, 0), _samples(corners), strict=True)
    return torch.cat([a + (b - a) * torch.arange(n, dtype=a.dtype)[:, None] / n for a, b, n in edges])


def _pulled_in(
    edges: Sequence[Tensor], moved: Sequence[tuple[Tensor, Tensor]], change: Change
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """(K, 2) places of the points of every polygon, (K,) which are their own, and which there are.

    What has no place takes that of the point where one last exists on the way to the middle of what the new image
    shows: an outline around all that can be mapped so becomes its rim.
    """
    result = [(places, own, own) for places, own in moved]
    partly = [i for i, (_, own) in enumerate(moved) if not bool(own.all())]
    if not partly:
        return result
    target = change.target[0]
    shown = change.inverse().points(target.pixel_grid()[::_COARSE, ::_COARSE].flatten(0, 1).double()[None])[0][0]
    shown = shown[(shown != -1).any(-1)]
    if not len(shown):
        return result
    middle = shown[(shown - shown.mean(0)).norm(dim=-1).argmin()]
    # what lies beyond all that can be mapped, and not around it, stays away
    partly = [i for i in partly if bool(moved[i][1].any()) or bool(within(edges[i], middle[None]))]
    if not partly:
        return result
    points = torch.cat([edges[i][~moved[i][1]] for i in partly])
    least, most = torch.zeros(len(points), 1).double(), torch.ones(len(points), 1).double()

    def at(share: Tensor) -> Tensor:
        return change.points((points + share * (middle - points))[None])[0][0]

    for _ in range(_HALVINGS):
        share = (least + most) / 2
        mapped = (at(share) != -1).any(-1, keepdim=True)
        least, most = torch.where(mapped, least, share), torch.where(mapped, share, most)
    found = iter(at(most).split([int((~moved[i][1]).sum()) for i in partly]))
    for i in partly:
        places, own = moved[i]
        result[i] = places.index_put((~own,), next(found).to(places)), own, torch.ones_like(own)
    return result


def _thinned(corners: Tensor, places: Tensor, own: Tensor, there: Tensor) -> list[tuple[float, float]]:
    """What became of a polygon: its corners, and as many points between them as its edges are curved."""
    everywhere: list[tuple[float, float]] = list(zip(*places.T.tolist(), strict=True))
    is_own: list[bool] = own.tolist()
    is_there: list[bool] = there.tolist()
    points: list[tuple[float, float]] = []
    first = 0
    for count in _samples(corners):
        edge = everywhere[first : first + count + 1]
        if len(edge) == count:  # the last one, which closes it
            edge.append(everywhere[0])
        wanted = count
        if count > 1 and all(is_own[first : first + count]) and is_own[(first + count) % len(is_own)]:
            wanted = min(count, max(1, math.ceil(math.sqrt(_sag(edge) / _SAG))))
        kept = sorted({round(j * count / wanted) for j in range(wanted)})
        points += [edge[j] for j in kept if is_there[first + j]]
        first += count
    return points


def _sag(edge: list[tuple[float, float]]) -> float:
    """How far points are from the line between the first one and the last."""
    (x, y), (x1, y1) = edge[0], edge[-1]
    across, down = x1 - x, y1 - y
    return max(abs((u - x) * down - (v - y) * across) for u, v in edge) / max(math.hypot(across, down), 1e-9)


def _clipped(polygon: list[tuple[float, float]], width: int, height: int) -> list[tuple[float, float]]:
    """The part of a polygon on an image, by Sutherland and Hodgman: parts are joined along the image's edge."""
    for axis, limit, sign in ((0, -0.5, 1), (0, width - 0.5, -1), (1, -0.5, 1), (1, height - 0.5, -1)):
        before, polygon = polygon, []
        for a, b in zip(before[-1:] + before[:-1], before, strict=True):
            inside = sign * (a[axis] - limit) >= 0, sign * (b[axis] - limit) >= 0
            if inside[0] != inside[1]:
                share = (limit - a[axis]) / (b[axis] - a[axis])
                other = a[1 - axis] + share * (b[1 - axis] - a[1 - axis])
                polygon.append((limit, other) if axis == 0 else (other, limit))
            if inside[1]:
                polygon.append(b)
    return polygon


def _area(polygon: list[tuple[float, float]]) -> float:
    pairs = zip(polygon, polygon[1:] + polygon[:1], strict=True)
    return abs(sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in pairs)) / 2


def _enclosing(corners: list[tuple[float, float]]) -> list[float]:
    """[x, y, width, height] between pixel edges."""
    low, high = ([end(values) for values in zip(*corners, strict=True)] for end in (min, max))
    return [low[0] + 0.5, low[1] + 0.5, high[0] - low[0], high[1] - low[1]]
