"""A rolling shutter: rows that are seen one after the other, by a camera that turns meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, Literal, TypedDict, get_args

import torch
from torch import Tensor, nn

from camtorch._arguments import (
    Numbers,
    as_batch,
    as_coordinates,
    as_image_size,
    as_number,
    as_own,
    as_points,
    as_real,
    as_vectors,
    as_whole,
    broadcast_shapes,
    fails,
    shown,
)
from camtorch._dtypes import narrow, widen
from camtorch._module import GeometryModule
from camtorch._tracing import in_transform, is_concrete, keeps_graph
from camtorch.camera import Camera
from camtorch.optics.special import cosc_root, sinc_root

Direction = Literal["down", "up", "right", "left"]
DIRECTIONS: tuple[Direction, ...] = get_args(Direction)

_LONGEST = 2.0  # seconds
_FASTEST = 70.0  # radians per second: twice what gyroscopes measure
_BEYOND = 1.0  # readouts from the middle of the image, half an image beyond its rim: further out time stands still
_STEPS = 6  # of the secant method: three digits each in the end
_SETTLED = 0.01  # pixels by which the row of a point may be off when it is said to be found
_STILL = 1e-3  # the part of a row that a row must advance by, as the scene passes


class RollingShutter(GeometryModule):
    """Rows read one after the other, down the image, by a camera that turns at a constant rate: for `Warp`.

    Convention: `rates` are what a gyroscope in the camera tells, in its frame (x right, y down, z forward): about +x
    the camera looks up, about +y it turns right, about +z it leans right, clockwise. With t = 0 in the middle of the
    readout, when the middle of the image is read, `ray_at_0 = exp(t [rates]) ray_at_t`. All else that has no row, as
    points in space, gaze and poses, is of that moment.

    The turn is exact without depth. What the camera moves is left out, as it would need depth.

    Args:
        readout: seconds from the first row to the last (all rows times the time of one), or (B,). Negative reads the
            other way. 0 is a global shutter.
        rates: (3,) or (B, 3) radians per second.
        direction: in which the sensor is read: "down", "up", "right" or "left", as seen in the image.
        exposure: seconds for which each row gathers light, or (B,). A warp that puts the shutter on blurs its images
            by the turn meanwhile; a blur cannot be undone. Labels are of the middle of the exposure.
        samples: moments of the exposure that are averaged, at the cost of a warp each. Where the blur is many more
            pixels long, its steps show.
        gamma: images are averaged as their power gamma: 2.2 is in linear light for those made for a screen.

    Plain values are kept as they are and do not learn; Parameters and tensors of a graph do.

    Raises:
        ValueError: numbers that are not finite, shapes that do not fit, times of more than two seconds (they may be
            milliseconds), rates of more than 70 radians per second (degrees), an unknown direction. TypeError: no
            numbers.
    """

    readout: Tensor
    rates: Tensor
    exposure: Tensor
    batch_shape: torch.Size
    samples: int
    gamma: float

    def __init__(
        self,
        readout: Numbers,
        rates: Numbers,
        *,
        direction: Direction = "down",
        exposure: Numbers = 0.0,
        samples: int = 8,
        gamma: float = 1.0,
    ):
        super().__init__()
        owner = "RollingShutter"
        rates = as_vectors(rates, "rates", owner)
        times = {name: as_real(value, name, owner) for name, value in (("readout", readout), ("exposure", exposure))}
        if not isinstance(direction, str) or direction not in DIRECTIONS:
            raise ValueError(f"{owner}: direction must be one of {DIRECTIONS}; got {shown(direction)}")
        for name, value in times.items():
            if value.ndim > 1:
                raise ValueError(f"{owner}: {name} must be a number or (B,); got shape {tuple(value.shape)}")
            if fails(value.detach().abs() < _LONGEST):
                raise ValueError(
                    f"{owner}: {name} is in seconds; got {value.tolist()}, which would be milliseconds: {name} / 1000"
                )
        if fails(rates.detach().abs() < _FASTEST):
            raise ValueError(
                f"{owner}: rates are in radians per second; got {rates.tolist()}, which would be degrees: numpy.deg2rad"
            )
        if fails(times["exposure"].detach() >= 0):
            raise ValueError(f"{owner}: exposure must not be negative; got {times['exposure'].tolist()}")
        samples, gamma = as_whole(samples, "samples", owner), as_number(gamma, "gamma", owner)
        if samples < 1 or not (math.isfinite(gamma) and gamma > 0):
            raise ValueError(f"{owner}: samples and gamma must be positive; got {samples!r} and {gamma!r}")
        shapes = {name: (*value.shape, 1) for name, value in times.items()}
        self.batch_shape = as_batch(owner, rates=rates.shape, **shapes)
        if len(self.batch_shape) > 1:
            raise ValueError(f"{owner}: rates must be (3,) or (B, 3); got shape {tuple(rates.shape)}")
        for name, value in (*times.items(), ("rates", rates)):
            if isinstance(value, nn.Parameter):
                self.register_parameter(name, value)
            else:
                self.register_buffer(name, as_own(value))
        self.direction, self.samples, self.gamma = direction, samples, gamma
        self._moment: float | None = None
        self._blurs = not is_concrete(self.exposure) or bool((self.exposure.detach() > 0).any())

    def times(self, pixels: Numbers, image_size: tuple[int, int]) -> Tensor:
        """(*B, *N): seconds from the middle of the readout at which pixels (*B, *N, 2) of an image are seen."""
        values = as_coordinates(pixels, "pixels", 2, "RollingShutter", self.rates.device)
        size = as_image_size(image_size, "RollingShutter")
        if size is None:
            raise TypeError("RollingShutter: image_size must be two integers (height, width); got None")
        return self._times(self._share(values, image_size), values.ndim)

    # -- what a warp asks for

    @property
    def tensors(self) -> list[Tensor]:
        """All that positions depend on."""
        return [self.readout, self.rates, self.exposure]

    @property
    def form(self) -> tuple[object, ...]:
        """What they depend on beside tensors."""
        return self.direction, self._moment

    def rows_of(self, index: list[int]) -> RollingShutter:
        """The shutter of these rows of a batch."""
        if not self.batch_shape:
            return self

        def of(value: Tensor, ndim: int) -> Tensor:
            return value[index] if value.ndim > ndim else value

        return self._with(of(self.readout, 0), of(self.rates, 1), of(self.exposure, 0))

    def detached(self) -> RollingShutter:
        """The shutter of the same numbers, which do not learn."""
        return self._with(self.readout.detach(), self.rates.detach(), self.exposure.detach(), self._moment)

    def _with(self, readout: Tensor, rates: Tensor, exposure: Tensor, moment: float | None = None) -> RollingShutter:
        options: dict[str, Any] = {"direction": self.direction, "samples": self.samples, "gamma": self.gamma}
        made = RollingShutter(readout, rates, exposure=exposure, **options)
        made._moment = moment
        return made

    @property
    def blurs(self) -> bool:
        """Whether the exposure takes time; a shutter at one moment of it does not blur."""
        if self._moment is not None:
            return False
        return bool((self.exposure.detach() > 0).any()) if is_concrete(self.exposure) else self._blurs

    def exposed(self) -> list[RollingShutter]:
        """The shutter at `samples` moments of its exposure, spread evenly."""
        parts = ((i + 0.5) / self.samples - 0.5 for i in range(self.samples))
        return [self._with(self.readout, self.rates, self.exposure, part) for part in parts]

    def _share(self, pixels: Tensor, size: tuple[int, int]) -> Tensor:
        """When pixels (..., 2) are read, in readouts from the middle one."""
        across = self.direction in ("right", "left")
        share = (pixels[..., 0 if across else 1] + 0.5) / size[1 if across else 0] - 0.5
        share = share.clamp(-_BEYOND, _BEYOND)
        return -share if self.direction in ("up", "left") else share

    def _times(self, share: Tensor, ndim: int) -> Tensor:
        """Seconds, of shares of the readout (..., ) of points with `ndim` dims."""
        readout, exposure = (_lead(value.to(share.dtype), ndim - 1) for value in (self.readout, self.exposure))
        return share * readout + self._moment * exposure if self._moment else share * readout

    def turned(self, rays: Tensor, share: Tensor, sign: float) -> Tensor:
        """Rays (*B, *N, 3) of shares (*B, *N) of the readout, turned to its middle (sign 1) or from it (sign -1).

        Rodrigues' formula; at time zero every number stays as it is.
        """
        rates = _lead(self.rates.to(rays.dtype), rays.ndim - 1, 1)
        wx, wy, wz = ((sign * self._times(share, rays.ndim)).unsqueeze(-1) * rates).unbind(-1)
        x, y, z = rays.unbind(-1)
        square = wx * wx + wy * wy + wz * wz
        s, c = sinc_root(square), cosc_root(square)
        a, b, d = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        planes = (
            x + s * a + c * (wy * d - wz * b),
            y + s * b + c * (wz * a - wx * d),
            z + s * d + c * (wx * b - wy * a),
        )
        return torch.stack(planes, -1)

    def extra_repr(self) -> str:
        """Times, rates and direction."""
        if self.batch_shape or not all(map(is_concrete, self.tensors)):
            return f"batch_shape={tuple(self.batch_shape)}, direction={self.direction!r}"
        parts = [f"readout={float(self.readout):g}", f"rates={self.rates.tolist()}", f"direction={self.direction!r}"]
        return ", ".join([*parts, f"exposure={float(self.exposure):g}"])


class Shutters(TypedDict):
    """What a `Warp` takes of shutters by name."""

    shutter: RollingShutter | None
    target_shutter: RollingShutter | None


def _lead(value: Tensor, ndim: int, inner: int = 0) -> Tensor:
    """(B, ...) before points with `ndim` leading dims; what has no batch dim serves all."""
    return value if value.ndim == inner else value.reshape(len(value), *[1] * (ndim - 1), *value.shape[1:])


class InMotion:
    """A camera behind a rolling shutter, as a warp sees one: rays are those of the middle of the readout."""

    def __init__(self, camera: Camera, shutter: RollingShutter):
        self.camera, self.shutter = camera, shutter
        self.batch_shape = broadcast_shapes(camera.batch_shape, shutter.batch_shape)
        self.size = camera.size_for("Warp")

    def __getattr__(self, name: str) -> Any:
        return getattr(self.camera, name)

    def unproject(self, pixels: Numbers) -> tuple[Tensor, Tensor]:
        """As of a camera; in closed form, for a pixel says when it is seen."""
        pixels, _ = as_points(pixels, "pixels", 2, self.batch_shape, self.camera.tensors[:1], "Warp")
        rays, valid = self.camera.unproject(pixels)
        pixels = torch.where(valid.unsqueeze(-1), pixels, 0.0)
        return self.shutter.turned(rays, self.shutter._share(pixels, self.size), 1.0), valid

    def project(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """As of a camera. When a ray is seen depends on where: that is solved without a graph, and then goes one step
        of Newton's method with one, which has the derivatives of the solution.

        Not valid where the scene passes as fast as rows are read, or faster.
        """
        rays, _ = as_points(rays, "points", 3, self.batch_shape, self.camera.tensors[:1], "Warp")
        side = self.size[1 if self.shutter.direction in ("right", "left") else 0]

        def seen(share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            pixels, valid = self.camera.project(self.shutter.turned(rays, share, -1.0))
            return pixels, valid, self.shutter._share(pixels, self.size)

        with torch.no_grad():
            share = torch.zeros_like(rays[..., 0].detach())
            pixels, valid, found = seen(share)
            before, missed_before = share, found
            share = found
            for _ in range(_STEPS):
                pixels, valid, found = seen(share)
                missed = found - share
                change = missed - missed_before
                flat = change == 0
                step = torch.where(flat, missed, missed * (before - share) / torch.where(flat, 1.0, change))
                before, missed_before = share, missed
                share = (share + step.clamp(-0.5, 0.5)).clamp(-_BEYOND, _BEYOND)
            pixels, valid, found = seen(share)
            settled = ((found - share).abs() * side < _SETTLED) | (found.abs() >= _BEYOND)
        tensors = (rays, *self.camera.tensors, *self.shutter.tensors)
        if keeps_graph(*tensors) or in_transform():
            with torch.no_grad():
                h = 1e-4 if share.dtype == torch.float64 else 1e-2
                slope = (seen(share + h)[2] - seen(share - h)[2]) / (2 * h)
                settled = settled & ((1 - slope).abs() > _STILL)
            ahead = seen(share)[2] - share
            share = share + torch.where(settled, ahead / torch.where(settled, 1 - slope, 1.0), 0.0)
            pixels, valid, _ = seen(share)
        valid = valid & settled
        return torch.where(valid.unsqueeze(-1), pixels, -1.0), valid


def averaged(
    images: Tensor,
    warps: Sequence[Callable[..., Tensor]],
    gamma: float,
    mode: str,
    padding_mode: str,
    fill: tuple[float, ...],
) -> Tensor:
    """The mean of what warps make of images: of their power gamma, of which the root is taken again.

    Args:
        images: (B, C, H, W) of any dtype, which comes out.
        warps: of the moments of an exposure.
        gamma: see `RollingShutter`. Negative values count as 0 unless it is 1.
        mode: of the warps.
        padding_mode: likewise.
        fill: likewise.
    """
    linear = widen(images)
    if gamma != 1:
        linear, fill = linear.clamp(min=0) ** gamma, tuple(max(value, 0.0) ** gamma for value in fill)
    options = {"mode": mode, "padding_mode": padding_mode, "fill": fill}
    mean = reduce(torch.add, (warp(linear, **options) for warp in warps)) / len(warps)
    if gamma != 1:  # the root has no derivative at zero
        some = mean > 0
        mean = torch.where(some, torch.where(some, mean, 1.0) ** (1 / gamma), 0.0)
    return narrow(mean, images.dtype)
