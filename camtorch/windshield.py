"""Windshields: maps of rays that learn, and the cameras behind them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, cast

import torch
from torch import Tensor
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch._arguments import (
    Numbers,
    as_batch,
    as_real,
    as_rows,
    broadcast_shapes,
    check_devices,
    columns,
    is_list,
    shown,
)
from camtorch._module import BatchedModule, typed_as
from camtorch.optics import Before, Bending, Chart, Lens
from camtorch.optics.charts import Planes3
from camtorch.optics.ray_maps import order_of, powers

if TYPE_CHECKING:
    from camtorch.camera import Camera

CameraT = TypeVar("CameraT", bound="Camera")


class Windshield(BatchedModule):
    """What a windshield does to the rays of a camera behind it: `camera.behind(shield)` is the camera of both.

    Of a ray the angles phi = asin(x) and theta = asin(y), of its unit vector, become P(phi, theta) and Q(phi, theta),
    and it goes on along (sin phi, sin theta, sqrt(1 - sin^2 phi - sin^2 theta)). The model is one of rays ahead of the
    camera; one behind it stays behind. Source: `BivariateWindshieldModel` of NVIDIA's nvidia-ncore.

    Args:
        horizontal: (*B, n) coefficients of P: those of 1, phi, phi^2, ..., phi^N, then theta (1, phi, ..., phi^(N-1)),
            and so on to theta^N; n = (N + 1)(N + 2) / 2 is 1, 3, 6, 10, 15, 21, ... (0, 1, 0) changes nothing.
        vertical: (*B, m) those of Q, in the same order; its N may be another. (0, 0, 1) changes nothing.

    Plain values become new Parameters; a tensor that requires grad is kept as it is.

    Raises:
        ValueError: another number of coefficients, batch dims that do not fit, NaN or infinite values.
        TypeError: values that are not numbers.
    """

    tensor_names: ClassVar[tuple[str, ...]] = ("horizontal", "vertical")
    horizontal: Tensor
    vertical: Tensor

    def __init__(self, horizontal: Numbers, vertical: Numbers):
        super().__init__()
        given = {"horizontal": as_real(horizontal, "horizontal", "Windshield")}
        given["vertical"] = as_real(vertical, "vertical", "Windshield")
        for name, values in given.items():
            is_column = values.ndim > 1 and values.shape[-1] == 1
            if values.ndim == 0 or is_column or order_of(values.shape[-1]) is None:
                hint = f". A column goes in as {name}[..., 0]" if is_column else ""
                raise ValueError(
                    f"Windshield: {name} must be (*B, n) with n = (N + 1)(N + 2) / 2 coefficients of a polynomial of "
                    f"order N, 1, 3, 6, 10, 15, 21, ...; got shape {tuple(values.shape)}{hint}"
                )
        check_devices("Windshield", **given)
        batch = as_batch("Windshield", **{name: values.shape for name, values in given.items()})
        for name, values in given.items():
            self.hold(name, values, (*batch, values.shape[-1]))

    @property
    def batch_shape(self) -> torch.Size:
        """*B, the batch dims of the coefficients."""
        return broadcast_shapes(self.horizontal.shape[:-1], self.vertical.shape[:-1])

    def forward(self, rays: Numbers) -> Tensor:
        """Rays as the camera behind sees them.

        Args:
            rays: (*B, *N, 3), of any length.

        Returns:
            Unit rays of the same shape, finite always. What is valid says `camera.behind(shield)`; what is no direction
            becomes (0, 0, 1), without a gradient.
        """
        return self._mapped(rays, Bending.__call__)

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def inverse(self, rays: Numbers) -> Tensor:
        """Rays in front of the windshield of those behind it; see `forward`.

        By Newton's method, from the ray itself. Derivatives are those of the implicit function theorem, up to the
        second. A ray that none becomes has some finite one.
        """
        return self._mapped(rays, Bending.inverse)

    def _mapped(self, rays: Numbers, way: Callable[..., Planes3]) -> Tensor:
        parameters = self.horizontal, self.vertical
        rows, lead, restore = as_rows(rays, "rays", 3, self.batch_shape, parameters, "Windshield")
        coefficients = (t.to(rows.dtype).expand(*lead, t.shape[-1]).reshape(-1, t.shape[-1]) for t in parameters)
        x, y, z = rows.unbind(-1)
        size = rows.detach().abs().amax(-1)
        known = (size > torch.finfo(rows.dtype).tiny) & (size < torch.inf)
        scale = 1 / torch.where(known, size, 1.0)
        planes = (torch.where(known, w * scale, axis) for w, axis in ((x, 0.0), (y, 0.0), (z, 1.0)))
        found = way(Bending(*map(columns, coefficients)), *planes)
        return restore(
            torch.stack([torch.where(known, w, axis) for w, axis in zip(found, (0.0, 0.0, 1.0), strict=True)])
        )


_models: dict[tuple[type[Camera], int, int], type[Camera]] = {}


def model_behind(model: type[CameraT], counts: Sequence[int]) -> type[CameraT]:
    """The model of cameras behind a windshield of so many coefficients, which follow theirs: h0 h1 ... v0 v1 ..."""
    if not is_list(counts) or len(counts) != 2 or any(not isinstance(n, int) or order_of(n) is None for n in counts):
        raise ValueError(
            f"{model.__name__}: windshield must be two of the counts 1, 3, 6, 10, 15, 21, ...; got {shown(counts)}"
        )
    across, down = counts
    found = _models.get((model, across, down))
    if found is not None:
        return cast("type[CameraT]", found)
    of_shield = [("h", i, *ij) for i, ij in enumerate(powers(order_of(across) or 0))]
    of_shield += [("v", i, *ij) for i, ij in enumerate(powers(order_of(down) or 0))]
    names, added = tuple(f"{letter}{n}" for letter, n, _, _ in of_shield), across + down
    ideals = tuple(float((letter, i, j) in (("h", 1, 0), ("v", 0, 1))) for letter, _, i, j in of_shield)
    # mirrored, the angle across changes its sign, before and after
    odd_in_x = {f"{letter}{n}" for letter, n, i, _ in of_shield if (i % 2 == 1) != (letter == "h")}
    odd_in_y = {f"{letter}{n}" for letter, n, _, j in of_shield if (j % 2 == 1) != (letter == "v")}
    place = {(letter, i, j): f"{letter}{n}" for letter, n, i, j in of_shield}
    turned = None
    if model.quarter_turn is not None and across == down:
        signs = {(letter, i): "-" if (i % 2 == 0) == (letter == "h") else "" for letter, _, i, _ in of_shield}
        turned = {f"{k}{n}": signs[k, i] + place["v" if k == "h" else "h", j, i] for k, n, i, j in of_shield}

    # of which models without distortion have one of their own
    general: Any = next(cls for cls in reversed(model.__mro__) if "optics" in vars(cls))

    class Behind(model):  # type: ignore[misc, valid-type]
        __qualname__ = f"{model.__qualname__}BehindWindshield{across}x{down}"
        configuration = MappingProxyType({"windshield": (across, down)})
        __init__ = general.__init__
        distortion_names = (*model.distortion_names, *names)
        default_count = model.default_count + added
        fit_counts = tuple(count + added for count in model.fit_counts)
        special_cases = ((model.key, model.names_of(model.default_count) or ()), *model.special_cases)
        quarter_turn = None if turned is None else MappingProxyType({**(model.quarter_turn or {}), **turned})

        @classmethod
        def names_of(cls, count: int) -> tuple[str, ...] | None:
            own = model.names_of(count - added) if count >= added else None
            return None if own is None else (*own, *names)

        @classmethod
        def counts_text(cls) -> str:
            return f"{added} coefficients of the windshield ({names[0]} ... {names[-1]}) after {model.counts_text()}"

        @classmethod
        def ideal(cls, count: int) -> tuple[float, ...]:
            return (*model.ideal(count - added), *ideals)

        @staticmethod
        def defined(k: Sequence[Tensor]) -> Tensor | None:
            return model.defined(k[:-added]) if len(k) > added else None

        @staticmethod
        def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
            chart, lens = model.optics(k[:-added])
            return Before(Bending(k[-added : len(k) - down], k[len(k) - down :]), chart), lens

        @classmethod
        def fit_start(cls, names: tuple[str, ...], angles: Tensor, radii: Tensor) -> Tensor:
            own = model.fit_start(names[:-added], angles, radii)
            return torch.cat((own, own.new_tensor(ideals).expand(*own.shape[:-1], added)), -1)

    Behind.__name__ = f"{model.__name__}BehindWindshield"
    Behind.odd_in_x, Behind.odd_in_y = model.odd_in_x | odd_in_x, model.odd_in_y | odd_in_y
    Behind.key = f"{model.key} behind a windshield"  # for messages; MODELS has no such
    made: type[CameraT] = Behind
    _models[model, across, down] = made
    return made


def behind(camera: CameraT, shield: Windshield) -> CameraT:
    """See `Camera.behind`."""
    owner = f"{type(camera).__name__}.behind"
    if not isinstance(shield, Windshield):
        raise TypeError(f"{owner}: takes a ct.Windshield; got {shown(shield)}")
    model: type[CameraT] = type_before_parametrizations(camera)
    if camera.is_mixed or "windshield" in model.configuration:
        why = "a Mixed has cameras that can be" if camera.is_mixed else "the camera is behind one already"
        raise TypeError(f"{owner}: {why}")
    tensors = camera.distortion, shield.horizontal, shield.vertical
    check_devices(owner, camera=camera.intrinsics, shield=shield.horizontal)
    batch = as_batch(owner, camera=(*camera.batch_shape, 4), shield=(*shield.batch_shape, 1))
    dtype = torch.promote_types(camera.intrinsics.dtype, shield.horizontal.dtype)
    shared = batch if shield.batch_shape or camera.distortion.ndim > 1 else ()
    distortion = torch.cat([t.to(dtype).expand(*shared, t.shape[-1]) for t in tensors], -1)
    kind = model_behind(model, (shield.horizontal.shape[-1], shield.vertical.shape[-1]))
    made: CameraT = kind(camera.intrinsics, distortion, image_size=camera.image_size)
    return made.freeze_like(camera, shield)
