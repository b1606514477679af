"""The camera that a calibration or a fit is asked for."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.cameras.camera import Camera, as_model
from camtorch.cameras.freezing import INTRINSICS, frozen_names
from camtorch.values.arguments import as_whole, no_camera


@dataclass(frozen=True)
class Model:
    """The camera to find."""

    kind: type[Camera]
    count: int  # of coefficients
    image_size: tuple[int, int] | None = None
    fixed: tuple[str, ...] = ()  # the names of parameters that are held
    start: Camera | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names (4 + n,) of all parameters."""
        return (*INTRINSICS, *(self.kind.names_of(self.count) or ()))

    @property
    def free(self) -> Tensor:
        """Whether parameters are free, (4 + n,) bool on the CPU."""
        return torch.tensor([name not in self.fixed for name in self.names], device="cpu")

    def camera(self, parameters: Tensor) -> Camera:
        """Return the camera of parameters (*B, 4 + n), with the same names frozen as in the camera to start from."""
        found = self.kind(*parameters.split((4, self.count) if self.count else 4, -1))
        found.image_size = self.image_size  # set later, as crops may be off centre
        frozen = () if self.start is None else frozen_names(self.start)
        if frozen:
            found.freeze(*frozen)
        return found


def asked_model(
    model: type[Camera] | str | Camera,
    count: int | None,
    start: Camera | None,
    fixed: Collection[str] | str,
    image_size: tuple[int, int] | None,
    owner: str,
) -> Model:
    """Return the camera that the arguments of `calibrate` ask for; its image size is by default that of the start."""
    if isinstance(model, Camera):
        if start is not None:
            raise ValueError(f"{owner}: start must be left out if model is a camera; got {start!r}")
        start, model = model, type_before_parametrizations(model)
    kind = as_model(model, owner)
    if start is not None:
        start = _as_start(start, kind, owner)
        own = start.distortion.shape[-1]
        if count not in (None, own):
            raise ValueError(f"{owner}: count must be that of the start, {own}; got {count}")
        count = own
    count = kind.default_count if count is None else as_whole(count, "count", owner)
    if not 0 <= count <= max(100, kind.default_count) or kind.names_of(count) is None:
        raise ValueError(f"{owner}: count must fit {kind.__name__}, {kind.counts_text()}; got {count}")
    names = Model(kind, count).names
    if not isinstance(fixed, Collection) or isinstance(fixed, Mapping):
        raise TypeError(f'{owner}: fixed must be names of parameters, as ("cx", "cy"), or "all"; got {fixed!r}')
    if isinstance(fixed, str):
        fixed = names if fixed == "all" else (fixed,)
    unknown = [name for name in fixed if name not in names]
    if unknown:
        raise ValueError(f"{owner}: fixed must name parameters of {kind.__name__}, {', '.join(names)}; got {unknown}")
    if start is None and {"fx", "fy"} & set(fixed):
        raise ValueError(f"{owner}: start must be a camera if fx or fy is fixed; got None")
    held = [*fixed, *(() if start is None else frozen_names(start))]
    if start is not None and kind.smoothness() is not None:
        held += INTRINSICS
    if image_size is None and start is not None:
        image_size = start.image_size
    return Model(kind, count, image_size, tuple(held), start)


def _as_start(start: Camera, kind: type[Camera], owner: str) -> Camera:
    """Return a camera to start from; surfaces take any, and convert it."""
    if not isinstance(start, Camera):
        raise TypeError(f"{owner}: start must be a camera; got {no_camera(start)}")
    is_other = type_before_parametrizations(start) is not kind
    if is_other and kind.smoothness() is not None and not start.batch_shape:
        return start.convert(kind).camera
    if is_other or start.batch_shape.numel() != 1:
        raise ValueError(
            f"{owner}: start must be one {kind.__name__}, as start.convert({kind.__name__}).camera is; got "
            f"{type(start).__name__} with batch_shape={tuple(start.batch_shape)}"
        )
    return start
