"""The YAML, JSON and XML that calibration files are written in, read without trusting them."""

from __future__ import annotations

import json
import os
import re
from typing import Any, NoReturn

from camtorch.io._errors import CameraFileError

LARGEST_FILE = 1 << 24
_LARGEST_YAML = 1 << 22
_LARGEST_SLOW_YAML = 1 << 19  # for PyYAML without libyaml
_DEEPEST = 100
_MOST_DIRECTIVES = 100  # libyaml compares each with all
_MOST_JSON_VALUES = 1 << 21
_MOST_VALUES = 1 << 17  # a second of work


def read_bytes(path) -> bytes:
    """The content of a file that is not suspiciously large.

    Raises:
        CameraFileError: no ordinary file, over 16 MiB. OSError: it cannot be opened.
    """
    check_ordinary(path)
    with open(path, "rb") as file:
        content = file.read(LARGEST_FILE + 1)
    if len(content) > LARGEST_FILE:
        raise CameraFileError(path, "size", f"more than {LARGEST_FILE >> 20} MiB")
    return content


def check_ordinary(path) -> None:
    """Refuse devices and pipes, which may have no end.

    Raises:
        CameraFileError: it is one.
    """
    if os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path):
        raise CameraFileError(path, "content", "no ordinary file")


def read_text(path) -> str:
    """The text of a file.

    Raises:
        CameraFileError: it is none, over 16 MiB. OSError: it cannot be opened.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CameraFileError(path, f"byte {error.start}", "not text") from None


def read_mapping(path) -> dict[str, Any]:
    """The keys of a YAML, JSON or XML file. Values are text, lists and mappings: numbers stay text until someone asks.

    Raises:
        CameraFileError: no YAML, JSON or XML, a key twice, tags other than `!!opencv-matrix`, no mapping, too large.
        OSError: the file cannot be opened. ImportError: YAML without PyYAML.
    """
    return parse_mapping(path, read_text(path))


def parse_mapping(path, text: str) -> dict[str, Any]:
    """The keys of a text, as `read_mapping`; `path` is for the errors."""
    start = text.lstrip()[:1]
    parse = _from_json if start == "{" else _from_xml if start == "<" else _from_yaml
    try:
        keys = parse(path, text)
    except RecursionError:
        raise CameraFileError(path, "content", "nested too deeply") from None
    if not isinstance(keys, dict):
        raise CameraFileError(path, "content", "not keys and values")
    return keys


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = dict(pairs)
    if len(keys) < len(pairs):
        names = set()
        twice = next(key for key, _ in pairs if key in names or names.add(key))
        raise ValueError(f"the key {twice!r:.60} stands there twice")
    return keys


def _from_json(path, text: str):
    if sum(map(text.count, "[{,")) > _MOST_JSON_VALUES:
        raise CameraFileError(path, "content", "too many values")
    try:
        return json.loads(text, object_pairs_hook=_unique, parse_int=str, parse_float=str, parse_constant=str)
    except json.JSONDecodeError as error:
        raise CameraFileError(path, f"line {error.lineno}", error.msg) from None
    except ValueError as error:
        raise CameraFileError(path, "content", error) from None


def _from_yaml(path, text: str):
    try:
        import yaml
    except ImportError:
        raise ImportError("reading YAML camera files needs PyYAML: pip install 'camtorch[cli]'") from None
    loader = getattr(yaml, "CSafeLoader", None)
    largest = _LARGEST_SLOW_YAML if loader is None else _LARGEST_YAML
    if len(text) > largest:
        raise CameraFileError(path, "size", f"more than {largest >> 10} KiB of YAML")
    # "%YAML:1.0", as OpenCV writes it, is not YAML
    text = re.sub(r"\A%YAML[^\n]*", "", text)
    if len(re.findall(r"^%", text, re.MULTILINE)) > _MOST_DIRECTIVES:
        raise CameraFileError(path, "content", "too many YAML directives")
    tree = Tree(path)
    try:
        # events, not yaml.load: no recursion, no tags, and none of YAML 1.1's ideas of what is a number
        for event in yaml.parse(text, loader or yaml.SafeLoader):
            tree.place = f"line {event.start_mark.line + 1}"
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


def _take(yaml, tree: Tree, event) -> None:
    if tree.documents > 1 and isinstance(event, yaml.NodeEvent):
        # rostopic ends a message with ---, which begins an empty document
        if not isinstance(event, yaml.ScalarEvent) or event.value:
            tree.fail("a second document in the file")
    elif isinstance(event, yaml.AliasEvent):
        tree.alias(event.anchor)
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
    elif isinstance(event, yaml.DocumentStartEvent):
        tree.documents += 1


def _check_tag(tree: Tree, event, names: tuple[str, ...]) -> None:
    if event.tag is None or event.tag == "!" or event.tag in [f"tag:yaml.org,2002:{name}" for name in names]:
        return
    if event.tag == "tag:yaml.org,2002:opencv-matrix":
        tree.fail("expected keys and values after !!opencv-matrix")
    tree.fail(f"could not determine a constructor for the tag {event.tag!r:.80}: nothing is constructed here")


class Tree:
    """Lists and mappings, built from the outside in by a parser that has no recursion.

    Args:
        path: the file, for the errors.
    """

    def __init__(self, path):
        self.path, self.place = path, "content"
        self.root: Any = None
        self._open: list[list] = []  # container, key that waits for its value, anchor, how many values
        self._anchors: dict[str, tuple[Any, int]] = {}
        self._count = self.documents = 0

    def fail(self, reason: object) -> NoReturn:
        """Raise the CameraFileError of this place."""
        raise CameraFileError(self.path, self.place, reason) from None

    @property
    def waits_for_value(self) -> bool:
        """Whether a key of the innermost mapping has no value yet."""
        return self._open[-1][1] is not None

    def open(self, container: list | dict, anchor: str | None = None) -> None:
        """Begin a list or a mapping."""
        if len(self._open) >= _DEEPEST:
            self.place = "content"
            self.fail("nested too deeply")
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
            self.fail("too many values")
        if anchor:
            self._anchors[anchor] = (value, count)
        if not self._open:
            self.root = value
            return
        top = self._open[-1]
        top[3] += count
        if top[3] > _MOST_VALUES:  # an alias costs nothing here, but whoever walks through it pays
            self.fail("too many values")
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


def _from_xml(path, text: str):
    from camtorch.io.xml import parse_storage

    return parse_storage(path, text)
