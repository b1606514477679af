"""Numbers and matrices as the text of a `cv2.FileStorage`."""

from __future__ import annotations

import json

from camtorch.io.writing import number

Value = float | list[list[float]]
"""A number, or the rows of a matrix."""


def _words(matrix: list[list[float]], separator: str) -> str:
    return separator.join(number(value) for row in matrix for value in row)


def _scalar(value: float) -> str:
    return number(value) if isinstance(value, float) else str(value)


def as_yaml(values: dict[str, Value]) -> str:
    """The text of a file as `cv2.FileStorage` writes YAML."""
    lines = ["%YAML:1.0", "---"]
    for key, value in values.items():
        if isinstance(value, (int, float)):
            lines.append(f"{key}: {_scalar(value)}")
        else:
            lines += [f"{key}: !!opencv-matrix", f"   rows: {len(value)}", f"   cols: {len(value[0])}", "   dt: d"]
            lines.append(f"   data: [ {_words(value, ', ')} ]")
    return "\n".join(lines) + "\n"


def as_json(values: dict[str, Value]) -> str:
    """The text of a file as `cv2.FileStorage` writes JSON."""
    whole = {
        key: value
        if isinstance(value, (int, float))
        else {
            "type_id": "opencv-matrix",
            "rows": len(value),
            "cols": len(value[0]),
            "dt": "d",
            "data": [v for row in value for v in row],
        }
        for key, value in values.items()
    }
    return json.dumps(whole, indent=4, allow_nan=False) + "\n"


def as_xml(values: dict[str, Value]) -> str:
    """The text of a file as `cv2.FileStorage` writes XML."""
    lines = ['<?xml version="1.0"?>', "<opencv_storage>"]
    for key, value in values.items():
        if isinstance(value, (int, float)):
            lines.append(f"<{key}>{_scalar(value)}</{key}>")
        else:
            lines += [f'<{key} type_id="opencv-matrix">', f"  <rows>{len(value)}</rows>"]
            lines += [f"  <cols>{len(value[0])}</cols>", "  <dt>d</dt>", "  <data>"]
            lines.append(f"    {_words(value, ' ')}</data></{key}>")
    return "\n".join([*lines, "</opencv_storage>"]) + "\n"
