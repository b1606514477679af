"""OpenCV's cameras or stereo pairs: YAML, JSON or XML of `cv2.FileStorage`, and archives of `numpy.savez`."""

import json
import os
import re
from typing import Any, NoReturn

import torch

from camtorch.cameras.camera import Camera
from camtorch.cameras.image_sizes import off_centre, warn_of_order, warn_of_size
from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.parsing import parse_mapping, read_bytes
from camtorch.io.record import Names, Record
from camtorch.io.writing import Lossy, number
from camtorch.models import MODELS
from camtorch.poses.extrinsics import Extrinsics
from camtorch.values.arguments import check_path, shown, warn

NAMES = Names("opencv", "OpenCV", (".yml", ".yaml", ".json", ".xml"), ("*.xml",))

_NAMES = r"\d*|left|right"  # a key ends with the camera's name, as in M1, D1 or cameraMatrix_left
_MATRIX = re.compile(rf"(?:K|M|(?i:mtx|camera_?matrix|intrinsic_?matrix))_?({_NAMES})")
_DISTORTION = re.compile(
    rf"(?:[Dd]|(?i:dist(?:ortion)?(?:_?coef(?:f|fs|s|ficients?)?(?:_?mat)?|_?param(?:s|eters)?)?))_?({_NAMES})"
)
_LIKE_DISTORTION = re.compile(r"(?i:d\d*|.*coef.*|.*distor.*|dist(?!ance).*)")
_NO_DISTORTION = re.compile(r"(?i:.*(?:std|err|undist|names|flags|model).*)")
_XI = re.compile(rf"(?i:xi)_?({_NAMES})")
_WIDTH = re.compile(r"(?i:(?:image_?)?width)")
_HEIGHT = re.compile(r"(?i:(?:image_?)?height)")
_SIZE = re.compile(r"(?i:camera_?resolution|im(?:age|g)_?size)")  # width and height
_FISHEYE = re.compile(r"(?i:(?:is_?)?fisheye(?:_?model)?)")
_OTHER_LENS = re.compile(r"(?i:distortion_?model|camera_?model)")
_FISHEYE_COUNT = 4  # of cv2.fisheye, and one of the counts of cv2.calibrateCamera
_LONGEST_KEY = 200
_PAIRS = (["1", "2"], ["left", "right"])
_POSES = (("R", "T"), ("rvec", "tvec"), ("om", "T"))  # a matrix, or a rotation vector


class AmbiguousModelWarning(UserWarning):
    """A file whose coefficients may be those of two models."""


def read(path: str | os.PathLike[str], model: str | None = None) -> Camera:
    """Return the only camera of an OpenCV YAML, JSON or XML file, in float64 and frozen; for several use `read_rig`.

    Args:
        path: A file with a camera matrix (`camera_matrix`, `cameraMatrix`, `K`, `M`, `mtx`), and optional
            distortion coefficients (`distortion_coefficients`, `distCoeffs`, `D`), `image_width` and `image_height`.
        model: A key of `camtorch.MODELS`, for a file that leaves it open. Default: without coefficients a pinhole,
            with a true `fisheye_model` a Kannala-Brandt, with `xi` a Mei, else a Brown-Conrady camera, with a warning
            if 4 coefficients could be of two models.

    Raises:
        CameraFileError: If the file has no usable camera, or one of another model than `model`.
        OSError: If the file cannot be opened. ValueError: If `model` is unknown, or the file has several cameras.
    """
    check_path(path, "io.opencv.read")
    return read_rig(path, model).camera


def read_rig(path: str | os.PathLike[str], model: str | None = None) -> Rig:
    """Return all cameras of such a file, and the pose of a pair, all frozen; raise what `read` raises."""
    check_path(path, "io.opencv.read_rig")
    if model not in (None, *MODELS):
        raise ValueError(f"io.opencv: model must be one of {', '.join(sorted(MODELS))}; got {shown(model)}")
    return parse(Record(path, parse_mapping(path, read_bytes(path))), model).requires_grad_(False)


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys may be those of an OpenCV file."""
    return any(len(key) <= _LONGEST_KEY and _MATRIX.fullmatch(key) for key in keys)


def parse(record: Record, model: str | None = None) -> Rig:
    """Return the cameras by the ends of their keys; a pair has the pose `X2 = R X1 + T`, R may be a vector `om`."""
    file = _File(record)
    names = sorted(file.matrices, key=lambda name: (name.isdigit(), int(name) if name.isdigit() else 0, name))
    record.few(len(names))
    if not names:
        file.fail("camera_matrix", "must be given, or cameraMatrix, K or M; got none. Is this a file of OpenCV?")
    cameras = {name or "camera": file.camera(model, name) for name in names}
    extrinsics = {}
    keys = next((keys for keys in _POSES if all(key in record for key in keys)), None)
    if names in _PAIRS and keys is not None:
        here = poses.pose(record, [0.0] * 3, [0.0] * 3)
        extrinsics = dict(zip(names, (here, file.pose(*keys)), strict=True))
    return Rig(cameras, extrinsics)


class _File:
    """The keys of a file, and the keys of matrices, distortions and xi by camera name."""

    def __init__(self, record: Record):
        self.record = record
        # a pattern may take quadratic time in the length of a key
        self.keys = [key for key in record.keys() if len(key) <= _LONGEST_KEY]  # noqa: SIM118
        self.matrices, self.lenses, self.xis = map(self.by_name, (_MATRIX, _DISTORTION, _XI))
        # ignoring the distortion of a camera would make all results wrong without a warning
        orphans = [key for name, key in (self.lenses | self.xis).items() if name not in self.matrices]
        if not self.matrices.keys() <= self.lenses.keys():
            like = [k for k in self.keys if _LIKE_DISTORTION.fullmatch(k) and not _NO_DISTORTION.fullmatch(k)]
            known = {*self.lenses.values(), *self.xis.values()}
            orphans += [k for k in like if k not in known and isinstance(record.value[k], (list, dict))]
        if self.matrices and orphans:
            self.fail(orphans[0], "must be the distortion of a camera; got no camera of this name")

    def fail(self, place: str, reason: object) -> NoReturn:
        Record(self.record.path, None, self.record.place_of(place)).fail(reason)

    def find(self, pattern: re.Pattern[str]) -> str | None:
        return next(filter(pattern.fullmatch, self.keys), None)

    def by_name(self, pattern: re.Pattern[str]) -> dict[str, str]:
        """Return the keys that match a pattern by camera name."""
        named: dict[str, str] = {}
        for key in self.keys:
            if match := pattern.fullmatch(key):
                if match[1] in named:
                    self.fail(key, f"must be the only one of a camera; got {named[match[1]]} too")
                named[match[1]] = key
        return named

    def camera(self, model: str | None, name: str) -> Camera:
        key, lens, xi = self.matrices[name], self.lenses.get(name), self.xis.get(name)
        intrinsics = self.record[key].intrinsics()
        distortion = self.record[lens].flat() if lens else []
        if xi:  # cv2.omnidir
            is_matrix = isinstance(self.record[xi].value, (dict, list))
            distortion = [*(self.record[xi].flat() if is_matrix else [self.record[xi].number()]), *distortion]
        stated, place = (("mei",), xi) if xi else self.stated()
        if place is not None and model is not None and model not in stated:
            self.fail(place, f"the model must be the file's, {stated[0]}; got {model}. Leave it out or change the file")
        kind, size = model or ("mei" if xi else self.model(distortion, stated)), self.image_size()
        if size is not None and self.find(_SIZE):  # a pair of numbers, whose order no key states
            rows = off_centre(torch.tensor(intrinsics), size)
            warn_of_order(rows, size, str(self.record.path), "(width, height)")
            if self.record.path == "loads":  # keys that the caller has put together
                warn_of_size(rows, size, "loads")
        return self.record[key].camera(kind, intrinsics, distortion, size, self.record[lens or xi or key])

    def stated(self) -> tuple[tuple[str, ...], str | None]:
        """Return the models that the fisheye flag allows, and its key; no models and None if there is no flag."""
        key = self.find(_FISHEYE)
        if key is None:
            return (), None
        flag = self.record[key].value
        if not isinstance(flag, (str, float, bool)):
            self.fail(key, f"must be true or false; got {flag!r:.60}")
        no = str(flag).strip().lower() in ("", "0", "0.", "0.0", "false", "no", "off", "n")
        return ("brown_conrady", "pinhole") if no else ("kannala_brandt",), key

    def model(self, distortion: list[float], stated: tuple[str, ...]) -> str:
        """Return the model if the caller does not name one."""
        other = self.find(_OTHER_LENS)
        if other is not None:
            name = "Write model='kannala_brandt' or --from-model kannala_brandt"
            self.fail(other, f"must be absent, or the model be named; got a file that may mean another model. {name}")
        if "kannala_brandt" in stated:
            return "kannala_brandt"
        if len(distortion) == _FISHEYE_COUNT and not stated:
            text = f"{self.record.path}: {_FISHEYE_COUNT} coefficients and no fisheye_model are read as brown_conrady. "
            way = "camtorch.io.opencv.read(path, 'kannala_brandt'), or --from-model kannala_brandt"
            warn(f"{text}If they come from cv2.fisheye, load them by {way}", AmbiguousModelWarning)
        return "brown_conrady" if distortion else "pinhole"

    def pose(self, rotation_key: str, translation_key: str) -> Extrinsics:
        """Return the pose of R or a rotation vector, and T."""
        rotation, translation = self.record[rotation_key].flat(), self.record[translation_key].flat()
        for key, values in ((rotation_key, rotation), (translation_key, translation)):
            count = 9 if key == "R" else 3
            if len(values) != count:
                self.fail(key, f"must have {count} numbers; got {len(values)}")
        poses.check_near(self.record[translation_key], translation)
        if rotation_key != "R":
            return poses.pose(self.record[rotation_key], rotation, translation)
        matrix = [[*rotation[3 * i : 3 * i + 3], t] for i, t in enumerate(translation)]
        return poses.from_matrices(self.record[rotation_key], matrix)

    def image_size(self) -> tuple[int, int] | None:
        height, width = self.find(_HEIGHT), self.find(_WIDTH)
        if height is None and width is None:
            size = self.find(_SIZE)
            return None if size is None else self.record[size].size()
        if height is None or width is None:
            self.fail("image_height" if height is None else "image_width", "must be given as the other side; got none")
        return self.record[height].side(), self.record[width].side()


def render(rig: Rig, lossy: Lossy) -> str:
    """Return the text of a file of one camera or several; the second of two may have a pose."""
    names, ends = list(rig.cameras), list(rig.cameras)
    if len(names) == 1:
        ends = [names[0] if re.fullmatch(_NAMES, names[0]) else ""]
    elif not all(name and re.fullmatch(_NAMES, name) for name in names):
        ends = [str(i + 1) for i in range(len(names))]
    values: dict[str, Any] = {}
    for name, end in zip(names, ends, strict=True):
        _add_camera(lossy, values, name, rig.cameras[name], end)
    last, both = zip(*sorted(zip(ends, names, strict=True)), strict=True)
    if len(both) == 2 and list(last) in _PAIRS and both[1] in rig.extrinsics:
        lossy.all_posed(rig)
        if not poses.is_identity(rig.extrinsics[both[0]]):
            lossy.fail(both[0], "must be where the rig is for OpenCV; got other extrinsics, which would be lost")
        rows = poses.matrices(rig.extrinsics[both[1]]).tolist()
        values["R"] = [row[:3] for row in rows[:3]]
        values["T"] = [row[3:] for row in rows[:3]]
    else:
        lossy.no_pose(rig)
    return _text(os.path.splitext(lossy.path)[1].lower(), values)


def _add_camera(lossy: Lossy, values: dict[str, Any], name: str, camera: Camera, end: str) -> None:
    key, (fx, fy, cx, cy), distortion = lossy.model(name, camera, ("pinhole", "brown_conrady", "kannala_brandt", "mei"))
    if camera.image_size is not None:
        values_of_size = {"image_width": camera.image_size[1], "image_height": camera.image_size[0]}
        if values and any(values.get(key) != value for key, value in values_of_size.items()):
            lossy.fail(name, "must have the size of those before it, as OpenCV's file has one for all; got another")
        values.update(values_of_size)
    elif "image_width" in values:
        lossy.fail(name, "must have an image_size, as OpenCV's file has one for all cameras; got none")
    if key == "kannala_brandt":
        distortion = lossy.at_most(name, camera, distortion, (_FISHEYE_COUNT,))
    if key == "mei":
        values[f"xi_{end}" if end else "xi"] = distortion[0]
        distortion = distortion[1:]
    fisheye = int(key == "kannala_brandt")
    # one flag holds for all cameras, so they must agree even if some do not need it
    says = key != "mei" and (fisheye or len(distortion) == _FISHEYE_COUNT or end)
    if says and values.setdefault("fisheye_model", fisheye) != fisheye:
        lossy.fail(name, "must be a lens like those before it, as OpenCV's file has one fisheye_model; got another")
    joint = "_" if end.isalpha() else ""
    values[f"M{joint}{end}" if end else "camera_matrix"] = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    if distortion:
        values[f"D{joint}{end}" if end else "distortion_coefficients"] = [[value] for value in distortion]


def _text(suffix: str, values: dict[str, Any]) -> str:
    """Return numbers, and matrices as lists of rows, as `cv2.FileStorage` writes them: JSON, XML, or else YAML."""
    yaml, xml, whole = ["%YAML:1.0", "---"], ['<?xml version="1.0"?>', "<opencv_storage>"], dict[str, Any]()
    for key, value in values.items():
        if not isinstance(value, list):
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
    if suffix == ".json":
        return json.dumps(whole, indent=4, allow_nan=False) + "\n"
    return "\n".join([*xml, "</opencv_storage>"] if suffix == ".xml" else yaml) + "\n"
