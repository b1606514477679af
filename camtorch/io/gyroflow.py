"""Gyroflow's lens profiles: JSON with the matrix and the coefficients of OpenCV."""

from __future__ import annotations

from typing import Any

from camtorch.io.protocol import Names
from camtorch.io.record import Record, one_of
from camtorch.io.writing import Lossy, as_json
from camtorch.rig import Rig

NAMES = Names("gyroflow", "Gyroflow", (".json",), ("*gyroflow*.json",))

# distortion_model -> key, how many coefficients may stand there
_MODELS = {"opencv_fisheye": ("kannala_brandt", (4,)), "opencv_standard": ("brown_conrady", (4, 5, 8, 12))}
_STRETCHES = ("input_horizontal_stretch", "input_vertical_stretch")


def matches(keys: dict[str, Any]) -> bool:
    """Whether these are the keys of such a file."""
    return "fisheye_params" in keys and "calib_dimension" in keys


def parse(record: Record) -> Rig:
    """The camera of the images that were calibrated, with the centre that was found, which Gyroflow leaves out of
    account where `asymmetrical` is not set. Images stretched, cropped or of a computed lens are refused.
    """
    for key in (*_STRETCHES, "crop", "digital_lens"):
        if key in record and record[key].value not in (1.0, None):
            record[key].fail(f"{record[key].value!r:.60}, which no model here has")
    named = "distortion_model" in record and record["distortion_model"].value is not None
    key, _ = _MODELS[one_of(record["distortion_model"], _MODELS) if named else "opencv_fisheye"]
    matrix, coefficients = (record["fisheye_params"][name] for name in ("camera_matrix", "distortion_coeffs"))
    intrinsics = matrix.intrinsics([number for row in matrix.rows(3, 3) for number in row])
    size = record["calib_dimension"]["h"].side(), record["calib_dimension"]["w"].side()
    return Rig({"camera": record.camera(key, intrinsics, coefficients.numbers(), size, lens=coefficients)})


def render(rig: Rig, path: str) -> str:
    """The text of a file of one camera, whose name is the profile's."""
    lossy = Lossy(path, NAMES.title)
    lossy.no_pose(rig)
    name, camera = lossy.only_camera(rig)
    height, width = lossy.size(name, camera)
    key, (fx, fy, cx, cy), distortion = lossy.model(name, camera, {key for key, _ in _MODELS.values()})
    kind, counts = next((kind, counts) for kind, (k, counts) in _MODELS.items() if k == key)
    lens = {
        "RMS_error": 0.0,
        "camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "distortion_coeffs": lossy.at_most(name, camera, distortion, counts),
    }
    size = {"w": width, "h": height}
    keys = {"name": name, "calibrator_version": "camtorch", "calib_dimension": size, "orig_dimension": size}
    stretches = dict.fromkeys(_STRETCHES, 1.0)
    return as_json({**keys, "asymmetrical": True, **stretches, "distortion_model": kind, "fisheye_params": lens})
