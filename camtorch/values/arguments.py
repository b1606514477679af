"""Checks and conversions of the numbers, sizes and options that users pass."""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
import math
import operator
import os
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ParamSpec, TypeAlias, TypeGuard, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from camtorch.evaluate.door import is_cheap_to_read
from camtorch.evaluate.tensors import is_kept, is_predicted, known_false, known_some, row_of

Numbers: TypeAlias = Tensor | np.ndarray[Any, Any] | np.number[Any] | float | list[Any] | tuple[Any, ...]
"""Numbers as users pass them: a tensor, an array, a number, or lists of them."""

LEFT = "docs/leaving-0.3.md lists what left camtorch"  # the hint of errors about unknown names

Taken = ParamSpec("Taken")
Result = TypeVar("Result")
Name = TypeVar("Name", bound=str)

CLOSE = 0.55  # as difflib has it: size and image_size are, prob and roll are not
TOLD: set[object] = set()  # keys of what this process has told its user; see `first_time`


def present(value: Result | None, what: str) -> Result:
    """Return a value that its user has made sure of, which `python -O` checks as well."""
    if value is None:
        raise RuntimeError(f"camtorch: {what} must be there; got none")
    return value


def hinting(hint: str) -> Callable[[Callable[Taken, Result]], Callable[Taken, Result]]:
    """Return a decorator that adds `hint` to a function's error about arguments that it does not have."""

    def hinted(function: Callable[Taken, Result]) -> Callable[Taken, Result]:
        @functools.wraps(function)
        def call(*args: Taken.args, **kwargs: Taken.kwargs) -> Result:
            try:
                return function(*args, **kwargs)
            except TypeError as error:
                name = next((name for name in kwargs if f"unexpected keyword argument {name!r}" in str(error)), "")
                if name:
                    close = difflib.get_close_matches(name, inspect.signature(function).parameters, 1, CLOSE)
                    meant = f"Did you mean {close[0]!r}? " if close else ""
                    unknown = f"{function.__qualname__}() got an unexpected keyword argument {name!r}"
                    raise TypeError(f"{unknown}. {meant}{hint}. {LEFT}") from None
                if error.__traceback__ is None or error.__traceback__.tb_next is not None:  # of the function's body
                    raise
                raise TypeError(f"{error}. {hint}") from None

        return call

    return hinted


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Warn, and show the line that called this package."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_INSIDE):
        level, frame = level + 1, frame.f_back
    warnings.warn(text, category, stacklevel=level)


def first_time(key: object) -> bool:
    """Whether this process has not been here with a key before, to warn of something once."""
    if key in TOLD:
        return False
    TOLD.add(key)
    return True


def imported(module: str, needs: str, extra: str, has: str = "__name__") -> Any:
    """Import an optional module with the attribute `has`, or raise an ImportError with the command to type."""
    try:
        found = importlib.import_module(module)
        operator.attrgetter(has)(found)
    except (ImportError, AttributeError):
        raise ImportError(f"{needs}: pip install -e '.[{extra}]' in a checkout of camtorch") from None
    return found


# torch's frames lie between a module's caller and its forward
_INSIDE = tuple(os.path.dirname(file) + os.sep for file in (os.path.dirname(__file__), torch.__file__))


def as_real(value: Numbers, name: str, owner: str, device: torch.device | None = None) -> Tensor:
    """Return finite floating-point numbers: a tensor itself; lists and integers take torch's default dtype."""
    if type(value) in (list, tuple) and {float, int}.issuperset(map(type, value)):  # type: ignore[arg-type]
        value = torch.tensor(value, dtype=torch.get_default_dtype(), device=device)
    elif not isinstance(value, Tensor):
        _check_list(value, name, owner)
        try:
            if isinstance(value, (list, tuple)) and value and all(getattr(v, "ndim", 0) for v in value):
                value = torch.stack([torch.as_tensor(_as_plain(v), device=device) for v in value])
            else:
                value = torch.as_tensor(_as_plain(value), device=device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(
                f"{owner}: {name} must be numbers (a tensor, an array or a list); got {no_camera(value)}: {error}"
            ) from None
    _check_real(value, name, owner, device)
    if not value.dtype.is_floating_point:
        value = value.to(torch.get_default_dtype())
    row = row_of(value)
    if row is not None:
        finite = all(map(math.isfinite, row))
    else:
        finite = is_predicted(value) or not known_false(torch.isfinite(value))
    if not finite:
        wrong = (~value.detach().isfinite()).nonzero()
        first = wrong[0].tolist()
        place = f", first {name}{first} = {value[tuple(first)].item()}" if first else ""
        raise ValueError(f"{owner}: {name} must be finite; got {len(wrong)} of {value.numel()} that are not{place}")
    return value


def _check_list(value: object, name: str, owner: str) -> None:
    if isinstance(value, (list, tuple)) and any(isinstance(v, Tensor) and v.requires_grad for v in value):
        raise TypeError(f"{owner}: {name} must be a tensor; got a list of tensors that require grad. torch.stack them")


def _check_real(value: Tensor, name: str, owner: str, device: torch.device | None) -> None:
    if value.dtype.is_complex or value.dtype == torch.bool:
        raise TypeError(f"{owner}: {name} must be real numbers; got dtype {value.dtype}")
    if value.layout is not torch.strided:
        raise TypeError(f"{owner}: {name} must be a dense tensor; got {value.layout}. Use .to_dense()")
    if device is not None and value.device != device:
        where = f"must be on {device}, like the other tensors; got {value.device}"
        raise ValueError(f"{owner}: {name} {where}. Move it with .to(device)")


def _as_plain(value: Numbers) -> Numbers:
    """Return `value` as torch accepts it: a copy of an array that is reversed, read-only or of another byte order."""
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError(MASKED)
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
        if value.dtype.kind == "f" and value.dtype.itemsize > 8:
            return value.astype(np.float64)
        odd = not value.dtype.isnative or not value.flags.writeable or any(step < 0 for step in value.strides)
        return value.astype(value.dtype.newbyteorder("="), order="C", copy=True) if odd else value
    return value


def as_vectors(value: Numbers, name: str, owner: str, device: torch.device | None = None) -> Tensor:
    """Return (*B, 3) finite vectors, also of OpenCV's columns (*B, 3, 1) and arrays (1, 3)."""
    vectors = as_real(value, name, owner, device)
    if vectors.ndim > 1 and vectors.shape[-2:] == (3, 1):
        flat = vectors.squeeze(-1)
    elif vectors.shape == (1, 3) and not isinstance(value, (Tensor, list, tuple)):
        flat = vectors[0]
    elif vectors.ndim > 2 and vectors.shape[-2:] == (1, 3) and not isinstance(value, Tensor):
        flat = vectors.squeeze(-2)  # OpenCV's rows, stacked or in a list
    elif vectors.ndim and vectors.shape[-1] == 3:
        return vectors
    else:
        for_quaternions = ". For quaternions, use scipy's Rotation.from_quat(xyzw).as_rotvec()"
        hint = for_quaternions if vectors.shape[-1:] == (4,) else ""
        raise ValueError(f"{owner}: {name} must be (*B, 3); got shape {tuple(vectors.shape)}{hint}")
    if isinstance(value, nn.Parameter):  # the module could not own it
        raise ValueError(f"{owner}: the Parameter {name} must be (*B, 3); got shape {tuple(vectors.shape)}")
    return flat


def as_image_size(value: Any, owner: str, name: str = "image_size") -> tuple[int, int] | None:
    """Return (height, width) as two positive ints, or None."""
    if value is None:
        return None
    if type(value) is tuple and [type(side) for side in value] == [int, int] and min(value) > 0:
        return value
    try:
        if isinstance(value, (set, frozenset, dict)) or any(isinstance(side, bool) for side in value):
            raise TypeError
        height, width = (operator.index(side) for side in value)
    except (TypeError, ValueError):
        raise TypeError(f"{owner}: {name} must be two integers (height, width); got {shown(value)}") from None
    if height <= 0 or width <= 0:
        raise ValueError(f"{owner}: {name} must be positive (height, width); got {(height, width)}")
    return height, width


def as_known_size(value: Any, owner: str, name: str = "image_size") -> tuple[int, int]:
    """Return (height, width) as two positive ints; raise an error for None."""
    size = as_image_size(value, owner, name)
    if size is None:
        raise TypeError(f"{owner}: {name} must be two integers (height, width); got None")
    return size


def shown(value: object) -> str:
    """Return `value` as errors show it: the shape of a tensor or array, the beginning of anything else."""
    if isinstance(value, (Tensor, np.ndarray)) and value.ndim:
        return f"{type(value).__name__} of shape {tuple(value.shape)}"
    return f"{value!r:.60}"


MASKED = "its mask would be lost. Pass array.filled(value), and ~array.mask apart"  # the reason of errors
GUESS_CAMERA = "KannalaBrandt.from_fov(degrees, image_size=...) guesses a camera"  # if one is missing


def no_camera(value: object) -> str:
    """Return the type of what was passed instead of a camera, and how a rig, a file or a matrix leads to one."""
    if hasattr(type(value), "_way_to_cameras"):  # a Rig, whose module imports this one
        return f"{type(value).__name__}, {value._way_to_cameras()}"  # type: ignore[attr-defined]
    if type(value).__module__.startswith("kornia."):
        return f"{type(value).__name__}; ct.from_kornia(theirs) makes a camera and a pose of it"
    if isinstance(value, os.PathLike) or (isinstance(value, str) and os.path.splitext(value)[1]):
        return f"{type(value).__name__}; ct.load({os.fspath(value)!r:.60}).camera loads the camera of a file"
    if isinstance(value, (list, tuple)) and value and isinstance(value[0], nn.Module):
        return f"{type(value).__name__}; ct.Mixed(cameras) makes a batch of a list of cameras"
    if tuple(getattr(value, "shape", ()))[-2:] == (3, 3):
        return f"{type(value).__name__} (3, 3); ct.BrownConrady.from_matrix(K, distortion) makes a camera of a matrix K"
    return type(value).__name__


def as_whole(value: Any, name: str, owner: str, least: int | None = None) -> int:
    """Return `value` as an int of at least `least`."""
    try:
        whole = operator.index(value)
    except (TypeError, RuntimeError):
        raise TypeError(f"{owner}: {name} must be a whole number; got {shown(value)}") from None
    if least is not None and whole < least:
        raise ValueError(f"{owner}: {name} must be at least {least}; got {whole}")
    return whole


def as_flag(value: Any, name: str, owner: str) -> bool:
    """Return `value` as a bool if it is True, False, 1 or 0, and raise an error for anything else, like "False"."""
    plain = value.item() if isinstance(value, (Tensor, np.ndarray, np.generic)) and not value.ndim else value
    if isinstance(plain, int) and plain in (0, 1):
        return bool(plain)
    raise TypeError(f"{owner}: {name} must be True or False; got {shown(value)}")


def as_number(value: Any, name: str, owner: str) -> float:
    """Return `value` as a float, which may be NaN or infinite."""
    try:
        if isinstance(value, (str, bytes)):
            raise TypeError
        return float(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise TypeError(f"{owner}: {name} must be a number; got {shown(value)}") from None


def as_part(value: Any, name: str, owner: str, kind: str = "part") -> float:
    """Return `value` as a float if it lies within [0, 1], like a probability."""
    part = as_number(value, name, owner)
    if not 0 <= part <= 1:
        raise ValueError(f"{owner}: {name} must be a {kind} in [0, 1]; got {value!r}")
    return part


def as_fov(value: Any, owner: str, most: float, means: str = "") -> float:
    """Return a field of view in degrees: above 2 pi and below `most`, or at most 360 if `most` is 360."""
    fov = as_number(value, "fov", owner)
    if not (0 < fov < most or fov == most == 360):
        upto = "up to" if most == 360 else "below"
        raise ValueError(f"{owner}: fov must be in degrees, above 0 and {upto} {most:g}{means}; got {shown(value)}")
    check_degrees(fov, value, owner)
    return fov


def check_degrees(least: float, fov: object, owner: str) -> None:
    """Raise a ValueError if the least of the given fields of view is at most 2 pi, and so seems to be in radians."""
    if least <= 2 * math.pi * (1 + 1e-6):  # float32 rounds 2 pi up
        raise ValueError(
            f"{owner}: fov must be in degrees; got {fov}, which seems to be radians: {least:.4g} are "
            f"{math.degrees(least):.4g} degrees. Make a camera of so narrow a view from its focal lengths: "
            "ct.Pinhole([fx, fy, cx, cy]), or from_matrix(K) of any model"
        )


def one_of(value: str, allowed: tuple[Name, ...], name: str, owner: str) -> Name:
    """Return `value` if it is one of `allowed`."""
    for known in allowed if isinstance(value, str) else ():
        if value == known:
            return known
    raise ValueError(f"{owner}: {name} must be one of {allowed}; got {shown(value)}")


def as_mapping(value: Any, name: str, owner: str, form: str) -> Mapping[Any, Any]:
    """Return a mapping, also for torch's ModuleDict and ParameterDict; an empty one for None."""
    if value is None:
        return {}
    if isinstance(value, (nn.ModuleDict, nn.ParameterDict)):
        return dict(value.items())
    if not isinstance(value, Mapping):
        raise TypeError(f"{owner}: {name} must be a dict, as {form}; got {shown(value)}")
    return value


def is_list(value: object) -> TypeGuard[Sequence[Any]]:
    """Whether `value` is a list, a tuple or another sequence, like the lists in files of options, but not a text."""
    return isinstance(value, Sequence) and not isinstance(value, (str, bytes))


def check_path(path: Any, owner: str) -> None:
    """Raise a TypeError if `path` is neither a text nor a path."""
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"{owner}: path must name a file; got {shown(path)}")


def check_boxes(boxes: Tensor, name: str, owner: str) -> None:
    """Raise a ValueError if plain boxes (..., 4) have x2 < x1 or y2 < y1, as boxes x, y, width, height mostly do."""
    if not is_cheap_to_read(boxes) or boxes.requires_grad:
        return
    wide = boxes if boxes.dtype.is_floating_point else boxes.double()
    # rounding may turn a box without extent by so much
    turned = (wide[..., 2:] < wide[..., :2] - 8 * torch.finfo(wide.dtype).eps * wide[..., :2].abs()).any(-1)
    if bool(turned.any()):
        index = turned.nonzero()[0].tolist()
        place = f"[{', '.join(map(str, index))}]" if index else ""
        raise ValueError(
            f"{owner}: {name} must be x1, y1, x2, y2 (xyxy), with x1 <= x2 and y1 <= y2; got {name}{place} = "
            f"{boxes[tuple(index)].tolist()}. Pass boxes x, y, width, height as x, y, x + width, y + height"
        )


def check_radians(vectors: Tensor, name: str, owner: str) -> None:
    """Raise a ValueError if plain rotation vectors (..., 3) have more than two turns, the most that anybody uses."""
    if not is_cheap_to_read(vectors) or is_kept(vectors) or is_predicted(vectors):
        return
    if bool((vectors.square().sum(-1) > (4 * math.pi) ** 2 * (1 + 1e-6)).any()):
        longest = torch.linalg.vector_norm(vectors.double(), dim=-1).nan_to_num(0.0).amax().item()
        raise ValueError(
            f"{owner}: {name} must be rotation vectors, axis times angle in radians; got an angle of {longest:.4g}, "
            "which seems to be degrees. Use torch.deg2rad() or math.radians()"
        )


def check_angles(angles: Tensor, owner: str) -> None:
    """Raise a ValueError if angles exceed a turn, as degrees would; a network's predictions are not checked."""
    if not is_predicted(angles) and known_some(angles.abs() > 2 * math.pi * (1 + 1e-6)):
        raise ValueError(
            f"{owner}: angles must be radians; got {float(angles.abs().max()):.4g}, which seems to be degrees. "
            "Use torch.deg2rad() or math.radians()"
        )


def check_devices(owner: str, /, **tensors: Tensor | None) -> None:
    """Raise a ValueError unless all tensors are on one device."""
    devices = {name: tensor.device for name, tensor in tensors.items() if tensor is not None}
    if len(set(devices.values())) > 1:
        where = ", ".join(f"{name} on {device}" for name, device in devices.items())
        raise ValueError(f"{owner}: tensors must be on one device; got {where}. Move them with .to(device)")


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """Return the shape that all shapes broadcast to; torch's function imports sympy, for a third of a second."""
    if shapes and shapes.count(shapes[0]) == len(shapes):
        return torch.Size(shapes[0])
    shape: list[int] = []
    for other in shapes:
        shape = [1] * (len(other) - len(shape)) + shape
        for i, side in enumerate(other, len(shape) - len(other)):
            if side != shape[i] and side != 1:
                if shape[i] != 1:
                    raise ValueError(f"shapes must broadcast; got {', '.join(str(tuple(s)) for s in shapes)}")
                shape[i] = side
    return torch.Size(shape)


def as_batch(owner: str, **shapes: Sequence[int]) -> torch.Size:
    """Return the batch dims, all but the last, that the named shapes broadcast to."""
    try:
        return broadcast_shapes(*(shape[:-1] for shape in shapes.values()))
    except ValueError:
        named = " and ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        raise ValueError(f"{owner}: batch dims must fit together; got {named}") from None


def working_dtype(values: Tensor, *parameters: Tensor) -> torch.dtype:
    """Return the dtype to compute in: the widest of all, at least float32; integers take the parameters' dtype."""
    dtype = torch.float32
    for tensor in (values, *parameters):
        if tensor.dtype.is_floating_point and tensor.dtype != dtype:
            dtype = torch.promote_types(dtype, tensor.dtype)
    return dtype


def as_values(values: Numbers, name: str, owner: str, device: torch.device | None = None) -> Tensor:
    """Return real numbers, which may be NaN or infinite, as a tensor; a given tensor must be on `device`, if any."""
    if not isinstance(values, Tensor):
        _check_list(values, name, owner)
        try:
            values = torch.as_tensor(_as_plain(values), device=device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(f"{owner}: {name} must be a tensor; got {type(values).__name__}: {error}") from None
    _check_real(values, name, owner, device)
    return values


def as_coordinates(
    values: Numbers,
    name: str,
    size: int,
    owner: str,
    device: torch.device | None = None,
    form: str = "...",
    means: str = "",
) -> Tensor:
    """Return a tensor (..., size) of real numbers; integers take torch's default dtype."""
    values = as_values(values, name, owner, device)
    if values.ndim == 0 or values.shape[-1] != size:
        raise ValueError(f"{owner}: {name} must be ({form}, {size}){means}; got shape {tuple(values.shape)}")
    return values if values.dtype.is_floating_point else values.to(torch.get_default_dtype())


def as_points(
    values: Numbers, name: str, size: int, batch: torch.Size, parameters: Sequence[Tensor], owner: str
) -> tuple[Tensor, torch.Size]:
    """Return points (*B, *N, size), in the dtype to compute in and expanded to the batch dims of `batch`, and *B."""
    values = as_values(values, name, owner, parameters[0].device)
    takes = f"{name} must be (*B, *N, {size}) with batch dims *B = {tuple(batch)}"
    if values.ndim == 0 or values.shape[-1] != size:
        hint = f". Pass {name}[..., :3], x, y, z alone" if size == 3 < max(values.shape[-1:], default=0) else ""
        if values.ndim > 1 and values.shape[-2] == size:
            hint = f". Pass points in columns as {name}.T"
        raise ValueError(f"{owner}: {takes}; got shape {tuple(values.shape)}{hint}")
    lead, rest = values.shape[: len(batch)], values.shape[len(batch) : -1]
    try:
        if len(lead) < len(batch) or values.ndim <= len(batch):
            raise ValueError
        lead = lead if lead == batch else broadcast_shapes(lead, batch)
    except ValueError:
        hint = f". Pass values that the whole batch shares as {name}[None]" if values.ndim > 1 and len(batch) else ""
        raise ValueError(f"{owner}: {takes}; got shape {tuple(values.shape)}{hint}") from None
    values = values.to(working_dtype(values, *parameters))
    if values.shape[: len(lead)] != lead:
        values = values.expand(*lead, *rest, size)
    return values, lead


def as_rows(
    values: Numbers, name: str, batch: torch.Size, parameters: Sequence[Tensor], owner: str
) -> tuple[Tensor, torch.Size, Callable[[Tensor], Tensor]]:
    """Return rows (C, N, 3), one a camera, of points; *B; and a function from (count, C, N) to (*B, *N, count)."""
    values, lead = as_points(values, name, 3, batch, parameters, owner)
    shape = values.shape[:-1]

    def restore(planes: Tensor) -> Tensor:
        return planes.reshape((len(planes), *shape)).movedim(0, -1)

    return values.reshape(math.prod(lead), math.prod(shape[len(batch) :]), 3), lead, restore


def columns(parameters: Tensor) -> tuple[Tensor, ...]:
    """Return the columns of (*B, n): n tensors (*B, 1), or (1,), that broadcast against planes."""
    # a tensor without columns cannot be unbound after it was exported and loaded
    return parameters.unsqueeze(-1).unbind(-2) if parameters.shape[-1] else ()
