"""camtorch's own JSON, which holds any camera of any model to the last bit."""

import functools
from collections.abc import Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.evaluate.door import pytree
from camtorch.io import poses
from camtorch.io.parsing import plain
from camtorch.io.record import Names, Record, one_of
from camtorch.io.writing import Lossy, as_json
from camtorch.poses.extrinsics import Extrinsics
from camtorch.values.arguments import broadcast_shapes
from camtorch.values.module import BatchedModule, remade

Made = TypeVar("Made", bound=BatchedModule)

NAMES = Names("camtorch", "camtorch", (".json",), ("*.json",))

_VERSION = 1
_DEEPEST_BATCH = 8
_DTYPES = {"float32": torch.float32, "float64": torch.float64}
_OF_CAMERAS = "model", "intrinsics", "distortion_names", "distortion", "image_size", "dtype"
_OF_POSES = "rotation", "translation", "dtype"


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of a camtorch file, or of `camera.to_dict()`."""
    return "camtorch" in keys or {"model", "intrinsics"} <= keys.keys() <= {*_OF_CAMERAS}


def parse(record: Record) -> Rig:
    """Return the cameras, their poses and the names of the posed images."""
    if "camtorch" not in record:
        return Rig({"camera": _camera(record)})
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
            entry.fail(f"camera must be in the file; got {images.get(name, name)!r:.60}")
        extrinsics[name] = _vectors(entry)
    if extrinsics and extrinsics.keys() == images.keys() and all(t.ndim == 1 for _, t in extrinsics.values()):
        batch = _pose(*map(torch.stack, zip(*extrinsics.values(), strict=True)))
        return Rig(cameras, (list(extrinsics), batch), images=images)
    return Rig(cameras, {name: _pose(*vectors) for name, vectors in extrinsics.items()}, images=images)


def made_of(kind: type[Made], d: Mapping[str, Any]) -> Made:
    """Return the camera or pose of a dict made by `dict_of`, frozen; a CameraFileError names a wrong key."""
    record = Record(f"{kind.__name__}.from_dict", plain(d))
    is_camera = issubclass(kind, Camera)
    known = _OF_CAMERAS if is_camera else _OF_POSES
    if other := [key for key in record.keys() if key not in known]:  # noqa: SIM118
        record[other[0]].fail(f"keys must be among {', '.join(known)}; got {other[0]!r:.60}")
    made: Any = _camera(record) if is_camera else _pose(*_vectors(record))
    if not isinstance(made, kind):
        record["model"].fail(f"must be of {kind.__name__}; got {type(made).__name__}. ct.Camera.from_dict takes any")
    dtype = _DTYPES[one_of(record["dtype"], _DTYPES)] if "dtype" in record else torch.float64
    return made.to(dtype).requires_grad_(False)


def _vectors(record: Record) -> tuple[Tensor, Tensor]:
    rotation, translation = _tensor(record["rotation"], 3), _tensor(record["translation"], 3)
    _same_batch(record, rotation, translation)
    for key, values in (("rotation", rotation), ("translation", translation)):
        poses.check_near(record[key], values.flatten())
    return rotation, translation


def _pose(rotation: Tensor, translation: Tensor) -> Extrinsics:
    """Return the pose of rotation vectors of any length, as trained, which need no conversion to matrices."""
    pose = Extrinsics(torch.zeros_like(rotation[..., None]), translation)
    return remade(pose, rotation=nn.Parameter(rotation.expand(pose.rotation.shape).clone()))


def _camera(record: Record) -> Camera:
    key = record["model"].text()
    names = [name.text() for name in record["distortion_names"]] if "distortion_names" in record else []
    kind = record["model"].model(key)
    intrinsics = _tensor(record["intrinsics"], 4)
    if bool((intrinsics[..., :2].abs() < torch.finfo(torch.float32).tiny).any()):  # which float32 takes for zero
        record["intrinsics"].fail(f"focal lengths must be positive; got {record['intrinsics'].value!r:.60}")
    if names and list(kind.names_of(len(names)) or ()) != names:
        record["distortion_names"].fail(f"must be names of {kind.__name__}, {kind.counts_text()}; got {names!r:.60}")
    distortion = _tensor(record["distortion"], len(names)) if names or "distortion" in record else intrinsics[..., :0]
    count = distortion.shape[-1]
    if "distortion" in record and kind.names_of(count) is None:
        record["distortion"].fail(f"must have coefficients {kind.counts_text()} for {kind.__name__}; got {count}")
    size = None
    if "image_size" in record:
        record["image_size"].numbers(2)
        height, width = (side.side() for side in record["image_size"])
        size = (height, width)
    _same_batch(record, intrinsics, distortion)
    return record.camera(key, intrinsics, distortion, size)


def _same_batch(record: Record, *tensors: Tensor) -> None:
    """Refuse batch dims that would grow when they are broadcast: a small file must not take much memory."""
    shapes = {tuple(t.shape[:-1]) for t in tensors} - {()}
    if len(shapes) > 1:
        record.fail(f"batch dims must be equal; got {', '.join(map(str, sorted(shapes)))}")


def _tensor(record: Record, last: int) -> Tensor:
    """Return a record's numbers, float64 (*B, last); any last dim is accepted if `last` is 0."""
    if any(isinstance(number, bool) for number in pytree.tree_leaves(record.value)):
        record.fail(f"must be numbers; got {record.value!r:.60}")
    try:
        values = torch.tensor(record.value, dtype=torch.float64)
    except (ValueError, TypeError, RuntimeError) as error:
        record.fail(f"must be numbers (*B, {last or 'n'}): {error}")
    if not 0 < values.ndim <= _DEEPEST_BATCH or values.shape[-1] != (last or values.shape[-1]):
        record.fail(f"must be numbers (*B, {last or 'n'}); got {tuple(values.shape)}")
    if not bool(values.isfinite().all()):
        record.fail("must be finite; got NaN or infinity")
    return values


def render(rig: Rig, lossy: Lossy) -> str:
    """Return the text of a file. Numbers are float64, which holds those of a float32 camera exactly."""
    cameras = {name: _entry(camera, lossy, name) for name, camera in rig.cameras.items()}
    extrinsics = {name: _entry(pose, lossy, name) for name, pose in rig.extrinsics.items()}
    for name, entry in extrinsics.items():
        if name in rig.images:
            entry["camera"] = rig.images[name]
    return as_json({"camtorch": _VERSION, "cameras": cameras, "extrinsics": extrinsics})


def dict_of(one: Camera | Extrinsics) -> dict[str, Any]:
    """Return a camera or a pose as entries of a file, with its dtype if that is not float64."""
    owner = f"{type(one).__name__}.to_dict"
    if isinstance(one, Camera) and not one.key:  # as of a Mixed
        raise TypeError(f"{owner}: camera must be of one model with a key; got {type(one).__name__}")
    entry = _entry(one, Lossy(owner, NAMES.title), "numbers")
    dtype = str(functools.reduce(torch.promote_types, [getattr(one, name).dtype for name in one.tensor_names]))
    return entry if dtype == "torch.float64" else {**entry, "dtype": dtype.removeprefix("torch.")}


def _entry(one: Camera | Extrinsics, lossy: Lossy, name: str) -> dict[str, Any]:
    tensors = [getattr(one, key) for key in one.tensor_names]
    batch = broadcast_shapes(*(t.shape[:-1] for t in tensors))
    first, second = (t if t.ndim == 1 else t.expand(*batch, -1) for t in tensors)
    if isinstance(one, Extrinsics):
        return {"rotation": lossy.numbers(name, first), "translation": lossy.numbers(name, second)}
    entry: dict[str, Any] = {"model": one.key, "intrinsics": lossy.numbers(name, first)}
    if second.shape[-1]:
        entry |= {"distortion_names": list(one.distortion_names), "distortion": lossy.numbers(name, second)}
    if one.image_size is not None:
        entry["image_size"] = list(one.image_size)
    return entry
