"""The domain of a lens: where it is one-to-one, and a table to start its inverse from, made once for its values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from camtorch.evaluate.export import of_points, plus
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import may_branch_on
from camtorch.native.structs import AZIMUTHS, MOST_RADII
from camtorch.optics.radial_inverse import RADII, InverseTable, first_loss, fold_of, precise, tabulate, within
from camtorch.projection.fold import Extent, azimuth, limits_and_extent
from camtorch.values.arguments import columns, present

if TYPE_CHECKING:
    from camtorch.optics.charts import Chart
    from camtorch.optics.lens import Lens
    from camtorch.optics.model_spec import Optics

_CAMERAS_AT_ONCE = 6  # whose azimuths are followed together
_BOUND_RADII = 129  # at which the bounds of stages after a radial one are taken
_FARTHEST_BOUND = 1.25  # times the edge of the radial stage, up to there
# Stages after a radial one that change distances by less than a quarter, and so move points by less than that, are
# inverted by Newton's method from anywhere: each step leaves at most 2/3 of the distance
_LEAST_SLOPE = 0.75

InverseBy = Literal["radius", "stages", "plane", "either"]
"""How lenses are inverted: along the radius, by stages, in the plane, or either of the last two, as their camera asks.

It goes along the radius if the lens is radial, and by stages if only the first of them, a radial one, has a limit.
"""


def _per_camera(make: Callable[[Domain], Tensor]) -> cached_property[Tensor]:
    """Return a property with a table (C, ...) that is made at its first use."""

    def table(self: Domain) -> Tensor:
        # a graph could not use tensors of inference mode later
        with torch.inference_mode(False), torch.no_grad():
            return make(self)

    table.__doc__ = make.__doc__
    return cached_property(table)


class Domain:
    """The lenses of cameras (C,), graph-free, and their domains.

    A point (a, b) of the chart's plane is in the domain if its lens is regular all the way from the centre: up to the
    fold of a radial lens, and of a lens whose other stages change distances little. For other lenses, bounds of their
    terms give the radius up to which they certainly are; azimuths are followed only if a point lies further out.
    """

    def __init__(
        self,
        optics: Optics,
        k: Tensor,
        known: Mapping[str, object] = MappingProxyType({}),
        *,
        is_constant: bool = False,
    ):
        """Make the domain of a model's `optics` and coefficients (C, n), of the points' dtype and device.

        known: Properties by name, in place of those that it would make. is_constant: Whether it is a constant of an
        exported program for other runtimes, where no tensor is a view of another.
        """
        self.optics, self.k, self.is_constant = optics, k, is_constant
        self.chart, self.lens = optics([c.clone() for c in columns(k)] if is_constant else columns(k))
        for name, value in known.items():  # before they are read: a compiler cannot follow a cached property's lock
            setattr(self, name, value)

    def optics_of(self, camera: Tensor) -> tuple[Chart, Lens]:
        """Return the chart and lens of single points (M,), each seen by the camera of that index."""
        return self.optics(of_points(self.k, camera))

    @cached_property
    def _followed(self) -> tuple[Tensor, Extent]:
        with torch.inference_mode(False), torch.no_grad():
            parts_of_k = self.k.split(_CAMERAS_AT_ONCE)
            limits2, extents = zip(*(limits_and_extent(self.optics, k) for k in parts_of_k), strict=True)
            return torch.cat(limits2), Extent(*(torch.cat(parts) for parts in zip(*extents, strict=True)))

    @cached_property
    def extent(self) -> Extent:
        """The extents of all cameras."""
        return self._followed[1]

    @_per_camera
    def edge2(self) -> Tensor:
        """Return (C, 1), the furthest squared radius to which the first stage's radial factor sends its fold."""
        radial = present(self.optics(columns(precise(self.k)))[1].radial, "a radial factor")
        edge = self._fold * radial(self._fold * self._fold)
        return (edge * edge).to(self.k.dtype)

    @_per_camera
    def image_circle_sq(self) -> Tensor:
        """Return (C, 1), the squared radius of the image's circle, beyond which it shows nothing; infinite if unknown.

        It is finite if the domain ends at the fold of a first, radial stage: then the inverse goes stage by stage.
        """
        if self.lens.rest is None:
            return self.k.new_full((self.k.shape[0], 1), torch.inf)
        k = precise(self.k)
        rest = present(self.optics(columns(k))[1].rest, "a later stage")
        edge = self.edge2.to(k.dtype).sqrt()
        steps = torch.linspace(0, _FARTHEST_BOUND, _BOUND_RADII, dtype=k.dtype, device=k.device)
        least, furthest = rest.lower_bound(edge * steps)
        # a number that changes less from radius to radius than it is large has no zero in between
        certain = least.amin(-1, keepdim=True) - least.diff(dim=-1).abs().amax(-1, keepdim=True)
        furthest_out = torch.where(steps <= 1 + steps[1], furthest, 0.0).amax(-1, keepdim=True)
        return torch.where(certain > _LEAST_SLOPE, furthest_out * furthest_out, torch.inf).to(self.k.dtype)

    @_per_camera
    def stagewise(self) -> Tensor:
        """Return (C, 1) bool, whether the inverse goes stage by stage; see `image_circle_sq`."""
        return torch.isfinite(self.image_circle_sq)

    @cached_property
    def inverse_by(self) -> InverseBy:
        """How the lenses of all cameras are inverted: "plane" where values may not be read."""
        return way_of_inverse(self.lens.is_radial, None if self.lens.rest is None else self.stagewise)

    @property
    def is_circular(self) -> bool:
        """Whether the domain of all cameras is a circle, whose radius is the fold of the first stage."""
        return self.inverse_by in ("radius", "stages")

    @_per_camera
    def safe_radius_sq(self) -> Tensor:
        """Return (C, 1), the squared radius up to which the lens is certainly regular: of a circular fold, its own."""
        if self.is_circular:
            inner = self._fold.to(self.k.dtype)
        else:
            radii = self.chart.radii(MOST_RADII, self.k)
            lost = first_loss(self.lens.lower_bound(radii.expand(self.k.shape[0], -1))[0])
            inner = radii[(lost - 1).floor().clamp(0, MOST_RADII - 1).long()].unsqueeze(-1)
            if self.inverse_by == "either":
                inner = torch.where(self.stagewise, self._fold.to(inner.dtype), inner)
        return within(inner.clamp(max=self.chart.end(inner.dtype)))

    @_per_camera
    def limits2(self) -> Tensor:
        """Return (C, azimuths), from each azimuth to the next the squared radius up to which the orientation decides.

        Beyond it the lens is folded. It is 0 for cameras whose domain is a circle.
        """
        if self.is_circular:
            return self.k.new_zeros(self.k.shape[0], AZIMUTHS)
        limits2 = self._followed[0]
        return torch.where(self.stagewise, 0.0, limits2) if self.inverse_by == "either" else limits2

    @_per_camera
    def _fold(self) -> Tensor:
        """Return (C, 1), the fold of the first stage's radial factor, in double precision if the device has it."""
        k = precise(self.k)
        chart, lens = self.optics(columns(k))
        radial, most = present(lens.radial, "a radial factor"), torch.finfo(self.k.dtype).max ** 0.25
        return fold_of(radial, lambda: chart.radii(RADII, k), chart.end(self.k.dtype), most)

    @_per_camera
    def table(self) -> Tensor:
        """Return the table (C, 2 + 2 nodes) of `inverse`."""
        chart, lens = self.optics(columns(precise(self.k)))
        radial = present(lens.radial, "a radial factor")
        return tabulate(radial, self._fold, chart.usual_end(self.k.dtype)).to(self.k.dtype)

    @cached_property
    def inverse(self) -> InverseTable | None:
        """The inverse of the first stage's radial factor, if it has one."""
        return InverseTable(self.table) if self.lens.radial else None

    @cached_property
    def image_radius_sq(self) -> Tensor:
        """The squared radii (C, 1) of `safe_radius_sq`, but no further out than images reach."""
        return self.safe_radius_sq.clamp(max=self.chart.usual_end(self.k.dtype) ** 2)

    def margin(self, a: Tensor, b: Tensor, t: Tensor) -> Tensor:
        """Return a margin, positive for the plane points (C, N) in the domain; t is a^2 + b^2."""
        inside = self.safe_radius_sq - t
        if self.is_circular:
            return inside
        if may_branch_on(inside):  # few points are as far out
            places = (~(inside > 0)).nonzero(as_tuple=True)
            camera, _ = places
            if len(camera):
                a, b = a[places], b[places]
                before = self.limits2[camera, azimuth(a, b)] - t[places]
                outside = torch.minimum(before, regular(self.optics_of(camera)[1], a, b))
                inside[places] = torch.maximum(inside[places], outside)
            return inside
        index = azimuth(a, b)
        index = index + torch.arange(self.k.shape[0], device=t.device, dtype=index.dtype).unsqueeze(-1) * AZIMUTHS
        limits2 = self.limits2.flatten().index_select(0, index.flatten()).view(index.shape)
        return torch.maximum(inside, torch.minimum(limits2 - t, regular(self.lens, a, b)))


def way_of_inverse(is_radial: bool, stagewise: Tensor | None) -> InverseBy:
    """Return the way of the inverse of lenses, of which those that are `stagewise` (C, 1) may go stage by stage."""
    if is_radial:
        return "radius"
    if stagewise is None or not bool(stagewise.any()):
        return "plane"
    return "stages" if bool(stagewise.all()) else "either"


def regular(lens: Lens, a: Tensor, b: Tensor, to_edge: bool = True) -> Tensor:
    """Return a margin, positive where a lens is regular, up to its edge or beyond, so that its inverse is smooth."""
    at = lens.at(a, b)
    edge = at.edge if to_edge else None
    least = at.orientation if edge is None else torch.minimum(at.orientation, edge)
    # closer to zero the reciprocal could leave the floating-point range
    return plus(torch.nan_to_num(least, nan=-1.0), -(torch.finfo(a.dtype).tiny ** 0.25))


_domains = Kept(24)  # enough for a batch of eight models before, while and after it changes


def domain_of(model: str, k: Tensor, optics: Optics) -> Domain:
    """Return the domain of these values: one of the last ones used, or a new one."""
    return _domains((k,), (model,), lambda: Domain(optics, k.detach().clone()))
