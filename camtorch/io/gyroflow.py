"""Gyroflow's lens profiles: JSON with the matrix and the coefficients of OpenCV."""

from typing import Any

from camtorch.cameras.rig import Rig
from camtorch.io.record import Names, Record, one_of

NAMES = Names("gyroflow", "Gyroflow")

_MODELS = {"opencv_fisheye": "kannala_brandt", "opencv_standard": "brown_conrady"}
_STRETCHES = ("input_horizontal_stretch", "input_vertical_stretch")


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of a Gyroflow lens profile."""
    return "fisheye_params" in keys and "calib_dimension" in keys


def parse(record: Record) -> Rig:
    """Return the camera of the calibrated images, with the measured centre, whether or not `asymmetrical` is set."""
    for key in (*_STRETCHES, "crop", "digital_lens"):
        if key in record and record[key].value not in (1.0, None):
            record[key].fail(f"must be 1.0 or null, because no model has it; got {record[key].value!r:.60}")
    named = "distortion_model" in record and record["distortion_model"].value is not None
    key = _MODELS[one_of(record["distortion_model"], _MODELS) if named else "opencv_fisheye"]
    matrix, coefficients = (record["fisheye_params"][name] for name in ("camera_matrix", "distortion_coeffs"))
    intrinsics = matrix.intrinsics()
    size = record["calib_dimension"]["h"].side(), record["calib_dimension"]["w"].side()
    return Rig({"camera": record.camera(key, intrinsics, coefficients.numbers(), size, lens=coefficients)})
