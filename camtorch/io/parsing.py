"""Contents of files as keys and values: YAML, JSON, OpenCV's XML, Python literals and NumPy archives, never trusted.

A file that is refused, whatever it holds, has cost at most a second for 10 MB and ten times its size in memory.
"""

from __future__ import annotations

import ast
import json
import os
import re
from typing import Any, NoReturn

from camtorch.io._errors import CameraFileError
from camtorch.io.filestorage import parse_storage
from camtorch.io.npz import parse_archive
from camtorch.io.record import repeated

LARGEST_FILE = 1 << 24
_LARGEST_YAML = 1 << 22
_LARGEST_SLOW_YAML = 1 << 19  # for PyYAML without libyaml
_DEEPEST = 100
_MOST_DIRECTIVES = 100  # libyaml compares each with all
_MOST_VALUES = 1 << 17
_LARGEST_LITERAL = 1 << 15  # of which Python 3.10 can parse any: it crashes on deeper sums than that has room for
_OPTIMIZATION_INPUTS = re.compile(r"('optimization_inputs'\s*:\s*)b'[^'\\\n]*'")  # megabytes, which are not read
_MOST_JSON_UNITS = 1 << 20  # of 32 bytes, what a number takes in memory
_BYTES_PER_UNIT = 4  # of the file, where there are more
_START = 1 << 16  # of a text, where its kind shows

# how files begin that people pass by mistake
_OTHERS = (
    (rb"\x80[\x02-\x05]", "a pickle, which could run any code: not read. Save numpy.savez(path, K=K, D=D) instead"),
    (rb"\x93NUMPY", "a single array; save both by numpy.savez(path, K=K, D=D)"),
    (rb"\x89HDF", "a file of HDF5 or MATLAB, which is not read; export K and D from there"),
    (rb"\x89PNG|\xff\xd8\xff|II\*\0|MM\0\*", "an image; a calibration is read here"),
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
        return parse_storage(path, content)
    return _from_yaml(path, text)


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
    """Texts, numbers, lists, tuples and mappings."""
    text = _OPTIMIZATION_INPUTS.sub(r"\1''", text)
    if len(text) > _LARGEST_LITERAL:
        raise CameraFileError(path, "size", f"more than {_LARGEST_LITERAL >> 10} KiB of a Python literal")
    try:
        return _value_of(path, ast.parse(text, mode="eval").body)
    except SyntaxError as error:
        raise CameraFileError(path, f"line {error.lineno}", error.msg) from None


def _value_of(path: str | os.PathLike[str], node: ast.expr) -> Any:
    """A node as JSON has it. `ast.literal_eval` alone passes over keys that stand there twice."""
    if isinstance(node, (ast.List, ast.Tuple)):
        return [_value_of(path, item) for item in node.elts]
    if isinstance(node, ast.Dict):
        keys: list[Any] = [key and _value_of(path, key) for key in node.keys]
        if not all(isinstance(key, str) for key in keys):
            raise CameraFileError(path, f"line {node.lineno}", "a key that is no text")
        if (twice := repeated(keys)) is not None:
            raise CameraFileError(path, f"line {node.lineno}", f"the key {twice!r:.60} stands there twice")
        return dict(zip(keys, [_value_of(path, value) for value in node.values], strict=True))
    try:
        value = ast.literal_eval(node)
    except ValueError:
        raise CameraFileError(path, f"line {node.lineno}", "no text, number, list or mapping") from None
    if isinstance(value, bytes):
        return value.decode("latin-1")
    return float(value) if type(value) is int else value


# -- YAML


def _from_yaml(path: str | os.PathLike[str], text: str) -> Any:
    import yaml  # a fiftieth of a second: only when needed

    loader = getattr(yaml, "CSafeLoader", None)
    largest = _LARGEST_SLOW_YAML if loader is None else _LARGEST_YAML
    if len(text) > largest:
        raise CameraFileError(path, "size", f"more than {largest >> 10} KiB of YAML")
    # "%YAML:1.0", as OpenCV writes it, is not YAML
    text = re.sub(r"\A%YAML[^\n]*", "", text)
    if text.count("\n%") > _MOST_DIRECTIVES:
        raise CameraFileError(path, "content", "too many YAML directives")
    tree = _YamlTree(path)
    try:
        # events, not yaml.load: no recursion, no tags, and none of YAML 1.1's ideas of what is a number
        for event in yaml.parse(text, loader or yaml.SafeLoader):
            tree.take(event, type(event).__name__)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "not YAML"
        raise CameraFileError(path, f"line {mark.line + 1}" if mark else "content", reason) from None
    except (ValueError, OverflowError) as error:
        if isinstance(error, CameraFileError):
            raise
        raise CameraFileError(path, "content", error) from None
    return tree.root


class _YamlTree:
    """Lists and mappings, built of the events of a parser."""

    def __init__(self, path: str | os.PathLike[str]):
        self.path = path
        self.line = 0
        self.root: Any = None
        self.open: list[list[Any]] = []  # container, key that waits for its value, anchor, how many values
        self.anchors: dict[str, tuple[Any, int]] = {}
        self.count = self.documents = 0

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
            text = getattr(event, "value", "")
            if text or kind in ("SequenceStartEvent", "MappingStartEvent", "AliasEvent"):
                self.fail("a second document in the file")
        elif kind == "ScalarEvent":
            self.check_tag(event.tag, "str")
            self.put(event.value, 1, event.anchor)
        elif kind in ("SequenceStartEvent", "MappingStartEvent"):
            is_list = kind == "SequenceStartEvent"
            self.check_tag(event.tag, *(("seq",) if is_list else ("map", "opencv-matrix", "opencv-nd-matrix")))
            self.begin([] if is_list else {}, event.anchor)
        elif kind in ("SequenceEndEvent", "MappingEndEvent"):
            container, key, anchor, count = self.open.pop()
            if key is not None:
                self.fail(f"the key {key!r:.60} has no value")
            self.put(container, count, anchor)
        elif kind == "AliasEvent":
            value, count = self.anchors.get(event.anchor) or self.fail(f"nothing is called {event.anchor!r:.60}")
            if value is None:
                self.fail("a recursive value")
            self.put(value, count)

    def check_tag(self, tag: str | None, *names: str) -> None:
        if tag not in (None, "!", *(f"tag:yaml.org,2002:{name}" for name in names)):
            if tag == "tag:yaml.org,2002:opencv-matrix":
                self.fail("expected keys and values after !!opencv-matrix")
            self.fail(f"could not determine a constructor for the tag {tag!r:.80}: nothing is constructed here")

    def begin(self, container: list[Any] | dict[Any, Any], anchor: str | None) -> None:
        if len(self.open) >= _DEEPEST:
            raise CameraFileError(self.path, "content", "nested too deeply")
        if self.open and isinstance(self.open[-1][0], dict) and self.open[-1][1] is None:
            self.fail("a key that is no text")
        if anchor:
            self.anchors[anchor] = (None, 0)
        self.open.append([container, None, anchor, 1])

    def put(self, value: Any, count: int, anchor: str | None = None) -> None:
        """A value of so many values, which in a mapping is a key or what belongs to it."""
        self.count += 1
        top: list[Any] = self.open[-1] if self.open else [None, None, None, 0]
        top[3] += count
        if max(self.count, top[3]) > _MOST_VALUES:  # an alias costs nothing here, but whoever walks through it pays
            self.fail(f"too many values: more than {_MOST_VALUES} are not read")
        if anchor:
            self.anchors[anchor] = (value, count)
        container, key = top[:2]
        if container is None:
            self.root = value
        elif isinstance(container, list):
            container.append(value)
        elif key is not None:
            container[key], top[1] = value, None
        elif not isinstance(value, str):
            self.fail("a key that is no text")
        elif value in container:
            self.fail(f"the key {value!r:.60} stands there twice")
        else:
            top[1] = value
