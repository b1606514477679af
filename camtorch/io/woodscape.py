"""WoodScape's calibrations: JSON of one camera, a polynomial of the angle in pixels, the pose vehicle from camera."""

from __future__ import annotations

from typing import Any

from camtorch.io import poses
from camtorch.io.protocol import Names
from camtorch.io.record import Record, one_of
from camtorch.io.writing import Lossy, as_json, multiple
from camtorch.rig import Rig

NAMES = Names(
    "woodscape", "WoodScape", (".json",), ("*woodscape*.json", *(f"*_{c}.json" for c in ("fv", "rv", "mvl", "mvr")))
)
_POWERS = ("k1", "k2", "k3", "k4")


def matches(keys: dict[str, Any]) -> bool:
    """Whether these are the keys of such a file."""
    return "extrinsic" in keys and isinstance(keys.get("intrinsic"), dict) and "k1" in keys["intrinsic"]


def parse(record: Record) -> Rig:
    """The camera by its name, with its pose: camera from vehicle."""
    lens, name = record["intrinsic"], record["name"].text() if "name" in record else "camera"
    one_of(lens["model"], ("radial_poly",))
    height, width = lens["height"].side(), lens["width"].side()
    focal, *higher = (lens[power].number() for power in _POWERS)
    if focal == 0:
        lens["k1"].fail("0, where the focal length belongs")
    centre = [lens[key].number() + (side - 1) / 2 for key, side in (("cx_offset", width), ("cy_offset", height))]
    intrinsics = [focal, focal * lens["aspect_ratio"].number(), *centre]
    camera = lens.camera("woodscape", intrinsics, [k / focal for k in higher], (height, width))
    pose = record["extrinsic"]
    x, y, z, w = pose["quaternion"].numbers(4)
    vehicle = [w, x, y, z, *pose["translation"].numbers(3)]
    return Rig({name: camera}, {name: poses.from_quaternions(pose, vehicle, undo=True)})


def render(rig: Rig, path: str) -> str:
    """The text of a file of one camera; one without a pose is where the vehicle is."""
    lossy = Lossy(path, NAMES.title)
    name, camera = lossy.only_camera(rig)
    height, width = lossy.size(name, camera)
    _, (fx, fy, cx, cy), distortion = lossy.model(name, camera, ("woodscape",))
    w, x, y, z, *translation = poses.quaternions(lossy.all_posed(rig)[name], undo=True).tolist()
    lens = {
        **{"model": "radial_poly", "poly_order": 4, "aspect_ratio": fy / fx, "width": width, "height": height},
        **{"cx_offset": cx - (width - 1) / 2, "cy_offset": cy - (height - 1) / 2},
        **dict(zip(_POWERS, [fx, *(multiple(k, fx) for k in distortion)], strict=True)),
    }
    return as_json(
        {"name": name, "extrinsic": {"quaternion": [x, y, z, w], "translation": translation}, "intrinsic": lens}
    )
