"""Write `structs.py`, the structures, enumerators and calls of the C headers: `python -m camtorch.native.headers`.

The build, which needs no package, runs this file for the text by which the library computes its own checksum.
"""

from __future__ import annotations

import keyword
import re
import zlib
from pathlib import Path
from typing import NamedTuple

_HERE = Path(__file__).resolve().parent
# of each type of a field: its size, its type in ctypes and that of its values
_TYPES = {
    "*": (8, "c_void_p", "int | None"),
    "int64_t": (8, "c_int64", "int"),
    "int32_t": (4, "c_int32", "int"),
    "double": (8, "c_double", "float"),
}
# of what calls return and take: its type in ctypes, and that of its values
_GIVEN = {"int64_t": ("c_int64", "int"), "double*": ("c_void_p", "int"), "char*": ("c_char_p", "bytes")}
_RESULTS = _GIVEN | {"int32_t": ("c_int32", "int"), "unsigned": ("c_uint32", "int"), "void": ("None", "None")}
_STRUCT = re.compile(r"\benum\s*\{(?P<values>[^}]*)\}|typedef struct \{(?P<fields>[^}]*)\}\s*(?P<name>\w+);")
_NAME = re.compile(r"(\*?)\s*(\w+)(?:\[(.*)\])?")
_CALL = re.compile(r"^EXPORTED (\w+|const char \*) ?(camtorch_[a-z]\w*)\((.*)\) \{", re.M)


class Field(NamedTuple):
    """A field of a structure: its type in C, or "*"; how many there are, 0 for one that is no array; its place."""

    name: str
    kind: str
    many: int
    offset: int
    size: int


class Headers(NamedTuple):
    """What Python shares with the C files: the fields of structures; each call's result and types; enumerators."""

    structs: dict[str, list[Field]]
    sizes: dict[str, int]
    calls: dict[str, tuple[str, list[str]]]
    values: dict[str, int]
    files: dict[str, str]  # of each structure

    @property
    def checksum(self) -> int:
        """The checksum of all names, types and values, from which the library's own goes on."""
        return zlib.crc32(repr(self[:4]).encode())

    @property
    def layout(self) -> int:
        """What `camtorch_layout()` of a library of these headers returns."""
        total = self.checksum
        for name, fields in self.structs.items():
            for number in (self.sizes[name], *(n for field in fields for n in (field.offset, field.size))):
                total = (total ^ number) * 16777619 & 0xFFFFFFFF
        return total


def read(folder: Path = _HERE) -> Headers:
    """Read the headers that `dispatch.c` includes, and its calls."""
    found = Headers({}, {}, {}, {}, {})
    text, seen = (folder / "dispatch.c").read_text("utf-8"), set[str]()
    _follow(folder, text, seen, found)
    for result, name, given in re.findall(r"\bENTRY\((\w+), (\w+), (.*?)\)", text):
        found.calls[f"camtorch_{name}"] = result, [given]
    for result, name, given in _CALL.findall(text):
        found.calls[name] = result, [] if given == "void" else given.split(",")
    for name, (result, given) in found.calls.items():
        words = [re.sub(r"\bconst\b|\s", "", re.sub(r"\b\w+$", "", one) if one[-1] != "*" else one) for one in given]
        found.calls[name] = re.sub(r"\bconst\b|\s", "", result), words
    return found


def _follow(folder: Path, text: str, seen: set[str], found: Headers) -> None:
    for name in re.findall(r'^#include "(.*)"', text, re.M):
        if name not in seen:
            seen.add(name)
            header = re.sub(r"/\*.*?\*/", "", (folder / name).read_text("utf-8"), flags=re.S)
            _follow(folder, header, seen, found)
            for match in _STRUCT.finditer(header):
                if match["name"]:
                    _add_struct(name, match["name"], match["fields"], found)
                else:
                    _add_values(match["values"], found)


def _add_values(text: str, found: Headers) -> None:
    following = 0
    for name, _, value in (entry.partition("=") for entry in text.split(",") if entry.strip()):
        found.values[name.strip()] = following = eval(value, {}, found.values) if value else following
        following += 1


def _add_struct(file: str, name: str, text: str, found: Headers) -> None:
    fields, end = list[Field](), 0
    for line in filter(None, map(str.strip, text.split(";"))):
        kind, names = line.removeprefix("const ").split(maxsplit=1)
        for star, field, many in (_NAME.fullmatch(one.strip()).groups() for one in names.split(",")):  # type: ignore[union-attr]
            kind_of = star or kind
            if kind_of in _TYPES:
                size = step = _TYPES[kind_of][0]
            elif kind_of in found.sizes:
                size, step = found.sizes[kind_of], 8
            else:
                raise ValueError(
                    f"{file}: the type of {name}.{field} must be one of {[*_TYPES]} or a struct; got {kind}"
                )
            count = int(eval(many, {}, found.values)) if many else 0
            offset, size = -(-end // step) * step, size * max(count, 1)
            fields.append(Field(field + "_" * keyword.iskeyword(field), kind_of, count, offset, size))
            end = offset + size
    found.structs[name], found.sizes[name], found.files[name] = fields, -(-end // 8) * 8, file


def layout_h(folder: Path = _HERE) -> str:
    """Return `layout.h`, which the build makes: where the compiler puts what Python finds by its place."""
    found = read(folder)
    numbers = list[str]()
    for name, fields in found.structs.items():
        numbers.append(f"sizeof({name})")
        for field in fields:
            own = field.name.removesuffix("_")
            numbers += [f"offsetof({name}, {own})", f"sizeof((({name} *)0)->{own})"]
    return f"#define LAYOUT {found.checksum}u\n#define OFFSETS {', '.join(numbers) or 0}\n"


def structs_py(folder: Path = _HERE) -> str:
    """Return the text of `structs.py`."""
    found = read(folder)
    lines = [
        '"""The structures, enumerators and calls of the C files: `python -m camtorch.native.headers` writes them."""',
        "",
        "from __future__ import annotations",
        "",
        "from collections.abc import Callable",
        "from ctypes import CDLL, POINTER, c_char_p, c_double, c_int32, c_int64, c_uint32, c_void_p",
        "",
        "from camtorch.native.structure import Numbers, Struct",
        "",
        f"LAYOUT = {found.layout}",
        "",
        *(f"{name} = {value}" for name, value in found.values.items()),
    ]
    for name, fields in found.structs.items():
        lines += ["", "", *_class(name, fields, found)]
    lines += ["", "", *_library(found)]
    return "\n".join(lines) + "\n"


def _class(name: str, fields: list[Field], found: Headers) -> list[str]:
    lines = [f"class {name}(Struct):", f'    """`{name}` of {found.files[name]}."""', "", "    __slots__ = ()"]
    types, lines = dict[str, str](), [*lines, "    _fields_ = ("]
    for field in fields:
        _, kind, value = _TYPES.get(field.kind, (0, field.kind, field.kind))
        lines.append(f'        ("{field.name}", {kind}{f" * {field.many}" if field.many else ""}),')
        types[field.name] = "Numbers" if field.many else value
    return [*lines, "    )", *(f"    {field}: {kind}" for field, kind in types.items())]


def _library(found: Headers) -> list[str]:
    """Return the lines of the library's class: each call with the types that it takes."""
    lines, table = (
        ["class Library(CDLL):", '    """The compiled library; `declare` gives its calls their types."""', ""],
        list[str](),
    )
    for name, (result, given) in found.calls.items():
        kinds = {one: (f"POINTER({one[:-1]})", one[:-1]) for one in given if one[:-1] in found.structs} | _GIVEN
        takes, values = ([kinds[one][i] for one in given] for i in (0, 1))
        of, value = _RESULTS[result]
        lines.append(f"    {name}: Callable[[{', '.join(values)}], {value}]")
        table.append(f'            "{name}": ({of}, [{", ".join(takes)}]),')
    return [
        *lines,
        "",
        "    def declare(self) -> None:",
        '        """Give each call the types of its result and of what it takes."""',
        "        types = {",
        *table,
        "        }",
        "        for name, (result, takes) in types.items():",
        "            call = getattr(self, name)",
        "            call.restype, call.argtypes = result, takes",
    ]


if __name__ == "__main__":
    (_HERE / "structs.py").write_text(structs_py(), "utf-8")
