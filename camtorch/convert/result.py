"""The result of a conversion: the camera of another model, and its differences."""

import math
from dataclasses import dataclass
from typing import Generic, TypeVar

from torch import Tensor

from camtorch.projection.camera_like import CameraLike

CameraT = TypeVar("CameraT", bound=CameraLike, covariant=True)


@dataclass
class Conversion(Generic[CameraT]):
    """A camera of another model, and its differences from the old camera.

    Both cameras' pixels of the same rays are compared, on a lattice over the image of the old camera, its outer edges
    included; without an image, on rays in all directions. Each number has the batch shape of the camera.
    """

    camera: CameraT
    """The new camera."""
    rms: Tensor
    """The root of the mean squared distance in pixels, up to `max_angle`."""
    max_error: Tensor
    """The largest distance in pixels, up to `max_angle`."""
    max_angle: Tensor
    """The angle from the optical axis, in radians, up to which the new camera has a pixel for each compared ray: the
    image's largest, the one asked for, or the end of the new model. Beyond it nothing is guaranteed."""
    valid_fraction: Tensor
    """The part of the image with rays of the old camera that lies within `max_angle`."""
    exact: Tensor
    """Bool: whether models are related and coefficients carried over bit by bit, so that only rounding differs."""
    source_name: str = "camera"

    def __repr__(self) -> str:
        many = f" x {self.rms.numel()}" if self.rms.ndim else ""
        head = f"{self.source_name} -> {type(self.camera).__name__}{many}: "
        if bool(self.exact.all()):
            text = "exact"
        else:
            worst = "at worst " if self.rms.ndim else ""
            text = f"{worst}rms {float(self.rms.max()):.3g} px, max {float(self.max_error.max()):.3g} px"
        angle, part = math.degrees(float(self.max_angle.min())), 100 * float(self.valid_fraction.min())
        what = "the image" if self.camera.image_size else "the rays"
        return f"Conversion({head}{text}, up to {angle:.1f} degrees, {part:.4g} % of {what})"
