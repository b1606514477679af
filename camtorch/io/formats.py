"""`load` and `save`: which format a file has, or is to have."""

from __future__ import annotations

import os
import re

from camtorch.camera import Camera
from camtorch.io import aria, basalt, camtorch_json, colmap, kalibr, mrcal, nerfstudio, opencv, ros
from camtorch.io._errors import CameraFileError
from camtorch.io.parsing import parse_mapping, read_text
from camtorch.io.record import Record
from camtorch.io.writing import replacing
from camtorch.rig import Rig

# what has keys and values, in the order in which their keys are tried
_BY_KEYS = {
    "camtorch": camtorch_json,
    "aria": aria,
    "basalt": basalt,
    "mrcal": mrcal,
    "nerfstudio": nerfstudio,
    "ros": ros,
    "kalibr": kalibr,
    "opencv": opencv,
}
FORMATS = (*_BY_KEYS, "colmap")
_SUFFIXES = {
    "opencv": (".yml", ".yaml", ".json", ".xml"),
    "ros": (".yaml", ".yml"),
    "kalibr": (".yaml", ".yml"),
    "colmap": (".txt", ".bin"),
    "nerfstudio": (".json",),
    "aria": (".json",),
    "basalt": (".json",),
    "mrcal": (".cameramodel",),
    "camtorch": (".json",),
}
_NAMES = {
    r"transforms.*\.json": "nerfstudio",
    r".*camchain.*\.ya?ml": "kalibr",
    r".*camera_?info.*\.ya?ml": "ros",
}
_IN_A_FOLDER = ("cameras.bin", "cameras.txt", "transforms.json")


def load(path, format: str | None = None) -> Rig:
    """The cameras of a calibration file, in float64 and frozen, with their poses.

    A calibration is a measurement: nothing of it learns until `.requires_grad_()` says so.

    Args:
        path: a file of OpenCV, ROS, Kalibr, COLMAP, Nerfstudio, Project Aria, Basalt, mrcal or camtorch; or the folder
            of a COLMAP or Nerfstudio reconstruction. COLMAP's images beside the cameras are read with them.
        format: its format, one of the keys of `camtorch.save`; found from content and name if left out.

    Returns:
        A `Rig`: `rig.cameras`, `rig.extrinsics` (camera from rig, or from world for posed images), `rig.camera` if
        there is only one. Pixel centres, axes and directions are camtorch's, whatever the file's are. Names are the
        file's; one nameless camera is "camera".

    Raises:
        CameraFileError: the file cannot be used; it says where and why. OSError: it cannot be opened.
        ValueError: an unknown format. ImportError: YAML without PyYAML.
    """
    format = _known(format)
    if os.path.isdir(path):
        found = [os.path.join(path, name) for name in _IN_A_FOLDER if os.path.exists(os.path.join(path, name))]
        if not found:
            raise CameraFileError(path, "folder", f"has none of {', '.join(_IN_A_FOLDER)}")
        path = found[0]
    try:
        rig, format = _load(path, format)
    except (ArithmeticError, RecursionError, MemoryError) as error:
        raise CameraFileError(path, "content", f"cannot be read: {type(error).__name__}: {error}") from None
    if not rig.cameras:
        raise CameraFileError(path, "cameras", "none")
    for module in (*rig.cameras.values(), *rig.extrinsics.values()):
        module.requires_grad_(False)
    rig.format = format
    return rig


def _load(path, format: str | None) -> tuple[Rig, str]:
    if format == "colmap" or (format is None and os.fspath(path).endswith(".bin")):
        return colmap.read(path), "colmap"
    text = read_text(path)
    if format is None and colmap.matches_text(text):
        return colmap.read(path, text), "colmap"
    literal = format == "mrcal" or (format is None and mrcal.matches_text(text))
    keys = (mrcal.parse_literal if literal else parse_mapping)(path, text)
    format = format or next((name for name, module in _BY_KEYS.items() if module.matches(keys)), None)
    if format is None:
        shown = ", ".join(f"{key!r:.30}" for key in list(keys)[:5]) or "none"
        raise CameraFileError(path, "content", f"no format that is known here has the keys {shown}")
    return _BY_KEYS[format].parse(Record(path, keys)), format


def save(rig: Rig | Camera, path, format: str | None = None) -> None:
    """Write cameras to a calibration file; what stood there before is replaced as a whole, or stays.

    Args:
        rig: a `Rig`, or one camera.
        path: the file; with COLMAP it may be a folder. There poses go to an images file beside the cameras.
        format: "opencv", "ros", "kalibr", "colmap", "nerfstudio", "aria", "basalt", "mrcal" or "camtorch". If left out:
            the format that the rig was loaded from if its files end like this one, else what the name says
            (`transforms.json`, `camchain.yaml`, `camera_info.yaml`, `.cameramodel`, `.xml`, `cameras.txt`, `.bin`),
            else camtorch's own for `.json`.

    Raises:
        CameraFileError: something that the format cannot hold; it says what would be lost.
        ValueError: an unknown format, or a suffix that does not say which. OSError: it cannot be written.
    """
    contents = rendered(rig, path, format)
    for name in contents:
        folder = os.path.dirname(name)
        if os.path.normpath(folder or ".") == os.path.normpath(path):
            os.makedirs(folder, exist_ok=True)
    with replacing(*contents) as files:
        for file, content in zip(files, contents.values(), strict=True):
            file.write(content)


def rendered(rig: Rig | Camera, path, format: str | None = None) -> dict[str, bytes]:
    """The files that `save` writes, by their paths. Raises what it raises."""
    if isinstance(rig, Camera):
        rig = Rig({"camera": rig})
    if not isinstance(rig, Rig):
        raise TypeError(f"save takes a Rig or a Camera; got {type(rig).__name__}")
    if not rig.cameras:
        raise ValueError(f"{path}: a rig without cameras, which no format holds")
    path = os.fspath(path)
    format = _known(format) or _format_of(rig, path)
    if format != "colmap" and os.path.isdir(path):
        raise ValueError(f"{path}: is a folder; {format} is one file, so name it")
    try:
        return colmap.write(rig, path) if format == "colmap" else {path: _BY_KEYS[format].render(rig, path).encode()}
    except UnicodeEncodeError as error:
        raise CameraFileError(path, "names", f"{error.object!r:.60} is no text that a file can hold") from None


def _known(format: str | None) -> str | None:
    name = None if format is None else str(format).lower()
    if name is not None and name not in FORMATS:
        raise ValueError(f"unknown format {format!r}; known are {', '.join(sorted(FORMATS))}")
    return name


def _format_of(rig: Rig, path: str) -> str:
    name = os.path.basename(path).lower()
    suffix = os.path.splitext(name)[1]
    fitting = [format for format, suffixes in _SUFFIXES.items() if suffix in suffixes]
    if rig.format in fitting or (rig.format == "colmap" and os.path.isdir(path)):
        return rig.format
    if os.path.isdir(path):
        raise ValueError(f"{path}: is a folder; name a file, or format='colmap'")
    for pattern, format in _NAMES.items():
        if re.fullmatch(pattern, name):
            return format
    if suffix == ".json":
        return "camtorch"
    if len(fitting) == 1:
        return fitting[0]
    may = f"it may be {', '.join(sorted(fitting))}" if fitting else f"known are {', '.join(sorted(FORMATS))}"
    raise ValueError(f"{path}: the name does not say the format; {may}. Say which, as in format={'kalibr'!r}")
