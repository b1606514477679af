"""Conversion of a camera to another model, with its errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.convert import views
from camtorch.convert.fitting import fit, refine_minimax
from camtorch.convert.measuring import Reference, measure, reference
from camtorch.convert.relations import carry_over, default_count
from camtorch.convert.result import CameraT, Conversion
from camtorch.projection.camera_like import CameraLike
from camtorch.values.arguments import as_image_size, as_number, as_whole
from camtorch.values.module import remade

_FIT_SIDE = 33  # nodes along a side of the lattice of pixels to fit to
_ROWS = 64  # rows of a batch that are converted together
_WORTH_IT = 0.5  # of the largest error before: more coefficients are taken if they get below it


@torch.no_grad()
def convert(
    source: CameraLike,
    model: type[CameraT],
    models: Mapping[str, type[CameraLike]],
    *,
    count: int | None,
    image_size: Sequence[int] | None,
    max_angle: float | None,
    tolerance: float,
    **options: Any,
) -> Conversion[CameraT]:
    """Convert a camera; see `Camera.convert`. `models` has all models by key; some may relate source and target."""
    owner = f"{type_before_parametrizations(source).__name__}.convert"
    image_size = as_image_size(image_size, owner) or source.image_size
    max_angle = None if max_angle is None else as_number(max_angle, "max_angle", owner)
    if max_angle is not None and not 0 < max_angle <= math.pi * (1 + 1e-6):
        raise ValueError(f"{owner}: max_angle must be positive radians, up to pi; got {max_angle}")
    tolerance = as_number(tolerance, "tolerance", owner)
    if not tolerance > 0:
        raise ValueError(f"{owner}: tolerance must be positive; got {tolerance}")
    if count is None:
        least = default_count(model, source, models)
        counts: tuple[int, ...] = (least, *(n for n in model.fit_counts if n > least))
    else:
        counts = (as_whole(count, "count", owner),)
    if counts[0] < 0 or model.names_of(counts[0]) is None:
        raise ValueError(f"{owner}: count must fit {model.__name__}, {model.counts_text()}; got {count}")

    def build(parameters: Tensor) -> CameraT:
        intrinsics, distortion = parameters[..., :4], parameters[..., 4:]
        # models without coefficients take no argument for them
        intrinsics = nn.Parameter(intrinsics.clone())
        arguments = (intrinsics, distortion) if distortion.shape[-1] else (intrinsics,)
        return model(*arguments, image_size=image_size, **options).double()

    limit = math.pi if max_angle is None else min(math.pi, max_angle)
    batch = source.batch_shape
    tensors = [t.detach().double().expand(*batch, -1).reshape(batch.numel(), t.shape[-1]) for t in source.tensors]
    parts = []
    for intrinsics, distortion in zip(*(t.split(_ROWS) for t in tensors), strict=True):
        rays = reference(remade(source, intrinsics=intrinsics, distortion=distortion), image_size, limit)
        parts.append(_with_fewest_coefficients(_Task(rays, model, models, build, tolerance), counts))
    most = max(part.parameters.shape[-1] for part in parts)
    result = _Result(*map(torch.cat, zip(*(part.padded(most) for part in parts), strict=True)))
    camera = build(result.parameters.reshape(*batch, most)).freeze_like(source)
    names = ("rms", "max_error", "max_angle", "valid_fraction", "exact")
    numbers: dict[str, Any] = {name: getattr(result, name).reshape(batch) for name in names}
    return Conversion(camera, **numbers, source_name=type_before_parametrizations(source).__name__)


class _Task(NamedTuple):
    """Cameras (C,) to convert."""

    source: Reference
    model: type[CameraLike]
    models: Mapping[str, type[CameraLike]]
    build: Callable[[Tensor], CameraLike]
    tolerance: float

    def of(self, rows: Tensor) -> _Task:
        """Return the task of converting some of the cameras."""
        camera, image_size, lattice, *_ = self.source
        intrinsics, distortion = (t[rows] for t in camera.tensors)
        chosen = remade(camera, intrinsics=intrinsics, distortion=distortion)
        return self._replace(source=reference(chosen, image_size, lattice.limit))


class _Result(NamedTuple):
    """Parameters (C, 4 + n), and the numbers of a `Conversion`, (C,) each."""

    parameters: Tensor
    rms: Tensor
    max_error: Tensor
    max_angle: Tensor
    valid_fraction: Tensor
    exact: Tensor

    def of(self, rows: Tensor) -> _Result:
        return _Result(*(t[rows] for t in self))

    def replaced(self, rows: Tensor, other: _Result) -> _Result:
        """Return the results with those of `other` at `rows`."""
        if len(rows) == 0:
            return self  # without padding
        width = max(self.parameters.shape[-1], other.parameters.shape[-1])
        pairs = zip(self.padded(width), other.padded(width), strict=True)
        return _Result(*(t.index_copy(0, rows, new) for t, new in pairs))

    def padded(self, width: int) -> _Result:
        """Return the results with parameters (C, width), filled with zeros."""
        more = width - self.parameters.shape[-1]
        return self._replace(parameters=torch.nn.functional.pad(self.parameters, (0, more)))


def _with_fewest_coefficients(task: _Task, counts: tuple[int, ...]) -> _Result:
    """Convert each row with the first of `counts` within the tolerance, or with the last one that halved the error."""
    result = _convert(task, counts[0])
    for count in counts[1:]:
        rows = ((result.max_error > task.tolerance) & result.max_error.isfinite()).nonzero()[:, 0]
        if len(rows) == 0:
            break
        before, other = result.of(rows), _convert(task.of(rows), count)
        most = (_WORTH_IT * before.max_error).clamp(min=task.tolerance)
        good = (other.max_error <= most) & _reaches_as_far(other, before)
        result = result.replaced(rows[good], other.of(good))
    return result


def _reaches_as_far(result: _Result, before: _Result) -> Tensor:
    return result.max_angle >= before.max_angle * (1 - 1e-9)  # but for rounding


def _convert(task: _Task, count: int) -> _Result:
    source, model, build = task.source.camera, task.model, task.build
    names = model.names_of(count) or ()
    slopes = views.focal_at_axis(source)
    samples = views.sample(source, task.source.image_size, _FIT_SIDE, task.source.lattice.limit)
    starts = model.fit_start(names, *views.radii(source, slopes, task.source.reach))
    exact = torch.zeros(len(slopes), dtype=torch.bool, device=slopes.device)
    parameters = torch.cat((slopes, starts[0]), -1)
    usable = torch.isfinite(source.distortion).all(-1) & torch.isfinite(source.intrinsics).all(-1)
    carried = carry_over(source, source.distortion.nan_to_num(0.0, 0.0, 0.0), model, names, task.models)
    if carried is not None:
        taken, lossless = carried
        exact = lossless & usable & (source.intrinsics[:, :2] > 0).all(-1)
        starts = torch.cat((starts, taken[None]))
        parameters = torch.where(exact[:, None], torch.cat((source.intrinsics, taken), -1), parameters)
    if not bool(exact.all()):
        fitted = fit(build(parameters), samples, starts, slopes)
        parameters = torch.where(exact[:, None], parameters, fitted)
    result = _measure(task, parameters, exact)
    # the largest error of any camera of the model is at least the least rms
    rows = ((result.max_error > task.tolerance) & (result.rms < task.tolerance)).nonzero()[:, 0]
    if len(rows):
        before, task = result.of(rows), task.of(rows)
        observations = views.with_rings(samples.of(rows), task.source.camera, task.source.image_size)
        refined = refine_minimax(build(before.parameters), observations, before.parameters)
        minimax = _measure(task, refined, before.exact)
        better = (minimax.max_error < before.max_error) & _reaches_as_far(minimax, before)
        result = result.replaced(rows[better], minimax.of(better))
    return result


def _measure(task: _Task, parameters: Tensor, exact: Tensor) -> _Result:
    return _Result(parameters, *measure(task.build(parameters), parameters[:, 4:], exact, task.source), exact)
