"""What camtorch says where something is wrong: its statements that raise or warn, and what they said in a run of tests.

`pytest -n 2 --messages FILE` writes all of them to FILE, each with the first message that it made, or that no test
reaches it.
"""

import ast
import builtins
import importlib.abc
import importlib.machinery
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).parents[1] / "camtorch"
FAIL = ("fail", "_refuse")  # functions that do nothing but raise: what matters is where they are called
_RECORD = "_record_message_of_camtorch"


class Statement(NamedTuple):
    """A statement that raises or warns."""

    file: str
    line: int
    function: str
    kind: str
    """The class that is raised; "warning"; or the name of the function that raises."""
    arguments: list[ast.expr]
    tried: bool
    """Whether it stands between `try` and `except`."""

    @property
    def place(self) -> str:
        return f"{self.file}:{self.line}"


def statements(path: Path) -> Iterator[Statement]:
    """Those of a file of camtorch, but for what raises again what was caught."""
    names: list[str] = []

    def walk(node: ast.AST, tried: bool = False) -> Iterator[Statement]:
        named = isinstance(node, (ast.FunctionDef, ast.ClassDef))
        if named:
            names.append(node.name)
        kind, arguments = _said_by(node)
        if kind and not (kind not in ("warning", *FAIL) and names[-1:] and names[-1] in FAIL):
            yield Statement(
                path.relative_to(PACKAGE.parent).as_posix(), node.lineno, ".".join(names), kind, arguments, tried
            )
        for child in ast.iter_child_nodes(node):
            yield from walk(child, (tried and not named) or (isinstance(node, ast.Try) and child in node.body))
        if named:
            names.pop()

    yield from walk(ast.parse(path.read_text()))


def _said_by(node: ast.AST) -> tuple[str, list[ast.expr]]:
    if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
        return ast.unparse(node.exc.func), node.exc.args
    if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Name) and node.exc.id[0].isupper():
        return node.exc.id, []
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        if node.func.attr == "warn":
            return "warning", node.args[:1]
        if node.func.attr in FAIL:
            return node.func.attr, node.args
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in FAIL:
        return node.func.id, node.args
    return "", []


def everything() -> list[Statement]:
    return [statement for path in sorted(PACKAGE.rglob("*.py")) for statement in statements(path)]


# -- a run of tests


class _Recorded(ast.NodeTransformer):
    """Statements hand what they raise or warn of to the record first."""

    def visit_Raise(self, node: ast.Raise) -> ast.Raise:
        self.generic_visit(node)
        if node.exc is not None:
            node.exc = self._record(node.exc)
        return node

    def visit_Call(self, node: ast.Call) -> ast.Call:
        self.generic_visit(node)
        if isinstance(node.func, ast.Attribute) and node.func.attr == "warn":
            node.args[0] = self._record(node.args[0])
        return node

    @staticmethod
    def _record(value: ast.expr) -> ast.expr:
        call = ast.Call(ast.Name(_RECORD, ast.Load()), [value], [])
        return ast.fix_missing_locations(ast.copy_location(call, value))


class _Loader(importlib.machinery.SourceFileLoader):
    def get_code(self, fullname: str) -> object:
        source = _Recorded().visit(ast.parse(Path(self.path).read_text()))
        return compile(source, self.path, "exec", dont_inherit=True)


class _Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        if name.partition(".")[0] != "camtorch":
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class Recorder:
    """A plugin of pytest; of its processes each adds to the file what it was the first to say at some place."""

    def __init__(self, file: Path, gathers: bool):
        self.file, self.gathers, self.places = file, gathers, set[str]()
        if gathers:
            file.unlink(missing_ok=True)
        assert "camtorch" not in sys.modules
        setattr(builtins, _RECORD, self.record)
        sys.meta_path.insert(0, _Finder())

    def record(self, said: object) -> object:
        frame = sys._getframe(1)
        while frame.f_code.co_name in FAIL:
            frame = frame.f_back
        place = f"{frame.f_code.co_filename}:{frame.f_lineno}"
        if place not in self.places:
            self.places.add(place)
            text = said.__name__ if isinstance(said, type) else f"{type(said).__name__}: {said}"
            with self.file.open("a") as lines:
                lines.write(json.dumps([place, text]) + "\n")
        return said

    def pytest_terminal_summary(self, terminalreporter: object) -> None:
        if not self.gathers:
            return
        said = dict(json.loads(line) for line in self.file.read_text().splitlines()[::-1])
        known = everything()
        lines, never = [], 0
        for statement in known:
            end = statement.arguments[-1].end_lineno if statement.arguments else statement.line
            places = (f"{PACKAGE.parent / statement.file}:{line}" for line in range(statement.line, end + 2))
            example = next((said[place] for place in places if place in said), None)
            never += example is None
            words = ", ".join(map(ast.unparse, statement.arguments))
            what = example or f"NO TEST: {statement.kind}({words})"
            lines.append(f"{statement.place} {statement.function}\n    {what}\n")
        self.file.write_text("".join(lines))
        terminalreporter.write_line(f"{len(known)} statements raise or warn, {never} in no test: {self.file}")
