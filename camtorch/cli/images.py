"""Image files as tensors and back, by Pillow, without surprises."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from camtorch._photographs import ORIENTATION, load_stored, stored_size
from camtorch.cli import targets
from camtorch.cli.terminal import note
from camtorch.io.writing import replacing
from camtorch.warp.warp import Warp

_DEEP = ("I;16", "I;16B", "I;16L", "I;16N", "I")
_DEEPEST = 65535
_KEEP_ORIENTATION = ("AVIF", "JPEG", "MPO", "PNG", "TIFF", "WEBP")
_OTHER_SIZES = ("ICO", "ICNS")  # formats that hold an image in sizes of their own


class ImageFileError(ValueError):
    """An image file that cannot be read or written. The text names the file and the reason."""


def read(path: Path, tell: Callable[[str], None] = note) -> tuple[Tensor, int | None]:
    """An image as stored, and its Exif orientation: it is not turned, for calibrations know stored pixels.

    Notes, which `tell` gets, say what is left out: the lower bits of deep colours, which Pillow does not read, and all
    but the first image of several.

    Returns:
        (C, H, W) uint8 with C = 1 grey, 2 grey and alpha, 3 RGB or 4 RGBA; or (1, H, W) uint16 for deep grey images.
        Other kinds of image (palette, CMYK, ...) come as RGB or RGBA.

    Raises:
        ImageFileError: no such file, no image, a damaged one, floating-point pixels, or more than 16 bits deep.
    """
    try:
        with _opened(path) as opened:
            count, cut = getattr(opened, "n_frames", 1), _is_cut(opened)
            orientation = opened.getexif().get(ORIENTATION)
            image = load_stored(opened)
            if count > 1:
                tell(f"{path} holds {count} images; only the first is taken")
            if cut:
                tell(f"{path} has 16 bits a colour; only the upper 8 are read")
            if image.mode in _DEEP and "transparency" in image.info:
                tell(f"{path} is grey of 16 bits with transparency, which is not read")
            return _pixels(path, image), orientation
    except FileNotFoundError:
        reason = "no such file"
    except UnidentifiedImageError:
        reason = "not an image that Pillow can read"
    except Image.DecompressionBombError:
        reason = f"more than {2 * (Image.MAX_IMAGE_PIXELS or 0) / 1e6:.0f} million pixels, which are not read"
    except ImageFileError:
        raise
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        reason = getattr(error, "strerror", None) or str(error)
    raise ImageFileError(f"{path}: {reason}")


def size_of(path: Path) -> tuple[int, int] | None:
    """(height, width) of what its first bytes say is an image; None of anything else."""
    try:
        with _opened(path) as image:
            return stored_size(image)
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError):
        return None


def _opened(path: Path) -> Image.Image:
    with warnings.catch_warnings():
        # of a large photograph, which is what the user named
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        return Image.open(path)


def _is_cut(image: Image.Image) -> bool:
    """Whether Pillow reads 16 bits as 8, before it does: its decoders' arguments tell."""
    for tile in () if image.mode in _DEEP else getattr(image, "tile", ()):
        arguments = tile[3] if isinstance(tile[3], tuple) else (tile[3],)
        if any(isinstance(argument, str) and ";16" in argument for argument in arguments):
            return True
        if tile[0] == "ppm" and isinstance(arguments[-1], int) and arguments[-1] > 255:
            return True
    return False


def _pixels(path: Path, image: Image.Image) -> Tensor:
    if image.mode == "F":
        raise ImageFileError(f"{path}: floating-point pixels; 8-bit and 16-bit images can be read")
    if image.mode in _DEEP:
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


def check_target(path: Path, *, force: bool, inputs: tuple[Path | None, ...] = ()) -> None:
    """Refuse before the work what could not be written after it: see `targets.check` and `check_kind`."""
    targets.check(path, force=force, inputs=inputs)
    check_kind(path)


def check_kind(path: Path) -> None:
    """Refuse, by an ImageFileError, a name of no file type that holds images of any size."""
    kind = Image.registered_extensions().get(path.suffix.lower())
    if kind not in Image.SAVE or kind in _OTHER_SIZES:
        why = "icons have sizes of their own" if kind in _OTHER_SIZES else "no image can be written as that"
        raise ImageFileError(f"{path}: {path.suffix or 'no suffix'}: {why}; try .png")


def filled(warp: Warp) -> float:
    """The part of new images that shows something."""
    valid = warp.valid_mask()
    return int(valid.sum()) / valid.numel()


def in_colour(image: Tensor, paper: tuple[int, int, int] = (255, 255, 255)) -> Tensor:
    """(3, H, W) uint8 of any image; deep ones from their darkest to their brightest, what is clear on paper."""
    if image.dtype != torch.uint8:
        deep = image.float()
        image = (255 * (deep - deep.min()) / (deep.max() - deep.min()).clamp(min=1)).round().byte()
    if len(image) in (2, 4):
        alpha = image[-1:] / 255
        image = (image[:-1] * alpha + torch.tensor(paper)[:, None, None] * (1 - alpha)).round().byte()
    return image.expand(3, -1, -1)


def from_tensor(image: Tensor) -> Image.Image:
    """A Pillow image of (C, H, W) uint8 or (1, H, W) uint16."""
    pixels = image.permute(1, 2, 0).contiguous().numpy()
    return Image.fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels)


def write(
    path: Path,
    image: Image.Image,
    *,
    orientation: int | None = None,
    tell: Callable[[str], None] = note,
    synced: bool = True,
) -> None:
    """Write a Pillow image, whole or not at all; folders that lack are made; `synced` as of `replacing`.

    Where the file type does not hold the Exif orientation of the image it was made of, `tell` gets that this is lost.

    Raises:
        ImageFileError: the file type does not take such pixels, or the disk does not take the file.
    """
    kind = Image.registered_extensions()[path.suffix.lower()]
    options: dict[str, Any] = {"quality": 95}
    if orientation is not None:
        options["exif"] = Image.Exif()
        options["exif"][ORIENTATION] = orientation
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, synced=synced) as (file,):
            image.save(file, kind, **options)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        if isinstance(error, OSError) and "cannot write mode" in str(error):
            reason = f"{path.suffix} files hold no image of mode {image.mode}; .png does"
        raise ImageFileError(f"{path}: {reason}") from None
    if orientation not in (None, 1) and kind not in _KEEP_ORIENTATION:
        tell(f"is to be shown turned by its Exif orientation, which is lost: {path.suffix} files hold none")
