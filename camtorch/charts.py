"""Charts: a ray to a point of a plane in closed form, and back.

A chart works on component planes, not on interleaved triples. It states which rays it covers and which
points of its plane are the image of a ray; the camera hands it nothing else, so no chart guards its own formulas.
"""

import math

import torch
from torch import Tensor

from camtorch.analytic import angle_per_radius, cos_root, sinc_root

_SMALLEST_RADIUS = 1e-4  # a hundredth of a degree

Planes2 = tuple[Tensor, Tensor]
Planes3 = tuple[Tensor, Tensor, Tensor]


def unit(x: Tensor, y: Tensor, z: Tensor) -> Planes3:
    """The direction scaled to length one."""
    scale = (x * x + y * y + z * z).rsqrt()
    return x * scale, y * scale, z * scale


class Chart:
    """What a camera asks of a chart. Rays arrive with their largest component at 1, results are unit length.

    The axis (0, 0, 1) is covered by every chart and lies at (0, 0).
    """

    def covers(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Bool: the rays that this chart has a point for."""
        raise NotImplementedError

    def to_plane(self, x: Tensor, y: Tensor, z: Tensor) -> Planes2:
        """The plane point of covered rays."""
        raise NotImplementedError

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        """Bool: the points of the plane that are the image of a ray."""
        raise NotImplementedError

    def to_ray(self, a: Tensor, b: Tensor) -> Planes3:
        """The unit ray of points on the plane."""
        raise NotImplementedError

    def radii(self, count: int, like: Tensor) -> Tensor:
        """(count,) ascending radii from the centre of the plane to the end of the chart.

        Half of them in even steps of the angle, half in even ratios: a telephoto lens may fold within a degree.
        Only charts that a lens follows need them.
        """
        raise NotImplementedError


def _even_steps_and_ratios(count: int, steps_to: float, end: float, like: Tensor, bend) -> Tensor:
    options = {"dtype": like.dtype, "device": like.device}
    steps = bend(torch.linspace(0, steps_to, count // 2, **options))
    ratios = torch.linspace(math.log(_SMALLEST_RADIUS), math.log(end), count - count // 2, **options).exp()
    return torch.cat((steps, ratios)).sort().values


class Perspective(Chart):
    """(x/z, y/z): rays in front of the camera.

    Rays within `1 / limit` of 90 degrees are left out: there the ninth power of the radius, which
    distortion polynomials reach, leaves the floating-point range.
    """

    @staticmethod
    def limit(dtype: torch.dtype) -> float:
        return min(1e9, torch.finfo(dtype).max ** (1 / 9))

    def covers(self, x, y, z):
        return torch.maximum(x.abs(), y.abs()) < self.limit(z.dtype) * z

    def to_plane(self, x, y, z):
        return x / z, y / z

    def on_plane(self, a, b):
        return torch.maximum(a.abs(), b.abs()) < self.limit(a.dtype)

    def to_ray(self, a, b):
        return unit(a, b, torch.ones_like(a))

    def radii(self, count, like):
        return _even_steps_and_ratios(count, math.radians(88), 1.5 * self.limit(like.dtype), like, torch.tan)


class Equidistant(Chart):
    """theta (cos phi, sin phi), theta = atan2(hypot(x, y), z): every ray but the exact backward one."""

    def covers(self, x, y, z):
        # closer to the backward direction the derivative pi / rho leaves the floating-point range
        return (z > 0) | (x * x + y * y > torch.finfo(z.dtype).tiny ** 0.5)

    def to_plane(self, x, y, z):
        scale = angle_per_radius(x * x + y * y, z)
        return x * scale, y * scale

    def on_plane(self, a, b):
        return a * a + b * b < math.pi**2

    def to_ray(self, a, b):
        theta2 = a * a + b * b
        sinc = sinc_root(theta2)
        return a * sinc, b * sinc, cos_root(theta2)

    def radii(self, count, like):
        return _even_steps_and_ratios(count, math.pi, math.pi, like, torch.positive)


def _half_turn(dtype: torch.dtype) -> float:
    # pi rounded to float32 is larger than pi, and seen from the other side
    return math.pi * (1 - torch.finfo(dtype).eps)


class CylinderChart(Chart):
    """(longitude, height) = (atan2(x, z), y / hypot(x, z)). Every ray but straight up and down."""

    def covers(self, x, y, z):
        return y.abs() < Perspective.limit(y.dtype) * torch.maximum(x.abs(), z.abs())

    def to_plane(self, x, y, z):
        return torch.atan2(x, z), y * (x * x + z * z).rsqrt()

    def on_plane(self, a, b):
        return (a.abs() < _half_turn(a.dtype)) & (b.abs() < Perspective.limit(b.dtype))

    def to_ray(self, a, b):
        return unit(torch.sin(a), b, torch.cos(a))


class SphereChart(Chart):
    """(longitude, latitude) = (atan2(x, z), atan2(y, hypot(x, z))). Every ray but straight up and down."""

    def covers(self, x, y, z):
        return x * x + z * z > torch.finfo(y.dtype).tiny ** 0.5

    def to_plane(self, x, y, z):
        return torch.atan2(x, z), torch.atan2(y, (x * x + z * z).sqrt())

    def on_plane(self, a, b):
        return (a.abs() < _half_turn(a.dtype)) & (b.abs() < math.pi / 2)

    def to_ray(self, a, b):
        across = torch.cos(b)
        return torch.sin(a) * across, torch.sin(b), torch.cos(a) * across
