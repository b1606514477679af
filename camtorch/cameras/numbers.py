"""The numbers that a camera is made of, as users give them: checked, and from a matrix or a field of view."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.evaluate.tensors import are_free, is_kept, is_predicted, known_false, row_of, values_of
from camtorch.optics.radial_inverse import precise
from camtorch.projection.camera_like import CameraLike
from camtorch.rays.lattices import AXES, focal_for
from camtorch.values.arguments import (
    Numbers,
    as_batch,
    as_flag,
    as_image_size,
    as_real,
    check_degrees,
    check_devices,
    one_of,
    warn,
)
from camtorch.values.module import remade

CameraT = TypeVar("CameraT", bound=CameraLike)
Rows = list[list[float]]  # fx, fy, cx, cy of each camera
_Checked = tuple[Tensor, Tensor, tuple[str, ...], torch.Size, tuple[int, int] | None]

_OF_CALIBRATE_CAMERA = 5, 8, 12, 14  # OpenCV's numbers of coefficients; 4 may be of its fisheye, too
_DTYPES, _NUMBERS = (torch.float32, torch.float64), {float, int}
_LARGE = 1e30  # float32 can hold it, and NaN is not below it
_SIZE_LIKE = 32  # px; two whole coefficients from here on are an image size
_LOOKED_AT = 64  # cameras of a batch that are checked: a wrong order is in all of them
_CENTRED, _NEAR = 0.1, 0.05
"""Parts of the image's sides: how far from its middle most principal points lie, and how near one lies on purpose."""
_FAR = 0.14  # both parts, to one side: the images of the calibration were larger or smaller
_SIZES = """
224x224 256x256 240x320 270x480 360x480 360x640 400x640 480x640 480x752 512x512 540x960 576x720 600x800 600x960
720x1280 768x1024 800x1280 960x1280 1024x1024 1024x1280 1080x1440 1080x1920 1200x1600 1200x1920 1440x1920 1440x2560
1536x2048 1944x2592 2160x3840 2448x3264 3000x4000 3024x4032
"""  # of cameras
_CUT_OUT = "For a part of an image use camera.crop"


def checked_numbers(
    model: type[CameraLike], intrinsics: Numbers, distortion: Numbers | None, image_size: Sequence[int] | None
) -> _Checked:
    """Return checked intrinsics, distortion, its names, batch dims and image size of a camera of this model."""
    owner = model.__name__
    intrinsics = checked_intrinsics(model, intrinsics)
    if distortion is None:
        ideal = model.ideal(model.default_count)
        k = intrinsics.new_tensor(ideal) if ideal else intrinsics.new_empty(0)
        distortion = k if intrinsics.ndim == 1 else k.expand(*intrinsics.shape[:-1], len(ideal))
    else:
        distortion = checked_distortion(model, distortion, intrinsics)
    batch = as_batch(owner, intrinsics=intrinsics.shape, distortion=distortion.shape)
    size = as_image_size(image_size, owner)
    if size is not None:
        rows = off_centre(intrinsics, size)
        warn_of_order(rows, size, owner)
        warn_of_size(rows, size, owner)
    return intrinsics, distortion, model.names_of(distortion.shape[-1]) or (), batch, size


def check_fast(model: type[CameraLike], intrinsics: Any, distortion: Any, size: Any) -> _Checked | None:
    """Return `checked_numbers` for lists of a camera, or plain tensors of some, that are right at a glance, or None."""
    if not (model.always_defined and are_free(*[value for value in (intrinsics, distortion) if type(value) is Tensor])):
        return None
    made: list[Tensor] = []
    tables: list[Rows] = []
    for value in (intrinsics, distortion):
        if type(value) is list and _NUMBERS.issuperset(map(type, value)):
            tensor, rows = torch.empty(len(value)), [value]
        elif type(value) is Tensor and value.ndim == 1 and not value.requires_grad:
            tensor, rows = value.clone(), [value.tolist()]
        elif type(value) is Tensor and value.ndim == 2 and 0 < len(value) <= _LOOKED_AT and not is_predicted(value):
            tensor, rows = value.clone(), value.tolist()
        elif value is None and not model.default_count and made:
            rows = [[]] * len(tables[0])
            tensor = made[0].new_empty(0) if made[0].ndim == 1 else made[0].new_empty(len(rows), 0)
        else:
            return None
        if not (tensor.dtype in _DTYPES and tensor.is_cpu):
            return None
        most = _SIZE_LIKE if made else _LARGE
        for row in rows:
            if not sum(map(abs, row)) < most:
                return None
        if rows[0] is value:
            tensor.numpy()[:] = value  # takes half the time of torch.tensor
        made.append(nn.Parameter(tensor) if rows[0] else tensor)
        tables.append(rows)
    numbers, k = tables
    names = _names_of(model, len(k[0]))  # type: ignore[arg-type]  # a class can be hashed
    if len(numbers[0]) != 4 or made[0].ndim != made[1].ndim or len(numbers) != len(k) or names is None:
        return None
    if size is not None and not (
        type(size) is tuple and len(size) == 2 and type(size[0]) is type(size[1]) is int and min(size) > 0
    ):
        return None
    for fx, fy, cx, cy in numbers:
        if not (fx > 0 and fy > 0 and (size is None or _off_centre(cx, cy, size) <= _CENTRED)):
            return None
    return made[0], made[1], names, made[0].shape[:-1], size


_names_of = functools.lru_cache(maxsize=256)(lambda model, count: model.names_of(count))


def checked_intrinsics(model: type[CameraLike], intrinsics: Numbers) -> Tensor:
    """Return the intrinsics (*B, 4) of a camera of this model as a tensor; raise as `Camera` does."""
    owner = model.__name__
    intrinsics = as_real(intrinsics, "intrinsics", owner)
    if intrinsics.ndim == 0 or intrinsics.shape[-1] != 4:
        hint = f". For a matrix K use {owner}.from_matrix" if intrinsics.shape[-2:] == (3, 3) else ""
        hint = ". Pass a column as intrinsics[..., 0]" if intrinsics.shape[-2:] == (4, 1) else hint
        raise ValueError(
            f"{owner}: intrinsics must be (*B, 4) = fx, fy, cx, cy; got shape {tuple(intrinsics.shape)}{hint}"
        )
    row = row_of(intrinsics)
    if not is_predicted(intrinsics) and (known_false(intrinsics[..., :2] > 0) if row is None else min(row[:2]) <= 0):
        hint = f". For matrices (4, 4) use {owner}.from_matrix(K[..., :3, :3])"
        hint = hint if intrinsics.shape[-2:] == (4, 4) else ""
        raise ValueError(
            f"{owner}: focal lengths must be positive; got fx, fy = {intrinsics[..., :2].tolist()!s:.200}{hint}"
        )
    return intrinsics


def checked_distortion(model: type[CameraLike], distortion: Numbers, intrinsics: Tensor) -> Tensor:
    """Return the distortion (*B, n) of a camera of this model and intrinsics as a tensor; raise as `Camera` does."""
    owner = model.__name__
    distortion = as_real(distortion, "distortion", owner, intrinsics.device)
    row = row_of(distortion)
    if row is not None and len(row) == 2 and min(row) >= _SIZE_LIKE and all(map(float.is_integer, row)):
        raise ValueError(f"{owner}: distortion must not be an image size; got {row}. Use image_size=(height, width)")
    if not model.distortion_names and distortion.numel():
        raise ValueError(
            f"{owner}: distortion must be left out, as the model has none; got shape {tuple(distortion.shape)}. "
            "BrownConrady takes those of OpenCV's calibrateCamera, KannalaBrandt those of fisheye, Mei omnidir's"
        )
    known = distortion.ndim > 0 and model.names_of(distortion.shape[-1]) is not None
    in_doubt = _is_column(model, distortion) and intrinsics.shape[:-1] != distortion.shape[:-1]
    if known:
        as_batch(owner, intrinsics=intrinsics.shape, distortion=distortion.shape)
    if not known or in_doubt:
        hint = _column_hint(distortion) if in_doubt else ""
        raise ValueError(
            f"{owner}: distortion must be (*B, n) with {model.counts_text()}; got shape {tuple(distortion.shape)}{hint}"
        )
    is_known = model.always_defined or is_predicted(distortion)
    defined = None if is_known else model.defined(distortion.unbind(-1))
    if defined is not None and known_false(defined > 0):
        raise ValueError(f"{owner}: distortion must have {model.defined_text}; got {distortion.tolist()}")
    return distortion


def replaced(
    camera: CameraT, intrinsics: Numbers | None, distortion: Numbers | None, image_size: Sequence[int] | None
) -> CameraT:
    """Return the camera with the given numbers in place of its own; see `Camera.replace`."""
    model: type[CameraT] = type_before_parametrizations(camera)
    changes: dict[str, Any] = {}
    if image_size is not None:
        changes["image_size"] = as_image_size(image_size, model.__name__)
    now, k = camera.intrinsics, camera.distortion
    if intrinsics is not None:
        now = changes["intrinsics"] = checked_intrinsics(model, as_numbers_of(camera, intrinsics, "intrinsics"))
    if distortion is not None:
        k = changes["distortion"] = checked_distortion(model, as_numbers_of(camera, distortion, "distortion"), now)
        changes["distortion_names"] = model.names_of(k.shape[-1])
    batch = as_batch(model.__name__, intrinsics=now.shape, distortion=k.shape)
    check_devices(model.__name__, intrinsics=now, distortion=k)
    size = changes.get("image_size", camera.image_size)
    if size is not None and intrinsics is not None:
        warn_of_order(off_centre(now, size), size, model.__name__)
    elif size is not None and camera.image_size is None and now.is_cpu and now.grad_fn is None:  # as of a file's K
        warn_of_size(off_centre(now.detach(), size), size, model.__name__)
    for name in changes.keys() & {"intrinsics", "distortion"}:
        value = changes[name]
        if not is_kept(value):
            own = value.detach().expand(*batch, value.shape[-1]).clone()
            own = own.float() if own.dtype.itemsize < 4 else own
            changes[name] = nn.Parameter(own, requires_grad=getattr(camera, name).requires_grad)
    return remade(camera, **changes)


def as_numbers_of(camera: CameraLike, value: Numbers, name: str) -> Tensor:
    """Return a tensor itself, and other numbers in the camera's dtype and on its device."""
    if isinstance(value, Tensor):
        return value
    as_real(value, name, type_before_parametrizations(camera).__name__)
    return torch.as_tensor(np.asarray(value, dtype=np.float64)).to(camera.intrinsics)


def unstack_numbers(intrinsics: Tensor, xp: Any) -> Iterable[Any]:
    """Return fx, fy, cx, cy of intrinsics (*B, 4) in float64, as tensors, or as numbers and arrays."""
    if xp is torch:
        return precise(intrinsics).unbind(-1)
    return intrinsics.tolist() if intrinsics.ndim == 1 else intrinsics.detach().double().numpy().T


def stack_numbers(numbers: Sequence[Any], like: Tensor, xp: Any) -> Tensor:
    """Return (*B, n) for n tensors (*B,), or for numbers and arrays, in the dtype of a tensor."""
    if xp is torch:
        return torch.stack(torch.broadcast_tensors(*numbers), -1).to(like.dtype)
    kind = np.float64 if like.dtype == torch.float64 else np.float32
    if {float, np.float64}.issuperset(map(type, numbers)):
        return torch.from_numpy(np.array(numbers, kind))
    return torch.from_numpy(np.stack(np.broadcast_arrays(*numbers), -1).astype(kind, copy=False))


def _is_column(model: type[CameraLike], distortion: Tensor) -> bool:
    """Whether `distortion` may be one camera's coefficients as OpenCV's column (n, 1), n > 1."""
    count = max(distortion.shape[:-1], default=1) if distortion.shape[-1:] == (1,) else 1
    return count > 1 and model.names_of(count) is not None


def _column_hint(distortion: Tensor) -> str:
    count = max(distortion.shape)
    return (
        f". Pass the {count} coefficients of one lens, a column in OpenCV, as distortion[..., 0], and one "
        f"coefficient of each of {count} cameras with intrinsics ({count}, 4)"
    )


def numbers_of_matrix(
    model: type[CameraLike], matrix: Numbers, distortion: Numbers | None, ignore_skew: bool
) -> tuple[Tensor] | tuple[Tensor, Tensor]:
    """Return the intrinsics of a matrix K, and the distortion if it is given; see `Camera.from_matrix`."""
    owner = model.__name__
    K = as_real(matrix, "K", owner)  # noqa: N806
    if K.shape[-2:] == (4, 4) and not known_false((K[..., :3, 3] == 0) & (K[..., 3, :3] == 0)):
        K = K[..., :3, :3]  # noqa: N806
    if K.shape[-2:] != (3, 3):
        hint = ". For larger ones use K[..., :3, :3]" if min(K.shape[-2:], default=0) >= 3 else ""
        raise ValueError(f"{owner}: K must be (*B, 3, 3); got shape {tuple(K.shape)}{hint}")
    bottom, skew = K[..., 2, :].detach(), K[..., 0, 1].detach()
    if known_false(bottom == bottom.new_tensor([0, 0, 1])) or known_false(K[..., 1, 0] == 0):
        raise ValueError(f"{owner}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; got {K.tolist()}")
    if not as_flag(ignore_skew, "ignore_skew", owner) and known_false(skew == 0):
        raise ValueError(
            f"{owner}: K must have no skew, as the model has none; got K[0, 1] = {skew.tolist()}. "
            "ignore_skew=True drops it"
        )
    intrinsics = torch.stack((K[..., 0, 0], K[..., 1, 1], K[..., 0, 2], K[..., 1, 2]), -1)
    if distortion is None:
        return (intrinsics,)
    distortion = as_real(distortion, "distortion", owner, K.device)
    if not model.distortion_names:
        return intrinsics, distortion  # the constructor raises
    if K.ndim == 2 and distortion.numel() == max(distortion.shape, default=0):
        distortion = distortion.flatten()
    elif 2 < K.ndim == distortion.ndim and distortion.shape[-2] == 1:  # OpenCV's rows (1, n), stacked
        distortion = distortion.squeeze(-2)
    elif _is_column(model, distortion):
        raise ValueError(
            f"{owner}: distortion must fit K {tuple(K.shape)}; got shape {tuple(distortion.shape)}"
            + _column_hint(distortion)
        )
    count = distortion.shape[-1] if distortion.ndim else 0
    if count in _OF_CALIBRATE_CAMERA and (model.names_of(count) or ())[:3] == ("k1", "k2", "k3"):
        raise ValueError(
            f"{owner}: distortion must be OpenCV's for a fisheye, 4; got {count} coefficients, as of calibrateCamera, "
            f"k1 k2 p1 p2 k3 .... Use BrownConrady for those; {owner}(intrinsics, "
            "distortion) takes any number"
        )
    return intrinsics, distortion


def camera_of_fov(
    model: type[CameraT], fov: Numbers, image_size: Sequence[int], axis: str, distortion: Numbers | None
) -> CameraT:
    """Make the camera of a field of view in degrees; see `Camera.from_fov`."""
    owner = f"{model.__name__}.from_fov"
    size = as_image_size(image_size, owner)
    if size is None:
        raise ValueError(f"{owner}: image_size must be that of the image whose fov it is; got None")
    one_of(axis, AXES, "axis", owner)
    device = distortion.device if isinstance(distortion, Tensor) else None
    fov = torch.tensor(fov, dtype=torch.float64, device=device) if isinstance(fov, (int, float)) else fov
    degrees = as_real(fov, "fov", owner).detach().double()
    if known_false((degrees > 0) & (degrees <= 360)):
        raise ValueError(f"{owner}: fov must be in degrees, above 0 and up to 360; got {degrees.tolist()}")
    if (known := values_of(degrees)) is not None and known.numel():
        check_degrees(float(known.min()), known.tolist(), owner)
    given = () if distortion is None else (as_real(distortion, "distortion", owner, degrees.device),)
    make = cast("Callable[..., CameraT]", model)
    plane = make(degrees.new_tensor([1.0, 1.0, 0.0, 0.0]), *(t.detach().double() for t in given))
    degrees = degrees.expand(as_batch(owner, fov=(*degrees.shape, 1), distortion=plane.distortion.shape))
    focal, reached = focal_for(plane, degrees.deg2rad(), size, axis)
    centre = focal.new_tensor([(size[1] - 1) / 2, (size[0] - 1) / 2]).expand(*focal.shape, 2)
    intrinsics = torch.cat((focal[..., None], focal[..., None], centre), -1)
    intrinsics = intrinsics.to(given[0].dtype if given else torch.get_default_dtype())
    made = make(intrinsics, *given, image_size=size)
    if known_false(reached):
        widest = made.fov[..., AXES.index(axis)].flatten().tolist()
        raise ValueError(
            f"{owner}: {axis} fov must be within this lens's widest; got {degrees.tolist()} degrees. The widest is "
            + ", ".join(f"{angle:.5g}" for angle in widest)
        )
    return made


def off_centre(intrinsics: Tensor, size: tuple[int, int]) -> Rows:
    """Return the rows of plain numbers (*B, 4); none if a principal point is near the middle of images of `size`."""
    if is_kept(intrinsics) or is_predicted(intrinsics):
        return []
    row = row_of(intrinsics)
    known = values_of(intrinsics) if row is None else None
    rows = [row] if row is not None else [] if known is None else known.reshape(-1, 4)[:_LOOKED_AT].tolist()
    return [] if any(_off_centre(cx, cy, size) <= _CENTRED for _, _, cx, cy in rows) else rows


def warn_of_order(rows: Rows, size: tuple[int, int], owner: str, order: str = "(height, width)") -> None:
    """Warn of rows `off_centre` that fit in another order only: sides exchanged, or as fx, cx, fy, cy.

    order: how the sides were given.
    """
    if not rows:
        return
    given = f"fx, fy, cx, cy = {rows[0]}"
    is_file = order == "(width, height)"
    sides = size[::-1] if is_file else size
    how = "Write image_width and image_height" if is_file else "Exchange OpenCV's (width, height)"
    if all(_off_centre(cx, cy, size[::-1]) <= _NEAR for _, _, cx, cy in rows):
        warn(
            f"{owner}: image_size={sides} is taken as {order}, but the principal point of {given} is the "
            f"middle of {sides[::-1]}. {how}. {_CUT_OUT}"
        )
    elif all(
        _off_centre(fy, cy, size) <= _NEAR and abs(cx - fx) <= _NEAR * fx and abs(fy - fx) > _CENTRED * fx
        for fx, fy, cx, cy in rows
    ):
        warn(
            f"{owner}: {given} have their principal point far from the middle of images of {size}, and seem to be "
            f"fx, cx, fy, cy. Pass both focal lengths first. {_CUT_OUT}"
        )
    elif all(20 * max(fx, fy) < min(size) and max(abs(cx - 0.5), abs(cy - 0.5)) < 0.2 for fx, fy, cx, cy in rows):
        warn(
            f"{owner}: {given} seem to be parts of the image's width and height. Multiply fx and cx by the width, "
            "fy and cy by the height, and subtract 0.5 from cx and cy"
        )


def warn_of_size(rows: Rows, size: tuple[int, int], owner: str) -> None:
    """Warn of rows `off_centre` that seem to be of larger or of smaller images than those of `size`."""
    offs = [((cx + 0.5) / size[1] - 0.5, (cy + 0.5) / size[0] - 0.5) for _, _, cx, cy in rows]
    if not rows or not (all(min(off) > _FAR for off in offs) or all(max(off) < -_FAR for off in offs)):
        return
    cx, cy = rows[0][2:]
    known = [(int(a), int(b)) for a, b in (text.split("x") for text in _SIZES.split())]
    its = min(known + [size[::-1] for size in known], key=lambda size: _off_centre(cx, cy, size))
    its = its if _off_centre(cx, cy, its) < _NEAR / 2 else (16 * round(cy / 8), 16 * round(cx / 8))
    if min(its) >= _SIZE_LIKE:
        warn(
            f"{owner}: fx, fy, cx, cy = {rows[0]} have their principal point far from the middle of images of {size}, "
            f"and seem to be of images of about (height, width) = {its}. Pass image_size={its}, then scale that camera "
            f"by .resize{size}. {_CUT_OUT}"
        )


def warn_of_exchange(old: tuple[int, int], new: tuple[int, int], owner: str, how: str = "stretched") -> None:
    """Warn of a new size that has the shape of the old one on its side, as (width, height) would."""
    turned = new[0] * old[0] / (new[1] * old[1])
    if old[0] != old[1] and abs(turned - 1) < _CENTRED / 10:
        warn(
            f"{owner}: an image of (height, width) = {old} is {how} to {new}; it would keep its shape as "
            f"{new[::-1]}. For the image on its side use camera.rot90"
        )


def _off_centre(cx: float, cy: float, size: tuple[int, int]) -> float:
    """Return the distance of a point from the middle of an image, the larger of the parts of its height and width."""
    height, width = size
    return max(abs(cx - (width - 1) / 2) / width, abs(cy - (height - 1) / 2) / height)
