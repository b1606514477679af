"""`Warp.save` and `load_map`: the formats of maps, none of which is known here but by its object.

To add a format, write one file beside this one, as `protocol.py` says, and name its object below.
"""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

from camtorch._arguments import as_image_size, as_whole
from camtorch.io._errors import CameraFileError
from camtorch.io.parsing import path_of, read_bytes
from camtorch.io.writing import as_json, replacing
from camtorch.maps.depthai import DepthAI
from camtorch.maps.dw100 import DW100
from camtorch.maps.exact import Exact
from camtorch.maps.lookup import LookupMap
from camtorch.maps.obj import OBJ
from camtorch.maps.onnx import ONNX
from camtorch.maps.opencv import OpenCV
from camtorch.maps.protocol import SIZES, MapFormat, Options, named_sizes
from camtorch.maps.report import MapReport, measure
from camtorch.maps.stmap import STMap
from camtorch.maps.ti_ldc import TILDC

if TYPE_CHECKING:
    from camtorch.warp.warp import Warp

# in the order in which they are asked
_FORMATS: dict[str, MapFormat] = {
    format.name: format
    for format in (
        OpenCV("opencv"),
        OpenCV("opencv_fixed"),
        STMap(),
        DW100(),
        TILDC(),
        DepthAI(),
        OBJ(),
        ONNX(),
    )
}
FORMATS = tuple(_FORMATS)

_LARGEST_FILE = 1 << 31
_LARGEST_DESCRIPTION = 1 << 16


def save_map(warp: Warp, path: str | os.PathLike[str], format: str | None, **said: Any) -> MapReport:
    """See `Warp.save`; `said` are fields of `Options`."""
    name = path_of(path, "Warp.save")
    chosen = _chosen(name, format)
    if said["step"] is not None:
        said["step"] = as_whole(said["step"], "step", "Warp.save")
    if said["block"] is not None:
        said["block"] = as_image_size(said["block"], "Warp.save", "block")
    for option, value in said.items():
        if value is not None and option not in chosen.options:
            takes = f"; it takes {', '.join(chosen.options)}" if chosen.options else ""
            raise ValueError(f"Warp.save: {chosen.name} has no {option}{takes}")
    if chosen.suffixes and not name.lower().endswith(chosen.suffixes):
        raise ValueError(f"{name}: files of {chosen.name} are called {', '.join(chosen.suffixes)}")
    exact = Exact(warp, "Warp.save")
    if not exact.shown.any():
        raise ValueError(f"Warp.save: {name}: no pixel of the target shows anything of the source's image")
    options = Options(**said, source_size=exact.source_size, target_size=exact.target_size)
    content, facts = chosen.encode(name, exact, options)
    files = (name, _description(name)) if chosen.described else (name,)
    report = measure(name, chosen.decode(content, options), exact, files, facts)
    with replacing(*files) as opened:
        opened[0].write(content)
        if chosen.described:
            errors = {"max_error": round(report.max_error, 6), "rms_error": round(report.rms_error, 6)}
            sizes = named_sizes(report.source_size, report.target_size)
            opened[1].write(as_json({"format": chosen.name, **sizes, **facts, **errors}).encode())
    return report


def load_map(path: str | os.PathLike[str], format: str | None = None) -> LookupMap:
    """Read a map that `Warp.save` wrote: to see what it holds, and to compare it with a warp.

    Args:
        path: the file, beside which bare tables have their description.
        format: one of those of `Warp.save`; found from the content, the name and the description if left out.

    Returns:
        A `LookupMap`: `.positions`, `.map_x`, `.map_y`, `.grid()`, `.error(warp)`; called with images it warps them.

    Raises:
        CameraFileError: the file cannot be used; it says why. OSError: it cannot be opened. ValueError: an unknown
            format. ImportError: a library that the format needs is missing; the error names the extra.
    """
    name = path_of(path, "load_map")
    content = read_bytes(name, _LARGEST_FILE)
    chosen = None if format is None else _named(format)
    chosen = chosen or next((known for known in _FORMATS.values() if known.matches(name, content)), None)
    described = _read_description(name) if chosen is None or chosen.described else {}
    chosen = chosen or _FORMATS.get(str(described.get("format")))
    if chosen is None:
        raise CameraFileError(
            name, "content", f"not that of a known map, and no {_description(name)} says it; say format"
        )
    if described.get("format", chosen.name) != chosen.name:
        raise CameraFileError(_description(name), "format", f"describes {described['format']!r:.60}, not {chosen.name}")
    facts = {key: tuple(value) if isinstance(value, list) else value for key, value in described.items()}
    try:
        sizes: dict[str, Any] = {}
        if chosen.described:
            rows, columns, height, width = (facts[key] for key in SIZES)
            sizes = {"source_size": (rows, columns), "target_size": (height, width)}
        read = chosen.decode(content, Options(step=described.get("step"), **sizes))
    except ImportError:
        raise
    except Exception as error:  # whatever a damaged file makes of the library that reads it
        reason = f"no map of {chosen.name}: {str(error) or type(error).__name__}"
        raise CameraFileError(name, "content", reason) from None
    read.facts = {**{key: facts[key] for key in facts if key not in _NO_FACTS}, **read.facts}
    return read


def files_of(path: str | os.PathLike[str], format: str | None = None) -> tuple[str, ...]:
    """The files that `Warp.save` writes: that of the path, and beside a bare table its description.

    Raises:
        ValueError: as `Warp.save`, of the path and the format.
    """
    name = path_of(path, "Warp.save")
    return (name, _description(name)) if _chosen(name, format).described else (name,)


def check_map(warp: Warp, path: str | os.PathLike[str], format: str | None = None) -> MapReport:
    """How far a map that is there is from a warp; see `load_map`.

    Raises:
        ValueError: it is between images of other sizes, and as `load_map`.
    """
    read = load_map(path, format)
    return measure(path_of(path, "check_map"), read, Exact(warp, "check_map"), (), read.facts)


_NO_FACTS = ("format", *SIZES, "max_error", "rms_error")


def _description(path: str) -> str:
    """The file that says what a bare table does not."""
    return path + ".json"


def _read_description(path: str) -> dict[str, Any]:
    """What stands beside a bare table, or nothing."""
    beside = _description(path)
    if not os.path.isfile(beside):
        return {}
    with open(beside, "rb") as file:
        content = file.read(_LARGEST_DESCRIPTION + 1)
    try:
        described = json.loads(content)
        if not isinstance(described, dict) or len(content) > _LARGEST_DESCRIPTION:
            raise ValueError("no mapping, or too long")
    except (ValueError, RecursionError) as error:
        raise CameraFileError(beside, "content", f"no description of a map: {error}") from None
    return described


def _chosen(path: str, format: str | None) -> MapFormat:
    """The format to write."""
    if format is not None:
        return _named(format)
    suffix = os.path.splitext(path)[1].lower()
    suffixes = {suffix: known for known in reversed(_FORMATS.values()) for suffix in known.suffixes}
    if suffix not in suffixes:
        raise ValueError(
            f"{path}: the name does not say the format; names that end in {', '.join(suffixes)} do. Say which, "
            f"as in format='dw100' or --format dw100; known are {', '.join(FORMATS)}"
        )
    return suffixes[suffix]


def _named(format: str) -> MapFormat:
    found = _FORMATS.get(str(format).lower())
    if found is None:
        raise ValueError(f"format: {format!r} is no format of a map that is known here; known are {', '.join(FORMATS)}")
    return found
