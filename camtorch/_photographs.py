"""Image files as they are stored, which calibrations know. Pillow turns TIFFs by their orientation, and no others."""

from __future__ import annotations

from PIL import Image

ORIENTATION = 0x0112  # the Exif tag, likewise of TIFF
_WIDTH, _HEIGHT = 256, 257  # tags of TIFF
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
