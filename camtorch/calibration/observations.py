"""Object points and image points of a calibration as padded tensors, and results in the form of these."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from camtorch.values.arguments import Numbers, as_image_size, as_values, shown, warn

Points: TypeAlias = Numbers | Sequence[Numbers | None]
"""Points of all views: a tensor, an array, or a list with one of them, or None, for each view."""
Array: TypeAlias = NDArray[Any]

_LEAST_CORNERS = 4
_FLAT = 1e-5  # the width of a set of points over its length, below which it is a line
_ROUNDING = 1e-11  # of coordinates: rounding of points far from the board's origin
_LEAST_UNIT, _MOST_UNIT = 1e-30, 1e30
_NORMALISED = 3.0  # px: coordinates that all are smaller are normalised ones
_RIM = 0.02  # of the longer side: no detector finds corners further outside the image
_MANY_OUTSIDE = 0.2  # of all corners, more than a robust loss can bear
_FEW_OUTSIDE, _FEW_LEFT = 0.02, 0.2  # of all corners outside, and of these with the image's sides exchanged
_MOST_OF_A_VIEW = 0.5
_NOWHERE = 10.0  # times the longer side: not even an outlier is so far outside
_SAME_PIXEL = 3  # corners of a view at one pixel
_SAME_ERRORS = 0.1  # the squared distance of two views over their squared residuals, which is 1 for independent noise
_SAME_NOISE = 0.1  # px, the distance of two views that saving a file again may cause
_NAMED = 6  # views at most, in a message


class Observations(NamedTuple):
    """Corners of boards and their pixels in one camera: float64, padded to the number of the fullest view."""

    points: Tensor  # (V, N, 3) in the board's frame, 0 if padded
    pixels: Tensor  # (V, N, 2), 0 if unseen
    seen: Tensor  # (V, N) bool

    def of(self, views: Tensor) -> Observations:
        return Observations(*(t[views] for t in self))


class Layout(NamedTuple):
    """The form of one camera's image points as they were passed."""

    shapes: tuple[tuple[int, ...], ...]  # of each view that was passed, without the last dim; (N,) for None
    stacked: bool  # whether they were one tensor or array, not a list
    views: Tensor  # (V,) the indices of passed views that have corners
    seen: Tensor  # (V, N) of the observations
    image_size: tuple[int, int]  # (height, width)
    copies: tuple[int, ...]  # the indices of passed views without new evidence: see `_observed` and `repeats`

    def restore(self, values: Tensor) -> Any:
        """Return results (V, N, k) or (V, N) in the form of the image points, NaN (of bool: False) if unseen."""
        rest, empty = values.shape[2:], values.new_tensor(False if values.dtype == torch.bool else torch.nan)
        full = empty.repeat(len(self.shapes), *values.shape[1:])
        full[self.views] = torch.where(self.seen.reshape(*self.seen.shape, *[1] * len(rest)), values, empty)
        if self.stacked:
            return full.reshape(len(full), *self.shapes[0], *rest)
        return [row[: math.prod(shape)].reshape(*shape, *rest) for row, shape in zip(full, self.shapes, strict=True)]


def as_observations(
    object_points: Points, image_points: Points, image_size: Sequence[int], owner: str
) -> tuple[Observations, Layout]:
    """Return the observations of one camera, of views that have corners, and the form for its results."""
    if isinstance(image_points, Mapping):
        raise TypeError(f"{owner}: image_points must be a tensor or a list; got a mapping. Use calibrate_rig for it")
    return _observed(object_points, {"": image_points}, {"": image_size}, owner)[""]


def as_rig_observations(
    object_points: Points,
    image_points: Mapping[str, Points],
    image_sizes: Mapping[str, Sequence[int]],
    models: Mapping[str, Any],
    owner: str,
) -> dict[str, tuple[Observations, Layout]]:
    """Return the observations of a rig's cameras of the same boards, by name in the order of the models."""
    for argument, given in {"models": models, "image_points": image_points, "image_sizes": image_sizes}.items():
        if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
            got = f"{type(given).__name__} {shown(given)}"
            raise TypeError(f"{owner}: {argument} must be a mapping by names of cameras; got {got}")
        if not given or set(given) != set(models):
            raise ValueError(
                f"{owner}: models, image_points and image_sizes must name the same cameras; got {argument} of "
                f"{list(given)} and models of {list(models)}"
            )
    return _observed(object_points, {name: image_points[name] for name in models}, image_sizes, owner)


def repeats(cameras: Sequence[Observations], residuals: Sequence[Tensor]) -> Tensor:
    """Return views (R,) that show an earlier one again with its errors, as a file saved twice or a frozen frame does.

    If the noise of two views is independent, their corners differ by at least both errors together; in such a pair they
    differ by less than a third of that. residuals: of each camera (V, N, 2).
    """
    seen = torch.cat([one.seen for one in cameras], -1)
    pixels = torch.cat([one.pixels for one in cameras], 1)
    size = (torch.cat(list(residuals), 1).square().sum(-1) * seen).sum(-1)
    order = pixels.sum((1, 2)).argsort(stable=True)  # similar views become neighbours
    before, after = order[:-1], order[1:]
    apart = (pixels[after] - pixels[before]).square().sum((1, 2))
    alike = (seen[after] == seen[before]).all(-1) & (apart <= _SAME_ERRORS * (size[after] + size[before]))
    alike &= apart <= _SAME_NOISE**2 * seen[after].sum(-1)
    group = torch.nn.functional.pad((~alike).cumsum(0), (1, 0))
    first = torch.full_like(order, len(order)).scatter_reduce(0, group, order, "amin")
    return order[first[group] != order].sort().values


def _observed(
    object_points: Points, image_points: Mapping[str, Points], image_sizes: Mapping[str, Any], owner: str
) -> dict[str, tuple[Observations, Layout]]:
    """Return the observations of cameras by name, "" for a single one, without views that have no corners."""
    labels = {name: f"image_points[{name!r}]" if name else "image_points" for name in image_points}
    given = {name: _in_views(image_points[name], 2, label, owner) for name, label in labels.items()}
    boards, *_ = _in_views(object_points, 3, "object_points", owner)
    numbers = {label: len(given[name][0]) for name, label in labels.items()}
    numbers |= {"object_points": len(boards)} if len(boards) > 1 or boards[0] is None else {}
    if len(set(numbers.values())) > 1:
        raise ValueError(f"{owner}: all arguments must have the same views; got numbers of views {numbers}")
    boards = boards * len(next(iter(given.values()))[0]) if len(boards) == 1 else boards
    lengths = [0 if board is None else len(board) for board in boards]
    points, sizes, pixels = _pad(boards, max(lengths), 3), {}, {}
    seen: dict[str, Array] = {}
    for name, (views, *_) in given.items():
        size_label = f"image_sizes[{name!r}]" if name else "image_size"
        if (size := as_image_size(image_sizes[name], owner, size_label)) is None:
            raise ValueError(f"{owner}: {size_label} must be given; got None. Pass (height, width), image.shape[:2]")
        for i, (view, length) in enumerate(zip(views, lengths, strict=True)):
            if view is not None and len(view) not in (0, length):
                raise ValueError(
                    f"{owner}: view {i}: {labels[name]}[{i}] must be as many corners as object_points, {length} (inner "
                    f"ones of a chessboard); got {len(view)}. Pass rows of NaN for corners that were not found"
                )
        of = _pad(views, max(lengths), 2)
        seen[name] = ~np.isnan(of.sum(-1))
        sizes[name], pixels[name] = size, np.where(seen[name][..., None], of, np.nan)
        _check_corners(points, pixels[name], seen[name], labels[name], owner)
        _check_inside(pixels[name], seen[name], labels[name], size, size_label, owner)
    sees: Array = np.stack([of.any(-1) for of in seen.values()])
    # cameras must share a view, at least by way of others, with the first
    names, linked = list(given), np.arange(len(given)) == 0
    for _ in names:
        linked = linked | (sees & sees[linked].any(0)).any(-1)
    if not linked.all():
        apart = ", ".join(repr(name) for name, is_linked in zip(names, linked, strict=True) if not is_linked)
        raise ValueError(
            f"{owner}: cameras must share views with {names[0]!r}, directly or through others; got no such view of "
            f"{apart}. Take views that both see, or calibrate it alone"
        )
    first: dict[bytes, int] = {}
    has: Array = np.any(sees, 0)
    rows = enumerate(np.concatenate([_sort_rows(of) for of in pixels.values()], 1) + 0.0)
    copy: Array = has & np.array([first.setdefault(row.tobytes(), i) != i for i, row in rows])
    for left_out, why in ((~has, "nothing was seen"), (copy, "the corners are those of another view")):
        if left_out.any():
            warn(f"{owner}: {_views_of(left_out)} left out, because {why}")
    every = [v for value in image_points.values() for v in (value if isinstance(value, (list, tuple)) else [value])]
    device = next((view.device for view in every if isinstance(view, Tensor)), torch.device("cpu"))
    kept, found = np.flatnonzero(has & ~copy), {}
    for name, (_, shapes, stacked) in given.items():
        arrays = np.nan_to_num(points[kept]), np.nan_to_num(pixels[name][kept]), seen[name][kept], kept
        *corners, numbered = (torch.as_tensor(array, device=device) for array in arrays)
        forms = tuple((n,) if shape is None else shape for n, shape in zip(lengths, shapes, strict=True))
        copies = tuple(np.flatnonzero(copy & seen[name].any(-1)).tolist())
        found[name] = Observations(*corners), Layout(forms, stacked, numbered, corners[2], sizes[name], copies)
    return found


def _in_views(
    value: Points, size: int, name: str, owner: str
) -> tuple[list[Array | None], list[tuple[int, ...] | None], bool]:
    """Return points (n, size) of each view, their shapes (None for no points), and whether they were one array."""
    parts: list[Array | None] = []
    if isinstance(value, (list, tuple)):
        parts = [None if p is None else _as_array(p, size, f"{name}[{i}]", owner) for i, p in enumerate(value)]
    are_rows = bool(parts) and all(p is not None and p.ndim == 1 <= p.size for p in parts)  # of plain numbers
    stacked, is_one = are_rows or not isinstance(value, (list, tuple)), False
    if stacked:
        whole = _as_array(value, size, name, owner)
        # (N, 1, size) is OpenCV's form of one set of points
        is_one = whole.ndim < 3 or (whole.ndim == 3 and whole.shape[1] == 1 < whole.shape[0])
        parts = [whole] if is_one else list(whole)
    if all(part is None for part in parts):
        raise ValueError(f"{owner}: {name} must have a view with points; got {shown(value)}")
    rows: list[Array | None] = []
    for i, part in enumerate(parts):
        flat = part if part is None or part.size else np.empty((0, size))
        if flat is not None and flat.ndim == 3 and 1 in flat.shape[:2]:
            flat = flat.reshape(-1, flat.shape[-1])
        if flat is not None and (flat.ndim != 2 or flat.shape[1] != size or (is_one and size == 2)):
            form = f"(V, N, {size}) or a list of (N_i, {size})" if stacked and size == 2 else f"(N, {size})"
            shape = whole.shape if stacked or part is None else part.shape
            raise ValueError(f"{owner}: {name}{'' if stacked else f'[{i}]'} must be {form}; got shape {shape}")
        rows.append(flat)
    return rows, [None if p is None else p.shape[:-1] or (0,) for p in parts], stacked


def _as_array(value: Any, size: int, name: str, owner: str) -> Array:
    """Return a float64 array; None among the numbers of a list becomes NaN."""
    if isinstance(value, (list, tuple)):
        try:
            plain = [v.numpy(force=True) if isinstance(v, Tensor) else v for v in value]
            value = np.asarray([[math.nan] * size if v is None else v for v in plain], np.float64)
        except (TypeError, ValueError) as error:
            raise type(error)(f"{owner}: {name} must be rows of {size} numbers; got {shown(value)}: {error}") from None
    values = as_values(value, name, owner, value.device if isinstance(value, Tensor) else torch.device("cpu"))
    if values.is_meta:
        raise ValueError(f"{owner}: {name} must have values; got a tensor on the device meta")
    return values.detach().double().numpy(force=True)


def _pad(views: Sequence[Array | None], count: int, size: int) -> Array:
    """Pad the points of views to (V, count, size) with NaN."""
    padded = np.full((len(views), count, size), np.nan)
    for row, points in zip(padded, views, strict=True):
        if points is not None:
            row[: len(points)] = points
    return padded


def _sort_rows(rows: Array) -> Array:
    """Sort the rows (V, N, k) of each view, NaN last."""
    return np.take_along_axis(rows, np.lexsort(np.moveaxis(rows, -1, 0))[..., None], 1)


def _has_repeats(rows: Array, times: int) -> Array:
    """Whether so many rows (V, N, k) of a view are equal, (V,); NaN equals nothing."""
    ordered = _sort_rows(rows)
    same: Array = (ordered[:, times - 1 :] == ordered[:, : rows.shape[1] - times + 1]).all(-1).any(-1)
    return same


def _check_corners(points: Array, pixels: Array, seen: Array, name: str, owner: str) -> None:
    """Raise if corners determine no pose; points (V, N, 3) and pixels (V, N, 2) are NaN if padded."""
    number, corners = seen.sum(-1), np.where(seen[..., None], points, np.nan)
    if not number.any():
        raise ValueError(f"{owner}: {name} must have seen corners; got NaN in all views")
    known = np.nan_to_num(corners, posinf=0.0, neginf=0.0)
    reach = np.abs(known).max((1, 2))
    known = known / np.where(reach > 0, reach, 1.0)[:, None, None]
    offsets = (known - known.sum(1, keepdims=True) / np.maximum(number, 1)[:, None, None]) * seen[..., None]
    spread = np.sqrt(np.linalg.eigvalsh(offsets.swapaxes(1, 2) @ offsets).clip(min=0))  # (V, 3) ascending
    thin = spread[:, 1] <= np.maximum(_FLAT * spread[:, 2], _ROUNDING)
    odd, at_one = (reach > 0) & ((reach <= _LEAST_UNIT) | (reach >= _MOST_UNIT)), _has_repeats(pixels, _SAME_PIXEL)
    for wrong, words in (
        (np.isinf(pixels).any((1, 2)), f"{name} must not be infinite; unseen corners are NaN"),
        (number < _LEAST_CORNERS, f"{name} must have {_LEAST_CORNERS} or more seen corners; or leave it out"),
        ((~np.isfinite(corners).all(-1) & seen).any(-1), "object_points must be finite where image_points are"),
        (odd, f"object_points must be in a unit near the board's size; got up to {reach.max():.3g}"),
        (thin, "object_points of the seen corners must not lie on one line, or be the same point"),
        (_has_repeats(corners, 2), "object_points must have each corner once; got one twice"),
        (at_one, f"{name} must not have {_SAME_PIXEL} corners at one pixel; corners that were not found are NaN"),
    ):
        if (wrong & (number > 0)).any():
            raise ValueError(f"{owner}: {_views_of(wrong & (number > 0))}: {words}")


def _check_inside(pixels: Array, seen: Array, name: str, size: tuple[int, int], size_name: str, owner: str) -> None:
    """Raise if pixels do not lie in an image of this size."""
    found = pixels[seen]
    low, high = ("({:.6g}, {:.6g})".format(*end) for end in (found.min(0), found.max(0)))
    if np.abs(found).max() < _NORMALISED < min(size) / 2:
        raise ValueError(
            f"{owner}: {name} must be pixels, not normalised coordinates; got {low} to {high} in an image of "
            f"{size[0]} x {size[1]}"
        )

    def outside(sides: tuple[int, int], rim: float) -> Array:
        over = np.maximum(pixels - np.array(sides[::-1]) + 1.0, -pixels)
        far: Array = (over > rim * max(size)).any(-1)  # False for NaN
        return far

    out = outside(size, _RIM)
    number, total = int(out.sum()), len(found)
    exchanged = number > _FEW_OUTSIDE * total and int(outside(size[::-1], _RIM).sum()) <= _FEW_LEFT * number
    views: Array = (out.sum(-1) > _MOST_OF_A_VIEW * seen.sum(-1)) | outside(size, _NOWHERE).any(-1)
    if exchanged or number > _MANY_OUTSIDE * total or views.any():
        raise ValueError(
            f"{owner}: {name} must lie in the image of {size_name} {size}; got {number} of {total} corners outside, in "
            f"{_views_of(views if views.any() else out.sum(-1))}, from {low} to {high}. {size_name} is "
            "(height, width) of all images, as image.shape[:2], points are (u, v), and unseen corners NaN"
        )


def _views_of(views: Array) -> str:
    """Return the views of a mask (V,) in words."""
    return named(np.flatnonzero(views).tolist())


def named(views: Sequence[int]) -> str:
    """Return views by their numbers, in words."""
    more = f" and {len(views) - _NAMED} more" if len(views) > _NAMED else ""
    return f"view{'s' * (len(views) > 1)} {', '.join(map(str, views[:_NAMED]))}{more}"
