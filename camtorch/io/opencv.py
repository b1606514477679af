"""OpenCV's camera files: what `cv2.FileStorage` writes as YAML or JSON."""

from __future__ import annotations

import math
import re
import warnings
from typing import Any, NoReturn

import torch

from camtorch.camera import MODELS, Camera
from camtorch.io import CameraFileError
from camtorch.io.text import read_mapping

# the end of the key is the camera's name, as in M1, D1 or cameraMatrix_left
_NAME = r"_?(\d*|left|right)"
_MATRIX = re.compile(rf"(?:K|M|(?i:camera_?matrix|intrinsic_?matrix)){_NAME}")
_DISTORTION = re.compile(rf"(?:D|(?i:dist(?:ortion)?(?:_?coeff?s|_?coefficients)?)){_NAME}")
_WIDTH = re.compile(r"(?i:(?:image_?)?width)")
_HEIGHT = re.compile(r"(?i:(?:image_?)?height)")
_FISHEYE = re.compile(r"(?i:(?:is_?)?fisheye(?:_?model)?)")
_OTHER_LENS = re.compile(r"(?i:distortion_?model|camera_?model|xi)")
_LARGEST_SIDE = 1 << 20
_FISHEYE_COUNT = 4  # of cv2.fisheye, and one of the counts of cv2.calibrateCamera


def read(path, model: str | None = None, *, name: str | None = None) -> Camera:
    """The camera of an OpenCV YAML or JSON file, in float64.

    Args:
        path: a file with a camera matrix (`camera_matrix`, `cameraMatrix`, `K`, `M`) and, where it has them,
            distortion coefficients (`distortion_coefficients`, `distCoeffs`, `D`), `image_width` and `image_height`.
        model: a key of `camtorch.MODELS`. If left out: without coefficients a pinhole, with a true `fisheye_model` a
            Kannala-Brandt, else a Brown-Conrady camera, with a warning where 4 coefficients could be either.
        name: which camera of a file with several: the end of its keys, "1" for `M1` and `D1`.

    Raises:
        CameraFileError: not one usable camera in the file.
        OSError: no such file, or it cannot be opened. ValueError: an unknown model. ImportError: YAML without PyYAML.
    """
    if model is not None and model not in MODELS:
        raise ValueError(f"unknown model {model!r}; known are {', '.join(sorted(MODELS))}")
    return _File(path, read_mapping(path)).camera(model, name)


class _File:
    """The keys of a file, and its path for the errors."""

    def __init__(self, path, keys: dict[str, Any]):
        self.path, self.keys = path, keys

    def camera(self, model: str | None, name: str | None) -> Camera:
        key, distortion_key = self.keys_of_camera(name)
        matrix = self.numbers(key, self.keys[key])
        if len(matrix) != 9:
            self.fail(key, f"a camera matrix has 3 x 3 numbers, this has {len(matrix)}")
        fx, skew, cx, below, fy, cy, *bottom = matrix
        if skew:
            self.fail(
                f"{key}[1]", f"a skew of {skew:g}, which no model here has; write 0 there to ignore it as OpenCV does"
            )
        if below or bottom != [0, 0, 1]:
            self.fail(key, "is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
        distortion = self.numbers(distortion_key, self.keys[distortion_key]) if distortion_key else []
        kind = MODELS[model or self.model(distortion)]
        arguments = [torch.tensor([fx, fy, cx, cy], dtype=torch.float64)]
        if distortion:
            if kind.names_of(len(distortion)) is None or not kind.distortion_names:
                self.fail(distortion_key, f"{len(distortion)} coefficients; {kind.__name__} takes {kind.counts_text()}")
            arguments.append(torch.tensor(distortion, dtype=torch.float64))
        try:
            return kind(*arguments, image_size=self.image_size())
        except CameraFileError:
            raise
        except ValueError as error:
            self.fail(key, error)

    def keys_of_camera(self, name: str | None) -> tuple[str, str | None]:
        """The keys of the camera's matrix and distortion, None where it has no distortion."""
        matrices, distortions = self.by_name(_MATRIX), self.by_name(_DISTORTION)
        if not matrices:
            self.fail("camera_matrix", "missing, also as cameraMatrix, K and M; is this a file of OpenCV's?")
        if name is None and len(matrices) > 1:
            self.fail(
                ", ".join(matrices.values()),
                f"several cameras; choose one by its name, as in name={min(matrices)!r} or --name {min(matrices)}",
            )
        name = next(iter(matrices)) if name is None else name
        if name not in matrices:
            there = f"there are {sorted(matrices)}" if any(matrices) else "the only one has no name"
            self.fail(", ".join(matrices.values()), f"no camera is called {name!r:.60}; {there}")
        return matrices[name], distortions.get(name)

    def by_name(self, pattern: re.Pattern) -> dict[str, str]:
        named: dict[str, str] = {}
        for key in self.keys:
            if match := pattern.fullmatch(key):
                if match[1] in named:
                    self.fail(key, f"one camera has this and {named[match[1]]}")
                named[match[1]] = key
        return named

    def model(self, distortion: list[float]) -> str:
        for key in filter(_OTHER_LENS.fullmatch, self.keys):
            self.fail(
                key,
                "the file may mean another model than OpenCV's own two; name it, as in model='kannala_brandt' "
                "or --model kannala_brandt",
            )
        flag = self.keys.get(self.find(_FISHEYE), "0")
        if not isinstance(flag, (str, bool)):
            self.fail(self.find(_FISHEYE), "is neither true nor false")
        if str(flag).strip().lower() not in ("", "0", "0.", "0.0", "false", "no", "off", "n"):
            return "kannala_brandt"
        if len(distortion) == _FISHEYE_COUNT and self.find(_FISHEYE) is None:
            warnings.warn(
                f"{self.path}: {_FISHEYE_COUNT} coefficients and no fisheye_model: taken for brown_conrady. "
                "If they come from cv2.fisheye, the model is kannala_brandt",
                stacklevel=4,
            )
        return "brown_conrady" if distortion else "pinhole"

    def image_size(self) -> tuple[int, int] | None:
        keys = self.find(_HEIGHT), self.find(_WIDTH)
        if keys == (None, None):
            return None
        if None in keys:
            self.fail("image_height" if keys[0] is None else "image_width", "missing, while the other side is given")
        height, width = (self.number(key, self.keys[key]) for key in keys)
        for key, side in zip(keys, (height, width), strict=True):
            if side != int(side) or not 0 < side <= _LARGEST_SIDE:
                self.fail(key, f"{side:g} is no number of pixels")
        return int(height), int(width)

    def find(self, pattern: re.Pattern) -> str | None:
        return next(filter(pattern.fullmatch, self.keys), None)

    def numbers(self, key: str, value) -> list[float]:
        """An OpenCV matrix, a list, or a list of rows as one list."""
        if isinstance(value, dict):
            rows, cols = (self.number(f"{key}.{side}", value.get(side)) for side in ("rows", "cols"))
            data = value.get("data")
            if not isinstance(data, list) or len(data) != rows * cols:
                count = f"{len(data)} numbers" if isinstance(data, list) else "no list"
                self.fail(f"{key}.data", f"{count}, where rows and cols say {rows:g} x {cols:g}")
            return [self.number(f"{key}.data[{i}]", item) for i, item in enumerate(data)]
        if not isinstance(value, list):
            self.fail(key, "is neither an OpenCV matrix nor a list of numbers")
        rows = [row if isinstance(row, list) else [row] for row in value]
        return [self.number(f"{key}[{i}]", item) for i, row in enumerate(rows) for item in row]

    def number(self, key: str, value) -> float:
        try:
            number = float(value) if isinstance(value, str) else math.nan
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            self.fail(key, f"{value!r:.60} is no finite number" if isinstance(value, str) else "is no number")
        return number

    def fail(self, place: str, reason: object) -> NoReturn:
        raise CameraFileError(self.path, place, reason) from None
