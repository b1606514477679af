"""The numbers that a camera is made of, as users give them: checked, and from a matrix or a field of view."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.cameras.image_sizes import (
    CAMERAS_LOOKED_AT,
    CENTRED_SHARE,
    LEAST_SIDE,
    Rows,
    off_centre,
    off_middle,
    warn_of_order,
    warn_of_size,
)
from camtorch.evaluate.tensors import are_free, is_kept, is_predicted, known_false, row_of, values_of
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
)
from camtorch.values.module import remade

CameraT = TypeVar("CameraT", bound=CameraLike)
_Checked = tuple[Tensor, Tensor, tuple[str, ...], torch.Size, tuple[int, int] | None]

_OF_CALIBRATE_CAMERA = 5, 8, 12, 14  # OpenCV's numbers of coefficients; 4 may be of its fisheye, too
_DTYPES, _NUMBERS = (torch.float32, torch.float64), {float, int}
_MOST_SUM = 1e30  # float32 can hold it, and NaN is not below it


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
    """Return `checked_numbers` for lists of one camera, or plain tensors of some; None if a longer look is needed.

    Fast path: None sends the call to `checked_numbers`, which alone raises and warns.
    """
    if not (model.always_defined and are_free(*[value for value in (intrinsics, distortion) if type(value) is Tensor])):
        return None
    given = _plain_rows(intrinsics, _MOST_SUM)
    if given is None:
        return None
    numbers, rows = given
    if distortion is None and not model.default_count:
        k = numbers.new_empty(*numbers.shape[:-1], 0)
    elif (given := _plain_rows(distortion, LEAST_SIDE)) is not None:
        k = given[0]
    else:
        return None
    names = _names_of(model, k.shape[-1])  # type: ignore[arg-type]  # a class can be hashed
    if numbers.shape[-1] != 4 or numbers.shape[:-1] != k.shape[:-1] or names is None:
        return None
    if size is not None and not (type(size) is tuple and [*map(type, size)] == [int, int] and min(size) > 0):
        return None
    for fx, fy, cx, cy in rows:
        if not (fx > 0 and fy > 0 and (size is None or off_middle(cx, cy, size) <= CENTRED_SHARE)):
            return None
    return numbers, k, names, numbers.shape[:-1], size


def _plain_rows(value: Any, most: float) -> tuple[Tensor, Rows] | None:
    """Return a list, or a tensor of few rows, as a new Parameter, and its rows; None for other values, and large ones.

    The absolute values of a row are to sum to less than `most`. A tensor without values does not learn.
    """
    if type(value) is list and _NUMBERS.issuperset(map(type, value)):
        tensor, rows = torch.empty(len(value)), [value]
    elif type(value) is Tensor and value.ndim == 1 and not value.requires_grad:
        tensor, rows = value.clone(), [value.tolist()]
    elif type(value) is Tensor and value.ndim == 2 and 0 < len(value) <= CAMERAS_LOOKED_AT and not is_predicted(value):
        tensor, rows = value.clone(), value.tolist()
    else:
        return None
    if not (tensor.dtype in _DTYPES and tensor.is_cpu):
        return None
    for row in rows:
        if not sum(map(abs, row)) < most:
            return None
    if rows[0] is value:
        tensor.numpy()[:] = value  # takes half the time of torch.tensor
    return nn.Parameter(tensor) if rows[0] else tensor, rows


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
    if row is not None and len(row) == 2 and min(row) >= LEAST_SIDE and all(map(float.is_integer, row)):
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
    known = values_of(degrees)
    if known is not None and known.numel():
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
