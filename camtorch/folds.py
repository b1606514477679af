"""Where a lens folds: how far out, on every azimuth, its map of the chart's plane stays one-to-one."""

import math

import torch
from torch import Tensor

_AZIMUTHS = 256
_RADII = 64
_RADII_RADIAL = 256  # one azimuth stands for all


class FoldLimits:
    """For each camera and azimuth, a radius before which the sign at the point itself decides.

    On each azimuth the sense of the lens (positive where its determinant is) is followed outwards over nodes;
    the limit is the first node where it is not positive, or the bottom of a parabola through three nodes
    that dips below zero between them. Up to that limit there is at most one change of sign, so the
    sense at the point itself tells exactly on which side of the fold it lies.
    """

    def __init__(self, lens, chart, like: Tensor):
        """like: gives the dtype and device. The limits are graph-free, of shape (*B, azimuths)."""
        self.azimuths = 1 if lens.is_radial else _AZIMUTHS
        radii = chart.radii(_RADII_RADIAL if lens.is_radial else _RADII, like)
        angles = torch.arange(self.azimuths, dtype=like.dtype, device=like.device) * (2 * math.pi / self.azimuths)
        a, b = (torch.outer(f(angles), radii).flatten() for f in (torch.cos, torch.sin))
        sense = lens.jacobian(a, b)[1].unflatten(-1, (self.azimuths, len(radii)))
        position = _first_loss(sense)
        index = position.floor().long().clamp(max=len(radii) - 1)
        inner, outer = radii[index], radii[(index + 1).clamp(max=len(radii) - 1)]
        limit = torch.where(position < len(radii), inner + (position - index) * (outer - inner), math.inf)
        # Between two azimuths the fold moves smoothly, or it ends there: then nearer is the safe side
        smooth = (position - position.roll(-1, -1)).abs() <= 1.5
        following = limit.roll(-1, -1)
        self.limits = torch.where(smooth, torch.maximum(limit, following), torch.minimum(limit, following))

    def before(self, a: Tensor, b: Tensor) -> Tensor:
        """Bool: plane points (*B, N) that lie before the limit of their azimuth."""
        radius2 = a * a + b * b
        if self.azimuths == 1:
            return radius2 < self.limits * self.limits
        turn = torch.atan2(b, a) / (2 * math.pi)
        index = ((turn - turn.floor()) * self.azimuths).long().clamp(max=self.azimuths - 1)
        limits = torch.gather(self.limits.expand(*index.shape[:-1], -1), -1, index)
        return radius2 < limits * limits


def _first_loss(sense: Tensor) -> Tensor:
    """(*B, A, S) -> (*B, A): the node, with a fraction at a dip, where the sense is first lost; S where it never is."""
    count = sense.shape[-1]
    before, here, after = sense[..., :-2], sense[..., 1:-1], sense[..., 2:]
    bend = before - 2 * here + after
    tilt = before - after
    bend_safe = torch.where(bend > 0, bend, 1.0)
    dip = (bend > 0) & (tilt.abs() <= bend) & (here - tilt * tilt / (8 * bend_safe) <= 0)
    offset = torch.where(dip & (here > 0), tilt / (2 * bend_safe), 0.0)
    edge = torch.zeros_like(sense[..., :1])
    lost = ~(sense > 0) | torch.cat((edge, dip.to(edge.dtype), edge), -1).bool()
    position = torch.arange(count, dtype=sense.dtype, device=sense.device) + torch.cat((edge, offset, edge), -1)
    return torch.where(lost, position, float(count)).amin(-1)
