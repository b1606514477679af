"""OpenMVG's `sfm_data.json`: cameras and posed views, as cereal writes them."""

from __future__ import annotations

import math
from typing import Any, NoReturn

import numpy as np

from camtorch.camera import Camera
from camtorch.io import poses
from camtorch.io.protocol import Names
from camtorch.io.record import Record, one_of
from camtorch.io.writing import Lossy
from camtorch.rig import Rig

NAMES = Names("openmvg", "OpenMVG", (".json",), ("sfm_data*.json",))

# polymorphic_name -> key of the coefficients, key of the model
_MODELS = {
    "pinhole": ("", "pinhole"),
    "pinhole_radial_k1": ("disto_k1", "brown_conrady"),
    "pinhole_radial_k3": ("disto_k3", "brown_conrady"),
    "pinhole_brown_t2": ("disto_t2", "brown_conrady"),
    "fisheye": ("fisheye", "kannala_brandt"),
    "spherical": ("", "equirectangular"),
}
_COUNTS = {"disto_k1": 1, "disto_k3": 3, "disto_t2": 5, "fisheye": 4}
_NEW = 1 << 31  # with this bit of an id cereal writes what it stands for, with the one below no id is needed
_NO_POSE = (1 << 32) - 1


def matches(keys: dict[str, Any]) -> bool:
    """Whether these are the keys of such a file."""
    return "sfm_data_version" in keys and "intrinsics" in keys


def parse(record: Record) -> Rig:
    """The cameras by the keys of their intrinsics, and the poses of those views that have one."""
    kinds: dict[float, str] = {}
    views = [_data(view, kinds)[1] for view in record["views"]]
    record["intrinsics"].few(len(record["intrinsics"]))
    cameras: dict[str, Camera] = {}
    for entry in record["intrinsics"]:
        name = _identity(entry["key"])
        if name in cameras:
            entry["key"].fail(f"a second camera is called {name}")
        cameras[name] = _camera(*_data(entry, kinds))
    found = {_identity(entry["key"]): entry["value"] for entry in record["extrinsics"]}
    places: dict[str, Record] = {}
    images: dict[str, str] = {}
    for view in views:
        pose, camera = _identity(view["id_pose"]), _identity(view["id_intrinsic"])
        if pose in found and camera in cameras:
            name = "/".join(filter(None, (view["local_path"].text(), view["filename"].text())))
            if name in places or (name in cameras and name != camera):
                view["filename"].fail(f"a second view is called {name!r:.60}")
            images[name], places[name] = camera, found[pose]
    if not places:
        return Rig(cameras)
    there = list(places.values())
    rotations = np.array([place["rotation"].rows(3, 3) for place in there])
    centres = np.array([place["center"].numbers(3) for place in there])
    poses.check_near(lambda row: there[row]["center"], centres)
    matrices = np.concatenate((rotations, -rotations @ centres[..., None]), -1)
    batch = poses.from_matrices(lambda row: there[row]["rotation"], matrices)
    return Rig(
        cameras, (list(places), batch), images={name: camera for name, camera in images.items() if name != camera}
    )


def _identity(record: Record) -> str:
    return str(record.whole(0, _NO_POSE, "number of OpenMVG's"))


def _data(entry: Record, kinds: dict[float, str]) -> tuple[Record, Record]:
    """The kind and the values of what a pointer of cereal's points to, with the names of the kinds so far."""
    value = entry["value"]
    kind = Record(value.path, "", value.place_of("polymorphic_name"))
    if "polymorphic_id" in value:
        identity = value["polymorphic_id"].number()
        if "polymorphic_name" in value:
            kind = value["polymorphic_name"]
            kinds[identity - _NEW] = kind.text()
        kind.value = kinds.get(identity - (_NEW if identity >= _NEW else 0), "")
    return kind, value["ptr_wrapper"]["data"]


def _camera(kind: Record, data: Record) -> Camera:
    coefficients, key = _MODELS[one_of(kind, _MODELS)]
    size = data["height"].side(), data["width"].side()
    if key == "equirectangular":
        scale = max(size) / (2 * math.pi)
        return data.camera(key, [scale, scale, size[1] / 2, size[0] / 2], [], size)
    focal, lens = data["focal_length"].number(), None
    distortion: list[float] = []
    if coefficients:
        lens = data[coefficients]
        distortion = lens.numbers(_COUNTS[coefficients])
    if key == "brown_conrady":
        k1, k2, k3, t1, t2 = (distortion + [0.0] * 4)[:5]
        distortion = [k1, k2, t1, t2, k3]
    return data.camera(key, [focal, focal, *data["principal_point"].numbers(2)], distortion, size, lens=lens)


def render(rig: Rig, path: str) -> NoReturn:
    """Raise the CameraFileError that nothing is written: OpenMVG's files hold its views and its structure too."""
    Lossy(path, NAMES.title).fail(
        "format", "read only: it has views and structure beside cameras. Save as format='colmap'"
    )
