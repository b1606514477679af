"""camodocal's camera files, also those of KITTI-360's fisheyes and of VINS: YAML of one camera."""

from typing import Any

from camtorch.cameras.rig import Rig
from camtorch.io.record import Names, Record, one_of

NAMES = Names("camodocal", "camodocal")

_GROUPS = ("mirror_parameters", "distortion_parameters", "projection_parameters")
_RADTAN = ("k1", "k2", "p1", "p2")
# model_type -> key, names of the coefficients by their groups; the last group has the intrinsics
_MODELS = {
    "MEI": ("mei", (("xi",), _RADTAN, ("gamma1", "gamma2", "u0", "v0"))),
    "PINHOLE": ("brown_conrady", ((), _RADTAN, ("fx", "fy", "cx", "cy"))),
    "KANNALA_BRANDT": ("kannala_brandt", ((), (), ("k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0"))),
}


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of a camodocal file."""
    return "model_type" in keys and "projection_parameters" in keys


def parse(record: Record) -> Rig:
    """Return the camera by its name, or as "camera" if the name is empty."""
    key, names = _MODELS[one_of(record["model_type"], _MODELS)]
    groups = [(record[group], there) for group, there in zip(_GROUPS, names, strict=True) if there]
    values = [group[name].number() for group, there in groups for name in there]
    size = record["image_height"].side(), record["image_width"].side()
    name = record["camera_name"].text() if "camera_name" in record else ""
    return Rig({name or "camera": record.camera(key, values[-4:], values[:-4], size)})
