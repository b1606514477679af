"""Contents of files as keys and values: YAML, JSON, OpenCV's XML, Python literals and NumPy archives, never trusted.

To refuse 10 MB takes at most a second and ten times that memory. All functions raise CameraFileError to refuse.
"""

from __future__ import annotations

import ast
import contextlib
import io
import json
import os
import re
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn
from xml.etree import ElementTree

import numpy as np

from camtorch.io.record import CameraFileError, repeated
from camtorch.values.arguments import is_list

Path = str | os.PathLike[str]

LARGEST_FILE = 1 << 24
_LARGEST_STORAGE = 1 << 20  # of YAML and of OpenCV's XML
_LARGEST_LITERAL = 1 << 15  # short enough that no nesting crashes Python's parser
_OPTIMIZATION_INPUTS = re.compile(r"('optimization_inputs'\s*:\s*)b'[^'\\\n]*'")  # can be megabytes; skipped
_DEEPEST = 100
_MOST_VALUES = 1 << 17
_MOST_JSON_UNITS = 1 << 20  # of 32 bytes, the memory of a number
_BYTES_PER_UNIT = 4  # of the file, for larger files
_FEW_NODES = 1 << 14  # elements and attributes of XML
_BYTES_PER_NODE = 16  # of the file, for larger files
_START = 1 << 16  # characters in which the kind of a text is visible
_MOST_ARRAYS = 1000
_LARGEST_ARRAY = 1 << 16  # bytes; an array of a camera has at most 14 numbers
_SIZES = ("image_size", "imagesize", "img_size", "imgsize", "size", "resolution")
_WORD = re.compile(r'"([^"]*)"|(\S+)')

# beginnings of files that people pass by mistake
_OTHERS = (
    (rb"\x80[\x02-\x05]", "must be text; got a pickle, which could run code. Save numpy.savez(path, K=K, D=D) instead"),
    (rb"\x93NUMPY", "must be text; got a single array. Save both by numpy.savez(path, K=K, D=D)"),
    (rb"\x89HDF", "must be text; got a file of HDF5 or MATLAB. Export K and D from there"),
    (rb"\x89PNG|\xff\xd8\xff|II\*\0|MM\0\*", "must be text; got an image. Pass a calibration file"),
)


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
        if (size := os.fstat(file.fileno()).st_size) > largest:
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
        reason = next((reason for start, reason in _OTHERS if re.match(start, content)), "must be text; got bytes")
        raise CameraFileError(path, f"byte {error.start}", reason) from None


def parse_mapping(path: Path, content: bytes) -> dict[str, Any]:
    """Return the keys of a content. Values are text, lists and mappings; JSON's numbers are floats.

    Unknown kinds, repeated keys, tags other than `!!opencv-matrix` and too many values are refused.
    """
    try:
        keys = _from_archive(path, content) if content.startswith(b"PK\3\4") else _from_text(path, content)
    except (RecursionError, MemoryError):
        raise CameraFileError(path, "content", "nested too deeply") from None
    if not isinstance(keys, dict):
        raise CameraFileError(path, "content", f"must be keys and values; got {type(keys).__name__}")
    return keys


def _from_text(path: Path, content: bytes) -> Any:
    text = decoded(path, content)
    # mrcal's brace, perhaps after comments, and quoted key differ from JSON; one regular expression would be slow
    start = re.sub(r"#[^\n]*", "", text[:_START]).split()[:2]
    if re.match(r"\{(?:'|\"(?:lens_?model|distortion_model)\")", "".join(start)):
        text = _OPTIMIZATION_INPUTS.sub(r"\1''", text)  # mrcal's Python literal
        _check_length(path, text, _LARGEST_LITERAL, "a Python literal")
        try:
            values = ast.literal_eval(ast.parse(text, mode="eval"))
        except SyntaxError as error:
            raise CameraFileError(path, f"line {error.lineno}" if error.lineno else "content", error.msg) from None
        except (ValueError, TypeError):  # a list as a key has no hash
            raise CameraFileError(path, "content", "must be text, numbers, lists and mappings; got others") from None
        return plain(values)
    kind = text.lstrip()[:1]
    return parse_json(path, text) if kind == "{" else (_from_storage if kind == "<" else _from_yaml)(path, text)


def _check_length(path: Path, text: str, most: int, kind: str) -> None:
    if len(text) > most:
        raise CameraFileError(path, "size", f"must be at most {most >> 10} KiB of {kind}; got {len(text)} characters")


def parse_json(path: Path, text: str) -> Any:
    """Return the value of a JSON text; all numbers are floats."""
    size = text.count(",") + 3 * text.count("[") + 6 * text.count("{") + 5 * text.count(":")
    if size > max(_MOST_JSON_UNITS, len(text) // _BYTES_PER_UNIT):
        raise CameraFileError(path, "content", "must have fewer values; got too many")

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(keys := dict(pairs)) < len(pairs):
            raise ValueError(f"keys must be unique; got {repeated(key for key, _ in pairs)!r:.60} twice")
        return keys

    # parse floats directly: huge integers cost no time, and no text is made of a number
    try:
        return json.loads(text, object_pairs_hook=unique, parse_int=float, parse_constant=float)
    except RecursionError:
        raise CameraFileError(path, "content", "nested too deeply") from None
    except json.JSONDecodeError as error:
        raise CameraFileError(path, f"line {error.lineno}", error.msg) from None
    except ValueError as error:
        raise CameraFileError(path, "content", error) from None


def plain(value: Any) -> Any:
    """Return keys and values as a parser of JSON gives them; YAML, NumPy and configurations have others."""
    kind = type(value)
    if kind is float or kind is str:
        return value
    if kind is int:
        return float(value)
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
            name = entry.filename.removesuffix(".npy")
            array = None
            if entry.file_size <= largest:
                with archive.open(entry) as file, contextlib.suppress(ValueError, MemoryError):
                    array = np.lib.format.read_array(file, allow_pickle=False)
            arrays[name] = array if array is not None and array.dtype.kind in "fiub" else None
    return arrays


def _from_archive(path: Path, content: bytes) -> dict[str, Any]:
    """Return the keys of an archive, arrays as lists; refuse damaged ones, and sizes whose order is unknown."""
    try:
        arrays = arrays_of(content, _LARGEST_ARRAY)
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError, NotImplementedError) as error:
        raise CameraFileError(path, "content", f"must be an archive of numpy.savez; got a bad one: {error}") from None
    keys = {name: None if array is None else array.astype(np.float64).tolist() for name, array in arrays.items()}
    for name, value in keys.items():
        if name.lower() in _SIZES and isinstance(value, list) and len(value) == 2 and value[0] != value[1]:
            either = f"got {value[0]:g} {value[1]:g}, (width, height) or (height, width)"
            raise CameraFileError(path, name, f"its order must be known; {either}. Save image_width and image_height")
    return keys


# -- XML: OpenCV has keys in <opencv_storage>, and sequences as words or as elements called _


def parse_xml(path: Path, text: str) -> ElementTree.Element:
    """Return the root of an XML text; document types, entities and very many elements are refused."""
    if declared := re.search(r"<!(?:DOCTYPE|ENTITY|ELEMENT|ATTLIST|NOTATION)", text, re.IGNORECASE):
        line = text.count("\n", 0, declared.start()) + 1
        raise CameraFileError(path, f"line {line}", "must have no document type, which could define entities; got one")
    if text.count("=") + text.count("<") > max(_FEW_NODES, len(text) // _BYTES_PER_NODE):
        raise CameraFileError(path, "content", "must have fewer elements; got too many")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        reason = str(error).split(":")[0]
        raise CameraFileError(path, f"line {error.position[0]}", f"must be XML; got {reason}") from None
    except (ValueError, LookupError) as error:
        raise CameraFileError(path, "content", error) from None


def _from_storage(path: Path, text: str) -> Any:
    _check_length(path, text, _LARGEST_STORAGE, "XML")
    root = parse_xml(path, text)
    if root.tag == "lensdatabase":
        raise CameraFileError(path, "content", "must not be of lensfun; got its database. Use ct.lenses.from_lensfun")
    if root.tag != "opencv_storage":
        where = "must be XML of OpenCV, <opencv_storage>"
        raise CameraFileError(path, "content", f"{where}; got <{root.tag:.60}>")
    return _keys_of(path, root)


def _keys_of(path: Path, element: ElementTree.Element) -> dict[str, Any]:
    if (twice := repeated(child.tag for child in element)) is not None:
        raise CameraFileError(path, f"{element.tag:.60}", f"keys must be unique; got {twice!r:.60} twice")
    return {child.tag: _value_of(path, child) for child in element}


def _value_of(path: Path, element: ElementTree.Element) -> Any:
    if any(child.tag != "_" for child in element):
        return _keys_of(path, element)
    words = [word[1] or word[2] or "" for word in _WORD.finditer(element.text or "")]
    if len(element) or len(words) != 1 or element.tag == "data":
        return words + [_value_of(path, child) for child in element]
    return words[0]


def _from_yaml(path: Path, text: str) -> Any:
    import yaml  # the import takes 0.02 s

    _check_length(path, text, _LARGEST_STORAGE, "YAML")
    text = re.sub(r"\A(\s*)%YAML[^\r\n]*", r"\1", text)  # "%YAML:1.0", as OpenCV writes it, is not YAML
    if "\n%" in text:  # libyaml compares all pairs of directives
        raise CameraFileError(path, "content", "must have no YAML directives; got one")
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        # parse events, not yaml.load: no tags, and no numbers by the rules of YAML 1.1
        return _Yaml(path, yaml.parse(text, loader)).document()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "no reason given"
        where = f"line {mark.line + 1}" if mark else "content"
        raise CameraFileError(path, where, f"must be YAML; got an error: {reason}") from None
    except (ValueError, OverflowError) as error:
        raise error if isinstance(error, CameraFileError) else CameraFileError(path, "content", error) from None


class _Yaml:
    """Text, lists and mappings from the events of a YAML parser."""

    def __init__(self, path: Path, events: Iterable[Any]):
        self.path, self.events = path, iter(events)
        self.anchors: dict[str, tuple[Any, int]] = {}

    def fail(self, event: Any, reason: str) -> NoReturn:
        raise CameraFileError(self.path, f"line {event.start_mark.line + 1}", reason) from None

    def document(self) -> Any:
        """Return the first document; a second one must be empty: rostopic ends a message with ---."""
        value, count = None, 0
        for event in self.events:
            kind = type(event).__name__
            count += kind == "DocumentStartEvent"
            if kind in _TAGS and count == 1:
                value, _ = self.value(event, 0)
            elif count > 2 or (kind in _TAGS and getattr(event, "value", None) != ""):
                self.fail(event, "must have one document; got a second one")
        return value

    def value(self, event: Any, depth: int) -> tuple[Any, int]:
        """Return the value that begins with an event, and how many values it has, those behind aliases included."""
        kind = type(event).__name__
        if kind == "AliasEvent":
            return self.anchors.get(event.anchor) or self.fail(event, f"alias must be known; got {event.anchor!r:.60}")
        if event.tag not in _TAGS[kind]:
            self.fail(event, f"tags must be of keys and values, as nothing is constructed here; got {event.tag!r:.80}")
        found = (event.value, 1) if kind == "ScalarEvent" else self.container(event, kind == "MappingStartEvent", depth)
        if event.anchor:
            self.anchors[event.anchor] = found
        return found

    def container(self, start: Any, is_mapping: bool, depth: int) -> tuple[Any, int]:
        """Return a list or mapping and its count of values; `value` sets its anchor last, so it never holds itself."""
        if depth >= _DEEPEST:
            self.fail(start, "nested too deeply")
        values, keys, count = list[Any](), dict[str, Any](), 1
        for event in self.events:
            if type(event).__name__ in ("SequenceEndEvent", "MappingEndEvent"):
                break
            value, size = self.value(event, depth + 1)
            count += size
            if not is_mapping:
                values.append(value)
            elif not isinstance(value, str):
                self.fail(event, "a key must be text; got a list or a mapping")
            elif value in keys:
                self.fail(event, f"keys must be unique; got {value!r:.60} twice")
            else:
                keys[value], size = self.value(next(self.events), depth + 1)
                count += size
            if count > _MOST_VALUES:
                self.fail(event, f"must have at most {_MOST_VALUES} values; got more")
        return keys if is_mapping else values, count


_TAG = "tag:yaml.org,2002:{}".format
# event that begins a value -> the tags that it may have
_TAGS: dict[str, tuple[str | None, ...]] = {
    "ScalarEvent": (None, "!", _TAG("str")),
    "AliasEvent": (),
    "SequenceStartEvent": (None, "!", _TAG("seq")),
    "MappingStartEvent": (None, "!", _TAG("map"), _TAG("opencv-matrix"), _TAG("opencv-nd-matrix")),
}
