"""mrcal's .cameramodel, a Python literal that is read without Python."""

from __future__ import annotations

from typing import Any

from camtorch.extrinsics import Extrinsics
from camtorch.io import poses
from camtorch.io.protocol import Names
from camtorch.io.record import Record, one_of
from camtorch.io.writing import Lossy, number
from camtorch.rig import Rig

NAMES = Names("mrcal", "mrcal", (".cameramodel",), ("*.cameramodel",))

# lens model -> key, number of coefficients
_MODELS = {
    "LENSMODEL_PINHOLE": ("pinhole", 0),
    "LENSMODEL_LONLAT": ("equirectangular", 0),
    "LENSMODEL_LATLON": ("latlon", 0),
    "LENSMODEL_STEREOGRAPHIC": ("stereographic", 0),
    "LENSMODEL_CAHVOR": ("cahvor", 5),
    **{f"LENSMODEL_OPENCV{count}": ("brown_conrady", count) for count in (4, 5, 8, 12, 14)},
}
# a CAHVORE says its linearity in the name, and ends with e0 e1 e2
_CAHVORE = "LENSMODEL_CAHVORE_linearity="


def matches(keys: dict[str, Any]) -> bool:
    """Whether these are the keys of such a file."""
    return any(key in keys for key in ("lensmodel", "lens_model")) and "imagersize" in keys


def parse(record: Record) -> Rig:
    """The camera; the rig is mrcal's reference. The valid region and the optimization inputs are not read."""
    name = record["lens_model" if "lens_model" in record else "lensmodel"]
    if name.text().startswith(_CAHVORE):
        linearity = Record(name.path, name.text().removeprefix(_CAHVORE), name.place)
        key, values = "cahvore", _central(record["intrinsics"], linearity)
    else:
        key, count = _MODELS[one_of(name, [*_MODELS, f"{_CAHVORE}..."])]
        values = record["intrinsics"].numbers(4 + count)
    camera = record["intrinsics"].camera(key, values[:4], values[4:], record["imagersize"].size())
    extrinsics: dict[str, Extrinsics] = {}
    for place in ("rt_cam_ref", "extrinsics"):
        if place in record and not extrinsics:
            rt = record[place].numbers(6)
            extrinsics["camera"] = poses.pose(record[place], rt[:3], rt[3:])
    return Rig({"camera": camera}, extrinsics)


def _central(record: Record, linearity: Record) -> list[float]:
    """The numbers of a CAHVORE, with its linearity in the place of e0 e1 e2, which are zeros."""
    values = record.numbers(12)
    if any(values[9:]):
        record.fail(f"e0, e1, e2 = {values[9:]}: its rays do not pass one point, as those of each camera here do")
    return [*values[:9], linearity.number()]


def render(rig: Rig, path: str) -> str:
    """The text of a file."""
    lossy = Lossy(path, NAMES.title)
    name, camera = lossy.only_camera(rig)
    lossy.no_images(rig)
    height, width = lossy.size(name, camera)
    key, intrinsics, distortion = lossy.model(name, camera, {"cahvore", *(key for key, _ in _MODELS.values())})
    if key == "stereographic":  # without the polynomial
        distortion = lossy.at_most(name, camera, distortion, (0,))
    if key == "cahvore":
        *distortion, linearity = distortion
        model, distortion = f"{_CAHVORE}{number(linearity)}", [*distortion, 0.0, 0.0, 0.0]
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
