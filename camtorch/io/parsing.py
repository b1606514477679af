"""Contents of files as keys and values: YAML, JSON, OpenCV's XML and NumPy archives, never trusted.

To refuse 10 MB takes at most a second and ten times that memory. All functions raise CameraFileError to refuse.
"""

import contextlib
import io
import json
import math
import os
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from itertools import takewhile
from typing import Any, NoReturn
from xml.etree import ElementTree

import numpy as np

from camtorch.io.record import CameraFileError, repeated
from camtorch.values.arguments import is_list

Path = str | os.PathLike[str]

LARGEST_FILE = 1 << 24
_LARGEST_STORAGE = 1 << 20  # of YAML and of OpenCV's XML
_DEEPEST = 100
_MOST_VALUES = 1 << 17
_MOST_JSON_UNITS = 1 << 20  # of 32 bytes, the memory of a number
_BYTES_PER_UNIT = 4  # of the file, for larger files
_FEW_NODES = 1 << 14  # elements and attributes of XML
_BYTES_PER_NODE = 16  # of the file, for larger files
_MOST_ARRAYS = 1000
_LARGEST_ARRAY = 1 << 16  # bytes; an array of a camera has at most 14 numbers
_SIZES = ("image_size", "imagesize", "img_size", "imgsize", "size", "resolution")
_WORD = re.compile(r'"([^"]*)"|(\S+)')
_JSON = re.compile(r'\s*\{\s*(?!"(?:lens_?model|distortion_model)")["}]')  # mrcal's keys are in a Python literal
_OPTIMIZATION_INPUTS = re.compile(r"('optimization_inputs'\s*:\s*)b'[^'\\\n]*'")  # mrcal's, up to megabytes; skipped
_TAG = "tag:yaml.org,2002:{}".format
_TAGS = (None, "!", *map(_TAG, ("str", "seq", "map", "opencv-matrix", "opencv-nd-matrix")))


def path_of(path: Any, owner: str, file: str = "file") -> str:
    """Return a path as text; raise a TypeError of `owner` that names the kind of `file` if it is none."""
    try:
        name = os.fsdecode(path)
    except TypeError:
        hint = ". Pass its name, file.name" if hasattr(path, "read") else ""
        raise TypeError(f"{owner}: path must be that of a {file}; got {type(path).__name__}{hint}") from None
    if "\0" in name:
        raise CameraFileError(repr(name), "path", "must have no NUL character; got one")
    return name


def check_ordinary(path: Path) -> None:
    """Refuse devices and pipes, which may have no end."""
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        raise CameraFileError(path, "content", "must be an ordinary file; got a device or a pipe")


def read_bytes(path: Path, largest: int = LARGEST_FILE) -> bytes:
    """Return the content of an ordinary file that is neither empty nor suspiciously large."""
    check_ordinary(path)
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > largest:
            raise CameraFileError(path, "size", f"must be at most {largest >> 20} MiB; got {size} bytes")
        content = file.read(size)
    if not content:
        raise CameraFileError(path, "content", "must not be empty; got no bytes")
    return content


def decoded(path: Path, content: bytes) -> str:
    """Return the text of a content in UTF-8."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        kinds = "must be text, or an archive as of numpy.savez(path, K=K, D=D)"
        raise CameraFileError(path, f"byte {error.start}", f"{kinds}; got other bytes") from None


def parse_mapping(path: Path, content: bytes) -> dict[str, Any]:
    """Return the keys of a content. Values are text, lists and mappings; JSON's numbers are floats."""
    try:
        if content.startswith(b"PK\3\4"):
            keys = _from_archive(path, content)
        elif _JSON.match(text := decoded(path, content)):
            keys = parse_json(path, text)
        else:
            text = _OPTIMIZATION_INPUTS.sub(r"\1''", text)
            if len(text) > _LARGEST_STORAGE:
                most = f"must be at most {_LARGEST_STORAGE >> 20} MiB of YAML or XML"
                raise CameraFileError(path, "size", f"{most}; got {len(text)} characters")
            keys = (_from_storage if text.lstrip().startswith("<") else _from_yaml)(path, text)
    except (RecursionError, MemoryError):
        raise CameraFileError(path, "content", "nested too deeply") from None
    if not isinstance(keys, dict):
        raise CameraFileError(path, "content", f"must be keys and values; got {type(keys).__name__}")
    return keys


def parse_json(path: Path, text: str) -> Any:
    """Return the value of a JSON text; all numbers are floats."""
    size = text.count(",") + 3 * text.count("[") + 6 * text.count("{") + 5 * text.count(":")
    if size > max(_MOST_JSON_UNITS, len(text) // _BYTES_PER_UNIT):
        raise CameraFileError(path, "content", "must have fewer values; got too many")

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = dict(pairs)
        if len(keys) < len(pairs):
            raise ValueError(f"keys must be unique; got {repeated(key for key, _ in pairs)!r:.60} twice")
        return keys

    # parse floats directly: huge integers cost no time, and no text is made of a number
    try:
        return json.loads(text, object_pairs_hook=unique, parse_int=float, parse_constant=float)
    except ValueError as error:
        place = f"line {error.lineno}" if isinstance(error, json.JSONDecodeError) else "content"
        raise CameraFileError(path, place, getattr(error, "msg", error)) from None


def plain(value: Any) -> Any:
    """Return keys and values as a parser of JSON gives them; YAML, NumPy and configurations have others."""
    kind = type(value)
    if kind is float or kind is str:
        return value
    if kind is int:
        return float(value) if abs(value) < 1e308 else math.inf  # as JSON's
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if is_list(value):
        return list(map(plain, value))
    return plain(value.tolist()) if hasattr(value, "tolist") else value


def arrays_of(content: bytes, largest: int) -> dict[str, np.ndarray | None]:
    """Return arrays of numbers by name; None for damaged or too large arrays, and for objects."""
    if content.count(b"PK\1\2") > _MOST_ARRAYS:
        raise ValueError(f"must hold at most {_MOST_ARRAYS} arrays; got more")
    arrays: dict[str, np.ndarray | None] = {}
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for entry in archive.infolist():
            array = None
            if entry.file_size <= largest:
                with archive.open(entry) as file, contextlib.suppress(ValueError, MemoryError):
                    array = np.lib.format.read_array(file, allow_pickle=False)
            name = entry.filename.removesuffix(".npy")
            arrays[name] = array if array is not None and array.dtype.kind in "fiub" else None
    return arrays


def _from_archive(path: Path, content: bytes) -> dict[str, Any]:
    """Return the keys of an archive, arrays as lists; refuse sizes, whose order is unknown."""
    try:
        arrays = arrays_of(content, _LARGEST_ARRAY)
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError) as error:
        raise CameraFileError(path, "content", f"must be an archive of numpy.savez; got a bad one: {error}") from None
    keys = {name: None if array is None else array.astype(np.float64).tolist() for name, array in arrays.items()}
    for name, value in keys.items():
        if name.lower() in _SIZES and isinstance(value, list) and len(value) == 2 and value[0] != value[1]:
            either = f"got {value[0]:g} {value[1]:g}, (width, height) or (height, width)"
            raise CameraFileError(path, name, f"its order must be known; {either}. Save image_width and image_height")
    return keys


def parse_xml(path: Path, text: str) -> ElementTree.Element:
    """Return the root of an XML text; document types, entities and very many elements are refused."""
    if declared := re.search(r"<!(?:DOCTYPE|ENTITY|ELEMENT|ATTLIST|NOTATION)", text, re.IGNORECASE):
        line = text.count("\n", 0, declared.start()) + 1
        raise CameraFileError(path, f"line {line}", "must have no document type, which could define entities; got one")
    if text.count("=") + text.count("<") > max(_FEW_NODES, len(text) // _BYTES_PER_NODE):
        raise CameraFileError(path, "content", "must have fewer elements; got too many")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        place = f"line {error.position[0]}" if isinstance(error, ElementTree.ParseError) else "content"
        raise CameraFileError(path, place, f"must be XML; got {str(error).split(':')[0]}") from None


def _from_storage(path: Path, text: str) -> Any:
    """Return OpenCV's XML: keys in <opencv_storage>, and sequences as words or as elements called _."""
    root = parse_xml(path, text)
    if root.tag != "opencv_storage":
        raise CameraFileError(path, "content", f"must be XML of OpenCV, <opencv_storage>; got <{root.tag:.60}>")

    def value_of(element: ElementTree.Element) -> Any:
        if element is root or any(child.tag != "_" for child in element):
            twice = repeated(child.tag for child in element)
            if twice is not None:
                raise CameraFileError(path, f"{element.tag:.60}", f"keys must be unique; got {twice!r:.60} twice")
            return {child.tag: value_of(child) for child in element}
        words = [quoted or word for quoted, word in _WORD.findall(element.text or "")]
        if len(element) or len(words) != 1 or element.tag == "data":
            return words + list(map(value_of, element))
        return words[0]

    return value_of(root)


def _from_yaml(path: Path, text: str) -> Any:
    import yaml  # the import takes 0.02 s

    text = re.sub(r"\A(\s*)%YAML[^\r\n]*", r"\1", text)  # "%YAML:1.0", as OpenCV writes it, is not YAML
    if "\n%" in text:  # libyaml compares all pairs of directives
        raise CameraFileError(path, "content", "must have no YAML directives; got one")
    try:
        # parse events, not yaml.load: no tags, and no numbers by the rules of YAML 1.1
        return _document(path, yaml.parse(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)))
    except yaml.YAMLError as error:
        mark, reason = (getattr(error, name, None) for name in ("problem_mark", "problem"))
        where = f"line {mark.line + 1}" if mark else "content"
        reason = reason or getattr(error, "reason", "no reason given")
        raise CameraFileError(path, where, f"must be YAML; got an error: {reason}") from None
    except (ValueError, OverflowError) as error:
        raise error if isinstance(error, CameraFileError) else CameraFileError(path, "content", error) from None


def _document(path: Path, events: Iterator[Any]) -> Any:
    """Return the value of the first document; others must be empty: rostopic ends a message with ---."""
    anchors: dict[str, tuple[Any, int]] = {}

    def fail(event: Any, reason: str) -> NoReturn:
        raise CameraFileError(path, f"line {event.start_mark.line + 1}", reason) from None

    def value_of(event: Any, depth: int) -> tuple[Any, int]:
        """Return the value that begins with an event, and how many values it has, those behind aliases included."""
        kind = type(event).__name__
        if kind == "AliasEvent":  # of a value that has ended, so that none holds itself
            return anchors.get(event.anchor) or fail(event, f"alias must be known; got {event.anchor!r:.60}")
        if event.tag not in _TAGS:
            fail(event, f"tags must be of keys and values, as nothing is constructed here; got {event.tag!r:.80}")
        if depth > _DEEPEST:
            fail(event, "nested too deeply")
        found = (event.value, 1) if kind == "ScalarEvent" else inside(kind == "SequenceStartEvent", depth + 1)
        if event.anchor:
            anchors[event.anchor] = found
        return found

    def inside(is_list: bool, depth: int) -> tuple[Any, int]:
        """Return the list or the mapping of the next events, up to its end, and how many values it has with itself."""
        items, keys, size = list[Any](), dict[str, Any](), 1
        for item in takewhile(lambda one: not type(one).__name__.endswith("EndEvent"), events):
            value, more = value_of(item, depth)
            size += more
            if is_list:
                items.append(value)
            elif isinstance(value, str) and value not in keys:
                keys[value], more = value_of(next(events), depth)
                size += more
            else:
                twice = f"{value!r:.60} twice" if isinstance(value, str) else "a list or a mapping"
                fail(item, f"keys must be text, and unique; got {twice}")
            if size > _MOST_VALUES:
                fail(item, f"must have at most {_MOST_VALUES} values; got more")
        return (items if is_list else keys), size

    values = [value_of(event, 0)[0] for event in events if hasattr(event, "anchor")]
    if any(values[1:]):
        raise CameraFileError(path, "content", "must have one document; got a second one")
    return values[0] if values else None
