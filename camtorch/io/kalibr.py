"""Kalibr's camchain: cam0, cam1, ... each with its pose relative to the one before, or to the IMU."""

import itertools
import re
from typing import Any

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.record import Names, Record
from camtorch.io.writing import Lossy, listed
from camtorch.poses.extrinsics import Extrinsics

NAMES = Names("kalibr", "Kalibr", (".yaml", ".yml"), ("*camchain*",))

# camera_model, distortion_model -> key, number of coefficients before the intrinsics, number after them
_MODELS = {
    ("pinhole", "none"): ("pinhole", 0, 0),
    ("pinhole", "radtan"): ("brown_conrady", 0, 4),
    ("pinhole", "equidistant"): ("kannala_brandt", 0, 4),
    ("pinhole", "fov"): ("fov", 0, 1),
    ("omni", "radtan"): ("mei", 1, 4),
    ("omni", "none"): ("mei", 1, 0),
    ("eucm", "none"): ("eucm", 2, 0),
    ("ds", "none"): ("double_sphere", 2, 0),
}
_NAME = re.compile(r"cam(\d{1,4})")


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of a camchain."""
    return any(_NAME.fullmatch(key) and isinstance(value, dict) for key, value in keys.items())


def parse(record: Record) -> Rig:
    """Return the cameras; the rig is the IMU if `T_cam_imu` is given, else cam0."""
    numbered = sorted((int(match[1]), key) for key in record.keys() if (match := _NAME.fullmatch(key)))  # noqa: SIM118
    names = [name for _, name in numbered]
    if [number for number, _ in numbered] != list(range(len(numbered))):
        record.fail(f"cameras must be numbered from cam0 on; got {', '.join(names):.80}")
    return Rig({name: _camera(record[name]) for name in names}, _extrinsics(record, names))


def _camera(record: Record) -> Camera:
    names = record["camera_model"].text(), record["distortion_model"].text()
    if names not in _MODELS:
        record.fail(f"must be one of {', '.join(map('-'.join, _MODELS))}; got {'-'.join(names)!r:.60}")
    key, before, after = _MODELS[names]
    values = record["intrinsics"].numbers(before + 4)
    coefficients = record["distortion_coeffs"] if after or "distortion_coeffs" in record else None
    distortion = values[:before] + (coefficients.numbers(after) if coefficients is not None else [])
    if names == ("omni", "none"):
        distortion += [0.0] * 4
    return record.camera(key, values[before:], distortion, record["resolution"].size())


def _extrinsics(record: Record, names: list[str]) -> dict[str, Extrinsics]:
    for key, undo in (("T_cam_imu", False), ("T_imu_cam", True)):
        if any(key in record[name] for name in names):
            return {name: _pose(record[name][key], undo) for name in names}
    if not any("T_cn_cnm1" in record[name] for name in names[1:]):
        return {}
    chain = {names[0]: poses.pose(record, [0.0] * 3, [0.0] * 3)}
    for previous, name in itertools.pairwise(names):
        with torch.no_grad():
            chain[name] = _pose(record[name]["T_cn_cnm1"]).compose(chain[previous])
    return chain


def _pose(record: Record, undo: bool = False) -> Extrinsics:
    return poses.from_matrices(record, poses.matrix_rows(record), undo)


def render(rig: Rig, lossy: Lossy) -> str:
    """Return the text of a file; the cameras are renamed to cam0, cam1, ... in their order."""
    rig = lossy.numbered(rig)
    posed = lossy.all_posed(rig) if rig.extrinsics or len(rig.cameras) > 1 else {}
    first = next(iter(posed.values()), None)
    chained = first is None or (len(posed) > 1 and poses.is_identity(first))
    lines: list[str] = []
    previous = None
    for i, (name, camera) in enumerate(rig.cameras.items()):
        lines.append(f"cam{i}:")
        if not chained:
            lines += _rows("T_cam_imu", poses.matrices(posed[name]))
        if previous is not None:
            lines += _rows("T_cn_cnm1", poses.matrices(posed[name]) @ poses.matrices(previous, undo=True))
        previous = posed.get(name)
        height, width = lossy.size(name, camera)
        key, intrinsics, distortion = lossy.model(name, camera, {key for key, _, _ in _MODELS.values()})
        names, before, after = next((names, b, a) for names, (k, b, a) in _MODELS.items() if k == key)
        distortion = lossy.at_most(name, camera, distortion, (before + after,))
        lines += [
            f"  camera_model: {names[0]}",
            f"  distortion_model: {names[1]}",
            f"  intrinsics: {listed([*distortion[:before], *intrinsics])}",
            f"  distortion_coeffs: {listed(distortion[before:])}",
            f"  resolution: [{width}, {height}]",
            "  cam_overlaps: []",
            f"  rostopic: /cam{i}/image_raw",
        ]
    return "\n".join(lines) + "\n"


def _rows(key: str, matrix: Tensor) -> list[str]:
    return [f"  {key}:", *(f"  - {listed(row)}" for row in matrix.tolist())]
