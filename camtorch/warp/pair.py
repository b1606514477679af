"""Two cameras at one place, and what the way of images and points from one to the other follows from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from typing_extensions import Self

from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import is_unknown
from camtorch.values.arguments import Numbers, broadcast_shapes
from camtorch.values.module import GeometryModule
from camtorch.warp.grid import Lattice, Sampling, locate
from camtorch.warp.moving import moved_pixels
from camtorch.warp.panorama import Seam, seam_of
from camtorch.warp.sampling import Mode, Options, PaddingMode

_SINGLE = 1e-3  # pixels: some ulps of a position in an image a thousand pixels wide, computed in float32


def _part(held: str, name: str) -> Any:
    """Return a property of a module's part, read from its usual dict; `nn.Module.__getattr__` looks in all."""

    def part(module: nn.Module) -> Any:
        parts = module.__dict__[held]
        return parts[name] if name in parts else nn.Module.__getattr__(module, name)

    return property(part)


class Plan:
    """The positions of a warp while its cameras stay, or once and for all, and calls that are ready for some images."""

    def __init__(self, pinned: Sampling | Lattice | None = None, padding: str = "zeros"):
        """Keep positions by the padding that they serve; `pinned` ones stay if the cameras change."""
        self.is_pinned, self.positions, self.calls = pinned is not None, Kept(6), Kept(8)
        self._exact: Sampling | None = None
        if pinned is not None:
            self.positions_for(padding, lambda: pinned)
            self._exact = pinned if isinstance(pinned, Sampling) else None

    def positions_for(self, padding: str, compute: Callable[[], Sampling | Lattice]) -> Sampling | Lattice:
        """Return `compute()` without a graph, or what is kept; pinned positions that are exact serve all paddings."""
        return self.positions((), (padding,), compute) if self._exact is None else self._exact


class CameraPair(GeometryModule):
    """The state of a `Warp`: source, target, rotation and options; and where target pixels lie."""

    is_an_operator: ClassVar[bool] = True  # compiled code may call it as one, as cameras and rotation are all of it
    batch_shape: torch.Size
    padding_mode: PaddingMode
    _tolerance: float | None
    mode: Mode
    fill: tuple[float, ...]
    _kept: Kept
    _host: Kept | None = None
    source: Camera = _part("_modules", "source")
    target: Camera = _part("_modules", "target")
    rotation: Tensor | None = _part("_buffers", "rotation")
    antialias: bool

    def _set(self, source: Camera, target: Camera, options: Options, batch: torch.Size | None = None) -> None:
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

    def turned_by(self, rotation: Tensor | None) -> Self:
        """Give this warp, made without one, a rotation that is not checked, (3, 3) or (B, 3, 3); return the warp."""
        self.put("rotation", rotation, persistent=rotation is not None and not rotation.requires_grad)
        if rotation is not None and rotation.shape[:-2] != self.batch_shape:
            self.batch_shape = broadcast_shapes(self.batch_shape, rotation.shape[:-2])
        return self

    @property
    def is_pinned(self) -> bool:
        """Whether positions stay whatever becomes of the cameras."""
        plan: Plan | None = self._kept.result
        return plan is not None and plan.is_pinned

    @property
    def host(self) -> Self | None:
        """The same warp on the CPU, where this one is on another device and was made from it."""
        host = None if is_unknown(self.target.intrinsics) else self._host
        entry = None if host is None else host.entry(self._inputs(), ())
        return None if entry is None else entry[2]

    def follow_host(self, host: CameraPair) -> Self:
        """Have a warp like this one, on the CPU, find the positions while the cameras stay; return this warp."""
        if not self.target.intrinsics.is_cpu:
            self._host = Kept()
            self._host(self._inputs(), (), lambda: host)
        return self

    @property
    def _options(self) -> tuple[object, ...]:
        """All that positions depend on in addition to `_inputs`."""
        source, target = self._ends
        return source.form, target.form, self.rotation is None, self.antialias, self._tolerance

    @property
    def tolerance(self) -> float:
        """Pixels of the source by which sampling positions may be off."""
        if self._tolerance is not None:
            return self._tolerance
        single = all(camera.intrinsics.dtype == torch.float32 for camera in (self.source, self.target))
        return _SINGLE if single else 0.0

    def _inputs(self) -> list[Tensor]:
        """Return all tensors that positions depend on."""
        (source, target), rotation = self._ends, self.rotation
        found = [*source.tensors, *target.tensors]
        return found if rotation is None else [*found, rotation]

    def _locate(self, rows: range, padding: PaddingMode, tolerance: float) -> Sampling | Lattice:
        """Return positions of some rows of the target, which serve a padding, within a tolerance."""
        return locate(self._sampled, self._ends[1], self.rotation, tolerance, self.antialias, rows, padding)

    @property
    def _ends(self) -> tuple[Camera, Camera]:
        """Source and target, by which positions are found."""
        return self.source, self.target

    @property
    def _seam(self) -> Seam | None:
        """By how much the source's images become longer before they are sampled."""
        return seam_of(self._ends[0])

    @property
    def _sampled(self) -> Camera:
        """The source, of these images."""
        source, seam = self._ends[0], self._seam
        return source if seam is None else seam.before(source)

    def _move(self, pixels: Numbers, back: bool = False, on_image: bool = False) -> tuple[Tensor, Tensor]:
        """Return pixels of the source on the target's image, or back, and whether there is one; see `moved_pixels`."""
        (source, target), rotation = self._ends, self.rotation
        if back:
            source, target, rotation = target, source, None if rotation is None else rotation.mT
        return moved_pixels(source, target, rotation, pixels, on_image)
