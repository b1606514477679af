"""mrcal's .cameramodel, a Python literal, read as YAML: texts have no escapes."""

import re
from typing import Any

from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.record import Names, Record
from camtorch.io.writing import Lossy, number
from camtorch.models import Splined
from camtorch.values.arguments import LEFT

NAMES = Names("mrcal", "mrcal", (".cameramodel",), ("*.cameramodel",))

# lens model -> key, number of coefficients
_MODELS = {
    "LENSMODEL_PINHOLE": ("pinhole", 0),
    "LENSMODEL_LONLAT": ("equirectangular", 0),
    "LENSMODEL_LATLON": ("latlon", 0),
    "LENSMODEL_STEREOGRAPHIC": ("stereographic", 0),
    **{f"LENSMODEL_OPENCV{count}": ("brown_conrady", count) for count in (4, 5, 8, 12, 14)},
}
_SPLINED_NAME = "LENSMODEL_SPLINED_STEREOGRAPHIC_order={}_Nx={}_Ny={}_fov_x_deg={}"
_SPLINED = re.compile(r"LENSMODEL_SPLINED_STEREOGRAPHIC_order=(\d)_Nx=(\d{1,4})_Ny=(\d{1,4})_fov_x_deg=(\d{1,4})")


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of a cameramodel."""
    return any(key in keys for key in ("lensmodel", "lens_model")) and "imagersize" in keys


def parse(record: Record) -> Rig:
    """Return the camera; the rig is mrcal's reference. The valid region and the optimization inputs are not read."""
    name = record["lens_model" if "lens_model" in record else "lensmodel"]
    if found := _SPLINED.fullmatch(name.text()):
        order, columns, rows, fov_x = map(int, found.groups())
        try:
            model = Splined.with_grid(order=order, columns=columns, rows=rows, fov_x=fov_x)
        except ValueError as error:
            name.fail(error)
        key, count = model.key, model.default_count
    elif name.text() in _MODELS:
        key, count = _MODELS[name.text()]
    else:
        known = ", ".join(sorted([*_MODELS, _SPLINED_NAME.format(3, 16, 11, 120)]))
        name.fail(f"must be one of {known}; got {name.text()!r:.60}. {LEFT}")
    values = record["intrinsics"].numbers(4 + count)
    camera = record["intrinsics"].camera(key, values[:4], values[4:], record["imagersize"].size())
    place = record.get("rt_cam_ref" if "rt_cam_ref" in record else "extrinsics")
    if place is None:
        return Rig({"camera": camera})
    rt = place.numbers(6)
    return Rig({"camera": camera}, {"camera": poses.pose(place, rt[:3], rt[3:])})


def render(rig: Rig, lossy: Lossy) -> str:
    """Return the text of a file."""
    name, camera = lossy.only_camera(rig)
    lossy.no_images(rig)
    height, width = lossy.size(name, camera)
    known = {"splined", *(key for key, _ in _MODELS.values())}
    if isinstance(camera, Splined):
        grid = {"order": camera.order, "columns": camera.columns, "rows": camera.rows, "fov_x": camera.fov_x}
        known.add(Splined.with_grid(**grid).key)
    key, intrinsics, distortion = lossy.model(name, camera, known)
    if key == "stereographic":  # mrcal's model has no polynomial
        distortion = lossy.at_most(name, camera, distortion, (0,))
    if isinstance(camera, Splined):
        model = _SPLINED_NAME.format(camera.order, camera.columns, camera.rows, camera.fov_x)
    else:
        model = next(model for model, (k, count) in _MODELS.items() if k == key and count == len(distortion))
    rotation, translation = [0.0] * 3, [0.0] * 3
    if name in rig.extrinsics:
        rotation, translation = lossy.pose(name, rig.extrinsics[name])
    pose = _listed(rotation + translation)
    return f"""{{
    'lensmodel':  '{model}',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': {_listed([*intrinsics, *distortion])},

    'rt_cam_ref': {pose},
    'extrinsics': {pose}, # for compatibility with mrcal < 2.5

    'imagersize': [ {width}, {height},],
}}
"""


def _listed(values: list[float]) -> str:
    return f"[ {', '.join(map(number, values))},]"
