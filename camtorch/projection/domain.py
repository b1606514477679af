"""The domain of a lens: where it is one-to-one, and a table to start its inverse from. Made once per set of values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from camtorch._arguments import columns
from camtorch._tracing import may_look
from camtorch.projection.fold import AZIMUTHS, Azimuths, azimuth, first_loss, radial_orientation

if TYPE_CHECKING:
    from camtorch.optics.charts import Chart
    from camtorch.optics.lens import Lens, Polynomial, Rational

Optics = Callable[[Sequence[Tensor]], tuple["Chart", "Lens"]]

_RADII = 512
_PARTS = 256  # of the interval in which a fold is looked for; twice, then the secant
_NODES = 1024  # of the table of an inverse
_HALF_WAY = 2.0  # the squared radius in the middle of the table of a lens that never folds


def _per_camera(make: Callable[[Domain], Tensor]) -> cached_property:
    """A table (C, ...) that is made when it is first asked for; that of some cameras is a part of the whole one."""

    def table(self: Domain) -> Tensor:
        if self.whole is not None:
            return getattr(self.whole, make.__name__)[self.cameras]
        with torch.no_grad():
            return make(self)

    table.__doc__ = make.__doc__
    return cached_property(table)


class Domain:
    """The lenses of cameras (C,), graph-free, and their domains.

    A point (a, b) of the chart's plane is in the domain if its lens is regular all the way from the centre. A radial
    lens is followed to the root. Of others it is known from bounds of their terms how far out they certainly are; the
    azimuths are followed only when a point lies further out.
    """

    def __init__(self, optics: Optics, k: Tensor, whole: Domain | None = None, cameras: slice = slice(None)):
        """optics: a model's. k: (C, n) coefficients, in the dtype and on the device of the points.

        whole, cameras: the domain of which this is a part.
        """
        self.optics, self.k, self.whole, self.cameras = optics, k, whole, cameras
        self.chart, self.lens = optics(columns(k))

    def part(self, cameras: slice) -> Domain:
        """The domain of some of the cameras."""
        if cameras.stop - cameras.start == len(self.k):
            return self
        return Domain(self.optics, self.k[cameras], self, cameras)

    def optics_of(self, camera: Tensor) -> tuple[Chart, Lens]:
        """Of single points (M,), each seen by the camera of that index."""
        # a single camera serves all points
        k = self.k[0].unsqueeze(-1) if len(self.k) == 1 else self.k[camera].mT
        return self.optics(k.unbind(0))

    def with_tables(self, inner2: Tensor, limits2: Tensor, table: Tensor) -> Domain:
        """The same domain with tables that were made elsewhere."""
        self.__dict__.update(inner2=inner2, limits2=limits2, table=table)
        return self

    @cached_property
    def azimuths(self) -> Azimuths:
        """Of all cameras, also where this is a part."""
        with torch.no_grad():
            return Azimuths(self.chart, self.lens, self.k)

    @_per_camera
    def inner2(self) -> Tensor:
        """(C, 1): the squared radius up to which the lens is certainly regular; for a radial lens the fold itself."""
        radii = self.chart.radii(_RADII, self.k)
        if self.lens.is_radial:
            inner = self._fold.to(self.k.dtype)
        else:
            lost = first_loss(self.lens.lower_bound(radii.expand(len(self.k), -1)))
            inner = radii[(lost - 1).floor().clamp(0, _RADII - 1).long()].unsqueeze(-1)
        inside = 1 - 4 * torch.finfo(inner.dtype).eps
        return (inner.clamp(max=self.chart.end(inner.dtype)) * inside) ** 2

    @_per_camera
    def limits2(self) -> Tensor:
        """(C, azimuths): the squared radius, up to the next azimuth, before which the orientation decides."""
        return self.azimuths.limits.clamp(max=self.chart.end(self.k.dtype)) ** 2

    @_per_camera
    def _fold(self) -> Tensor:
        """(C, 1): that of the radial factor of the first stage, in double precision where there is one."""
        k = _precise(self.k)
        chart, lens = self.optics(columns(k))
        return _fold(lens.radial, chart, k, chart.end(self.k.dtype), torch.finfo(self.k.dtype).max ** 0.25)

    @_per_camera
    def table(self) -> Tensor:
        """(C, 2 + 2 nodes): what `inverse` is made of."""
        k = _precise(self.k)
        chart, lens = self.optics(columns(k))
        return tabulate(lens.radial, self._fold, chart.usual_end(self.k.dtype)).to(self.k.dtype)

    @property
    def inverse(self) -> RadialInverse | None:
        """That of the radial factor of the first stage, if it has one."""
        return RadialInverse(self.table) if self.lens.radial else None

    def margin(self, a: Tensor, b: Tensor, t: Tensor) -> Tensor:
        """Positive for the plane points (C, N) in the domain; t = a^2 + b^2."""
        inside = self.inner2 - t
        if self.lens.is_radial or (may_look(inside) and bool(inside.amin() > 0)):
            return inside
        row = torch.arange(len(self.k), device=t.device, dtype=torch.int32).unsqueeze(-1) * AZIMUTHS
        index = row + azimuth(a, b)
        limits2 = self.limits2.flatten().index_select(0, index.flatten()).view(index.shape)
        return torch.maximum(inside, torch.minimum(limits2 - t, regular(self.lens, a, b)))


def regular(lens: Lens, a: Tensor, b: Tensor) -> Tensor:
    """Positive where the lens is regular at the point itself, and its inverse has a derivative."""
    # nearer to zero the reciprocal could leave the floating-point range
    return torch.nan_to_num(lens.at(a, b).orientation, nan=-1.0) - torch.finfo(a.dtype).tiny ** 0.25


def _precise(k: Tensor) -> Tensor:
    return k if k.device.type == "mps" else k.double()


def _fold(radial: Polynomial | Rational, chart: Chart, k: Tensor, end: float | Tensor, most: float) -> Tensor:
    """(C, 1): the smallest radius at which a radial factor is no longer regular, or the end of the chart.

    most: the largest image that is a number to calculate with.
    """

    def orientation(radius: Tensor) -> Tensor:
        found, image = radial_orientation(radial, radius), radius * radial(radius * radius)
        return torch.where(image < most, found, -1.0)

    nodes = chart.radii(2 * _RADII, k).clamp(max=end).expand(len(k), -1)
    lost = first_loss(orientation(nodes)).unsqueeze(-1)
    some = lost < nodes.shape[-1]

    def node(index: Tensor) -> Tensor:
        return nodes.gather(-1, index.long().clamp(0, nodes.shape[-1] - 1))

    low, high = node((lost - 1).floor()), node(lost.ceil())
    # at a dip between nodes the upper end is the bottom of its parabola
    at_dip = node(lost.floor()) + (lost - lost.floor()) * (high - node(lost.floor()))
    high = torch.where(lost == lost.floor(), high, at_dip)
    steps = torch.linspace(0, 1, _PARTS + 1, dtype=k.dtype, device=k.device)
    for _ in range(2):
        inner = low + (high - low) * steps
        # the upper end counts as lost, whatever rounding says of it
        first = (orientation(inner) > 0).long().cumprod(-1).sum(-1, keepdim=True).clamp(1, _PARTS)
        low, high = inner.gather(-1, first - 1), inner.gather(-1, first)
    before, after = orientation(low), orientation(high)
    crossing = (before > 0) & (after < 0)
    fraction = torch.where(crossing, before / torch.where(crossing, before - after, 1.0), 0.0)
    return torch.where(some, low + fraction * (high - low), end)


def tabulate(radial: Polynomial | Rational, fold: Tensor, usual_end: float | Tensor) -> Tensor:
    """(C, 2 + 2 nodes): the table of a `RadialInverse`, see there."""
    end = fold.clamp(max=usual_end)
    u = torch.linspace(0, 1, _NODES + 1, dtype=fold.dtype, device=fold.device)
    square = _square(u, end * end)
    factor = radial(square)
    r2 = torch.cummax(square * factor * factor, -1).values
    reach2 = r2[..., -1:]
    # where the nodes' images lie, and what lies at nodes that are even there
    at = _variable(r2, reach2).contiguous()
    cell = (torch.searchsorted(at, u.expand_as(at).contiguous(), right=True) - 1).clamp(0, _NODES - 1)
    low, high = at.gather(-1, cell), at.gather(-1, cell + 1)
    scale = factor.reciprocal()
    before, step = scale.gather(-1, cell), scale.diff(dim=-1).gather(-1, cell)
    values = before + ((u - low) / torch.where(high > low, high - low, 1.0)).clamp(0, 1) * step
    wanted = _square(u, reach2)
    for _ in range(2):
        t = wanted * values * values
        factor, slope = radial.derivatives(t, 1)
        slope = factor + 2 * t * slope
        correction = (values * factor - 1) / torch.where(slope > 0, slope, 1.0)
        values = values - torch.maximum(torch.minimum(correction, step.abs()), -step.abs())
    values = torch.cat((values[..., :-1], scale[..., -1:]), -1)
    most2 = torch.where(fold > usual_end, torch.inf, reach2)
    return torch.cat((reach2, most2, values[..., :-1], values.diff(dim=-1)), -1)


def _square(u: Tensor, top2: Tensor) -> Tensor:
    """The inverse of `_variable`."""
    x = u * (2 - u) * (top2 / (top2 + _HALF_WAY))
    return _HALF_WAY * x / (1 - x)


def _variable(r2: Tensor, top2: Tensor) -> Tensor:
    x = r2 / (r2 + _HALF_WAY) * ((top2 + _HALF_WAY) / top2)
    return 1 - (1 - x).clamp(min=0).sqrt()


def table_width() -> int:
    """The number of columns of `tabulate`."""
    return 2 + 2 * _NODES


class RadialInverse:
    """The factor by which the inverse of a radial factor scales a point, tabulated over the point's squared radius r2.

    The table's variable is 1 - sqrt(1 - x), x = r2 / (r2 + 2) scaled to 1 at the fold: it takes the root singularity
    at the fold out of the inverse, and is as analytic in r2 as that.
    """

    def __init__(self, table: Tensor):
        """table: (C, 2 + 2 nodes): its last squared radius, the largest one that has a point, factors and steps."""
        self.reach2, self.most2 = table[..., :1], table[..., 1:2]
        self.values, self.steps = table[..., 2 : 2 + _NODES], table[..., 2 + _NODES :]

    def __call__(self, r2: Tensor) -> Tensor:
        """The factor for (C, N), to about 1e-6."""
        position = _variable(r2, self.reach2) * _NODES
        node = position.to(torch.int32).clamp(0, _NODES - 1)  # NaN becomes some integer
        fraction = position - node
        if len(self.values) > 1:
            node = node + torch.arange(len(self.values), device=r2.device, dtype=torch.int32).unsqueeze(-1) * _NODES
        node = node.flatten()
        value, step = (w.flatten().index_select(0, node).view(r2.shape) for w in (self.values, self.steps))
        return torch.addcmul(value, fraction, step)
