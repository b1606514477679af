"""Arrays as tensors, without a copy if torch can read their memory, and images as arrays again."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np
import torch
from torch import Tensor

from camtorch.values.arguments import MASKED

Array: TypeAlias = "np.ndarray[Any, Any]"


class Picture(Protocol):
    """A PIL image, for type checkers, which need no Pillow."""

    @property
    def mode(self) -> str: ...

    info: dict[str | tuple[int, int], Any]


Image = TypeVar("Image", bound=Tensor | np.ndarray[Any, Any] | Picture)
_FEW_CHANNELS = 4


def as_tensor(array: object, name: str, owner: str) -> Tensor:
    """Return an `array` of real numbers as a tensor to read only, without a copy if torch can read its memory."""
    if isinstance(array, np.ma.MaskedArray):
        raise TypeError(f"{owner}: {name} must be an array without a mask; got a MaskedArray: {MASKED}")
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        what = f"dtype {array.dtype}" if isinstance(array, np.ndarray) else type(array).__name__
        hint = f". np.array({name}) makes one" if hasattr(array, "__array_interface__") else ""
        raise TypeError(f"{owner}: {name} must be a numpy array of real numbers; got {what}{hint}")
    if not can_share(array):
        dtype = array.dtype.newbyteorder("=") if array.itemsize <= 8 else np.dtype(np.float64)
        array, given = np.empty(array.shape, dtype), array
        # channel by channel is three times as fast for pixels or channels that run backwards
        apart = given.ndim == 3 and given.shape[-1] <= _FEW_CHANNELS
        for at in [(..., channel) for channel in range(given.shape[-1])] if apart else [...]:
            array[at] = given[at]
    elif not array.flags.writeable:  # torch warns about read-only memory, which is only read here
        interface = {**array.__array_interface__, "data": (array.ctypes.data, False)}
        array = np.asarray(SimpleNamespace(__array_interface__=interface, owner=array))
    return torch.from_numpy(array)


def can_share(array: Array) -> bool:
    """Whether torch can read the memory of an array of real numbers."""
    # torch has no other byte orders or long doubles, and no strides that are negative or end within a number
    known = array.dtype.isnative and array.itemsize <= 8 and array.flags.aligned
    return known and not any(step < 0 or step % array.itemsize for step in array.strides)


def as_planes(array: object, name: str, owner: str, size: tuple[int, int] | None = None, many: bool = False) -> Tensor:
    """Return an array (H, W, C) or (H, W) as an image (C, H, W), and if `many`, (N, H, W, C) as images (N, C, H, W).

    Raise if `size` shows that its channels come first.
    """
    tensor = as_tensor(array, name, owner)
    shape = tuple(tensor.shape)
    if tensor.ndim not in ((2, 3, 4) if many else (2, 3)) or (len(shape) > 2 and size == shape[-2:]):
        forms = "(H, W, C), (H, W) or (N, H, W, C)" if many else "(H, W, C) or (H, W)"
        hint = f". np.moveaxis({name}, -3, -1) puts channels last" if size == shape[-2:] else ""
        hint += f", {name}[..., None] adds one to grey images" if hint and many else ""
        raise ValueError(f"{owner}: {name} must be {forms}; got shape {shape}{hint}")
    return tensor.movedim(-1, -3) if tensor.ndim > 2 else tensor[None]


def plain(tensor: Tensor) -> Array:
    """Return a tensor as an array, without a copy if it is on the CPU."""
    return tensor.numpy(force=True)


def as_array(image: Tensor, like: Array) -> Array:
    """Return images (..., C, H, W) in the layout and the dtype of `like`, without a copy if their memory has them."""
    planes = plain(image)
    last = (*range(planes.ndim - 3), -2, -1, -3)
    return np.ascontiguousarray(planes.transpose(last) if like.ndim > 2 else planes[..., 0, :, :], like.dtype)


def as_planes_of(
    image: Any, name: str, owner: str, size: tuple[int, int] | None = None, many: bool = False
) -> tuple[Tensor, Callable[[Tensor], Any]]:
    """Return an array or a PIL image as `as_planes` does, and a function from such planes to an image of its kind."""
    mode = None if isinstance(image, np.ndarray) else getattr(image, "mode", None)
    if mode is None and not isinstance(image, np.ndarray):
        forms = "a tensor (..., C, H, W), an array (H, W, C) or a PIL image"
        how = "Image.open(path) reads a file, np.stack(images) joins several; cv2.imread returns None if it fails"
        raise TypeError(f"{owner}: {name} must be {forms}; got {type(image).__name__}. {how}")
    if mode in ("1", "P", "PA"):
        raise ValueError(
            f"{owner}: {name} must be an image whose values can be averaged; got a PIL image of mode {mode!r}. Labels "
            "go in as np.asarray(image) with mode='nearest', in a sample as its mask or tv_tensors.Mask(image); "
            "image.convert('RGB') makes colours of it"
        )
    array = image if mode is None else np.asarray(image)

    def restored(planes: Tensor) -> Any:
        made = as_array(planes, array)
        if mode is None:
            return made
        if planes.ndim > 3:
            raise ValueError(
                f"{owner}: {name} must be an array or a tensor, as {len(planes)} images come out; got a PIL image. "
                "np.asarray(image) makes an array"
            )
        new = importlib.import_module("PIL.Image").frombuffer(mode, made.shape[1::-1], made, "raw", mode, 0, 1)
        new.info |= image.info  # as Pillow's own transforms do: Exif, with the orientation
        return new

    return as_planes(array, name, owner, size, many), restored


def warped_alike(
    images: Any, size: tuple[int, int], owner: str, warp: Callable[[Tensor], Tensor], device: torch.device | str = "cpu"
) -> Any:
    """Return an array or a PIL image, of that size, as `warp` makes it of images (N, C, H, W), without gradients."""
    planes, restored = as_planes_of(images, "images", owner, size, many=True)
    with torch.no_grad():
        made = warp((planes[None] if planes.ndim == 3 else planes).to(device))
    return restored(made[0] if planes.ndim == 3 and len(made) == 1 else made)
