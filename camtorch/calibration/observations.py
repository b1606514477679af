"""What users pass as object points and image points, brought into padded tensors, and results brought back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from camtorch._arguments import Numbers, as_image_size, as_values, shown, warn

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
_NAMED = 6  # views, in a message


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
    """The numbers of the views, of those that were passed, that are no new evidence: see `_observed` and `repeats`."""

    def restore(self, values: Tensor) -> Any:
        """Results (V, N, k) or (V, N) in the form of the image points, NaN (of bool: False) where nothing was seen:

        (V', *, k) for one tensor of V' views, or a list of a tensor (*, k) for each view.
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
    """What one camera sees: the views that have corners, and the form to bring results back into.

    Args:
        object_points: (N, 3) for all views, (V, N, 3), or a list of (N_i, 3), in the board's frame.
        image_points: (V, N, 2) or a list of (N_i, 2), in which None is a view without corners; rows with NaN are
            unseen. In both, points may be OpenCV's (N, 1, 2), (1, N, 2).
        image_size: (height, width) in pixels.
        owner: the name of the function that asks, for messages.

    Warns:
        UserWarning: a view has no corner, or those of an earlier one, and is left out.

    Raises:
        ValueError: shapes and numbers that do not fit, views of too few corners, corners on a line, corners twice,
            corners outside the image, infinite values. TypeError: no numbers.
    """
    if isinstance(image_points, Mapping):
        raise TypeError(f"{owner}: image_points of one camera are a tensor or a list; cameras by name make a rig")
    return _observed(object_points, {"": image_points}, {"": image_size}, owner)[""]


def as_rig_observations(
    object_points: Points,
    image_points: Mapping[str, Points],
    image_sizes: Mapping[str, Sequence[int]],
    models: Mapping[str, Any],
    owner: str,
) -> dict[str, tuple[Observations, Layout]]:
    """What the cameras of a rig see: of every camera the same views of the same boards, by name in the models' order.

    Image points are None or NaN where a camera does not see the board of a view.

    Raises:
        ValueError: what `as_observations` refuses; names that differ; a camera that sees nothing; cameras that no
            board links. TypeError: no mappings.
    """
    for argument, given in {"models": models, "image_points": image_points, "image_sizes": image_sizes}.items():
        if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
            raise TypeError(
                f"{owner}: {argument} must map names of cameras to theirs, as {{'left': ..., 'right': ...}}; "
                f"got {type(given).__name__} {shown(given)}"
            )
        if not given or set(given) != set(models):
            raise ValueError(
                f"{owner}: models, image_points and image_sizes must name the same cameras; {argument} has "
                f"{list(given)}, and models {list(models)}"
            )
    return _observed(object_points, {name: image_points[name] for name in models}, image_sizes, owner)


def repeats(cameras: Sequence[Observations], residuals: Sequence[Tensor]) -> Tensor:
    """The rows of views that show another one again, its errors included: a file saved anew, a frame that stands still.

    Where the noise of two views is independent, corners differ by at least as much as both are wrong by; in such a pair
    they differ by less than a third of that. Images taken one after the other from a tripod have noise of their own.
    Returned are all but the first of each group that is alike, (R,). residuals: of each camera (V, N, 2).
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


def _observed(
    object_points: Points, image_points: Mapping[str, Points], image_sizes: Mapping[str, Any], owner: str
) -> dict[str, tuple[Observations, Layout]]:
    """What cameras see, by their names; the name of a camera that is no part of a rig is empty.

    Views without corners are left out, and those that have the same corners in all cameras as an earlier one, in any
    order: noise makes those of no two photographs equal.
    """
    labels = {name: f"image_points[{name!r}]" if name else "image_points" for name in image_points}
    sizes = {}
    for name in image_points:
        size_name = f"image_sizes[{name!r}]" if name else "image_size"
        if (size := as_image_size(image_sizes[name], owner, size_name)) is None:
            raise ValueError(f"{owner}: {size_name} is missing: (height, width) in pixels, as image.shape[:2]")
        sizes[name] = size_name, size
    views = {name: _in_views(given, 2, labels[name], owner) for name, given in image_points.items()}
    board = _in_views(object_points, 3, "object_points", owner).rows
    counts = {labels[name]: len(given.rows) for name, given in views.items()}
    if len(board) > 1 or board[0] is None:
        counts["object_points"] = len(board)
    if len(set(counts.values())) > 1:
        raise ValueError(f"{owner}: all arguments must have the same views; got numbers of views {counts}")
    number = len(next(iter(views.values())).rows)
    boards = [torch.empty(0, 3) if rows is None else rows for rows in (board * number if len(board) == 1 else board)]
    device = next(rows.device for given in views.values() for rows in given.rows if rows is not None)
    points = _padded(boards, max(map(len, boards)), 3, device)
    pixels, seen = {}, {}
    for name, given in views.items():
        for i, (rows, of_board) in enumerate(zip(given.rows, boards, strict=True)):
            if rows is not None and len(rows) not in (0, len(of_board)):
                raise ValueError(
                    f"{owner}: view {i}: object_points are {len(of_board)} corners (of a chessboard its inner ones), "
                    f"and {labels[name]}[{i}] are {len(rows)}; corners that were not found are rows of NaN"
                )
        pixels[name] = _padded(given.rows, points.shape[1], 2, device)
        seen[name] = ~pixels[name].isnan().any(-1)
        _check_corners(points, pixels[name], seen[name], labels[name], owner)
        _check_inside(pixels[name], seen[name], labels[name], *sizes[name], owner)
    sees = torch.stack([of.any(-1) for of in seen.values()])
    _check_links(list(views), sees, owner)
    has = sees.any(0)
    # complex numbers have an order: by u, then by v
    corners = {name: torch.where(seen[name], torch.view_as_complex(of), torch.inf) for name, of in pixels.items()}
    ordered = np.concatenate([np.sort(of.numpy(force=True) + 0.0, 1) for of in corners.values()], 1)
    first: dict[bytes, int] = {}
    copy = has & torch.tensor([first.setdefault(row.tobytes(), i) != i for i, row in enumerate(ordered)], device=device)
    for left_out, why in ((~has, "nothing was seen"), (copy, "the corners are those of another view")):
        if bool(left_out.any()):
            warn(f"{owner}: left out, as {why} in {_views_of(left_out)}")
    kept = (has & ~copy).nonzero()[:, 0]
    found = {}
    for name, given in views.items():
        of = seen[name][kept]
        some = Observations(points[kept].nan_to_num(nan=0.0), torch.where(of[..., None], pixels[name][kept], 0.0), of)
        shapes = tuple((len(b),) if shape is None else shape for b, shape in zip(boards, given.shapes, strict=True))
        copies = tuple((copy & seen[name].any(-1)).nonzero()[:, 0].tolist())
        found[name] = some, Layout(shapes, given.stacked, kept, of, sizes[name][1], copies)
    return found


class _Views(NamedTuple):
    """Points as they came, in views: (n, size) and the shape before the last dim, None where nothing was passed."""

    rows: list[Tensor | None]
    shapes: list[tuple[int, ...] | None]
    stacked: bool


def _in_views(value: Points, size: int, name: str, owner: str) -> _Views:
    """Image points have a dim for views, or are in a list; object points may be one set."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = list(value)
    parts: list[Tensor | None]
    listed, single = isinstance(value, (list, tuple)), False
    if isinstance(value, (list, tuple)):
        parts = [None if p is None else _as_float64(p, size, f"{name}[{i}]", owner) for i, p in enumerate(value)]
        if any(p is not None for p in parts) and all(p is None or (p.ndim == 1 and len(p)) for p in parts):
            listed, single, parts = False, True, [_as_float64(value, size, name, owner)]  # rows of numbers
    else:
        whole = _as_float64(value, size, name, owner)
        # (N, 1, size) is OpenCV's form of one set of points
        single = whole.ndim < 3 or (whole.ndim == 3 and whole.shape[1] == 1 < whole.shape[0])
        parts = [whole] if single else list(whole)
    if not any(part is not None for part in parts):
        raise ValueError(f"{owner}: {name} has no view with points; got {shown(value)}")
    rows: list[Tensor | None] = []
    for i, part in enumerate(parts):
        if part is None or not part.numel():
            rows.append(None if part is None else part.new_empty(0, size))
            continue
        flat = part.reshape(-1, part.shape[-1]) if part.ndim == 3 and 1 in part.shape[:2] else part
        if flat.ndim != 2 or flat.shape[1] != size or (single and size == 2):
            shape = part.shape if listed or single else (len(parts), *part.shape)
            form = f"(N, {size})" if listed or size == 3 else f"(V, N, {size}) or a list of (N_i, {size})"
            raise ValueError(f"{owner}: {name}{f'[{i}]' * listed} must be {form}; got shape {tuple(shape)}")
        rows.append(flat)
    return _Views(rows, [None if p is None else tuple(p.shape[:-1]) or (0,) for p in parts], not listed)


def _as_float64(value: Any, size: int, name: str, owner: str) -> Tensor:
    """A detached float64 tensor; None among the numbers, or the rows, of a list is NaN."""
    if isinstance(value, (list, tuple)):
        rows = [row.detach().cpu().numpy() if isinstance(row, Tensor) else row for row in value]
        try:
            value = np.asarray([[math.nan] * size if row is None else row for row in rows], np.float64)
        except (TypeError, ValueError) as error:
            raise type(error)(f"{owner}: {name} must be rows of {size} numbers; got {shown(value)}: {error}") from None
    values = as_values(value, name, owner)
    if values.is_meta:
        raise ValueError(f"{owner}: {name} is on the device meta, and has no values")
    return values.detach().to(torch.float64)


def _padded(views: Sequence[Tensor | None], count: int, size: int, device: torch.device) -> Tensor:
    """(V, count, size), NaN where there is nothing."""
    given = [points for points in views if points is not None and len(points) == count]
    if len(given) == len(views):
        return torch.stack(given).to(device, torch.float64)
    padded = torch.full((len(views), count, size), torch.nan, dtype=torch.float64, device=device)
    for row, points in zip(padded, views, strict=True):
        if points is not None:
            row[: len(points)] = points
    return padded


# -- what is in them


def _check_corners(points: Tensor, pixels: Tensor, seen: Tensor, name: str, owner: str) -> None:
    """Refuse corners from which no pose can be told; points (V, N, 3) and pixels (V, N, 2) are NaN where padded."""

    def refuse(views: Tensor, words: str) -> None:
        if bool(views.any()):
            raise ValueError(f"{owner}: {_views_of(views)}: {words}")

    refuse(pixels.isinf().any(-1).any(-1), f"{name} is infinite; what is unseen is NaN")
    number, has = seen.sum(-1), seen.any(-1)
    if not bool(has.any()):
        raise ValueError(f"{owner}: {name} is NaN everywhere: no view has a corner")
    few = has & (number < _LEAST_CORNERS)
    refuse(few, f"{name} has fewer than {_LEAST_CORNERS} seen corners; leave it out, or make it None or NaN")
    refuse((~points.isfinite().all(-1) & seen).any(-1), "object_points are not finite where image_points are")
    known = torch.where(seen[..., None], points, 0.0)
    reach = known.abs().amax((1, 2))
    if not _LEAST_UNIT < float(reach.max()) < _MOST_UNIT and bool(reach.any()):
        raise ValueError(
            f"{owner}: object_points reach {float(reach.max()):.3g}; give them in a unit near the size of the board"
        )
    offsets = (known - (known.sum(1) / number.clamp(min=1)[:, None])[:, None]) * seen[..., None]
    spread = torch.linalg.eigvalsh(offsets.mT @ offsets).clamp(min=0).sqrt()  # (V, 3) ascending
    thin = spread[:, 1] <= torch.maximum(_FLAT * spread[:, 2], _ROUNDING * reach)
    refuse(has & thin, "the object_points of its seen corners lie on one line, or are the same point")
    refuse(_repeated(known, seen, 2), "object_points has a corner twice; a board has each once")
    at_one = _repeated(pixels, seen, _SAME_PIXEL)
    refuse(at_one, f"{name} has {_SAME_PIXEL} or more corners at one pixel; corners that were not found are NaN")


def _repeated(rows: Tensor, seen: Tensor, times: int) -> Tensor:
    """(V,) whether so many of the seen rows (V, N, k) of a view are equal."""
    # equal rows have equal sums of multiples that no two others have in common, and stand together once sorted
    sums = torch.where(seen, (rows * rows.new_tensor([1.0, 2**0.5, 3**0.5])[: rows.shape[-1]]).sum(-1), torch.nan)
    order = sums.argsort(-1)
    ordered, both = rows.gather(1, order[..., None].expand_as(rows)), seen.gather(1, order)
    before, after = slice(None, rows.shape[1] - times + 1), slice(times - 1, None)
    same = (ordered[:, after] == ordered[:, before]).all(-1) & both[:, after] & both[:, before]
    return same.any(-1)


def _check_inside(pixels: Tensor, seen: Tensor, name: str, size_name: str, size: tuple[int, int], owner: str) -> None:
    """Refuse pixels that are not those of such an image."""
    found, (height, width) = pixels[seen], size
    low, high = ("({:.6g}, {:.6g})".format(*end.tolist()) for end in (found.amin(0), found.amax(0)))
    if float(found.abs().max()) < _NORMALISED < min(size) / 2:
        raise ValueError(
            f"{owner}: {name} reaches from {low} to {high} in an image of {height} x {width}: pixels are asked for, "
            "not normalised coordinates"
        )

    def outside(rows: int, columns: int, rim: float) -> Tensor:
        limits = pixels.new_tensor([columns - 1.0, rows - 1.0])
        return seen & ((pixels < -rim * max(size)) | (pixels > limits + rim * max(size))).any(-1)

    out = outside(height, width, _RIM)
    number, total = int(out.sum()), len(found)
    exchanged = number > _FEW_OUTSIDE * total and int(outside(width, height, _RIM).sum()) <= _FEW_LEFT * number
    views = (out.sum(-1) > _MOST_OF_A_VIEW * seen.sum(-1)) | outside(height, width, _NOWHERE).any(-1)
    if exchanged or number > _MANY_OUTSIDE * total or bool(views.any()):
        raise ValueError(
            f"{owner}: {number} of {total} corners of {name} lie outside the image of {size_name} {size}, in "
            f"{_views_of(views if bool(views.any()) else out.any(-1))}; they reach from {low} to {high}: {size_name} "
            "is (height, width) of all images, as image.shape[:2], points are (u, v), and unseen corners NaN"
        )


def _check_links(names: list[str], sees: Tensor, owner: str) -> None:
    """Refuse cameras, sees (C, V), of which some share no view, not even by way of others, with the first."""
    linked = torch.arange(len(names), device=sees.device) == 0
    for _ in names:
        linked = linked | (sees & sees[linked].any(0)).any(-1)
    apart = [repr(name) for name, is_linked in zip(names, linked.tolist(), strict=True) if not is_linked]
    if apart:
        raise ValueError(
            f"{owner}: {', '.join(apart)} never sees a board in the same view as {names[0]!r}, nor as a "
            "camera that does: where it is cannot be told; take views that both see, or calibrate it alone"
        )


def _views_of(views: Tensor) -> str:
    """The views of a mask (V,) in words."""
    return named(views.nonzero()[:, 0].tolist())


def named(views: Sequence[int]) -> str:
    """Views by their numbers, in words."""
    more = f" and {len(views) - _NAMED} more" if len(views) > _NAMED else ""
    return f"view{'s' * (len(views) > 1)} {', '.join(map(str, views[:_NAMED]))}{more}"
