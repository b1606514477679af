"""Labels of one image in a JSON file."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from camtorch.camera import Camera
from camtorch.cli.terminal import note

_LARGEST_FILE = 1 << 20
_FARTHEST = 1e6
_SHAPES = {
    "keypoints": (2, "[[x, y], ...]"),
    "boxes": (4, "[[x1, y1, x2, y2], ...]"),
    "gaze": (3, "[x, y, z]"),
    "gaze_from": (2, "[x, y]"),
}


class LabelsError(ValueError):
    """A file of labels that cannot be read. The text names the file, the entry and the reason."""


@dataclass
class Labels:
    """What is known of an image, in its pixels and its camera's frame; float64."""

    keypoints: Tensor
    """(N, 2) pixels."""
    boxes: Tensor
    """(M, 4) pixels x1, y1, x2, y2."""
    eyes: Tensor
    """(K, 3) points from which somebody looks; where the distance is not known, it is 1."""
    gaze: Tensor
    """(K, 3) unit directions."""


def entries_of(path: str | Path) -> dict[str, Any]:
    """What the file of an image says, as `camtorch.data.MapSamples` takes it: fields, and perhaps the camera.

    Raises:
        LabelsError: no JSON, or no object.
    """
    with Path(path).open("rb") as file:
        content = file.read(_LARGEST_FILE + 1)
    if len(content) > _LARGEST_FILE:
        raise LabelsError(f"{path}: larger than {_LARGEST_FILE >> 20} MiB, more than the labels of one image")
    try:
        entries = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise LabelsError(f"{path}: no JSON: {error}") from None
    if not isinstance(entries, dict):
        raise LabelsError(f"{path}: must be an object, {{{_known()}}}; it is {_kind(entries)}")
    return entries


def read(path: str | Path, camera: Camera) -> Labels:
    """Keypoints, boxes, and gaze with gaze_from, of an image of `camera`, as far as the file has them, and but for
    those that it says are not valid. A note names what else it has.

    Raises:
        LabelsError: as `entries_of`; numbers that are none, a box whose corners are swapped, a gaze of no direction,
            or from a pixel that has no ray.
    """
    entries = entries_of(path)
    values = {name: _numbers(f"{path}: {name}", name, entries[name]) for name in _SHAPES if name in entries}
    for i, (x1, y1, x2, y2) in enumerate(values.get("boxes", ())):
        if x1 > x2 or y1 > y2:
            raise LabelsError(f"{path}: boxes[{i}]: x1 <= x2 and y1 <= y2 must hold; got {entries['boxes'][i]}")
    lone = {"gaze", "gaze_from"} if len({"gaze", "gaze_from"} & set(values)) == 1 else set()
    silent = {*_SHAPES, *(f"{name}_valid" for name in _SHAPES), "camera", "rotation"} - lone
    other = [name for name in entries if name not in silent]
    if other:
        why = "; a gaze needs gaze_from, the pixel of its eyes" if lone else ""
        note(f"{path}: not shown: {', '.join(map(_short, other))}{why}")
    for name in ("keypoints", "boxes"):
        valid = entries.get(f"{name}_valid")
        if name in values and valid is not None:
            if not isinstance(valid, list) or len(valid) != len(values[name]):
                raise LabelsError(f"{path}: {name}_valid: must be a list, true or false for each of {name}")
            values[name] = [row for row, seen in zip(values[name], valid, strict=True) if seen]
    eyes = gaze = torch.zeros(0, 3, dtype=torch.float64)
    if "gaze" in values and not lone and entries.get("gaze_valid", True) and entries.get("gaze_from_valid", True):
        gaze = _tensor(values["gaze"], 3)
        if not gaze.norm() > 1e-6:
            raise LabelsError(f"{path}: gaze: a direction has a length; got {entries['gaze']}")
        eyes, seen = camera.unproject(_tensor(values["gaze_from"], 2))
        if not bool(seen):
            raise LabelsError(f"{path}: gaze_from: the camera has no ray at {entries['gaze_from']}")
        eyes, gaze = eyes.double(), gaze / gaze.norm()
    return Labels(_tensor(values.get("keypoints", []), 2), _tensor(values.get("boxes", []), 4), eyes, gaze)


def _numbers(where: str, name: str, entry: Any) -> list[Any]:
    size, shape = _SHAPES[name]
    many = shape.startswith("[[")
    if not isinstance(entry, list):
        raise LabelsError(f"{where}: must be {shape}; it is {_kind(entry)}")
    for i, row in enumerate(entry if many else [entry]):
        at = f"{where}[{i}]" if many else where
        if not isinstance(row, list):
            raise LabelsError(f"{at}: must be a list of {size} numbers; it is {_kind(row)}")
        if len(row) != size:
            raise LabelsError(f"{at}: must be {size} numbers; here are {len(row)}")
        for number in row:
            if isinstance(number, bool) or not isinstance(number, (int, float)):
                raise LabelsError(f"{at}: {_short(number)} is no number")
            # of an integer too large for a float, too
            if not (abs(number) <= _FARTHEST and math.isfinite(number)):
                raise LabelsError(f"{at}: {_short(number)} is no number between -1e6 and 1e6")
    return entry


def _tensor(rows: list[Any], size: int) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, size)


def _known() -> str:
    return ", ".join(f'"{name}": {shape}' for name, (_, shape) in _SHAPES.items())


def _kind(value: object) -> str:
    names = {dict: "an object", list: "a list", str: "a text", bool: "true or false", type(None): "null"}
    return names.get(type(value), "a number")


def _short(value: object) -> str:
    try:
        text = json.dumps(value)
    except ValueError:  # Python refuses to print integers of thousands of digits
        return "an integer of thousands of digits"
    return text if len(text) <= 40 else text[:36] + " ..."
