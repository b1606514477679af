"""The files of a `cv2.FileStorage`, as they are written: numbers and matrices as YAML, JSON and XML."""

from __future__ import annotations

import json
import os
from typing import Any

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
