"""A lens followed outwards on azimuths: how far out it stays one-to-one, and where to start its inverse."""

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


def limits_and_extent(optics: Optics, k: Tensor) -> tuple[Tensor, Extent]:
    """Follow lenses of coefficients (C, n) that are not radial outwards on azimuths of the chart's plane. Graph-free.

    Returns the squared radius (C, azimuths), up to the next azimuth, before which the orientation decides, and extents.
    The orientation is lost at the first node at which it is not positive, or at the bottom of a parabola through three
    nodes that dips below zero. Up to there it changes its sign at most once: its value at a point shows the side.
    """
    chart, lens = optics(columns(k))
    radii = _around(lens.radial, chart, chart.radii(_RADII, k)).expand(k.shape[0], -1)
    # the azimuths of each camera are rows
    rows = radii.repeat_interleave(AZIMUTHS, 0)
    chart, lens = optics(columns(k.repeat_interleave(AZIMUTHS, 0)))
    directions = (c.repeat(k.shape[0]) for c in _directions(radii))
    followed = _follow(chart, lens, rows, *directions)
    lost, reach, *rim = (w.unflatten(0, (-1, AZIMUTHS)) for w in followed)
    pairs = torch.stack((lost, lost.roll(-1, -1)), -1).flatten(0, 1)
    # for each azimuth and the next, (M, 2), the radius at which the lens is lost
    ends = _radius_at(rows, pairs)
    nearer, further = ends.amin(-1), ends.amax(-1)
    # Between two azimuths the fold moves smoothly, and may bulge: the orientation decides where it lies.
    # If the fold ends there, the nearer radius is on the safe side.
    smooth = (pairs.diff(dim=-1).squeeze(-1).abs() <= 1.5) | (further <= (1 + SMOOTH) * nearer)
    limit = torch.where(smooth, further * (1 + BULGE), nearer).unsqueeze(-1)
    limits = limit.clamp(max=chart.end(limit.dtype)).squeeze(-1).unflatten(0, (-1, AZIMUTHS))
    envelope = _envelope(*rim)
    return limits * limits, Extent(radii, reach, torch.where(envelope < FAR_IMAGE, envelope, torch.inf))


def _follow(chart: Chart, lens: Lens, radii: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, ...]:
    """Return on azimuths (M,) the node where a lens is lost, how far it sends radii, the furthest, its last point."""
    a, b = a.unsqueeze(-1), b.unsqueeze(-1)
    at = lens.at(a * radii, b * radii)
    lost = _find_loss(lens, a, b, radii, at.orientation)
    (x, y), end = at.value, chart.end(radii.dtype)
    reach = (x * x + y * y).sqrt()
    index = torch.arange(reach.shape[-1], dtype=reach.dtype, device=reach.device)
    reach = torch.where((index < lost.unsqueeze(-1)) & (reach < torch.inf), reach, torch.inf).cummax(-1).values
    nodes = lost.clamp(max=radii.shape[-1] - 1).unsqueeze(-1)
    last = _radius_at(radii, nodes).clamp(max=end)
    x, y = lens.at(a * last, b * last, order=0).value
    before = torch.where((radii < last) & (reach < torch.inf), reach, 0.0).amax(-1, keepdim=True)
    furthest = torch.maximum((x * x + y * y).sqrt(), before)
    # before a pole the lens sends points to infinity
    beyond = radii.gather(-1, nodes.ceil().long()).clamp(max=end)
    margin = lens.at(a * beyond, b * beyond).margin
    open_ended = furthest.isnan() if margin is None else furthest.isnan() | ~(margin > 0)
    return lost, reach, torch.where(open_ended, torch.inf, furthest).squeeze(-1), x.squeeze(-1), y.squeeze(-1)


class Extent(NamedTuple):
    """The reach of the lenses of cameras (G,) on their azimuths.

    radii: (G, radii). reach: (G, azimuths, radii), how far from the centre they go, ascending; infinite past the fold.
    furthest: (G, azimuths), the distance that no point before the fold exceeds in each direction of the image.
    """

    radii: Tensor
    reach: Tensor
    furthest: Tensor

    def start(self, camera: Tensor, target: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Return the radius (M,) before the fold at which a point's lens nearly reaches `target` towards (a, b)."""
        row = camera * AZIMUTHS + azimuth(a, b, 0.5)
        table = self.reach.flatten()
        size = self.radii.shape[-1]
        low = _last_not_above(table, row * size, size, target)
        near, far = table[row * size + low], table[row * size + low + 1]
        # next to the fold only its inner side is a safe start
        fraction = torch.where(far < torch.inf, (target - near) / torch.where(far > near, far - near, 1.0), 0.0)
        inner, outer = (self.radii.flatten()[camera * size + low + i] for i in range(2))
        return inner + fraction.clamp(0, 1) * (outer - inner)


def _envelope(furthest: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return (G, azimuths), by direction of the image, from the images (x, y) of the ends of the azimuths."""
    # a regular map sends its inside inside: no point goes further than the outermost of the rim
    here = azimuth(x.nan_to_num(0.0, 0.0, 0.0), y.nan_to_num(0.0, 0.0, 0.0)).long()
    turn = (here.roll(-1, -1) - here + AZIMUTHS // 2).remainder(AZIMUTHS) - AZIMUTHS // 2
    level = torch.maximum(furthest, furthest.roll(-1, -1))
    envelope = torch.zeros_like(level)
    for step in range(-SPAN, SPAN + 1):
        between = (step >= turn.clamp(max=0) - ASIDE) & (step <= turn.clamp(min=0) + ASIDE)
        direction = (here + step).remainder(AZIMUTHS)
        envelope = envelope.scatter_reduce(-1, direction, torch.where(between, level, 0.0), "amax")
    # the envelope becomes a circle if the rim has no end, turns by leaps, or is not seen to go once around the centre
    leaps = (level == torch.inf) | (turn.abs() > SPAN - ASIDE) | (turn.sum(-1, keepdim=True) != AZIMUTHS)
    circle = torch.where(leaps.any(-1, keepdim=True), level.amax(-1, keepdim=True), 0.0)
    return BEYOND * torch.maximum(envelope, circle)


def _find_loss(lens: Lens, a: Tensor, b: Tensor, radii: Tensor, orientation: Tensor) -> Tensor:
    """Return `first_loss` (M,), but dips between coarse nodes (M, S) count only if a closer look finds them."""
    last = orientation.shape[-1] - 1
    steps = torch.linspace(-1, 1, DIP, dtype=orientation.dtype, device=orientation.device)

    def assumed(lost: Tensor) -> Tensor:
        node = lost.round().long().clamp(max=last).unsqueeze(-1)
        return (lost <= last).unsqueeze(-1) & (orientation.gather(-1, node) > 0)

    spared = torch.zeros_like(orientation, dtype=torch.bool)
    lost = first_loss(orientation, spared)
    dips = assumed(lost)
    while bool(dips.any()):
        node = lost.round().long().clamp(max=last).unsqueeze(-1)
        radius = _radius_at(radii, (node + steps).clamp(0, last))
        spared_now = dips & (lens.at(a * radius, b * radius).orientation > 0).all(-1, keepdim=True)
        spared = spared.scatter(-1, node, spared.gather(-1, node) | spared_now)
        lost = first_loss(orientation, spared)
        dips = assumed(lost) & spared_now  # in rows that are not done
    return lost


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
    for _ in range((length - 1).bit_length()):
        middle = (low + high) // 2
        above = table[row + middle] > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return low.clamp(max=length - 2)


def _around(radial: RadialFactor | None, chart: Chart, fine: Tensor) -> Tensor:
    """Return radii (C, radii): the chart's, and more of them close to the fold of the radial factor, if it has one."""
    if radial is None:
        return chart.radii(RADII, fine)
    orientation = radial.orientation(fine)
    fold = _radius_at(fine.expand_as(orientation), first_loss(orientation).unsqueeze(-1))
    # without a fold on the chart, the middle of the chart does no harm
    fold = torch.where(fold < torch.inf, fold, 1.0)
    spread = 1 + 0.5 * torch.linspace(-1, 1, RADII // 2, dtype=fine.dtype, device=fine.device) ** 3
    close = (fold * spread).clamp(max=fine[-1])
    coarse = chart.radii(RADII // 2, fine).expand(*close.shape[:-1], -1)
    return torch.cat((coarse, close), -1).sort(-1).values


def _radius_at(radii: Tensor, position: Tensor) -> Tensor:
    """Return the radii (M, P) at fractional node positions (M, P) of radii (M, S); infinite from S on."""
    last = radii.shape[-1] - 1
    index = position.floor().long().clamp(max=last)
    inner, outer = radii.gather(-1, index), radii.gather(-1, (index + 1).clamp(max=last))
    return torch.where(position <= last, inner + (position - index) * (outer - inner), torch.inf)
