"""EXR images of float32, written by OpenEXR: the extra `maps`."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np


def needed(name: str, images: str) -> ModuleType:
    """The library of that name, without which there are no such images.

    Raises:
        ImportError: it is missing.
    """
    try:
        return __import__(name)
    except ImportError:
        raise ImportError(f'{images} images need {name}: pip install "camtorch[maps]"') from None


def as_exr(pixels: np.ndarray, attributes: Mapping[str, Any]) -> bytes:
    """An image (H, W, 3), red, green and blue, with attributes of its own.

    Raises:
        ImportError: OpenEXR is missing.
    """
    openexr = needed("OpenEXR", "EXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage, **attributes}
    planes = {channel: np.ascontiguousarray(pixels[..., i], np.float32) for i, channel in enumerate("RGB")}
    with tempfile.TemporaryDirectory() as folder:  # it writes to names alone
        file = os.path.join(folder, "image.exr")
        openexr.File(header, planes).write(file)
        with open(file, "rb") as written:
            return written.read()
