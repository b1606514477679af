"""Attributes of CARLA's `sensor.camera.rt_lens` (Unreal Engine 5), as JSON; written only.

`for key, value in json.load(file)["attributes"].items(): blueprint.set_attribute(key, value)` makes the camera.
Focal lengths and centre are parts of the image's width and height, whose edges are 0 and 1. Source: CARLA,
`CameraModelUtil.cpp` and `SceneCaptureCamera_RayTracedLens.cpp`, 2026: kannala_brandt is that of OpenCV, with four
coefficients, brown_conrady has k1, k2, k3, p1, p2, and ftheta is the angle by powers of the distance in pixels, eight
of them from the constant on.
"""

from __future__ import annotations

import math

from camtorch.io.protocol import Names
from camtorch.io.writing import Lossy, as_json, number
from camtorch.rig import Rig

NAMES = Names("carla", "CARLA", (".json",))

_IDEAL = {  # key -> camera_model, without coefficients
    "pinhole": "perspective",
    "stereographic": "stereographic",
    "equisolid": "equisolid",
    "orthographic_fisheye": "orthographic",
}
_FITTED: dict[str, int | None] = {"kannala_brandt": 4, "brown_conrady": 5}
_POWERS = 6  # of ftheta beyond the first


def render(rig: Rig, path: str) -> str:
    """The text of a file of one camera, which loses its name."""
    lossy = Lossy(path, NAMES.title)
    lossy.no_pose(rig)
    name, camera = lossy.only_camera(rig)
    height, width = lossy.size(name, camera)
    models = _FITTED
    if camera.key in _IDEAL and not bool(camera.distortion.any()):
        models = {camera.key: None}
    elif camera.key == "f_theta_backward":
        models = {camera.key: _POWERS, **_FITTED}
    result, fit = lossy.closest(name, camera, models)
    kind = result.camera.key
    fx, fy, cx, cy = result.camera.intrinsics.tolist()
    values = result.camera.distortion.tolist()
    fx_unit, fy_unit = fx / width, fy / height
    if kind in _IDEAL:
        kind, values = _IDEAL[kind], []
    elif kind == "brown_conrady":
        k1, k2, p1, p2, k3 = values
        values = [k1, k2, k3, p1, p2]
    elif kind == "f_theta_backward":
        kind, values = "ftheta", [0.0, *(value / fx**i for i, value in enumerate([1.0, *values], 1))]
        fx_unit, fy_unit = 1 / width, fy / fx / height
    numbers = {
        "fx": fx_unit,
        "fy": fy_unit,
        "cx": (cx + 0.5) / width,
        "cy": (cy + 0.5) / height,
        "theta_max_deg": math.degrees(float(result.max_angle)),
    }
    attributes = {
        "image_size_x": str(width),
        "image_size_y": str(height),
        "camera_model": kind,
        **{key: number(value) for key, value in numbers.items()},
        "distortion_coeffs": ",".join(map(number, values)),
    }
    return as_json({"blueprint": "sensor.camera.rt_lens", "lens": fit, "attributes": attributes})
