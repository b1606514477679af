"""The f-theta fisheye camera from the pixel to the angle: theta = r (1 + k2 r + k3 r^2 + ...)."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.models._polynomial import FreePolynomial, Sheared
from camtorch.optics import Chart, Inverted, Lens, RadiusPolynomial, Shear


class FThetaBackward(FreePolynomial):
    """The radially symmetric fisheye with a free polynomial of the radius: theta = r (1 + k2 r + k3 r^2 + ...).

    r is the distance of the pixel from the axis in focal lengths, theta = atan2(hypot(x, y), z). The other direction of
    `FTheta`: there the polynomial gives r. A ray is valid before theta stops ascending, up to 19 focal lengths.

    Distortion: k2 k3 ... by the power of r, any number of them, at least one; 3 if left out. A polynomial of pixels
    is taken by `from_polynomial`. The same as NVIDIA DriveWorks `ftheta` if its polynomial gives angles of
    pixels (`bw-poly`), and as nvidia-ncore's, whose linear part makes it an `FThetaBackwardSheared`. On the axis see
    `FTheta`. See `Camera` for shapes, conventions and errors.
    """

    key = "f_theta_backward"

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Inverted(RadiusPolynomial, k), Lens()

    @classmethod
    def _scaled(cls, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        focal = 1 / coefficients[..., :1]
        powers = range(2, coefficients.shape[-1] + 1)
        return focal, coefficients[..., 1:] * focal ** coefficients.new_tensor(list(powers))


class FThetaBackwardSheared(Sheared, FThetaBackward):
    """`FThetaBackward` with all of NVIDIA's linear part: (u, v) = f (x + e y, d x + y) + c.

    Distortion: d e k2 k3 ..., d and e like `FThetaSheared`, then those of `FThetaBackward`, at least one; 5 if left
    out. See `Camera` for shapes, conventions and errors.
    """

    key = "f_theta_backward_sheared"
    special_cases = (("f_theta_backward", tuple(f"k{i}" for i in range(2, 33))),)

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Inverted(RadiusPolynomial, k[2:]), Lens(Shear(*k[:2]))


FThetaBackward.sheared = FThetaBackwardSheared
