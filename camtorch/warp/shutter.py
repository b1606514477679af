"""A rolling shutter: rows are read one after the other while the camera turns."""

from __future__ import annotations

from typing import Any, Literal, Unpack, cast, get_args

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.evaluate.tensors import as_own, known_false, values_of
from camtorch.optics.special import cosc_root, sinc_root
from camtorch.poses.rotations import as_rotation, transposed
from camtorch.values.arguments import (
    LEFT,
    Numbers,
    as_batch,
    as_points,
    as_real,
    as_vectors,
    broadcast_shapes,
    check_devices,
    one_of,
)
from camtorch.values.module import GeometryModule
from camtorch.warp.affine import HalvingWarp
from camtorch.warp.camera_pair import CameraPair
from camtorch.warp.options import TolerantOptions
from camtorch.warp.warp import Warp

Direction = Literal["down", "up", "right", "left"]
DIRECTIONS: tuple[Direction, ...] = get_args(Direction)

_LONGEST_READOUT = 2.0  # seconds
_FASTEST_RATE = 70.0  # radians per second: twice what gyroscopes measure
_FARTHEST_READOUT = 1.0  # readouts from the middle, half an image beyond the rim: further out, time is clamped
_STEPS = 4  # of the secant method, before one Newton step
_SETTLED_ROWS = 0.01  # a point is found if its row is off by less
_LEAST_GAIN = 1e-3  # rows per row that the readout must gain on the passing scene


class RollingShutter(GeometryModule):
    """A shutter that reads rows one after the other while the camera turns at a constant rate, for `ShutterWarp`.

    Convention: `rates` are a gyroscope's measurements in the camera's frame (x right, y down, z forward): about +x
    the camera looks up, about +y it turns right, about +z it leans right, clockwise. With t = 0 in the middle of the
    readout, when the middle of the image is read, `ray_at_0 = exp(t [rates]) ray_at_t`. Values without a row, such
    as points in space, gaze and poses, are of that moment.

    The turn is exact without depth; the camera's translation, which would need depth, is ignored.

    Args:
        readout: seconds from the first row to the last (all rows times the time of one), or (B,). Negative reads in
            the opposite direction. 0 is a global shutter.
        rates: (3,) or (B, 3) radians per second.
        direction: in which the sensor is read: "down", "up", "right" or "left", as seen in the image.

    Plain values are kept and do not learn; Parameters and tensors of a graph do.

    Raises:
        ValueError: If numbers are not finite, shapes do not fit, the readout is more than two seconds (it may be
            milliseconds), a rate is more than 70 radians per second (degrees), or the direction is unknown.
        TypeError: If a value is not numeric.
    """

    readout: Tensor
    rates: Tensor
    direction: Direction
    batch_shape: torch.Size

    def __init__(self, readout: Numbers, rates: Numbers, *, direction: Direction = "down"):
        super().__init__()
        owner = "RollingShutter"
        rates = as_vectors(rates, "rates", owner, readout.device if isinstance(readout, Tensor) else None)
        readout = as_real(readout, "readout", owner, rates.device)
        if readout.ndim > 1:
            raise ValueError(f"{owner}: readout must be a number or (B,); got shape {tuple(readout.shape)}")
        if known_false(readout.detach().abs() < _LONGEST_READOUT):
            raise ValueError(
                f"{owner}: readout must be below 2 seconds; got {readout.tolist()}. Pass milliseconds as readout / 1000"
            )
        if known_false(rates.detach().abs() < _FASTEST_RATE):
            raise ValueError(
                f"{owner}: rates must be below 70 radians per second; got {rates.tolist()}. numpy.deg2rad takes degrees"
            )
        self.batch_shape = as_batch(owner, rates=rates.shape, readout=(*readout.shape, 1))
        if len(self.batch_shape) > 1:
            raise ValueError(f"{owner}: rates must be (3,) or (B, 3); got shape {tuple(rates.shape)}")
        for name, value in (("readout", readout), ("rates", rates)):
            self.put(name, as_own(value), persistent=True)
        self.direction = one_of(direction, DIRECTIONS, "direction", owner)

    def rows_of(self, index: list[int]) -> RollingShutter:
        """Return the shutter of these rows of a batch."""
        rates = self.rates[index] if self.rates.ndim == 2 else self.rates
        readout = self.readout[index] if self.readout.ndim else self.readout
        return RollingShutter(readout, rates, direction=self.direction)

    def detach(self) -> RollingShutter:
        """Return the same shutter without a graph: it shares the numbers of this one, and does not learn."""
        return RollingShutter(self.readout.detach(), self.rates.detach(), direction=self.direction).share(self)

    def read_at(self, pixels: Tensor, size: tuple[int, int]) -> Tensor:
        """Return when pixels (..., 2) are read, in readouts from the middle one."""
        across = self.direction in ("right", "left")
        share = (pixels[..., 0 if across else 1] + 0.5) / size[1 if across else 0] - 0.5
        share = share.clamp(-_FARTHEST_READOUT, _FARTHEST_READOUT)
        return -share if self.direction in ("up", "left") else share

    def turned(self, rays: Tensor, share: Tensor, sign: float) -> Tensor:
        """Turn rays (*B, *N, 3) of shares (*B, *N) to the readout's middle (sign 1) or from it (-1), by Rodrigues."""
        rates = _lead(self.rates.to(rays.dtype), rays.ndim - 1, 1)
        wx, wy, wz = ((sign * share * _lead(self.readout.to(share.dtype), share.ndim)).unsqueeze(-1) * rates).unbind(-1)
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

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *given: Any) -> None:
        _check_exposure(state_dict.pop(f"{prefix}exposure", None))
        super()._load_from_state_dict(state_dict, prefix, *given)

    def __setstate__(self, state: dict[str, Any]) -> None:
        _check_exposure(state["_buffers"].pop("exposure", None))
        super().__setstate__(state)

    def extra_repr(self) -> str:
        readout, rates = map(values_of, (self.readout, self.rates))
        if self.batch_shape or readout is None or rates is None:
            return f"batch_shape={tuple(self.batch_shape)}, direction={self.direction!r}"
        return f"readout={float(readout):g}, rates={rates.tolist()}, direction={self.direction!r}"


def _lead(value: Tensor, ndim: int, inner: int = 0) -> Tensor:
    """Return values (B, ...) shaped for points with `ndim` leading dims; without a batch dim they serve all points."""
    return value if value.ndim == inner else value.reshape(len(value), *[1] * (ndim - 1), *value.shape[1:])


def _check_exposure(exposure: Tensor | None) -> None:
    """Raise if a state of 0.3 has an exposure."""
    if exposure is not None and known_false(exposure == 0):
        raise ValueError(f"RollingShutter: the state's exposure must be 0; got {exposure.tolist()}. {LEFT}")


class ShutterWarp(HalvingWarp):
    """A `Warp` between cameras with rolling shutters: it undoes the source's shutter and applies the target's.

    Cameras and rotation are those of the middle of the readout. Images, points and boxes move by the row that sees
    them; rays turn by the rotation alone.

        shutter = ct.RollingShutter(0.015, [0.3, -1.2, 0.5])
        straight = ct.ShutterWarp(camera, ct.Dewarp(camera).target, shutter=shutter)
        images = straight(images)

    Args:
        source: the camera of the given images.
        target: the camera of the images to make.
        rotation: (3, 3) or (B, 3, 3), `ray_target = R ray_source`; None is no rotation.
        shutter: the shutter by which the given images were taken.
        target_shutter: the shutter by which the images to make are taken.
        as_warp: mode, padding_mode, fill, antialias, tolerance, as in `Warp`.

    Raises:
        ValueError: If batch dims do not fit, and as `Warp`. TypeError: If a shutter is no `RollingShutter`.
    """

    moves_by_cameras = False
    shutter: RollingShutter | None
    target_shutter: RollingShutter | None

    def __init__(
        self,
        source: Camera,
        target: Camera,
        rotation: Tensor | None = None,
        *,
        shutter: RollingShutter | None = None,
        target_shutter: RollingShutter | None = None,
        **as_warp: Unpack[TolerantOptions],
    ):
        rotation = as_rotation(rotation, "ShutterWarp")
        super().__init__(source, target, None, **as_warp)
        shutters = {"shutter": shutter, "target_shutter": target_shutter}
        shapes = {"cameras": (*self.batch_shape, 1)}
        shapes |= {} if rotation is None else {"rotation": rotation.shape[:-1]}
        for name, each in shutters.items():
            if not (each is None or isinstance(each, RollingShutter)):
                hint = "ct.RollingShutter(readout, rates) makes one, of seconds and radians per second"
                raise TypeError(f"ShutterWarp: {name} must be a RollingShutter; got {type(each).__name__}. {hint}")
            shapes |= {} if each is None else {name: (*each.batch_shape, 1)}
            setattr(self, name, each)
        check_devices("ShutterWarp", source=source.intrinsics, **{n: s.rates for n, s in shutters.items() if s})
        self.batch_shape: torch.Size = as_batch("ShutterWarp", **shapes)
        self.turned_by(rotation)

    @property
    def pair(self) -> CameraPair:
        source, target = _in_motion(self.source, self.shutter), _in_motion(self.target, self.target_shutter)
        return CameraPair(source, target, self.rotation)

    def inverse(self) -> Warp:
        """Return the warp from target to source. It applies the shutter that this one undoes, and undoes the other."""
        shutters = {"shutter": self.target_shutter, "target_shutter": self.shutter}
        return self.between(self.target, self.source, transposed(self.rotation), **self.options, **shutters)

    def between(self, source: Camera, target: Camera, rotation: Tensor | None, **options: Any) -> Warp:
        """Return this warp between other cameras, with its shutters unless `options` have others."""
        return ShutterWarp(source, target, **{**self.own_parts(), **options}).turned_by(rotation)

    def own_parts(self, index: list[int] | None = None) -> dict[str, Any]:
        both = {"shutter": self.shutter, "target_shutter": self.target_shutter}
        return {name: each if each is None or index is None else each.rows_of(index) for name, each in both.items()}


def _in_motion(camera: Camera, shutter: RollingShutter | None) -> Camera:
    """Return the camera behind its shutter, if it has one."""
    return camera if shutter is None else cast("Camera", InMotion(camera, shutter))


class InMotion:
    """A camera behind a rolling shutter, as a warp uses it: rays are those of the middle of the readout."""

    has_native_form = False

    def __init__(self, camera: Camera, shutter: RollingShutter):
        self.camera = camera
        self.shutter = shutter
        self.batch_shape: torch.Size = broadcast_shapes(camera.batch_shape, shutter.batch_shape)
        self.size: tuple[int, int] = camera.size_for("Warp")
        self.turn_axis = None  # a panorama ends at its edges

    def __getattr__(self, name: str) -> Any:
        return getattr(self.camera, name)

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        return *self.camera.tensors, self.shutter.readout, self.shutter.rates

    @property
    def form(self) -> tuple[object, ...]:
        return self.camera.form, self.shutter.direction

    def unproject(self, pixels: Numbers) -> tuple[Tensor, Tensor]:
        """Return rays and valid, as a camera does; in closed form, as a pixel fixes the time at which it is seen."""
        pixels, _ = as_points(pixels, "pixels", 2, self.batch_shape, self.camera.tensors[:1], "Warp")
        rays, valid = self.camera.unproject(pixels)
        pixels = torch.where(valid.unsqueeze(-1), pixels, 0.0)
        return self.shutter.turned(rays, self.shutter.read_at(pixels, self.size), 1.0), valid

    def project(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Return pixels and valid, False if the scene passes as fast as rows are read, or faster."""
        rays, _ = as_points(rays, "points", 3, self.batch_shape, self.camera.tensors[:1], "Warp")
        side = self.size[1 if self.shutter.direction in ("right", "left") else 0]

        def seen(share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            pixels, valid = self.camera.project(self.shutter.turned(rays, share, -1.0))
            return pixels, valid, self.shutter.read_at(pixels, self.size)

        with torch.no_grad():
            before = torch.zeros_like(rays[..., 0].detach())
            share = missed_before = seen(before)[2]
            for _ in range(_STEPS):
                missed = seen(share)[2] - share
                change = missed - missed_before
                flat = change == 0
                step = torch.where(flat, missed, missed * (before - share) / torch.where(flat, 1.0, change))
                before, missed_before = share, missed
                share = (share + step.clamp(-0.5, 0.5)).clamp(-_FARTHEST_READOUT, _FARTHEST_READOUT)
            h = 1e-4 if share.dtype == torch.float64 else 1e-2
            slope = (seen(share + h)[2] - seen(share - h)[2]) / (2 * h)
        found = seen(share)[2]  # a Newton step from there has the derivatives of the solution
        off = found - share
        settled = (off.detach().abs() * side < _SETTLED_ROWS) | (found.detach().abs() >= _FARTHEST_READOUT)
        settled = settled & ((1 - slope).abs() > _LEAST_GAIN)
        pixels, valid, _ = seen(share + torch.where(settled, off / torch.where(settled, 1 - slope, 1.0), 0.0))
        valid = valid & settled
        return torch.where(valid.unsqueeze(-1), pixels, -1.0), valid
