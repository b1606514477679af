"""Project Aria's Fisheye624: r = theta (1 + k0 theta^2 + ...), then tangential and thin-prism terms."""

from collections.abc import Sequence
from types import MappingProxyType

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Equidistant, Lens, Planar, Polynomial


class Fisheye624(Camera):
    """Project Aria's fisheye with six radial, two tangential and four thin-prism coefficients.

    With theta = atan2(hypot(x, y), z), real past 90 degrees:

        r   = theta (1 + k0 theta^2 + k1 theta^4 + ... + k5 theta^12)
        (a, b) = r (cos phi, sin phi)
        a' = a + p0 (2 a^2 + r^2) + 2 p1 a b + s0 r^2 + s1 r^4
        b' = b + p1 (2 b^2 + r^2) + 2 p0 a b + s2 r^2 + s3 r^4

    (u, v) = f (a', b') + c. A ray is valid before the fold of r and, on its azimuth, before that of the small rest.

    Distortion: k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3. Source: Project Aria, `FisheyeRadTanThinPrism.h`, which sends z < 0
    to the pixel of the antipodal point; here it is the model's own. COLMAP RAD_TAN_THIN_PRISM_FISHEYE. See `Camera`.

    Example:
        >>> ct.Fisheye624([300.0, 300.0, 319.5, 239.5], [0.1] + 11 * [0.0]).unproject([319.5, 239.5])[0].tolist()
        [0.0, 0.0, 1.0]
    """

    key = "fisheye624"
    distortion_names: tuple[str, ...] = ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3")
    default_count = 12
    special_cases = (("fisheye62", distortion_names[:8]),)
    odd_in_x = frozenset({"p0", "s0", "s1"})
    odd_in_y = frozenset({"p1", "s2", "s3"})
    quarter_turn = MappingProxyType({"p0": "-p1", "p1": "p0", "s0": "-s2", "s1": "-s3", "s2": "s0", "s3": "s1"})

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Equidistant(), Lens(Planar(Polynomial(k[:6])), Planar(tangential=k[6:8], prism=k[8:]))


FisheyeRadTanThinPrism = Fisheye624
