"""What models with a polynomial of any number of coefficients share: of odd powers, or of all powers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import torch

from camtorch._arguments import Numbers, as_batch, as_number, as_real, fails
from camtorch.camera import Camera

if TYPE_CHECKING:
    from torch import Tensor
    from typing_extensions import Self


class OddPolynomial(Camera):
    """The coefficients k1 k2 ... of x (1 + k1 x^2 + k2 x^4 + ...), any number of them."""

    distortion_names: tuple[str, ...] = ("k1", "k2", "k3", "k4")
    default_count = 4
    fit_counts = (4, 6, 8, 10)

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        return tuple(f"k{i}" for i in range(1, count + 1)) or None

    @classmethod
    def counts_text(cls) -> str:
        return "n >= 1 (k1 k2 ...)"


class FreePolynomial(Camera):
    """The coefficients k2 k3 ... of x (1 + k2 x + k3 x^2 + ...), any number of them; x is the angle or the radius."""

    distortion_names: tuple[str, ...] = ("k2", "k3", "k4")
    default_count = 3
    fit_counts: ClassVar[tuple[int, ...]] = (3, 5, 7)

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        return tuple(f"k{i}" for i in range(2, count + 2)) or None

    @classmethod
    def counts_text(cls) -> str:
        return "n >= 1 (k2 k3 ...)"

    @classmethod
    def from_polynomial(
        cls,
        centre: Numbers,
        coefficients: Numbers,
        *,
        aspect_ratio: float = 1.0,
        image_size: Sequence[int] | None = None,
    ) -> Self:
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
        aspect_ratio = as_number(aspect_ratio, "aspect_ratio", cls.__name__)
        centre = as_real(centre, "centre", cls.__name__)
        coefficients = as_real(coefficients, "coefficients", cls.__name__)
        if centre.ndim == 0 or centre.shape[-1] != 2:
            raise ValueError(f"{cls.__name__}: centre must be (*B, 2) = cx, cy; got shape {tuple(centre.shape)}")
        if coefficients.ndim == 0 or coefficients.shape[-1] < 2:
            raise ValueError(f"{cls.__name__}: coefficients must be (*B, n), n >= 2; got {tuple(coefficients.shape)}")
        first = coefficients[..., :1]
        if fails(first > 0):
            raise ValueError(
                f"{cls.__name__}: the first coefficient, of the first power, must be positive; got {first.tolist()}. "
                "A constant before it, which is zero, is left out"
            )
        as_batch(cls.__name__, centre=centre.shape, coefficients=coefficients.shape)
        focal, distortion = cls._scaled(coefficients)
        both = torch.broadcast_tensors(torch.cat((focal, focal * aspect_ratio), -1), centre)
        return cls(torch.cat(both, -1), distortion, image_size=image_size)

    @classmethod
    def _scaled(cls, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """The focal length, and coefficients in units of it."""
        raise NotImplementedError
