"""Project Aria's Fisheye62: r = theta (1 + k0 theta^2 + ... + k5 theta^12), then tangential terms."""

from collections.abc import Sequence
from types import MappingProxyType

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Equidistant, Lens, Planar, Polynomial


class Fisheye62(Camera):
    """Project Aria's fisheye with six radial and two tangential coefficients.

    With theta = atan2(hypot(x, y), z), real past 90 degrees:

        r   = theta (1 + k0 theta^2 + k1 theta^4 + ... + k5 theta^12)
        (a, b) = r (cos phi, sin phi)
        a' = a + p0 (2 a^2 + r^2) + 2 p1 a b
        b' = b + p1 (2 b^2 + r^2) + 2 p0 a b

    (u, v) = f (a', b') + c. A ray is valid before the fold of r and, on its azimuth, that of the tangential terms.

    Distortion: k0 k1 k2 k3 k4 k5 p0 p1. Source: Project Aria, `Fisheye62.h`, which sends z < 0 to the pixel of the
    antipodal point; here it is the model's own. See `Camera` for shapes, conventions and errors.

    Example:
        >>> ct.KannalaBrandt([300.0, 300.0, 319.5, 239.5], [0.1, 0.0, 0.0, 0.0]).convert("fisheye62").camera
        Fisheye62(fx=300, fy=300, cx=319.5, cy=239.5, k0=0.1, k1=0, k2=0, k3=0, k4=0, k5=0, p0=0, p1=0, float64, learns)
    """

    key = "fisheye62"
    distortion_names: tuple[str, ...] = ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1")
    default_count = 8
    special_cases = (("kannala_brandt", distortion_names[:6]),)
    odd_in_x = frozenset({"p0"})
    odd_in_y = frozenset({"p1"})
    quarter_turn = MappingProxyType({"p0": "-p1", "p1": "p0"})

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Equidistant(), Lens(Planar(Polynomial(k[:6])), Planar(tangential=k[6:]))
