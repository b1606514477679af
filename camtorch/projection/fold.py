"""A lens followed outwards on azimuths: how far out it stays one-to-one, and where to start its inverse."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from camtorch.optics.radial_inverse import first_loss

if TYPE_CHECKING:
    from camtorch.optics.charts import Chart
    from camtorch.optics.lens import Lens
    from camtorch.optics.radial import RadialFactor

AZIMUTHS = 336  # no further apart than 1.4 degrees
_RADII = 2048  # to find the fold of the radial factor
_SMOOTH, _BULGE = 0.02, 0.001
_DIP = 65  # radii at which a dip between two nodes is looked at
_COARSE, _CLOSE = 40, 40  # on each of many azimuths: over the whole chart, and around the fold of the radial factor


class Azimuths:
    """The lens of each camera, one that is not radial, on azimuths and radii of the chart's plane. Graph-free.

    On each azimuth the orientation of the lens (positive where it is regular) is followed outwards. It is
    lost at the first node where it is not positive, or at the bottom of a parabola through three nodes that
    dips below zero between them. Up to there the orientation changes its sign once at the most, so that its
    value at the point itself tells exactly on which side of the fold the point lies.

    Such a lens mostly folds where its radial factor does: there the radii are dense.
    """

    def __init__(self, chart: Chart, lens: Lens, like: Tensor):
        """The tables of cameras (C,): limits (C, azimuths), reach (C, azimuths, radii); like gives dtype and device."""
        fine = chart.radii(_RADII, like)
        margin = lens.radial.margin(fine * fine) if lens.radial else None
        self.has_pole = None if margin is None else ~(margin > 0).all(-1)
        self.radii = _around(lens.radial, chart, fine)
        a, b = (c[:, None] * self.radii.unsqueeze(-2) for c in _directions(like))
        at = lens.at(a.flatten(-2), b.flatten(-2))
        x, y = at.value
        shape = (AZIMUTHS, self.radii.shape[-1])
        lost = self._lost(lens, at.orientation.unflatten(-1, shape))
        self.limits = self._limits(lost)
        self.reach = _ascending((x * x + y * y).sqrt().unflatten(-1, shape), lost)

    def _lost(self, lens: Lens, orientation: Tensor) -> Tensor:
        """(C, azimuths): `first_loss`, where dips between coarse nodes count only if a closer look finds them."""
        spared = torch.zeros_like(orientation, dtype=torch.bool)
        last = orientation.shape[-1] - 1
        a, b = (c.unsqueeze(-1) for c in _directions(orientation))
        steps = torch.linspace(-1, 1, _DIP, dtype=orientation.dtype, device=orientation.device)
        while True:
            lost = first_loss(orientation, spared)
            node = lost.round().long().clamp(max=last).unsqueeze(-1)
            assumed = (lost <= last).unsqueeze(-1) & (orientation.gather(-1, node) > 0)
            if not bool(assumed.any()):
                return lost
            shape = (AZIMUTHS, _DIP)
            closer = (node + steps).clamp(0, last).flatten(-2)
            radius = _radius_at(self.radii.unsqueeze(-2), closer).unflatten(-1, shape)
            seen = lens.at((a * radius).flatten(-2), (b * radius).flatten(-2)).orientation.unflatten(-1, shape)
            spared_now = assumed & (seen > 0).all(-1, keepdim=True)
            if not bool(spared_now.any()):
                return lost
            spared = spared.scatter(-1, node, spared.gather(-1, node) | spared_now)

    def _limits(self, lost: Tensor) -> Tensor:
        """(C, azimuths): the radius, up to the next azimuth, before which the orientation decides."""
        limit = _radius_at(self.radii.unsqueeze(-2), lost)
        following = limit.roll(-1, -1)
        nearer, further = torch.minimum(limit, following), torch.maximum(limit, following)
        # Between two azimuths the fold moves smoothly, and may bulge: the orientation tells where it lies.
        # Or it ends there: then the nearer one is on the safe side.
        smooth = ((lost - lost.roll(-1, -1)).abs() <= 1.5) | (further <= (1 + _SMOOTH) * nearer)
        return torch.where(smooth, further * (1 + _BULGE), nearer)

    def furthest(self) -> Tensor:
        """(C,): how far from the centre the lens sends any point before the fold, with what nodes may miss."""
        furthest = 1.02 * torch.where(self.reach < torch.inf, self.reach, 0.0).flatten(1).amax(-1)
        # before a pole there is no end to it
        return furthest if self.has_pole is None else torch.where(self.has_pole, torch.inf, furthest)

    def start(self, camera: Tensor, target: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """The radius (M,) at which the lens of each point's camera nearly reaches `target` on the azimuth of (a, b).

        Looked for before the fold only: a target that is not reached ends up next to it.
        """
        row = camera * AZIMUTHS + azimuth(a, b, 0.5)
        table = self.reach.flatten()
        size = self.radii.shape[-1]
        low = _last_not_above(table, row * size, size, target)
        near, far = table[row * size + low], table[row * size + low + 1]
        # next to the fold only its inner side is safe to start from
        fraction = torch.where(far < torch.inf, (target - near) / torch.where(far > near, far - near, 1.0), 0.0)
        radii, row = self.radii.flatten(), camera * size if self.radii.ndim > 1 else 0
        inner, outer = (radii[row + low + i] for i in range(2))
        return inner + fraction.clamp(0, 1) * (outer - inner)


def _directions(like: Tensor) -> tuple[Tensor, Tensor]:
    """The unit vectors of the azimuths, in even steps along the rim of the diamond |a| + |b| = 1."""
    turn = torch.arange(AZIMUTHS, dtype=like.dtype, device=like.device) * (4 / AZIMUTHS)
    a, b = (turn - 2).abs() - 1, 1 - ((turn + 1).remainder(4) - 2).abs()
    length = torch.hypot(a, b)
    return a / length, b / length


def azimuth(a: Tensor, b: Tensor, offset: float = 0.0) -> Tensor:
    """The index of the azimuth at or below that of the points; `offset` 0.5 gives the nearest one."""
    size = a.abs() + b.abs()
    across = b / torch.where(size > 0, size, 1.0)
    turn = torch.where(a < 0, 2 - across, across)
    return (turn * (AZIMUTHS / 4) + offset).floor().to(torch.int32).remainder(AZIMUTHS)


def _last_not_above(table: Tensor, row: Tensor, length: int, target: Tensor) -> Tensor:
    """The index, up to length - 2, of the last entry not above the target in the ascending row that begins at `row`."""
    low, high = torch.zeros_like(row), torch.full_like(row, length - 1)
    for _ in range((length - 1).bit_length()):
        middle = (low + high) // 2
        above = table[row + middle] > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return low.clamp(max=length - 2)


def _around(radial: RadialFactor | None, chart: Chart, fine: Tensor) -> Tensor:
    """(C, radii): the chart's, and more of them the nearer to the fold of the radial factor, if it has one."""
    if radial is None:
        return chart.radii(_COARSE + _CLOSE, fine)
    fold = _radius_at(fine, first_loss(radial.orientation(fine)).unsqueeze(-1))
    # without a fold on the chart, the middle of a chart does no harm
    fold = torch.where(fold < torch.inf, fold, 1.0)
    spread = 1 + 0.5 * torch.linspace(-1, 1, _CLOSE, dtype=fine.dtype, device=fine.device) ** 3
    close = (fold * spread).clamp(max=fine[-1])
    coarse = chart.radii(_COARSE, fine).expand(*close.shape[:-1], -1)
    return torch.cat((coarse, close), -1).sort(-1).values


def _radius_at(radii: Tensor, position: Tensor) -> Tensor:
    """The radius at fractional node positions (*B, A) of radii (*B, 1 or A, S); infinite from S on."""
    last = radii.shape[-1] - 1
    index = position.floor().long().clamp(max=last).unsqueeze(-1)
    radii = radii.expand(*index.shape[:-1], -1)
    inner, outer = torch.gather(radii, -1, index), torch.gather(radii, -1, (index + 1).clamp(max=last))
    between = inner + (position.unsqueeze(-1) - index) * (outer - inner)
    return torch.where(position <= last, between.squeeze(-1), torch.inf)


def _ascending(reach: Tensor, lost: Tensor) -> Tensor:
    """How far from the centre the lens sends each node, ascending; infinite past the fold."""
    nodes = torch.arange(reach.shape[-1], dtype=reach.dtype, device=reach.device)
    before = (nodes < lost.unsqueeze(-1)) & (reach < torch.inf)
    return torch.cummax(torch.where(before, reach, torch.inf), -1).values
