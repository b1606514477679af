"""Write `structs.py`, the structures, numbers and calls of the C files: `python -m camtorch.native.headers`.

The build, which needs no package, runs this file for `layout.h`, by which a library says what it was built with.
"""

import keyword
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

_HERE = Path(__file__).resolve().parent
# types of fields, and of what calls take and return: in structs.py, and in ctypes
_FIELDS = {
    "*": ("Pointer", "c_void_p"),
    "int64_t": ("Int64", "c_int64"),
    "int32_t": ("Int32", "c_int32"),
    "double": ("Double", "c_double"),
}
_GIVEN = {"int64_t": "Int64", "double*": "Pointer", "char*": "Text"}
_RESULTS = _GIVEN | {"int32_t": "Int32", "unsigned": "Unsigned", "void": "Void"}
_DECLARED = re.compile(r"\benum\s*\{([^}]*)\}|typedef struct \{([^}]*)\}\s*(\w+);")
_NUMBERS = re.compile(r"^#define (\w+) ((?:(?:, )?-?\d[\d.e-]*f?)+)$", re.M)
_CALL = re.compile(r"^EXPORTED (?:const )?(\w+ \*?)camtorch_(\w+)\((.*)\) \{|\bENTRY\((\w+), (\w+), (.*?)\)", re.M)
_HEAD = '''"""The structures, numbers and calls of the C files: `python -m camtorch.native.headers` writes them."""

from collections.abc import Callable
from ctypes import c_double, c_int32, c_int64, c_void_p
from typing import Annotated

from camtorch.native.structure import Double, Int32, Int64, Numbers, Pointer, Struct, Text, TypedLibrary, Unsigned, Void
'''


class Shared(NamedTuple):
    """What Python and C share: fields with their type, or "*", and number, 0 if alone; results and types of calls."""

    structs: dict[str, dict[str, tuple[str, int]]]
    enumerations: list[dict[str, Any]]  # and numbers that are alone
    calls: dict[str, tuple[str, list[str]]]

    @property
    def values(self) -> dict[str, Any]:
        return {name: value for one in self.enumerations for name, value in one.items()}

    @property
    def checksum(self) -> int:
        """The checksum of all names, types and values."""
        return zlib.crc32(repr((self.structs, self.values, self.calls)).encode())


def read(folder: Path = _HERE) -> Shared:
    """Read `dispatch.c` and the headers that it includes."""
    found, text = Shared({}, [], {}), (folder / "dispatch.c").read_text("utf-8")
    headers = _included(folder, text, set())
    found.enumerations.extend({name: eval(numbers.replace("f", ""))} for name, numbers in _NUMBERS.findall(headers))
    for values, fields, name in _DECLARED.findall(headers):
        if name:
            found.structs[name] = dict(_fields(name, fields, found))
            continue
        following, enumeration = 0, dict[str, int]()
        for word, _, value in (entry.partition("=") for entry in values.split(",") if entry.strip()):
            following = eval(value, {}, found.values | enumeration) if value else following
            enumeration[word.strip()] = following
            following += 1
        found.enumerations.append(enumeration)
    for groups in _CALL.findall(text):
        result, name, given = groups[:3] if groups[0] else groups[3:]
        takes = ["".join(pair) for pair in re.findall(r"(\w+) (\*?)", given.replace("const ", ""))]
        found.calls[f"camtorch_{name}"] = result.replace(" ", ""), takes
    return found


def _included(folder: Path, text: str, seen: set[str]) -> str:
    """Return the texts of all headers that a text includes, each once and after those that it includes."""
    texts = list[str]()
    for name in re.findall(r'^#include "(.*)"', text, re.M):
        if name not in seen:
            seen.add(name)
            header = re.sub(r" */\*.*?\*/", "", (folder / name).read_text("utf-8"), flags=re.S)
            texts += [_included(folder, header, seen), header]
    return "\n".join(texts)


def _fields(struct: str, text: str, found: Shared) -> Iterator[tuple[str, tuple[str, int]]]:
    for line in filter(None, map(str.strip, text.split(";"))):
        kind, names = line.removeprefix("const ").split(maxsplit=1)
        for star, name, many in re.findall(r"(\*?)\s*(\w+)(?:\[(.*?)\])?", names):
            if not star and kind not in _FIELDS and kind not in found.structs:
                raise ValueError(f"{struct}.{name} must be a pointer, int64_t, int32_t, double or a struct; got {kind}")
            yield name, (star or kind, int(eval(many, {}, found.values)) if many else 0)


def layout_h(folder: Path = _HERE) -> str:
    """Return `layout.h`: the checksum of names and types, and where the compiler puts each field."""
    found, numbers = read(folder), list[str]()
    for struct, fields in found.structs.items():
        places = (f"offsetof({struct}, {name}), sizeof((({struct} *)0)->{name})" for name in fields)
        numbers += [f"sizeof({struct})", *places]
    return f"#define CHECKSUM {found.checksum}u\n#define OFFSETS {', '.join(numbers) or 0}\n"


def structs_py(folder: Path = _HERE) -> str:
    """Return the text of `structs.py`."""
    found = read(folder)
    lines = [_HEAD, f"CHECKSUM = {found.checksum}", ""]
    for enumeration in found.enumerations:
        values = list(enumeration.values())
        counted = len(values) > 1 and values == list(range(len(values)))
        right = f"range({len(values)})" if counted else ", ".join(map(str, values))
        lines.append(f"{', '.join(enumeration)} = {right}")
    for struct, fields in found.structs.items():
        lines += ["", "", f"class {struct}(Struct):", "    __slots__ = ()"]
        for name, (kind, many) in fields.items():
            one, in_c = _FIELDS.get(kind, (kind, kind))
            hint = f"Annotated[Numbers, {in_c} * {many}]" if many else one
            lines.append(f"    {name}{'_' * keyword.iskeyword(name)}: {hint}")
    lines += ["", "", f"STRUCTS = {', '.join(found.structs)}", "for struct in STRUCTS:", "    struct.lay_out()"]
    lines += ["", "", "class Library(TypedLibrary):", '    """The compiled library."""', ""]
    for name, (result, given) in found.calls.items():
        takes = ", ".join(one[:-1] if one[:-1] in found.structs else _GIVEN[one] for one in given)
        lines.append(f"    {name}: Callable[[{takes}], {_RESULTS[result]}]")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    (_HERE / "structs.py").write_text(structs_py(), "utf-8", newline="\n")
