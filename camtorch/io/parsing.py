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
_MOST_JSON_UNITS = 1 << 20  # of 32 bytes, what a number takes in memory
_BYTES_PER_UNIT = 4  # of the file, where there are more
MOST_COMMENTS = 10_000
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
    size = text.count(",") + 3 * text.count("[") + 6 * text.count("{") + 5 * text.count(":")
    if size > max(_MOST_JSON_UNITS, len(text) // _BYTES_PER_UNIT):
        raise CameraFileError(path, "content", "too many values")
    # floats at once: no text is made of a number, and integers of any length are no work
    options: dict[str, Any] = {"parse_int": float, "parse_constant": float}
    try:
        return json.loads(text, object_pairs_hook=_unique, **options)
    except json.JSONDecodeError as error:
        raise CameraFileError(path, f"line {error.lineno}", error.msg) from None
    except ValueError as error:
        raise CameraFileError(path, "content", error) from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = dict(pairs)
    if len(keys) < len(pairs):
        raise ValueError(f"the key {repeated(key for key, _ in pairs)!r:.60} stands there twice")
    return keys


# -- Python literals, as mrcal writes them


_TOKEN = re.compile(
    r"""\s*(?:(?P<mark>[][{}(),:])|b?'(?P<text>[^'\\\n]*(?:\\.[^'\\\n]*){0,999})'|"""
    r"""b?"(?P<quoted>[^"\\\n]*(?:\\.[^"\\\n]*){0,999})"|(?P<comment>\#[^\n]*)"""
    r"""|(?P<word>[^][\s{}(),:'"#]+)|(?P<end>\Z))"""
)
_CLOSING = {"{": "}", "[": "]", "(": ")"}


def _is_literal(text: str) -> bool:
    """Whether this is the start of one: a brace, perhaps after comments, and a key in quotes unlike JSON's."""
    # Python's regular expressions remember every repetition of a group
    start = re.sub(r"#[^\n]*", "", text[:_START]).split()[:2]
    return re.match(r"\{(?:'|\"(?:lens_?model|distortion_model)\")", "".join(start)) is not None


def _from_literal(path: str | os.PathLike[str], text: str) -> Any:
    """Texts, numbers, lists, tuples and mappings."""
    position, comments, expected = 0, 0, "value"
    tree = Tree(path, lambda: f"line {text.count(chr(10), 0, position) + 1}")
    closing: list[str] = []
    while True:
        token = _TOKEN.match(text, position)
        if token is None:
            tree.fail(f"{text[position : position + 40].strip()!r:.40} where a value belongs")
        kind = token.lastgroup or "end"
        value, position = token[kind], token.start(kind)
        if kind == "mark" and value in "]})":
            if not closing or closing[-1] != value or expected == "end":
                tree.fail(f"{value!r} where nothing is to be closed by it")
            closing.pop()
            tree.close()
            expected = "separator" if closing else "end"
        elif kind == "comment":
            comments += 1
            if comments > MOST_COMMENTS:
                tree.fail("too many comments")
        elif kind == "end":
            break
        elif expected == "separator":
            # a mapping takes : and , in turn, which the tree's key tells apart
            if kind != "mark" or value != (":" if tree.waits_for_value else ","):
                tree.fail(f"{value!r:.40} where {':' if tree.waits_for_value else ','!r} belongs")
            expected = "value"
        elif expected == "end" or (kind == "mark" and value in ",:"):
            tree.fail(f"{value!r:.40} does not belong here")
        elif kind == "mark":
            tree.open({} if value == "{" else [])
            closing.append(_CLOSING[value])
        else:
            if "\\" in value:
                try:
                    value = ast.literal_eval(token[0].strip())
                except (SyntaxError, ValueError):
                    tree.fail(f"{value!r:.40} is no text")
            tree.add(value if isinstance(value, str) else value.decode("latin-1"))
            expected = "separator" if closing else "end"
        position = token.end()
    if closing or not isinstance(tree.root, dict):
        tree.fail("ends before its last brace")
    return tree.root


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

    @property
    def waits_for_value(self) -> bool:
        """Whether a key of the innermost mapping has no value yet."""
        return self._open[-1][1] is not None

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
