"""How warps sample images: modes, paddings, fill and the other options."""

import math
from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple, TypeAlias, TypedDict, get_args

from camtorch.native import sampler
from camtorch.values.arguments import as_flag, as_number, one_of, shown

Mode: TypeAlias = sampler.Mode
PaddingMode = Literal["zeros", "border", "reflection"]
Fill = float | Sequence[float]
MODES = tuple(sampler.MODES)
# in an order that two things need: positions for one padding serve those before it, and places are torch's codes
PADDINGS: tuple[PaddingMode, ...] = get_args(PaddingMode)


class Sampler(NamedTuple):
    """How the images of one call are sampled."""

    mode: Mode
    padding_mode: PaddingMode
    fill: tuple[float, ...]


class Options(TypedDict):
    """The options of a `Warp`."""

    mode: Mode
    padding_mode: PaddingMode
    fill: tuple[float, ...]
    antialias: bool | None  # None: a `HalvingWarp` chooses for each image, as other warps do not
    tolerance: float | None


class WarpOptions(TypedDict, total=False):
    """The options of every kind of warp; see `Warp`."""

    mode: Mode
    padding_mode: PaddingMode
    fill: Fill
    antialias: bool


class TolerantOptions(WarpOptions, total=False):
    """The options of warps that may interpolate positions, within `tolerance` pixels."""

    tolerance: float | None


def serving_all(*paddings: PaddingMode) -> PaddingMode:
    """Return the padding whose positions serve all of these."""
    return PADDINGS[max(map(PADDINGS.index, paddings))]


def as_options(
    owner: str,
    mode: str = "bilinear",
    padding_mode: str = "zeros",
    fill: Fill = 0.0,
    antialias: bool | None = False,
    tolerance: float | None = None,
) -> Options:
    """Return the checked options of a `Warp`, by name."""
    tolerance = None if tolerance is None else as_number(tolerance, "tolerance", owner)
    if tolerance is not None and not 0 <= tolerance < math.inf:
        raise ValueError(f"{owner}: tolerance must be a number of pixels, zero or more; got {tolerance!r}")
    return {
        "mode": one_of(mode, MODES, "mode", owner),
        "padding_mode": one_of(padding_mode, PADDINGS, "padding_mode", owner),
        "fill": as_fill(fill, owner),
        "antialias": None if antialias is None else as_flag(antialias, "antialias", owner),
        "tolerance": tolerance,
    }


def as_fill(fill: Fill, owner: str) -> tuple[float, ...]:
    """Return one value or one for each channel as a tuple; integers, which may be ids, stay integers."""
    try:
        if isinstance(fill, (str, bytes)):
            raise TypeError
        given = tuple(fill) if isinstance(fill, Iterable) else (fill,)
        values = tuple(value if isinstance(value, int) else float(value) for value in given)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise TypeError(f"{owner}: fill must be a number or one for each channel; got {shown(fill)}") from None
    if not values or not all(map(math.isfinite, values)):
        raise ValueError(f"{owner}: fill must be finite, a number or one for each channel; got {shown(fill)}")
    return values
