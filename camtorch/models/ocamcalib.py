"""OCamCalib's omnidirectional camera, from the pixel to the ray: (x, y, 1 + a1 r + a2 r^2 + ...)."""

from collections.abc import Sequence
from types import MappingProxyType
from typing import ClassVar, Self

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.evaluate.tensors import known_false
from camtorch.native.structs import ANGLE_OF_ALL_POWERS
from camtorch.optics import AnglePerRadius, Chart, Inverted, Lens, RadiusPolynomial, Shear
from camtorch.optics.radial import RadialFactor
from camtorch.optics.special import first_root
from camtorch.values.arguments import Numbers, as_real


class AngleOfAllPowers(AnglePerRadius):
    """Radial factor theta / r of the ray (r, 0, D), D = 1 + a1 r + a2 r^2 + ..."""

    code: ClassVar[int | None] = ANGLE_OF_ALL_POWERS

    def __init__(self, coefficients: Sequence[Tensor]):
        super().__init__(coefficients)
        self.ahead: RadialFactor = RadiusPolynomial(coefficients)

    def closed_fold(self) -> Tensor:
        """Return the first root of D - r D', to which d(theta)/dr is proportional."""
        return first_root(*(-i * c for i, c in enumerate(self.parameters)))


class OCamCalib(Camera):
    """The omnidirectional camera of Scaramuzza's toolbox: the point (x, y) sees along (x, y, 1 + a1 r + a2 r^2 + ...).

    r = hypot(x, y); (u, v) = f (x + e y, d x + y) + c. A ray is valid before its angle from the axis stops ascending
    with r, and up to a radius of 19 focal lengths. The inverse, for which the toolbox fits a second polynomial, is
    exact. With odd powers (a1 is mostly zero) the camera has one continuous derivative on the axis, and no second one.

    Distortion: d e a1 a2 ... by the power of r, n >= 3 numbers; four powers if left out. `from_ocamcalib` takes ss, c,
    d, e of the toolbox, with its axes and its centre. Even powers alone are `Division`. Source: Scaramuzza, Martinelli
    and Siegwart, "A toolbox for easily calibrating omnidirectional cameras", IROS 2006. See `Camera`.
    """

    key = "ocamcalib"
    distortion_names: tuple[str, ...] = ("d", "e", "a1", "a2", "a3", "a4")
    default_count = 6
    odd_in_x = odd_in_y = frozenset({"d", "e"})
    quarter_turn = MappingProxyType({"d": "-e", "e": "-d"})
    special_cases = (("division", ("a2", "a4", "a6")), ("pinhole", ()))
    fit_counts = (6, 8, 10)

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        return ("d", "e", *(f"a{i}" for i in range(1, count - 1))) if count >= 3 else None

    @classmethod
    def counts_text(cls) -> str:
        return "n >= 3 (d e a1 a2 ...)"

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Inverted(AngleOfAllPowers, k[2:]), Lens(Shear(*k[:2]))

    @classmethod
    def from_ocamcalib(
        cls,
        polynomial: Numbers,
        centre: Numbers,
        affine: Numbers = (1.0, 0.0, 0.0),
        *,
        image_size: Sequence[int] | None = None,
    ) -> Self:
        """Return the camera of the toolbox's numbers: its x goes down the rows, its z backwards if ss[0] is negative.

        Args:
            polynomial: ss (n,), n >= 2, from the constant on: z over the distance from the centre, both in pixels.
            centre: xc, yc (2,): row and column, counted from 0 as in `calib_results.txt`; MATLAB's are one more.
            affine: c, d, e (3,): (row, column) = [[c, d], [e, 1]] (x, y) + (xc, yc).
            image_size: (height, width) in pixels.

        Raises:
            ValueError: If a shape is wrong, ss[0] is zero, or c is not positive.
        """
        owner = cls.__name__
        polynomial = as_real(polynomial, "polynomial", owner)
        named = (centre, "centre"), (affine, "affine")
        centre, affine = (as_real(value, name, owner, polynomial.device) for value, name in named)
        shapes = [tuple(t.shape) for t in (polynomial, centre, affine)]
        if polynomial.ndim != 1 or len(polynomial) < 2 or shapes[1:] != [(2,), (3,)]:
            raise ValueError(f"{owner}: polynomial must be (n,), n >= 2, centre (2,), affine (3,); got shapes {shapes}")
        if known_false((polynomial[0] != 0) & (affine[0] > 0)):
            raise ValueError(
                f"{owner}: ss[0], the focal length, must not be zero, and c must be positive; got ss[0] = "
                f"{float(polynomial[0])}, c = {float(affine[0])}"
            )
        focal, (c, d, e) = polynomial[0].abs(), affine.unbind()
        powers = torch.arange(1, len(polynomial), device=polynomial.device)
        distortion = torch.cat((torch.stack((d / c, e)), polynomial[1:] / polynomial[0] * focal**powers)) + 0.0
        return cls(torch.stack((focal, focal * c, centre[1], centre[0])), distortion, image_size=image_size)
