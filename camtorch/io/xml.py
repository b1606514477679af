"""OpenCV's XML: a mapping in `<opencv_storage>`, sequences as words or as elements called `_`."""

from __future__ import annotations

import re
from typing import Any
from xml.parsers import expat

from camtorch.io._errors import CameraFileError

_WORD = re.compile(r'"([^"]*)"|(\S+)')
_DEEPEST = 100
_MOST_VALUES = 1 << 18


def parse_storage(path, text: str) -> dict[str, Any]:
    """The keys of an XML text, as `camtorch.io.parsing.parse_mapping`.

    Raises:
        CameraFileError: no XML, a document type or an entity declared, a key twice, nested too deeply.
    """
    if declared := re.search(r"<!(?:DOCTYPE|ENTITY|ELEMENT|ATTLIST|NOTATION)", text, re.IGNORECASE):
        line = text.count("\n", 0, declared.start()) + 1
        raise CameraFileError(path, f"line {line}", "a document type, which could define entities: not read")
    parser = expat.ParserCreate("utf-8")
    elements = _Elements(path, parser)
    parser.StartElementHandler = elements.start
    parser.EndElementHandler = elements.end
    parser.CharacterDataHandler = elements.text
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        raise CameraFileError(path, f"line {error.lineno}", f"not XML: {expat.ErrorString(error.code)}") from None
    except UnicodeEncodeError:
        raise CameraFileError(path, "content", "not XML") from None
    return elements.root


class _Elements:
    """The open elements: name, whether a matrix, text so far, children."""

    def __init__(self, path, parser):
        self.path, self.parser, self.root = path, parser, None
        self.open: list[tuple[str, list[str], list[tuple[str, Any]]]] = []
        self.count = 0

    def fail(self, reason: str):
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
            self.fail("too many values")

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
            if len(set(names)) < len(names):
                seen = set()
                twice = next(key for key in names if key in seen or seen.add(key))
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
