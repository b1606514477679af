"""The files of a `cv2.FileStorage`: numbers and matrices as YAML, JSON and XML, and XML read."""

from __future__ import annotations

import json
import os
import re
from typing import Any, NoReturn
from xml.parsers import expat

from camtorch.io._errors import CameraFileError
from camtorch.io.record import repeated
from camtorch.io.writing import number, replacing

Value = float | list[list[float]]
"""A number, or the rows of a matrix."""


def text_for(path: str | os.PathLike[str], values: dict[str, Value]) -> str:
    """The text of a file as `cv2.FileStorage` writes it, by its name JSON, XML, or else YAML."""
    yaml, xml, whole = ["%YAML:1.0", "---"], ['<?xml version="1.0"?>', "<opencv_storage>"], dict[str, Any]()
    for key, value in values.items():
        if isinstance(value, (int, float)):
            text = number(value) if isinstance(value, float) else str(value)
            yaml.append(f"{key}: {text}")
            xml.append(f"<{key}>{text}</{key}>")
            whole[key] = value
            continue
        rows, cols, data = len(value), len(value[0]), [v for row in value for v in row]
        yaml += [f"{key}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {cols}", "   dt: d"]
        yaml.append(f"   data: [ {', '.join(map(number, data))} ]")
        xml += [f'<{key} type_id="opencv-matrix">', f"  <rows>{rows}</rows>", f"  <cols>{cols}</cols>", "  <dt>d</dt>"]
        xml += ["  <data>", f"    {' '.join(map(number, data))}</data></{key}>"]
        whole[key] = {"type_id": "opencv-matrix", "rows": rows, "cols": cols, "dt": "d", "data": data}
    suffix = _suffix(path)
    if suffix == ".json":
        return json.dumps(whole, indent=4, allow_nan=False) + "\n"
    return "\n".join([*xml, "</opencv_storage>"] if suffix == ".xml" else yaml) + "\n"


def _suffix(path: str | os.PathLike[str]) -> str:
    return os.path.splitext(os.fspath(path))[1].lower()


def write(path: str | os.PathLike[str], values: dict[str, Value]) -> None:
    """Write a file that `cv2.FileStorage` reads, whole or not at all.

    Raises:
        ValueError: a name that says none of YAML, JSON and XML.
    """
    if _suffix(path) not in (".yml", ".yaml", ".json", ".xml"):
        raise ValueError(f"{os.fspath(path)}: files of OpenCV are called .yml, .json or .xml")
    with replacing(path) as (file,):
        file.write(text_for(path, values).encode())


# -- reading XML: a mapping in <opencv_storage>, sequences as words or as elements called _

_WORD = re.compile(r'"([^"]*)"|(\S+)')
_DEEPEST = 100
_MOST_VALUES = 1 << 17
_MOST_ATTRIBUTES = 1 << 14


def parse_storage(path: str | os.PathLike[str], content: bytes) -> dict[str, Any]:
    """The keys of an XML file in UTF-8, as `camtorch.io.parsing.parse_mapping`.

    Raises:
        CameraFileError: no XML, a document type or an entity declared, a key twice, nested too deeply.
    """
    if declared := re.search(rb"<!(?:DOCTYPE|ENTITY|ELEMENT|ATTLIST|NOTATION)", content, re.IGNORECASE):
        line = content.count(b"\n", 0, declared.start()) + 1
        raise CameraFileError(path, f"line {line}", "a document type, which could define entities: not read")
    if content.count(b"=") > _MOST_ATTRIBUTES:  # which make a mapping of each element before anyone can look
        raise CameraFileError(path, "content", "too many attributes")
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text, parser.buffer_size = True, 1 << 16
    elements = _Elements(path, parser)
    parser.StartElementHandler = elements.start
    parser.EndElementHandler = elements.end
    parser.CharacterDataHandler = elements.text
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise CameraFileError(path, f"line {error.lineno}", f"not XML: {expat.ErrorString(error.code)}") from None
    root: dict[str, Any] = elements.root
    return root


class _Elements:
    """The open elements: name, whether a matrix, text so far, children."""

    def __init__(self, path: str | os.PathLike[str], parser: expat.XMLParserType):
        self.path, self.parser = path, parser
        self.root: Any = None
        self.open: list[tuple[str, list[str], list[tuple[str, Any]]]] = []
        self.count = 0

    def fail(self, reason: str) -> NoReturn:
        raise CameraFileError(self.path, f"line {self.parser.CurrentLineNumber}", reason)

    def start(self, name: str, attributes: dict[str, str]) -> None:
        if len(self.open) >= _DEEPEST:
            self.fail("nested too deeply")
        if not self.open and name != "opencv_storage":
            self.fail(f"<{name:.60}> where <opencv_storage> belongs: XML is read where OpenCV wrote it")
        self.counted(1)
        self.open.append((name, [], []))

    def counted(self, more: int) -> None:
        self.count += more
        if self.count > _MOST_VALUES:
            self.fail(f"too many values: more than {_MOST_VALUES} are not read")

    def text(self, text: str) -> None:
        self.open[-1][1].append(text)

    def end(self, name: str) -> None:
        _, texts, children = self.open.pop()
        words = []
        for word in _WORD.finditer("".join(texts)):
            self.counted(1)
            words.append(word[1] or word[2] or "")
        names = [key for key, _ in children]
        if not self.open or (children and set(names) != {"_"}):
            if words:
                self.fail(f"text between the elements of <{name:.60}>")
            if (twice := repeated(names)) is not None:
                self.fail(f"the key {twice!r:.60} stands there twice")
            value: Any = dict(children)
        elif children or len(words) != 1 or name == "data":
            value = words + [value for _, value in children]
        else:
            value = words[0]
        if self.open:
            self.open[-1][2].append((name, value))
        else:
            self.root = value
