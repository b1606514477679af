"""WoodScape's calibrations: JSON of one camera, a polynomial of the angle in pixels, the pose vehicle from camera."""

from typing import Any

from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.record import Names, Record, one_of

NAMES = Names("woodscape", "WoodScape")
_POWERS = ("k1", "k2", "k3", "k4")


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of a WoodScape calibration."""
    return "extrinsic" in keys and isinstance(keys.get("intrinsic"), dict) and "k1" in keys["intrinsic"]


def parse(record: Record) -> Rig:
    """Return the camera by its name, with its pose, camera from vehicle."""
    lens, name = record["intrinsic"], record["name"].text() if "name" in record else "camera"
    one_of(lens["model"], ("radial_poly",))
    height, width = lens["height"].side(), lens["width"].side()
    focal, *higher = (lens[power].number() for power in _POWERS)
    if focal == 0:
        lens["k1"].fail("the focal length must not be 0; got 0")
    centre = [lens[key].number() + (side - 1) / 2 for key, side in (("cx_offset", width), ("cy_offset", height))]
    intrinsics = [focal, focal * lens["aspect_ratio"].number(), *centre]
    camera = lens.camera("woodscape", intrinsics, [k / focal for k in higher], (height, width))
    pose = record["extrinsic"]
    x, y, z, w = pose["quaternion"].numbers(4)
    vehicle = [w, x, y, z, *pose["translation"].numbers(3)]
    return Rig({name: camera}, {name: poses.from_quaternions(pose, vehicle, undo=True)})
