"""Image files as they are stored, which calibrations know. Pillow turns TIFFs by their orientation, and no others."""

from __future__ import annotations

import contextlib
import io
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from camtorch._arguments import warn

ORIENTATION = 0x0112  # the Exif tag, likewise of TIFF
_WIDTH, _HEIGHT = 256, 257  # tags of TIFF
DEEP = ("I;16", "I;16B", "I;16L", "I;16N", "I")
_DEEPEST = 65535
_BACK = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
"""By orientation, what undoes the turn."""


def stored_size(image: Image.Image) -> tuple[int, int]:
    """(height, width) of an opened file."""
    tags = getattr(image, "tag_v2", {})
    return tags.get(_HEIGHT, image.height), tags.get(_WIDTH, image.width)


def load_stored(image: Image.Image) -> Image.Image:
    """The pixels of an opened file that is not loaded yet."""
    orientation = image.getexif().get(ORIENTATION) if image.format == "TIFF" else None
    image.load()
    if orientation is None or orientation not in _BACK or image.getexif().get(ORIENTATION) == orientation:
        return image
    return image.transpose(_BACK[orientation])


class ImageFileError(ValueError):
    """An image file that cannot be read or written. The text names the file and the reason."""


def read_stored(path: Path) -> tuple[Tensor, int | None]:
    """An image as stored, and its Exif orientation: it is not turned, for calibrations know stored pixels.

    Warnings say what is left out: the lower bits of deep colours, which Pillow does not read, and all but the first
    image of several.

    Returns:
        (C, H, W) uint8 with C = 1 grey, 2 grey and alpha, 3 RGB or 4 RGBA; or (1, H, W) uint16 for deep grey images.
        Other kinds of image (palette, CMYK, ...) come as RGB or RGBA.

    Raises:
        ImageFileError: no such file, no image, a damaged one, floating-point pixels, or more than 16 bits deep.
    """
    with _refused(path, ImageFileError), open_image(path) as opened:
        count, tiles = getattr(opened, "n_frames", 1), getattr(opened, "tile", ())
        # of deep colours its decoders are told so, which make eight bits of them
        cut = opened.mode not in DEEP and any(re.search(r";16|65535", str(tile[3])) for tile in tiles)
        orientation = opened.getexif().get(ORIENTATION)
        image = load_stored(opened)
        if count > 1:
            warn(f"{path} holds {count} images; only the first is taken")
        if cut:
            warn(f"{path} has 16 bits a colour; only the upper 8 are read")
        return _pixels(path, image), orientation


@contextlib.contextmanager
def _refused(name: object, kind: type[Exception]) -> Iterator[None]:
    """What Pillow raises where it cannot read a file, as an error of that kind, which names file and reason."""
    try:
        yield
    except ImageFileError:
        raise
    except Image.DecompressionBombError:
        reason = f"more than {2 * (Image.MAX_IMAGE_PIXELS or 0) / 1e6:.0f} million pixels, which are not read"
        raise kind(f"{name}: {reason}") from None
    except UnidentifiedImageError:
        raise kind(f"{name}: not an image that Pillow can read") from None
    except FileNotFoundError:
        if kind is OSError:
            raise
        raise kind(f"{name}: no such file") from None
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        raise kind(f"{name}: {getattr(error, 'strerror', None) or error}") from None


def size_of(path: Path) -> tuple[int, int] | None:
    """(height, width) of what its first bytes say is an image; None of anything else."""
    try:
        with open_image(path) as image:
            return stored_size(image)
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError):
        return None


def open_image(path: Path) -> Image.Image:
    with warnings.catch_warnings():
        # of a large photograph, which is what the user named
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        return Image.open(path)


def _pixels(path: Path, image: Image.Image) -> Tensor:
    if image.mode == "F":
        raise ImageFileError(f"{path}: floating-point pixels; 8-bit and 16-bit images can be read")
    if image.mode in DEEP:
        deep = np.asarray(image)
        low, high = int(deep.min()), int(deep.max())
        if low < 0 or high > _DEEPEST:
            raise ImageFileError(f"{path}: pixels from {low} to {high}; 8-bit and 16-bit images can be read")
        return torch.from_numpy(deep.astype(np.uint16))[None]
    clear = "transparency" in image.info or image.mode in ("PA", "RGBa", "La")
    if clear or image.mode not in ("L", "LA", "RGB", "RGBA"):
        colours = "L" if image.mode in ("1", "L", "La") else "RGB"
        image = image.convert(colours + "A" if clear else colours)
    pixels = torch.from_numpy(np.array(image))
    return pixels[None] if pixels.ndim == 2 else pixels.permute(2, 0, 1)


def as_jpeg(image: Any, size: tuple[int, int], name: str, owner: str, side: int, quality: int) -> bytes:
    """A JPEG file of what `as_photograph` makes of an image."""
    file = io.BytesIO()
    as_photograph(image, size, name, owner, side).save(file, "JPEG", quality=quality, optimize=True)
    return file.getvalue()


def as_photograph(image: Any, size: tuple[int, int], name: str, owner: str, side: int) -> Image.Image:
    """Grey or RGB in 8 bits, of an image of any kind that users pass, its longer side no more than `side` pixels.

    Raises:
        ValueError: its (height, width) is not `size`. OSError: it cannot be read.
    """

    def check(height: int, width: int) -> None:
        if (height, width) != size:
            raise ValueError(
                f"{owner}: the image {name!r} has {width} x {height} pixels, and those of the camera have "
                f"{size[1]} x {size[0]}"
            )

    if isinstance(image, (str, bytes, os.PathLike)):
        with _refused(name, OSError):
            opened = open_image(Path(os.fsdecode(image)))
        with opened:
            check(*stored_size(opened))
            with _refused(name, OSError):
                opened.draft(None, (side, side))
                image = load_stored(opened)
    else:
        image = image if isinstance(image, Image.Image) else _from_array(image)
        check(image.height, image.width)
    if image.mode.startswith(("I", "F")):  # deep grey
        values = np.asarray(image, np.float64)
        image = Image.fromarray((255 * values / max(values.max(), 1e-9)).clip(0, 255).astype(np.uint8))
    image = image.convert("L" if image.mode in ("1", "L", "LA") else "RGB")
    image.thumbnail((side, side), reducing_gap=2.0)
    found: Image.Image = image
    return found


def _from_array(image: Any) -> Image.Image:
    if isinstance(image, Tensor):
        image = (image if image.ndim == 2 else image.movedim(0, -1)).numpy(force=True)
    values = np.asarray(image)
    if values.dtype.kind == "f":
        values = (255 * values).clip(0, 255).astype(np.uint8)
    return Image.fromarray(values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values)
