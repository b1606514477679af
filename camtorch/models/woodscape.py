"""The fisheye of the WoodScape data set: r = theta (1 + k2 theta + k3 theta^2 + k4 theta^3)."""

from collections.abc import Sequence
from typing import ClassVar, Self

from camtorch.models._polynomial import FreePolynomial
from camtorch.models.f_theta import FTheta
from camtorch.values.arguments import Numbers, as_image_size, as_real


class WoodScape(FTheta):
    """WoodScape's fisheye: `FTheta` of fourth order, r = theta (1 + k2 theta + k3 theta^2 + k4 theta^3).

    The files give rho = k1 theta + k2 theta^2 + k3 theta^3 + k4 theta^4 in pixels: see `from_woodscape`.

    Distortion: k2 k3 k4, each that of the file divided by its k1. Source: Yogamani et al., "WoodScape: a multi-task,
    multi-camera fisheye dataset for autonomous driving", ICCV 2019, and its `projection.py`. See `Camera`.
    """

    key = "woodscape"
    special_cases = ()
    fit_counts = ()
    sheared: ClassVar[type[FreePolynomial] | None] = None

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        return cls.distortion_names if count == 3 else None

    @classmethod
    def counts_text(cls) -> str:
        return "n = 3 (k2 k3 k4)"

    @classmethod
    def from_woodscape(
        cls,
        coefficients: Numbers,
        offset: Numbers = (0.0, 0.0),
        *,
        image_size: Sequence[int],
        aspect_ratio: float = 1.0,
    ) -> Self:
        """Return the camera of the numbers of a calibration file.

        Args:
            coefficients: k1, k2, k3, k4 in pixels.
            offset: cx_offset, cy_offset: offset of the axis from the middle of the image, in pixels.
            image_size: (height, width) in pixels.
            aspect_ratio: Factor of v in the file.
        """
        owner = f"{cls.__name__}.from_woodscape"
        size, moved = as_image_size(image_size, owner), as_real(offset, "offset", owner)
        if size is None:
            raise ValueError(f"{owner}: image_size must be (height, width) for offsets from the middle; got None")
        if moved.shape != (2,):
            raise ValueError(f"{owner}: offset must be (2,) = cx_offset, cy_offset; got shape {tuple(moved.shape)}")
        centre = moved + (moved.new_tensor([size[1], size[0]]) - 1) / 2
        return cls.from_polynomial(centre, coefficients, aspect_ratio=aspect_ratio, image_size=image_size)
