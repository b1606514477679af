"""Image files as they are stored, as calibrations need them. Pillow turns only TIFFs by their orientation."""

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
from PIL import Image
from torch import Tensor

from camtorch.values.arguments import warn

ORIENTATION = 0x0112  # the Exif tag, also of TIFF
_DEEP = ("I;16", "I;16B", "I;16L", "I;16N", "I")
_T = Image.Transpose
_TURNS = _T.FLIP_LEFT_RIGHT, _T.ROTATE_180, _T.FLIP_TOP_BOTTOM, _T.TRANSPOSE, _T.ROTATE_90, _T.TRANSVERSE, _T.ROTATE_270
_BACK = dict(enumerate(_TURNS, 2))  # orientation -> the inverse of its turn


class ImageFileError(OSError, ValueError):
    """An image file that cannot be read or written. The text names the file and the reason."""


class _NoImageFileError(ImageFileError, FileNotFoundError):
    pass


def load_stored(image: Image.Image) -> Image.Image:
    """Return the pixels of an opened but not yet loaded file as they are stored."""
    orientation = image.getexif().get(ORIENTATION) if image.format == "TIFF" else None
    image.load()
    if orientation not in _BACK or image.getexif().get(ORIENTATION) == orientation:
        return image
    return image.transpose(_BACK[orientation])


def size_of(path: Path) -> tuple[int, int] | None:
    """Return the stored (height, width) of an image file; None for any other file."""
    with contextlib.suppress(ImageFileError), _opened(path) as image:
        return _stored_size(image)
    return None


def read_stored(path: Path) -> tuple[Tensor, int | None, bytes | None]:
    """Read an image as it is stored, its Exif orientation, which is not applied, and the ICC profile of its colours.

    Pixels are (C, H, W) uint8 with C = 1 grey, 2 grey and alpha, 3 RGB or 4 RGBA, also for palette, CMYK and others;
    or (1, H, W) uint16 for deep grey images. A profile of other colours than theirs, as of CMYK, is None. It warns if
    it leaves out data: the lower bits of deep colours, which Pillow does not read, and all images but the first. Other
    files raise ImageFileError.
    """
    with _opened(path) as opened:
        count, tiles = getattr(opened, "n_frames", 1), getattr(opened, "tile", ())
        # Pillow's decoder reduces deep colours to eight bits; its arguments show that
        cut = opened.mode not in _DEEP and any(re.search(r";16|65535", str(tile[3])) for tile in tiles)
        orientation = opened.getexif().get(ORIENTATION)
        image, profile = load_stored(opened), opened.info.get("icc_profile") or b""
        space = profile[16:20]  # of its header
        if count > 1:
            warn(f"{path}: only the first of {count} images is read")
        if cut:
            warn(f"{path}: only the upper 8 of 16 bits a colour are read")
        if image.mode in (*_DEEP, "F"):
            deep = np.asarray(image)
            if image.mode == "F" or deep.min() < 0 or deep.max() > 65535:
                raise ImageFileError(f"{path}: pixels must have 8 or 16 bits; got {deep.dtype}, up to {deep.max()}")
            return torch.from_numpy(deep.astype(np.uint16))[None], orientation, profile if space == b"GRAY" else None
        clear = "transparency" in image.info or image.mode in ("LA", "PA", "RGBA", "RGBa", "La")
        kind = ("L" if image.mode in ("1", "L", "LA", "La") else "RGB") + ("A" if clear else "")
        pixels = torch.from_numpy(np.array(image if image.mode == kind else image.convert(kind)))
    pixels = pixels[None] if pixels.ndim == 2 else pixels.permute(2, 0, 1)
    return pixels, orientation, profile if space == (b"GRAY" if kind[0] == "L" else b"RGB ") else None


def as_jpeg(image: Any, size: tuple[int, int], name: str, owner: str, side: int, quality: int) -> bytes:
    """Return a JPEG file, at most `side` pixels wide and high, of an image whose (height, width) must be `size`."""
    with contextlib.ExitStack() as stack:
        if isinstance(image, (str, bytes, os.PathLike)):
            image = stack.enter_context(_opened(Path(os.fsdecode(image))))
        elif not isinstance(image, Image.Image):
            if isinstance(image, Tensor):
                image = (image if image.ndim == 2 else image.movedim(0, -1)).numpy(force=True)
            values = np.asarray(image)
            if values.dtype.kind == "f":
                values = (255 * values).clip(0, 255).astype(np.uint8)
            image = Image.fromarray(values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values)
        height, width = _stored_size(image)
        if (height, width) != size:
            wanted = f"{owner}: the image {name!r} must have the size of the camera, {size[1]} x {size[0]}"
            raise ValueError(f"{wanted}; got {width} x {height} pixels")
        image.draft(None, (side, side))
        image = load_stored(image)
    if image.mode.startswith(("I", "F")):  # deep grey
        values = np.asarray(image, np.float64)
        image = Image.fromarray((255 * values / max(values.max(), 1e-9)).clip(0, 255).astype(np.uint8))
    image = image.convert("L" if image.mode in ("1", "L", "LA") else "RGB")
    image.thumbnail((side, side), reducing_gap=2.0)
    file = io.BytesIO()
    image.save(file, "JPEG", quality=quality, optimize=True)
    return file.getvalue()


def _stored_size(image: Image.Image) -> tuple[int, int]:
    """Return (height, width) of an image that is not loaded yet."""
    tags = getattr(image, "tag_v2", {})
    return tags.get(257, image.height), tags.get(256, image.width)  # of TIFF, which Pillow may turn


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """Open an image; raise errors of Pillow, also in the block, as ImageFileError with the path and the reason."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the user names a large photograph
            image = Image.open(path)
        with image:
            yield image
    except ImageFileError:
        raise
    except FileNotFoundError as error:
        raise _NoImageFileError(f"{path}: {error.strerror}") from None
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as error:
        raise ImageFileError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
