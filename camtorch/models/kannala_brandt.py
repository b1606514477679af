"""The Kannala-Brandt fisheye camera, OpenCV's: r = theta (1 + k1 theta^2 + k2 theta^4 + ...)."""

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor

from camtorch.evaluate.tensors import known_false
from camtorch.models._polynomial import OddPolynomial
from camtorch.optics import Chart, Equidistant, Lens, Planar, Polynomial
from camtorch.values.arguments import Numbers, as_batch, as_coordinates, as_real


class KannalaBrandt(OddPolynomial):
    """The radially symmetric fisheye: r = theta (1 + k1 theta^2 + k2 theta^4 + ...).

    theta = atan2(hypot(x, y), z), so that angles past 90 degrees are real; (u, v) = f r (cos phi, sin phi) + c. A ray
    is valid before the first root of dr/dtheta.

    Distortion: k1 k2 ..., any number of coefficients, at least one; 4 by default. Source: OpenCV `fisheye`, with 4. The
    same as Aria KANNALA_BRANDT_K3, Basalt kb4, COLMAP OPENCV_FISHEYE. See `Camera` for conventions and errors.

    Example:
        >>> ct.KannalaBrandt([300.0, 300.0, 319.5, 239.5]).project([1.0, 0.0, -1.0])[1].item()  # 135 degrees
        True
    """

    key = "kannala_brandt"

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Equidistant(), Lens(Planar(Polynomial(k)))

    @classmethod
    def from_general(
        cls, intrinsics: Numbers, coefficients: Numbers, *, image_size: Sequence[int] | None = None
    ) -> Self:
        """Return the camera of the paper's form r = k1 theta + k2 theta^3 + ..., which has no leading 1.

        Args:
            intrinsics: fx, fy, cx, cy (*B, 4); focal lengths 1, 1 if the coefficients are in pixels.
            coefficients: k1, k2, ... (*B, n), n >= 1, of the paper; k1 > 0 is folded into the focal lengths.
            image_size: (height, width) in pixels.

        Source: Kannala and Brandt, "A generic camera model and calibration method for conventional,
        wide-angle, and fish-eye lenses", PAMI 2006, equation (6).

        Raises:
            ValueError: If there are no coefficients, or the first one is not positive.
        """
        intrinsics = as_real(intrinsics, "intrinsics", cls.__name__)
        coefficients = as_real(coefficients, "coefficients", cls.__name__, intrinsics.device)
        as_coordinates(intrinsics, "intrinsics", 4, cls.__name__, form="*B")
        if coefficients.ndim == 0 or coefficients.shape[-1] == 0:
            raise ValueError(f"{cls.__name__}: coefficients must be (*B, n), n >= 1; got {tuple(coefficients.shape)}")
        first = coefficients[..., :1]
        if known_false(first > 0):
            raise ValueError(f"{cls.__name__}: the first coefficient must be positive; got {first.tolist()}")
        as_batch(cls.__name__, intrinsics=intrinsics.shape, coefficients=coefficients.shape)
        focal, centre = torch.broadcast_tensors(intrinsics[..., :2] * first, intrinsics[..., 2:])
        rest = coefficients[..., 1:] / first if coefficients.shape[-1] > 1 else torch.zeros_like(first)
        return cls(torch.cat((focal, centre), -1), rest, image_size=image_size)
