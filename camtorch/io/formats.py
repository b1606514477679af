"""`load` and `save`: each format decides whether a file is its own; formats are known only by their modules.

To add a format, write a file in this folder and name it in one of the lists below. It has `NAMES: Names`, and
* `matches(keys: dict[str, Any]) -> bool` and `parse(record: Record) -> Rig`, if a file is keys and values of YAML,
  JSON, XML or a NumPy archive; else `matches(path: str, content: bytes) -> bool` and `read(path, content) -> Rig`,
  which may read files in the same folder too, all in float64;
* `render(rig: Rig, lossy: Lossy) -> str | dict[str, bytes]`, if it is written: the text of a file, or files by path.
Values that it cannot read or hold raise CameraFileError, as by `record.fail`.
"""

import codecs
import fnmatch
import json
import os
import re
from collections.abc import Mapping
from typing import IO, Any, TypeVar

from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.io import (
    aria,
    basalt,
    camodocal,
    camtorch_json,
    colmap,
    gyroflow,
    kalibr,
    metashape,
    mrcal,
    ncore,
    nerfstudio,
    nuscenes,
    ocamcalib,
    opencv,
    ros,
    woodscape,
)
from camtorch.io.parsing import LARGEST_FILE, parse_mapping, path_of, plain, read_bytes
from camtorch.io.record import CameraFileError, Names, Record
from camtorch.io.writing import Lossy, replacing
from camtorch.values.arguments import LEFT, shown

Kind = TypeVar("Kind", bound=Camera)


# formats that are read, in the order in which they are tried
_BY_CONTENT: tuple[Any, ...] = (colmap, metashape, nuscenes, ocamcalib)
_BY_KEYS: tuple[Any, ...] = (
    camtorch_json,
    aria,
    basalt,
    mrcal,
    ncore,
    nerfstudio,
    ros,
    kalibr,
    woodscape,
    gyroflow,
    camodocal,
    opencv,
)
_MODULES: dict[str, Any] = {module.NAMES.format: module for module in (*_BY_CONTENT, *_BY_KEYS)}
READ: dict[str, Names] = {format: module.NAMES for format, module in _MODULES.items()}
WRITTEN = {format: READ[format] for format, module in _MODULES.items() if hasattr(module, "render")}
FORMATS = tuple(READ)
_CONTENT = r"""\n|\{['"]|<\?|\0\0|PK\x03"""  # in no path


def load(path: str | os.PathLike[str] | IO[str] | IO[bytes], format: str | None = None) -> Rig:
    """Load the cameras of a calibration file and their poses, in float64, frozen until you call `.requires_grad_()`.

    Args:
        path: A file of OpenCV, ROS, Kalibr, COLMAP, Nerfstudio, Project Aria, Basalt, mrcal, ncore, OCamCalib,
            WoodScape, Gyroflow, camodocal, Metashape, nuScenes or camtorch; an archive of
            `numpy.savez(path, K=K, D=D)`; or the folder of a COLMAP or Nerfstudio reconstruction. COLMAP's images
            in the folder of the cameras are read with them. Or an open file, of which only the content is read.
        format: Its format in small letters, as in "opencv" or "ros". Default: found from content and name.

    Returns:
        Rig: `rig.cameras`, `rig.extrinsics` (camera from rig, or from world for posed images), `rig.camera` if
        there is only one. Poses of images are the rows of one batch, `rig.extrinsics.batch`. Pixel centres, axes and
        directions are camtorch's, whatever the file's are. Names are the file's; one nameless camera is "camera".

    Example:
        >>> ct.save(ct.Pinhole([90.0, 90.0, 63.5, 47.5], image_size=(96, 128)), "camera.xml")
        >>> ct.load("camera.xml").camera.image_size
        (96, 128)

    Raises:
        CameraFileError: If the file cannot be used; the message names the place and the reason.
        OSError: If the file cannot be opened. ValueError: If the format is unknown. TypeError: If `path` is no path.
    """
    format = _known(format, READ, "read")
    if isinstance(path, (Mapping, list)):
        raise TypeError(f"load: path must be that of a calibration file; got a {type(path).__name__}. Write ct.loads")
    if not isinstance(path, (str, bytes, os.PathLike)) and hasattr(path, "read"):
        name = getattr(path, "name", None)
        source = f"load: {name if isinstance(name, str) else type(path).__name__}"  # in no folder, as an archive's is
        try:
            content = path.read(LARGEST_FILE + 1)
        except ValueError as error:  # closed, only written to, or binary and open as text
            reason = f"must be readable; got {str(error).rstrip('.')}. Open it with 'rb'"
            raise CameraFileError(source, "content", reason) from None
        if len(content) > LARGEST_FILE:
            raise CameraFileError(source, "size", f"must be at most {LARGEST_FILE >> 20} MiB; got more")
        return _loaded(source, content, format)
    if isinstance(path, (str, bytes)) and re.search(_CONTENT, os.fsdecode(path)) and not os.path.exists(path):
        raise ValueError("load: path must be that of a calibration file; got its content. Write ct.loads(content)")
    path = path_of(path, "load", "calibration file")
    if os.path.isdir(path):
        names = [name for names in READ.values() for name in names.in_folder]
        found = next((name for name in names if os.path.exists(os.path.join(path, name))), None)
        if found is None:
            raise CameraFileError(path, "folder", f"must have one of {', '.join(names)}; got none. Name its file")
        path = os.path.join(path, found)
    return _loaded(path, read_bytes(path), format)


def loads(content: str | bytes | Mapping[str, Any] | list[Any], format: str | None = None) -> Rig:
    """Load the cameras of a calibration that is in memory, as `load` loads those of a file.

    Args:
        content: The text or the bytes of a calibration file, or its keys and values as a parser of JSON or YAML gave
            them; arrays and tensors may be values. Or the dict of `camera.to_dict()`.
        format: See `load`. COLMAP's poses are in a file of their own, which is not read.

    Raises:
        CameraFileError: If the content cannot be used; the message names the place and the reason.
        ValueError: If the format is unknown. TypeError: If `content` is neither text, nor bytes, nor keys and values.
    """
    format = _known(format, READ, "read")
    if not isinstance(content, (str, bytes, Mapping, list)):
        raise TypeError(f"loads: content must be text, bytes or a dict; got {shown(content)}. ct.load reads files")
    if isinstance(content, (str, bytes)) and os.path.exists(content):
        raise ValueError(f"loads: content must be that of a calibration file; got its path. Write ct.load({content!r})")
    return _loaded("loads", content, format)


def _loaded(source: str, content: str | bytes | Mapping[str, Any] | list[Any], format: str | None) -> Rig:
    """Return the frozen rig of a content, or of keys and values; errors name its source."""
    if not content:
        raise CameraFileError(source, "content", "must not be empty; got nothing. Call file.seek(0) if it was read")
    try:
        rig, format = _read(source, content, format)
    except (ArithmeticError, RecursionError, MemoryError, UnicodeError) as error:
        raise CameraFileError(source, "content", f"must be readable; got {type(error).__name__}: {error}") from None
    if not rig.cameras:
        raise CameraFileError(source, "cameras", "must be given; got none")
    rig.format = format
    return rig.requires_grad_(False)


def load_camera(kind: type[Kind], path: str | os.PathLike[str]) -> Kind:
    """Return the only camera of a calibration file, which must be a `kind`."""
    rig, owner = load(path), f"{kind.__name__}.load: {os.fspath(path)}"
    if len(rig.cameras) != 1:
        names = ", ".join(map(repr, rig.cameras))
        raise ValueError(f"{owner} must have one camera; got {names}. Write ct.load(path)[name]")
    if not isinstance(rig.camera, kind):
        its = type(rig.camera).__name__
        raise ValueError(f"{owner} must have a {kind.__name__}; got a {its}. Write ct.Camera.load(path)")
    return rig.camera


def _read(path: str, content: str | bytes | Mapping[str, Any] | list[Any], format: str | None) -> tuple[Rig, str]:
    if isinstance(content, Mapping):
        keys = plain(content)
    else:
        content = json.dumps(plain(content)) if isinstance(content, list) else content
        content = content.encode() if isinstance(content, str) else content
        content = content.removeprefix(codecs.BOM_UTF8)  # some editors write this mark
        for by_content in _BY_CONTENT:
            if format == by_content.NAMES.format or (format is None and by_content.matches(path, content)):
                return by_content.read(path, content), by_content.NAMES.format
        keys = parse_mapping(path, content)
    for by_keys in _BY_KEYS:
        if format == by_keys.NAMES.format or (format is None and by_keys.matches(keys)):
            return by_keys.parse(Record(path, keys)), by_keys.NAMES.format
    first = ", ".join(f"{key!r:.30}" for key in list(keys)[:5]) or "none"
    raise CameraFileError(path, "content", f"keys must be those of a known format; got {first}. OpenCV's are K and D")


def save(rig: Rig | Camera, path: str | os.PathLike[str], format: str | None = None) -> None:
    """Write cameras to a calibration file; an existing file is replaced as a whole, or kept if writing fails.

    Formats of data sets, and of programs that make their own calibrations, are read only.

    Args:
        rig: A `Rig`, or one camera.
        path: The file; if it is a link, the file that it points to is replaced. With COLMAP it may be a folder, and
            poses go to an images file in the folder of the cameras; with Nerfstudio it may be a folder that exists.
        format: "opencv", "ros", "kalibr", "colmap", "nerfstudio", "aria", "basalt", "mrcal" or "camtorch".
            Default: the format that the rig was loaded from if its files end like this one, else that of the name
            (`transforms.json`, `camchain.yaml`, `camera_info.yaml`, `.cameramodel`, `.xml`, `cameras.txt`, `.bin`),
            else camtorch's own for `.json`.

    Example:
        >>> ct.save(ct.Pinhole([90.0, 90.0, 63.5, 47.5], image_size=(96, 128)), "camera.json")

    Raises:
        CameraFileError: If the format cannot hold a value; the message names the value that would be lost.
        ValueError: If the format is unknown, or the name does not determine it. OSError: If the file cannot be written.
    """
    write(rendered(rig, path, format), path)


def write(contents: dict[str, bytes], path: str | os.PathLike[str]) -> None:
    """Write the files that `rendered` returned for a path."""
    for name in contents:
        folder = os.path.dirname(name)
        if os.path.normpath(folder or ".") == os.path.normpath(path):
            os.makedirs(folder, exist_ok=True)
    with replacing(*contents) as files:
        for file, content in zip(files, contents.values(), strict=True):
            file.write(content)


def rendered(rig: Rig | Camera, path: str | os.PathLike[str], format: str | None = None) -> dict[str, bytes]:
    """Return the files that `save` writes, by their paths; raise the same errors."""
    if isinstance(rig, Camera):
        rig = Rig({"camera": rig})
    if not isinstance(rig, Rig):
        part = next((name for name in ("camera", "rig") if isinstance(getattr(rig, name, None), (Camera, Rig))), None)
        hint = f". Pass its .{part}" if part else ""
        raise TypeError(f"save: rig must be a Rig or a Camera; got {type(rig).__name__}{hint}")
    path = path_of(path, "save", "calibration file")
    if not rig.cameras:
        raise ValueError(f"{path}: rig must have a camera; got none")
    for name, camera in rig.cameras.items():
        if camera.is_mixed:
            by_name = "ct.Rig({f'camera{i}': one for i, one in enumerate(camera)})"
            raise TypeError(f"{path}: {name} must be of one model; got a Mixed. Save {by_name}")
        if not camera.key:
            raise TypeError(f"{path}: {name} must be of a model with a key; got {type(camera).__name__}")
    format = _known(format, WRITTEN, "written") or _format_of(rig, path)
    if os.path.isdir(path):
        inside = [os.path.join(path, name) for name in WRITTEN[format].in_folder]
        if not inside:
            raise ValueError(f"{path}: path must be a file for {format}; got a folder. Add a name")
        path = next(filter(os.path.exists, inside), inside[-1])
    try:
        found: str | dict[str, bytes] = _MODULES[format].render(rig, Lossy(path, WRITTEN[format].title))
        return {path: found.encode()} if isinstance(found, str) else found
    except UnicodeEncodeError as error:
        raise CameraFileError(path, "names", f"must be text that a file can hold; got {error.object!r:.60}") from None


def _known(format: str | None, there: dict[str, Names], done: str) -> str | None:
    name = None if format is None else str(format).lower()
    if name is None or name in there:
        return name
    reason = f"which is not {done}" if name in FORMATS else f"which is unknown. {LEFT}"
    raise ValueError(f"format must be one of {', '.join(sorted(there))}; got {format!r}, {reason}")


def _format_of(rig: Rig, path: str) -> str:
    """Return the format to write: the rig's own if the path allows it, else the one that the file name means."""
    folder, file = os.path.isdir(path), os.path.basename(path).lower()
    fitting = [n for n in WRITTEN.values() if (n.in_folder if folder else file.endswith(n.suffixes))]
    formats = sorted(names.format for names in fitting)
    if rig.format is not None and rig.format in formats:
        return rig.format
    patterns = {pattern: names.format for names in fitting for pattern in names.patterns if not folder}
    if meant := [pattern for pattern in patterns if fnmatch.fnmatchcase(file, pattern)]:
        return patterns[max(meant, key=len)]
    may = f"got one that fits {', '.join(formats) or 'none of ' + ', '.join(sorted(WRITTEN))}"
    hint = "Name the format, as in format='kalibr' or --format kalibr"
    raise ValueError(f"{path}: the name must determine the format; {may}. {hint}")
