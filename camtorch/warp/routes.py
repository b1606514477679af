"""What every warp holds, and how it finds the positions at which its images are sampled.

Which way a warp goes is decided in four places, after `ready` has asked for a kept call, and a `HalvingWarp` whether
images are copied, resized or halved:

1. `RoutedWarp.route`: kept positions, those of a graph, strips, or an operator of a compiled graph.
2. `RoutedWarp.computed`: positions to keep are found by the same warp on the CPU, by an operator, or by `locate`.
3. `locate` in `grid.py`: a lattice, or exact positions.
4. `prepared` in `sampling.py`: native code, or torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor, nn

from camtorch.cameras.camera import Camera
from camtorch.evaluate.door import (
    in_graph,
    in_jit_trace,
    in_transform,
    is_constant,
    is_eager,
    is_for_here,
    keeps_graph,
    outside_inference,
    records_constants,
    set_aside,
)
from camtorch.evaluate.export import with_values
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import is_unknown
from camtorch.native.sampler import NativeJob, maker
from camtorch.projection.evaluation import native_forms
from camtorch.projection.native_cameras import Native
from camtorch.values.arguments import Numbers, broadcast_shapes
from camtorch.values.module import GeometryModule
from camtorch.warp import compiled
from camtorch.warp.camera_pair import CameraPair
from camtorch.warp.grid import local_scale, locate
from camtorch.warp.lattice import PixelPositions, Positions
from camtorch.warp.options import Mode, Options, PaddingMode, Sampler, as_options, serving_all
from camtorch.warp.panorama import Seam, seam_of
from camtorch.warp.sampling import Pyramid, by_torch, laid_as, prepared, render

Route = Literal["operator", "strips", "graph", "kept"]
_MOST_KEPT_PIXELS = 1 << 25  # of a grid; longer ones, of 256 MB in float32, are made by strips and not kept
_STRIP_PIXELS = 1 << 21  # of such a strip
_CHECKED = frozenset({"mode", "padding_mode", "fill", "antialias"})  # attributes that may be set later
_MOST_CALLS = 8  # forms of images for which a call is kept
_FLOAT32_TOLERANCE = 1e-3  # pixels: some ulps of a position in an image a thousand pixels wide


def _held_in(usual: str, name: str) -> Any:
    """Return a property for what a module holds in its `usual` dict; `nn.Module.__getattr__` looks in all of them."""

    def held(module: nn.Module) -> Any:
        values = module.__dict__[usual]
        return values[name] if name in values else nn.Module.__getattr__(module, name)

    return property(held)


class KeptPositions:
    """The positions of a warp's pixels while its cameras stay, or once and for all, and calls that sample there."""

    def __init__(self, pinned: Positions | None = None, paddings: Sequence[PaddingMode] = ()):
        """Keep positions by the padding that they serve; `pinned` ones, of these `paddings`, stay if cameras change."""
        self.is_pinned = pinned is not None
        self.calls: dict[tuple[object, ...], NativeJob] = {}
        self.halvings: list[int] | None = None  # how often a `HalvingWarp` halves the image of each camera, once asked
        self._found: dict[str, Positions] = {} if pinned is None else dict.fromkeys(paddings, pinned)

    def serving(self, padding: str, compute: Callable[[], Positions]) -> Positions:
        """Return `compute()` without a graph, or what is kept for a padding."""
        found = self._found.get(padding)
        if found is None:
            if in_transform():  # a transform's tensors die with it
                return compute()
            with outside_inference(), torch.no_grad():
                found = self._found[padding] = compute()
        return found

    def keep(self, call: NativeJob, form: tuple[object, ...], where: Positions) -> None:
        """Keep the call for images of a form if its positions are kept."""
        if any(where is each for each in self._found.values()):
            if len(self.calls) >= _MOST_CALLS:
                self.calls.clear()
            self.calls[form] = call


class RoutedWarp(GeometryModule):
    """The state of a `Warp`: source, target, rotation and options; and the routes to the positions of its pixels.

    Packages ask every kind of warp by its public names and by these. A `LazyWarp` has those with a star, and `target`,
    `rotation`, `image_size` and `options`.

    * `moves_by_cameras` *: both cameras and the rotation are all that native code and operators need. Not of an
      `AffineWarp`, `PlaneWarp`, `ShiftedWarp` or `ShutterWarp`, which have their own of some of the names below.
    * `may_mirror` *: the rotation may be a mirror, as that of a `HalvingWarp` and of the kinds derived from it.
    * `natives` *: source and target for native code, or None. `new_target` *: a copy of the target.
    * `tensors`: all that positions depend on. `locate`: positions of rows. `move`: pixels there and back. All three are
      of its own for an `AffineWarp`, a `PlaneWarp` and a `ShiftedWarp`.
    * `pair`: the cameras by which pixels move; those of a `ShutterWarp` are behind their shutters.
    * `seam`: how images of a whole turn are lengthened; None for an `AffineWarp` and a `ShiftedWarp`.
    * `transform_positions` *, `moved_distance`, `moved_depth`: points in space, and images of distances and depths, as
      the target sees them. A `ShiftedWarp` moves them by its shift, an `AffineWarp` keeps depths, and a `PlaneWarp`
      raises an error, as it knows the depth of its plane alone.
    * `own_parts`, `between`: what a kind is made of besides cameras, rotation and options, and a new one of all that.
      `detach`, `inverse` and `made_like` need both. Kinds without parts have none of their own.

    A `CropsWarp` passes all that it is asked for images and labels on to a warp of B * F rows.
    """

    moves_by_cameras: ClassVar[bool] = True
    may_mirror: ClassVar[bool] = False
    source: Camera = _held_in("_modules", "source")
    target: Camera = _held_in("_modules", "target")
    rotation: Tensor | None = _held_in("_buffers", "rotation")
    batch_shape: torch.Size
    mode: Mode
    padding_mode: PaddingMode
    fill: tuple[float, ...]
    antialias: bool | None
    _tolerance: float | None
    _kept: Kept
    _host: Kept | None = None

    def set_up(self, source: Camera, target: Camera, options: Options, batch: torch.Size | None = None) -> None:
        """Give a new warp its cameras and options, which are valid."""
        if batch is None:
            batch = broadcast_shapes(source.batch_shape, target.batch_shape)
        super().__init__(
            {"source": source, "target": target},
            batch_shape=batch,
            mode=options["mode"],
            padding_mode=options["padding_mode"],
            fill=options["fill"],
            antialias=options["antialias"],
            _tolerance=options["tolerance"],
            _kept=Kept(),
        )
        seam_of(source)  # while its values may be looked at: traced code asks for it too

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _CHECKED:
            value = as_options("Warp", **{name: value})[name]  # type: ignore[literal-required]
        super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        """Return the names that users call, without those by which packages and other kinds of warps ask this one."""
        inside = {*vars(RoutedWarp), *dir(GeometryModule)}
        inside |= {"own_parts", "transform_positions", "moved_distance", "moved_depth"}
        inside -= {"source", "target", "rotation", "tolerance", *dir(nn.Module)}
        names: list[str] = super().__dir__()  # type: ignore[no-untyped-call]
        return [name for name in names if name not in inside]

    @classmethod
    def of_valid(cls, source: Camera, target: Camera, options: Options) -> Self:
        """Return a warp, without a rotation yet, of valid cameras and options."""
        warp = cls.__new__(cls)
        warp.set_up(source, target, options)
        return warp

    def turned_by(self, rotation: Tensor | None) -> Self:
        """Give this warp, made without one, a rotation that is not checked, (3, 3) or (B, 3, 3); return the warp."""
        self.put("rotation", rotation, persistent=rotation is not None and not rotation.requires_grad)
        if rotation is not None and rotation.shape[:-2] != self.batch_shape:
            self.batch_shape = broadcast_shapes(self.batch_shape, rotation.shape[:-2])
        return self

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) of the images to make."""
        return self.target.size_for("Warp")

    @property
    def is_pinned(self) -> bool:
        """Whether positions stay whatever becomes of the cameras."""
        known: KeptPositions | None = self._kept.result
        return known is not None and known.is_pinned

    @property
    def host(self) -> Self | None:
        """The same warp on the CPU, where this one is on another device and was made from it."""
        host = self._host
        if host is None or is_unknown(self.target.intrinsics):
            return None
        warp: Self | None = host.get(self.tensors, ())
        return warp

    def follow_host(self, host: RoutedWarp) -> Self:
        """Have a warp like this one, on the CPU, find the positions while the cameras stay; return this warp."""
        if not self.target.intrinsics.is_cpu:
            self._host = Kept()
            self._host(self.tensors, (), lambda: host)
        return self

    @property
    def tolerance(self) -> float:
        """Pixels of the source by which sampling positions may be off."""
        if self._tolerance is not None:
            return self._tolerance
        single = self.source.intrinsics.dtype == self.target.intrinsics.dtype == torch.float32
        return _FLOAT32_TOLERANCE if single else 0.0

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors that positions depend on."""
        source, target, rotation = self.pair
        return [*source.tensors, *target.tensors, *(() if rotation is None else (rotation,))]

    @property
    def form(self) -> tuple[object, ...]:
        """All that positions depend on in addition to `tensors`."""
        source, target, rotation = self.pair
        return source.form, target.form, rotation is None, self.antialias, self._tolerance

    @property
    def pair(self) -> CameraPair:
        """Source, target and rotation by which pixels move: cameras that have shutters are behind them."""
        modules: Any = self._modules
        return CameraPair(modules["source"], modules["target"], self.rotation)

    @property
    def seam(self) -> Seam | None:
        """The `Seam` that lengthens the source's images before they are sampled; None if they stay."""
        return seam_of(self.pair.source)

    @property
    def sampled(self) -> CameraPair:
        """The `pair` whose source is the camera of the images that are sampled, which `seam` may have lengthened."""
        pair, seam = self.pair, self.seam
        return pair if seam is None else pair._replace(source=seam.camera_of(pair.source))

    @property
    def natives(self) -> tuple[Native, Native] | None:
        """Source and target for native code; None if the warp, also by its rotation, has to go step by step."""
        pair = self.pair
        if not self.moves_by_cameras or self.is_pinned or pair.goes_round:
            return None
        source, target, rotation = pair
        made = native_forms((source, target), target.intrinsics, *(() if rotation is None else (rotation,)))
        return None if made is None else (made[0][0], made[0][1])

    def new_target(self, batch: tuple[int, ...]) -> Camera:
        """Return a copy of the target, of batch dims (B,) or, of one camera, of none."""
        target = self.target
        if target.batch_shape and not batch:
            return target[0].clone()
        return target.expand(*batch).clone()

    def locate(self, rows: range, padding: PaddingMode, tolerance: float) -> Positions:
        """Return positions of some rows of the target, which serve a padding, within a tolerance."""
        return locate(self.sampled, rows, tolerance, padding, bool(self.antialias))

    def move(self, pixels: Numbers, back: bool = False, on_image: bool = False) -> tuple[Tensor, Tensor]:
        """Return pixels of the source on the target's image, or back, and their validity; see `CameraPair.move`."""
        pair = self.pair
        return (pair.back if back else pair).move(pixels, on_image)

    def route(self, images: Tensor | None = None) -> Route:
        """Return the route of images, or of positions alone; `locate` and `render` choose the lattice and the sampler.

        * "operator": a compiled graph calls one operator, and traces nothing of it;
        * "strips": the grid would be too long for memory, and is made part by part;
        * "graph": something learns, so that positions are computed anew with their graph;
        * "kept": positions without a graph, pinned or kept until an input changes.
        """
        is_pinned = self.is_pinned
        learns = not is_pinned and keeps_graph(*self.tensors)
        if learns and (images is None or images.dtype.is_floating_point):
            return "graph"
        if torch.compiler.is_compiling():  # sizes that a program leaves open would be bounded in it by a comparison
            return "operator" if images is not None and self.goes_by_operator(images) else "kept"
        if is_pinned or math.prod((*self.batch_shape, *self.image_size)) <= _MOST_KEPT_PIXELS:
            return "kept"
        looks = all(t.is_cpu and not is_unknown(t) for t in self.tensors)
        return "strips" if looks and (images is None or not in_graph(images)) else "kept"

    def goes_by_operator(self, *images: Tensor) -> bool:
        """Whether a compiled graph calls this warp, or its positions, as an operator, which is traced no further.

        It does for cameras of one model each, on the CPU, if nothing learns.
        """
        if not (is_for_here() and self.moves_by_cameras) or self.source.is_mixed or self.target.is_mixed:
            return False
        inputs = *images, *self.tensors
        return all(t.is_cpu for t in inputs) and not keeps_graph(*inputs)

    def ready(self, images: object, mode: str | None, padding: str | None) -> NativeJob | None:
        """Return the call that an earlier one has left for images of this form, if nothing has changed since."""
        known: KeptPositions | None = self._kept.result
        if known is None or not known.calls or not isinstance(images, Tensor):
            return None
        mode = self.mode if mode is None else mode
        padding = self.padding_mode if padding is None else padding
        tensors = self.tensors
        if not is_eager(images, *tensors) or images.requires_grad:
            return None
        call = known.calls.get(self._form_of(images, mode, padding))
        if call is None or known.is_pinned:
            return call
        learns = images.dtype.is_floating_point and keeps_graph(*tensors)
        return None if learns or self._kept.get(tensors, self.form) is None else call

    def _form_of(self, images: Tensor, mode: str, padding: str) -> tuple[object, ...]:
        return images.shape, images.stride(), images.dtype, mode, padding, self.fill

    def warped(self, images: Tensor, sampler: Sampler, route: Route | None = None) -> Tensor:
        """Return the warped images (B, C, H', W') of checked images (B, C, H, W), whose route may be known."""
        route = route or self.route(images)
        if route == "strips":
            cameras = math.prod(self.batch_shape)
            result = maker(images, len(images) if cameras == 1 else cameras, self.image_size)()
            for rows, strip, _ in self.in_strips(images, sampler):
                result[:, :, rows] = strip
            return result
        sampled = self.lengthened(images)
        if route == "operator":
            padding = serving_all(self.padding_mode, sampler.padding_mode)
            return compiled.warped(sampled, self.sampled, self.tolerance, self.antialias, padding, sampler)
        earlier: KeptPositions | None = self._kept.result  # None in the first call, the only one of most warps
        where = self.positions(route, sampler.padding_mode)
        call = prepared(sampled, where, sampler)
        if call is None:
            return by_torch(sampled, where, sampler)
        if earlier is not None and sampled is images and sampler.fill == self.fill:
            earlier.keep(call, self._form_of(images, sampler.mode, sampler.padding_mode), where)
        return call(sampled)

    def lengthened(self, images: Tensor) -> Tensor:
        """Return the images that are sampled: those of a whole turn go on beyond their edges."""
        seam = self.seam
        return images if seam is None else laid_as(images, seam.around(images))

    def positions(self, route: Route, padding: PaddingMode = "zeros") -> Positions:
        """Return the positions at which target pixels sample the source's image: kept ones unless they have a graph."""
        served, tolerance = serving_all(self.padding_mode, padding), self.tolerance
        if route == "graph":
            if in_jit_trace():
                raise RuntimeError(
                    "Warp: cameras must not learn in torch.jit.trace and torch.onnx.export(dynamo=False); got some "
                    "that do. Use torch.onnx.export(dynamo=True) or torch.export; or make the map a constant by "
                    "warp.requires_grad_(False)"
                )
            return self.locate(range(self.image_size[0]), served, tolerance)
        if records_constants() and (self.is_pinned or is_constant(self)):
            return self._constant(padding)
        if in_jit_trace():
            with set_aside():  # constants of the trace
                return self.positions(route, padding).pixels
        # exact positions serve every padding, so one entry is enough
        served = served if tolerance else "zeros"
        return self._positions().serving(served, partial(self.computed, served, tolerance))

    def _positions(self) -> KeptPositions:
        """Return the positions that are pinned, or those of the cameras as they are."""
        known: KeptPositions | None = self._kept.result
        if known is not None and known.is_pinned:
            return known
        return self._kept(self.tensors, self.form, KeptPositions)

    def by_pixel(self) -> PixelPositions:
        """Return the positions of all pixels, one by one."""
        return self.positions(self.route()).pixels

    def computed(self, padding: PaddingMode, tolerance: float) -> Positions:
        """Return the positions of all pixels, without a graph, which serve a padding within a tolerance."""
        host = self.host if tolerance and not self.antialias else None
        if host is not None:
            return host.positions("kept", padding).on(self.target.intrinsics.device)
        if tolerance and self.goes_by_operator():
            sampled = self.sampled
            planes, mapped = compiled.positions(*sampled, tolerance, padding)
            grid = planes.movedim(1, -1)
            scale = local_scale(grid, mapped, sampled.source) if self.antialias else None
            return PixelPositions(grid, mapped, scale)
        return self.locate(range(self.image_size[0]), padding, tolerance)

    def strip_positions(
        self, padding: PaddingMode = "zeros", count: int | None = None
    ) -> Iterator[tuple[slice, Positions]]:
        """Yield rows of the target, `count` at a time, and their positions on the source's image."""
        height, width = self.image_size
        if count is None:
            pixels_of_row = max(math.prod(self.batch_shape), 1) * width
            count = max(_STRIP_PIXELS // pixels_of_row, 1)
        for top in range(0, height, count):
            rows = range(top, min(top + count, height))
            with torch.no_grad():
                where = self.locate(rows, serving_all(self.padding_mode, padding), self.tolerance)
            yield slice(rows.start, rows.stop), where

    def in_strips(
        self, images: Tensor, sampler: Sampler, count: int | None = None
    ) -> Iterator[tuple[slice, Tensor, Positions]]:
        """Yield rows of the target, `count` at a time, images of them, and their positions."""
        pyramids: dict[int, Pyramid] = {}
        images = self.lengthened(images)
        for rows, where in self.strip_positions(sampler.padding_mode, count):
            with torch.no_grad():
                strip = render(images, where, sampler, pyramids)
            yield rows, strip, where

    def on_image(self, where: Positions) -> Tensor:
        """Whether the source maps pixels onto its image, (B or 1, 1, h, W')."""
        grid, source = where.pixels.grid.detach(), self.sampled.source
        pixels = (grid + 1) * grid.new_tensor(source.size_for("Warp")[::-1]) / 2 - 0.5
        return (where.pixels.mapped & source.contains(pixels)).unsqueeze(1)

    def _constant(self, padding: PaddingMode) -> Positions:
        """Return the positions, which are known, as a constant of an exported program."""

        def own() -> PixelPositions:
            where = self.positions("kept", padding).pixels
            grid, mapped = (t.detach().clone(memory_format=torch.contiguous_format) for t in where[:2])
            return where._replace(grid=grid, mapped=mapped)

        with set_aside() if self.is_pinned else with_values(self):
            return self._positions().serving(f"constant {serving_all(self.padding_mode, padding)}", own)
