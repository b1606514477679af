"""Random mounts, lenses and cameras: what they are drawn from, and the new camera and lens that a draw makes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import lru_cache
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.parametrize import type_before_parametrizations
from typing_extensions import Unpack

from camtorch.augment.augmentation import Augmentation, FilledOptions, Range, as_range
from camtorch.augment.change import Part, View
from camtorch.augment.filling import enough, scaled
from camtorch.augment.kinds import Named
from camtorch.augment.presets import PRESETS, PresetName
from camtorch.cameras.camera import Camera
from camtorch.cameras.numbers import joined, split
from camtorch.cameras.opaque import CameraNumbers, opaque
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.known import are_free, are_numbers, known_false, with_derivatives_of
from camtorch.lenses.drawing import FOLD, covering, drawn
from camtorch.models import MODELS, KannalaBrandt
from camtorch.optics.radial_inverse import precise
from camtorch.poses.rotations import mount_elements
from camtorch.projection.compiled import project, project_numbers, unproject
from camtorch.projection.evaluation import rows_of
from camtorch.projection.native_cameras import Native
from camtorch.projection.rows import CameraRows, single_native
from camtorch.rays.lattices import field_of_view, pixel_lattice, polar_rays, reach
from camtorch.values.arguments import LEFT, as_image_size, broadcast_shapes, check_degrees, warn
from camtorch.values.module import remade
from camtorch.warp.boxes import along_edges
from camtorch.warp.panorama import PANORAMAS
from camtorch.warp.shifted import ShiftedWarp
from camtorch.warp.vignetting import vignetting
from camtorch.warp.warp import Warp

RangeLike = float | Sequence[float]
Auto = RangeLike | Literal["auto"] | None
Array = np.ndarray[Any, Any]
T = TypeVar("T")


DRAWN = 16
"""How many coefficients have a draw of their own; more take turns."""
_SMALL = 0.1  # decentering, prism and tilt, whose images are lopsided, move less than radial terms: as in real lenses
_STEP = 1e-4
_PARTS = 1.0, -1.0, 0.5, -0.5, 0.25, -0.25, 0.125, -0.125  # of a step, in the order in which they are tried
_REAL = "real"
_TURNS = "yaw", "pitch", "roll"
_SHIFTS = "shift_x", "shift_y", "shift_z"
_DEPTHS = {"of_depth": ("depth", "z"), "of_distance": ("distance", "distance")}
"""In a draw, how far away things are: the field of samples that says so, and what it holds."""
_SIDE = 9
_LESS = 0.9  # of the least field of view that was asked for: below that a warning says so
_told: set[tuple[object, ...]] = set()
_EDGE_SAMPLES = 32
_AZIMUTHS = 128
_ANGLES = 64


class LensOptions(FilledOptions, total=False):
    """Options that `RandomMount` and `RandomLens` have in common; see `RandomCamera`."""

    chromatic: RangeLike | None
    vignetting: RangeLike | None
    cos4: RangeLike | None
    image_size: Sequence[int] | None


class RandomCamera(Augmentation):
    """Another camera in the same place: turned, with another lens, cropped, and of another size.

    Convention: ranges are (low, high), or a number x for x to either side of doing nothing. Angles are in
    degrees, as every `fov` in camtorch.

    Args:
        like: whose lens the new camera has. None: the sample's own camera. A Camera, whose numbers are copied and do
            not learn. The name of a preset, see `PRESETS`. A key of `ct.MODELS`, for that model with zero
            coefficients; it needs `fov`. "real": for each sample one of 7,000 calibrated lenses (`ct.lenses`), even
            chances for all whose images, cropped to the new shape, have a field of view in the range of `fov`. Every
            pixel has a ray. As lenses vary enough, the "auto" of focal, centre, distortion and crop is then None.
        camera: of samples that do not bring one.
        yaw: degrees by which the camera turns to its right.
        pitch: degrees by which it then looks up.
        roll: degrees by which it then leans to its right, clockwise: what it sees turns counterclockwise.
        zoom: factor on the focal lengths.
        fov: horizontal field of view of the new camera in degrees, from one outer edge of the image to the other if
            the axis is in the middle. None: that of the lens, whatever the size of the image. "source": as much of
            that as the images fill, all of the new image as long as nothing else is drawn: the focal lengths are
            scaled up to that. A turn then still leaves a rim empty, which `min_filled` takes away. Where `min_filled`
            leaves less than 0.9 of the least number given here, one warning a process says so; the new camera's `fov`
            is what came.
        focal: factor on the focal lengths, for lenses made alike; "auto" is (0.95, 1.05).
        centre: how far the principal point moves, as a part of the image's width and height; "auto" is 0.02.
        distortion: by what part of the distance from the centre to the corner all coefficients together may move
            the image's rim; see `jittered`, which also keeps the lens invertible over the image. "auto" is 0.02.
        crop: part of the image's width and height that is kept, at a random place, and enlarged to the full size;
            "auto" is (0.9, 1).
        chromatic: lateral chromatic aberration: by what factor less one red and blue, each for itself, are larger than
            green. Shown by images of three channels, taken as red, green, blue.
        vignetting: the part of the light that is lost in the image's farthest corner; it grows with the square of
            the distance from the principal point.
        cos4: natural vignetting: the light falls by this power of cos^4 of a pixel's angle to the axis; 1 is the law,
            fisheyes have less, below 0 it is undone. See `ct.vignetting`.
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
    beside_the_camera: ClassVar[frozenset[str]] = frozenset({"chromatic", "vignetting", "cos4"})
    _usual_ranges: ClassVar[Sequence[RangeLike]] = (0.95, 1.05), (-0.02, 0.02), (-0.02, 0.02), (0.9, 1.0)
    like: Camera | None

    def __init__(
        self,
        like: Camera | PresetName | str | None = None,
        *,
        yaw: RangeLike | None = (-10.0, 10.0),
        pitch: RangeLike | None = (-10.0, 10.0),
        roll: RangeLike | None = (-10.0, 10.0),
        zoom: RangeLike | None = (1.0, 1.0),
        fov: RangeLike | Literal["source"] | None = None,
        focal: Auto = "auto",
        centre: Auto = "auto",
        distortion: Auto = "auto",
        crop: Auto = "auto",
        chromatic: RangeLike | None = None,
        vignetting: RangeLike | None = None,
        cos4: RangeLike | None = None,
        image_size: Sequence[int] | None = None,
        **options: Unpack[FilledOptions],
    ):
        super().__init__(**options)
        self.fov = "source" if isinstance(fov, str) and fov == "source" else None
        self._memo = Kept()
        self.image_size: tuple[int, int] | None = as_image_size(image_size, self._name)
        self._is_real = isinstance(like, str) and like == _REAL
        self.like = None if self._is_real else _as_like(like, self._name)
        focal, centre, distortion, crop = (
            (None if self._is_real else usual) if isinstance(given, str) and given == "auto" else given
            for given, usual in zip((focal, centre, distortion, crop), self._usual_ranges, strict=True)
        )
        if self.like is not None and self.like.image_size is None and fov is None:
            raise ValueError(f"{self._name}: like={like!r} says nothing of the field of view; give fov=(low, high)")
        tiny, huge = 1e-3, 1e3
        limits: dict[str, tuple[object, dict[str, Any]]] = {
            "yaw": (yaw, {"least": -180, "most": 180}),
            "pitch": (pitch, {"least": -180, "most": 180}),
            "roll": (roll, {"least": -180, "most": 180}),
            "zoom": (zoom, {"least": tiny, "most": huge, "around": 1}),
            "lens": ((0, 1) if self._is_real else None, {}),
            "fov": (None if self.fov else _pair(fov), {"least": tiny, "most": 360}),
            "focal": (focal, {"least": tiny, "most": huge, "around": 1}),
            "centre": (centre, {"least": -1, "most": 1, "size": 2}),
            "distortion": (distortion, {"least": -1, "most": 1, "size": DRAWN}),
            "crop": (_pair(crop), {"least": tiny, "most": 1}),
            "place": (None if crop is None else (0, 1), {"size": 2}),
            "chromatic": (chromatic, {"least": -0.5, "most": 0.5, "size": 2}),
            "vignetting": (_pair(vignetting), {"least": 0, "most": 1}),
            "cos4": (_pair(cos4), {"least": -2, "most": 2}),
        }
        self.ranges: dict[str, Range] = {
            n: as_range(v, n, self._name, **limit) for n, (v, limit) in limits.items() if v is not None
        }
        if "fov" in self.ranges:
            check_degrees(self.ranges["fov"].low, fov, self._name)
        among = self.ranges.pop("fov", None) if self._is_real else None
        self._among = None if among is None else (among.low, among.high)

    def new_camera(self, source: Camera, values: Mapping[str, Tensor]) -> tuple[Camera, Tensor | None]:
        """The new camera and its turn; see `Augmentation.new_camera`."""
        return self._made(source, values, torch)

    def _new_camera(self, source: Camera, values: Mapping[str, Any]) -> tuple[Camera, Tensor | None]:
        if type(self).new_camera is not RandomCamera.new_camera:
            return super()._new_camera(source, values)
        if self._are_plain(source) and not any(isinstance(v, Tensor) for v in values.values()):
            # a hundred operations on some numbers, for each of which torch takes microseconds
            of_one = not source.batch_shape and not any(isinstance(value, np.ndarray) for value in values.values())
            return self._made(source, values, math if of_one else np)
        like = precise(source.intrinsics.detach())
        return self._made(source, {name: torch.as_tensor(value).to(like) for name, value in values.items()}, torch)

    def _are_plain(self, source: Camera) -> bool:
        """Whether plain numbers and arrays do, of which nothing is recorded."""
        like = self._held("like")
        return are_numbers(*source._tensors, *(() if like is None else like._tensors))

    def _made(self, source: Camera, values: Mapping[str, Any], xp: Any) -> tuple[Camera, Tensor | None]:
        """The same by tensors, arrays in float64, or numbers: with the functions of torch, of numpy or of math."""
        base, numbers, distortion, size, _ = self._target(source, values, xp)
        intrinsics = joined(numbers, distortion if xp is torch else base.intrinsics, xp)
        target = remade(base, intrinsics=intrinsics, distortion=distortion, image_size=size)
        return target, self._rotation(values, source.intrinsics, xp)

    def _rotation(self, values: Mapping[str, Any], like: Tensor, xp: Any) -> Tensor | None:
        """(*B, 3, 3); None: the camera stays as it looks."""
        none = next((0 * values[name] for name in _TURNS if name in values), None)
        if none is None:
            return None
        angles = [values.get(name, none) * (math.pi / 180) for name in _TURNS]
        elements = mount_elements([xp.cos(a) for a in angles], [xp.sin(a) for a in angles])
        rotation = joined(elements, like, xp)
        return rotation.view(3, 3) if xp is math else rotation.view(*rotation.shape[:-1], 3, 3)

    def __setstate__(self, state: dict[str, Any]) -> None:
        if "rates" in state["ranges"]:
            raise ValueError(f"{type(self).__name__}: the saved augmentation draws a rolling shutter. {LEFT}")
        super().__setstate__(state)  # type: ignore[no-untyped-call]

    def _part(self, rows: list[int] | None, source: Camera, draw: Mapping[str, Any]) -> Part:
        view = self._view(source, draw)
        return super()._part(rows, source, draw) if view is None else Part(rows, view, source)

    def _view(self, source: Camera, draw: Mapping[str, Any]) -> View | None:
        """What a draw makes of a single camera as plain numbers; None where it takes more than that."""
        usual = type(self).new_camera is RandomCamera.new_camera and self.options["tolerance"]  # or by another class
        usual = usual and not self.options["antialias"] and self.beside_the_camera.isdisjoint(self.ranges)
        if self.min_filled or not usual or isinstance(draw["apply"], Tensor) or source.batch_shape:
            return None
        if isinstance(source, PANORAMAS) or isinstance(self._held("like"), PANORAMAS):
            return None
        values = self._values(source, draw)
        if any(isinstance(v, (np.ndarray, Tensor)) for v in values.values()) or not self._are_plain(source):
            return None
        base, numbers, distortion, size, lens = self._target(source, values, math)
        total = math.fsum(numbers) + math.fsum(distortion.tolist())
        if not math.isfinite(total) or min(numbers[:2]) <= 0:
            return None
        before = rows_of(source, *source._tensors)
        if distortion is source.distortion:
            lens = before.native
        elif not base.always_defined and rows_of(base, *base._tensors).usable is not None:
            return None
        if before.usable is not None:
            return None
        turn = self._rotation(values, source.intrinsics, math)
        return View(base, numbers, distortion, size, turn, self.options, before.native, lens)

    def _warp(self, source: Camera, target: Camera, rotation: Tensor | None) -> Warp:
        return Warp.unchecked(source, target, self.options).turned_by(rotation)

    def _seen_through(self, warp: Warp, values: Mapping[str, Tensor]) -> tuple[tuple[Warp, Warp] | None, Tensor | None]:
        shades = light = None
        if "chromatic" in values:
            red, blue = (scaled(warp.target, 1 + values["chromatic"][..., i]) for i in (0, 1))
            shades = self._warp(warp.source, red, warp.rotation), self._warp(warp.source, blue, warp.rotation)
        if "vignetting" in values:
            # (B or 1, 1, H, W): it is lost by the square of the distance, so much in the farthest corner
            height, width = warp.target.height, warp.target.width
            cx, cy = warp.target.intrinsics.detach()[..., 2:].reshape(-1, 2, 1, 1).unbind(1)
            grid = warp.target.pixel_grid()
            square = (grid[..., 0] - cx) ** 2 + (grid[..., 1] - cy) ** 2
            reach = [torch.maximum(c, side - 1 - c) for c, side in ((cx, width), (cy, height))]
            farthest = (reach[0] ** 2 + reach[1] ** 2).clamp(min=1e-12)
            light = (1 - values["vignetting"].reshape(-1, 1, 1) * square / farthest).unsqueeze(1)
        if "cos4" in values:
            natural = vignetting(warp.target, values["cos4"])
            light = natural if light is None else light * natural
        return shades, light

    def _tell_of_zoom(self, source: Camera, target: Camera, factor: Tensor, found: Tensor) -> None:
        """Warn, once a process, if `min_filled`, and not a draw, zoomed to less than the `fov` that was asked for."""
        asked = self._among[0] if self._among else self.ranges["fov"].low if "fov" in self.ranges else None
        share = self.min_filled or 0.0
        key = self._name, asked, share
        if asked is None or key in _told or not known_false(factor <= 1):
            return
        made = _across(target)
        least = torch.minimum(_across(scaled(target, 1 / factor)), torch.full_like(made, asked))
        # what cannot be filled at all has a warning of its own
        less = (made < _LESS * least) & (factor > 1) & (found >= share)
        if not bool(less.any()):
            return
        _told.add(key)
        warn(
            f"{self._name}: asked for fov={asked:g} degrees at least, an image is {float(made[less].min()):.0f} wide: "
            f"min_filled={share:g} zooms until so much of it is filled, and the camera of the images, "
            f"{float(source.fov[..., 0].max()):.0f} degrees wide, shows no more where the new one looks. fov='source' "
            "asks for what it has; with min_filled=0 the rest stays empty"
        )

    def _target(
        self, source: Camera, values: Mapping[str, Any], xp: Any
    ) -> tuple[Camera, Sequence[Any], Tensor, tuple[int, int], Native | None]:
        """The new camera: of whose model, fx, fy, cx and cy, distortion, and (height, width); see `View.lens`."""
        size = self.image_size or (source.height, source.width)
        like = self._held("like")
        base = source if like is None else like
        dtype, device = torch.promote_types(source.intrinsics.dtype, torch.float32), source.intrinsics.device
        if self._is_real:
            share = torch.as_tensor(values["lens"], dtype=dtype, device=device)
            intrinsics, k, reach = drawn(share, size, self._among)
            base = remade(_ANY, intrinsics=intrinsics, distortion=k, image_size=size)
        if any(t.dtype != dtype or t.device != device for t in base._tensors):
            base = base.each(lambda t: t.to(device, dtype))
        if self.fov == "source":
            numbers = split(self._from_source(source, base, size), xp)
        else:
            numbers = _sized(base, size, values.get("fov"), xp)
        fx, fy, cx, cy = before = numbers
        for name in ("focal", "zoom"):
            if name in values:
                fx, fy = fx * values[name], fy * values[name]
        height, width = size
        if "centre" in values:
            right, down = _pairs(values["centre"])
            cx, cy = cx + right * width, cy + down * height
        if self._is_real:
            factor: Any = covering(joined((fx, fy, cx, cy), base.intrinsics, xp), reach, size)
            factor = factor if xp is torch else factor.numpy()
            fx, fy = fx * factor, fy * factor
        distortion, lens = base.distortion, None
        if "distortion" in values and distortion.shape[-1] and xp is math:
            usual = self._usual(base, size) if "fov" in values else joined(before, distortion, xp)
            distortion, lens = _jittered_alone(base, (fx, fy, cx, cy), values["distortion"], usual, size)
        elif "distortion" in values and distortion.shape[-1]:
            drawn_to = remade(base, intrinsics=joined((fx, fy, cx, cy), distortion, xp), image_size=size).detach()
            usual = self._usual(base, size) if "fov" in values else joined(before, distortion, xp).detach()
            amounts = torch.as_tensor(values["distortion"], dtype=dtype, device=device)
            distortion = jittered(drawn_to, amounts, usual)
            distortion = with_derivatives_of(base.distortion, distortion)
        if "crop" in values:  # a part of the image, enlarged to the full size
            share, (right, down) = values["crop"], _pairs(values["place"])
            left, top = (1 - share) * right * width, (1 - share) * down * height
            fx, fy, cx, cy = fx / share, fy / share, (cx + 0.5 - left) / share - 0.5, (cy + 0.5 - top) / share - 0.5
        return base, (fx, fy, cx, cy), distortion, size, lens

    def _usual(self, base: Camera, size: tuple[int, int]) -> Tensor:
        """(*B, 4): intrinsics of the lens with the field of view in the middle of the range; graph-free."""

        def made() -> Tensor:
            middle = base.intrinsics.new_tensor(self.ranges["fov"].middle)
            return joined(_sized(base, size, middle, torch), base.intrinsics, torch).detach()

        return self._memo(base._tensors, (type(base), base.image_size, size), made)

    def _from_source(self, source: Camera, base: Camera, size: tuple[int, int]) -> Tensor:
        """(*B, 4): intrinsics of the lens at most as wide as its like and as images of the source fill all of."""

        def narrowed() -> Tensor:
            fov = torch.rad2deg(field_of_view(source)[..., 0]) if base.image_size is None else None
            intrinsics = joined(_sized(base, size, fov, torch), base.intrinsics, torch)
            whole = remade(base, intrinsics=intrinsics, image_size=size)
            return scaled(whole, enough(source, whole, None, 1.0)[0]).intrinsics.detach()

        return self._memo(source._tensors + base._tensors, (type(source), source.image_size, size), narrowed)


def _sized(base: Camera, size: tuple[int, int], fov: Any, xp: Any) -> Sequence[Any]:
    """Return fx, fy, cx, cy of a lens before an image of another size, as wide as it was or of a fov in degrees.

    The old image is scaled to the new width, and cropped or padded evenly to the new height.
    """
    fx, fy, cx, cy = own = split(base.intrinsics, xp)
    across, down = (size[1] - 1) / 2, (size[0] - 1) / 2
    if base.image_size is None:
        cx, cy = cx + across, cy + down
    elif base.image_size != size:
        height, width = base.image_size
        scale = size[1] / width
        fx, fy = fx * scale, fy * scale
        cx, cy = (cx - (width - 1) / 2) * scale + across, (cy - (height - 1) / 2) * scale + down
    if fov is None:
        return fx, fy, cx, cy
    half = fov * (math.pi / 360)
    sine, cosine = xp.sin(half), xp.cos(half)
    if xp is not torch and (seen := _seen_across(base, sine, cosine)) is not None:
        return own[0] * size[1] / seen, own[1] * size[1] / seen, cx, cy
    ends = [joined((end, 0 * sine, cosine), base.intrinsics, xp) for end in (-sine, sine)]
    rays = torch.stack(ends, -2)
    if base.batch_shape:
        rays = rays.expand(*broadcast_shapes(rays.shape, (*base.batch_shape, 2, 3)))
    pixels, valid = base.project(rays)
    if known_false(valid):
        widest = float(fov if xp is math else fov.max())
        raise ValueError(f"fov: a {base.key} lens of these coefficients does not reach {widest:g} degrees")
    wide = pixels[..., 1, 0] - pixels[..., 0, 0]
    ratio = size[1] / (wide if xp is torch else wide.numpy())
    return own[0] * ratio, own[1] * ratio, cx, cy


def _seen_across(base: Camera, sine: Any, cosine: Any) -> Any:
    """Return the pixels, one or (B,), between rays to either side of the axis; None without compiled code."""
    native = None if base.batch_shape else rows_of(base, base.intrinsics, base.distortion).native
    if native is None:
        return None
    ends, is_one = (-sine, 0 * sine, cosine, sine, 0 * sine, cosine), isinstance(sine, float)
    pixels = project_numbers(native, ends if is_one else np.transpose(ends).ravel().tolist())
    if pixels is None:
        return None
    return pixels[2] - pixels[0] if is_one else np.subtract(pixels[2::4], pixels[::4])


class RandomMount(RandomCamera):
    """The camera turned and rolled where it stands, and zoomed: any lens keeps its coefficients.

    Args are those of `RandomCamera`: yaw, pitch, roll in degrees, zoom, a range of `fov`, chromatic, vignetting, cos4,
    image_size, and all options. On a pinhole camera this is the homography K' R K^-1.

    `shift=(dx, dy, dz)` also moves the camera: right, down and forward by lengths of the unit of the depth, each a
    range, or a number for as much to either side. It is for some centimetres, and for samples that have `depth` or
    `distance`: near things shift against far ones, which no image alone says. What stood behind something is empty and
    not valid; pixels move by their depth, points and poses exactly, and there is no `inverse`.
    """

    def __init__(
        self,
        *,
        yaw: RangeLike | None = (-10.0, 10.0),
        pitch: RangeLike | None = (-10.0, 10.0),
        roll: RangeLike | None = (-10.0, 10.0),
        zoom: RangeLike | None = (1.0, 1.0),
        shift: Sequence[RangeLike] | None = None,
        fov: RangeLike | None = None,
        **options: Unpack[LensOptions],
    ):
        if isinstance(fov, str):
            raise ValueError(f"{type(self).__name__}: the lens stays, so fov is a range of degrees; got {fov!r}")
        none: dict[str, Any] = dict.fromkeys(("focal", "centre", "distortion", "crop"))
        super().__init__(yaw=yaw, pitch=pitch, roll=roll, zoom=zoom, fov=fov, **none, **options)
        if shift is None:
            return
        if isinstance(shift, (str, int, float)) or len(shift) != len(_SHIFTS):
            raise TypeError(f"{self._name}: shift must be three lengths or ranges (dx, dy, dz); got {shift!r}")
        if "chromatic" in self.ranges:
            raise ValueError(f"{self._name}: with shift there is no chromatic")
        for name, each in zip(_SHIFTS, shift, strict=True):
            self.ranges[name] = as_range(each, "shift", self._name)

    def _of_sample(self, draw: Mapping[str, Any], named: Named) -> Mapping[str, Any]:
        draw = super()._of_sample(draw, named)
        if _SHIFTS[0] not in self.ranges:
            return draw
        for key, (field, _) in _DEPTHS.items():
            for found, value in named.values():
                if found == field and isinstance(value, Tensor):
                    return {**draw, key: value if value.ndim == 4 else value[:, None]}
        raise ValueError(
            f"{self._name}: shift moves the camera, and near things against far ones: the sample needs depth (B, 1, H, "
            f"W) or distance; it has {', '.join(named)}. Without it yaw, pitch, roll and zoom are exact"
        )

    def _checked_draw(self, draw: Mapping[str, Tensor]) -> Mapping[str, Any]:
        return {**super()._checked_draw(draw), **{key: draw[key] for key in _DEPTHS if key in draw}}

    def _part(self, rows: list[int] | None, source: Camera, draw: Mapping[str, Any]) -> Part:
        if _SHIFTS[0] not in self.ranges:
            return super()._part(rows, source, draw)
        key = next((key for key in reversed(_DEPTHS) if key in draw), None)
        if key is None:
            raise ValueError(f"{self._name}: shift needs the sample's depth; call the augmentation with the sample")
        part = super()._part(rows, source, {name: v for name, v in draw.items() if name not in (*_SHIFTS, key)})
        shifts = [torch.as_tensor(draw[name], dtype=torch.float64) for name in _SHIFTS]
        shift = torch.stack(shifts, -1).expand(len(draw["apply"]), 3)
        warp = ShiftedWarp(source, part.target, part.warp.rotation, draw[key], _DEPTHS[key][1], shift, **self.options)
        return replace(part, moves=warp)


class RandomLens(RandomCamera):
    """Another lens before the camera, which stays where it looks.

    Args are those of `RandomCamera`: like, fov, focal, centre, distortion, chromatic, vignetting, cos4, image_size, and
    all options; "auto" is (0.9, 1.1) for focal, 0.03 for centre and 0.05 for distortion, and None with like="real".
    From pinhole data, `RandomLens("kannala_brandt", fov=(120, 140))` makes a fisheye's, `RandomLens("real", fov=(100,
    150))` that of lenses that exist.
    """

    _usual_ranges: ClassVar[Sequence[RangeLike]] = (0.9, 1.1), (-0.03, 0.03), (-0.05, 0.05), (1.0, 1.0)

    def __init__(
        self,
        like: Camera | PresetName | str | None = None,
        *,
        fov: RangeLike | Literal["source"] | None = None,
        focal: Auto = "auto",
        centre: Auto = "auto",
        distortion: Auto = "auto",
        **options: Unpack[LensOptions],
    ):
        none: dict[str, Any] = dict.fromkeys(("yaw", "pitch", "roll", "zoom", "crop"))
        super().__init__(like, fov=fov, focal=focal, centre=centre, distortion=distortion, **none, **options)


_ANY = KannalaBrandt([1.0, 1.0, 0.0, 0.0]).detach()


def _as_like(like: Camera | str | None, owner: str) -> Camera | None:
    if like is None or isinstance(like, Camera):
        if like is not None and like.batch_shape:
            raise ValueError(f"{owner}: like must be a single camera; got batch dims {tuple(like.batch_shape)}")
        return like
    if isinstance(like, str) and like in PRESETS:
        return PRESETS[like].camera()
    if isinstance(like, str) and like in MODELS:
        return MODELS[like]([1.0, 1.0, 0.0, 0.0]).detach()
    close = get_close_matches(like, [_REAL, *PRESETS, *MODELS], 1) if isinstance(like, str) else []
    raise ValueError(
        f"{owner}: like must be a Camera, 'real', a preset ({', '.join(PRESETS)}) or a model ({', '.join(MODELS)}); "
        f"got {like!r}" + (f". Did you mean {close[0]!r}?" if close else "")
    )


def _across(camera: Camera) -> Tensor:
    """(*B,) degrees between the left and the right edge of the image, at the height of the principal point."""
    cy = camera.intrinsics[..., 3].detach()
    u = torch.stack((torch.full_like(cy, -0.5), torch.full_like(cy, camera.width - 0.5)), -1)
    pixels = torch.stack((u, cy[..., None].expand_as(u)), -1)
    with torch.no_grad():
        rays = camera.unproject(pixels.expand(*camera.batch_shape, 2, 2))[0]
    return torch.atan2(rays[..., 0].abs(), rays[..., 2]).sum(-1).rad2deg()


def _pair(value: RangeLike | str | None) -> RangeLike | str | None:
    """A single number of these means just that number."""
    return (value, value) if isinstance(value, (int, float)) else value


def _pairs(values: Any) -> Any:
    """Both of two numbers, or of (*B, 2) of them."""
    return values if isinstance(values, list) else (values[..., 0], values[..., 1])


# -- lenses like a given one: coefficients moved by what they do to the image, as far as it stays invertible


def jittered(camera: Camera, amounts: Tensor, nominal: Tensor) -> Tensor:
    """Return distortion coefficients (*B, n) of lenses like that of `camera`, moved by amounts (*B, 16).

    Every coefficient moves until it has moved the image's rim by its amount, a share of the distance from the centre to
    the corner of a lens of `nominal` intrinsics; together at most by the largest amount. Where the new lens could not
    be inverted on the rim of what the old one shows, they move as far the other way; or half as far, and so on; or
    stay.
    """
    with torch.no_grad():
        return _jittered(camera, amounts, nominal)[0]


def _shapes(camera: CameraNumbers, amounts: Tensor, nominal: Tensor) -> tuple[Tensor]:
    return (amounts.new_empty(*amounts.shape[:-1], camera.distortion.shape[-1]),)


def _jittered_alone(
    base: Camera, numbers: Sequence[float], amounts: Sequence[float], nominal: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Native | None]:
    """`jittered` of one lens with plain numbers fx, fy, cx, cy before images of a size; see `View.lens`."""
    model: type[Camera] = type_before_parametrizations(base)
    k, intrinsics = base.distortion.detach(), joined(numbers, nominal, math)
    fx, fy, cx, cy = intrinsics.tolist()
    given = k.numpy()
    measured, end = _kept(_of_lens, base, k, nominal, size=size)
    native, (height, width) = None, size
    across, down = max(cx + 0.5, width - 0.5 - cx) / fx, max(cy + 0.5, height - 0.5 - cy) / fy
    # all of the image is within the circle where the lens ends, with some room; see `covering`
    if model.always_defined and math.hypot(across, down) <= FOLD * end:
        rim = _border(size, k.dtype)[None]
        steps = np.array([amounts[i % DRAWN] for i in range(len(given))], given.dtype) * measured
        for part in _PARTS:
            candidate = torch.from_numpy(given + given.dtype.type(part) * steps)
            native = single_native(model, intrinsics, candidate)
            if native is None:
                break
            if unproject(native, rim).valid.numpy().all():
                return candidate, native
    if native is not None:
        return k, None
    lens = remade(base, intrinsics=intrinsics, image_size=size).detach()
    return jittered(lens, torch.as_tensor(amounts, dtype=k.dtype), nominal), None


@opaque(_shapes)
def _jittered(camera: Camera, amounts: Tensor, nominal: Tensor) -> tuple[Tensor]:
    count = camera.distortion.shape[-1]
    measured = _kept(_sensitivity, camera, camera.distortion, nominal).to(amounts).reshape(-1, count)
    steps = amounts.reshape(-1, DRAWN).repeat(1, -(-count // DRAWN))[:, :count] * measured
    lens = remade(camera, intrinsics=camera.intrinsics.reshape(-1, 4), distortion=camera.distortion.reshape(-1, count))
    rim, given = _rim(lens), lens.distortion.expand_as(steps)
    if len(rim) < len(steps):
        rim = rim.expand(len(steps), -1, -1)
    result, done = given, None
    for part in _PARTS:
        candidate, defined = _defined(camera, given + part * steps, given)
        fits = _seen_through(lens, lens.intrinsics.expand(len(candidate), 4), candidate, rim, unproject)[1].all(-1)
        fits = fits if defined is None else fits & defined
        if done is None and bool(fits.all()):  # mostly the first step does
            return (candidate.view(*amounts.shape[:-1], count),)
        done = torch.zeros_like(fits) if done is None else done
        result = torch.where((fits & ~done).unsqueeze(-1), candidate, result)
        done |= fits
        if bool(done.all()):
            break
    return (result.view(*amounts.shape[:-1], count).clone(),)


def _seen_through(
    lens: Camera, intrinsics: Tensor, distortion: Tensor, values: Tensor, way: Callable[[Native, Tensor], Any]
) -> tuple[Tensor, Tensor]:
    """What lenses of other numbers, (C, 4) and (C, n), make of pixels or rays (C, N, size); way: which of both."""
    made = CameraRows(type_before_parametrizations(lens), intrinsics, distortion)
    if made.native is None or not are_free(values, intrinsics, distortion):
        camera = remade(lens, intrinsics=intrinsics, distortion=distortion)
        return camera.project(values) if way is project else camera.unproject(values)
    planes, valid, *_ = way(made.native, values)
    return planes.movedim(0, -1), valid


_MOST_MEASURED = 64  # lenses
_measured: dict[tuple[object, ...], Any] = {}


def _kept(measure: Callable[..., T], camera: Camera, *inputs: Tensor, size: tuple[int, int] | None = None) -> T:
    """Return `measure(camera, *inputs)`, of which these tensors and the size of images are all that counts, kept."""
    values = [(t.dtype, t.shape, t.device, t.detach().cpu().numpy().tobytes()) for t in inputs]
    key = measure, type(camera), size or camera.image_size, *values
    found: T | None = _measured.pop(key, None)
    if found is None:
        with torch.inference_mode(False), torch.no_grad():  # what inference mode makes could not be used in a graph
            lens = camera if size is None else remade(camera.detach(), image_size=size)
            found = measure(lens, *[t.detach().clone() for t in inputs])
    _measured[key] = found  # the last one
    while len(_measured) > _MOST_MEASURED:
        _measured.pop(next(iter(_measured)), None)
    return found


def _of_lens(camera: Camera, distortion: Tensor, nominal: Tensor) -> tuple[Array, float]:
    """What changes of a single lens do (n,), and the least distance at which it ends; see `_sensitivity`."""
    measured = _sensitivity(camera, distortion, nominal).to(distortion.dtype).numpy()
    return measured, float(_least_end(camera, distortion[None]))


def _sensitivity(camera: Camera, distortion: Tensor, nominal: Tensor) -> Tensor:
    """Return (*B, n): by how much to change each coefficient so that the rim moves from centre to corner."""
    count, size = distortion.shape[-1], camera._size_for("its sensitivity")
    batch = broadcast_shapes(nominal.shape[:-1], distortion.shape[:-1])
    intrinsics, k = (
        t.detach().double().expand(*batch, t.shape[-1]).reshape(-1, t.shape[-1]) for t in (nominal, distortion)
    )
    pixels = _over(size).to(k.device).expand(len(k), -1, -1)
    rays, seen = _seen_through(camera, intrinsics, k, pixels, unproject)
    # each coefficient less, then each more; the same lenses stand before any part of an image
    change = _STEP * torch.eye(count, dtype=torch.float64, device=k.device)
    lenses, _ = _defined(camera, k[:, None] + torch.cat((-change, change)), k[:, None])
    many = [t.repeat_interleave(2 * count, 0) for t in (intrinsics, rays)]
    ends, valid = _seen_through(camera, many[0], lenses.flatten(0, 1), many[1], project)
    # (B, less and more, n, N, 2), and plain arithmetic on a few numbers
    places, known = (t.unflatten(0, (-1, 2, count)).cpu().numpy() for t in (ends, valid))
    moved = np.linalg.norm(places[:, 1] - places[:, 0], axis=-1) / (2 * _STEP)
    most = np.where(known.all(1) & seen.cpu().numpy()[:, None], moved, 0.0).max(-1)
    odd = camera.odd_in_x | camera.odd_in_y
    lopsided = np.array([name in odd for name in camera.distortion_names], bool)
    share = np.where(lopsided, np.float32(_SMALL), np.float32(1)) / np.float32(max((~lopsided).sum(), 1))
    corner = math.hypot(size[1] / 2, size[0] / 2)
    measured = share * np.where(most > 0, corner / most.clip(min=1e-30), 0.0)
    return torch.from_numpy(measured.reshape(*batch, count)).to(k.device)


@lru_cache(maxsize=16)
def _over(size: tuple[int, int]) -> Tensor:
    """(N, 2) in float64: pixels in even steps over images of a size, to their outer edges."""
    with torch.inference_mode(False):
        edges = torch.tensor([[-0.5, -0.5], [size[1] - 0.5, size[0] - 0.5]], dtype=torch.float64)
        return pixel_lattice(edges[0], edges[1], _SIDE, _SIDE).flatten(0, 1)


def _defined(camera: Camera, distortion: Tensor, otherwise: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return coefficients (*B, n), others where the model has no formula for them; and where, (*B,), None: nowhere."""
    sense = camera.defined(distortion.unbind(-1))
    if sense is None:
        return distortion, None
    return torch.where((sense > 0).unsqueeze(-1), distortion, otherwise), sense > 0


def _rim(camera: Camera) -> Tensor:
    """Return (C, N, 2): pixels of the outline of what cameras show of the image; the principal point for the rest.

    A lens that is invertible on the image's edges and where it ends on the image is so inside.
    """
    size = camera._size_for("its rim")
    border = _border(size, camera.intrinsics.dtype).to(camera.intrinsics.device)
    rim = border.expand(*camera.batch_shape, *border.shape)
    if len(camera.distortion) == 1:
        least = _kept(_least_end, camera, camera.distortion)
        if bool((covering(camera.intrinsics, least, size) == 1).all()):
            return rim
    if not bool(camera.unproject(rim)[1].all()):
        focal, centre = camera.intrinsics[:, None, :2], camera.intrinsics[:, None, 2:]
        # edited images have different intrinsics, and few kinds of coefficients
        lenses, which = camera.distortion.detach().unique(dim=0, return_inverse=True)
        ends = _kept(_ends, camera, lenses).to(focal)[which] * focal + centre
        ends = torch.where(camera.contains(ends).unsqueeze(-1), ends, rim[:, :1])
        rim = torch.cat((rim, ends.expand(len(rim), -1, -1)), 1)
        rim = torch.where(camera.unproject(rim)[1].unsqueeze(-1), rim, centre)
    return rim


@lru_cache(maxsize=16)
def _border(size: tuple[int, int], dtype: torch.dtype) -> Tensor:
    """(N, 2): pixels along the outer edges of images of a size."""
    height, width = size
    with torch.inference_mode(False):
        corners = torch.tensor([[0, 0], [width, 0], [width, height], [0, height]], dtype=torch.float64) - 0.5
        return along_edges(corners, _EDGE_SAMPLES).to(dtype)


def _ends(camera: Camera, distortion: Tensor) -> Tensor:
    """(*B, K, 2): in focal lengths, the last point along every azimuth that the lens of these coefficients maps."""
    ones = distortion.new_tensor([1.0, 1.0, 0.0, 0.0]).double()
    plane = remade(camera, intrinsics=ones, distortion=distortion.detach().double())
    azimuths = torch.linspace(0, 2 * math.pi, _AZIMUTHS + 1, dtype=torch.float64, device=ones.device)[:-1]

    def seen(rays: Tensor) -> tuple[Tensor, Tensor]:
        return plane.project(rays.expand(*plane.batch_shape, *rays.shape[-3:]))

    ends = reach(lambda rays: seen(rays)[1], azimuths, steps=_ANGLES, rounds=2)
    return seen(polar_rays(ends, azimuths).unsqueeze(-2))[0].squeeze(-2)


def _least_end(camera: Camera, distortion: Tensor) -> Tensor:
    """(*B,): the least of the distances of `_ends`; what is nearer to the principal point has a ray."""
    return (_ends(camera, distortion) ** 2).sum(-1).amin(-1).sqrt()
