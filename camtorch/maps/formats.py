"""`save_map` and `load_map`: the formats of maps, known only by their objects.

To add a format, write one file in this folder, as `protocol.py` explains, and name its object below.
"""

import json
import os
from typing import Any, Literal, TypedDict, Unpack

from camtorch.io.parsing import path_of, read_bytes
from camtorch.io.record import CameraFileError
from camtorch.io.writing import as_json, replacing
from camtorch.maps.dw100 import DW100
from camtorch.maps.lookup import Exact, LookupMap
from camtorch.maps.onnx import ONNX
from camtorch.maps.opencv import OpenCV
from camtorch.maps.protocol import SIZES, MapFormat
from camtorch.maps.report import MapReport, measure
from camtorch.maps.ti_ldc import TILDC
from camtorch.warp.warp import Warp

_ALL = OpenCV("opencv"), OpenCV("opencv_fixed"), DW100(), TILDC(), ONNX()  # in the order in which they are tried
_FORMATS: dict[str, MapFormat] = {format.name: format for format in _ALL}
FORMATS = tuple(_FORMATS)

_NO_FACTS = ("format", *SIZES, "max_error", "rms_error")
_KNOWN = f"known are {', '.join(FORMATS)}; docs/leaving-0.3.md lists what to use for formats that left"


class MapOptions(TypedDict, total=False):
    """Options of `save_map`, each for some formats."""

    step: int | None
    dtype: Literal["float32", "uint8"] | None
    clip: bool | None


def save_map(
    warp: Warp, path: str | os.PathLike[str], format: str | None = None, **options: Unpack[MapOptions]
) -> MapReport:
    """Write the source position of each target pixel for another runtime, and measure the error of the file.

    The file is read back, interpolated as its runtime does, and compared with the exact positions, at every pixel that
    shows the source's image. A map holds positions alone: mode, padding, fill and antialias are the runtime's, except
    for "onnx", which holds all but the last.

    Args:
        warp: A single warp.
        path: The file, replaced as a whole or not at all. A bare table gets a description next to it, PATH.json.
        format: "opencv" (.yml, .npz), "opencv_fixed" (the same), "dw100", "ti_ldc" or "onnx". Default: chosen by
            the suffix.
        step: "ti_ldc": pixels of the target between the nodes of the mesh, a power of two up to 128; 8 by default.
        dtype: "onnx": of the images, "float32" by default, or "uint8".
        clip: "dw100", "ti_ldc": clip positions that the format cannot hold, instead of refusing them.

    Raises:
        CameraFileError: If the format cannot hold this warp; the error says why. ValueError: If the warp is a batch,
            the format unknown, or an option not one of the format. ImportError: If a library that the format needs is
            missing; the error names the extra. OSError: If the file cannot be written.

    Example:
        >>> report = ct.save_map(ct.Dewarp(camera), "map.npz")
        >>> report.max_error  # pixels of the source
    """
    name = path_of(path, "save_map")
    chosen = _chosen(name, format)
    given = {option: value for option, value in options.items() if value is not None}
    for option in given:
        if option not in chosen.options:
            takes = f"among {', '.join(chosen.options)}" if chosen.options else "none"
            raise ValueError(f"save_map: options of {chosen.name} must be {takes}; got {option}")
    if chosen.suffixes and not name.lower().endswith(chosen.suffixes):
        raise ValueError(f"{name}: suffix must be one of {', '.join(chosen.suffixes)} for {chosen.name}; got another")
    exact = Exact(warp, "save_map")
    if not exact.shown.any():
        raise ValueError(f"save_map: {name}: the target must show a part of the source's image; got none")
    content, facts = chosen.encode(name, exact, given)
    described = {"format": chosen.name, **dict(zip(SIZES, exact.source_size + exact.target_size, strict=True)), **facts}
    files = files_of(name, chosen.name)
    report = measure(name, chosen.decode(content, described), exact, files, facts)
    with replacing(*files) as opened:
        opened[0].write(content)
        if chosen.described:
            errors = {"max_error": round(report.max_error, 6), "rms_error": round(report.rms_error, 6)}
            opened[1].write(as_json({**described, **errors}).encode())
    return report


def load_map(path: str | os.PathLike[str], format: str | None = None) -> LookupMap:
    """Read a map that `save_map` wrote, to inspect it or to compare it with a warp.

    Args:
        path: The file; a bare table has its description next to it.
        format: One of the formats of `save_map`. Default: found from the content, the name and the description.

    Returns:
        LookupMap: `.positions`, `.map_x`, `.map_y`, `.grid()`, `.error(warp)`; called with images it warps them.

    Raises:
        CameraFileError: If the file cannot be used; the error says why. OSError: If it cannot be opened. ValueError: If
            the format is unknown. ImportError: If a library that it needs is missing; the error names the extra.
    """
    name = path_of(path, "load_map")
    content = read_bytes(name, largest=1 << 31)
    fitting = (known for known in _FORMATS.values() if known.matches(name, content))
    chosen = next(fitting, None) if format is None else _named(format)
    described = _read_description(name) if chosen is None or chosen.described else {}
    chosen = chosen or _FORMATS.get(str(described.get("format")))
    if chosen is None:
        what = f"must be a known map, or have {name}.json; got neither. Write format=...; {_KNOWN}"
        raise CameraFileError(name, "content", what)
    if described.get("format", chosen.name) != chosen.name:
        raise CameraFileError(f"{name}.json", "format", f"must be {chosen.name}; got {described['format']!r:.60}")
    try:
        read = chosen.decode(content, described)
    except ImportError:
        raise
    except Exception as error:  # libraries raise any error for damaged files
        reason = f"must be a map of {chosen.name}; got {str(error) or type(error).__name__}"
        raise CameraFileError(name, "content", reason) from None
    facts = {key: tuple(value) if isinstance(value, list) else value for key, value in described.items()}
    read.facts = {**{key: facts[key] for key in facts if key not in _NO_FACTS}, **read.facts}
    return read


def files_of(path: str | os.PathLike[str], format: str | None = None) -> tuple[str, ...]:
    """Return the files that `save_map` writes: the path, and for a bare table its description."""
    name = path_of(path, "save_map")
    return (name, f"{name}.json") if _chosen(name, format).described else (name,)


def _read_description(path: str) -> dict[str, Any]:
    """Return the description of a bare table, or an empty dict."""
    beside = f"{path}.json"
    if not os.path.isfile(beside):
        return {}
    try:
        described = json.loads(read_bytes(beside, largest=1 << 16))
        if not isinstance(described, dict):
            raise ValueError("must be a mapping; got another value")
    except (ValueError, RecursionError) as error:
        raise CameraFileError(beside, "content", f"must describe a map: {error}") from None
    return described


def _chosen(path: str, format: str | None) -> MapFormat:
    if format is not None:
        return _named(format)
    suffix = os.path.splitext(path)[1].lower()
    suffixes = {suffix: known for known in reversed(_FORMATS.values()) for suffix in known.suffixes}
    if suffix not in suffixes:
        raise ValueError(
            f"{path}: the name must end in {', '.join(suffixes)} to determine the format; got another. Name it, "
            f"as in format='dw100' or --format dw100; {_KNOWN}"
        )
    return suffixes[suffix]


def _named(format: str) -> MapFormat:
    found = _FORMATS.get(str(format).lower())
    if found is None:
        raise ValueError(f"format must be a known format of maps; got {format!r}; {_KNOWN}")
    return found
