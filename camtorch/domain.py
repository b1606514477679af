"""The domain of a lens, tabulated: how far out it stays one-to-one, and where to start its inverse."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from camtorch.charts import Chart
    from camtorch.lens import Lens

_AZIMUTHS = 256
_RADII = 2048  # on one azimuth, which stands for all where the lens is radial
_SMOOTH, _BULGE = 0.02, 0.001
_COARSE, _CLOSE = 40, 40  # on each of many azimuths: over the whole chart, and around the fold of the radial factor


class Domain:
    """The lens of each camera on azimuths and radii of the chart's plane. Graph-free.

    On each azimuth the sense of the lens (positive where it is regular) is followed outwards over the radii. It is
    lost at the first node where it is not positive, or at the bottom of a parabola through three nodes that
    dips below zero between them. Up to there the sense changes its sign once at the most, so that its
    value at the point itself tells exactly on which side of the fold the point lies.

    A lens that is not radial mostly folds where its radial factor does: there its radii are dense.
    """

    def __init__(self, optics: Callable[[Sequence[Tensor]], tuple[Chart, Lens]], k: Sequence[Tensor], like: Tensor):
        """optics, k: a model's chart and lens of graph-free coefficients. like: gives the dtype and device.

        The tables have the shape (*B, azimuths, radii).
        """
        self.optics, self.k = optics, k
        chart, lens = optics(k)
        self.lens = lens
        fine = chart.radii(_RADII, like)
        self.azimuths = 1 if lens.is_radial else _AZIMUTHS
        self.radii = fine if lens.is_radial else _around(lens.radial_part(), chart, fine)
        self.count = self.radii.shape[-1]
        angles = torch.arange(self.azimuths, dtype=like.dtype, device=like.device) * (2 * math.pi / self.azimuths)
        a, b = ((f(angles)[:, None] * self.radii.unsqueeze(-2)).flatten(-2) for f in (torch.cos, torch.sin))
        (x, y), _, sense = lens.linearise(a, b)
        shape = (self.azimuths, self.count)
        lost = _first_loss(sense.unflatten(-1, shape))
        self.limits = self._limits(lost)
        self.reach = _ascending((x * x + y * y).sqrt().unflatten(-1, shape), lost)
        # where the limits of each camera begin, were they in one row
        cameras = self.limits.shape[:-1]
        self.row = torch.arange(math.prod(cameras), device=like.device).view(*cameras, 1) * self.azimuths

    def lanes(self, mask: Tensor) -> Domain:
        """The domain of some points of planes (*B, N) by themselves, as planes (M,); it answers `contains` alone."""
        domain = copy.copy(self)
        domain.k = [c.expand_as(mask)[mask] for c in self.k]
        domain.lens = self.optics(domain.k)[1]
        domain.row = self.row.expand_as(mask)[mask]
        return domain

    def _limits(self, lost: Tensor) -> Tensor:
        """(*B, azimuths): the radius, up to the next azimuth, before which the sense at the point itself decides."""
        limit = _radius_at(self.radii.unsqueeze(-2), lost)
        following = limit.roll(-1, -1)
        nearer, further = torch.minimum(limit, following), torch.maximum(limit, following)
        # Between two azimuths the fold moves smoothly, and may bulge: the sense tells where it lies. Or it ends there:
        # then the nearer one is on the safe side.
        smooth = ((lost - lost.roll(-1, -1)).abs() <= 1.5) | (further <= (1 + _SMOOTH) * nearer)
        return torch.where(smooth, further * (1 + _BULGE), nearer)

    def contains(self, a: Tensor, b: Tensor, sense: Tensor) -> Tensor:
        """Bool: plane points (*B, N) before the fold of their azimuth; `sense` is that of the lens at these points."""
        # nearer to zero its reciprocal could leave the floating-point range
        regular = sense > torch.finfo(a.dtype).tiny ** 0.25
        limits = self.limits
        if self.azimuths > 1:
            index = self.row + self._azimuth(a, b, 0.0)
            limits = torch.gather(limits.flatten(), 0, index.flatten()).view(index.shape)
        return regular & (a * a + b * b < limits * limits)

    def bracket(self, target: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The radii (*B, N) between which the lens reaches `target` on the azimuth of (a, b), and a guess between them.

        Looked for before the fold only: a target that is not reached ends up next to it.
        """
        row = self._azimuth(a, b, 0.5) * self.count if self.azimuths > 1 else torch.zeros_like(target, dtype=torch.long)
        table = self.reach.flatten(-2).expand(*target.shape[:-1], -1)
        low = _last_not_above(table, row, self.count, target)
        near, far = torch.gather(table, -1, row + low), torch.gather(table, -1, row + low + 1)
        # next to the fold only its inner side is safe to start from
        fraction = torch.where(far < torch.inf, (target - near) / torch.where(far > near, far - near, 1.0), 0.0)
        radii = self.radii.expand(*target.shape[:-1], -1)
        lower, inner, upper = (torch.gather(radii, -1, (low + i).clamp(max=self.count - 1)) for i in range(3))
        return lower, lower + fraction.clamp(0, 1) * (inner - lower), upper

    def _azimuth(self, a: Tensor, b: Tensor, offset: float) -> Tensor:
        """The index of the azimuth at or below that of the points; `offset` 0.5 gives the nearest one."""
        turn = torch.atan2(b, a) * (self.azimuths / (2 * math.pi)) + offset
        return turn.floor().long().remainder(self.azimuths)


def _last_not_above(table: Tensor, row: Tensor, length: int, target: Tensor) -> Tensor:
    """The index, up to length - 2, of the last entry not above the target in the ascending row that begins at `row`."""
    low, high = torch.zeros_like(row), torch.full_like(row, length - 1)
    for _ in range((length - 1).bit_length()):
        middle = (low + high) // 2
        above = torch.gather(table, -1, row + middle) > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return low.clamp(max=length - 2)


def _around(radial: Lens | None, chart: Chart, fine: Tensor) -> Tensor:
    """(*B, radii): the chart's, and more of them the nearer to the fold of the radial part, if it has one."""
    if radial is None:
        return chart.radii(_COARSE + _CLOSE, fine)
    fold = _radius_at(fine, _first_loss(radial.linearise(fine, torch.zeros_like(fine))[2]).unsqueeze(-1))
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


def _first_loss(sense: Tensor) -> Tensor:
    """(*B, A, S) -> (*B, A): the node, with a fraction at a dip, where the sense is first lost; S where it never is."""
    before, here, after = sense[..., :-2], sense[..., 1:-1], sense[..., 2:]
    bend, tilt = before - 2 * here + after, before - after
    bend_safe = torch.where(bend > 0, bend, 1.0)
    dips = (bend > 0) & (tilt.abs() <= bend) & (here - tilt * tilt / (8 * bend_safe) <= 0)
    offset = torch.where(dips & (here > 0), tilt / (2 * bend_safe), 0.0)
    nodes = torch.arange(sense.shape[-1], dtype=sense.dtype, device=sense.device)
    inner = torch.where(dips | ~(here > 0), nodes[1:-1] + offset, torch.inf)
    ends = torch.where(sense[..., [0, -1]] > 0, torch.inf, nodes[[0, -1]])
    return torch.cat((inner, ends), -1).amin(-1).clamp(max=sense.shape[-1])
