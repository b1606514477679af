"""A lens followed outwards on azimuths: how far out it stays one-to-one, and where to start its inverse.

A lens folds where its orientation is lost, see `StageAt.orientation`. It is followed at ascending radii, the nodes,
from the centre of the chart's plane. The place of a loss is a number of nodes, and may lie between two of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from camtorch.evaluate.export import as_index
from camtorch.native.structs import ASIDE, AZIMUTHS, BEYOND, BULGE, DIP, FAR_IMAGE, RADII, SMOOTH, SPAN
from camtorch.optics.radial_inverse import first_loss
from camtorch.values.arguments import columns

if TYPE_CHECKING:
    from camtorch.optics.charts import Chart
    from camtorch.optics.lens import Lens
    from camtorch.optics.model_spec import Optics
    from camtorch.optics.radial import RadialFactor

_RADII = 2048  # to find the fold of the radial factor


class Extent(NamedTuple):
    """The reach of the lenses of cameras (C,) on their azimuths.

    radii: (C, radii). reach: (C, azimuths, radii), how far from the centre they go, ascending; infinite past the fold.
    furthest: (C, azimuths), the distance that no point before the fold exceeds in each direction of the image.
    """

    radii: Tensor
    reach: Tensor
    furthest: Tensor

    def start(self, camera: Tensor, target: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Return the radius (M,) before the fold at which a point's lens nearly reaches `target` towards (a, b)."""
        count = self.radii.shape[-1]
        reach, row = self.reach.flatten(), (camera * AZIMUTHS + azimuth(a, b, 0.5)) * count
        node = _last_not_above(reach, row, count, target)
        near, far = reach[row + node], reach[row + node + 1]
        # next to the fold only its inner side is a safe start
        share = torch.where(far < torch.inf, (target - near) / torch.where(far > near, far - near, 1.0), 0.0)
        inner, outer = (self.radii.flatten()[camera * count + node + i] for i in range(2))
        return inner + share.clamp(0, 1) * (outer - inner)


def limits_and_extent(optics: Optics, k: Tensor) -> tuple[Tensor, Extent]:
    """Follow lenses of coefficients (C, n) that are not radial outwards on azimuths of the chart's plane. Graph-free.

    Returns the squared radius (C, azimuths), up to the next azimuth, before which the orientation decides, and extents.
    The orientation is lost at the first node at which it is not positive, or at the bottom of a parabola through three
    nodes that dips below zero. Up to there it changes its sign at most once: its value at a point shows the side.
    """
    chart, lens = optics(columns(k))
    radii = _around(lens.radial, chart, chart.radii(_RADII, k)).expand(k.shape[0], -1)
    # each camera has as many rows as there are azimuths
    chart, lens = optics(columns(k.repeat_interleave(AZIMUTHS, 0)))
    rows, directions = radii.repeat_interleave(AZIMUTHS, 0), (c.repeat(k.shape[0]) for c in _directions(radii))
    followed = _follow(chart, lens, rows, *directions)
    lost, reach, furthest, x, y = (of_rows.unflatten(0, (-1, AZIMUTHS)) for of_rows in followed)
    limits = _limits(lost, rows, chart.end(rows.dtype))
    envelope = _envelope(furthest, x, y)
    return limits * limits, Extent(radii, reach, torch.where(envelope < FAR_IMAGE, envelope, torch.inf))


def _follow(chart: Chart, lens: Lens, radii: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, ...]:
    """Follow lenses on azimuths (M,) towards (a, b), at radii (M, S).

    Returns where each is lost, in nodes; how far the lens sends radii up to each (M, S), and the furthest; and its last
    point (x, y).
    """
    a, b = a.unsqueeze(-1), b.unsqueeze(-1)
    end, last = chart.end(radii.dtype), radii.shape[-1] - 1
    at = lens.at(a * radii, b * radii)
    lost = _find_loss(lens, a, b, radii, at.orientation)
    x, y = at.value
    distance = (x * x + y * y).sqrt()
    nodes = torch.arange(last + 1, dtype=radii.dtype, device=radii.device)
    is_before = (nodes < lost.unsqueeze(-1)) & (distance < torch.inf)
    reach = torch.where(is_before, distance, torch.inf).cummax(-1).values
    # the last point, and the furthest one up to there
    place = lost.clamp(max=last).unsqueeze(-1)
    rim = _radius_at(radii, place).clamp(max=end)
    x, y = lens.at(a * rim, b * rim, order=0).value
    before = torch.where((radii < rim) & (reach < torch.inf), reach, 0.0).amax(-1, keepdim=True)
    furthest = torch.maximum((x * x + y * y).sqrt(), before)
    # before a pole the lens sends points to infinity
    beyond = radii.gather(-1, place.ceil().long()).clamp(max=end)
    margin = lens.at(a * beyond, b * beyond).margin
    is_endless = furthest.isnan() if margin is None else furthest.isnan() | ~(margin > 0)
    furthest = torch.where(is_endless, torch.inf, furthest)
    return lost, reach, furthest.squeeze(-1), x.squeeze(-1), y.squeeze(-1)


def _find_loss(lens: Lens, a: Tensor, b: Tensor, radii: Tensor, orientation: Tensor) -> Tensor:
    """Return `first_loss` (M,), but dips between coarse nodes (M, S) count only if a closer look finds them."""
    last = orientation.shape[-1] - 1
    steps = torch.linspace(-1, 1, DIP, dtype=orientation.dtype, device=orientation.device)
    spared = torch.zeros_like(orientation, dtype=torch.bool)
    is_open: Tensor | None = None  # whether an earlier look has spared a dip of the row, so that it goes on
    while True:
        lost = first_loss(orientation, spared)
        node = lost.round().long().clamp(max=last).unsqueeze(-1)
        is_dip = (lost <= last).unsqueeze(-1) & (orientation.gather(-1, node) > 0)
        is_dip = is_dip if is_open is None else is_dip & is_open
        if not bool(is_dip.any()):
            return lost
        radius = _radius_at(radii, (node + steps).clamp(0, last))
        is_open = is_dip & (lens.at(a * radius, b * radius).orientation > 0).all(-1, keepdim=True)
        spared = spared.scatter(-1, node, spared.gather(-1, node) | is_open)


def _limits(lost: Tensor, radii: Tensor, end: float | Tensor) -> Tensor:
    """Return the radii (C, azimuths), from each azimuth to the next, before which the orientation decides.

    Between two azimuths the fold mostly moves smoothly, and may bulge: the orientation decides where it lies. If the
    fold ends there, the nearer radius is on the safe side.
    """
    places = torch.stack((lost, lost.roll(-1, -1)), -1).flatten(0, 1)  # on an azimuth and the next, (M, 2)
    folds = _radius_at(radii, places)
    nearer, further = folds.amin(-1), folds.amax(-1)
    is_smooth = (places.diff(dim=-1).squeeze(-1).abs() <= 1.5) | (further <= (1 + SMOOTH) * nearer)
    limits = torch.where(is_smooth, further * (1 + BULGE), nearer).unsqueeze(-1)
    limits = limits.clamp(max=end)  # (M, 1), as the end may be
    return limits.view(-1, AZIMUTHS)


def _envelope(furthest: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return the furthest distances (C, azimuths) by direction of the image, from the images (x, y) of the rim.

    A regular map sends its inside inside: no point goes further than the outermost of the rim.
    """
    # the directions that the rim passes from each azimuth to the next, and how far out it is there
    here = azimuth(x.nan_to_num(0.0, 0.0, 0.0), y.nan_to_num(0.0, 0.0, 0.0)).long()
    turn = (here.roll(-1, -1) - here + AZIMUTHS // 2).remainder(AZIMUTHS) - AZIMUTHS // 2
    level = torch.maximum(furthest, furthest.roll(-1, -1))
    envelope = torch.zeros_like(level)
    for step in range(-SPAN, SPAN + 1):
        is_passed = (step >= turn.clamp(max=0) - ASIDE) & (step <= turn.clamp(min=0) + ASIDE)
        direction = (here + step).remainder(AZIMUTHS)
        envelope = envelope.scatter_reduce(-1, direction, torch.where(is_passed, level, 0.0), "amax")
    # the envelope becomes a circle if the rim has no end, turns by leaps, or is not seen to go once around the centre
    leaps = (level == torch.inf) | (turn.abs() > SPAN - ASIDE) | (turn.sum(-1, keepdim=True) != AZIMUTHS)
    circle = torch.where(leaps.any(-1, keepdim=True), level.amax(-1, keepdim=True), 0.0)
    return BEYOND * torch.maximum(envelope, circle)


def _directions(like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the unit vectors of the azimuths, in even steps along the rim of the diamond |a| + |b| = 1."""
    turn = torch.arange(AZIMUTHS, dtype=like.dtype, device=like.device) * (4 / AZIMUTHS)
    a, b = (turn - 2).abs() - 1, 1 - ((turn + 1).remainder(4) - 2).abs()
    length = torch.hypot(a, b)
    return a / length, b / length


def azimuth(a: Tensor, b: Tensor, offset: float = 0.0) -> Tensor:
    """Return the index of the azimuth at or below that of the points; `offset` 0.5 gives the nearest one."""
    size = a.abs() + b.abs()
    across = b / torch.where(size > 0, size, 1.0)
    turn = torch.where(a < 0, 2 - across, across)
    return as_index((turn * (AZIMUTHS / 4) + offset).floor()).remainder(AZIMUTHS)


def _last_not_above(table: Tensor, row: Tensor, length: int, target: Tensor) -> Tensor:
    """Return the index, up to length - 2, of the last entry not above `target` in the ascending row from `row` on."""
    low, high = torch.zeros_like(row), torch.full_like(row, length - 1)
    for _ in range((length - 1).bit_length()):  # by bisection
        middle = (low + high) // 2
        above = table[row + middle] > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return low.clamp(max=length - 2)


def _around(radial: RadialFactor | None, chart: Chart, fine: Tensor) -> Tensor:
    """Return radii (C, radii): the chart's, and more of them close to the fold of the radial factor, if it has one.

    `fine` are radii (S,) of the chart, at which that fold is looked for.
    """
    if radial is None:
        return chart.radii(RADII, fine)
    orientation = radial.orientation(fine)
    fold = _radius_at(fine.expand_as(orientation), first_loss(orientation).unsqueeze(-1))
    # without a fold on the chart, the middle of the chart does no harm
    fold = torch.where(fold < torch.inf, fold, 1.0)
    # from half of it to one and a half, denser the closer to it
    spread = 1 + 0.5 * torch.linspace(-1, 1, RADII // 2, dtype=fine.dtype, device=fine.device) ** 3
    close = (fold * spread).clamp(max=fine[-1])
    even = chart.radii(RADII // 2, fine).expand(*close.shape[:-1], -1)
    return torch.cat((even, close), -1).sort(-1).values


def _radius_at(radii: Tensor, place: Tensor) -> Tensor:
    """Return the radii (M, P) at places (M, P), on or between the nodes of radii (M, S); infinite from S on."""
    last = radii.shape[-1] - 1
    node = place.floor().long().clamp(max=last)
    inner, outer = radii.gather(-1, node), radii.gather(-1, (node + 1).clamp(max=last))
    return torch.where(place <= last, inner + (place - node) * (outer - inner), torch.inf)
