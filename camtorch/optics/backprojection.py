"""The chart of cameras that are defined from the pixel to the angle; Newton's method finds the other direction."""

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from camtorch.evaluate.export import as_constant, is_portable_export, times
from camtorch.native.structs import INVERTED
from camtorch.optics.charts import Chart, Equidistant, Planes3, even_steps_and_ratios
from camtorch.optics.radial import RadialFactor
from camtorch.optics.radial_inverse import RadialInverse

FURTHEST = math.tan(math.radians(87))  # the radius, in focal lengths, up to which pixels have rays


class Inverted(Chart):
    """The point (a, b) of radius r sees the angle theta = r R(r^2), R a radial factor; see `Equidistant`.

    Rays are covered before theta stops ascending, and up to `FURTHEST`.
    """

    code: ClassVar[int | None] = INVERTED

    def __init__(self, factor: type[RadialFactor], parameters: Sequence[Tensor]):
        """Make the chart from the class of R, whose instances are made of the parameters."""
        self.factor = factor
        self.parameters: tuple[Tensor, ...] = tuple(parameters)
        self._known: RadialInverse | None = None

    @property
    def _inverse(self) -> RadialInverse:
        """The inverse with its tables, without a graph, made at first use; compiled graphs may keep nothing."""
        if torch.compiler.is_compiling() and not is_portable_export():
            return RadialInverse(self.factor, self.parameters, FURTHEST)
        if self._known is None:
            with as_constant():
                self._known = RadialInverse(self.factor, self.parameters, FURTHEST)
        return self._known

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        theta2 = torch.addcmul(x * x, y, y) * Equidistant().scale(x, y, z, 1) ** 2
        # stay away from the fold, which the ray's own rounding would cross
        before = times(self._inverse.most2, 1 - 32 * torch.finfo(z.dtype).eps) - theta2
        return torch.minimum(Equidistant().margin(x, y, z), before)

    def scale(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Tensor:
        angle = Equidistant().scale(x, y, z, order)
        theta2 = torch.minimum(torch.addcmul(x * x, y, y) * angle * angle, self._inverse.most2)
        # the solution of s R(theta2 s^2) = 1 with its derivatives, as `solve.attach` does it
        scale = self._inverse(theta2.detach())
        with torch.no_grad():
            t = theta2.detach() * scale * scale
            factor, slope = self._inverse.radial.derivatives(t, 1)
            step = torch.addcmul(factor, t, slope, value=2).reciprocal()
        radial = self.factor(self.parameters)
        for _ in range(max(order, 1)):
            scale = scale + (1 - scale * radial(theta2 * scale * scale)) * step
        return angle * scale

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        t = torch.addcmul(a * a, b, b)
        inside = times(self._inverse.safe_radius_sq, 1 - 64 * torch.finfo(a.dtype).eps) - t
        t = torch.minimum(t, self._inverse.safe_radius_sq)
        theta2 = t * self._inverse.radial(t) ** 2
        # where theta stops ascending its rounding is that of many radii; so further away from there than in `margin`
        before = times(self._inverse.most2, 1 - 128 * torch.finfo(a.dtype).eps)
        return torch.minimum(inside, before.clamp(max=math.pi**2) - theta2)

    def seen(self, a: Tensor, b: Tensor) -> Tensor:
        return self.on_plane(a, b)

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        factor = self.factor(self.parameters)(torch.addcmul(a * a, b, b))
        return Equidistant().to_ray(a * factor, b * factor, order)

    def end(self, dtype: torch.dtype) -> float | Tensor:
        inverse = self._inverse
        # beyond half a turn a ray is seen from the other side
        most2 = (math.pi * (1 - 32 * torch.finfo(dtype).eps)) ** 2
        turned = math.pi * inverse(inverse.most2.clamp(max=most2))
        t = inverse.safe_radius_sq
        return torch.where(t * inverse.radial(t) ** 2 > most2, turned, t.sqrt()).to(dtype)

    def radii(self, count: int, like: Tensor) -> Tensor:
        return even_steps_and_ratios(count, FURTHEST, FURTHEST, like, torch.positive)
