"""The base of random cameras: the ranges they draw from, and the new camera that a draw makes, by formulas of torch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Unpack

import torch
from torch import Tensor

from camtorch.augment.augmentation import Augmentation, AugmentationOptions
from camtorch.augment.devices import twin_of
from camtorch.augment.filling import scaled, zoom_to_fill
from camtorch.augment.jitter import jittered
from camtorch.augment.native_draws import DRAWN_SIZES, Start, Wanted, too_wide
from camtorch.augment.part import Part
from camtorch.augment.presets import REAL, as_like
from camtorch.augment.ranges import POSITIVE, TURN, Draw, Range, RangeLike, as_range, as_tensors, values_for
from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import hold_numbers, known_false, with_derivatives_of
from camtorch.lenses.drawing import covering, drawn
from camtorch.models import KannalaBrandt, Pinhole
from camtorch.optics.radial_inverse import precise
from camtorch.poses.rotations import mount_elements
from camtorch.rays.lattices import field_of_view
from camtorch.values.arguments import LEFT, as_image_size, broadcast_shapes, check_degrees, present
from camtorch.values.module import remade
from camtorch.warp.vignetting import falloff, vignetting
from camtorch.warp.warp import Warp

Auto = RangeLike | Literal["auto"] | None

_TURNS = "yaw", "pitch", "roll"
_TINY, _HUGE = 1e-3, 1e3
_LIMITS: dict[str, dict[str, Any]] = {
    **dict.fromkeys(_TURNS, TURN),
    "zoom": {"least": _TINY, "most": _HUGE, "around": 1},
    "lens": {},
    "fov": {"least": _TINY, "most": 360, "is_pair": True},
    "focal": {"least": _TINY, "most": _HUGE, "around": 1},
    "centre": {"least": -1, "most": 1, "size": DRAWN_SIZES["centre"]},
    "distortion": {"least": -1, "most": 1, "size": DRAWN_SIZES["distortion"]},
    "crop": {"least": _TINY, "most": 1, "is_pair": True},
    "place": {"size": DRAWN_SIZES["place"]},
    "chromatic": {"least": -0.5, "most": 0.5, "size": 2},
    "vignetting": {"least": 0, "most": 1},
    "cos4": {"least": -2, "most": 2},
}
"""The options of `as_range` for each range, in the order in which they are drawn."""
_EXACT = "fov", "crop", "vignetting", "cos4"  # a number x of these means (x, x), not a range around nothing
_AUTO = "focal", "centre", "distortion", "crop"  # ranges that "auto" may stand for
_REAL_LENS = KannalaBrandt([1.0, 1.0, 0.0, 0.0]).detach()  # of the model of real lenses, with other numbers


class LensOptions(AugmentationOptions, total=False):
    """Options that `RandomMount`, `RandomLens` and `RandomCamera` have in common; see `RandomCamera`."""

    min_filled: float | None
    chromatic: RangeLike | None
    vignetting: RangeLike | None
    cos4: RangeLike | None
    image_size: Sequence[int] | None


class CameraDrawer(Augmentation):
    """Another camera in the same place; see `RandomCamera`.

    Args:
        like: see `RandomCamera`.
        given: name -> range, of those of `RandomCamera`.
        chromatic, vignetting, cos4, image_size, min_filled, options: see `RandomCamera`.
    """

    other_words: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("preset", "model", "lens"), "like"),
        **{"center": "centre", "size": "image_size"},
    }
    beside_the_camera: ClassVar[frozenset[str]] = frozenset({"chromatic", "vignetting", "cos4"})
    _usual_ranges: ClassVar[Mapping[str, RangeLike]] = {}
    """The ranges that "auto" stands for, of lenses that are not drawn from real ones."""
    like: Any  # a Camera or None; the name of a preset or a model when it is set

    def __init__(
        self,
        like: Camera | str | None,
        given: Mapping[str, Any],
        *,
        chromatic: RangeLike | None = None,
        vignetting: RangeLike | None = None,
        cos4: RangeLike | None = None,
        image_size: Sequence[int] | None = None,
        min_filled: float | None = None,
        **options: Unpack[AugmentationOptions],
    ):
        super().__init__(min_filled=min_filled, **options)
        self._memo = Kept(8)
        self.image_size: tuple[int, int] | None = as_image_size(image_size, self._name)
        self._is_real = isinstance(like, str) and like == REAL
        fov = given.get("fov")
        self.fov = "source" if isinstance(fov, str) and fov == "source" else None
        # The ranges by name, of which some follow from others
        values = {**given, "chromatic": chromatic, "vignetting": vignetting, "cos4": cos4}
        for name in _AUTO:
            if isinstance(values.get(name), str) and values[name] == "auto":
                values[name] = None if self._is_real else self._usual_ranges.get(name)
        if self.fov:
            values["fov"] = None
        if self._is_real:
            values["lens"] = 0, 1
        if values.get("crop") is not None:
            values["place"] = 0, 1
        self.ranges: dict[str, Range] = {}
        for name, limit in _LIMITS.items():
            value = values.get(name)
            if name in _EXACT and isinstance(value, (int, float)):
                value = value, value
            if value is not None:
                self.ranges[name] = as_range(value, name, self._name, **limit)
        if "fov" in self.ranges:
            check_degrees(self.ranges["fov"].low, fov, self._name)
        # Real lenses are not made as wide as a drawn angle, but drawn among those that are as wide
        real = self.ranges.pop("fov", None) if self._is_real else None
        self._among = None if real is None else (real.low, real.high)  # a name in states of 0.4
        self.like = None if self._is_real else like  # last, as setting it reads `fov` and `ranges`

    @property
    def makes_pinholes(self) -> bool:  # type: ignore[override]
        """See `SampleTransform`."""
        return not self._is_real and (self.like is None or isinstance(self.like, Pinhole))

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "fov" and value not in (None, "source"):
            how = f"Set ranges['fov'] = ct.augment.Range(low, high), or make a new {self._name}"
            raise ValueError(f"{self._name}: fov must be None or 'source', once it is made; got {value!r}. {how}")
        if name == "like":
            given, value = value, as_like(value, self._name)
            if value is not None and self._is_real:
                got = f"one that was made with 'real'. Make a new {self._name}"
                raise ValueError(f"{self._name}: like must stay None in {got}; got {given!r:.60}")
            if value is not None and value.image_size is None and self.fov is None and "fov" not in self.ranges:
                wanted = "have an image_size, or fov be given"
                raise ValueError(f"{self._name}: like must {wanted}; got like={given!r}. Pass fov=(low, high)")
        super().__setattr__(name, value)

    def __setstate__(self, state: dict[str, Any]) -> None:
        if "rates" in state["ranges"]:
            raise ValueError(f"{type(self).__name__}: the saved augmentation draws a rolling shutter. {LEFT}")
        super().__setstate__(state)

    @property
    def _keeps_formulas(self) -> bool:
        """Whether new cameras follow from the formulas of this class; a subclass may have another `new_camera`."""
        return type(self).new_camera is CameraDrawer.new_camera

    drawn_on_host = _keeps_formulas  # the formulas take numbers alone

    @property
    def _least_fov(self) -> float | None:  # type: ignore[override]
        if self._among is not None:
            return self._among[0]
        return self.ranges["fov"].low if "fov" in self.ranges else None

    def _part(self, source: Camera, draw: Draw) -> Part:
        values = values_for(source, draw)
        # a draw is of tensors where something is recorded
        start = None if isinstance(draw["apply"], Tensor) else self._start(source, values)
        options = self.options
        made = None if start is None else start.warp(source, values, options)
        if made is None:
            target, rotation = self._filled_camera(source, values)
        else:
            warp, zooms, filled = made
            if self.min_filled and (min(filled, default=1) < self.min_filled or max(zooms, default=1) > 1):
                self._tell_of_unfilled(source, lambda: warp.target, torch.tensor([*zooms]), torch.tensor([*filled]))
            may_stay_lazy = warp.natives is not None and options["tolerance"] and not options["antialias"]
            if may_stay_lazy and self.beside_the_camera.isdisjoint(self.ranges):
                return Part(source, warp)  # of numbers, which become a `Warp` at first use
            target, rotation = warp.target, warp.rotation
        return self._seen_by(source, target, rotation, values)

    def _seen_by(self, source: Camera, target: Camera, rotation: Tensor | None, values: Mapping[str, Any]) -> Part:
        """Return the part to new cameras, with what values of `beside_the_camera` do to colours and light."""
        beside = as_tensors(source, {name: values[name] for name in self.beside_the_camera.intersection(values)})
        cameras, light = [target], None
        if "chromatic" in beside:  # red and blue are seen by cameras of their own
            cameras += [scaled(target, 1 + beside["chromatic"][..., i]) for i in (0, 1)]
        warp, *others = [Warp.of_valid(source, camera, self.options).turned_by(rotation) for camera in cameras]
        if "vignetting" in beside:
            light = falloff(target, beside["vignetting"])
        if "cos4" in beside:
            natural = vignetting(target, beside["cos4"])
            light = natural if light is None else light * natural
        return Part(source, warp, (others[0], others[1]) if others else None, light)

    def _start(self, source: Camera, values: Mapping[str, Any]) -> Start | None:
        """Return what native code starts from for values of these names, kept while the cameras' numbers stay.

        None if a camera learns, or native code lacks a range or a model.
        """
        tensors: tuple[Tensor, ...] = (source.intrinsics, source.distortion)
        like: Camera | None = self._modules.get("like")  # type: ignore[assignment]  # `self.like` in less time
        if like is not None:
            numbers = like.tensors
            if not numbers[0].is_cpu:
                numbers = present(self._like_for(source), "like").tensors
            tensors += numbers
        if not hold_numbers(tensors):
            return None
        if self._is_real:  # each draw has a lens of its own
            return self._new_start(source, values)
        # all else that new cameras depend on
        sizes = source.image_size, None if like is None else like.image_size
        key = "start", type(source), *sizes, self._calls.revision, self.ranges.get("fov"), self.min_filled, *values
        start: Start | None = self._memo.get(tensors, key, self._new_start, source, values)
        return start

    def _new_start(self, source: Camera, values: Mapping[str, Any]) -> Start | None:
        if not self._keeps_formulas:
            return None
        self._check_ranges()
        names = values.keys() - self.beside_the_camera - {"lens"}
        source = source.detach().clone()
        base, sized, covered_radius = self._lens_for(source, values.get("lens"))
        size, nominal = self._size_of(source), None
        if "distortion" in values and base.distortion.shape[-1] > 0:
            nominal = self._nominal(base, sized, size, values)
        return Start.of(Wanted(source, base, sized, covered_radius, size, names, nominal, self.min_filled, self._name))

    def _new_camera(self, source: Camera, values: Mapping[str, Any]) -> tuple[Camera, Tensor | None]:
        if not self._keeps_formulas:
            return super()._new_camera(source, values)
        self._check_ranges()
        example = precise(source.intrinsics.detach())
        kind: dict[str, Any] = {"dtype": example.dtype, "device": example.device}  # as_tensor makes float32 of floats
        return self.new_camera(source, {name: torch.as_tensor(value, **kind) for name, value in values.items()})

    def extra_repr(self) -> str:
        fov = "" if self._among is None else f", fov=({self._among[0]:g}, {self._among[1]:g})"
        return f"like={REAL!r}{fov}, {super().extra_repr()}" if self._is_real else super().extra_repr()

    def _check_ranges(self) -> None:
        """Raise a ValueError if a range, which may have been set since, draws what makes no camera."""
        for name, limit in _LIMITS.items():
            size, one = limit.get("size"), self.ranges.get(name)
            if one is not None and one.size != size:
                wanted = "Range(low, high)" if size is None else f"Range(low, high, {size})"
                raise ValueError(f"{self._name}: the range {name!r} must be {wanted}; got {one!r}")
            if one is not None and name in POSITIVE and one.low <= 0:
                raise ValueError(f"{self._name}: the range {name!r} must be above 0; got {one!r}")

    def new_camera(self, source: Camera, values: Mapping[str, Tensor]) -> tuple[Camera, Tensor | None]:
        """Return the new camera and its turn, by formulas of torch; see `Augmentation.new_camera`."""
        base, sized, covered_radius = self._lens_for(source, values.get("lens"))
        height, width = size = self._size_of(source)
        wide = _as_wide(base, sized, values["fov"], width, self._name) if "fov" in values else sized
        fx, fy, cx, cy = wide.unbind(-1)
        for name in ("focal", "zoom"):
            if name in values:
                fx, fy = fx * values[name], fy * values[name]
        if "centre" in values:
            right, down = values["centre"].unbind(-1)
            cx, cy = cx + right * width, cy + down * height
        if covered_radius is not None:
            factor = covering(_joined((fx, fy, cx, cy), base.intrinsics), covered_radius, size)
            fx, fy = fx * factor, fy * factor
        distortion = base.distortion
        if "distortion" in values and distortion.shape[-1]:
            drawn_to = remade(base, intrinsics=_joined((fx, fy, cx, cy), distortion), image_size=size).detach()
            amounts = values["distortion"].to(distortion)
            distortion = jittered(drawn_to, amounts, self._nominal(base, sized, size, values))
            distortion = with_derivatives_of(base.distortion, distortion)
        if "crop" in values:  # a part of the image, enlarged to the full size
            share, (right, down) = values["crop"], values["place"].unbind(-1)
            left, top = (1 - share) * right * width, (1 - share) * down * height
            fx, fy, cx, cy = fx / share, fy / share, (cx + 0.5 - left) / share - 0.5, (cy + 0.5 - top) / share - 0.5
        intrinsics = _joined((fx, fy, cx, cy), distortion)
        target = remade(base, intrinsics=intrinsics, distortion=distortion, image_size=size)
        turns = [values[name] for name in _TURNS if name in values]
        if not turns:
            return target, None
        none = 0 * turns[0]
        angles = [torch.deg2rad(values.get(name, none)) for name in _TURNS]
        elements = mount_elements([angle.cos() for angle in angles], [angle.sin() for angle in angles])
        return target, _joined(elements, source.intrinsics).unflatten(-1, (3, 3))

    def _lens_for(self, source: Camera, share: Any) -> tuple[Camera, Tensor, Tensor | None]:
        """Return the camera whose lens new cameras have, its intrinsics (*B, 4) for their size, and any covered radius.

        share: of "real" lenses, which one. Only these have the radius (*B,): `reach` of `lenses.drawing.Lenses`.
        """
        size, like, covered_radius = self._size_of(source), self._like_for(source), None
        base = source if like is None else like
        dtype, device = torch.promote_types(source.intrinsics.dtype, torch.float32), source.intrinsics.device
        if self._is_real:
            lens = drawn(torch.as_tensor(share, dtype=dtype, device=device), size, self._among)
            base = remade(_REAL_LENS, intrinsics=lens.intrinsics, distortion=lens.distortion, image_size=size)
            covered_radius = lens.reach
        if any(t.dtype != dtype or t.device != device for t in base.tensors):
            base = base.each(lambda t: t.to(device, dtype))
        sized = _sized(base, size) if self.fov is None else precise(self._from_source(source, base, size))
        return base, sized, covered_radius

    def _from_source(self, source: Camera, base: Camera, size: tuple[int, int]) -> Tensor:
        """Return intrinsics (*B, 4) of the lens, at most as wide as its like, whose images the source fills."""

        def narrowed() -> Tensor:
            sized = _sized(base, size)
            if base.image_size is None:
                sized = _as_wide(base, sized, torch.rad2deg(field_of_view(source)[..., 0]), size[1], self._name)
            whole = remade(base, intrinsics=sized.to(base.intrinsics.dtype), image_size=size)
            return scaled(whole, zoom_to_fill(source, whole, None, 1.0)[0]).intrinsics.detach()

        key = "source", type(source), source.image_size, type(base), base.image_size, size
        return self._memo(source.tensors + base.tensors, key, narrowed)

    def _nominal(self, base: Camera, sized: Tensor, size: tuple[int, int], values: Mapping[str, Any]) -> Tensor:
        """Return intrinsics (*B, 4) without a graph, with the field of view in the middle of the range."""
        if "fov" not in values:
            return sized.detach().to(base.intrinsics.dtype)

        def made() -> Tensor:
            middle = precise(base.intrinsics).new_tensor(self.ranges["fov"].middle)
            return _as_wide(base, sized, middle, size[1], self._name).detach().to(base.intrinsics.dtype)

        return self._memo(base.tensors, ("nominal", type(base), base.image_size, size, self.ranges["fov"]), made)

    def _like_for(self, source: Camera) -> Camera | None:
        """Return `like`, on the CPU if the source is there and its numbers are known; None without `like`."""
        like: Camera | None = self.like
        if like is None or like.intrinsics.is_cpu or not source.intrinsics.is_cpu:
            return like
        return twin_of(like) or like

    def _size_of(self, source: Camera) -> tuple[int, int]:
        return self.image_size or source.size_for(self._name)


def _joined(numbers: Sequence[Tensor], example: Tensor) -> Tensor:
    """Return (*B, n) of n tensors (*B,), in the dtype of another."""
    return torch.stack(torch.broadcast_tensors(*numbers), -1).to(example.dtype)


def _sized(base: Camera, size: tuple[int, int]) -> Tensor:
    """Return intrinsics (*B, 4) in float64 of a lens before an image of another size, as wide as it was.

    The old image is scaled to the new width, and cropped or padded evenly to the new height.
    """
    if base.image_size == size:
        return precise(base.intrinsics)
    fx, fy, cx, cy = precise(base.intrinsics).unbind(-1)
    across, down = (size[1] - 1) / 2, (size[0] - 1) / 2
    if base.image_size is None:
        cx, cy = cx + across, cy + down
    else:
        height, width = base.image_size
        scale = size[1] / width
        fx, fy = fx * scale, fy * scale
        cx, cy = (cx - (width - 1) / 2) * scale + across, (cy - (height - 1) / 2) * scale + down
    return torch.stack((fx, fy, cx, cy), -1)


def _as_wide(base: Camera, sized: Tensor, fov: Tensor, width: int, owner: str) -> Tensor:
    """Return intrinsics (*B, 4) with the focal lengths by which the lens is as wide as a `fov` (*B,) in degrees."""
    half = fov * (math.pi / 360)
    sine, cosine = half.sin(), half.cos()
    rays = torch.stack([_joined((end, 0 * sine, cosine), base.intrinsics) for end in (-sine, sine)], -2)
    if base.batch_shape:
        rays = rays.expand(*broadcast_shapes(rays.shape, (*base.batch_shape, 2, 3)))
    pixels, valid = base.project(rays)
    if known_false(valid):
        raise too_wide(owner, base, float(fov.max()))
    ratio = width / (pixels[..., 1, 0] - pixels[..., 0, 0])
    focal = precise(base.intrinsics)[..., :2] * ratio.unsqueeze(-1)
    return torch.cat(torch.broadcast_tensors(focal, sized[..., 2:]), -1)
