"""Print all public names of the installed camtorch as JSON: names, methods, keywords, commands, options, formats.

`python tests/package/public_names.py > names.json` in a checkout of a version makes the list of that version. A name is
written as a page would write it: `ct.Warp`, `ct.Warp.grid`, `ct.Warp(mode=)`, `camtorch dewarp --fov`,
`camera format opencv`, `map format onnx`, `label format coco`, `model pinhole`, `landmarks ibug68`, `lens preset ...`,
`camtorch[plot]`.
"""

import argparse
import ast
import importlib
import importlib.util
import inspect
import json
import operator
import re
import types
from pathlib import Path

import pytest
import torch

import camtorch as ct

ROOMS = ["augment", "augment.kornia", "augment.numpy", "cabin", "data", "io", "lenses", "losses", "models", "optics"]
ROOMS += ["plot", "views"]
FRONT_ENDS = ("augment.albumentations", "augment.torchvision")
"""These are read as text, because the libraries that they need may not be installed."""


def public(names):
    return sorted(name for name in names if not name.startswith("_"))


def keywords(function):
    """Return the names that a caller may pass by keyword, also through `**options`."""
    makers = [function]
    if inspect.isclass(function):  # what a class passes on goes to the next one
        makers = [base.__init__ for base in function.__mro__ if "__init__" in vars(base)]
    names = []
    for maker in makers:
        try:
            parameters = inspect.signature(maker).parameters.values()
        except (TypeError, ValueError):
            break
        names += [p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        rest = next((p for p in parameters if p.kind == p.VAR_KEYWORD), None)
        options = unpacked(str(rest.annotation), inspect.unwrap(maker)) if rest else []
        names += options
        if options or rest is None:
            break
    inherited = {"ranges"} if len(makers) > 1 and "ranges" not in inspect.signature(makers[0]).parameters else set()
    return public({*names} - inherited - {"self", "cls"})


def unpacked(annotation, function):
    """Return the names of a TypedDict in `**options: Unpack[...]`."""
    name = re.search(r"Unpack\[(?:\w+\.)*(\w+)\]", annotation)
    if name is None:
        return []
    kind = function.__globals__.get(name[1])
    if kind is None:  # it is imported for type checkers alone
        source = Path(inspect.getfile(function)).read_text("utf-8")
        place = re.search(rf"from (camtorch[\w.]*) import [^\n]*\b{name[1]}\b", source)
        kind = getattr(importlib.import_module(place[1]), name[1])
    return list(kind.__annotations__)


def of_value(name, value, public_classes):
    yield name
    if inspect.isclass(value):
        yield from (f"{name}({word}=)" for word in keywords(value))
        bases = [base for base in value.__mro__[1:] if base in public_classes]
        inherited = {member for base in (*bases, torch.nn.Module, dict, tuple, Exception) for member in dir(base)}
        for member in public({*dir(value), *getattr(value, "__annotations__", ())} - inherited):
            attribute = inspect.getattr_static(value, member, None)
            yield f"{name}.{member}"
            if isinstance(attribute, (types.FunctionType, classmethod, staticmethod)):
                yield from (f"{name}.{member}({word}=)" for word in keywords(getattr(value, member)))
    elif callable(value):
        yield from (f"{name}({word}=)" for word in keywords(value))


def room_of(name):
    try:
        return operator.attrgetter(name)(ct)
    except AttributeError:  # a front end is imported by name; a room may be gone
        return importlib.import_module(f"camtorch.{name}") if importlib.util.find_spec(f"camtorch.{name}") else None


def of_modules():
    found = {"ct": ct} | {f"ct.{room}": module for room in ROOMS if (module := room_of(room)) is not None}
    named = [(p, module, name) for p, module in found.items() for name in public(getattr(module, "__all__", ()))]
    shown = [(f"{prefix}.{name}", getattr(module, name)) for prefix, module, name in named]
    # a class that is public in several places is listed in full at its first
    classes = {value for _, value in shown if inspect.isclass(value)}
    seen = set()
    for name, value in shown:
        if not inspect.isclass(value):
            yield from of_value(name, value, classes)
        elif value in seen:
            yield name
        else:
            seen.add(value)
            yield from of_value(name, value, classes - {value})


def of_front_ends():
    for room in FRONT_ENDS:
        path = importlib.util.find_spec(f"camtorch.{room}").origin
        for node in ast.parse(Path(path).read_text("utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                name = f"ct.{room}.{node.name}"
                yield name
                makers = [made.args for made in node.body if getattr(made, "name", "") == "__init__"]
                words = [word.arg for maker in makers for word in (*maker.args[1:], *maker.kwonlyargs)]
                yield from (f"{name}({word}=)" for word in words)


def of_commands():
    from camtorch.cli.main import make_parser

    (commands,) = (action for action in make_parser()._actions if isinstance(action, argparse._SubParsersAction))
    for command, parser in commands.choices.items():
        yield f"camtorch {command}"
        for action in parser._actions:
            yield from (f"camtorch {command} {option}" for option in action.option_strings)
            if isinstance(action.choices, (list, tuple)):
                option = next((o for o in action.option_strings if o.startswith("--")), action.dest)
                yield from (f"camtorch {command} {option} {choice}" for choice in action.choices)


def of_formats():
    from camtorch.maps import formats as maps

    yield from (f"camera format {name}" for name in ct.io.FORMATS)
    yield from (f"map format {name}" for name in maps.FORMATS)
    with pytest.raises(ValueError, match="one of") as refused:
        ct.data.read(".", format="?")
    known = re.search(r"one of ([\w, ]+)", str(refused.value))[1]
    yield from (f"label format {name}" for name in known.split(", "))
    yield from (f"model {name}" for name in ct.MODELS)
    yield from (f"landmarks {name}" for name in ct.augment.LANDMARKS)
    yield from (f"lens preset {name}" for name in ct.augment.PRESETS)


def of_extras():
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8")
    extras = text.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    yield from (f"camtorch[{name}]" for name in re.findall(r"^([\w-]+) = \[", extras, re.M) if name[-4:] != "test")


def names():
    return sorted({*of_modules(), *of_front_ends(), *of_commands(), *of_formats(), *of_extras()})


if __name__ == "__main__":
    print(json.dumps(names(), indent=0))
