"""OCamCalib's `calib_results.txt`: five lines of numbers between comments, in the order in which its C code reads them.

The second line, a polynomial close to the inverse of the first, is not read: the camera inverts the first exactly.
"""

import re

from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.parsing import decoded
from camtorch.io.record import CameraFileError, Names, Record
from camtorch.models import OCamCalib

NAMES = Names("ocamcalib", "OCamCalib")

_LINES = ("polynomial", "inverse polynomial", "centre", "affine", "image size")
_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)
_MOST_TERMS = 64
_START = 1 << 14  # bytes in which the kind of a file is visible
_LARGEST_FILE = 1 << 16


def matches(path: str, content: bytes) -> bool:
    """Whether a file begins with comments and a line that counts its numbers correctly."""
    lines = [line.split() for line in content[:_START].splitlines() if line.strip()]
    numbers = next((line for line in lines if not line[0].startswith(b"#")), [b""])
    counted = re.fullmatch(rb"[1-9]\d?", numbers[0]) is not None and int(numbers[0]) == len(numbers) - 1
    return counted and lines[0][0].startswith(b"#") and all(map(_NUMBER.fullmatch, numbers))


def read(path: str, content: bytes) -> Rig:
    """Return the only camera of a file; lines after the size, which some programs add, are not read."""
    if len(content) > _LARGEST_FILE:
        raise CameraFileError(path, "size", f"must be at most {_LARGEST_FILE} bytes; got {len(content)}")
    lines = [line.split() for line in decoded(path, content).splitlines()]
    rows = [line for line in lines if line and not line[0].startswith("#")]
    if len(rows) < len(_LINES):
        raise CameraFileError(path, _LINES[len(rows)], "must be given; got no such line")
    record = Record(path, dict(zip(_LINES, rows, strict=False)))
    polynomial, inverse, centre, affine, size = (record[name] for name in _LINES)
    for terms in (polynomial, inverse):
        first = Record(path, terms.value[0], terms.place)
        count = first.whole(1, _MOST_TERMS, f"number of coefficients up to {_MOST_TERMS}")
        if len(terms) != count + 1:
            terms.fail(f"must have as many coefficients as its first number; got {len(terms) - 1} for {count}")
    if len(size) != 2:
        size.fail(f"must be a height and a width; got {len(size)} numbers")
    height, width = (side.side() for side in size)
    values = polynomial.numbers()[1:], centre.numbers(2), affine.numbers(3)
    try:
        camera = OCamCalib.from_ocamcalib(*map(poses.as_float64, values))
    except (ValueError, TypeError) as error:
        record.fail(error)
    camera.image_size = height, width
    return Rig({"camera": camera})
