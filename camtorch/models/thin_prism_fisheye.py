"""COLMAP's thin-prism fisheye: theta (cos phi, sin phi) with radial, tangential and thin-prism terms."""

from collections.abc import Sequence
from types import MappingProxyType

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Equidistant, Lens, Planar, Polynomial


class ThinPrismFisheye(Camera):
    """COLMAP's thin-prism fisheye: all its terms are added at the undistorted point of the equidistant plane.

    With (a, b) = theta (cos phi, sin phi), theta = atan2(hypot(x, y), z), real past 90 degrees, and t = theta^2:

        a' = a (1 + k1 t + k2 t^2 + k3 t^3 + k4 t^4) + 2 p1 a b + p2 (t + 2 a^2) + sx1 t
        b' = b (1 + k1 t + k2 t^2 + k3 t^3 + k4 t^4) + p1 (t + 2 b^2) + 2 p2 a b + sy1 t

    (u, v) = f (a', b') + c. A ray is valid before the fold of the map on its azimuth. It is no special case of
    `Fisheye624`, whose tangential and thin-prism terms are made of the radius after the polynomial.

    Distortion: k1 k2 p1 p2 k3 k4 sx1 sy1. The same as COLMAP THIN_PRISM_FISHEYE, which stops at 90 degrees. Source:
    COLMAP, `models.h`. See `Camera` for shapes, conventions and errors.
    """

    key = "thin_prism_fisheye"
    distortion_names: tuple[str, ...] = ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")
    default_count = 8
    special_cases = (("kannala_brandt", ("k1", "k2", "k3", "k4")),)
    odd_in_x = frozenset({"p2", "sx1"})
    odd_in_y = frozenset({"p1", "sy1"})
    quarter_turn = MappingProxyType({"p1": "p2", "p2": "-p1", "sx1": "-sy1", "sy1": "sx1"})

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        k1, k2, p1, p2, k3, k4, sx1, sy1 = k
        zero = torch.zeros_like(sx1)
        # as in OpenCV, p2 is the decentering coefficient along x
        stage = Planar(Polynomial((k1, k2, k3, k4)), tangential=(p2, p1), prism=(sx1, zero, sy1, zero))
        return Equidistant(), Lens(stage)
