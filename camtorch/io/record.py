"""Values of a file with their places for errors, and the names of a format."""

from __future__ import annotations

import contextlib
import math
import os
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, NoReturn

import torch
from torch import Tensor, nn

from camtorch.cameras.camera import Camera, as_model
from camtorch.models import MODELS
from camtorch.values.arguments import LEFT

LARGEST_SIDE = 1 << 20
_MOST_CAMERAS = 20_000
_SHOWN = 8
_LONGEST_NUMBER = 400  # no double needs as many characters


@dataclass(frozen=True)
class Names:
    """Names of a format and of its files."""

    format: str  # its key in `camtorch.load` and `camtorch.save`
    title: str  # its name in errors
    suffixes: tuple[str, ...] = ()  # of written files, with the dot; files to read are recognized by content
    patterns: tuple[str, ...] = ()  # fnmatch patterns that mean this format; the longest match wins
    in_folder: tuple[str, ...] = ()  # files that stand for their folder; the first that exists is used


class CameraFileError(ValueError):
    """Error for a calibration file that cannot be used.

    Args:
        path: The file.
        place: The line or the key at which reading stopped.
        reason: The reason, and if possible what to do.
    """

    def __init__(self, path: str | os.PathLike[str], place: str, reason: object):
        super().__init__(str(path), place, str(reason))

    def __str__(self) -> str:
        return "{}: {}: {}".format(*self.args)


class Record:
    """A value of a file and its place: text, a float, True, False, None, a list or a mapping. Text may be a number."""

    def __init__(self, path: str | os.PathLike[str], value: Any, place: str = ""):
        self.path = path
        self.value = value
        self.place = place

    def fail(self, reason: object) -> NoReturn:
        """Raise the CameraFileError of this place."""
        raise CameraFileError(self.path, self.place or "content", reason) from None

    def _check(self, kind: type, what: str) -> None:
        if not isinstance(self.value, kind):
            self.fail(f"must be {what}; got {self._found()}")

    def _found(self) -> str:
        if isinstance(self.value, dict):
            return f"keys and values, {', '.join(f'{key!r:.30}' for key in islice(self.value, 3)) or 'none'}"
        if isinstance(self.value, list):
            return f"a list of {len(self.value)}"
        return "nothing" if self.value is None else f"{self.value!r:.60}"

    def keys(self) -> list[str]:
        self._check(dict, "keys and values")
        return list(self.value)

    def __contains__(self, key: str) -> bool:
        self._check(dict, "keys and values")
        return key in self.value

    def __getitem__(self, key: str) -> Record:
        found = self.get(key)
        if found is None:
            there = ", ".join(f"{name!r:.30}" for name in islice(self.value, _SHOWN)) or "none"
            more = ", ..." if len(self.value) > _SHOWN else ""
            Record(self.path, None, self.place_of(key)).fail(f"must be given; got keys {there}{more}")
        return found

    def get(self, key: str) -> Record | None:
        """Return the record of a key, or None."""
        return Record(self.path, self.value[key], self.place_of(key)) if key in self else None

    def place_of(self, key: str) -> str:
        """Return the place of a key, shortened if the key is long or not printable."""
        key = key if key.isprintable() and len(key) <= 60 else f"{key!r:.60}"
        return f"{self.place}.{key}" if self.place else key

    def __iter__(self) -> Iterator[Record]:
        self._check(list, "a list")
        for i, item in enumerate(self.value):
            yield Record(self.path, item, f"{self.place}[{i}]")

    def __len__(self) -> int:
        self._check(list, "a list")
        return len(self.value)

    def text(self) -> str:
        self._check(str, "text")
        return str(self.value)

    def number(self) -> float:
        """Return a finite number."""
        number = math.nan
        if isinstance(self.value, float) or (isinstance(self.value, str) and len(self.value) <= _LONGEST_NUMBER):
            with contextlib.suppress(ValueError):
                number = float(self.value)
        if not math.isfinite(number):
            self.fail(f"must be a finite number; got {self._found()}")
        return number

    def whole(self, low: int, high: int, what: str) -> int:
        """Return a whole number from low to high; `what` names it in the error."""
        number = self.number()
        if number != int(number) or not low <= number <= high:
            self.fail(f"must be a {what}; got {number:g}")
        return int(number)

    def side(self) -> int:
        """Return the width or the height of an image."""
        return self.whole(1, LARGEST_SIDE, "number of pixels")

    def size(self) -> tuple[int, int]:
        """Return (height, width) of a list [width, height]."""
        if len(self) != 2:
            self.fail(f"a size must be [width, height]; got {len(self)} numbers")
        width, height = (side.side() for side in self)
        return height, width

    def numbers(self, count: int | None = None) -> list[float]:
        """Return a list of finite numbers, `count` of them if given."""
        if count is not None and len(self) != count:
            self.fail(f"must have {count} numbers; got {len(self)}")
        plain = isinstance(self.value, list) and all(type(v) is float and math.isfinite(v) for v in self.value)
        return list(self.value) if plain else [item.number() for item in self]

    def flat(self) -> list[float]:
        """Return the numbers of a list, of a list of rows, or of a matrix of OpenCV or ROS."""
        if isinstance(self.value, dict):
            name = "sizes" if "sizes" in self else "rows and cols"  # "sizes" for any number of dimensions
            parts = [self[key] for key in name.split(" and ")]
            sizes = [n for part in parts for n in (part.numbers() if isinstance(part.value, list) else [part.number()])]
            data = self["data"]
            if len(data) != math.prod(sizes):
                data.fail(f"must have {' x '.join(f'{n:g}' for n in sizes)} numbers, by {name}; got {len(data)}")
            return data.numbers()
        if not isinstance(self.value, list):
            self.fail(f"must be an OpenCV matrix or a list of numbers; got {self._found()}")
        return [item.number() for row in self for item in (row if isinstance(row.value, list) else [row])]

    def few(self, count: int) -> None:
        """Refuse a file of too many cameras: each costs some kilobytes and a tenth of a millisecond."""
        if count > _MOST_CAMERAS:
            self.fail(f"must have at most {_MOST_CAMERAS} cameras; got {count}")

    def camera(
        self,
        key: str,
        intrinsics: list[float] | Tensor,
        distortion: list[float] | Tensor,
        size: tuple[int, int] | None,
        lens: Record | None = None,
    ) -> Camera:
        """Return the camera of a model of `camtorch.MODELS`, in float64; `lens` is the place of its distortion."""
        kind = self.model(key)
        first, second = (torch.as_tensor(values, dtype=torch.float64) for values in (intrinsics, distortion))
        count = second.shape[-1]
        if count and not kind.names_of(count):
            there = self if lens is None else lens
            there.fail(f"{kind.__name__} must have coefficients {kind.counts_text()}; got {count}")
        try:
            return kind(nn.Parameter(first), *([second] if count else []), image_size=size)  # crops may be off centre
        except (ValueError, TypeError) as error:
            self.fail(error)

    def intrinsics(self) -> list[float]:
        """Return the focal lengths and principal point of the camera matrix at this place, read by `flat`."""
        matrix = self.flat()
        if len(matrix) != 9:
            self.fail(f"a camera matrix must have 3 x 3 numbers; got {len(matrix)}")
        fx, skew, cx, below, fy, cy, *bottom = matrix
        if skew:
            place = Record(self.path, None, f"{self.place}[1]")
            place.fail(f"skew must be 0, as no model here has one; got {skew:g}. Write 0 to ignore it as OpenCV does")
        if below or bottom != [0, 0, 1]:
            self.fail(f"must be [fx, 0, cx, 0, fy, cy, 0, 0, 1]; got {matrix}")
        return [fx, fy, cx, cy]

    def model(self, key: str) -> type[Camera]:
        if key.partition(":")[0] not in MODELS:
            known = ", ".join(sorted(MODELS))
            self.fail(f"must be a camera model of this camtorch, one of {known}; got {key!r:.60}. {LEFT}")
        try:
            return as_model(key, "file")
        except ValueError as error:
            self.fail(str(error) if LEFT in str(error) else f"{error}. {LEFT}")


def repeated(names: Iterable[str]) -> str | None:
    """Return the first name that occurs more than once, or None."""
    return next((name for name, count in Counter(names).items() if count > 1), None)


def one_of(record: Record, names: Collection[str]) -> str:
    """Return the text of a record, which must be one of the names."""
    if record.text() not in names:
        record.fail(f"must be one of {', '.join(sorted(filter(None, names)))}; got {record.text()!r:.60}")
    return record.text()
