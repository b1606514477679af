"""Image files as tensors and back, by Pillow, without surprises."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

_ORIENTATION = 0x0112  # the Exif tag
_DEEP = ("I;16", "I;16B", "I;16L", "I;16N", "I")


class ImageFileError(ValueError):
    """An image file that cannot be read or written. The text names the file and the reason."""


def _pillow():
    try:
        from PIL import Image
    except ImportError:
        raise ImageFileError("images need Pillow: pip install 'camtorch[cli]'") from None
    return Image


def read(path) -> tuple[Tensor, int | None]:
    """An image as stored, and its Exif orientation: it is not turned, for calibrations know stored pixels.

    Returns:
        (C, H, W) uint8 with C = 1 grey, 2 grey and alpha, 3 RGB or 4 RGBA; or (1, H, W) uint16 for deep grey images.
        Other kinds of image (palette, CMYK, ...) come as RGB or RGBA.

    Raises:
        ImageFileError: no such file, no image, a damaged one, floating-point pixels, or no Pillow.
    """
    pil = _pillow()
    try:
        with pil.open(path) as image:
            image.load()
            orientation = image.getexif().get(_ORIENTATION)
            if image.mode == "F":
                raise ImageFileError(f"{path}: floating-point pixels; 8-bit and 16-bit images can be read")
            if image.mode in _DEEP:
                deep = np.asarray(image).astype(np.int64).clip(0, 65535).astype(np.uint16)
                return torch.from_numpy(deep)[None], orientation
            if image.mode not in ("L", "LA", "RGB", "RGBA"):
                clear = "transparency" in image.info or image.mode in ("PA", "RGBa", "La")
                image = image.convert("L" if image.mode == "1" else "RGBA" if clear else "RGB")
            pixels = torch.from_numpy(np.array(image))
            return (pixels[None] if pixels.ndim == 2 else pixels.permute(2, 0, 1)), orientation
    except FileNotFoundError:
        raise ImageFileError(f"{path}: no such file") from None
    except pil.UnidentifiedImageError:
        raise ImageFileError(f"{path}: not an image that Pillow can read") from None
    except ImageFileError:
        raise
    except (OSError, SyntaxError, ValueError, EOFError, pil.DecompressionBombError) as error:
        raise ImageFileError(f"{path}: {getattr(error, 'strerror', None) or error}") from None


def check_target(path, *, force: bool) -> None:
    """Refuse before the work what could not be written after it.

    Raises:
        ImageFileError: the file exists and `force` is not given, no folder to write to, an unknown file type.
    """
    path = Path(path)
    if path.is_dir():
        raise ImageFileError(f"{path}: is a folder")
    if path.exists() and not force:
        raise ImageFileError(f"{path}: exists already; --force overwrites it")
    if not path.parent.is_dir():
        raise ImageFileError(f"{path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise ImageFileError(f"{path}: the folder {path.parent} cannot be written to")
    pil = _pillow()
    if pil.registered_extensions().get(path.suffix.lower()) not in pil.SAVE:
        raise ImageFileError(f"{path}: no image can be written as {path.suffix or 'a nameless type'}; try .png")


def from_tensor(image: Tensor):
    """A Pillow image of (C, H, W) uint8 or (1, H, W) uint16."""
    pixels = image.permute(1, 2, 0).contiguous().numpy()
    return _pillow().fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels)


def write(path, image, *, orientation: int | None = None) -> None:
    """Write a Pillow image, whole or not at all.

    Raises:
        ImageFileError: the file type does not take such pixels, or the disk does not take the file.
    """
    path = Path(path)
    pil = _pillow()
    options: dict = {"quality": 95}
    if orientation is not None:
        options["exif"] = pil.Exif()
        options["exif"][_ORIENTATION] = orientation
    name = None
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            name = file.name
            image.save(file, format=pil.registered_extensions()[path.suffix.lower()], **options)
        # temporary files are private; an image gets the rights of any new file
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)
        os.replace(name, path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        if isinstance(error, OSError) and "cannot write mode" in str(error):
            reason = f"{path.suffix} files hold no image of mode {image.mode}; .png does"
        raise ImageFileError(f"{path}: {reason}") from None
    finally:
        if name is not None:
            with contextlib.suppress(OSError):
                os.unlink(name)
