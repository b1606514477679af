"""The f-theta fisheye camera: r is a free polynomial of the angle, r = theta (1 + k2 theta + k3 theta^2 + ...)."""

from collections.abc import Sequence
from typing import ClassVar

from torch import Tensor

from camtorch.models._polynomial import FreePolynomial, Sheared
from camtorch.optics import Chart, Equidistant, Lens, Planar, RadiusPolynomial, Shear


class FTheta(FreePolynomial):
    """The radially symmetric fisheye with a free polynomial: r = theta (1 + k2 theta + k3 theta^2 + ...).

    theta = atan2(hypot(x, y), z), so that angles past 90 degrees are real; (u, v) = f r (cos phi, sin phi) + c. The
    coefficients are dimensionless: `from_polynomial` takes a polynomial in pixels, and folds its linear
    coefficient into the focal lengths. A ray is valid before the first root of dr/dtheta.

    With even powers of theta the camera has one continuous derivative on the axis, and no second one: that depends on
    the azimuth. The first one is exact there, and the second one is given as zero; everywhere else all are exact.

    Distortion: k2 k3 ... by the power of theta, any number of them, at least one; 3 if left out. The same as
    `WoodScape`, which has three, and NVIDIA DriveWorks `ftheta` if its polynomial gives pixels of angles
    (`fw-poly`); one that gives angles of pixels is `FThetaBackward`. Files of NVIDIA have a linear part, too, for
    which `from_polynomial` makes an `FThetaSheared`. See `Camera` for shapes, conventions and errors.
    """

    key = "f_theta"
    special_cases: ClassVar[tuple[tuple[str, tuple[str, ...]], ...]] = (
        ("woodscape", ("k2", "k3", "k4")),
        ("kannala_brandt", ("k3", "k5", "k7", "k9", "k11", "k13")),
    )

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Equidistant(), Lens(Planar(RadiusPolynomial(k)))

    @classmethod
    def _scaled(cls, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        return coefficients[..., :1], coefficients[..., 1:] / coefficients[..., :1]


class FThetaSheared(Sheared, FTheta):
    """NVIDIA's f-theta camera with all of its linear part: of `FTheta`'s (x, y), (u, v) = f (x + e y, d x + y) + c.

    `from_polynomial` takes the [[c, d], [e, 1]] of files: d here is their e, e is their d / c, and c is fx / fy.

    Distortion: d e k2 k3 ..., d and e of the linear part like `OCamCalib`, then those of `FTheta`, at least one; 5 if
    left out. Source: NVIDIA's nvidia-ncore, `FThetaCameraModel`. On the axis see `FTheta`, for conventions `Camera`.
    """

    key = "f_theta_sheared"
    special_cases = (("f_theta", tuple(f"k{i}" for i in range(2, 33))),)

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Equidistant(), Lens(Planar(RadiusPolynomial(k[2:])), Shear(*k[:2]))


FTheta.sheared = FThetaSheared
