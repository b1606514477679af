"""mrcal's .cameramodel: a Python literal, read here without Python."""

from __future__ import annotations

import re
from typing import Any

from camtorch.io import poses
from camtorch.io.parsing import Tree
from camtorch.io.record import Record, one_of
from camtorch.io.writing import Lossy, number
from camtorch.rig import Rig

# lens model -> key, number of coefficients
_MODELS = {
    "LENSMODEL_PINHOLE": ("pinhole", 0),
    "LENSMODEL_LONLAT": ("equirectangular", 0),
    "LENSMODEL_STEREOGRAPHIC": ("stereographic", 0),
    **{f"LENSMODEL_OPENCV{count}": ("brown_conrady", count) for count in (4, 5, 8, 12, 14)},
}
_START = 1 << 16
_TOKEN = re.compile(
    r"""\s+|\#[^\n]*|(?P<mark>[][{}(),:])|b?(?P<text>'(?:[^'\\\n]|\\.)*'|"(?:[^"\\\n]|\\.)*")|(?P<word>[^][\s{}(),:'"#]+)"""
)


def matches_text(text: str) -> bool:
    """Whether this is the start of such a file: comments, a brace, a key in Python's quotes."""
    # Python's regular expressions remember every repetition
    start = re.sub(r"#[^\n]*", "", text[:_START]).split()[:2]
    return re.match(r"\{(?:'|\"(?:lens_?model|distortion_model)\")", "".join(start)) is not None


def parse_literal(path, text: str) -> dict[str, Any]:
    """The keys of a literal of texts, numbers, lists and mappings; numbers stay text until someone asks."""
    tree, expected, position, line = Tree(path), "value", 0, 1
    closing: list[str] = []
    while position < len(text):
        tree.place = f"line {line}"
        token = _TOKEN.match(text, position)
        if token is None:
            tree.fail(f"{text[position : position + 20]!r} where a value belongs")
        line += token[0].count("\n")
        position = token.end()
        mark, quoted, word = token["mark"], token["text"], token["word"]
        if not (mark or quoted is not None or word):
            continue
        if mark and mark in "]})":
            if not closing or closing[-1] != mark or expected == "end":
                tree.fail(f"{mark!r} where nothing is to be closed by it")
            closing.pop()
            tree.close()
            expected = "separator" if closing else "end"
        elif expected == "separator":
            # a mapping takes : and , in turn, which the tree's key tells apart
            if mark != (":" if tree.waits_for_value else ","):
                tree.fail(f"{token[0]!r:.40} where {':' if tree.waits_for_value else ','!r} belongs")
            expected = "value"
        elif expected == "end" or (mark and mark in ",:"):
            tree.fail(f"{token[0]!r:.40} does not belong here")
        elif mark:
            tree.open({} if mark == "{" else [])
            closing.append({"{": "}", "[": "]", "(": ")"}[mark])
        else:
            tree.add(quoted[1:-1] if quoted is not None else word)
            expected = "separator" if closing else "end"
    if closing or not isinstance(tree.root, dict):
        tree.fail("ends before its last brace")
    return tree.root


def matches(keys: dict) -> bool:
    """Whether these are the keys of such a file."""
    return any(key in keys for key in ("lensmodel", "lens_model")) and "imagersize" in keys


def parse(record: Record) -> Rig:
    """The camera; the rig is mrcal's reference. The valid region and the optimization inputs are not read."""
    name = record["lens_model" if "lens_model" in record else "lensmodel"]
    key, count = _MODELS[one_of(name, _MODELS)]
    values = record["intrinsics"].numbers(4 + count)
    camera = record["intrinsics"].camera(key, values[:4], values[4:], record["imagersize"].size())
    extrinsics = {}
    for place in ("rt_cam_ref", "extrinsics"):
        if place in record and not extrinsics:
            rt = record[place].numbers(6)
            extrinsics["camera"] = poses.pose(record[place], rt[:3], rt[3:])
    return Rig({"camera": camera}, extrinsics)


def render(rig: Rig, path) -> str:
    """The text of a file."""
    lossy = Lossy(path, "mrcal")
    name, camera = lossy.only_camera(rig)
    lossy.no_images(rig)
    height, width = lossy.size(name, camera)
    key = lossy.model(name, camera, {key for key, _ in _MODELS.values()})
    intrinsics, distortion = lossy.numbers(name, camera)
    if key == "stereographic":  # without the polynomial
        distortion = lossy.at_most(name, camera, distortion, (0,))
    model = next(model for model, (k, count) in _MODELS.items() if k == key and count == len(distortion))
    rotation, translation = [0.0] * 3, [0.0] * 3
    if name in rig.extrinsics:
        rotation, translation = lossy.pose(name, rig.extrinsics[name])
    pose = _listed(rotation + translation)
    return f"""{{
    'lensmodel':  '{model}',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': {_listed(intrinsics + distortion)},

    'rt_cam_ref': {pose},
    'extrinsics': {pose}, # for compatibility with mrcal < 2.5

    'imagersize': [ {width}, {height},],
}}
"""


def _listed(values: list[float]) -> str:
    return f"[ {', '.join(map(number, values))},]"
