"""camtorch's own JSON, which holds any camera of any model to the last bit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from camtorch._arguments import broadcast_shapes
from camtorch._module import remade
from camtorch.camera import Camera
from camtorch.extrinsics import Extrinsics
from camtorch.io import poses
from camtorch.io.protocol import Names
from camtorch.io.record import Record
from camtorch.io.writing import Lossy, as_json
from camtorch.rig import Rig

NAMES = Names("camtorch", "camtorch", (".json",), ("*.json",))

_VERSION = 1
_DEEPEST_BATCH = 8


def matches(keys: dict[str, Any]) -> bool:
    """Whether these are the keys of such a file."""
    return "camtorch" in keys


def parse(record: Record) -> Rig:
    """The cameras, their poses and the images that they took."""
    record["camtorch"].whole(1, _VERSION, f"version that this camtorch reads, which is up to {_VERSION}")
    record["cameras"].few(len(record["cameras"].keys()))
    cameras = {name: _camera(record["cameras"][name]) for name in record["cameras"].keys()}  # noqa: SIM118
    extrinsics: dict[str, tuple[Tensor, Tensor]] = {}
    images: dict[str, str] = {}
    for name in record["extrinsics"].keys() if "extrinsics" in record else ():
        entry = record["extrinsics"][name]
        if "camera" in entry:
            images[name] = entry["camera"].text()
        if images.get(name, name) not in cameras:
            entry.fail(f"of the camera {images.get(name, name)!r:.60}, which is not in the file")
        rotation, translation = _tensor(entry["rotation"], 3), _tensor(entry["translation"], 3)
        _same_batch(entry, rotation, translation)
        for key, values in (("rotation", rotation), ("translation", translation)):
            poses.check_near(entry[key], values.flatten())
        extrinsics[name] = rotation, translation
    if extrinsics and extrinsics.keys() == images.keys() and all(t.ndim == 1 for _, t in extrinsics.values()):
        batch = _pose(*map(torch.stack, zip(*extrinsics.values(), strict=True)))
        return Rig(cameras, (list(extrinsics), batch), images=images)
    return Rig(cameras, {name: _pose(*vectors) for name, vectors in extrinsics.items()}, images=images)


def _pose(rotation: Tensor, translation: Tensor) -> Extrinsics:
    """Of vectors that are no matrices, and of any length, as they learnt."""
    pose = Extrinsics(torch.zeros_like(rotation[..., None]), translation)
    return remade(pose, rotation=nn.Parameter(rotation.expand(pose.rotation.shape).clone()))


def _camera(record: Record) -> Camera:
    key = record["model"].text()
    names = [name.text() for name in record["distortion_names"]] if "distortion_names" in record else []
    kind = record.model(key)
    arguments = [_tensor(record["intrinsics"], 4)]
    if names:
        if list(kind.names_of(len(names)) or ()) != names:
            record["distortion_names"].fail(f"not those of {kind.__name__}, which takes {kind.counts_text()}")
        arguments.append(_tensor(record["distortion"], len(names)))
    size = None
    if "image_size" in record:
        record["image_size"].numbers(2)
        height, width = (side.side() for side in record["image_size"])
        size = (height, width)
    _same_batch(record, *arguments)
    try:
        return kind(nn.Parameter(arguments[0]), *arguments[1:], image_size=size)  # what was cut out may be off centre
    except (ValueError, TypeError) as error:
        return record.fail(error)


def _same_batch(record: Record, *tensors: Tensor) -> None:
    """Refuse batch dims that would grow when they are broadcast: a small file is not to take much memory."""
    shapes = {tuple(t.shape[:-1]) for t in tensors} - {()}
    if len(shapes) > 1:
        record.fail(f"batch dims that differ: {', '.join(map(str, sorted(shapes)))}")


def _tensor(record: Record, last: int) -> Tensor:
    """Numbers (*B, last)."""
    try:
        values = torch.tensor(record.value, dtype=torch.float64)
    except (ValueError, TypeError, RuntimeError) as error:
        record.fail(f"not numbers (*B, {last}): {error}")
    if not 0 < values.ndim <= _DEEPEST_BATCH or values.shape[-1] != last:
        record.fail(f"numbers (*B, {last}); these are {tuple(values.shape)}")
    if not bool(values.isfinite().all()):
        record.fail("numbers that are not finite")
    return values


def render(rig: Rig, lossy: Lossy) -> str:
    """The text of a file. Numbers are float64, which holds those of a float32 camera exactly."""
    cameras, extrinsics = {}, {}
    for name, camera in rig.cameras.items():
        intrinsics, distortion = _rows(camera.intrinsics, camera.distortion)
        entry: dict[str, Any] = {"model": camera.key, "intrinsics": _values(lossy, name, intrinsics)}
        if camera.distortion.shape[-1]:
            entry["distortion_names"] = list(camera.distortion_names)
            entry["distortion"] = _values(lossy, name, distortion)
        if camera.image_size is not None:
            entry["image_size"] = list(camera.image_size)
        cameras[name] = entry
    for name, pose in rig.extrinsics.items():
        rotation, translation = _rows(pose.rotation, pose.translation)
        extrinsics[name] = {
            "rotation": _values(lossy, name, rotation),
            "translation": _values(lossy, name, translation),
        }
        if name in rig.images:
            extrinsics[name]["camera"] = rig.images[name]
    return as_json({"camtorch": _VERSION, "cameras": cameras, "extrinsics": extrinsics})


def _rows(*tensors: Tensor) -> list[Tensor]:
    """Tensors (*B, n) with equal batch dims, or with none."""
    batch = broadcast_shapes(*(t.shape[:-1] for t in tensors))
    return [t if t.ndim == 1 else t.expand(*batch, -1) for t in tensors]


def _values(lossy: Lossy, name: str, tensor: Tensor) -> Sequence[Any]:
    if not bool(torch.isfinite(tensor).all()):
        lossy.fail(name, "numbers that are not finite")
    return tensor.detach().double().tolist()
