"""Random mounts, lenses and cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor
from typing_extensions import Unpack

from camtorch.augment.augmentation import FilledOptions
from camtorch.augment.change import Part
from camtorch.augment.drawer import Auto, CameraDrawer, LensOptions, RangeLike
from camtorch.augment.kinds import Named
from camtorch.augment.presets import PresetName
from camtorch.augment.ranges import as_range
from camtorch.cameras.camera import Camera
from camtorch.warp.shifted import ShiftedWarp

_SHIFTS = "shift_x", "shift_y", "shift_z"
_DEPTHS = {"of_depth": ("depth", "z"), "of_distance": ("distance", "distance")}
"""In a draw, how far away things are: the field of samples that says so, and what it holds."""


class RandomCamera(CameraDrawer):
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

    like: Camera | None
    _usual_ranges: ClassVar[Mapping[str, RangeLike]] = {
        "focal": (0.95, 1.05),
        "centre": (-0.02, 0.02),
        "distortion": (-0.02, 0.02),
        "crop": (0.9, 1.0),
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
        given = {"yaw": yaw, "pitch": pitch, "roll": roll, "zoom": zoom, "fov": fov, "focal": focal, "centre": centre}
        given |= {"distortion": distortion, "crop": crop}
        beside = {"chromatic": chromatic, "vignetting": vignetting, "cos4": cos4}
        super().__init__(like, given, image_size=image_size, **beside, **options)


class RandomMount(CameraDrawer):
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
            raise ValueError(f"{type(self).__name__}: fov must be a range of degrees, as the lens stays; got {fov!r}")
        super().__init__(None, {"yaw": yaw, "pitch": pitch, "roll": roll, "zoom": zoom, "fov": fov}, **options)
        if shift is None:
            return
        if isinstance(shift, (str, int, float)) or len(shift) != len(_SHIFTS):
            raise TypeError(f"{self._name}: shift must be three lengths or ranges (dx, dy, dz); got {shift!r}")
        if "chromatic" in self.ranges:
            raise ValueError(f"{self._name}: chromatic must be None with shift; got a range")
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
            f"{self._name}: with shift the sample must have depth (B, 1, H, W) or distance, as near things shift "
            f"against far ones; got {', '.join(named)}. Without shift, yaw, pitch, roll and zoom are exact"
        )

    def _checked_draw(self, draw: Mapping[str, Tensor]) -> Mapping[str, Any]:
        return {**super()._checked_draw(draw), **{key: draw[key] for key in _DEPTHS if key in draw}}

    def _part(self, rows: list[int] | None, source: Camera, draw: Mapping[str, Any]) -> Part:
        if _SHIFTS[0] not in self.ranges:
            return super()._part(rows, source, draw)
        key = next((key for key in reversed(_DEPTHS) if key in draw), None)
        if key is None:
            raise ValueError(
                f"{self._name}: draw must have the sample's depth for shift; got none. Call the augmentation with "
                "the sample"
            )
        part = super()._part(rows, source, {name: v for name, v in draw.items() if name not in (*_SHIFTS, key)})
        shifts = [torch.as_tensor(draw[name], dtype=torch.float64) for name in _SHIFTS]
        shift = torch.stack(shifts, -1).expand(len(draw["apply"]), 3)
        warp = ShiftedWarp(source, part.target, part.warp.rotation, draw[key], _DEPTHS[key][1], shift, **self.options)
        return replace(part, moves=warp)


class RandomLens(CameraDrawer):
    """Another lens before the camera, which stays where it looks.

    Args are those of `RandomCamera`: like, fov, focal, centre, distortion, chromatic, vignetting, cos4, image_size, and
    all options; "auto" is (0.9, 1.1) for focal, 0.03 for centre and 0.05 for distortion, and None with like="real".
    From pinhole data, `RandomLens("kannala_brandt", fov=(120, 140))` makes a fisheye's, `RandomLens("real", fov=(100,
    150))` that of lenses that exist.
    """

    _usual_ranges: ClassVar[Mapping[str, RangeLike]] = {
        "focal": (0.9, 1.1),
        "centre": (-0.03, 0.03),
        "distortion": (-0.05, 0.05),
    }

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
        super().__init__(like, {"fov": fov, "focal": focal, "centre": centre, "distortion": distortion}, **options)
