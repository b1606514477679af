"""Common parts of models with a polynomial of any number of coefficients: of odd powers, or of all powers."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import ClassVar, Self, cast

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.evaluate.tensors import known_false, known_true
from camtorch.values.arguments import Numbers, as_batch, as_coordinates, as_number, as_real, is_list


class OddPolynomial(Camera):
    """Cameras with coefficients k1 k2 ... of x (1 + k1 x^2 + k2 x^4 + ...), any number of them."""

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
    """Cameras with coefficients k2 k3 ... of x (1 + k2 x + k3 x^2 + ...), any number; x is the angle or the radius."""

    distortion_names: tuple[str, ...] = ("k2", "k3", "k4")
    default_count = 3
    fit_counts: ClassVar[tuple[int, ...]] = (3, 5, 7)

    sheared: ClassVar[type[FreePolynomial] | None] = None
    """The model that also has d and e, as first coefficients."""
    shear_names: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        first = cls.shear_names
        return (*first, *(f"k{i}" for i in range(2, count + 2 - len(first)))) if count > len(first) else None

    @classmethod
    def counts_text(cls) -> str:
        return f"n >= {len(cls.shear_names) + 1} ({' '.join((*cls.shear_names, 'k2', 'k3'))} ...)"

    @classmethod
    def from_polynomial(
        cls,
        centre: Numbers,
        coefficients: Numbers,
        *,
        aspect_ratio: float = 1.0,
        linear_cde: Numbers = (1.0, 0.0, 0.0),
        image_size: Sequence[int] | None = None,
    ) -> Self:
        """Return the camera of a polynomial without a leading 1: k1 theta + k2 theta^2 + ... pixels.

        For `FThetaBackward` it is the angle, k1 d + k2 d^2 + ... of the distance d from the axis in pixels.

        Args:
            centre: cx, cy (*B, 2), the pixel of the axis.
            coefficients: k1, k2, ... (*B, n), n >= 2; k1 > 0 becomes the focal length.
            aspect_ratio: fy / fx, for c = 1.
            linear_cde: c, d, e (*B, 3) of NVIDIA's files: the pixel is [[c, d], [e, 1]] r(theta) (cos phi, sin phi)
                from the centre. If d or e is not zero, or requires grad, the camera is an `FThetaSheared`, or an
                `FThetaBackwardSheared`; c goes into fx.
            image_size: (height, width) in pixels.

        Raises:
            ValueError: If there are fewer than two coefficients, the first one or c is not positive, c <= d e (no
                camera), or the model has no d and e.
        """
        owner = cls.__name__
        aspect_ratio = as_number(aspect_ratio, "aspect_ratio", owner)
        centre = as_real(centre, "centre", owner)
        coefficients = as_real(coefficients, "coefficients", owner, centre.device)
        as_coordinates(centre, "centre", 2, owner, form="*B", means=" = cx, cy")
        if coefficients.ndim == 0 or coefficients.shape[-1] < 2:
            raise ValueError(f"{owner}: coefficients must be (*B, n), n >= 2; got {tuple(coefficients.shape)}")
        first = coefficients[..., :1]
        if known_false(first > 0):
            raise ValueError(
                f"{owner}: the first coefficient, of the first power, must be positive; got {first.tolist()}. "
                "Leave out a zero constant before it"
            )
        linear = as_real(linear_cde, "linear_cde", owner, centre.device)
        as_coordinates(linear, "linear_cde", 3, owner, form="*B", means=" = c, d, e")
        if is_list(linear_cde):  # in the precision of the coefficients
            linear = torch.tensor(linear_cde, dtype=coefficients.dtype, device=coefficients.device)
        c, d, e = linear.split(1, -1)
        if known_false((c > 0) & (c > d * e)):
            raise ValueError(
                f"{owner}: linear_cde = c, d, e must have c > 0 and c > d e; got {linear.tolist()}. In files "
                "zeros mean 1, 0, 0"
            )
        batch = as_batch(owner, centre=centre.shape, coefficients=coefficients.shape, linear_cde=linear.shape)
        is_straight = linear_cde == (1.0, 0.0, 0.0) if isinstance(linear_cde, tuple) else False
        is_straight = is_straight or (not linear.requires_grad and known_true(linear[..., 1:] == 0))
        focal, distortion = cls._scaled(coefficients)
        focal = torch.cat((focal * c, focal.expand(*batch, 1) * aspect_ratio), -1)
        intrinsics = torch.cat(torch.broadcast_tensors(focal, centre), -1)
        kind: type[FreePolynomial] | None = cls if cls.shear_names or is_straight else cls.sheared
        if kind is None:
            raise ValueError(f"{owner}: d and e must be 0; got {linear.tolist()}. Use FTheta, which has them")
        if kind.shear_names:
            shear = torch.cat((e, d / c), -1)
            distortion = torch.cat([w.to(focal).expand(*batch, w.shape[-1]) for w in (shear, distortion)], -1)
        return cast("Self", kind(intrinsics, distortion, image_size=image_size))

    @classmethod
    def _scaled(cls, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Return the focal length, and the coefficients in units of it."""
        raise NotImplementedError


class Sheared(FreePolynomial):
    """Models with the coefficients d and e of NVIDIA's linear part before the polynomial."""

    shear_names: ClassVar[tuple[str, ...]] = ("d", "e")
    distortion_names: tuple[str, ...] = (*shear_names, *FreePolynomial.distortion_names)
    default_count = 5
    fit_counts: ClassVar[tuple[int, ...]] = (5, 7, 9)
    odd_in_x = odd_in_y = frozenset(shear_names)
    quarter_turn = MappingProxyType({"d": "-e", "e": "-d"})
