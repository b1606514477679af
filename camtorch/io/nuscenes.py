"""nuScenes' and nuImages' `calibrated_sensor.json`: all cameras of all drives, with the channels of `sensor.json`."""

import os
import re
from collections import Counter

from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.parsing import decoded, parse_json, read_bytes
from camtorch.io.record import Names, Record

NAMES = Names("nuscenes", "nuScenes")

_START = 4096  # the first sensor begins in these bytes


def matches(path: str, content: bytes) -> bool:
    """Whether a content is that of a `calibrated_sensor.json`."""
    return re.match(rb"\s*\[", content[:_START]) is not None and b'"sensor_token"' in content[:_START]


def read(path: str, content: bytes) -> Rig:
    """Return the cameras by channel, or token, and their poses, camera from ego. The file has no image sizes."""
    # sensors without intrinsics are lidars or radars
    sensors = [sensor for sensor in _table(path, content) if len(sensor["camera_intrinsic"])]
    Record(path, None).few(len(sensors))
    beside = path.removesuffix("calibrated_sensor.json") + "sensor.json"
    channels = {}
    if os.path.exists(beside):
        channels = {sensor["token"].text(): sensor["channel"].text() for sensor in _table(beside, read_bytes(beside))}
    names = [channels.get(sensor["sensor_token"].text(), "") for sensor in sensors]
    often = Counter(names)
    cameras: dict[str, Camera] = {}
    for sensor, channel in zip(sensors, names, strict=True):
        name = channel if channel and often[channel] == 1 else sensor["token"].text()
        if name in cameras:
            sensor["token"].fail(f"must be unique; got {name!r:.60} twice")
        intrinsics = sensor["camera_intrinsic"].intrinsics()
        lens = sensor.get("camera_distortion")  # only in nuImages
        distortion = [] if lens is None else lens.numbers()
        if lens is not None and len(distortion) == 6 and distortion.pop():
            lens.fail("a sixth coefficient must be 0, as nuImages documents no formula of fisheyes; got another")
        key = "brown_conrady" if distortion else "pinhole"
        cameras[name] = sensor.camera(key, intrinsics, distortion, None, lens=lens)
    if not cameras:
        return Rig({})
    values = [[*sensor["rotation"].numbers(4), *sensor["translation"].numbers(3)] for sensor in sensors]
    return Rig(cameras, (list(cameras), poses.from_quaternions(lambda row: sensors[row], values, undo=True)))


def _table(path: str, content: bytes) -> Record:
    return Record(path, parse_json(path, decoded(path, content)))
