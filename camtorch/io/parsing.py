"""Contents of files as keys and values: YAML, JSON, OpenCV's XML, Python literals and NumPy archives, never trusted.

A file that is refused, whatever it holds, has cost at most a second for 10 MB and ten times its size in memory.
"""

from __future__ import annotations

import ast
import json
import os
import re
from typing import Any, NoReturn
from xml.etree import ElementTree

from camtorch.io._errors import CameraFileError
from camtorch.io.npz import parse_archive
from camtorch.io.record import repeated

LARGEST_FILE = 1 << 24
_LARGEST_STORAGE = 1 << 20  # of YAML and of OpenCV's XML
_LARGEST_LITERAL = 1 << 15  # of which Python 3.10 can parse any: it crashes on deeper sums than that has room for
_OPTIMIZATION_INPUTS = re.compile(r"('optimization_inputs'\s*:\s*)b'[^'\\\n]*'")  # megabytes, which are not read
_DEEPEST = 100
_MOST_VALUES = 1 << 17
_MOST_JSON_UNITS = 1 << 20  # of 32 bytes, what a number takes in memory
_BYTES_PER_UNIT = 4  # of the file, where there are more
_FEW_NODES = 1 << 14  # elements and attributes of XML
_BYTES_PER_NODE = 16  # of the file, where there are more
_START = 1 << 16  # of a text, where its kind shows
_WORD = re.compile(r'"([^"]*)"|(\S+)')

# how files begin that people pass by mistake
_OTHERS = (
    (rb"\x80[\x02-\x05]", "a pickle, which could run any code: not read. Save numpy.savez(path, K=K, D=D) instead"),
    (rb"\x93NUMPY", "a single array; save both by numpy.savez(path, K=K, D=D)"),
    (rb"\x89HDF", "a file of HDF5 or MATLAB, which is not read; export K and D from there"),
    (rb"\x89PNG|\xff\xd8\xff|II\*\0|MM\0\*", "an image, where a file of a calibration is wanted"),
)


def path_of(path: Any, owner: str, file: str = "file") -> str:
    """What `owner` was given as the path of a kind of file, as text.

    Raises:
        TypeError: it is no path. CameraFileError: it has a NUL character.
    """
    try:
        name = os.fsdecode(path)
    except TypeError:
        hint = "; it may lie beside others, so name it: file.name" if hasattr(path, "read") else ""
        raise TypeError(f"{owner}: path must be that of a {file}; got {type(path).__name__}{hint}") from None
    if "\0" in name:
        raise CameraFileError(repr(name), "path", "a NUL character, which no path has")
    return name


def read_bytes(path: str | os.PathLike[str], largest: int = LARGEST_FILE) -> bytes:
    """The content of a file that is not suspiciously large.

    Raises:
        CameraFileError: no ordinary file, nothing in it, more bytes than `largest`. OSError: it cannot be opened.
    """
    check_ordinary(path)
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > largest:
            raise CameraFileError(path, "size", f"more than {largest >> 20} MiB")
        content = file.read(size)
    if not content:
        raise CameraFileError(path, "content", "the file is empty")
    return content


def check_ordinary(path: str | os.PathLike[str]) -> None:
    """Refuse devices and pipes, which may have no end.

    Raises:
        CameraFileError: it is one.
    """
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        raise CameraFileError(path, "content", "no ordinary file")


def decoded(path: str | os.PathLike[str], content: bytes) -> str:
    """The text of a content.

    Raises:
        CameraFileError: it is none.
    """
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        reason = next((reason for start, reason in _OTHERS if re.match(start, content)), "not text")
        raise CameraFileError(path, f"byte {error.start}", reason) from None


def parse_mapping(path: str | os.PathLike[str], content: bytes) -> dict[str, Any]:
    """The keys of a content. Values are text, lists and mappings: numbers stay text until someone asks, but for JSON's.

    Raises:
        CameraFileError: nothing known, a key twice, tags other than `!!opencv-matrix`, no mapping, too large.
    """
    try:
        keys = parse_archive(path, content) if content.startswith(b"PK\3\4") else _from_text(path, content)
    except (RecursionError, MemoryError):
        raise CameraFileError(path, "content", "nested too deeply") from None
    if not isinstance(keys, dict):
        raise CameraFileError(path, "content", "not keys and values")
    return keys


def _from_text(path: str | os.PathLike[str], content: bytes) -> Any:
    text = decoded(path, content)
    if _is_literal(text):
        return _from_literal(path, text)
    if re.match(r"\s*\{", text):
        return parse_json(path, text)
    if re.match(r"\s*<", text):
        return _from_storage(path, text)
    return _from_yaml(path, text)


def _check_length(path: str | os.PathLike[str], text: str, most: int, kind: str) -> None:
    if len(text) > most:
        raise CameraFileError(path, "size", f"more than {most >> 10} KiB of {kind}")


# -- JSON


def parse_json(path: str | os.PathLike[str], text: str) -> Any:
    """The value of a text of JSON, all numbers floats.

    Raises:
        CameraFileError: no JSON, a key twice, more values than are worth their memory. RecursionError: nested deeply.
    """
    size = text.count(",") + 3 * text.count("[") + 6 * text.count("{") + 5 * text.count(":")
    if size > max(_MOST_JSON_UNITS, len(text) // _BYTES_PER_UNIT):
        raise CameraFileError(path, "content", "too many values")

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = dict(pairs)
        if len(keys) < len(pairs):
            raise ValueError(f"the key {repeated(key for key, _ in pairs)!r:.60} stands there twice")
        return keys

    # floats at once: no text is made of a number, and integers of any length are no work
    options: dict[str, Any] = {"parse_int": float, "parse_constant": float}
    try:
        return json.loads(text, object_pairs_hook=unique, **options)
    except json.JSONDecodeError as error:
        raise CameraFileError(path, f"line {error.lineno}", error.msg) from None
    except ValueError as error:
        raise CameraFileError(path, "content", error) from None


# -- Python literals, as mrcal writes them


def _is_literal(text: str) -> bool:
    """Whether this is the start of one: a brace, perhaps after comments, and a key in quotes unlike JSON's."""
    # Python's regular expressions remember every repetition of a group
    start = re.sub(r"#[^\n]*", "", text[:_START]).split()[:2]
    return re.match(r"\{(?:'|\"(?:lens_?model|distortion_model)\")", "".join(start)) is not None


def _from_literal(path: str | os.PathLike[str], text: str) -> Any:
    text = _OPTIMIZATION_INPUTS.sub(r"\1''", text)
    _check_length(path, text, _LARGEST_LITERAL, "a Python literal")
    try:
        return _with_floats(ast.literal_eval(ast.parse(text, mode="eval")))
    except SyntaxError as error:
        raise CameraFileError(path, f"line {error.lineno}" if error.lineno else "content", error.msg) from None
    except (ValueError, TypeError):  # a list has no hash, as a key has
        raise CameraFileError(path, "content", "something else than texts, numbers, lists and mappings") from None


def _with_floats(value: Any) -> Any:
    """A literal as JSON has it."""
    if isinstance(value, dict):
        return {str(key): _with_floats(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return list(map(_with_floats, value))
    return float(value) if type(value) is int else value


# -- XML, in which OpenCV has keys in <opencv_storage>, and sequences as words or as elements called _


def parse_xml(path: str | os.PathLike[str], text: str) -> ElementTree.Element:
    """The root of a text of XML.

    Raises:
        CameraFileError: no XML, a document type or an entity declared, more elements than are worth their memory.
    """
    if declared := re.search(r"<!(?:DOCTYPE|ENTITY|ELEMENT|ATTLIST|NOTATION)", text, re.IGNORECASE):
        line = text.count("\n", 0, declared.start()) + 1
        raise CameraFileError(path, f"line {line}", "a document type, which could define entities: not read")
    if text.count("=") + text.count("<") > max(_FEW_NODES, len(text) // _BYTES_PER_NODE):
        raise CameraFileError(path, "content", "too many elements")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        reason = str(error).split(":")[0]
        raise CameraFileError(path, f"line {error.position[0]}", f"not XML: {reason}") from None
    except (ValueError, LookupError) as error:
        raise CameraFileError(path, "content", error) from None


def _from_storage(path: str | os.PathLike[str], text: str) -> Any:
    _check_length(path, text, _LARGEST_STORAGE, "XML")
    root = parse_xml(path, text)
    if root.tag == "lensdatabase":
        raise CameraFileError(path, "content", "lensfun's lenses, which lensfunpy reads, for ct.lenses.from_lensfun")
    if root.tag != "opencv_storage":
        raise CameraFileError(
            path, "content", f"<{root.tag:.60}> where <opencv_storage> belongs: XML is read where OpenCV wrote it"
        )
    return _keys_of(path, root)


def _keys_of(path: str | os.PathLike[str], element: ElementTree.Element) -> dict[str, Any]:
    names = [child.tag for child in element]
    if (twice := repeated(names)) is not None:
        raise CameraFileError(path, f"{element.tag:.60}", f"the key {twice!r:.60} stands there twice")
    return {child.tag: _value_of(path, child) for child in element}


def _value_of(path: str | os.PathLike[str], element: ElementTree.Element) -> Any:
    if any(child.tag != "_" for child in element):
        return _keys_of(path, element)
    words = [word[1] or word[2] or "" for word in _WORD.finditer(element.text or "")]
    if len(element) or len(words) != 1 or element.tag == "data":
        return words + [_value_of(path, child) for child in element]
    return words[0]


# -- YAML


def _from_yaml(path: str | os.PathLike[str], text: str) -> Any:
    import yaml  # a fiftieth of a second: only when needed

    _check_length(path, text, _LARGEST_STORAGE, "YAML")
    text = re.sub(r"\A(\s*)%YAML[^\r\n]*", r"\1", text)  # "%YAML:1.0", as OpenCV writes it, is not YAML
    if "\n%" in text:  # libyaml compares each with all
        raise CameraFileError(path, "content", "YAML directives, which no calibration has")
    tree = _YamlTree(path)
    try:
        # events, not yaml.load: no recursion, no tags, and none of YAML 1.1's ideas of what is a number
        for event in yaml.parse(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
            tree.take(event, type(event).__name__)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "no reason given"
        where = f"line {mark.line + 1}" if mark else "content"
        raise CameraFileError(path, where, f"not readable as YAML: {reason}") from None
    except (ValueError, OverflowError) as error:
        if isinstance(error, CameraFileError):
            raise
        raise CameraFileError(path, "content", error) from None
    return tree.root


class _YamlTree:
    """Lists and mappings, built of the events of a parser."""

    def __init__(self, path: str | os.PathLike[str]):
        self.path = path
        self.line = self.documents = self.count = 0
        self.root: Any = None
        self.open: list[list[Any]] = []  # container, key that waits for its value, anchor, count before it
        self.anchors: dict[str, tuple[Any, int]] = {}  # value, and how many values it is

    def fail(self, reason: object) -> NoReturn:
        raise CameraFileError(self.path, f"line {self.line}", reason) from None

    def take(self, event: Any, kind: str) -> None:
        """The next event, of a class of that name."""
        self.line = event.start_mark.line + 1
        if kind == "DocumentStartEvent":
            self.documents += 1
            if self.documents > 2:
                self.fail("a third document in the file")
        elif self.documents > 1:
            # rostopic ends a message with ---, which begins an empty document
            if getattr(event, "value", "") or kind in ("SequenceStartEvent", "MappingStartEvent", "AliasEvent"):
                self.fail("a second document in the file")
        elif kind == "ScalarEvent":
            self.check_tag(event.tag, "str")
            self.put(event.value, event.anchor, 1)
        elif kind in ("SequenceStartEvent", "MappingStartEvent"):
            is_list = kind == "SequenceStartEvent"
            self.check_tag(event.tag, *(("seq",) if is_list else ("map", "opencv-matrix", "opencv-nd-matrix")))
            if len(self.open) >= _DEEPEST:
                self.fail("nested too deeply")
            if self.open and isinstance(self.open[-1][0], dict) and self.open[-1][1] is None:
                self.fail("a key that is no text")
            self.open.append([[] if is_list else {}, None, event.anchor, self.count])
        elif kind in ("SequenceEndEvent", "MappingEndEvent"):
            container, _, anchor, before = self.open.pop()
            self.put(container, anchor, self.count - before + 1, new=1)
        elif kind == "AliasEvent":
            value, size = self.anchors.get(event.anchor) or self.fail(f"nothing is called {event.anchor!r:.60}")
            self.put(value, None, size)

    def check_tag(self, tag: str | None, *names: str) -> None:
        if tag not in (None, "!", *(f"tag:yaml.org,2002:{name}" for name in names)):
            if tag == "tag:yaml.org,2002:opencv-matrix":
                self.fail("expected keys and values after !!opencv-matrix")
            self.fail(f"could not determine a constructor for the tag {tag!r:.80}: nothing is constructed here")

    def put(self, value: Any, anchor: str | None, size: int, new: int | None = None) -> None:
        """A value of so many values, which in a mapping is a key or what belongs to it."""
        self.count += size if new is None else new  # an alias costs nothing here, but whoever walks through it pays
        if self.count > _MOST_VALUES:
            self.fail(f"too many values: more than {_MOST_VALUES} are not read")
        if anchor:
            self.anchors[anchor] = (value, size)
        if not self.open:
            self.root = value
            return
        top = self.open[-1]
        container, key = top[:2]
        if isinstance(container, list):
            container.append(value)
        elif key is not None:
            container[key], top[1] = value, None
        elif not isinstance(value, str):
            self.fail("a key that is no text")
        elif value in container:
            self.fail(f"the key {value!r:.60} stands there twice")
        else:
            top[1] = value
