"""Charts of wide-angle cameras in closed form: equisolid, field-of-view, division."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from camtorch.optics.charts import Chart, Equidistant, Perspective, even_steps_and_ratios, floor_of, unit
from camtorch.optics.special import angle_per_radius, cos_root, sinc_root, tanc_root


def _length(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    rho2 = torch.addcmul(x * x, y, y)
    return rho2, torch.addcmul(rho2, z, z).sqrt()


def _sum(z: Tensor, root: Tensor, difference: Tensor) -> Tensor:
    """Z + root where difference = root^2 - z^2, without the cancellation for z < 0."""
    ahead = z > 0
    return torch.where(ahead, z + root, difference / torch.where(ahead, 1.0, root - z))


class Equisolid(Chart):
    """2 sin(theta / 2) (cos phi, sin phi): every ray but the exact backward one."""

    def margin(self, x, y, z):
        return Equidistant().margin(x, y, z)

    def covers_all(self, nearest, extent, dtype):
        return True

    def scale(self, x, y, z, order=2):
        rho2, distance = _length(x, y, z)
        return (2 / (distance * _sum(z, distance, rho2))).sqrt()

    def on_plane(self, a, b):
        return self.end(a.dtype) ** 2 - torch.addcmul(a * a, b, b)

    def to_ray(self, a, b, order=2):
        r2 = torch.addcmul(a * a, b, b)
        across = (1 - r2 / 4).sqrt()
        return a * across, b * across, 1 - r2 / 2

    def end(self, dtype):
        # at the end itself the derivative of its ray is infinite
        return 2 * (1 - 64 * torch.finfo(dtype).eps)

    def radii(self, count, like):
        return even_steps_and_ratios(count, self.end(like.dtype), self.end(like.dtype), like, torch.positive)


class Fov(Chart):
    """r = atan2(2 tan(omega / 2) rho, z) / omega: every ray but the exact backward one; those in front for omega = 0.

    Even and analytic in omega, which lies between -pi and pi.
    """

    def __init__(self, omega: Tensor):
        self.parameters = (omega,)

    def _slope(self) -> tuple[Tensor, Tensor]:
        """2 tan(omega / 2) / omega and the square of 2 tan(omega / 2)."""
        (omega,) = self.parameters
        slope = tanc_root(omega * omega / 4)
        return slope, (omega * slope) ** 2

    def margin(self, x, y, z):
        (omega,), (_, tan2) = self.parameters, self._slope()
        most = Perspective().end(z.dtype)
        ahead = most * z - torch.maximum(x.abs(), y.abs())
        around = tan2 * torch.addcmul(x * x, y, y) - floor_of(z.dtype) / torch.finfo(z.dtype).eps
        # behind the plane of the camera r is up to pi / omega
        return torch.maximum(ahead, torch.minimum(around, omega * omega * most**2 - math.pi**2))

    def covers_all(self, nearest, extent, dtype):
        return Perspective().end(dtype) * nearest > extent

    def scale(self, x, y, z, order=2):
        slope, tan2 = self._slope()
        return slope * angle_per_radius(tan2 * torch.addcmul(x * x, y, y), z, order)

    def on_plane(self, a, b):
        (omega,) = self.parameters
        inside = math.pi**2 - omega * omega * torch.addcmul(a * a, b, b)
        return torch.minimum(inside, Perspective().end(a.dtype) / 2 - torch.maximum(a.abs(), b.abs()))

    def to_ray(self, a, b, order=2):
        (omega,), (slope, _) = self.parameters, self._slope()
        angle2 = omega * omega * torch.addcmul(a * a, b, b)
        sinc = sinc_root(angle2, order) / slope
        return unit(a * sinc, b * sinc, cos_root(angle2, order))


class OneDivision(Chart):
    """The rays (a, b, 1 + coefficient r^2): all but the exact backward one for a negative coefficient."""

    def __init__(self, coefficient: Tensor):
        self.parameters = (coefficient,)

    def _below(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """The plane point is 2 (x, y) over the first; the second is positive before the fold."""
        (coefficient,) = self.parameters
        difference = -4 * coefficient * torch.addcmul(x * x, y, y)
        square = torch.addcmul(difference, z, z)
        return _sum(z, square.sqrt(), difference), square

    def margin(self, x, y, z):
        below, square = self._below(x, y, z)
        return torch.minimum(Perspective().end(z.dtype) / 2 * below - torch.maximum(x.abs(), y.abs()), square)

    def covers_all(self, nearest, extent, dtype):
        return False

    def scale(self, x, y, z, order=2):
        return 2 / self._below(x, y, z)[0]

    def on_plane(self, a, b):
        (coefficient,) = self.parameters
        # away from the fold, where the ray's own rounding would carry it across
        before = 1 - 64 * torch.finfo(a.dtype).eps - coefficient * torch.addcmul(a * a, b, b)
        return torch.minimum(before, Perspective().end(a.dtype) / 2 - torch.maximum(a.abs(), b.abs()))

    def to_ray(self, a, b, order=2):
        (coefficient,) = self.parameters
        return unit(a, b, torch.addcmul(torch.ones_like(a), coefficient, torch.addcmul(a * a, b, b)))
