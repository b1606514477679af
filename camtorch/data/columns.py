"""Cameras as columns of numbers, one row a sample, for tables that hold no objects."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from camtorch.cameras.camera import MODELS, Camera, as_model
from camtorch.cameras.mixed import cat
from camtorch.values.arguments import as_image_size, no_camera

PARTS = ("model", "intrinsics", "distortion", "image_size")


def to_columns(camera: Camera, name: str = "camera") -> dict[str, Any]:
    """Return a camera as numbers: `camera_model`, the key in `ct.MODELS`; `camera_intrinsics` (4,) fx, fy, cx, cy;
    `camera_distortion` (n,); `camera_image_size` (2,), height and width in pixels.

    For a batch of B cameras each value has B rows: (B, 4) and so on.

    Args:
        camera: A camera with an image_size, and at most one batch dim.
        name: Prefix of the columns instead of "camera".

    Raises:
        TypeError: If `camera` is no camera. ValueError: If it has no image_size, or several batch dims.
    """
    if not isinstance(camera, Camera):
        raise TypeError(f"to_columns: camera must be a Camera; got {no_camera(camera)}")
    if camera.image_size is None or len(camera.batch_shape) > 1:
        got = f"image_size {camera.image_size} and batch dims {tuple(camera.batch_shape)}"
        raise ValueError(f"to_columns: the camera must have an image_size and one batch dim at most; got {got}")
    numbers = [t.detach().cpu().numpy() for t in (camera.intrinsics, camera.distortion)]
    batch = tuple(camera.batch_shape)
    rows = [np.broadcast_to(v, (*batch, v.shape[-1])).copy() for v in (*numbers, np.asarray(camera.image_size))]
    model = np.full(batch, camera.key) if batch else camera.key
    return {f"{name}_{part}": value for part, value in zip(PARTS, (model, *rows), strict=True)}


def from_columns(columns: Mapping[str, Any], name: str = "camera") -> Camera | list[Camera]:
    """Return the camera of a row, or of a batch: a batch of cameras, or a list if models or sizes differ.

    Args:
        columns: Columns of `to_columns`, and any others; `camera_distortion` may be missing.
        name: Prefix of the columns instead of "camera".

    Returns:
        Frozen cameras, with the dtype of the columns.

    Raises:
        ValueError: If columns are missing, or are not those of a camera.
    """
    if not isinstance(columns, Mapping):
        raise TypeError(f"from_columns: columns must be a dict of columns; got {type(columns).__name__}")
    missing = [f"{name}_{part}" for part in ("model", "intrinsics", "image_size") if f"{name}_{part}" not in columns]
    if missing:
        raise ValueError(f"from_columns: columns must hold {', '.join(missing)}; got none. to_columns makes them")
    parts = {part: columns[f"{name}_{part}"] for part in PARTS if f"{name}_{part}" in columns}
    if isinstance(parts["model"], str) or np.ndim(parts["model"]) == 0:
        return camera_of(parts, "from_columns")
    rows = [{part: values[i] for part, values in parts.items()} for i in range(len(parts["model"]))]
    cameras = [camera_of(row, "from_columns") for row in rows]
    return cameras if len({camera.image_size for camera in cameras}) > 1 else cat(cameras)


def camera_of(parts: Mapping[str, Any], owner: str) -> Camera:
    """Return the frozen camera of model, intrinsics, distortion and image_size."""
    model = str(parts["model"])
    if model.partition(":")[0] not in MODELS:
        raise ValueError(f"{owner}: the model of a camera must be one of {', '.join(MODELS)}; got {model!r}")
    numbers = [_numbers(parts[part]) for part in ("intrinsics", "distortion") if parts.get(part) is not None]
    height, width = (int(side) for side in parts["image_size"])
    camera: Camera = as_model(model, owner)(*(n for n in numbers if n.size))
    camera.image_size = as_image_size((height, width), owner)  # set later, as crops may be off centre
    return camera.requires_grad_(False)


def _numbers(values: Any) -> np.ndarray[Any, Any]:
    """Return a copy as an array; lists and arrays of objects become float64."""
    array = values.numpy() if isinstance(values, torch.Tensor) else np.asarray(values)
    return np.array(array, array.dtype if array.dtype.kind == "f" else np.float64)
