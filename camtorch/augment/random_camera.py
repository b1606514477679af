"""Random mounts, lenses and cameras: what they are drawn from, and the new camera that a draw makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any, ClassVar, Literal, cast

import torch
from torch import Tensor

from camtorch._arguments import as_image_size, broadcast_shapes
from camtorch._module import Memo
from camtorch._tracing import is_concrete
from camtorch.augment.augmentation import Augmentation, as_range
from camtorch.augment.change import camera_like, frozen
from camtorch.augment.filling import enough, scaled
from camtorch.augment.jitter import DRAWN, jittered
from camtorch.augment.presets import PRESETS, PresetName
from camtorch.camera import Camera
from camtorch.models import MODELS
from camtorch.projection.rays import field_of_view
from camtorch.rotations import mount_rotation
from camtorch.warp.warp import Warp

RangeLike = float | Sequence[float]


class RandomCamera(Augmentation):
    """Another camera in the same place: turned, with another lens, cropped, and of another size.

    Convention: ranges are (low, high), or a number x for x to either side of doing nothing. Degrees, because people
    think of mounts and lenses in degrees; everything else in camtorch is in radians.

    Args:
        like: whose lens the new camera has. None: the sample's own camera. A Camera, whose numbers are copied and do
            not learn. The name of a preset, see
            `PRESETS`. A key of `ct.MODELS`, for that model with zero coefficients; it needs `fov`.
        camera: of samples that do not bring one.
        yaw: degrees by which the camera turns to its right.
        pitch: degrees by which it then looks up.
        roll: degrees by which it then leans to its right, clockwise: what it sees turns counterclockwise.
        zoom: factor on the focal lengths.
        fov: horizontal field of view of the new camera in degrees, from one outer edge of the image to the other if
            the axis is in the middle. None: that of the lens, whatever the size of the image. "source": as much of
            that as the images fill, all of the new image as long as nothing else is drawn: the focal lengths are
            scaled up to that. A turn then still leaves a rim empty, which `min_filled` takes away.
        focal: factor on the focal lengths, for lenses made alike.
        centre: how far the principal point moves, as a part of the image's width and height.
        distortion: by what part of the distance from the centre to the corner all coefficients together may move
            the image's rim; see `jitter.jittered`, which also keeps the lens invertible over the image.
        crop: part of the image's width and height that is kept, at a random place, and enlarged to the full size.
        chromatic: lateral chromatic aberration: by what factor less one red and blue, each for itself, are larger than
            green. Shown by images of three channels, taken as red, green, blue.
        vignetting: the part of the light that is lost in the image's farthest corner; it grows with the square of
            the distance from the principal point.
        image_size: (height, width) to come out; the sample's by default. Fields of view are those in width.
        options: p, same_on_batch, camera, fields, mode, padding_mode, fill, antialias, tolerance, mask_fill, valid_mask
            and min_filled; see `Augmentation`.

    Raises:
        ValueError: ranges in the wrong order or out of bounds, an unknown name (the text lists those there are).
        TypeError: ranges that are none, an unknown keyword.
    """

    other_words: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("preset", "model", "lens"), "like"),
        **{"center": "centre", "size": "image_size"},
    }

    def __init__(
        self,
        like: Camera | PresetName | str | None = None,
        *,
        yaw: RangeLike | None = (-10.0, 10.0),
        pitch: RangeLike | None = (-10.0, 10.0),
        roll: RangeLike | None = (-10.0, 10.0),
        zoom: RangeLike | None = (1.0, 1.0),
        fov: RangeLike | Literal["source"] | None = None,
        focal: RangeLike | None = (0.95, 1.05),
        centre: RangeLike | None = (-0.02, 0.02),
        distortion: RangeLike | None = (-0.02, 0.02),
        crop: RangeLike | None = (0.9, 1.0),
        chromatic: RangeLike | None = None,
        vignetting: RangeLike | None = None,
        image_size: tuple[int, int] | None = None,
        **options: Any,
    ):
        super().__init__(**options)
        self.fov = "source" if isinstance(fov, str) and fov == "source" else None
        self._memo = Memo()
        self.image_size = as_image_size(image_size, self._name)
        self.like = _as_like(like, self._name)
        if self.like is not None and self.like.image_size is None and fov is None:
            raise ValueError(f"{self._name}: like={like!r} says nothing of the field of view; give fov=(low, high)")
        tiny, huge = 1e-3, 1e3
        limits = {
            "yaw": (yaw, {"least": -180, "most": 180}),
            "pitch": (pitch, {"least": -180, "most": 180}),
            "roll": (roll, {"least": -180, "most": 180}),
            "zoom": (zoom, {"least": tiny, "most": huge, "around": 1}),
            "fov": (None if self.fov else _pair(fov), {"least": tiny, "most": 360}),
            "focal": (focal, {"least": tiny, "most": huge, "around": 1}),
            "centre": (centre, {"least": -1, "most": 1, "size": 2}),
            "distortion": (distortion, {"least": -1, "most": 1, "size": DRAWN}),
            "crop": (_pair(crop), {"least": tiny, "most": 1}),
            "place": (None if crop is None else (0, 1), {"size": 2}),
            "chromatic": (chromatic, {"least": -0.5, "most": 0.5, "size": 2}),
            "vignetting": (_pair(vignetting), {"least": 0, "most": 1}),
        }
        self.ranges = {n: as_range(v, n, self._name, **limit) for n, (v, limit) in limits.items() if v is not None}

    def _without(self, options: Mapping[str, object], *names: str) -> dict[str, Any]:
        """None for the ranges that a class does without.

        Raises:
            TypeError: one of them is asked for.
        """
        for name in names:
            if name in options:
                raise TypeError(f"{type(self).__name__}: there is no {name} here; RandomCamera has it")
        return dict.fromkeys(names)

    def new_camera(self, source: Camera, values: Mapping[str, Tensor]) -> tuple[Camera, Tensor | None]:
        """The new camera and its turn; see `Augmentation.new_camera`."""
        rotation = mount_rotation(*(values[name] for name in ("yaw", "pitch", "roll"))) if "yaw" in values else None
        return self._target(source, values), rotation

    def _seen_through(self, warp: Warp, values: Mapping[str, Tensor]) -> tuple[tuple[Warp, Warp] | None, Tensor | None]:
        shades = light = None
        if "chromatic" in values:
            red, blue = (scaled(warp.target, 1 + values["chromatic"][..., i]) for i in (0, 1))
            shades = tuple(Warp(warp.source, target, warp.rotation, **self.options) for target in (red, blue))
        if "vignetting" in values:
            light = _light(warp.target, values["vignetting"])
        return shades, light

    def _target(self, source: Camera, values: Mapping[str, Tensor]) -> Camera:
        base = source if self.like is None else self.like
        size = self.image_size or cast("tuple[int, int]", source.image_size)
        dtype = torch.promote_types(source.intrinsics.dtype, torch.float32)
        numbers = (t.to(source.intrinsics.device, dtype) for t in (base.intrinsics, base.distortion))
        base = camera_like(base, *numbers, base.image_size)
        intrinsics = usual = self._from_source(source, base, size) if self.fov == "source" else None
        if intrinsics is None or usual is None:
            middle = base.intrinsics.new_tensor(self.ranges["fov"].middle) if "fov" in values else None
            intrinsics, usual = (_sized(base, size, fov) for fov in (values.get("fov"), middle))
        fx, fy, cx, cy = intrinsics.unbind(-1)
        for name in ("focal", "zoom"):
            if name in values:
                fx, fy = fx * values[name], fy * values[name]
        if "centre" in values:
            cx, cy = cx + values["centre"][..., 0] * size[1], cy + values["centre"][..., 1] * size[0]
        intrinsics = torch.stack(torch.broadcast_tensors(fx, fy, cx, cy), -1)
        target = camera_like(base, intrinsics, base.distortion, size)
        if "distortion" in values and base.distortion.shape[-1]:
            step = jittered(frozen(target, size), values["distortion"], usual) - base.distortion.detach()
            target = camera_like(base, intrinsics, base.distortion + step, size)
        if "crop" in values:
            target = _cropped(target, values["crop"], values["place"])
        return target

    def _from_source(self, source: Camera, base: Camera, size: tuple[int, int]) -> Tensor:
        """(*B, 4): intrinsics of the lens at most as wide as its like and as images of the source fill all of."""

        def narrowed() -> Tensor:
            fov = torch.rad2deg(field_of_view(source)[..., 0]) if base.image_size is None else None
            whole = camera_like(base, _sized(base, size, fov), base.distortion, size)
            return scaled(whole, enough(source, whole, None, 1.0)[0]).intrinsics.detach()

        numbers = source.intrinsics, source.distortion, base.intrinsics, base.distortion
        kept: Tensor = self._memo(numbers, (type(source), source.image_size, size), narrowed)
        return kept


class RandomMount(RandomCamera):
    """The camera turned and rolled where it stands, and zoomed: any lens keeps its coefficients.

    Args are those of `RandomCamera`: yaw, pitch, roll in degrees, zoom, and all options. On a pinhole camera this is
    the homography K' R K^-1.
    """

    def __init__(
        self,
        *,
        yaw: RangeLike | None = (-10.0, 10.0),
        pitch: RangeLike | None = (-10.0, 10.0),
        roll: RangeLike | None = (-10.0, 10.0),
        zoom: RangeLike | None = (1.0, 1.0),
        **options: Any,
    ):
        none = self._without(options, "focal", "centre", "distortion", "crop")
        super().__init__(yaw=yaw, pitch=pitch, roll=roll, zoom=zoom, **none, **options)


class RandomLens(RandomCamera):
    """Another lens before the camera, which stays where it looks.

    Args are those of `RandomCamera`: like, fov, focal, centre, distortion, chromatic, vignetting, and all options. From
    pinhole data, `RandomLens("kannala_brandt", fov=(120, 140))` makes a fisheye's.
    """

    def __init__(
        self,
        like: Camera | PresetName | str | None = None,
        *,
        fov: RangeLike | Literal["source"] | None = None,
        focal: RangeLike | None = (0.9, 1.1),
        centre: RangeLike | None = (-0.03, 0.03),
        distortion: RangeLike | None = (-0.05, 0.05),
        **options: Any,
    ):
        none = self._without(options, "yaw", "pitch", "roll", "zoom", "crop")
        super().__init__(like, fov=fov, focal=focal, centre=centre, distortion=distortion, **none, **options)


def _as_like(like: Camera | str | None, owner: str) -> Camera | None:
    if like is None or isinstance(like, Camera):
        if like is not None and like.batch_shape:
            raise ValueError(f"{owner}: like must be a single camera; got batch dims {tuple(like.batch_shape)}")
        return None if like is None else frozen(like, like.image_size)
    if isinstance(like, str) and like in PRESETS:
        return PRESETS[like].camera()
    if isinstance(like, str) and like in MODELS:
        ideal = MODELS[like]([1.0, 1.0, 0.0, 0.0])
        return frozen(ideal, None)
    close = get_close_matches(like, [*PRESETS, *MODELS], 1) if isinstance(like, str) else []
    raise ValueError(
        f"{owner}: like must be a Camera, a preset ({', '.join(PRESETS)}) or a model ({', '.join(MODELS)}); "
        f"got {like!r}" + (f". Did you mean {close[0]!r}?" if close else "")
    )


def _pair(value: RangeLike | str | None) -> RangeLike | str | None:
    """A single number of these means just that number."""
    return (value, value) if isinstance(value, (int, float)) else value


def _sized(base: Camera, size: tuple[int, int], fov: Tensor | None) -> Tensor:
    """Intrinsics (*B, 4) of a lens before an image of another size, showing as much in width or a fov in degrees.

    The old image is scaled to the new width, and cropped or padded evenly to the new height.
    """
    (height, width), (fx, fy, cx, cy) = size, base.intrinsics.unbind(-1)
    if base.image_size is None:
        cx, cy = cx + (width - 1) / 2, cy + (height - 1) / 2
    elif base.image_size != size:
        scale = width / base.image_size[1]
        fx, fy, cx = fx * scale, fy * scale, (cx + 0.5) * scale - 0.5
        cy = (cy - (base.image_size[0] - 1) / 2) * scale + (height - 1) / 2
    if fov is not None:
        focal = width / _plane_width(base, fov)
        fx, fy = focal, focal * fy / fx
    return torch.stack(torch.broadcast_tensors(fx, fy, cx, cy), -1)


def _plane_width(base: Camera, fov: Tensor) -> Tensor:
    """(*B,): how wide a field of view in degrees is on the plane of unit focal length."""
    half = torch.deg2rad(fov) / 2
    right = torch.stack((half.sin(), torch.zeros_like(half), half.cos()), -1)
    rays = torch.stack((right * right.new_tensor([-1.0, 1.0, 1.0]), right), -2)
    plane = camera_like(base, right.new_tensor([1.0, 1.0, 0.0, 0.0]), base.distortion, None)
    ends, valid = plane.project(rays.expand(*broadcast_shapes(rays.shape, (*plane.batch_shape, 2, 3))))
    if is_concrete(valid) and not bool(valid.all()):
        raise ValueError(f"fov: a {base.key} lens of these coefficients does not reach {float(fov.max()):g} degrees")
    return ends[..., 1, 0] - ends[..., 0, 0]


def _cropped(camera: Camera, share: Tensor, place: Tensor) -> Camera:
    """The camera of a part of the image, `share` (*B,) of each side at `place` (*B, 2), enlarged to the full size."""
    height, width = camera.image_size
    fx, fy, cx, cy = camera.intrinsics.unbind(-1)
    left, top = (1 - share) * place[..., 0] * width, (1 - share) * place[..., 1] * height
    cx, cy = (cx + 0.5 - left) / share - 0.5, (cy + 0.5 - top) / share - 0.5
    return camera_like(camera, torch.stack((fx / share, fy / share, cx, cy), -1), camera.distortion, camera.image_size)


def _light(camera: Camera, loss: Tensor) -> Tensor:
    """(B or 1, 1, H, W): one less `loss` (*B,) in the farthest corner, by the square of the distance."""
    height, width = camera.image_size
    cx, cy = camera.intrinsics.detach()[..., 2:].reshape(-1, 2, 1, 1).unbind(1)
    grid = camera.pixel_grid()
    square = (grid[..., 0] - cx) ** 2 + (grid[..., 1] - cy) ** 2
    reach = [torch.maximum(c, side - 1 - c) for c, side in ((cx, width), (cy, height))]
    farthest = (reach[0] ** 2 + reach[1] ** 2).clamp(min=1e-12)
    return (1 - loss.reshape(-1, 1, 1) * square / farthest).unsqueeze(1)
