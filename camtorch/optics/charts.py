"""Charts: closed-form maps from a ray to a point of a plane, and back.

A chart works on component planes, not on interleaved triples. It states which rays it covers and which points of its
plane are the image of a ray; the camera passes it only those, so no chart guards its own formulas.
"""

import math
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor

from camtorch.evaluate.export import atan2, plus
from camtorch.native.structs import CYLINDER, EQUIDISTANT, EQUISOLID, FOV, ONE_DIVISION, PERSPECTIVE, SPHERE
from camtorch.optics.special import angle_per_radius, cos_root, sinc_root, tanc_root

Planes2 = tuple[Tensor, Tensor]
Planes3 = tuple[Tensor, Tensor, Tensor]

_SMALLEST_RADIUS = 1e-4  # a hundredth of a degree


def unit(x: Tensor, y: Tensor, z: Tensor) -> Planes3:
    """Return the direction scaled to length one."""
    scale = (x * x + y * y + z * z).rsqrt()
    return x * scale, y * scale, z * scale


def floor_of(dtype: torch.dtype) -> float:
    """Return a square that adds nothing to 1, and whose reciprocal's square is still a number."""
    return math.sqrt(torch.finfo(dtype).tiny)


class Chart:
    """A map between rays and a plane. Rays arrive with their largest component near 1, and results have unit length.

    The axis (0, 0, 1) is covered by every chart and lies at (0, 0).

    Margins are positive if a condition holds.
    """

    code: ClassVar[int | None] = None
    """The code in native/structs.py, which a class states for itself, not for subclasses. None: only Python has it."""
    has_scale = True
    """Whether the plane point is (x, y) times a `scale`."""
    parameters: tuple[Tensor, ...] = ()
    """The learnable parts of the formulas: columns that broadcast against planes.

    The formulas read them here, and nothing else depends on the coefficients.
    """

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Return a margin, positive for rays that have a point."""
        raise NotImplementedError

    def scale(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Tensor:
        """Return the factor by which (x, y) become the plane point; see `to_plane`, which other charts override."""
        raise NotImplementedError

    def to_plane(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Planes2:
        """Return the plane point of covered rays; derivatives up to that order must be exact, on the axis too."""
        scale = self.scale(x, y, z, order)
        return x * scale, y * scale

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        """Return a margin, positive for points of the plane that are the image of a ray."""
        raise NotImplementedError

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        """Return the unit ray of points on the plane; see `to_plane`."""
        raise NotImplementedError

    def seen(self, a: Tensor, b: Tensor) -> Tensor | None:
        """Return a margin, positive for a lens's points that are the image of a ray; None if all up to `end` are."""
        return None

    def end(self, dtype: torch.dtype) -> float | Tensor:
        """Return the radius on the plane at which the chart ends, one or (C, 1). Only charts before a lens need it."""
        raise NotImplementedError

    def usual_end(self, dtype: torch.dtype) -> float | Tensor:
        """Return the radius beyond which no image reaches, up to which inverses are tabulated."""
        return self.end(dtype)

    def radii(self, count: int, like: Tensor) -> Tensor:
        """Return ascending radii (count,) from the centre of the plane to the end of the chart.

        Half of them are in even steps of the angle, half in even ratios: a telephoto lens may fold within a degree. By
        default the steps are of the radius, up to an `end` that is a float.
        """
        end: Any = self.end(like.dtype)
        return even_steps_and_ratios(count, end, end, like, torch.positive)


def even_steps_and_ratios(
    count: int, steps_to: float, end: float, like: Tensor, bend: Callable[[Tensor], Tensor]
) -> Tensor:
    """Return radii (count,) for `Chart.radii`: `bend` of even steps up to `steps_to`, and even ratios up to `end`."""
    dtype, device = like.dtype, like.device
    steps = torch.linspace(0, steps_to, count // 2, dtype=dtype, device=device)
    powers = torch.linspace(math.log(_SMALLEST_RADIUS), math.log(end), count - count // 2, dtype=dtype, device=device)
    return torch.cat((bend(steps), powers.exp())).sort().values


class Perspective(Chart):
    """(x/z, y/z): covers rays in front of the camera.

    Rays within `1 / end` of 90 degrees are left out: the ninth power of the radius, as in distortions, overflows there.
    """

    code: ClassVar[int | None] = PERSPECTIVE

    def end(self, dtype: torch.dtype) -> float:
        return min(1e9, math.pow(torch.finfo(dtype).max, 1 / 9))

    def usual_end(self, dtype: torch.dtype) -> float:
        return math.tan(math.radians(87))

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return self.end(z.dtype) * z - torch.maximum(x.abs(), y.abs())

    def scale(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Tensor:
        return z.reciprocal()

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        return self.end(a.dtype) - torch.maximum(a.abs(), b.abs())

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        z = torch.addcmul(a * a + 1, b, b).rsqrt()
        return a * z, b * z, z

    def radii(self, count: int, like: Tensor) -> Tensor:
        return even_steps_and_ratios(count, math.radians(88), self.end(like.dtype), like, torch.tan)


class Equidistant(Chart):
    """theta (cos phi, sin phi), theta = atan2(hypot(x, y), z): covers every ray but the exact backward one."""

    code: ClassVar[int | None] = EQUIDISTANT

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        # closer to the backward direction the derivative pi / rho leaves the floating-point range
        floor = floor_of(z.dtype) / torch.finfo(z.dtype).eps
        return torch.maximum(z, torch.addcmul(plus(x * x, -floor), y, y))

    def scale(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Tensor:
        return angle_per_radius(torch.addcmul(x * x, y, y), z, order)

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        return math.pi**2 - torch.addcmul(a * a, b, b)

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        theta2 = torch.addcmul(a * a, b, b)
        sinc = sinc_root(theta2, order)
        return a * sinc, b * sinc, cos_root(theta2, order)

    def end(self, dtype: torch.dtype) -> float | Tensor:
        return math.pi

    def radii(self, count: int, like: Tensor) -> Tensor:
        return even_steps_and_ratios(count, math.pi, math.pi, like, torch.positive)


class EquidistantUpTo(Equidistant):
    """The equidistant chart of a lens that is known up to some angle."""

    code: ClassVar[int | None] = EQUIDISTANT

    last: Tensor

    def __init__(self, last: Tensor):
        self.last = last.detach()

    def end(self, dtype: torch.dtype) -> float | Tensor:
        return self.last.clamp(max=math.pi)


def _half_turn(dtype: torch.dtype) -> float:
    # pi rounded to float32 is larger than pi, and so would be seen from the other side
    return math.pi * (1 - torch.finfo(dtype).eps)


class CylinderChart(Chart):
    """(longitude, height) = (atan2(x, z), y / hypot(x, z)): covers every ray but straight up and down."""

    code: ClassVar[int | None] = CYLINDER
    has_scale = False

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return Perspective().end(y.dtype) * torch.maximum(x.abs(), z.abs()) - y.abs()

    def to_plane(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Planes2:
        return atan2(x, z), y * (x * x + z * z).rsqrt()

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        return torch.minimum(_half_turn(a.dtype) - a.abs(), Perspective().end(b.dtype) - b.abs())

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        return unit(torch.sin(a), b, torch.cos(a))


class SphereChart(Chart):
    """(longitude, latitude) = (atan2(x, z), atan2(y, hypot(x, z))): covers every ray but straight up and down."""

    code: ClassVar[int | None] = SPHERE
    has_scale = False

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return plus(x * x + z * z, -floor_of(y.dtype))

    def to_plane(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Planes2:
        return atan2(x, z), atan2(y, (x * x + z * z).sqrt())

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        return torch.minimum(_half_turn(a.dtype) - a.abs(), math.pi / 2 - b.abs())

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        across = torch.cos(b)
        return torch.sin(a) * across, torch.sin(b), torch.cos(a) * across


class Transverse(Chart):
    """Another chart about the x axis instead of the y axis: x and y are exchanged, and so are a and b."""

    has_scale = False

    def __init__(self, chart: Chart):
        self.chart = chart

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return self.chart.margin(y, x, z)

    def to_plane(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Planes2:
        b, a = self.chart.to_plane(y, x, z, order)
        return a, b

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        return self.chart.on_plane(b, a)

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        y, x, z = self.chart.to_ray(b, a, order)
        return x, y, z


def _sum(z: Tensor, root: Tensor, difference: Tensor) -> Tensor:
    """Return the sum z + root for difference = root^2 - z^2, without the cancellation for z < 0."""
    ahead = z > 0
    return torch.where(ahead, z + root, difference / torch.where(ahead, 1.0, root - z))


class Equisolid(Chart):
    """2 sin(theta / 2) (cos phi, sin phi): covers every ray but the exact backward one."""

    code: ClassVar[int | None] = EQUISOLID

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return Equidistant().margin(x, y, z)

    def scale(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Tensor:
        rho2 = torch.addcmul(x * x, y, y)
        distance = torch.addcmul(rho2, z, z).sqrt()
        return (2 / (distance * _sum(z, distance, rho2))).sqrt()

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        return self.end(a.dtype) ** 2 - torch.addcmul(a * a, b, b)

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        r2 = torch.addcmul(a * a, b, b)
        across = (1 - r2 / 4).sqrt()
        return a * across, b * across, 1 - r2 / 2

    def end(self, dtype: torch.dtype) -> float:
        # at the end itself the derivative of its ray is infinite
        return 2 * (1 - 64 * torch.finfo(dtype).eps)


class Fov(Chart):
    """r = atan2(2 tan(omega / 2) rho, z) / omega: every ray but the exact backward one; those ahead if omega = 0.

    It is even and analytic in omega, which lies between -pi and pi.
    """

    code: ClassVar[int | None] = FOV

    def __init__(self, omega: Tensor):
        self.parameters: tuple[Tensor, ...] = (omega,)

    def _slope(self) -> tuple[Tensor, Tensor]:
        """Return 2 tan(omega / 2) / omega and the square of 2 tan(omega / 2)."""
        (omega,) = self.parameters
        slope = tanc_root(omega * omega / 4)
        return slope, (omega * slope) ** 2

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        (omega,), (_, tan2) = self.parameters, self._slope()
        most = Perspective().end(z.dtype)
        ahead = most * z - torch.maximum(x.abs(), y.abs())
        around = plus(tan2 * torch.addcmul(x * x, y, y), -floor_of(z.dtype) / torch.finfo(z.dtype).eps)
        # behind the plane of the camera r is up to pi / omega
        return torch.maximum(ahead, torch.minimum(around, omega * omega * most**2 - math.pi**2))

    def scale(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Tensor:
        slope, tan2 = self._slope()
        return slope * angle_per_radius(tan2 * torch.addcmul(x * x, y, y), z, order)

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        (omega,) = self.parameters
        inside = math.pi**2 - omega * omega * torch.addcmul(a * a, b, b)
        return torch.minimum(inside, Perspective().end(a.dtype) / 2 - torch.maximum(a.abs(), b.abs()))

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        (omega,), (slope, _) = self.parameters, self._slope()
        angle2 = omega * omega * torch.addcmul(a * a, b, b)
        sinc = sinc_root(angle2, order) / slope
        return unit(a * sinc, b * sinc, cos_root(angle2, order))


class OneDivision(Chart):
    """The rays (a, b, 1 + coefficient r^2): all but the exact backward one for a negative coefficient."""

    code: ClassVar[int | None] = ONE_DIVISION

    def __init__(self, coefficient: Tensor):
        self.parameters: tuple[Tensor, ...] = (coefficient,)

    def _below(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the number by which 2 (x, y) is divided, and one that is positive before the fold."""
        (coefficient,) = self.parameters
        difference = -4 * coefficient * torch.addcmul(x * x, y, y)
        square = torch.addcmul(difference, z, z)
        return _sum(z, square.sqrt(), difference), square

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        below, square = self._below(x, y, z)
        return torch.minimum(Perspective().end(z.dtype) / 2 * below - torch.maximum(x.abs(), y.abs()), square)

    def scale(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Tensor:
        return 2 / self._below(x, y, z)[0]

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        (coefficient,) = self.parameters
        # stay away from the fold, which the ray's own rounding would cross; `margin` has the square of this
        before = 1 - 16 * torch.finfo(a.dtype).eps ** 0.5 - coefficient * torch.addcmul(a * a, b, b)
        return torch.minimum(before, Perspective().end(a.dtype) / 2 - torch.maximum(a.abs(), b.abs()))

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        (coefficient,) = self.parameters
        return unit(a, b, torch.addcmul(torch.ones_like(a), coefficient, torch.addcmul(a * a, b, b)))
