"""Limits of a lens's coefficients, beyond which it would fold or bend too much on an image."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics.backprojection import FURTHEST, Inverted
from camtorch.optics.charts import Chart
from camtorch.values.arguments import columns

BEYOND = 1.02  # times the image's radius, so that its rim is safe from rounding
_NODES = 48  # of Chebyshev: a polynomial of t = radius^2 is hardly larger between them than at them
_KEPT = 0.02  # of the way from the given lens to the end of a formula, which is kept free
_AZIMUTHS = 360  # a shear near its end has its least slope in a narrow sector
_AT_AXIS = 1e-6  # of the radius; further out a chart of a large xi or alpha may have no rays
_FIRST, _LAST, _GRID, _NEARER = 1e-3, 1e3, 32, 3  # the first bracket of the end, its nodes, and shifts nearer
_ROUNDS, _PARTS = 5, 8  # of bracketing the end more closely
_STEP = 1e-6  # relative, of finite differences of the margin

# positive for a lens in the set, by the ratio of its profile to that of the given lens
_MARGINS: dict[str, Callable[[Tensor], Tensor]] = {
    "room": lambda ratio: ratio - _KEPT,  # positive where the chart has rays
    "turns": lambda ratio: torch.minimum(ratio / 0.25 - 1, 1 - ratio / 20.0),  # angles from node to node
    "slope": lambda ratio: ratio - 0.05,  # a lower bound in all directions
    "reach": lambda ratio: 1 - ratio / 4.0,  # an upper bound of the factor by which points move out
    "defined": lambda ratio: ratio - _KEPT,  # positive where the formula exists
}


class Limits:
    """The set of coefficients with which a model is one-to-one on a disc around the axis, around a given lens.

    Its lenses have, on the whole disc and in every direction, more than a twentieth of the given lens's slope, and
    move no point four times as far out; charts with coefficients are at least a quarter and at most twenty times as
    steep as the given one. The set is convex if all terms of a lens are in one stage and linear in the coefficients:
    polynomials, decentering, thin prisms. Otherwise only lines from the given lens are used.

    Coefficients are (*C, n) and radii of discs, on the plane of the chart, (*C, 1); `given` is (n,).
    """

    def __init__(self, model: type[Camera], given: Tensor):
        self.model = model
        self.given = given
        chart, lens = model.optics(columns(given))
        self.bends: bool = len(chart.parameters) > 0
        self.is_radial: bool = len(lens.stages) == 0 or lens.is_radial

    def disc(self, k: Tensor, radius: Tensor) -> Tensor:
        """Return the radius (*C, 1) of the disc that shows, near the axis, as much as that of the given lens."""
        if not self.bends:
            return radius
        given, other = (_angles(self.model.optics(columns(w))[0], _AT_AXIS * radius) for w in (self.given, k))
        return radius * given / other

    def filled(self, k: Tensor, radius: Tensor) -> Tensor:
        """Return the radius (*C, 1) of the largest circle of the sensor, in focal lengths, that the disc fills."""
        _, lens = self.model.optics(columns(k))
        if not lens.stages:
            return radius
        count = 1 if self.is_radial else _AZIMUTHS
        turn = torch.arange(count, dtype=k.dtype, device=k.device) * (2 * math.pi / count)
        return torch.hypot(*lens(radius * turn.cos(), radius * turn.sin())).amin(-1, keepdim=True)

    def _profile(self, k: Tensor, radius: Tensor) -> dict[str, Tensor]:
        """Return the numbers of a lens from the axis outwards, (*C, nodes) each, by names of `_MARGINS`."""
        share = torch.arange(1, _NODES + 1, dtype=k.dtype, device=k.device) * (math.pi / (2 * _NODES))
        radii = BEYOND * self.disc(k, radius) * share.sin()
        chart, lens = self.model.optics(columns(k))
        angles = _angles(chart, radii)
        # a lens that turns back is excluded without a table
        room = FURTHEST - radii if isinstance(chart, Inverted) else chart.on_plane(radii, torch.zeros_like(radii))
        profile = {"room": torch.minimum(room, math.pi - angles)}
        if self.bends:
            profile["turns"] = angles.diff(dim=-1, prepend=torch.zeros_like(angles[..., :1]))
        if lens.stages:
            profile["slope"], furthest = lens.lower_bound(radii)
            profile["reach"] = furthest / radii
        defined = self.model.defined(k.unbind(-1))
        return profile if defined is None else {**profile, "defined": defined.unsqueeze(-1)}

    def along(self, direction: Tensor, radius: Tensor) -> Tensor:
        """Return how many times (C, 1) a direction (C, n) may be added to the given coefficients before the set ends.

        The result is at most a thousand, and the first end if there are several. First derivatives are exact.
        """
        # a hypotenuse of two zeros has no gradient
        start = self.given.to(direction) + torch.finfo(direction.dtype).tiny ** 0.5

        def margin(times: Tensor, direction: Tensor, radius: Tensor, given: dict[str, Tensor]) -> Tensor:
            """Return the margin (C, S), positive in the set, with the direction added so many times (C, S)."""
            here = self._profile(start + times.unsqueeze(-1) * direction.unsqueeze(-2), radius.unsqueeze(-2))
            least = [_MARGINS[name](value / given[name]).nan_to_num(nan=-1.0).amin(-1) for name, value in here.items()]
            return torch.stack(torch.broadcast_tensors(*least)).amin(0)

        with torch.no_grad():
            plain = direction.detach(), radius.detach(), self._profile(start, radius.detach().unsqueeze(-2))
            times, ends = _end(lambda times: margin(times, *plain), direction)
            step = _STEP * times
            slope = (margin(times + step, *plain) - margin(times - step, *plain)) / (2 * step)
            ends &= slope < 0
        # the implicit function theorem: the end moves so that the margin remains zero
        # without an end, take derivatives at the given lens, since elsewhere the formula may not exist
        direction = torch.where(ends, direction, 0.0)
        there = margin(times, direction, radius, self._profile(start, radius.unsqueeze(-2)))
        moved = (there - there.detach()) / torch.where(ends, slope, 1.0)
        return times - torch.where(ends, moved, 0.0)


def _end(margin: Callable[[Tensor], Tensor], like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first times (C, 1) at which a margin of times (C, S) is not positive, and whether there is one."""
    nearest = torch.full_like(like[:, :1], _FIRST)
    for _ in range(_NEARER):  # 1 may be far out for other coefficients than one with little effect
        nearest = torch.where(margin(nearest) > 0, nearest, nearest * (_FIRST / _LAST))
    share = torch.linspace(0, 1, _GRID, dtype=like.dtype, device=like.device)
    parts = torch.arange(1, _PARTS + 1, dtype=like.dtype, device=like.device) / _PARTS
    times, low = nearest * (_LAST / _FIRST) ** share, torch.zeros_like(nearest)
    for i in range(_ROUNDS):
        kept = (margin(times) > 0).long().cumprod(-1).sum(-1, keepdim=True)
        if i == 0:
            ends = kept < times.shape[-1]
        low = torch.where(kept > 0, times.gather(-1, (kept - 1).clamp(min=0)), low)
        high = times.gather(-1, kept.clamp(max=times.shape[-1] - 1))
        times = low + (high - low) * parts
    before, after = margin(low), margin(high)
    fraction = (before / (before - after)).nan_to_num(nan=0.0).clamp(0, 1)
    return low + (high - low) * torch.where(ends, fraction, 0.0), ends


def _angles(chart: Chart, radii: Tensor) -> Tensor:
    x, _, z = chart.to_ray(radii, torch.zeros_like(radii), 1)
    return torch.atan2(x, z)
