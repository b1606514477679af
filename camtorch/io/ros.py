"""ROS camera_info: the YAML of camera_calibration, or a message as `rostopic echo` prints it."""

import json
from typing import Any

from camtorch.cameras.rig import Rig
from camtorch.io.record import Names, Record, one_of
from camtorch.io.writing import Lossy, listed

NAMES = Names("ros", "ROS camera_info", (".yaml", ".yml"), ("*camera_info*", "*camerainfo*"))

_MODELS = {
    "plumb_bob": ("brown_conrady", (4, 5)),
    "rational_polynomial": ("brown_conrady", (8, 12, 14)),
    "equidistant": ("kannala_brandt", (4,)),
    "fisheye": ("kannala_brandt", (4,)),
    "none": ("pinhole", ()),
    "": ("pinhole", ()),
}


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of a camera_info."""
    return "distortion_model" in keys and any(key in keys for key in ("camera_matrix", "K", "k"))


def parse(record: Record) -> Rig:
    """Return the camera of a file from K and D. R and P, the rectification of a stereo pair, are not read."""
    name = record["camera_name"].text() if "camera_name" in record else "camera"
    width, height = (_either(record, f"image_{side}", side).side() for side in ("width", "height"))
    intrinsics = _either(record, "camera_matrix", "K", "k").intrinsics()
    key, counts = _MODELS[one_of(record["distortion_model"], _MODELS)]
    coefficients = _either(record, "distortion_coefficients", "D", "d")
    distortion = coefficients.flat()
    while len(distortion) > max(counts, default=0) and not distortion[-1]:
        distortion.pop()  # messages of fixed length are padded with zeros
    if not distortion:
        key = "pinhole"
    elif len(distortion) not in counts:
        takes = " or ".join(map(str, counts)) or "none"
        coefficients.fail(f"must have {takes} for {record['distortion_model'].value!r}; got {len(distortion)}")
    return Rig({name or "camera": coefficients.camera(key, intrinsics, distortion, (height, width))})


def _either(record: Record, *keys: str) -> Record:
    return record[next((key for key in keys if key in record), keys[0])]


def render(rig: Rig, lossy: Lossy) -> str:
    """Return the text of a file: R is the identity, and P is K."""
    name, camera = lossy.only_camera(rig)
    lossy.no_pose(rig)
    height, width = lossy.size(name, camera)
    key, (fx, fy, cx, cy), distortion = lossy.model(name, camera, ("pinhole", "brown_conrady", "kannala_brandt"))
    model = "rational_polynomial" if len(distortion) > 5 else "plumb_bob"
    if key == "kannala_brandt":
        model, distortion = "equidistant", lossy.at_most(name, camera, distortion, (4,))
    lines = [
        f"image_width: {width}",
        f"image_height: {height}",
        f"camera_name: {json.dumps(name, ensure_ascii=False)}",
        *_matrix("camera_matrix", 3, 3, [fx, 0, cx, 0, fy, cy, 0, 0, 1]),
        f"distortion_model: {model}",
        *_matrix("distortion_coefficients", 1, len(distortion), distortion),
        *_matrix("rectification_matrix", 3, 3, [1, 0, 0, 0, 1, 0, 0, 0, 1]),
        *_matrix("projection_matrix", 3, 4, [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]),
    ]
    return "\n".join(lines) + "\n"


def _matrix(key: str, rows: int, cols: int, data: list[float]) -> list[str]:
    return [f"{key}:", f"  rows: {rows}", f"  cols: {cols}", f"  data: {listed(data)}"]
