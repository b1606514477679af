"""A rolling shutter: rows that are seen one after the other, by a camera that turns meanwhile."""

from __future__ import annotations

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
    as_own,
    as_points,
    as_real,
    as_vectors,
    as_whole,
    broadcast_shapes,
    fails,
    holds,
    shown,
    values_of,
)
from camtorch._dtypes import narrow, widen
from camtorch._module import GeometryModule
from camtorch.camera import Camera
from camtorch.optics.special import cosc_root, sinc_root

Direction = Literal["down", "up", "right", "left"]
DIRECTIONS: tuple[Direction, ...] = get_args(Direction)

_LONGEST = 2.0  # seconds
_FASTEST = 70.0  # radians per second: twice what gyroscopes measure
_BEYOND = 1.0  # readouts from the middle of the image, half an image beyond its rim: further out time stands still
_STEPS = 4  # of the secant method, before one of Newton's
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

    Plain values are kept as they are and do not learn; Parameters and tensors of a graph do.

    Raises:
        ValueError: numbers that are not finite, shapes that do not fit, times of more than two seconds (they may be
            milliseconds), rates of more than 70 radians per second (degrees), an unknown direction. TypeError: no
            numbers.
    """

    readout: Tensor
    rates: Tensor
    exposure: Tensor
    offset: Tensor
    """Seconds after which rows are seen: of a moment of an exposure."""
    batch_shape: torch.Size
    samples: int

    def __init__(
        self,
        readout: Numbers,
        rates: Numbers,
        *,
        direction: Direction = "down",
        exposure: Numbers = 0.0,
        samples: int = 8,
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
        shapes = {name: (*value.shape, 1) for name, value in times.items()}
        self.batch_shape = as_batch(owner, rates=rates.shape, **shapes)
        if len(self.batch_shape) > 1:
            raise ValueError(f"{owner}: rates must be (3,) or (B, 3); got shape {tuple(rates.shape)}")
        for name, value in (*times.items(), ("rates", rates)):
            if isinstance(value, nn.Parameter):
                self.register_parameter(name, value)
            else:
                self.register_buffer(name, as_own(value))
        self.register_buffer("offset", torch.zeros_like(self.readout.detach()), persistent=False)
        self.direction, self.samples = direction, as_whole(samples, "samples", owner, least=1)
        self._blurred = not holds(self.exposure == 0)

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
        """All that positions depend on, beside the direction."""
        return [self.readout, self.rates, self.offset]

    @property
    def form(self) -> tuple[object, ...]:
        """What they depend on beside tensors."""
        return (self.direction,)

    def rows_of(self, index: list[int]) -> RollingShutter:
        """The shutter of these rows of a batch."""
        if not self.batch_shape:
            return self
        rates = self.rates[index] if self.rates.ndim == 2 else self.rates
        return self._with(rates, *(t[index] if t.ndim else t for t in (self.readout, self.exposure)))

    def detached(self) -> RollingShutter:
        """The shutter of the same numbers, which do not learn."""
        return self._with(self.rates.detach(), self.readout.detach(), self.exposure.detach())

    def _with(self, rates: Tensor, readout: Tensor, exposure: Tensor) -> RollingShutter:
        return RollingShutter(readout, rates, exposure=exposure, direction=self.direction, samples=self.samples)

    @property
    def blurs(self) -> bool:
        """Whether the exposure takes time."""
        exposure = values_of(self.exposure)
        return self._blurred if exposure is None else bool((exposure > 0).any())

    def exposed(self) -> list[RollingShutter]:
        """The shutter at `samples` moments of its exposure, spread evenly."""
        moments = [self._with(self.rates, self.readout, torch.zeros_like(self.exposure)) for _ in range(self.samples)]
        for i, moment in enumerate(moments):
            moment.register_buffer("offset", ((i + 0.5) / self.samples - 0.5) * self.exposure, persistent=False)
            moment._blurred = False
        return moments

    def _share(self, pixels: Tensor, size: tuple[int, int]) -> Tensor:
        """When pixels (..., 2) are read, in readouts from the middle one."""
        across = self.direction in ("right", "left")
        share = (pixels[..., 0 if across else 1] + 0.5) / size[1 if across else 0] - 0.5
        share = share.clamp(-_BEYOND, _BEYOND)
        return -share if self.direction in ("up", "left") else share

    def _times(self, share: Tensor, ndim: int) -> Tensor:
        """Seconds, of shares of the readout (..., ) of points with `ndim` dims."""
        readout, offset = (_lead(value.to(share.dtype), ndim - 1) for value in (self.readout, self.offset))
        return share * readout + offset

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
        readout, rates, exposure = map(values_of, (self.readout, self.rates, self.exposure))
        if self.batch_shape or readout is None or rates is None or exposure is None:
            return f"batch_shape={tuple(self.batch_shape)}, direction={self.direction!r}"
        parts = [f"readout={float(readout):g}", f"rates={rates.tolist()}", f"direction={self.direction!r}"]
        return ", ".join([*parts, f"exposure={float(exposure):g}"])


class Shutters(TypedDict):
    """What a `Warp` takes of shutters by name."""

    shutter: RollingShutter | None
    target_shutter: RollingShutter | None


def _lead(value: Tensor, ndim: int, inner: int = 0) -> Tensor:
    """(B, ...) before points with `ndim` leading dims; what has no batch dim serves all."""
    return value if value.ndim == inner else value.reshape(len(value), *[1] * (ndim - 1), *value.shape[1:])


class InMotion:
    """A camera behind a rolling shutter, as a warp sees one: rays are those of the middle of the readout."""

    camera: Camera
    shutter: RollingShutter
    batch_shape: torch.Size
    size: tuple[int, int]

    def __init__(self, camera: Camera, shutter: RollingShutter):
        self.camera, self.shutter = camera, shutter
        self.batch_shape = broadcast_shapes(camera.batch_shape, shutter.batch_shape)
        self.size = camera._size_for("Warp")

    def __getattr__(self, name: str) -> Any:
        return getattr(self.camera, name)

    def unproject(self, pixels: Numbers) -> tuple[Tensor, Tensor]:
        """As of a camera; in closed form, for a pixel says when it is seen."""
        pixels, _ = as_points(pixels, "pixels", 2, self.batch_shape, self.camera._tensors[:1], "Warp")
        rays, valid = self.camera.unproject(pixels)
        pixels = torch.where(valid.unsqueeze(-1), pixels, 0.0)
        return self.shutter.turned(rays, self.shutter._share(pixels, self.size), 1.0), valid

    def project(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """As of a camera. When a ray is seen depends on where: that is solved without a graph, and then goes one step
        of Newton's method with one, which has the derivatives of the solution.

        Not valid where the scene passes as fast as rows are read, or faster.
        """
        rays, _ = as_points(rays, "points", 3, self.batch_shape, self.camera._tensors[:1], "Warp")
        side = self.size[1 if self.shutter.direction in ("right", "left") else 0]

        def seen(share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            pixels, valid = self.camera.project(self.shutter.turned(rays, share, -1.0))
            return pixels, valid, self.shutter._share(pixels, self.size)

        with torch.no_grad():
            before = torch.zeros_like(rays[..., 0].detach())
            share = missed_before = seen(before)[2]
            for _ in range(_STEPS):
                missed = seen(share)[2] - share
                change = missed - missed_before
                flat = change == 0
                step = torch.where(flat, missed, missed * (before - share) / torch.where(flat, 1.0, change))
                before, missed_before = share, missed
                share = (share + step.clamp(-0.5, 0.5)).clamp(-_BEYOND, _BEYOND)
            h = 1e-4 if share.dtype == torch.float64 else 1e-2
            slope = (seen(share + h)[2] - seen(share - h)[2]) / (2 * h)
        found = seen(share)[2]
        off = found - share
        settled = (off.detach().abs() * side < _SETTLED) | (found.detach().abs() >= _BEYOND)
        settled = settled & ((1 - slope).abs() > _STILL)
        pixels, valid, _ = seen(share + torch.where(settled, off / torch.where(settled, 1 - slope, 1.0), 0.0))
        valid = valid & settled
        return torch.where(valid.unsqueeze(-1), pixels, -1.0), valid


def averaged(images: Tensor, warps: Sequence[Callable[..., Tensor]], **options: Any) -> Tensor:
    """The mean of what warps, of the moments of an exposure, make of images (B, C, H, W), in their dtype."""
    wide = widen(images)
    return narrow(reduce(torch.add, (warp(wide, **options) for warp in warps)) / len(warps), images.dtype)
