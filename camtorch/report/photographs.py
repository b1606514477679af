"""Photographs of a report: of all kinds that users pass, small, as JPEG."""

from __future__ import annotations

import io
import os
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from camtorch._photographs import load_stored, stored_size

if TYPE_CHECKING:
    from PIL import Image

_SIDE = 760  # px, of the longer side
_QUALITY = 80


def as_jpeg(image: Any, size: tuple[int, int], name: str) -> bytes:
    """A small JPEG file of an image.

    Args:
        image: a path, a Pillow image, an array (H, W) or (H, W, C), or a tensor (H, W) or (C, H, W).
        size: (height, width) that it must have.
        name: of the view, for messages.

    Raises:
        ValueError: the image has another size. OSError: it cannot be read.
    """
    from PIL import Image

    if isinstance(image, (str, bytes, os.PathLike)):
        with Image.open(os.fsdecode(image)) as opened:
            _check_size(stored_size(opened), size, name)
            opened.draft(None, (_SIDE, _SIDE))
            image = load_stored(opened)
    else:
        image = image if isinstance(image, Image.Image) else _from_array(image)
        _check_size((image.height, image.width), size, name)
    if image.mode.startswith(("I", "F")):  # deep grey
        values = np.asarray(image, np.float64)
        image = Image.fromarray((255 * values / max(values.max(), 1e-9)).clip(0, 255).astype(np.uint8))
    image = image.convert("L" if image.mode in ("1", "L", "LA") else "RGB")
    image.thumbnail((_SIDE, _SIDE), reducing_gap=2.0)
    file = io.BytesIO()
    image.save(file, "JPEG", quality=_QUALITY, optimize=True)
    return file.getvalue()


def _from_array(image: Any) -> Image.Image:
    from PIL import Image

    if isinstance(image, Tensor):
        image = (image if image.ndim == 2 else image.movedim(0, -1)).numpy(force=True)
    values = np.asarray(image)
    if values.dtype.kind == "f":
        values = (255 * values).clip(0, 255).astype(np.uint8)
    return Image.fromarray(values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values)


def _check_size(image: tuple[int, int], camera: tuple[int, int], name: str) -> None:
    if image != camera:
        raise ValueError(
            f"write_report: the image {name!r} has {image[1]} x {image[0]} pixels, and those of the camera have "
            f"{camera[1]} x {camera[0]}"
        )
