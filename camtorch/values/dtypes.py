"""The dtypes in which images are computed, and the way back to their own."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

SIGNED = {torch.uint16: torch.int16, torch.uint32: torch.int32, torch.uint64: torch.int64}
"""The dtypes of the same bits that torch can flip and gather: it cannot do so for unsigned ones of more than a byte."""


_AVERAGED = torch.bool, torch.uint8, torch.uint16


def check_averaged(images: Tensor, mode: str, name: str, owner: str) -> None:
    """Raise a ValueError for integers that are mostly labels, which a `mode` but "nearest" would average."""
    if mode != "nearest" and not images.dtype.is_floating_point and images.dtype not in _AVERAGED:
        raise ValueError(
            f"{owner}: {name} must be of floating point, uint8, uint16 or bool for mode={mode!r}, which averages; got "
            f"{images.dtype}. Labels go in with mode='nearest', numbers as {name}.float() or .astype('float32')"
        )


def wide_dtype(dtype: torch.dtype) -> torch.dtype:
    """Return the dtype to compute images in: every value up to 2^53 is exact in it, class ids too."""
    if dtype.is_floating_point:
        return torch.promote_types(dtype, torch.float32)
    return torch.float64 if dtype.itemsize > 2 else torch.float32


def widen(images: Tensor) -> Tensor:
    """Return images in the dtype to compute in."""
    return images.to(wide_dtype(images.dtype))


def narrow(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Return values of `widen` in `dtype` again: integers are rounded and clamped, bool is true from one half on."""
    if dtype == torch.bool and values.is_floating_point():
        return values >= 0.5
    if not dtype.is_floating_point and values.is_floating_point():
        low, high = torch.iinfo(dtype).min, torch.iinfo(dtype).max
        # float64 does not have the largest int64: the next number would wrap around
        top = float(high) if int(float(high)) == high else math.nextafter(float(high), 0.0)
        values = values.round().clamp_(float(low), top)
        if dtype.itemsize < 4 and values.is_cpu:  # torch makes small integers of int32 in a third of the time
            values = values.int()
    return values.to(dtype)


def in_range(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Return values in a dtype of floating point, which may be narrower: finite values stay finite."""
    if dtype == torch.float16 != values.dtype:
        most = torch.finfo(dtype).max
        values = values.clamp(-most, most)
    return values.to(dtype)


def as_pixels(fill: Sequence[float], dtype: torch.dtype, device: torch.device | str = "cpu") -> Tensor:
    """Return the values (C or 1, 1, 1) of channels in a dtype: rounded, in range, true from one half on."""
    values: Sequence[float] = fill
    if dtype == torch.bool:
        values = [value >= 0.5 for value in fill]
    elif not dtype.is_floating_point:
        low, high = torch.iinfo(dtype).min, torch.iinfo(dtype).max
        values = [min(max(round(value), low), high) for value in fill]
    return torch.tensor(values, dtype=dtype, device=device)[:, None, None]
