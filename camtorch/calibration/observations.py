"""What users pass as object points and image points, brought into padded tensors, and results brought back."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from camtorch._arguments import Numbers, as_image_size

Points: TypeAlias = "Numbers | Sequence[Numbers | None]"
"""Points of all views: a tensor, an array, or a list with one of them, or None, for each view."""

_LEAST_CORNERS = 4
_FLAT = 1e-5  # the width of a set of points over its length, below which it is a line
_ROUNDING = 1e-11  # of coordinates, which a board's origin far away leaves of its points
_LEAST_UNIT, _MOST_UNIT = 1e-30, 1e30
_NORMALISED = 3.0  # pixels that none of an image's coordinates exceeds if they are no pixels
_RIM = 0.02  # of the longer side: further outside the image no corner is found
_MANY_OUTSIDE = 0.2  # of all corners, more than a robust loss would be asked to bear
_FEW_OUTSIDE, _FEW_LEFT = 0.02, 0.2  # of all corners, of which so few are left with the sides of the image exchanged
_MOST_OF_A_VIEW = 0.5
_NOWHERE = 10.0  # times the longer side: no corner at all, not even an outlier
_SAME_PIXEL = 3  # corners of a view at one pixel
_SAME_ERRORS = 0.1  # the squared distance of two views over their squared residuals: 1 where noise is independent
_SAME_NOISE = 0.1  # px, the distance of two views that saving a file anew may make
_NAMED = 8  # views, in a message


class Observations(NamedTuple):
    """Corners of boards and where one camera sees them: float64, padded to as many as the fullest view has."""

    points: Tensor
    """(V, N, 3) in the board's frame, 0 where padded."""
    pixels: Tensor
    """(V, N, 2), 0 where unseen."""
    seen: Tensor
    """(V, N) bool."""

    def of(self, views: Tensor) -> Observations:
        """Those of some views, given by numbers or by a mask."""
        return Observations(*(t[views] for t in self))

    def about(self, middle: Tensor) -> Observations:
        """With the points about another origin (3,)."""
        return self._replace(points=torch.where(self.seen[..., None], self.points - middle, 0.0))


class Layout(NamedTuple):
    """The form in which the image points of one camera came."""

    shapes: tuple[tuple[int, ...], ...]
    """Of each view that was passed, without the last dim; where it was None, (N,) of its object points."""
    stacked: bool
    """Whether they were one tensor or array, not a list."""
    views: Tensor
    """(V,) the numbers of the views that have corners, of those that were passed."""
    seen: Tensor
    """(V, N) of the observations."""
    image_size: tuple[int, int]
    """(height, width)."""
    copies: tuple[int, ...]
    """The numbers of the views, of those that were passed, that are no new evidence: see `_kept` and `repeats`."""

    def restore(self, values: Tensor) -> Any:
        """Results of the observations in the form of the image points, NaN (of bool: False) where nothing was seen.

        Args:
            values: (V, N, k) or (V, N).

        Returns:
            (V', *, k) for one tensor of V' views, or a list of a tensor (*, k) for each view; k is missing where it is
            in the values.
        """
        empty = False if values.dtype == torch.bool else torch.nan
        rest = values.shape[2:]
        seen = self.seen.reshape(*self.seen.shape, *[1] * len(rest))
        full = values.new_full((len(self.shapes), *values.shape[1:]), empty)
        full[self.views] = torch.where(seen, values, torch.full_like(values, empty))
        if self.stacked:
            return full.reshape(len(full), *self.shapes[0], *rest)
        return [row[: math.prod(shape)].reshape(*shape, *rest) for row, shape in zip(full, self.shapes, strict=True)]


def as_observations(
    object_points: Points, image_points: Points, image_size: Sequence[int], owner: str
) -> tuple[Observations, Layout]:
    """What one camera sees.

    Args:
        object_points: (N, 3) for all views, (V, N, 3), or a list of (N_i, 3), in the board's frame.
        image_points: (V, N, 2) or a list of (N_i, 2), in which None is a view without corners; rows with NaN are
            unseen. In both, points may be OpenCV's (N, 1, 2), (1, N, 2).
        image_size: (height, width) in pixels.
        owner: the name of the function that asks, for messages.

    Returns:
        The views that have corners, detached, float64, on the device of the image points; and the form to bring
        results back into.

    Warns:
        UserWarning: a view has no corner, or those of an earlier one, and is left out.

    Raises:
        ValueError: shapes and numbers that do not fit, views of too few corners, corners on a line, corners twice,
            corners outside the image, infinite values. TypeError: no numbers.
    """
    if isinstance(image_points, Mapping):
        raise TypeError(f"{owner}: image_points of one camera are a tensor or a list; cameras by name make a rig")
    size = _as_size(image_size, "image_size", owner)
    given = _Given("image_points", "image_size", _image_views(image_points, "image_points", owner), size)
    board, (one,) = _together(object_points, [given], owner)
    _check_sight(board, one, owner)
    kept, copies = _kept([one], owner)
    return _observations(board, one, kept), _layout(board, one, kept, copies)


def as_rig_observations(
    object_points: Points,
    image_points: Mapping[str, Points],
    image_sizes: Mapping[str, Sequence[int]],
    models: Mapping[str, Any],
    owner: str,
) -> tuple[dict[str, Observations], dict[str, Layout]]:
    """What the cameras of a rig see: of every camera the same views of the same boards, by name in the models' order.

    Args:
        object_points: as `as_observations` takes them; of the boards, so the same for all cameras.
        image_points: by the name of a camera, as `as_observations` takes them; None or NaN where a camera does not see
            the board of a view.
        image_sizes: by the name of a camera, (height, width).
        models: by the name of a camera; only the names count.
        owner: the name of the function that asks, for messages.

    Warns:
        UserWarning: no camera sees the board of a view, or all see the corners of an earlier one: it is left out.

    Raises:
        ValueError: what `as_observations` refuses; names that differ; a camera that sees nothing; cameras that no
            board links. TypeError: no mappings.
    """
    names = _names({"models": models, "image_points": image_points, "image_sizes": image_sizes}, owner)
    given = []
    for name in names:
        points, size = f"image_points[{name!r}]", f"image_sizes[{name!r}]"
        views = _image_views(image_points[name], points, owner)
        given.append(_Given(points, size, views, _as_size(image_sizes[name], size, owner)))
    if len({len(one.views.rows) for one in given}) > 1:
        raise ValueError(
            f"{owner}: all cameras have the same views, None where one does not see the board; got "
            + ", ".join(f"{len(one.views.rows)} in {one.points_name}" for one in given)
        )
    board, cameras = _together(object_points, given, owner)
    for one in cameras:
        _check_sight(board, one, owner)
    _check_links(names, torch.stack([one.seen.any(-1) for one in cameras]), owner)
    kept, copies = _kept(cameras, owner)
    observations = {name: _observations(board, one, kept) for name, one in zip(names, cameras, strict=True)}
    return observations, {name: _layout(board, one, kept, copies) for name, one in zip(names, cameras, strict=True)}


def repeats(cameras: Sequence[Observations], residuals: Sequence[Tensor]) -> Tensor:
    """The rows of views that show another one again, its errors included: a file saved anew, a frame that stands still.

    Where the noise of two views is independent, corners differ by at least as much as both are wrong by; in such a pair
    they differ by less than a third of that. Images taken one after the other from a tripod have noise of their own.

    Args:
        cameras: what each saw of the same views.
        residuals: of each, (V, N, 2).

    Returns:
        (R,) all but the first of each group that is alike.
    """
    seen = torch.cat([one.seen for one in cameras], -1)
    pixels = torch.cat([one.pixels for one in cameras], 1)
    size = (torch.cat(list(residuals), 1).square().sum(-1) * seen).sum(-1)
    order = pixels.sum((1, 2)).argsort(stable=True)  # where those that are alike are neighbours
    before, after = order[:-1], order[1:]
    apart = (pixels[after] - pixels[before]).square().sum((1, 2))
    alike = (seen[after] == seen[before]).all(-1) & (apart <= _SAME_ERRORS * (size[after] + size[before]))
    alike &= apart <= _SAME_NOISE**2 * seen[after].sum(-1)
    group = torch.nn.functional.pad((~alike).cumsum(0), (1, 0))
    first = torch.full_like(order, len(order)).scatter_reduce(0, group, order, "amin")
    return order[first[group] != order].sort().values


# -- forms


class _Views(NamedTuple):
    """Points as they came, in views: (n, size) and the shape before the last dim, None where nothing was passed."""

    rows: list[Tensor | None]
    shapes: list[tuple[int, ...] | None]
    stacked: bool
    alone: bool
    """Whether it was one set of points, without a dim for views."""

    def padded(self, count: int, size: int, device: torch.device) -> Tensor:
        """(V, count, size), NaN where there is nothing."""
        padded = torch.full((len(self.rows), count, size), torch.nan, dtype=torch.float64, device=device)
        for row, points in zip(padded, self.rows, strict=True):
            if points is not None:
                row[: len(points)] = points
        return padded


class _Given(NamedTuple):
    """What was passed of one camera."""

    points_name: str
    size_name: str
    views: _Views
    image_size: tuple[int, int]


class _Board(NamedTuple):
    """The points (1 or V, N, 3) of the boards, NaN where padded, and how many there are in each."""

    points: Tensor
    counts: list[int]


class _Sight(NamedTuple):
    """What one camera sees: pixels (V, N, 2), NaN where nothing is seen, and seen (V, N)."""

    given: _Given
    pixels: Tensor
    seen: Tensor


def _observations(board: _Board, sight: _Sight, kept: Tensor) -> Observations:
    points = board.points.nan_to_num(nan=0.0).expand(len(sight.pixels), -1, -1)[kept]
    pixels = torch.where(sight.seen[..., None], sight.pixels, 0.0)[kept]
    return Observations(points.contiguous(), pixels, sight.seen[kept])


def _layout(board: _Board, sight: _Sight, kept: Tensor, copies: Sequence[int]) -> Layout:
    counts = board.counts * (len(sight.pixels) if len(board.counts) == 1 else 1)
    shapes = tuple((n,) if s is None else s for n, s in zip(counts, sight.given.views.shapes, strict=True))
    size, has = sight.given.image_size, sight.seen.any(-1).tolist()
    return Layout(shapes, sight.given.views.stacked, kept, sight.seen[kept], size, tuple(i for i in copies if has[i]))


def _together(object_points: Points, given: list[_Given], owner: str) -> tuple[_Board, list[_Sight]]:
    """The boards and what each camera sees of them, of as many points."""
    number, name = len(given[0].views.rows), given[0].points_name
    board = _in_views(object_points, 3, "object_points", owner)
    shared = len(board.rows) == 1
    if not shared and len(board.rows) != number:
        raise ValueError(
            f"{owner}: object_points are of {len(board.rows)} views and {name} of {number}; "
            f"give object_points (N, 3) for all views, or one for each view"
        )
    for one in given:
        for i, points in enumerate(one.views.rows):
            if points is not None and (len(points) or one.views.stacked):
                _check_count(board.rows[0 if shared else i], points, i, one, owner)
    counts = [0 if points is None else len(points) for points in board.rows]
    device = next(points.device for one in given for points in one.views.rows if points is not None)
    width = max(counts)
    sights = []
    for one in given:
        pixels = one.views.padded(width, 2, device)
        sights.append(_Sight(one, pixels, ~pixels.isnan().any(-1)))
    return _Board(board.padded(width, 3, device), counts), sights


def _check_count(board: Tensor | None, points: Tensor, view: int, given: _Given, owner: str) -> None:
    count = 0 if board is None else len(board)
    if count == len(points):
        return
    hint = ""
    if given.views.stacked and count == len(given.views.rows):
        hint = ". The axes of views and corners are swapped: transpose the first two"
    raise ValueError(
        f"{owner}: view {view}: object_points are {count} corners, {given.points_name}[{view}] are {len(points)}{hint}"
        f". Is it the board's size (of a chessboard its inner corners)? Corners that were not found go in as rows of "
        f"NaN, or are left out of both"
    )


def _image_views(value: Points, name: str, owner: str) -> _Views:
    views = _in_views(value, 2, name, owner)
    if views.alone:
        raise ValueError(
            f"{owner}: {name} must be (V, N, 2) or a list of (N_i, 2), one for each view; got shape "
            f"{(*(views.shapes[0] or ()), 2)}. A single view goes in as [{name.split('[')[0]}]"
        )
    if all(points is None for points in views.rows):
        raise ValueError(f"{owner}: {name} has no view with corners; got {_brief(value)}")
    return views


def _in_views(value: Points, size: int, name: str, owner: str) -> _Views:
    if value is None or isinstance(value, (str, bytes, Mapping)):
        raise TypeError(f"{owner}: {name} must be a tensor, an array, or a list of them; got {type(value).__name__}")
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = list(value)
    if isinstance(value, (list, tuple)):
        parts = [None if part is None else _as_float64(part, f"{name}[{i}]", owner) for i, part in enumerate(value)]
        some = [part for part in parts if part is not None]
        if not some:
            raise ValueError(f"{owner}: {name} has no view with points; got {_brief(value)}")
        if not all(part.ndim == 1 and len(part) for part in some):
            labels = [f"{name}[{i}]" for i in range(len(parts))]
            rows = [None if p is None else _as_rows(p, size, at, owner) for p, at in zip(parts, labels, strict=True)]
            return _Views(rows, [None if p is None else tuple(p.shape[:-1]) or (0,) for p in parts], False, False)
        whole = _as_float64(list(value), name, owner)  # rows of numbers
    else:
        whole = _as_float64(value, name, owner)
    column = whole.ndim == 3 and whole.shape[1] == 1 and whole.shape[0] > 1 and whole.shape[2] == size
    if whole.ndim <= 2 or column:
        return _Views([_as_rows(whole, size, name, owner)], [tuple(whole.shape[:-1])], True, True)
    shape = tuple(whole.shape)
    rows = [_as_rows(part, size, name, owner, shape) for part in whole]
    return _Views(rows, [tuple(part.shape[:-1]) for part in whole], True, False)


def _as_rows(value: Tensor, size: int, name: str, owner: str, shape: tuple[int, ...] = ()) -> Tensor:
    """(n, size) of that, or of OpenCV's (n, 1, size) and (1, n, size); shape: of the whole that it is a view of."""
    if value.numel() == 0:
        return value.new_empty(0, size)
    rows = value
    if value.ndim == 3 and 1 in value.shape[:2]:
        rows = value.reshape(-1, value.shape[-1])
    if rows.ndim == 2 and rows.shape[-1] == size:
        return rows
    hint = ""
    if rows.ndim == 2 and rows.shape[0] == size:
        hint = ". The axes are swapped: transpose the last two"
    elif rows.ndim == 2 and rows.shape[-1] == 5 - size:
        hint = ". Are object_points and image_points exchanged?"
        hint += " Points of a plane need a column of zeros" if size == 3 else ""
    form = f"(V, N, {size})" if shape else f"(N, {size})"
    raise ValueError(f"{owner}: {name} must be {form}; got shape {shape or tuple(value.shape)}{hint}")


def _as_float64(value: Any, name: str, owner: str) -> Tensor:
    """A detached float64 tensor; None among the numbers, or the rows, of a list is NaN."""
    try:
        if isinstance(value, (list, tuple)):
            rows = [row.detach().cpu().numpy() if isinstance(row, Tensor) else row for row in value]
            like = next((np.shape(row) for row in rows if row is not None), ())
            value = np.asarray([np.full(like, np.nan) if row is None else row for row in rows], np.float64)
        if not isinstance(value, Tensor):
            array = np.asarray(value)
            if array.dtype.kind not in "fiu":
                raise TypeError(f"of dtype {array.dtype}")
            value = torch.from_numpy(array.astype(np.float64))  # a copy: native, writable, in order
    except TypeError as error:
        raise TypeError(f"{owner}: {name} must be real numbers; got {_brief(value)}: {error}") from None
    except ValueError as error:
        raise ValueError(f"{owner}: {name} must be rows of as many numbers; got {_brief(value)}: {error}") from None
    if value.is_complex() or value.dtype == torch.bool:
        raise TypeError(f"{owner}: {name} must be real numbers; got dtype {value.dtype}")
    if value.is_meta:
        raise ValueError(f"{owner}: {name} is on the device meta, and has no values")
    values: Tensor = value.detach().to(torch.float64)
    return values


def _as_size(value: Any, name: str, owner: str) -> tuple[int, int]:
    """(height, width); also of one size a view, where they are all the same."""
    if value is None:
        raise ValueError(f"{owner}: {name} is missing: (height, width) in pixels, as image.shape[:2]")
    if isinstance(value, (Tensor, np.ndarray)):
        if value.ndim > 2 or value.shape[-1:] != (2,):
            raise ValueError(
                f"{owner}: {name} must be (height, width), as image.shape[:2]; got an array of shape "
                f"{tuple(value.shape)}"
            )
        value = value.tolist()
    if isinstance(value, (list, tuple)) and value and all(isinstance(side, (list, tuple)) for side in value):
        sizes = sorted({tuple(side) for side in value})
        if len(sizes) > 1:
            raise ValueError(
                f"{owner}: {name} must be one (height, width) for all views; got {_several(sizes)}. "
                f"Calibrate the images of each size apart, or resize them and scale their corners"
            )
        value = sizes[0]
    try:
        size = as_image_size(value, owner)
    except (TypeError, ValueError) as error:
        raise type(error)(str(error).replace("image_size", name, 1)) from None
    assert size is not None
    return size


def _names(arguments: Mapping[str, Mapping[str, Any]], owner: str) -> list[str]:
    """The names of cameras, which all arguments have."""
    for argument, mapping in arguments.items():
        if not isinstance(mapping, Mapping):
            raise TypeError(
                f"{owner}: {argument} must map names of cameras to theirs, as {{'left': ..., 'right': ...}}; "
                f"got {type(mapping).__name__}"
            )
    first, *others = arguments.items()
    names = list(first[1])
    if not names:
        raise ValueError(f"{owner}: {first[0]} names no camera")
    strange = [name for name in names if not isinstance(name, str)]
    if strange:
        raise TypeError(f"{owner}: names of cameras must be strings; got {_several([repr(name) for name in strange])}")
    for argument, mapping in others:
        for missing, there, where in (
            ([n for n in names if n not in mapping], first[0], argument),
            ([n for n in mapping if n not in names], argument, first[0]),
        ):
            if missing:
                raise ValueError(
                    f"{owner}: {_several([repr(n) for n in missing])} of {there} is missing in {where}, "
                    f"which has {', '.join(repr(n) for n in arguments[where])}"
                )
    return names


# -- what is in them


def _check_sight(board: _Board, sight: _Sight, owner: str) -> None:
    """Refuse what no camera sees.

    Raises:
        ValueError: as `as_observations` says.
    """
    name, seen, pixels = sight.given.points_name, sight.seen, sight.pixels
    if bool(pixels.isinf().any()):
        raise ValueError(f"{owner}: {name} is infinite{_in(pixels.isinf().any(-1))}; what is unseen is NaN")
    if not bool(seen.any()):
        raise ValueError(f"{owner}: {name} is NaN everywhere: no view has a corner")
    number = seen.sum(-1)
    few = (number > 0) & (number < _LEAST_CORNERS)
    if bool(few.any()):
        view = _first(few)
        raise ValueError(
            f"{owner}: view {view}: {name}[{view}] has {int(number[view])} seen corners, and a view needs "
            f"{_LEAST_CORNERS}; leave it out, or make it None or NaN{_likewise(few)}"
        )
    _check_boards(board.points.expand(*seen.shape, 3), seen, owner)
    _check_pixels(pixels, sight, owner)


def _check_boards(points: Tensor, seen: Tensor, owner: str) -> None:
    strange = ~points.isfinite().all(-1) & seen
    if bool(strange.any()):
        raise ValueError(f"{owner}: object_points are not finite{_in(strange)}, where image_points are")
    weights = seen[..., None].double()
    count = weights.sum(1, keepdim=True).clamp(min=1)
    known = torch.where(seen[..., None], points, 0.0)
    reach = float(known.abs().amax())
    if reach > 0 and not _LEAST_UNIT < reach < _MOST_UNIT:
        raise ValueError(f"{owner}: object_points reach {reach:.3g}; give them in a unit near the size of the board")
    offsets = (known - known.sum(1, keepdim=True) / count) * weights
    spread = torch.linalg.eigvalsh(offsets.mT @ offsets).clamp(min=0).sqrt()  # (V, 3) ascending
    has = seen.any(-1)
    dot = has & (spread[:, 2] <= _ROUNDING * known.abs().amax((1, 2)))
    line = has & (spread[:, 1] <= _FLAT * spread[:, 2])
    if bool((dot | line).any()):
        view = _first(dot | line)
        where = "are all the same point" if bool(dot[view]) else "lie on one line"
        raise ValueError(
            f"{owner}: view {view}: the object_points of its seen corners {where}, which no pose can be told from"
            f"{_likewise(dot | line)}"
        )
    twice = _repeated(known, seen, 2)
    if bool(twice.any()):
        view = _first(twice)
        raise ValueError(
            f"{owner}: view {view}: object_points has a corner twice; each corner of a board has its own place, and is "
            f"seen once in a view{_likewise(twice)}"
        )


def _check_pixels(pixels: Tensor, sight: _Sight, owner: str) -> None:
    name, (height, width), seen = sight.given.points_name, sight.given.image_size, sight.seen
    at_one = _repeated(pixels, seen, _SAME_PIXEL)
    if bool(at_one.any()):
        view = _first(at_one)
        raise ValueError(
            f"{owner}: view {view}: {name}[{view}] has {_SAME_PIXEL} or more corners at one pixel; corners that were "
            f"not found are NaN{_likewise(at_one)}"
        )
    found = pixels[seen]
    if float(found.abs().max()) < _NORMALISED < min(height, width) / 2:
        raise ValueError(
            f"{owner}: {name} reaches from {_pair(found.amin(0))} to {_pair(found.amax(0))} in an image of "
            f"{height} x {width}: pixels are asked for, not normalised coordinates"
        )
    long = max(height, width)

    def outside(rows: float, columns: float, rim: float) -> Tensor:
        u, v = pixels.unbind(-1)
        rim = rim * long
        return seen & ((u < -rim) | (v < -rim) | (u > columns - 1 + rim) | (v > rows - 1 + rim))

    out, total = outside(height, width, _RIM), len(found)
    number = int(out.sum())
    many = f"{owner}: {number} of {total} corners of {name} lie outside the image"
    size = f"{sight.given.size_name} {(height, width)}"
    exchanged = int(outside(width, height, _RIM).sum())
    if number > _FEW_OUTSIDE * total and exchanged <= _FEW_LEFT * number:
        raise ValueError(
            f"{many}, and {'none' if not exchanged else f'only {exchanged}'} would in {(width, height)}: {size} is "
            f"(height, width), as image.shape[:2] and not OpenCV's (width, height), and points are (u, v), u to the "
            f"right, not (row, column)"
        )
    views = (out.sum(-1) > _MOST_OF_A_VIEW * seen.sum(-1)) & seen.any(-1)
    if number > _MANY_OUTSIDE * total or bool(views.any()):
        where = _in(views) if bool(views.any()) else ""
        raise ValueError(
            f"{many} of {size}{where}; they reach from {_pair(found.amin(0))} to {_pair(found.amax(0))}. Is it the "
            f"size of the images that the corners were found in, the same for all? Unseen corners are NaN"
        )
    nowhere = outside(height, width, _NOWHERE)
    if bool(nowhere.any()):
        view = _first(nowhere.any(-1))
        raise ValueError(
            f"{owner}: {int(nowhere.sum())} of {total} corners of {name} lie far outside the image of {size}"
            f"{_in(nowhere)}, as {_pair(pixels[view][nowhere[view]][0])}; unseen corners are NaN"
        )


def _check_links(names: list[str], sees: Tensor, owner: str) -> None:
    """Refuse cameras, sees (C, V), of which some share no view, not even by way of others, with the first."""
    linked = torch.zeros(len(names), dtype=torch.bool, device=sees.device)
    linked[0] = True
    for _ in names:
        linked = linked | (sees & sees[linked].any(0)).any(-1)
    if not bool(linked.all()):
        apart = [repr(name) for name, is_linked in zip(names, linked.tolist(), strict=True) if not is_linked]
        raise ValueError(
            f"{owner}: {_several(apart)} never sees a board in the same view as {names[0]!r}, nor as a camera that "
            f"does: where it is cannot be told; take views that both see, or calibrate it alone"
        )


def _kept(sights: Sequence[_Sight], owner: str) -> tuple[Tensor, list[int]]:
    """The numbers of the views with corners, and of those left out that have the same ones as an earlier view.

    A copy has the same corners in all cameras, in any order: noise makes those of no two photographs equal.
    """
    has = torch.stack([sight.seen.any(-1) for sight in sights]).any(0)
    if not bool(has.all()):
        warnings.warn(f"{owner}: left out, as nothing was seen{_in(~has)}", UserWarning, stacklevel=5)
    parts = []
    for sight in sights:
        ordered = torch.where(sight.seen[..., None], sight.pixels, torch.inf) + 0.0  # no -0
        for axis in (1, 0):
            index = ordered[..., axis].argsort(dim=-1, stable=True)
            ordered = torch.take_along_dim(ordered, index[..., None], 1)
        parts.append(ordered.flatten(1))
    views: dict[bytes, int] = {}
    first = [views.setdefault(row.tobytes(), i) for i, row in enumerate(torch.cat(parts, 1).cpu().numpy())]
    kept = [i for i in has.nonzero()[:, 0].tolist() if first[i] == i]
    copies = [i for i in has.nonzero()[:, 0].tolist() if first[i] != i]
    if copies:
        mask = torch.zeros_like(has)
        mask[copies] = True
        warnings.warn(f"{owner}: left out, as the corners are those of another view{_in(mask)}", stacklevel=5)
    return torch.tensor(kept, device=has.device), copies


def _repeated(rows: Tensor, seen: Tensor, times: int) -> Tensor:
    """(V,) whether so many of the seen rows (V, N, k) are equal."""
    # equal rows have equal sums of multiples that no two others have in common, and stand together once sorted
    factors = rows.new_tensor([1.0, 2**0.5, 3**0.5])[: rows.shape[-1]]
    sums = torch.where(seen, (rows * factors).sum(-1), torch.nan)
    order = sums.argsort(-1)
    ordered = rows.gather(1, order[..., None].expand_as(rows))
    both = seen.gather(1, order)
    step = times - 1
    if rows.shape[1] <= step:
        return torch.zeros_like(seen[:, 0])
    same = (ordered[:, step:] == ordered[:, :-step]).all(-1) & both[:, step:] & both[:, :-step]
    return same.any(-1)


# -- words


def _first(views: Tensor) -> int:
    return int(views.nonzero()[0, 0])


def _several(names: Sequence[Any]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(map(str, names[:_NAMED])) + more


def _in(mask: Tensor) -> str:
    """Of a mask (V,) or (V, N): the numbers of the views in which it is true."""
    views = (mask if mask.ndim == 1 else mask.any(-1)).nonzero()[:, 0].tolist()
    return f" in view{'s' * (len(views) > 1)} {_several(views)}"


def _likewise(views: Tensor) -> str:
    others = views.nonzero()[1:, 0].tolist()
    return f". Likewise view{'s' * (len(others) > 1)} {_several(others)}" if others else ""


def _pair(pixel: Tensor) -> str:
    return "({:.6g}, {:.6g})".format(*pixel.tolist())


def _brief(value: Any) -> str:
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) < 80 else text[:77] + '...'}"
