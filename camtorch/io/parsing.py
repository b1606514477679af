"""Contents of files as keys and values: YAML, JSON, OpenCV's XML, Python literals and NumPy archives, never trusted.

A file that is refused, whatever it holds, has cost at most a second for 10 MB and ten times its size in memory.
"""

from __future__ import annotations

import ast
import json
import os
import re
from collections.abc import Callable
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
_MOST_TOKENS = 1 << 18  # of a Python literal
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


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """The content of a file that is not suspiciously large.

    Raises:
        CameraFileError: no ordinary file, nothing in it, over 16 MiB. OSError: it cannot be opened.
    """
    check_ordinary(path)
    with open(path, "rb") as file:
        content = file.read(LARGEST_FILE + 1)
    if len(content) > LARGEST_FILE:
        raise CameraFileError(path, "size", f"more than {LARGEST_FILE >> 20} MiB")
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


def read_mapping(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The keys of a file. Values are text, lists and mappings: numbers stay text until someone asks, but for JSON's.

    Raises:
        CameraFileError: nothing known, a key twice, tags other than `!!opencv-matrix`, no mapping, too large.
        OSError: the file cannot be opened.
    """
    return parse_mapping(path, read_bytes(path))


def parse_mapping(path: str | os.PathLike[str], content: bytes) -> dict[str, Any]:
    """The keys of a content, as `read_mapping`; `path` is for the errors."""
    try:
        keys = parse_archive(path, content) if content.startswith(b"PK\3\4") else _from_text(path, content)
    except RecursionError:
        raise CameraFileError(path, "content", "nested too deeply") from None
    if not isinstance(keys, dict):
        raise CameraFileError(path, "content", "not keys and values")
    return keys


def _from_text(path: str | os.PathLike[str], content: bytes) -> Any:
    text = decoded(path, content)
    first = next(re.finditer(r"\S", text), None)
    if _is_literal(text):
        return _from_literal(path, text)
    if first and first[0] == "{":
        return _from_json(path, text)
    if first and first[0] == "<":
        return parse_storage(path, content)
    return _from_yaml(path, text)


# -- JSON


def _from_json(path: str | os.PathLike[str], text: str) -> Any:
    _check_count(path, text)
    # floats at once: no text is made of a number, and integers of any length are no work
    options: dict[str, Any] = {"parse_int": float, "parse_constant": float}
    try:
        return json.loads(text, object_pairs_hook=_unique, **options)
    except json.JSONDecodeError as error:
        raise CameraFileError(path, f"line {error.lineno}", error.msg) from None
    except ValueError as error:
        raise CameraFileError(path, "content", error) from None


def _check_count(path: str | os.PathLike[str], text: str) -> None:
    """Refuse more values than are worth their memory."""
    size = text.count(",") + 3 * text.count("[") + 6 * text.count("{") + 5 * text.count(":")
    if size > max(_MOST_JSON_UNITS, len(text) // _BYTES_PER_UNIT):
        raise CameraFileError(path, "content", "too many values")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = dict(pairs)
    if len(keys) < len(pairs):
        raise ValueError(f"the key {repeated(key for key, _ in pairs)!r:.60} stands there twice")
    return keys


# -- Python literals, as mrcal writes them


_TOKEN = re.compile(
    r"""(?P<mark>[][{}(),:])|b?'(?P<text>[^'\\\n]*(?:\\.[^'\\\n]*){0,999})'"""
    r"""|b?"(?P<quoted>[^"\\\n]*(?:\\.[^"\\\n]*){0,999})"|(?P<comment>\#[^\n]*)|(?P<word>[^][\s{}(),:'"#]+)"""
)


_as_json_text = json.JSONEncoder(ensure_ascii=False).encode


def _is_literal(text: str) -> bool:
    """Whether this is the start of one: a brace, perhaps after comments, and a key in quotes unlike JSON's."""
    # Python's regular expressions remember every repetition of a group
    start = re.sub(r"#[^\n]*", "", text[:_START]).split()[:2]
    return re.match(r"\{(?:'|\"(?:lens_?model|distortion_model)\")", "".join(start)) is not None


def _from_literal(path: str | os.PathLike[str], text: str) -> Any:
    """Texts, numbers, lists, tuples and mappings, written as JSON line by line; numbers and other words as texts.

    `ast.literal_eval` takes seconds for 2 MB of additions and passes over keys that stand there twice.
    """
    _check_count(path, text)
    comma = ""  # that has been read: JSON has none before a closing bracket

    def as_json(token: re.Match[str]) -> str:
        nonlocal comma
        kind, value = str(token.lastgroup), token[0]
        if kind == "comment":
            return ""
        before = "" if value in ("]", "}", ")") else comma
        comma = "," if value == "," else ""
        if kind == "mark":
            return before + {",": "", "(": "[", ")": "]"}.get(value, value)
        content: str | bytes = token[kind]
        if "\\" in token[kind]:
            try:
                content = ast.literal_eval(value)
            except (SyntaxError, ValueError):
                return before + value  # which JSON refuses, at its line
        content = content.decode("latin-1") if isinstance(content, bytes) else content
        return before + _as_json_text(content)

    text, count = _TOKEN.subn(as_json, text, _MOST_TOKENS)
    if count == _MOST_TOKENS:
        raise CameraFileError(path, "content", "too many values")
    return _from_json(path, text)


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
    event: Any = None
    tree = Tree(path, lambda: f"line {event.start_mark.line + 1}")
    try:
        # events, not yaml.load: no recursion, no tags, and none of YAML 1.1's ideas of what is a number
        for event in yaml.parse(text, loader or yaml.SafeLoader):
            _take(yaml, tree, event)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "not YAML"
        raise CameraFileError(path, f"line {mark.line + 1}" if mark else "content", reason) from None
    except (ValueError, OverflowError) as error:
        if isinstance(error, CameraFileError):
            raise
        raise CameraFileError(path, "content", error) from None
    return tree.root


def _take(yaml: Any, tree: Tree, event: Any) -> None:
    if tree.documents > 1 and isinstance(event, yaml.NodeEvent):
        # rostopic ends a message with ---, which begins an empty document
        if not isinstance(event, yaml.ScalarEvent) or event.value:
            tree.fail("a second document in the file")
    elif isinstance(event, yaml.ScalarEvent):
        _check_tag(tree, event, ("str",))
        tree.add(event.value, event.anchor)
    elif isinstance(event, yaml.SequenceStartEvent):
        _check_tag(tree, event, ("seq",))
        tree.open([], event.anchor)
    elif isinstance(event, yaml.MappingStartEvent):
        _check_tag(tree, event, ("map", "opencv-matrix", "opencv-nd-matrix"))
        tree.open({}, event.anchor)
    elif isinstance(event, (yaml.SequenceEndEvent, yaml.MappingEndEvent)):
        tree.close()
    elif isinstance(event, yaml.AliasEvent):
        tree.alias(event.anchor)
    elif isinstance(event, yaml.DocumentStartEvent):
        tree.documents += 1
        if tree.documents > 2:
            tree.fail("a third document in the file")


def _check_tag(tree: Tree, event: Any, names: tuple[str, ...]) -> None:
    if event.tag is None or event.tag == "!" or event.tag in [f"tag:yaml.org,2002:{name}" for name in names]:
        return
    if event.tag == "tag:yaml.org,2002:opencv-matrix":
        tree.fail("expected keys and values after !!opencv-matrix")
    tree.fail(f"could not determine a constructor for the tag {event.tag!r:.80}: nothing is constructed here")


class Tree:
    """Lists and mappings, built from the outside in by a parser that has no recursion.

    Args:
        path: the file, for the errors.
        place: says where in it the parser is, for the errors.
    """

    path: str | os.PathLike[str]
    place: Callable[[], str]

    def __init__(self, path: str | os.PathLike[str], place: Callable[[], str]):
        self.path, self.place = path, place
        self.root: Any = None
        self._open: list[list[Any]] = []  # container, key that waits for its value, anchor, how many values
        self._anchors: dict[str, tuple[Any, int]] = {}
        self._count = self.documents = 0

    def fail(self, reason: object) -> NoReturn:
        """Raise the CameraFileError of this place."""
        raise CameraFileError(self.path, self.place(), reason) from None

    def open(self, container: list[Any] | dict[Any, Any], anchor: str | None = None) -> None:
        """Begin a list or a mapping."""
        if len(self._open) >= _DEEPEST:
            raise CameraFileError(self.path, "content", "nested too deeply")
        if self._open and isinstance(self._open[-1][0], dict) and self._open[-1][1] is None:
            self.fail("a key that is no text")
        if anchor:
            self._anchors[anchor] = (None, 0)
        self._open.append([container, None, anchor, 1])

    def close(self) -> None:
        """End it."""
        container, key, anchor, count = self._open.pop()
        if key is not None:
            self.fail(f"the key {key!r:.60} has no value")
        self._put(container, count, anchor)

    def add(self, value: Any, anchor: str | None = None) -> None:
        """A text, which in a mapping is a key and a value in turn."""
        self._put(value, 1, anchor)

    def alias(self, anchor: str) -> None:
        """The value that has that name, by reference."""
        if anchor not in self._anchors:
            self.fail(f"nothing is called {anchor!r:.60}")
        value, count = self._anchors[anchor]
        if value is None:
            self.fail("a recursive value")
        self._put(value, count, None)

    def _put(self, value: Any, count: int, anchor: str | None) -> None:
        self._count += 1
        if self._count > _MOST_VALUES:
            self.fail(f"too many values: more than {_MOST_VALUES} are not read")
        if anchor:
            self._anchors[anchor] = (value, count)
        if not self._open:
            self.root = value
            return
        top = self._open[-1]
        top[3] += count
        if top[3] > _MOST_VALUES:  # an alias costs nothing here, but whoever walks through it pays
            self.fail(f"too many values: more than {_MOST_VALUES} are not read")
        container, key = top[:2]
        if isinstance(container, list):
            container.append(value)
        elif key is None:
            if not isinstance(value, str):
                self.fail("a key that is no text")
            if value in container:
                self.fail(f"the key {value!r:.60} stands there twice")
            top[1] = value
        else:
            container[key], top[1] = value, None
