"""Random mounts, lenses and cameras."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, Literal, Unpack

import torch

from camtorch.augment.drawer import Auto, CameraDrawer, LensOptions
from camtorch.augment.fields import Named
from camtorch.augment.part import Part
from camtorch.augment.presets import PresetName
from camtorch.augment.ranges import Draw, RangeLike, as_range
from camtorch.cameras.camera import Camera
from camtorch.rays.depth import as_depth
from camtorch.warp.shifted import ShiftedWarp

_SHIFTS = "shift_x", "shift_y", "shift_z"
_DEPTHS = {"of_depth": ("depth", "z"), "of_distance": ("distance", "distance")}
"""Names of distances in a draw, with the field of samples that holds them and its kind; the first one there counts.

Those of a sample replace those of a draw: a draw for clips has the distances of first frames, and each frame its own.
"""


class RandomCamera(CameraDrawer):
    """Another camera in the same place: turned, with another lens, cropped, and of another size.

    Ranges are (low, high). A number x stands for x to either side of doing nothing, but for `fov`, `crop`, `vignetting`
    and `cos4` for x alone. Angles are in degrees, as every `fov` in camtorch.

        >>> camera = ct.KannalaBrandt([80.0, 80.0, 63.5, 47.5], [0.02, -0.01, 0.0, 0.0], image_size=(96, 128))
        >>> augment = ct.augment.RandomCamera(yaw=(-5.0, 5.0), camera=camera)
        >>> sorted(augment(image=torch.zeros(3, 96, 128), keypoints=torch.tensor([[60.0, 50.0]])))
        ['camera', 'image', 'keypoints', 'keypoints_valid', 'rotation']

    Args:
        like: the camera whose lens is used. None: the sample's own. A Camera, copied without gradients. The name of a
            preset, see `PRESETS`. A key of `ct.MODELS`: that model with zero coefficients; it needs `fov`. "real": for
            each sample one of 7,000 calibrated lenses (`ct.lenses`), drawn evenly from those whose images, cropped to
            the new shape, have a field of view in the range of `fov`; every pixel has a ray, and "auto" of focal,
            centre, distortion and crop is None, as lenses vary enough.
        camera: for samples that hold none.
        yaw: degrees by which the camera turns to its right.
        pitch: degrees by which it then looks up.
        roll: degrees by which it then leans to its right, clockwise: the image turns counterclockwise.
        zoom: factor on the focal lengths.
        fov: horizontal field of view of the new camera in degrees, from one outer edge of the image to the other if
            the axis is in the middle. None: that of the lens, for any size of the image. "source": as much of it as
            the images fill, by larger focal lengths; all of the new image if nothing else is drawn. A turn then still
            leaves an empty rim, which `min_filled` removes. If `min_filled` leaves less than 0.9 of the least number
            given here, a process warns once; the new camera's `fov` is the result.
        focal: factor on the focal lengths, for lenses made alike; "auto" is (0.95, 1.05).
        centre: how far the principal point moves, as a part of the image's width and height; "auto" is 0.02.
        distortion: the part of the distance from the centre to the corner by which all coefficients together may move
            the image's rim; see `jittered`, which also keeps the lens invertible over the image. "auto" is 0.02.
        crop: part of the image's width and height that is kept, at a random place, and enlarged to the full size;
            "auto" is (0.9, 1).
        chromatic: lateral chromatic aberration: factor less one by which red and blue, drawn separately, are larger
            than green, for images of three channels, red, green and blue.
        vignetting: the part of the light that is lost in the image's farthest corner; it grows with the square of
            the distance from the principal point.
        cos4: natural vignetting: power of cos^4 of a pixel's angle to the axis; 1 is natural, fisheyes have less, below
            0 it is undone. See `ct.vignetting`.
        image_size: (height, width) of the result; default: the sample's, also with a `like` of another size. Fields of
            view are those in width.
        options: p, same_on_batch, camera, fields, mode, padding_mode, fill, antialias, tolerance, mask_fill, valid_mask
            and min_filled; see `Augmentation`.

    Raises:
        ValueError: If a range is in the wrong order or out of bounds, or a name is unknown (the message lists all).
        TypeError: If a range is not numeric, or a keyword is unknown.
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
        **options: Unpack[LensOptions],
    ):
        given = {"yaw": yaw, "pitch": pitch, "roll": roll, "zoom": zoom, "fov": fov, "focal": focal, "centre": centre}
        super().__init__(like, {**given, "distortion": distortion, "crop": crop}, **options)


class RandomMount(CameraDrawer):
    """The camera turned and rolled where it stands, and zoomed: any lens keeps its coefficients.

    Args are those of `RandomCamera`: yaw, pitch, roll in degrees, zoom, a range of `fov`, chromatic, vignetting, cos4,
    image_size, and all options. On a pinhole camera this is the homography K' R K^-1. `yaw=25` draws from -25 to 25;
    a fixed mount is `yaw=(25, 25), pitch=None, roll=None`.

        >>> augment = ct.augment.RandomMount(yaw=10, camera=ct.Pinhole([80.0, 80.0, 63.5, 47.5], image_size=(96, 128)))
        >>> sample = augment(image=torch.zeros(8, 3, 96, 128), gaze=torch.tensor([[0.0, 0.0, -1.0]] * 8))

    `shift=(dx, dy, dz)` also moves the camera: right, down and forward by lengths of the unit of the depth, each a
    range, or x for (-x, x). It is for some centimetres, and samples need `depth` or `distance`. Surfaces that were
    hidden are empty and not valid; pixels move by their depth, points and poses exactly. There is no `inverse`.
    """

    _labels_in_draws: ClassVar[Sequence[str]] = tuple(_DEPTHS)

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

    @property
    def shifts(self) -> bool:
        """Whether it also moves the camera, by `shift`."""
        return _SHIFTS[0] in self.ranges

    def _with_labels(self, draw: Draw, rows: Callable[[], Named]) -> Draw:
        draw = super()._with_labels(draw, rows)
        if not self.shifts:
            return draw
        named = rows()
        for key, (field, _) in _DEPTHS.items():
            for found, value in named.values():
                if found == field:
                    others = {name: v for name, v in draw.items() if name not in _DEPTHS}
                    if isinstance(value, list):  # a plane for each sample, with a channel or without
                        value = torch.stack([plane.reshape(-1, *plane.shape[-2:]) for plane in value])
                    return {**others, key: value if value.ndim == 4 else value[:, None]}
        raise ValueError(
            f"{self._name}: with shift the sample must have depth (B, 1, H, W) or distance, as near things shift "
            f"against far ones; got {', '.join(named)}. Without shift, yaw, pitch, roll and zoom are exact"
        )

    def _part(self, source: Camera, draw: Draw) -> Part:
        if not self.shifts:
            return super()._part(source, draw)
        key = next((key for key in _DEPTHS if key in draw), None)
        if key is None:
            raise ValueError(
                f"{self._name}: draw must have the sample's depth for shift; got none. Call the augmentation with "
                "the sample"
            )
        part = super()._part(source, {name: v for name, v in draw.items() if name not in (*_SHIFTS, *_DEPTHS)})
        shifts = [torch.as_tensor(draw[name], dtype=torch.float64) for name in _SHIFTS]
        shift = torch.stack(shifts, -1).expand(len(draw["apply"]), 3)
        kind = _DEPTHS[key][1]
        depth = as_depth(draw[key], kind, source.size_for(self._name), self._name, draw[key].device)
        turned = part.warp.rotation
        warp = ShiftedWarp(source, part.target, turned, depth, kind, shift, self._name, **self.options)
        return replace(part, motion=warp)


class RandomLens(CameraDrawer):
    """Another lens in front of the camera, which keeps its direction.

    Args are those of `RandomCamera`: like, fov, focal, centre, distortion, chromatic, vignetting, cos4, image_size, and
    all options; "auto" is (0.9, 1.1) for focal, 0.03 for centre and 0.05 for distortion, and None with like="real".
    From pinhole data, `RandomLens("kannala_brandt", fov=(120, 140))` makes images of a fisheye, and "real" those of
    lenses that exist.

        >>> lens = ct.augment.RandomLens("real", fov=(60, 90))
        >>> sample = lens(image=torch.zeros(3, 96, 128), camera=ct.Pinhole([50.0, 50, 64, 48], image_size=(96, 128)))
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
