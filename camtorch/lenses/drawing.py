"""Real lenses to draw from, scaled to the size of an image so that every pixel has a ray."""

import math
from functools import cache, lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.cameras.operators import opaque
from camtorch.evaluate.door import outside_transforms
from camtorch.lenses.collection import entries
from camtorch.models import KannalaBrandt
from camtorch.native.structs import TO_FOLD
from camtorch.projection.domain import Domain

_RMS = 1.0  # pixels
_ASPECT = 0.05  # tolerance of the aspect ratio of pixels
_CENTRE = 0.1  # of the image's sides: largest distance of the principal point from the middle
_PART = 256  # lenses whose tables stay in the processor's cache: eight times as fast as all at once
_EDGE = 1e-3  # degrees: rounding of a field of view in float32


class Lenses(NamedTuple):
    """Lenses for images of one size, in float64."""

    intrinsics: Tensor  # (N, 4)
    distortion: Tensor  # (N, 4)
    reach: Tensor  # (N,): the radius of the image at the lens's fold in focal lengths


@cache
def _good() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return sizes (N, 2) = (height, width), intrinsics and distortion (N, 4), and `Lenses.reach`, of good lenses."""
    good = [lens for lens in entries() if lens.is_optical and lens.rms < _RMS]
    rows = [(*lens.image_size, *lens.intrinsics, *lens.distortion) for lens in good]
    table = torch.tensor(rows, dtype=torch.float64, device="cpu")  # not on the default device
    off = (table[:, [5, 4]] / table[:, :2] - 0.5).abs().amax(-1)
    table = table[(off < _CENTRE) & ((table[:, 2] / table[:, 3] - 1).abs() < _ASPECT)]
    size, intrinsics, distortion = (part.contiguous() for part in table.split((2, 4, 4), -1))
    parts = [Domain(KannalaBrandt.optics, part).edge2 for part in distortion.split(_PART)]
    reach = torch.cat(parts).sqrt()[:, 0]
    return size, intrinsics, distortion, reach


def covering(intrinsics: Tensor, reach: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the factor (*B,), at least 1, of focal lengths for which all pixels have rays; reach as in `Lenses`."""
    fx, fy, cx, cy = intrinsics.unbind(-1)
    height, width = size
    across = torch.maximum(cx + 0.5, width - 0.5 - cx) / fx
    down = torch.maximum(cy + 0.5, height - 0.5 - cy) / fy
    return (torch.hypot(across, down) / (TO_FOLD * reach)).clamp(min=1.0)


@lru_cache(maxsize=16)
def lenses_for(size: tuple[int, int], fov: tuple[float, float] | None) -> Lenses:
    """Return the lenses whose horizontal field of view is in a range of degrees for images of a size; None: all.

    A calibrated image is scaled to cover the new one and cropped evenly; focal lengths grow until pixels have rays.
    """
    sizes, intrinsics, distortion, reach = _good()
    new = sizes.new_tensor(size)
    scale = (new / sizes).amax(-1, keepdim=True)
    # pixel centres are half a pixel from the edges
    centre = (intrinsics[:, 2:] - (sizes.flip(-1) - 1) / 2) * scale + (new.flip(-1) - 1) / 2
    focal = intrinsics[:, :2] * scale
    focal = focal * covering(torch.cat((focal, centre), -1), reach, size)[:, None]
    found = torch.cat((focal, centre), -1)
    if fov is None:
        return Lenses(found, distortion, reach)
    ends = torch.stack((torch.full_like(centre, -0.5), torch.full_like(centre, size[1] - 0.5)), 1)
    ends[..., 1] = centre[:, None, 1]
    parts = zip(*(column.split(_PART) for column in (found, distortion, ends)), strict=True)
    rays = torch.cat([KannalaBrandt(f, k).requires_grad_(False).unproject(pixels)[0] for f, k, pixels in parts])
    wide = torch.rad2deg(torch.atan2(rays[..., 0].abs(), rays[..., 2]).sum(-1))
    low, high = fov[0] + _EDGE, fov[1] - _EDGE
    chosen = (wide > low) & (wide < high)
    if not bool(chosen.any()):
        got = f"{fov[0]:g} to {fov[1]:g}; the widest shows {math.floor(float(wide.max()))}"
        raise ValueError(f"fov: must be that of a real lens for (height, width) {size}; got {got}")
    return Lenses(found[chosen], distortion[chosen], reach[chosen])


def drawn(share: Tensor, size: tuple[int, int], fov: tuple[float, float] | None) -> Lenses:
    """Return the lenses at shares (*B,) of the list of `lenses_for`, from 0 to 1, compiled or not."""
    low, high = (None, None) if fov is None else map(float, fov)
    return Lenses(*_drawn(share, size, low, high))


def _drawn_shapes(share: Tensor, *_: object) -> tuple[Tensor, Tensor, Tensor]:
    four = share.new_empty(*share.shape, 4)
    return four, four.clone(), share.new_empty(share.shape)


@opaque(_drawn_shapes)
def _drawn(
    share: Tensor, size: tuple[int, int], low: float | None, high: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    with outside_transforms():  # the lenses are kept for later calls
        lenses = lenses_for(size, None if low is None or high is None else (low, high))
    index = (share * len(lenses.reach)).long().clamp(0, len(lenses.reach) - 1).to(lenses.reach.device)
    intrinsics, distortion, reach = (column[index].to(share) for column in lenses)
    return intrinsics, distortion, reach
