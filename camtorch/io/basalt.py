"""Basalt's calibration: JSON as cereal writes it."""

from typing import Any

from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.record import Names, Record, one_of
from camtorch.io.writing import Lossy, as_json

NAMES = Names("basalt", "Basalt", (".json",))

_CORE = ("fx", "fy", "cx", "cy")
# camera_type -> key, the names of its coefficients
_MODELS = {
    "pinhole": ("pinhole", ()),
    "ds": ("double_sphere", ("xi", "alpha")),
    "eucm": ("eucm", ("alpha", "beta")),
    "ucm": ("ucm", ("alpha",)),
    "kb4": ("kannala_brandt", ("k1", "k2", "k3", "k4")),
    "fov": ("fov", ("w",)),
    "pinhole-radtan8": ("brown_conrady", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
# required by the constructor of Basalt's Calibration; a rig of cameras has no such values
_IMU = {
    "calib_accel_bias": [0.0] * 9,
    "calib_gyro_bias": [0.0] * 12,
    "imu_update_rate": 200.0,
    "accel_noise_std": [0.016] * 3,
    "gyro_noise_std": [0.000282] * 3,
    "accel_bias_std": [0.001] * 3,
    "gyro_bias_std": [0.0001] * 3,
    "cam_time_offset_ns": 0,
    "vignette": [],
}


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of a Basalt file."""
    return isinstance(keys.get("value0"), dict)


def parse(record: Record) -> Rig:
    """Return the cameras cam0, cam1, ...; the rig is the IMU. IMU, vignette and the radius `rpmax` are not read."""
    record = record["value0"]
    models, sizes, places = (list(record[key]) for key in ("intrinsics", "resolution", "T_imu_cam"))
    for key, items in (("resolution", sizes), ("T_imu_cam", places)):
        if len(items) != len(models):
            record[key].fail(f"must have one entry a camera; got {len(items)} for {len(models)} cameras")
    record.few(len(models))
    cameras, extrinsics = {}, {}
    for i, (model, size, place) in enumerate(zip(models, sizes, places, strict=True)):
        key, coefficients = _MODELS[one_of(model["camera_type"], _MODELS)]
        values = model["intrinsics"]
        intrinsics, distortion = ([values[name].number() for name in names] for names in (_CORE, coefficients))
        cameras[f"cam{i}"] = values.camera(key, intrinsics, distortion, size.size())
        numbers = [place[name].number() for name in ("qw", "qx", "qy", "qz", "px", "py", "pz")]
        extrinsics[f"cam{i}"] = poses.from_quaternions(place, numbers, undo=True)
    return Rig(cameras, extrinsics)


def render(rig: Rig, lossy: Lossy) -> str:
    """Return the text of a file; the cameras lose their names, and the IMU gets Basalt's defaults."""
    placed, models, sizes = [], [], []
    for name, extrinsics in lossy.all_posed(lossy.numbered(rig)).items():
        camera = rig.cameras[name]
        height, width = lossy.size(name, camera)
        key, intrinsics, distortion = lossy.model(name, camera, {key for key, _ in _MODELS.values()})
        camera_type, names = next((kind, names) for kind, (k, names) in _MODELS.items() if k == key)
        numbers = [*intrinsics, *lossy.at_most(name, camera, distortion, (len(names),))]
        values = dict(zip((*_CORE, *names), numbers, strict=True))
        if camera_type == "pinhole-radtan8":
            values["rpmax"] = 0.0
        models.append({"camera_type": camera_type, "intrinsics": values})
        sizes.append([width, height])
        w, x, y, z, px, py, pz = poses.quaternions(extrinsics, undo=True).tolist()
        placed.append({"px": px, "py": py, "pz": pz, "qx": x, "qy": y, "qz": z, "qw": w})
    return as_json({"value0": {"T_imu_cam": placed, "intrinsics": models, "resolution": sizes, **_IMU}})
