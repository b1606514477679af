"""The f-theta fisheye camera: a free polynomial of the angle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from camtorch._arguments import as_batch, as_real
from camtorch._tracing import is_concrete
from camtorch.camera import Camera
from camtorch.optics import Equidistant, Lens, Planar, RadiusPolynomial

if TYPE_CHECKING:
    from torch import Tensor
    from typing_extensions import Self


class FreePolynomial(Camera):
    """What a polynomial of all powers has in common, be it of the angle or of the radius."""

    distortion_names = ("k2", "k3", "k4")
    default_count = 3
    fit_counts = (3, 5, 7)

    @classmethod
    def names_of(cls, count):
        return tuple(f"k{i}" for i in range(2, count + 2)) or None

    @classmethod
    def counts_text(cls):
        return "n >= 1 (k2 k3 ...)"

    @classmethod
    def from_polynomial(cls, centre, coefficients, *, aspect_ratio: float = 1.0, image_size=None) -> Self:
        """From a polynomial without a leading 1: k1 theta + k2 theta^2 + ... pixels.

        For `FThetaBackward` it is the angle, k1 d + k2 d^2 + ... of the distance d from the axis in pixels.

        Args:
            centre: (*B, 2) cx, cy, the pixel of the axis.
            coefficients: (*B, n), n >= 2: k1, k2, ...; k1 > 0 makes the focal length.
            aspect_ratio: fy / fx.
            image_size: (height, width) in pixels.

        Raises:
            ValueError: fewer than two coefficients, or a first one that is not positive.
        """
        centre, coefficients = (
            as_real(v, n, cls.__name__) for v, n in ((centre, "centre"), (coefficients, "coefficients"))
        )
        if centre.ndim == 0 or centre.shape[-1] != 2:
            raise ValueError(f"{cls.__name__}: centre must be (*B, 2) = cx, cy; got shape {tuple(centre.shape)}")
        if coefficients.ndim == 0 or coefficients.shape[-1] < 2:
            raise ValueError(f"{cls.__name__}: coefficients must be (*B, n), n >= 2; got {tuple(coefficients.shape)}")
        first = coefficients[..., :1]
        if is_concrete(first) and not bool((first > 0).all()):
            raise ValueError(
                f"{cls.__name__}: the first coefficient, of the first power, must be positive; got {first.tolist()}. "
                "A constant before it, which is zero, is left out"
            )
        as_batch(cls.__name__, centre=centre.shape, coefficients=coefficients.shape)
        focal, distortion = cls._scaled(coefficients)
        focal, centre = torch.broadcast_tensors(torch.cat((focal, focal * aspect_ratio), -1), centre)
        return cls(torch.cat((focal, centre), -1), distortion, image_size=image_size)

    @classmethod
    def _scaled(cls, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """The focal length, and coefficients in units of it."""
        raise NotImplementedError


class FTheta(FreePolynomial):
    """The radially symmetric fisheye with a free polynomial: r = theta (1 + k2 theta + k3 theta^2 + ...).

    theta = atan2(hypot(x, y), z), so that angles past 90 degrees are real; (u, v) = f r (cos phi, sin phi) + c. The
    coefficients are dimensionless: a polynomial in pixels comes in through `from_polynomial`, which folds its linear
    coefficient into the focal lengths. A ray is valid before the first root of dr/dtheta.

    With even powers of theta the camera has one continuous derivative on the axis, and no second one: that depends on
    the azimuth. The first one is exact there, and the second one is given as zero; everywhere else all are exact.

    Distortion: k2 k3 ... by the power of theta, any number of them, at least one; 3 if left out. The same as
    `WoodScape`, which has three, and NVIDIA DriveWorks `ftheta` where its polynomial gives pixels of angles
    (`fw-poly`); one that gives angles of pixels is `FThetaBackward`. See `Camera` for shapes, conventions and errors.
    """

    key = "f_theta"
    special_cases = (("woodscape", ("k2", "k3", "k4")), ("kannala_brandt", ("k3", "k5", "k7", "k9", "k11", "k13")))

    @staticmethod
    def optics(k):
        return Equidistant(), Lens(Planar(RadiusPolynomial(k)))

    @classmethod
    def _scaled(cls, coefficients):
        return coefficients[..., :1], coefficients[..., 1:] / coefficients[..., :1]
