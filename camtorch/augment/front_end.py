"""The base of front ends, which pass the samples of other libraries to an augmentation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from camtorch.augment.augmentation import Augmentation
from camtorch.augment.change import Change
from camtorch.augment.matrices import Guess, camera_of
from camtorch.augment.reading import as_tensor
from camtorch.augment.sample import KeepsCamera, SampleTransform, Unknown
from camtorch.cameras.camera import Camera
from camtorch.values.arguments import GUESS_CAMERA, shown


class FrontEnd(KeepsCamera):
    """The base of front ends, which pass the samples of a library to an augmentation.

    Its method `_read` returns a sample as the augmentation takes it, and a function that writes the moved one in the
    form of the given one. kornia's calls a method for each kind of value instead.
    """

    augmentation: Any
    camera: Any  # of samples that bring none: a Camera, or degrees; None: that of the augmentation

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
    """Return the image_size of a camera; raise if it has none or a batch, or if a named image differs from it."""
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
    owner: str,
    augmentation: Augmentation,
    camera: object,
    sizes: Sequence[tuple[str, tuple[int, ...]]],
    matrix: tuple[str, Any] | None = None,
) -> Camera:
    """Return the single camera of a sample whose images are of these sizes: given, the augmentation's, or unknown.

    matrix: name and value of a field K, which is the camera where there is no other.
    """
    own = augmentation.camera
    camera = own if camera is None or (isinstance(camera, Guess) and isinstance(own, Camera)) else camera
    if (camera is None or isinstance(camera, Guess)) and sizes:
        height, width = sizes[0][1]
        if matrix is not None:
            camera = camera_of(matrix[0], as_tensor(matrix[1], matrix[0], "K", owner), (height, width), owner)
        elif camera is not None:
            camera = camera.camera((height, width))
        elif not augmentation.needs_camera:
            camera = Unknown.of((height, width))
    if not isinstance(camera, Camera):
        how = "give one here, in the sample, or to the augmentation"
        raise ValueError(f"{owner}: camera must be a Camera; got {shown(camera)}. Please {how}. {GUESS_CAMERA}")
    check_single(owner, camera, sizes)
    return camera
