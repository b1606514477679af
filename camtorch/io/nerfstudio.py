"""Nerfstudio's transforms.json: pixel centres at 0.5, cameras with y up and z back, poses camera-to-world."""

import math
from array import array
from typing import Any

import numpy as np

from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.record import Names, Record, one_of
from camtorch.io.writing import Lossy, as_json

NAMES = Names("nerfstudio", "Nerfstudio", (".json",), ("transforms*.json",), ("transforms.json",))

# camera_model -> key
_MODELS = {
    "OPENCV": "brown_conrady",
    "OPENCV_FISHEYE": "kannala_brandt",
    "PINHOLE": "pinhole",
    "SIMPLE_PINHOLE": "pinhole",
    "SIMPLE_RADIAL": "brown_conrady",
    "RADIAL": "brown_conrady",
    "FISHEYE624": "fisheye624",
    "EQUIRECTANGULAR": "equirectangular",
}
_RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")
_TANGENTIAL = ("p1", "p2")
_CORE = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
_OF_A_CAMERA = ("camera_model", "is_fisheye", *_CORE, *_RADIAL, *_TANGENTIAL, "distortion_params")


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of a transforms.json."""
    has_frames = isinstance(keys.get("frames"), list) and "camtorch" not in keys
    return has_frames or any(key in keys for key in ("fl_x", "camera_angle_x", "x_fov"))


def parse(record: Record) -> Rig:
    """Return the camera of all frames as "camera", or one for each frame, and the poses of the frames."""
    cameras: dict[str, Camera] = {}
    names: dict[str, str | None] = {}  # of the images, and of the camera that they share
    found = array("d")
    frames = list(record["frames"]) if "frames" in record else []
    own = [any(key in frame for key in _OF_A_CAMERA) for frame in frames]
    record.few(sum(own))
    if not frames or not all(own):
        cameras["camera"] = _camera(record)
    for frame, has_own in zip(frames, own, strict=True):
        name = frame["file_path"].text()
        if name in names or name in cameras:
            frame["file_path"].fail(f"must be unique; got {name!r:.60} twice")
        if has_own:
            cameras[name] = _camera(record, frame)
        names[name] = None if has_own else "camera"
        for row in poses.matrix_rows(frame["transform_matrix"]):
            found.extend(row)
    if not found:
        return Rig(cameras)
    rows = np.array(found).reshape(-1, 4, 4) * poses.UPRIGHT
    batch = poses.from_matrices(lambda row: frames[row]["transform_matrix"], rows, undo=True)
    return Rig(cameras, (list(names), batch), images={name: camera for name, camera in names.items() if camera})


def _camera(record: Record, frame: Record | None = None) -> Camera:
    """Return the camera of a file, with the entries that a frame adds."""
    values = {key: record.value[key] for key in _OF_A_CAMERA if key in record}
    merged = Record(record.path, values, record.place)
    if frame is not None:
        for key in filter(frame.__contains__, _OF_A_CAMERA):
            if values.setdefault(key, frame.value[key]) != frame.value[key]:
                record[key].fail("must be that of all frames, as Nerfstudio uses it for all; got another in a frame")
        merged.place = frame.place
    model = "OPENCV_FISHEYE" if values.get("is_fisheye") is True else "OPENCV"  # instant-ngp's flag
    if "camera_model" in merged:
        model = one_of(merged["camera_model"], _MODELS)
    size = (merged["h"].side(), merged["w"].side()) if "h" in merged and "w" in merged else None
    key = _MODELS[model]
    if key == "equirectangular":
        size = merged["h"].side(), merged["w"].side()
        return merged.camera(key, panorama(size), [], size)
    focals = [focal for focal in (_focal(merged, "x", "w"), _focal(merged, "y", "h")) if focal is not None]
    if not focals:
        merged["fl_x"].number()
    centre = [merged[c].number() if c in merged else merged[side].side() / 2 for c, side in (("cx", "w"), ("cy", "h"))]
    key, distortion = _distortion(merged, key)
    return merged.camera(key, [focals[0], focals[-1], centre[0] - 0.5, centre[1] - 0.5], distortion, size)


def _focal(record: Record, axis: str, side: str) -> float | None:
    """Return the focal length along an axis, as given or from the field of view; None if the file has neither."""
    if f"fl_{axis}" in record:
        return record[f"fl_{axis}"].number()
    for key, unit in ((f"camera_angle_{axis}", 1.0), (f"{axis}_fov", math.pi / 180)):
        if key in record:
            angle = record[key].number() * unit
            if not 1e-6 < angle < math.pi:
                record[key].fail(f"must be an angle of a pinhole camera; got {record[key].value}")
            return record[side].side() / 2 / math.tan(angle / 2)
    return None


def _distortion(record: Record, key: str) -> tuple[str, list[float]]:
    """Return model and coefficients; coefficients that the model does not have must be zero."""
    if key == "fisheye624":
        return key, record["distortion_params"].numbers(12)
    there = {name: record[name].number() for name in (*_RADIAL, *_TANGENTIAL) if name in record}
    if key == "pinhole" and any(there.values()):
        key = "brown_conrady"  # Nerfstudio treats both alike
    names = {"pinhole": (), "kannala_brandt": ("k1", "k2", "k3", "k4")}.get(key, ("k1", "k2", "p1", "p2", "k3"))
    for name, value in there.items():
        if value and name not in names:
            record[name].fail(f"must be 0, as Nerfstudio does not use it with this camera_model; got {value:g}")
    if key == "brown_conrady":
        if not there:
            return "pinhole", []
        names = names if "k3" in there else names[:4]
    return key, [there.get(name, 0.0) for name in names]


def panorama(size: tuple[int, int]) -> list[float]:
    """Return the intrinsics of the equirectangular image of the whole sphere."""
    height, width = size
    return [width / (2 * math.pi), height / math.pi, width / 2 - 0.5, height / 2 - 0.5]


def render(rig: Rig, lossy: Lossy) -> str:
    """Return the text of a file: one camera for all frames, or one for each frame."""
    written = {name: _entries(lossy, name, camera) for name, camera in rig.cameras.items()}
    models = {name: entries.pop("camera_model") for name, entries in written.items()}
    if len(set(models.values())) != 1:
        lossy.fail("cameras", f"must have one camera_model; got {', '.join(sorted(set(models.values()))) or 'none'}")
    for name in rig.cameras:
        if len(rig.cameras) > 1 and name not in rig.extrinsics and name not in rig.images.values():
            lossy.fail(name, "must have extrinsics, as frames distinguish the cameras; got none")
    shared = len(rig.cameras) == 1 and next(iter(rig.cameras)) not in rig.extrinsics
    whole: dict[str, Any] = {"camera_model": next(iter(models.values()))}
    if shared:
        whole.update(next(iter(written.values())))
    whole["frames"] = []
    matrices = (poses.matrices(poses.all_of(rig, lossy), undo=True).numpy() * poses.UPRIGHT + 0.0).tolist()
    for name, rows in zip(rig.extrinsics, matrices, strict=True):
        own = {} if shared else written[rig.images.get(name, name)]
        whole["frames"].append({"file_path": name, **own, "transform_matrix": rows})
    return as_json(whole)


def _entries(lossy: Lossy, name: str, camera: Camera) -> dict[str, Any]:
    key, (fx, fy, cx, cy), distortion = lossy.model(name, camera, set(_MODELS.values()))
    entries: dict[str, Any] = {"camera_model": next(model for model, k in _MODELS.items() if k == key)}
    if key == "equirectangular":
        size = lossy.size(name, camera)
        if [fx, fy, cx, cy] != panorama(size):
            lossy.fail(name, "must be a whole sphere for Nerfstudio; got a part of a panorama")
        return {**entries, "w": size[1], "h": size[0]}
    entries |= {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5}
    if camera.image_size is not None:
        entries |= {"w": camera.image_size[1], "h": camera.image_size[0]}
    if key == "fisheye624":
        entries["distortion_params"] = distortion
    elif key == "kannala_brandt":
        entries |= zip(_RADIAL[:4], lossy.at_most(name, camera, distortion, (4,)), strict=True)
    elif key == "brown_conrady":
        distortion = lossy.at_most(name, camera, distortion, (4, 5))
        entries |= zip(("k1", "k2", "p1", "p2", "k3"), distortion, strict=False)
    return entries
