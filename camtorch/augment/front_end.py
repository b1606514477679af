"""The base of front ends, which pass the samples of other libraries to an augmentation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from camtorch.augment.augmentation import Augmentation
from camtorch.augment.change import Change
from camtorch.augment.sample import KeepsCamera, SampleTransform, Unknown
from camtorch.cameras.camera import Camera
from camtorch.values.arguments import GUESS_CAMERA, shown


class FrontEnd(KeepsCamera):
    """The base of front ends, which pass the samples of a library to an augmentation.

    Its method `_read` returns a sample as the augmentation takes it, and a function that writes the moved one in the
    form of the given one. kornia's calls a method for each kind of value instead.
    """

    augmentation: Any

    @property
    def last(self) -> Change | None:
        """The change of the last call: its `source`, `target` and `rotation`."""
        return getattr(self.augmentation, "last", None)


def check_front_end(owner: str, augmentation: object, *kinds: type[SampleTransform]) -> None:
    """Raise a TypeError if `augmentation` is none, nor of other `kinds`."""
    if not isinstance(augmentation, kinds or Augmentation):
        raise TypeError(f"{owner}: augmentation must be an Augmentation; got {type(augmentation).__name__}")


def check_single(
    owner: str, camera: Camera, sizes: Sequence[tuple[str, tuple[int, ...]]], hint: str = ""
) -> tuple[int, int]:
    """Return the image_size of a single camera, which is that of images by name."""
    if camera.image_size is None or camera.batch_shape:
        raise ValueError(
            f"{owner}: the camera must have an image_size and no batch dims; got image_size {camera.image_size} and "
            f"batch dims {tuple(camera.batch_shape)}{hint}"
        )
    for name, size in sizes:
        if size != camera.image_size:
            raise ValueError(
                f"{owner}: {name} must be of the camera's image_size {camera.image_size}; got {size} (height, width). "
                "camera.resize, .crop and .pad give the camera of an edited image"
            )
    return camera.image_size


def camera_of_sample(
    owner: str, augmentation: Augmentation, camera: object, sizes: Sequence[tuple[str, tuple[int, ...]]]
) -> Camera:
    """Return the single camera of a sample whose images are of these sizes: given, the augmentation's, or unknown."""
    camera = augmentation.camera if camera is None else camera
    if camera is None and sizes and not augmentation.needs_camera:
        height, width = sizes[0][1]
        camera = Unknown.of((height, width))
    if not isinstance(camera, Camera):
        how = "give one here, in the sample, or to the augmentation"
        raise ValueError(f"{owner}: camera must be a Camera; got {shown(camera)}. Please {how}. {GUESS_CAMERA}")
    check_single(owner, camera, sizes)
    return camera
