"""Labels of images in JSON files."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from camtorch.camera import Camera
from camtorch.cli.terminal import note

Json = dict[str, Any]
_FARTHEST = 1e6
_SHAPES = {
    "keypoints": (2, True, "[[x, y], ...]"),
    "boxes": (4, True, "[[x1, y1, x2, y2], ...]"),
    "gaze": (3, False, "[x, y, z]"),
    "gaze_from": (2, False, "[x, y]"),
}
"""How many numbers, whether there are many of these, and both in words."""
SHAPES = ", ".join(f'"{name}": {shape}' for name, (*_, shape) in _SHAPES.items())


class LabelsError(ValueError):
    """A file of labels that cannot be read. The text names the file, the entry and the reason."""


def read_json(path: Path, otherwise: str = f"must be an object, {{{SHAPES}}}") -> Json:
    """The object in a file; `otherwise` is what is wrong with any other content.

    Raises:
        LabelsError: no JSON, or no object.
    """

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is none; null is, or leave it out")

    try:
        content = json.loads(path.read_bytes(), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise LabelsError(f"{path}: no JSON: {error}") from None
    if not isinstance(content, dict):
        raise LabelsError(f"{path}: {otherwise}; got {_short(content)}")
    return content


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


def labels_of(entries: Json, path: Path, camera: Camera) -> Labels:
    """Keypoints, boxes, and gaze with gaze_from, of what a file says of an image of `camera`, but for those that it
    says are not valid. A note names what else it has.

    Raises:
        LabelsError: numbers that are none, a box whose corners are swapped, a gaze of no direction, or from a pixel
            that has no ray.
    """
    entries = {name: value for name, value in entries.items() if value is not None}
    values = {name: _numbers(path, name, entries[name]) for name in _SHAPES if name in entries}
    has_gaze = "gaze" in values and "gaze_from" in values
    shown = {name for name in values if has_gaze or not name.startswith("gaze")}
    silent = {*shown, *(f"{name}_valid" for name in _SHAPES), "camera", "rotation"}
    if other := [name for name in entries if name not in silent]:
        why = "; a gaze needs gaze_from, the pixel of its eyes" if len(values) > len(shown) else ""
        note(f"{path}: not shown: {', '.join(map(_short, other))}{why}")
    for name in ("keypoints", "boxes"):
        valid = entries.get(f"{name}_valid")
        if name in values and valid is not None:
            if not isinstance(valid, list) or len(valid) != len(values[name]):
                raise LabelsError(f"{path}: {name}_valid: must be a list, true or false for each of {name}")
            values[name] = values[name][np.asarray(valid, bool).reshape(len(valid), -1).all(1)]
    boxes = values.get("boxes", np.zeros((0, 4)))
    for box in boxes[(boxes[:, :2] > boxes[:, 2:]).any(1)].tolist():
        raise LabelsError(f"{path}: boxes: x1 <= x2 and y1 <= y2 must hold; got {box}")
    eyes = gaze = torch.zeros(0, 3, dtype=torch.float64)
    if has_gaze and entries.get("gaze_valid", True) and entries.get("gaze_from_valid", True):
        gaze = torch.from_numpy(values["gaze"])
        if not (gaze.norm(dim=-1) > 1e-6).all():
            raise LabelsError(f"{path}: gaze: a direction has a length; got {entries['gaze']}")
        eyes, seen = camera.unproject(torch.from_numpy(values["gaze_from"]))
        if not bool(seen):
            raise LabelsError(f"{path}: gaze_from: the camera has no ray at {entries['gaze_from']}")
        eyes, gaze = eyes.double().expand_as(gaze), gaze / gaze.norm(dim=-1, keepdim=True)
    keypoints = values.get("keypoints", np.zeros((0, 2)))
    return Labels(torch.from_numpy(keypoints), torch.from_numpy(boxes), eyes, gaze)


def _numbers(path: Path, name: str, entry: Any) -> np.ndarray[Any, Any]:
    count, has_many, shape = _SHAPES[name]
    has_many |= name == "gaze" and _is_nested(entry)  # of several, from the same pixel
    for row in entry if has_many and isinstance(entry, list) else [entry]:
        row = row[0] if name == "keypoints" and _is_nested(row) and len(row) == 1 else row  # as OpenCV has them
        numbers: list[Any] = row if isinstance(row, list) and len(row) == count else [None]
        if not all(type(n) in (int, float) and abs(n) <= _FARTHEST for n in numbers):
            raise LabelsError(f"{path}: {name}: must be {shape}, numbers between -1e6 and 1e6; got {_short(row)}")
    return np.asarray(entry, np.float64).reshape(-1, count)


def _is_nested(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], list)


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:36] + " ..."
