"""Scenes of USD as text, for Omniverse and Isaac: cameras with NVIDIA's schemas of lens distortion; written only.

Cameras look along -z there, y up; matrices act on rows; pixel centres are at 0.5; attributes are float32. Source:
`omni.usd.schema.omni_lens_distortion` 1.0.0 has names, types and units, and Newton's reader of such cameras
the pixel centres. Lenses of other models become one of OpenCV's two schemas; not every renderer takes the coefficients
of OpenCvPinhole.
"""

from __future__ import annotations

import math
import re

from camtorch.camera import Camera
from camtorch.io import poses
from camtorch.io.protocol import Names
from camtorch.io.writing import Lossy
from camtorch.rig import Rig

NAMES = Names("usda", "USD", (".usda",), ("*.usda",))

# key -> number of coefficients, schema, names of its coefficients
_OPENCV = {
    "brown_conrady": (12, "OpenCvPinhole", "k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4"),
    "kannala_brandt": (4, "OpenCvFisheye", "k1 k2 k3 k4"),
}
# those of one focal length. The page of RadTanThinPrism has no place for it: it is that of the camera, as in Aria's
# model, whose names these are. Ftheta is the angle by powers of the distance in pixels, its default k1 being 0.00245
_SQUARE = {
    "fisheye624": (12, "RadTanThinPrism", "k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
    "f_theta_backward": (3, "Ftheta", "k0 k1 k2 k3 k4"),
}
# key -> of those, the one that may hold it exactly
_HELD = dict.fromkeys(("kannala_brandt", "fisheye62", "fisheye624"), "fisheye624")
_HELD["f_theta_backward"] = "f_theta_backward"
_APERTURE = 36.0  # any: what counts is its ratio to the focal length

_HEAD = """#usda 1.0
(
    defaultPrim = "rig"
    metersPerUnit = 1
)

def Xform "rig"
{
"""


def render(rig: Rig, path: str) -> str:
    """The text of a scene: cameras below an Xform, which is the rig. Lengths are the rig's, said to be metres."""
    lossy = Lossy(path, NAMES.title)
    prims: dict[str, str] = {}
    for name, extrinsics in lossy.all_posed(rig).items():
        prim = re.sub(r"[^A-Za-z0-9_]|^(?=[0-9])|^$", "_", name)
        if prim in prims:
            lossy.fail(name, f"{prim}, which it is called in USD, is another camera, too")
        camera = rig.cameras[name]
        size = lossy.size(name, camera)
        models: dict[str, int | None] = {key: count for key, (count, _, _) in _OPENCV.items()}
        if camera.key in _HELD and not camera.batch_shape and bool(camera.intrinsics[0] == camera.intrinsics[1]):
            models[_HELD[camera.key]] = _SQUARE[_HELD[camera.key]][0]
        result, fit = lossy.closest(name, camera, models)
        schema, lens = _lens(result.camera, size, math.degrees(2 * float(result.max_angle)))
        columns = (poses.matrices(extrinsics, undo=True).numpy() * poses.UPRIGHT + 0.0).T.tolist()
        lines = [
            f'def Camera "{prim}" (',
            f'    doc = "{fit}"',
            f'    prepend apiSchemas = ["OmniLensDistortion{schema}API"]',
            ")",
            "{",
            *(f"    {line}" for line in lens),
            f"    matrix4d xformOp:transform = ({', '.join(str(tuple(column)) for column in columns)})",
            '    uniform token[] xformOpOrder = ["xformOp:transform"]',
            "}",
        ]
        prims[prim] = "".join(f"    {line}\n" for line in lines)
    return _HEAD + "\n".join(prims.values()) + "}\n"


def _lens(camera: Camera, size: tuple[int, int], fov: float) -> tuple[str, list[str]]:
    """The schema of a camera and its attributes; fov in degrees."""
    height, width = size
    fx, fy, cx, cy = camera.intrinsics.tolist()
    cx, cy = cx + 0.5, cy + 0.5
    _, schema, names = (_OPENCV | _SQUARE)[camera.key]
    model = schema[0].lower() + schema[1:].replace("Cv", "cv")
    across = height * fx / fy * _APERTURE / width
    values = camera.distortion.tolist()
    if camera.key in _OPENCV:
        core = f"float fx = {fx}|float fy = {fy}|float cx = {cx}|float cy = {cy}|int2 imageSize = {(width, height)}"
    else:
        core = f"float nominalWidth = {width}|float nominalHeight = {height}|float2 opticalCenter = {(cx, cy)}"
        core += f"|float maxFov = {fov}"
    if schema == "Ftheta":
        values = [0.0, *(value / fx**i for i, value in enumerate([1.0, *values], 1))]
    own = [*core.split("|"), *(f"float {k} = {value}" for k, value in zip(names.split(), values, strict=True))]
    return schema, [
        "float2 clippingRange = (0.01, 1000000)",
        # what renderers that do not know the schemas take
        f"float focalLength = {fx * _APERTURE / width}",
        f"float horizontalAperture = {_APERTURE}",
        f"float verticalAperture = {across}",
        f"float horizontalApertureOffset = {(0.5 - cx / width) * _APERTURE}",
        f"float verticalApertureOffset = {(cy / height - 0.5) * across}",
        f'token omni:lensdistortion:model = "{model}"',
        *(line.replace(" ", f" omni:lensdistortion:{model}:", 1) for line in own),
    ]
