"""The collection of real lenses: its entries, read when the first one is wanted.

The file has the numbers' own bits, columns side by side; text is compressed by LZMA. fy is kept as its difference to
fx, the principal point to the image's middle, each with its sign as the lowest bit, and the bytes of a column one plane
after another.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from camtorch.models import KannalaBrandt

_FILE = Path(__file__).with_name("gyroflow.npz")
_TEXTS = "brand", "camera", "lens", "setting", "width", "height", "readout_ms", "h_stretch", "v_stretch", "digital_lens"


@dataclass(frozen=True, repr=False)
class Lens:
    """A lens on a camera, as somebody calibrated it for the collection gyroflow/lens_profiles (public domain)."""

    brand: str
    """Of the camera. The names are the collection's own."""
    body: str
    """The camera."""
    lens: str
    """The lens, or the mode of a camera that has but one."""
    setting: str
    """What else was said: resolution, focal length of a zoom, remarks."""
    image_size: tuple[int, int]
    """(height, width) that was calibrated."""
    intrinsics: tuple[float, ...]
    """fx, fy, cx, cy in pixels."""
    distortion: tuple[float, ...]
    """k1 ... k4 of `KannalaBrandt`."""
    rms: float
    """The calibration's own reprojection error in pixels."""
    readout_ms: float | None
    """Milliseconds from the first row to the last of a rolling shutter, negative if it reads from the bottom up; 0 is
    what many calibrations say that do not know. None: unknown.
    """
    stretch: tuple[float | None, float | None]
    """Horizontal and vertical factor by which recorded images are to be stretched; None: not stated."""
    digital: str
    """How the camera itself reprojects images after the lens, as GoPro's SuperView; empty where it does not."""

    @property
    def name(self) -> str:
        """Brand, camera, lens and setting."""
        return " ".join(part for part in (self.brand, self.body, self.lens, self.setting) if part)

    @property
    def is_optical(self) -> bool:
        """Whether a lens makes such images: not stretched, not reprojected, no focal length negative, as 31 are."""
        return is_as_seen(self.digital, self.stretch) and self._exists

    @property
    def _exists(self) -> bool:
        return min(self.intrinsics[:2]) > 0

    def camera(self) -> KannalaBrandt:
        """The camera, in float64, with nothing to learn, as those from files.

        Raises:
            ValueError: its focal lengths are negative.
        """
        if not self._exists:
            raise ValueError(
                f"{self.name}: this calibration has gone astray: fx, fy = {self.intrinsics[:2]}; take another one of "
                "lenses.search, is_optical says which"
            )
        made = KannalaBrandt(
            torch.nn.Parameter(torch.tensor(self.intrinsics, dtype=torch.float64)),  # a few are off centre
            torch.tensor(self.distortion, dtype=torch.float64),
            image_size=self.image_size,
        )
        return made.requires_grad_(False)

    def __repr__(self) -> str:
        height, width = self.image_size
        parts = [f"{width}x{height}"]
        if self._exists:
            parts.append(f"{float(self.camera().fov[0]):.3g} degrees wide")
        parts.append(f"rms {self.rms:.2g} px")
        if self.readout_ms:
            parts.append(f"readout {self.readout_ms:g} ms")
        if not self.is_optical:
            parts.append(self.digital or ("stretched" if self._exists else "astray"))
        return f"<{self.name}: {', '.join(parts)}>"


def is_as_seen(digital: str, stretch: tuple[float | None, float | None]) -> bool:
    """Whether images are as the lens makes them: not reprojected and not stretched. See `Lens`."""
    return not digital and all(factor in (None, 1.0) for factor in stretch)


def as_number(text: str) -> float | None:
    """A number that may be missing in the collection."""
    return float(text) if text else None


@cache
def columns() -> tuple[dict[str, list[str]], NDArray[np.float64]]:
    """Return the columns of text by their names, and those of numbers (9, N): fx fy cx cy k1 k2 k3 k4 rms."""
    with np.load(_FILE) as file:
        text, planes = file["text"].tobytes().decode(), file["planes"]
    lines, count = text.split("\0"), planes.shape[-1]
    texts = {name: lines[i * count : (i + 1) * count] for i, name in enumerate(_TEXTS)}
    codes = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<i8")[..., 0].astype(np.int64)
    bits = ((codes >> 1) & np.int64(2**63 - 1)) ^ -(codes & 1)
    bits[1] += bits[0]
    bits[2:4] += (np.array([texts["width"], texts["height"]], float) / 2).view(np.int64)
    return texts, bits.view(np.float64)


@cache
def entries() -> tuple[Lens, ...]:
    """All of them, in the order of the collection."""
    texts, numbers = columns()
    rows = zip(*texts.values(), numbers.T.tolist(), strict=True)
    return tuple(
        Lens(
            *(brand, body, lens, setting, (int(height), int(width)), tuple(values[:4]), tuple(values[4:8]), values[8]),
            *(as_number(readout), (as_number(across), as_number(down)), digital),
        )
        for brand, body, lens, setting, width, height, readout, across, down, digital, values in rows
    )
