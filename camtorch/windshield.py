"""Windshields: maps of rays that learn, and the cameras behind them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

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
    shown,
)
from camtorch._derived import CameraT, behind_windshield
from camtorch._module import BatchedModule, typed_as
from camtorch.optics import Bending
from camtorch.optics.charts import Planes3
from camtorch.optics.ray_maps import order_of


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

    def extra_repr(self) -> str:
        """The coefficients of one, and how many there are of a batch."""
        if self.batch_shape:
            return f"batch_shape={tuple(self.batch_shape)}"
        return ", ".join(
            f"{name}={[float(f'{x:.6g}') for x in getattr(self, name).tolist()]}" for name in self.tensor_names
        )

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


def behind(camera: CameraT, shield: Windshield) -> CameraT:
    """See `Camera.behind`."""
    owner = f"{type(camera).__name__}.behind"
    if not isinstance(shield, Windshield):
        raise TypeError(f"{owner}: takes a ct.Windshield; got {shown(shield)}")
    model: type[CameraT] = type_before_parametrizations(camera)
    if camera.is_mixed or ":windshield=" in model.key:
        why = "a Mixed has cameras that can be" if camera.is_mixed else "the camera is behind one already"
        raise TypeError(f"{owner}: {why}")
    tensors = camera.distortion, shield.horizontal, shield.vertical
    check_devices(owner, camera=camera.intrinsics, shield=shield.horizontal)
    batch = as_batch(owner, camera=(*camera.batch_shape, 4), shield=(*shield.batch_shape, 1))
    dtype = torch.promote_types(camera.intrinsics.dtype, shield.horizontal.dtype)
    shared = batch if shield.batch_shape or camera.distortion.ndim > 1 else ()
    distortion = torch.cat([t.to(dtype).expand(*shared, t.shape[-1]) for t in tensors], -1)
    kind = behind_windshield(model, shield.horizontal.shape[-1], shield.vertical.shape[-1])
    made: CameraT = kind(camera.intrinsics, distortion, image_size=camera.image_size)
    return made.freeze_like(camera, shield)
