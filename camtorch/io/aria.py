"""Project Aria's device calibration JSON."""

import math
from typing import Any

from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.record import Names, Record, one_of
from camtorch.io.writing import Lossy, as_json

NAMES = Names("aria", "Aria", (".json",))

# Projection.Name -> key, number of focal lengths, number of coefficients
_MODELS = {
    "FisheyeRadTanThinPrism": ("fisheye624", 1, 12),
    "Fisheye62": ("fisheye62", 1, 8),
    "KannalaBrandtK3": ("kannala_brandt", 2, 4),
    "Linear": ("pinhole", 2, 0),
    "Spherical": ("kannala_brandt", 2, 0),
}


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of an Aria file."""
    return "CameraCalibrations" in keys


def parse(record: Record) -> Rig:
    """Return the cameras by their labels; the rig is the device. `MaxSolidAngle`, IMUs and other keys are not read."""
    cameras, extrinsics = {}, {}
    record.few(len(record["CameraCalibrations"]))
    for entry in record["CameraCalibrations"]:
        name = entry["Label"].text()
        if name in cameras:
            entry["Label"].fail(f"must be unique; got {name!r:.60} twice")
        projection = entry["Projection"]
        key, focals, count = _MODELS[one_of(projection["Name"], _MODELS)]
        values = projection["Params"].numbers(focals + 2 + count)
        if focals == 1:  # of both directions
            values = [values[0], *values]
        distortion = [0.0] * 4 if projection["Name"].value == "Spherical" else values[4:]
        size = None
        config = entry.get("ConfigData")
        if config is not None and "ImageWidth" in config:
            size = config["ImageHeight"].side(), config["ImageWidth"].side()
        cameras[name] = projection.camera(key, values[:4], distortion, size)
        if "T_Device_Camera" in entry:
            place = entry["T_Device_Camera"]
            quaternion = place["UnitQuaternion"]
            if len(quaternion) != 2:
                quaternion.fail(f"must be [w, [x, y, z]]; got {quaternion.value!r:.60}")
            w, xyz = quaternion
            numbers = [w.number(), *xyz.numbers(3), *place["Translation"].numbers(3)]
            extrinsics[name] = poses.from_quaternions(quaternion, numbers, undo=True)
    return Rig(cameras, extrinsics)


def render(rig: Rig, lossy: Lossy) -> str:
    """Return the text of a file that projectaria_tools reads."""
    entries = []
    for name, extrinsics in lossy.all_posed(rig).items():
        camera = rig.cameras[name]
        height, width = lossy.size(name, camera)
        key, (fx, fy, cx, cy), distortion = lossy.model(name, camera, {key for key, _, _ in _MODELS.values()})
        kind, focals, count = next((kind, f, count) for kind, (k, f, count) in _MODELS.items() if k == key)
        if focals == 1 and fx != fy:
            lossy.fail(name, f"must have one focal length for {lossy.format}; got fx = {fx!r} and fy = {fy!r}")
        w, x, y, z, *translation = poses.quaternions(extrinsics, undo=True).tolist()
        entries.append(
            {
                "Calibrated": True,
                "ConfigData": {"ImageHeight": height, "ImageWidth": width, "MaxSolidAngle": math.pi},
                "Label": name,
                "Projection": {
                    "Description": f"see {kind}.h",
                    "Name": kind,
                    "Params": [*(fx, fy)[:focals], cx, cy, *lossy.at_most(name, camera, distortion, (count,))],
                },
                "SerialNumber": "0",
                "T_Device_Camera": {"Translation": translation, "UnitQuaternion": [w, [x, y, z]]},
            }
        )
    whole = {
        "AlgorithmName": "camtorch",
        "AlgorithmVersion": "1",
        "CalibrationSource": "Unknown",
        "CameraCalibrations": entries,
        "DeviceClassInfo": {"BuildVersion": "DVT-S", "DeviceClass": "Aria"},
        "FileFormat": {"Tags": [], "Timestamp": "", "UnixTime": 0, "Version": 3},
        # projectaria_tools accepts no other origin, even if the file has no such camera
        "OriginSpecification": {"ChildLabel": "camera-slam-left", "Type": "Custom"},
        "Serial": "",
    }
    return as_json(whole)
