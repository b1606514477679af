"""One camera as a camera of another model, and how good that is."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from camtorch.fit import Sights, even_out, fit, see
from camtorch.parameters import as_image_size, as_whole
from camtorch.related import carried, default_count

if TYPE_CHECKING:
    from camtorch.camera import Camera

_FIT_SIDE, _EVEN_SIDE, _CHECK_SIDE = 33, 65, 193  # of the lattices of pixels to fit to, and to check with
_EVEN_UP_TO = 10  # times the tolerance: where more is wrong, errors are not evened out
_ANGLES, _AZIMUTHS, _RADII = 181, 16, 64  # at which a camera is looked at as a whole
_END_AHEAD = math.radians(87)  # of rays, for a camera without a picture that does not see sideways
_ROWS = 64  # of a batch that are worked on at a time


@dataclass
class Conversion:
    """A camera of another model and how it differs from the one that it was made of.

    Compared are the pixels at which both see the same rays, on a lattice over the picture of the old camera, its outer
    edges included; without a picture, on rays in all directions. Each number has the batch shape of the camera.
    """

    camera: Camera
    """The new camera."""
    rms: Tensor
    """The root of the mean squared distance in pixels, up to `max_angle`."""
    max_error: Tensor
    """The largest distance in pixels, up to `max_angle`."""
    max_angle: Tensor
    """The angle from the optical axis, in radians, up to which the new camera has a pixel for each compared ray, and
    beyond which nothing is promised: the picture's largest, the one asked for, or where the new model ends."""
    valid_fraction: Tensor
    """The part of the picture, of what the old camera has rays for, that lies within `max_angle`."""
    exact: Tensor
    """Bool: the models are related, and the numbers were taken over bit by bit; what differs is rounding."""
    source_name: str = "camera"

    def __repr__(self) -> str:
        many = f" x {self.rms.numel()}" if self.rms.ndim else ""
        head = f"{self.source_name} -> {type(self.camera).__name__}{many}: "
        if bool(self.exact.all()):
            text = "exact"
        else:
            worst = "at worst " if self.rms.ndim else ""
            text = f"{worst}rms {float(self.rms.max()):.3g} px, max {float(self.max_error.max()):.3g} px"
        angle, part = math.degrees(float(self.max_angle.min())), 100 * float(self.valid_fraction.min())
        what = "the picture" if self.camera.image_size else "the rays"
        return f"Conversion({head}{text}, up to {angle:.1f} degrees, {part:.4g} % of {what})"


@torch.no_grad()
def convert(
    source: Camera, model: type[Camera] | str, *, count, image_size, max_angle, tolerance, **options
) -> Conversion:
    """See `Camera.convert`."""
    model = _model(model)
    owner = f"{type(source).__name__}.convert"
    image_size = as_image_size(image_size, owner) or source.image_size
    for name, value in (("max_angle must be positive radians", max_angle), ("tolerance must be positive", tolerance)):
        if value is not None and not float(value) > 0:
            raise ValueError(f"{owner}: {name}; got {value}")
    if count is None:
        least = default_count(model, source)
        counts = least, *(n for n in model.fit_counts if n > least)
    else:
        counts = (as_whole(count, "count", owner),)
    if counts[0] < 0 or model.names_of(counts[0]) is None:
        raise ValueError(f"{owner}: {model.__name__} takes {model.counts_text()}; got count={count}")

    def made(parameters: Tensor) -> Camera:
        intrinsics, distortion = parameters[..., :4], parameters[..., 4:]
        arguments = (intrinsics, distortion) if distortion.shape[-1] else (intrinsics,)
        return model(*arguments, image_size=image_size, **options).double()

    limit = math.pi if max_angle is None else min(math.pi, float(max_angle))
    batch = source.batch_shape
    tensors = [t.detach().double().expand(*batch, -1).reshape(batch.numel(), t.shape[-1]) for t in source._tensors]
    parts = [
        _by_counts(_Task(_with_numbers(source, *numbers), model, made, image_size, limit, float(tolerance)), counts)
        for numbers in zip(*(t.split(_ROWS) for t in tensors), strict=True)
    ]
    parameters, *numbers = zip(*parts, strict=True)
    most = max(p.shape[-1] for p in parameters)
    parameters = torch.cat([_padded(p, most) for p in parameters])
    camera = made(parameters.reshape(*batch, most)).freeze_like(source)
    return Conversion(camera, *(torch.cat(n).reshape(batch) for n in numbers), type(source).__name__)


def _model(model) -> type[Camera]:
    from camtorch.camera import MODELS, Camera

    if isinstance(model, str):
        if model not in MODELS:
            raise ValueError(f"there is no camera model {model!r}; known are {', '.join(sorted(MODELS))}")
        return MODELS[model]
    if not (isinstance(model, type) and issubclass(model, Camera) and hasattr(model, "key")):
        raise TypeError(f"convert takes a camera model, or its key in ct.MODELS; got {model!r}")
    return model


def _with_numbers(source: Camera, intrinsics: Tensor, distortion: Tensor) -> Camera:
    """A frozen camera like the source, in float64 and with these rows of numbers, even if they are none."""
    camera = copy.deepcopy(source).double()
    for name, value in (("intrinsics", intrinsics), ("distortion", distortion)):
        delattr(camera, name)
        camera.hold(name, nn.Parameter(value, requires_grad=False), tuple(value.shape))
    return camera.requires_grad_(False)


class _Task(NamedTuple):
    """Some rows to convert."""

    source: Camera
    model: type[Camera]
    made: Callable[[Tensor], Camera]
    image_size: tuple[int, int] | None
    limit: float
    tolerance: float

    def of(self, rows: Tensor) -> _Task:
        """Those of the rows."""
        return self._replace(source=_with_numbers(self.source, *(t[rows] for t in self.source._tensors)))


class _Result(NamedTuple):
    """Parameters (C, 4 + n), and the numbers of a `Conversion`, (C,) each."""

    parameters: Tensor
    rms: Tensor
    max_error: Tensor
    max_angle: Tensor
    valid_fraction: Tensor
    exact: Tensor

    def replaced(self, rows: Tensor, other: _Result) -> _Result:
        """With other results in the place of these rows."""
        if len(rows) == 0:
            return self
        width = max(self.parameters.shape[-1], other.parameters.shape[-1])
        results = [_padded(self.parameters, width).clone(), *(t.clone() for t in self[1:])]
        for result, new in zip(results, (_padded(other.parameters, width), *other[1:]), strict=True):
            result[rows] = new
        return _Result(*results)

    def of(self, rows: Tensor) -> _Result:
        """Those of the rows."""
        return _Result(*(t[rows] for t in self))


def _padded(parameters: Tensor, width: int) -> Tensor:
    return torch.nn.functional.pad(parameters, (0, max(width - parameters.shape[-1], 0)))


def _by_counts(task: _Task, counts: tuple[int, ...]) -> _Result:
    """Each row with the first number of coefficients that keeps the tolerance; with the first of all if none does."""
    result = _converted(task, counts[0])
    for count in counts[1:]:
        rows = ((result.max_error > task.tolerance) & result.max_error.isfinite()).nonzero()[:, 0]
        if len(rows) == 0:
            break
        other = _converted(task.of(rows), count)
        (good,) = ((other.max_error <= task.tolerance) & (other.max_angle >= result.max_angle[rows])).nonzero(
            as_tuple=True
        )
        result = result.replaced(rows[good], other.of(good))
    return result


def _converted(task: _Task, count: int) -> _Result:
    source, model, made = task.source, task.model, task.made
    names = model.names_of(count)
    slopes = _slopes(source)
    view = _view(source, task.image_size, _FIT_SIDE, task.limit)
    fine = _view(source, task.image_size, _CHECK_SIDE, task.limit)
    starts = model.fit_start(names, *_radii(source, slopes, torch.where(fine.valid, fine.angles, 0.0).amax(-1)))
    exact = torch.zeros(len(slopes), dtype=torch.bool, device=slopes.device)
    parameters = torch.cat((slopes, starts[0]), -1)
    usable = torch.isfinite(source.distortion).all(-1) & torch.isfinite(source.intrinsics).all(-1)
    related = carried(source, source.distortion.nan_to_num(0.0, 0.0, 0.0), model, names)
    if related is not None:
        taken, exact = related[0], related[1] & usable & (source.intrinsics[:, :2] > 0).all(-1)
        starts = torch.cat((starts, taken[None]))
        parameters = torch.where(exact[:, None], torch.cat((source.intrinsics, taken), -1), parameters)
    rows = (~exact).nonzero()[:, 0]
    if len(rows):
        parameters[rows] = fit(made(parameters), view.sights.of(rows), starts[:, rows], slopes[rows])
    result = _measured(task, parameters, exact)
    off = result.max_error / task.tolerance
    rows = ((off > 1) & (off <= _EVEN_UP_TO)).nonzero()[:, 0]
    if len(rows):
        sights = _view(task.of(rows).source, task.image_size, _EVEN_SIDE, task.limit).sights
        evened = _measured(task.of(rows), even_out(made(parameters), sights, parameters[rows]), exact[rows])
        (better,) = (
            (evened.max_error < result.max_error[rows]) & (evened.max_angle >= result.max_angle[rows])
        ).nonzero(as_tuple=True)
        result = result.replaced(rows[better], evened.of(better))
    return result


def _measured(task: _Task, parameters: Tensor, exact: Tensor) -> _Result:
    check = _view(task.source, task.image_size, _CHECK_SIDE, task.limit)
    whole = check if task.limit == math.pi else _view(task.source, task.image_size, _CHECK_SIDE, math.pi)
    numbers = _numbers(task.made(parameters), parameters[:, 4:], exact, check, whole)
    return _Result(parameters, *numbers, exact)


def _numbers(target: Camera, k: Tensor, exact: Tensor, check: _View, whole: _View) -> tuple[Tensor, ...]:
    """rms, max_error, max_angle and valid_fraction, (C,) each."""

    def compared(view: _View) -> tuple[Tensor, Tensor]:
        pixels, valid = target.project(view.rays)
        # what was out of the reach of the fit is no part of its result
        reached = see(target, k, view.rays).covered | exact[:, None]
        return torch.linalg.vector_norm(pixels - view.pixels, dim=-1), valid & reached

    errors, mapped = compared(check)
    first_hole = torch.where(check.valid & ~mapped, check.angles, torch.inf).amin(-1, keepdim=True)
    inside = check.valid & mapped & (check.angles < first_hole)
    errors, some = torch.where(inside, errors, 0.0), inside.any(-1)
    max_angle = torch.where(inside, check.angles, 0.0).amax(-1)
    rms = (errors.square().sum(-1) / inside.sum(-1).clamp(min=1)).sqrt()
    rms, max_error = (torch.where(some, number, torch.inf) for number in (rms, errors.amax(-1)))
    mapped = mapped if whole is check else compared(whole)[1]
    shown = whole.valid & mapped & (whole.angles <= max_angle[:, None]) & some[:, None]
    return rms, max_error, max_angle, shown.sum(-1) / whole.valid.sum(-1).clamp(min=1)


# -- what a camera sees


class _View(NamedTuple):
    """Rays (C, N, 3) of a camera, its pixels (C, N, 2) of them, and whether it has them, bool (C, N)."""

    rays: Tensor
    pixels: Tensor
    valid: Tensor

    @property
    def sights(self) -> Sights:
        """What a camera fitted to it shall see."""
        return Sights(self.rays, self.pixels, self.valid.to(self.pixels.dtype))

    @property
    def angles(self) -> Tensor:
        return torch.atan2(torch.hypot(self.rays[..., 0], self.rays[..., 1]), self.rays[..., 2])


def _view(camera: Camera, image_size: tuple[int, int] | None, side: int, limit: float) -> _View:
    """side^2 rays on the picture, or in all directions, of which those count that the camera has up to an angle."""
    if image_size is None:
        rays = _directions(_reach(camera, limit) * torch.linspace(0, 1, side, **_like(camera)), side)
        rays, found = rays.flatten(1, 2), True
    else:
        rays, found = camera.unproject(_lattice(camera, image_size, side, limit))
    pixels, valid = camera.project(rays)
    view = _View(rays, pixels, valid & found)
    return view._replace(valid=view.valid & (view.angles <= limit * (1 + 1e-12)))


def _lattice(camera: Camera, image_size: tuple[int, int], side: int, limit: float) -> Tensor:
    """(C, side^2, 2): pixels of the part of the picture that an angle leaves, its edges included."""
    height, width = image_size
    count = len(camera.intrinsics)
    low = camera.intrinsics.new_full((count, 2), -0.5)
    high = camera.intrinsics.new_tensor([width - 0.5, height - 0.5]).expand(count, 2)
    if limit < math.pi:
        ring, valid = camera.project(_directions(low.new_full((count, 1), limit), 64).flatten(1, 2))
        closed = valid.all(-1)[:, None] & (limit < math.pi / 2)
        least, most = (torch.where(closed, end, whole) for end, whole in ((ring.amin(1), low), (ring.amax(1), high)))
        inside = (least < high) & (most > low)
        low, high = torch.where(inside, least.clamp(min=low), low), torch.where(inside, most.clamp(max=high), high)
    steps = torch.linspace(0, 1, side, **_like(camera))[:, None]
    u, v = (low[:, None] + (high - low)[:, None] * steps).unbind(-1)
    return torch.stack(torch.broadcast_tensors(u[:, None, :], v[:, :, None]), -1).flatten(1, 2)


def _directions(angles: Tensor, azimuths: int) -> Tensor:
    """(C, K) angles from the axis -> (C, K, azimuths, 3) rays; none of them where panoramas are cut."""
    phi = (torch.arange(azimuths).to(angles) + 0.25) * (2 * math.pi / azimuths)
    theta = angles[..., None]
    z = theta.cos().expand(*angles.shape, azimuths)
    return torch.stack((theta.sin() * phi.cos(), theta.sin() * phi.sin(), z), -1)


def _reach(camera: Camera, limit: float) -> Tensor:
    """(C, 1): the angle up to which a camera has rays on some azimuth."""
    angles = torch.linspace(0, math.pi, _ANGLES, **_like(camera))
    rays = _directions(angles.expand(len(camera.intrinsics), -1), _AZIMUTHS)
    sees = camera.project(rays)[1].any(-1).long().cumprod(-1)
    reach = (angles * sees).amax(-1, keepdim=True)
    return torch.where(reach < math.pi / 2, reach.clamp(max=_END_AHEAD), reach).clamp(max=limit)


def _slopes(camera: Camera) -> Tensor:
    """(C, 4): the focal lengths at the axis, and the pixel of the axis."""
    h = 1e-3
    around = camera.intrinsics.new_tensor([[0, 0, 1], [h, 0, 1], [-h, 0, 1], [0, h, 1], [0, -h, 1]])
    seen, valid = camera.project(around.expand(len(camera.intrinsics), 5, 3))
    focal = torch.stack((seen[:, 1, 0] - seen[:, 2, 0], seen[:, 3, 1] - seen[:, 4, 1]), -1) / (2 * h)
    stated = camera.intrinsics
    good = valid.all(-1) & (focal > 0).all(-1)
    fair = torch.isfinite(stated).all(-1) & (stated[:, :2] > 0).all(-1)
    otherwise = torch.where(fair[:, None], stated, stated.new_tensor([1.0, 1, 0, 0]))
    return torch.where(good[:, None], torch.cat((focal, seen[:, 0]), -1), otherwise)


def _radii(camera: Camera, slopes: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Angles and radii as `Convertible.fit_start` gets them; reach: (C,) the last angle, 0 where nothing is seen."""
    steps = torch.arange(1, _RADII + 1, **_like(camera)) / _RADII
    angles = torch.where(reach > 0, reach, 1.0)[:, None] * steps
    pixels, valid = camera.project(_directions(angles, _AZIMUTHS))
    plane = (pixels - slopes[:, None, None, 2:]) / slopes[:, None, None, :2]
    radii = (torch.linalg.vector_norm(plane, dim=-1) * valid).sum(-1) / valid.sum(-1).clamp(min=1)
    growth = radii.diff(dim=-1, prepend=torch.zeros_like(radii[:, :1]))
    seen = valid.any(-1).long().cumprod(-1) * (growth > 0).long().cumprod(-1)
    last = seen.sum(-1, keepdim=True)
    at = (last - 1).clamp(min=0)
    end, slope = (torch.where(last > 0, t.gather(-1, at), angles[:, :1]) for t in (radii, growth))
    index = torch.arange(_RADII, device=slopes.device)
    return angles, torch.where(seen > 0, radii, end + slope * (index - at))


def _like(camera: Camera) -> dict:
    # steps of float32 would go past half a circle
    return {"dtype": camera.intrinsics.dtype, "device": camera.intrinsics.device}
