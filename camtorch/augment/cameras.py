"""The camera of a sample: the known one, else that of its matrix K, else a guessed one, else an unknown one.

Known is the sample's camera, else that of the front end, else that of the augmentation. A number in the place of one of
them is for guesses, and any known camera comes before it. What stands in for a camera takes its size from an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from camtorch.augment.fields import IMAGES, Named
from camtorch.augment.matrices import Guess, pinhole_of_matrix
from camtorch.augment.reading import as_tensor, check_one_size
from camtorch.cameras.camera import Camera
from camtorch.models import Pinhole
from camtorch.values.arguments import GUESS_CAMERA, shown


class Unknown(Pinhole):
    """The camera of images of which only the size is known, while they are edited; no sample comes out with it."""

    @classmethod
    def of(cls, size: tuple[int, int]) -> Unknown:
        return cls(torch.tensor([1.0, 1.0, 0.0, 0.0]), image_size=size).requires_grad_(False)


def known_camera(given: Any, own: Any) -> Any:
    """Return the camera given with a sample, else the augmentation's own; a `Guess` or None if neither is known."""
    return own if given is None or (isinstance(given, Guess) and isinstance(own, Camera)) else given


def _stand_in(size: tuple[int, int], matrix: tuple[str, Any] | None, guess: Guess | None, owner: str) -> Pinhole:
    """Return the camera of images of a size (height, width) if none is known; matrix: name and value of a field K."""
    if matrix is not None:
        return pinhole_of_matrix(*matrix, size, owner)
    return Unknown.of(size) if guess is None else guess.pinhole_for(size)


def camera_of_images(named: Named, guess: Guess | None, is_needed: bool, owner: str) -> Pinhole:
    """Return the camera of the images of a sample or a batch, where none is known."""
    how = f"give one as sample['camera'] or {owner}(camera=...)"
    matrix = next(((name, value) for name, (kind, value) in named.items() if kind == "K"), None)
    if is_needed and guess is None and matrix is None:
        guessed = f"camera=60, degrees across, takes pinholes for photographs of unknown cameras; {GUESS_CAMERA}"
        raise ValueError(f"{owner}: the sample must have a camera; got none. Please {how}. {guessed}")
    for name, (kind, value) in named.items():
        items = value if isinstance(value, list) else [value]
        shape: Sequence[int] = items[0].shape if items else ()
        if kind == "image" and len(shape) > 2 and shape[-1] <= 4 < shape[-3]:
            raise ValueError(
                f"{owner}: {name} must have its channels first, (B, C, H, W); got {tuple(shape)}, which seems to have "
                f"them last. camtorch.augment.numpy takes arrays as they are; if they are first, {how}"
            )
        if kind in IMAGES:
            check_one_size(name, {(one.shape[-2], one.shape[-1]) for one in items}, owner)
            return _stand_in((shape[-2], shape[-1]), matrix, guess, owner)
    raise ValueError(
        f"{owner}: the sample must have an image or a camera, as labels move by the image's size; got "
        f"{', '.join(named)}. For a camera, {how}"
    )


def camera_of_sample(
    owner: str,
    known: object,
    is_needed: bool,
    sizes: Sequence[tuple[str, tuple[int, ...]]],
    matrix: tuple[str, Any] | None = None,
) -> Camera:
    """Return the single camera of a sample of a front end.

    known: what `known_camera` returns. is_needed: whether the augmentation needs a camera. sizes: names and sizes
    (height, width) of images. matrix: name and value of a field K.
    """
    camera = known
    is_told = known is not None or matrix is not None or not is_needed
    if sizes and is_told and (known is None or isinstance(known, Guess)):
        height, width = sizes[0][1]
        rows = None if matrix is None else (matrix[0], as_tensor(matrix[1], matrix[0], "K", owner))
        camera = _stand_in((height, width), rows, known, owner)
    if not isinstance(camera, Camera):
        how = "give one here, in the sample, or to the augmentation"
        raise ValueError(f"{owner}: camera must be a Camera; got {shown(camera)}. Please {how}. {GUESS_CAMERA}")
    check_single(owner, camera, sizes)
    return camera


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
