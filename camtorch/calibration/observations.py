"""Object points and image points of a calibration as padded tensors, and results in the form of these."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from camtorch.values.arguments import Numbers, as_known_size, as_values, shown, warn

Points: TypeAlias = Numbers | Sequence[Numbers | None]
"""Points of all views: a tensor, an array, or a list with one of them, or None, for each view."""

_LEAST_CORNERS = 4
_FLAT = 1e-5  # the width of a set of points over its length, below which it is a line
_NORMALISED = 3.0  # px: coordinates that all are smaller are normalised ones
_RIM = 0.02  # of the longer side: no detector finds corners further outside the image
_MANY_OUTSIDE, _MOST_OF_A_VIEW = 0.2, 0.5  # of all corners, more than outliers; of those of a view
_FEW_OUTSIDE, _FEW_LEFT = 0.02, 0.2  # of all corners outside, and of these with the image's sides exchanged
_SAME_ERRORS = 0.1  # the squared distance of two views over their squared residuals, which is 1 for independent noise
_SAME_NOISE = 0.1  # px, the distance of two views that saving a file again may cause
_NAMED = 6  # views at most, in a message


class Observations(NamedTuple):
    """Corners of boards and their pixels in one camera: float64, padded to the number of the fullest view.

    V are the views that have corners in some camera. Results hold these, so pickles of 0.5.0 have the three fields.
    """

    points: Tensor  # (V, N, 3) in the board's frame, 0 if padded
    pixels: Tensor  # (V, N, 2), 0 if unseen
    seen: Tensor  # (V, N) bool

    def of(self, rows: Tensor) -> Observations:
        """Return the observations of some views."""
        return Observations(*(t[rows] for t in self))


class Layout(NamedTuple):
    """The image points of one camera as they were passed."""

    views: Tensor  # (V,) the indices of the views with observations among those that were passed
    image_size: tuple[int, int]  # (height, width)
    shapes: tuple[tuple[int, ...], ...]  # of each view that was passed, without the last dim; (N,) for None
    stacked: bool  # whether they were one tensor or array, not a list

    def restore(self, values: Tensor, seen: Tensor) -> Any:
        """Return results (V, N, k) or (V, N) in the form of the image points, NaN (of bool: False) if not `seen`."""
        rest, empty = values.shape[2:], values.new_tensor(False if values.dtype == torch.bool else torch.nan)
        full = empty.repeat(len(self.shapes), *values.shape[1:])
        full[self.views] = torch.where(seen.reshape(*seen.shape, *[1] * len(rest)), values, empty)
        if self.stacked:
            return full.reshape(len(full), *self.shapes[0], *rest)
        return [row[: math.prod(shape)].reshape(*shape, *rest) for row, shape in zip(full, self.shapes, strict=True)]


def as_observations(
    object_points: Points, image_points: Points, image_size: Sequence[int], owner: str
) -> tuple[Observations, Layout]:
    """Return the observations of one camera, of views that have corners, and how they were passed."""
    return as_rig_observations(object_points, {"": image_points}, {"": image_size}, {"": None}, owner)[""]


def as_rig_observations(
    object_points: Points,
    image_points: Mapping[str, Points],
    image_sizes: Mapping[str, Sequence[int]],
    models: Mapping[str, Any],
    owner: str,
) -> dict[str, tuple[Observations, Layout]]:
    """Return the observations of a rig's cameras of the same boards, and how they were passed, in the models' order."""
    for argument, given in {"models": models, "image_points": image_points, "image_sizes": image_sizes}.items():
        is_mapping = isinstance(given, Mapping)
        if not is_mapping or not given or set(given) != set(models):
            got = f"{argument} of {list(given) if is_mapping else type(given).__name__}"
            words = "models, image_points and image_sizes must be mappings by the same names of cameras"
            raise (ValueError if is_mapping else TypeError)(f"{owner}: {words}; got {got}")
    owners = {name: f"{owner}: {name}" if name else owner for name in models}
    by_name = {name: _as_views(image_points[name], 2, "image_points", of) for name, of in owners.items()}
    boards, *_ = _as_views(object_points, 3, "object_points", owner)
    counts = {name or "image_points": len(views) for name, (views, *_) in by_name.items()}
    if len(boards) > 1:
        counts["object_points"] = len(boards)
    if len(set(counts.values())) > 1:
        raise ValueError(f"{owner}: all arguments must have the same views; got numbers of views {counts}")
    count, device = next(iter(counts.values())), next(iter(by_name.values()))[0][0].device
    boards = [board.to(device) for board in boards]
    boards = boards * count if len(boards) == 1 else boards
    points = pad_sequence(boards, batch_first=True, padding_value=torch.nan)
    found: dict[str, tuple[Observations, Layout]] = {}  # of all views, NaN if padded or unseen
    for name, (views, shapes, stacked) in by_name.items():
        size = as_known_size(image_sizes[name], owners[name])
        pixels = torch.full_like(points[..., :2], torch.nan)
        for i, (view, board) in enumerate(zip(views, boards, strict=True)):
            if len(view) not in (0, len(board)):
                raise ValueError(
                    f"{owners[name]}: view {i}: image_points must be as many corners as object_points, {len(board)} "
                    f"(inner ones of a chessboard); got {len(view)}. Pass rows of NaN for corners that were not found"
                )
            pixels[i, : len(view)] = view
        one = Observations(points, pixels, ~pixels.isnan().any(-1))
        _check_corners(one, owners[name])
        _check_inside(one, size, owners[name])
        forms = tuple((len(b),) if shape is None else shape for b, shape in zip(boards, shapes, strict=True))
        found[name] = one, Layout(torch.arange(count, device=device), size, forms, stacked)
    sees = torch.stack([one.seen.any(-1) for one, _ in found.values()])
    _check_linked(sees, list(found), owner)
    if not bool(sees.any(0).all()):
        warn(f"{owner}: {_views_of(~sees.any(0))} left out, because nothing was seen")
    (kept,) = sees.any(0).nonzero(as_tuple=True)
    points = points.nan_to_num()
    for name, (one, layout) in found.items():
        pixels = torch.where(one.seen[..., None], one.pixels, 0.0)
        found[name] = Observations(points, pixels, one.seen).of(kept), layout._replace(views=kept)
    return found


def _check_linked(sees: Tensor, names: Sequence[str], owner: str) -> None:
    """Raise unless each camera shares a view, at least by way of others, with the first; sees: (C, V) bool."""
    linked = torch.arange(len(sees), device=sees.device) == 0
    for _ in names:
        linked = linked | (sees & sees[linked].any(0)).any(-1)
    if not bool(linked.all()):
        apart = ", ".join(repr(names[i]) for i in (~linked).nonzero()[:, 0].tolist())
        raise ValueError(
            f"{owner}: cameras must share views with {names[0]!r}, directly or through others; got no such view of "
            f"{apart}. Take views that both see, or calibrate it alone"
        )


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


def _as_views(
    value: Points, size: int, name: str, owner: str
) -> tuple[list[Tensor], list[tuple[int, ...] | None], bool]:
    """Return points (n, size) of each view, their shapes (None for no points), and whether they were one array."""
    listed = list(value) if isinstance(value, (list, tuple)) else []
    first = next((part for part in listed if part is not None and len(part)), None)
    are_rows = first is not None and not hasattr(first[0], "__len__")  # of plain numbers
    stacked = are_rows or not isinstance(value, (list, tuple))
    if stacked:
        whole = _as_double(value, name, owner)
        # (N, 1, 3) is OpenCV's form of one board
        is_one = size == 3 and (whole.ndim < 3 or (whole.ndim == 3 and whole.shape[1] == 1 < whole.shape[0]))
        listed = [whole] if is_one else [*whole]
    if all(part is None for part in listed):
        raise ValueError(f"{owner}: {name} must have a view with points; got {shown(value)}")
    views, shapes = [], []
    for i, part in enumerate(listed):
        one = torch.empty(0, size, dtype=torch.float64, device="cpu") if part is None else part
        one = one if stacked else _as_double(one, f"{name}[{i}]", owner)
        shapes.append(None if part is None else tuple(one.shape[:-1]) or (0,))
        if one.numel() and (one.shape[-1] != size or one.ndim != 2 + (one.ndim == 3 and 1 in one.shape[:2])):
            forms = f"(V, N, {size}) or a list of (N_i, {size})" + ", or (N, 3) for all views" * (size == 3)
            got = tuple(whole.shape) if stacked else f"{tuple(one.shape)} in view {i}"
            raise ValueError(f"{owner}: {name} must be {forms}; got shape {got}")
        views.append(one.reshape(-1, size))
    device = next((view.device for view in views if view.numel()), views[0].device)
    return [view.to(device) for view in views], shapes, stacked


def _as_double(value: Any, name: str, owner: str) -> Tensor:
    """Return a float64 tensor; None among the numbers of a list becomes NaN."""
    if isinstance(value, (list, tuple)):
        try:
            value = np.asarray(value, np.float64)
        except (TypeError, ValueError) as error:
            raise type(error)(f"{owner}: {name} must be rows of numbers; got {shown(value)}: {error}") from None
    device = value.device if isinstance(value, Tensor) else torch.device("cpu")
    return as_values(value, name, owner, device).detach().double()


def _check_corners(given: Observations, owner: str) -> None:
    """Raise if corners determine no pose."""
    points, pixels, seen = given.points, given.pixels, given.seen
    number = seen.sum(-1)
    if not bool(number.any()):
        raise ValueError(f"{owner}: image_points must have seen corners; got NaN in all views")
    corners = torch.where(seen[..., None], points, 0.0).nan_to_num(0.0, 0.0, 0.0)
    offsets = (corners - (corners.sum(1) / number.clamp(min=1)[:, None])[:, None]) * seen[..., None]
    spread = torch.linalg.svdvals(offsets)  # (V, 3) descending
    finite = torch.isfinite(points).all(-1) & torch.isfinite(pixels).all(-1)
    for wrong, words in (
        (number < _LEAST_CORNERS, f"image_points must have {_LEAST_CORNERS} or more seen corners; or leave it out"),
        ((seen & ~finite).any(-1), "object_points and image_points must be finite; unseen corners are NaN"),
        (
            spread[:, 1] <= _FLAT * spread[:, 0],
            "object_points of the seen corners must not lie on one line, or be one point",
        ),
        ((pixels == 0).all(-1).sum(-1) > 1, "image_points must be NaN for corners that were not found; got (0, 0)"),
    ):
        if bool((wrong & (number > 0)).any()):
            raise ValueError(f"{owner}: {_views_of(wrong & (number > 0))}: {words}")


def _check_inside(given: Observations, size: tuple[int, int], owner: str) -> None:
    """Raise if pixels do not lie in an image of the camera's size."""
    pixels, seen = given.pixels, given.seen
    found = pixels[seen]

    def outside(sides: tuple[int, int]) -> Tensor:
        over = torch.maximum(pixels - pixels.new_tensor(sides[::-1]) + 1.0, -pixels)
        return (over > _RIM * max(size)).any(-1)  # False for NaN

    out = outside(size)
    number, total = int(out.sum()), len(found)
    exchanged = number > _FEW_OUTSIDE * total and int(outside(size[::-1]).sum()) <= _FEW_LEFT * number
    bad = out.sum(-1) > _MOST_OF_A_VIEW * seen.sum(-1)
    bad |= float(found.abs().max()) < _NORMALISED < min(size) / 2
    if bool(bad.any()) or exchanged or number > _MANY_OUTSIDE * total:
        low, high = ("({:.6g}, {:.6g})".format(*end.tolist()) for end in (found.amin(0), found.amax(0)))
        raise ValueError(
            f"{owner}: image_points must be pixels in the image of image_size {size}; got {number} of "
            f"{total} corners outside, and values from {low} to {high}, in "
            f"{_views_of(bad if bool(bad.any()) else out.any(-1))}. image_size is (height, width) of all images, as "
            "image.shape[:2], points are (u, v), not parts of its sides, and unseen ones NaN"
        )


def _views_of(views: Tensor) -> str:
    """Return the views of a mask (V,) in words."""
    return named(views.nonzero()[:, 0].tolist())


def named(views: Sequence[int]) -> str:
    """Return views by their numbers, in words."""
    more = f" and {len(views) - _NAMED} more" if len(views) > _NAMED else ""
    return f"view{'s' * (len(views) > 1)} {', '.join(map(str, views[:_NAMED]))}{more}"
