"""Image files written from arrays, by Pillow."""

from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from PIL import Image

from camtorch.boards.finding import IMAGES
from camtorch.cli import videos
from camtorch.io.photographs import ORIENTATION, ImageFileError
from camtorch.io.writing import replacing
from camtorch.values.arguments import warn

_KEEP_BOTH = ("JPEG", "PNG", "TIFF", "WEBP")


def check_kind(path: Path, *, is_video: bool = False) -> None:
    """Raise an ImageFileError if images, or videos, cannot be written as the path's file type."""
    known = list(videos.WRITTEN) if is_video else sorted(IMAGES)
    if path.suffix.lower() not in known:
        what, kind = path.suffix or "no suffix", "video" if is_video else "image"
        raise ImageFileError(f"{path}: the suffix of the {kind} must be one of {', '.join(known)}; got {what}")


def write(path: Path, pixels: NDArray[Any], *, orientation: int | None = None, profile: bytes | None = None) -> None:
    """Write (H, W, C) uint8 or (H, W, 1) uint16 by `replacing`, and make missing folders."""
    image = Image.fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels)
    kind = Image.registered_extensions()[path.suffix.lower()]
    options: dict[str, Any] = {"quality": 95, "icc_profile": profile}
    if orientation is not None:
        options["exif"] = Image.Exif()
        options["exif"][ORIENTATION] = orientation
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, synced=False) as (file,):
            image.save(file, kind, **options)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        if isinstance(error, OSError) and "cannot write mode" in str(error):
            reason = f"{path.suffix} files hold no image of mode {image.mode}; .png does"
        raise ImageFileError(f"{path}: {reason}") from None
    turned = "Exif orientation, which turns the image," if orientation not in (None, 1) else ""
    for lost in filter(None, (turned, profile and "ICC profile of its colours")):
        if kind not in _KEEP_BOTH:
            warn(f"the {lost} is lost: {path.suffix} files hold none")
