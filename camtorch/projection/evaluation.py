"""The evaluation of cameras: the way that a call takes, and the results kept of a camera for the next one.

`evaluate_points` shapes points to rows, and a camera's `_evaluate` calls `evaluate_rows`: as a constant of an exported
program, in native code (by `_NativeCall` if something learns), or by the formula. `camera_rows` keeps their results.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn.utils import parametrize

from camtorch.evaluate.door import in_memory, is_constant, is_recorded, way_of
from camtorch.evaluate.export import portable_export, with_values
from camtorch.evaluate.kept import Kept, same
from camtorch.evaluate.tensors import are_free
from camtorch.native.library import warn_if_missing
from camtorch.projection.camera_like import CameraLike
from camtorch.projection.rows import CameraRows, Direction, unusable
from camtorch.values.arguments import Numbers, as_points, present, warn

_MANY_POINTS = 1_000_000  # a call of as many is so slow without the library that it warns
_BLOCK_POINTS = 1 << 17  # of all cameras, for each thread

if TYPE_CHECKING:
    from camtorch.projection.native_cameras import Native


def evaluate_points(camera: CameraLike, direction: Direction, values: Numbers) -> tuple[Tensor, Tensor]:
    """Return the planes and the mask of `evaluate_rows` for values (*B, *N, size), in their shape."""
    batch, tensors, size = camera.batch_shape, camera.tensors, direction.size
    lead, dims = batch, len(batch)
    if not (
        isinstance(values, Tensor)
        and values.layout is torch.strided
        and values.dtype == tensors[0].dtype == tensors[-1].dtype  # the tensors of a Mixed have one dtype
        and values.device == tensors[0].device
        and values.ndim > dims
        and values.shape[:dims] == batch
        and values.shape[-1] == size
    ):
        values, lead = as_points(values, direction.name, size, batch, tensors, type(camera).__name__)
    shape = values.shape[:-1]
    rows = values.reshape(math.prod(lead), math.prod(shape[dims:]), size)
    planes, valid = camera._evaluate(direction, rows, lead, tensors)
    return planes.reshape((planes.shape[0], *shape)).movedim(0, -1), valid.reshape(shape)


def evaluate_rows(
    model: type[CameraLike],
    direction: Direction,
    rows: Tensor,
    lead: torch.Size,
    tensors: Sequence[Tensor],
    cameras_of: Callable[[Tensor, Tensor], CameraRows],
    constant: CameraLike | None,
) -> tuple[Tensor, Tensor]:
    """Return planes (size_out, C, N), and valid (C, N), for rows (C, N, size) seen by cameras of a model.

    It decides whether native code or torch evaluates a direction; `native_forms` decides for warps, poses and boards.
    The cameras have the `tensors` (*B, 4) and (*B, n); `lead` are the batch dims that C counts. `cameras_of` returns
    the results kept of them as (C, 4) and (C, n). `constant` is the camera that they are of, if an exported program
    may hold it as a constant.
    """
    intrinsics, distortion = per_row(tensors, lead, rows)
    way = way_of(model.__name__, rows, intrinsics, distortion)
    if constant is not None and not way.is_native and is_constant(constant) and all(type(side) is int for side in lead):
        with with_values(constant):
            intrinsics, distortion = per_row(constant.tensors, lead, rows)
            cameras = cameras_of(intrinsics, distortion).as_constant()
        with portable_export():
            return direction.formula(model, rows, intrinsics, distortion, cameras)
    known = cameras_of(intrinsics, distortion) if way.is_known else None
    native = known.native if known is not None and way.is_native else None
    if native is not None and way.learns:
        planes, valid = _NativeCall.apply(  # type: ignore[no-untyped-call]
            rows, intrinsics, distortion, direction, native, known
        )
        return planes, valid
    if native is not None:
        planes, valid, _ = direction.native(native, rows, False)
        return planes, valid
    if way.is_native and rows.shape[0] * rows.shape[1] >= _MANY_POINTS:
        warn_if_missing()
    few = known is None or rows.shape[0] * rows.shape[1] <= _BLOCK_POINTS
    if few or not are_free(rows, intrinsics, distortion):
        return direction.formula(model, rows, intrinsics, distortion, known)
    return _by_blocks(lambda block: direction.formula(model, block, intrinsics, distortion, known), rows, direction)


def _by_blocks(
    evaluate: Callable[[Tensor], tuple[Tensor, Tensor]], rows: Tensor, direction: Direction
) -> tuple[Tensor, Tensor]:
    """Return the results of blocks of rows (C, N, size), which stay in a cache from one operation to the next."""
    planes = rows.new_empty(direction.size_out, *rows.shape[:2])
    valid = torch.empty(planes.shape[1:], dtype=torch.bool, device=planes.device)
    step = max(_BLOCK_POINTS * torch.get_num_threads() // len(rows), 1)
    for start in range(0, rows.shape[1], step):
        block = slice(start, start + step)
        planes[..., block], valid[..., block] = evaluate(rows[:, block])
    return planes, valid


def native_forms(cameras: Sequence[CameraLike], *values: Tensor) -> tuple[list[Native], bool] | None:
    """Return the native forms of cameras, each (B,) or single, and whether any of them is a batch.

    None if `evaluate_rows` would record values of the first one's dtype, for several models, and with a shutter.
    """
    dtype, pairs, inputs = values[0].dtype, [], [*values]
    for camera in cameras:
        if not camera.has_native_form:
            return None
        pairs.append(camera.tensors)
        inputs += pairs[-1]
    if not (dtype.is_floating_point and are_free(*inputs)):
        return None
    forms, is_batch = [], False
    for camera, (intrinsics, distortion) in zip(cameras, pairs, strict=True):
        if not intrinsics.dtype == distortion.dtype == dtype:
            return None
        if intrinsics.ndim > 1 or distortion.ndim > 1:
            is_batch, batch = True, intrinsics.shape[:-1]
            if distortion.shape[:-1] != batch:
                batch = camera.batch_shape
                intrinsics, distortion = (t.expand(*batch, t.shape[-1]) for t in (intrinsics, distortion))
            if len(batch) != 1:
                return None
        native = camera_rows(camera, intrinsics, distortion).native
        if native is None:
            return None
        forms.append(native)
    return forms, is_batch


class _NativeCall(Function):
    """A call of the native geometry, with derivatives; second derivatives come from the formula."""

    @staticmethod
    def forward(
        ctx: Any,
        rows: Tensor,
        intrinsics: Tensor,
        distortion: Tensor,
        direction: Direction,
        native: Native,
        cameras: CameraRows,
    ) -> tuple[Tensor, Tensor]:
        planes, valid, kept = direction.native(native, rows, True)
        ctx.save_for_backward(rows, intrinsics, distortion, *kept)
        ctx.direction, ctx.native, ctx.cameras = direction, native, cameras
        ctx.mark_non_differentiable(valid)
        ctx.set_materialize_grads(False)
        return planes, valid

    @staticmethod
    def backward(ctx: Any, by_planes: Tensor | None, _: Tensor | None) -> tuple[Tensor | None, ...]:
        """Return the cotangents of rows and parameters, with a graph if one is recorded."""
        if by_planes is None:
            return (None,) * 6
        wanted, cameras = ctx.needs_input_grad[:3], ctx.cameras
        if torch.is_grad_enabled() or not in_memory(by_planes) or is_recorded():
            # use the formula, with a graph of its own
            inputs = ctx.saved_tensors[:3]
            leaves = [t for t, needed in zip(inputs, wanted, strict=True) if needed]
            with torch.enable_grad():
                planes, _ = ctx.direction.formula(cameras.model, *inputs, cameras)
                found = iter(torch.autograd.grad(planes, leaves, by_planes, create_graph=True, materialize_grads=True))
            by_inputs = [next(found) if needed else None for needed in wanted]
        else:
            by_rows, sums = ctx.direction.native_vjp(
                ctx.native, *ctx.saved_tensors[3:], by_planes, wanted[0], wanted[1] or wanted[2]
            )
            by_inputs = [by_rows, *cameras.cotangents(sums, wanted[1:])]
        return *by_inputs, None, None, None


def camera_rows(camera: CameraLike, intrinsics: Tensor, distortion: Tensor) -> CameraRows:
    """Return the rows' cameras, kept until a value changes."""
    cameras = kept_cameras(camera._memo, type(camera), intrinsics, distortion)
    if cameras.usable is not None and not (camera._expects_unusable or camera._told):
        _warn_of_unusable(camera, cameras)
    return cameras


def kept_cameras(memo: Kept, model: type[CameraLike], intrinsics: Tensor, distortion: Tensor) -> CameraRows:
    """Return the cameras (C,) of one model, kept in a memo until a value changes."""
    cameras: CameraRows | None = memo.result
    if cameras is not None:
        for now, (then, mark) in zip((intrinsics, distortion), cameras.notes, strict=True):
            if mark is not None:
                is_same = same(now, (then, mark))
            else:
                # a single camera comes as (n,) from warps, as (1, n) from `per_row`
                if now.ndim != then.ndim and now.numel() == then.numel():
                    now = now[None] if now.ndim < then.ndim else now[0]
                is_same = now.dtype == then.dtype and now.device == then.device and torch.equal(now, then)
            if not is_same:
                break
        else:
            return cameras
    return memo.renew(lambda: CameraRows(model, intrinsics, distortion))


def _warn_of_unusable(camera: CameraLike, cameras: CameraRows) -> None:
    """Warn once if learning drove a module's Parameters to where no camera is, from which no gradient leads back."""
    usable = present(cameras.usable, "which cameras are usable")
    if not usable.is_cpu:  # reading values would wait for the device
        return
    bad = (usable <= 0).flatten().nonzero()
    found = unusable(camera, *(t[bad[0, 0]] for t in cameras.given)) if len(bad) else None
    if found is None or not isinstance(getattr(camera, found[0]), nn.Parameter):
        return
    camera._told = True
    tensor, reason = found
    name = parametrize.type_before_parametrizations(camera).__name__
    where = f" of camera {int(bad[0, 0])} in the batch" if len(cameras.given[0]) > 1 else ""
    keeps = "; focal lengths stay positive after torch.nn.utils.parametrize.register_parametrization(camera, "
    keeps += '"intrinsics", PositiveFocal()), which is in camtorch.networks.parametrize'
    warn(
        f"{name}: {tensor}{where} became unusable: {reason}. All its results are invalid and its gradients "
        f"zero from here on. Use a smaller learning rate{keeps if tensor == 'intrinsics' else ''}"
    )


def per_row(tensors: Sequence[Tensor], lead: torch.Size, rows: Tensor) -> list[Tensor]:
    """Return tensors (*B, n) as (C, n), in the dtype of the rows (C, N, size)."""
    made = []
    for tensor in tensors:
        count = tensor.shape[-1]
        if tensor.dtype != rows.dtype:
            tensor = tensor.to(rows.dtype)
        if not lead:
            tensor = tensor.unsqueeze(0)
        elif tensor.shape != (rows.shape[0], count):
            tensor = tensor.expand(*lead, count).reshape(rows.shape[0], count)
        made.append(tensor)
    return made
