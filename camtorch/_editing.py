"""The camera of an edited image: cropped, padded, scaled, flipped, turned by quarters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar, cast

import torch
from torch import Tensor

from camtorch._arguments import as_image_size, fails, values_of
from camtorch._module import learning_as, remade

if TYPE_CHECKING:
    from camtorch.camera import Camera
    from camtorch.mixed import Mixed

CameraT = TypeVar("CameraT", bound="Camera")


def quarter_turns(image_size: tuple[int, int]) -> tuple[tuple[tuple[int, int, int], tuple[int, int, int]], ...]:
    """From pixels (u, v, 1) to those of the image turned counterclockwise by 0, 1, 2 and 3 quarters: (2, 3) each."""
    bottom, right = (side - 1 for side in image_size)
    return (
        ((1, 0, 0), (0, 1, 0)),
        ((0, 1, 0), (-1, 0, right)),
        ((-1, 0, right), (0, -1, bottom)),
        ((0, -1, bottom), (1, 0, 0)),
    )


def edited_by(camera: CameraT, matrix: Sequence[Sequence[float]], size: Sequence[int]) -> CameraT:
    """The camera of an image whose pixels all move by one map (2, 3); it learns where the camera does.

    Raises:
        ValueError: a size that is not positive; and as `edited`. TypeError: a size that is not whole.
    """
    new_size = as_image_size(size, type(camera).__name__)
    if camera.is_mixed:
        return cast("Mixed", camera).by_groups(lambda group: edited_by(group, matrix, size))  # type: ignore[return-value]
    made = edited(camera, camera.intrinsics.new_tensor(matrix), new_size, turns=matrix[0][1] != 0)
    return learning_as(made, camera)


def edited(camera: CameraT, matrix: Tensor, image_size: tuple[int, int] | None, turns: bool | None = None) -> CameraT:
    """The camera of an image whose pixels move by a map each.

    Args:
        camera: of batch dims that broadcast with those of the maps.
        matrix: (*B, 2, 3), from pixels (u, v, 1) to those of the edited image: a quarter turn clockwise or none,
            flips, scales, and a shift.
        image_size: (height, width) of the edited image.
        turns: whether it is a quarter turn, where that is known without a look at values.

    Raises:
        ValueError: a quarter turn of a model that is not the same on its side.
    """
    if camera.is_mixed:
        return cast("Mixed", camera).by_groups(  # type: ignore[return-value]
            lambda group: edited(group, matrix, image_size, turns)
        )
    own = camera.intrinsics
    dtype = torch.promote_types(matrix.dtype, own.dtype)
    (a, b, left), (c, d, top) = (row.unbind(-1) for row in matrix.to(dtype).unbind(-2))
    fx, fy, cx, cy = own.to(dtype).unbind(-1)
    numbers = (
        *(a.abs() * fx + b.abs() * fy, c.abs() * fx + d.abs() * fy),
        *(a * cx + b * cy + left, c * cx + d * cy + top),
    )
    intrinsics = torch.stack(torch.broadcast_tensors(*numbers), -1).to(own.dtype)
    if turns is None:
        known = values_of(b)
        turns = known is None or bool((known != 0).any())
    distortion = _edited_distortion(camera, a - b, c + d, b != 0 if turns else None)
    return remade(camera, intrinsics=intrinsics, distortion=distortion, image_size=image_size)


def _edited_distortion(camera: Camera, across: Tensor, down: Tensor, on_side: Tensor | None) -> Tensor:
    """Coefficients after a quarter turn clockwise where it is on its side, (*B,) bool, and flips by signs (*B,)."""
    k, names = camera.distortion, camera.distortion_names
    if on_side is not None:
        k = torch.where(on_side.unsqueeze(-1), _on_side(camera), k)
    for sign, odd in ((across, camera.odd_in_x), (down, camera.odd_in_y)):
        if not odd.isdisjoint(names):
            is_odd = torch.tensor([name in odd for name in names], device=k.device)
            k = torch.where(is_odd & (sign < 0).unsqueeze(-1), -k, k)
    return k.clone() if k is camera.distortion else k


def _on_side(camera: Camera) -> Tensor:
    """(*B, n): the coefficients when the image is turned clockwise by a quarter."""
    names, turned, owner = camera.distortion_names, camera.quarter_turn, type(camera).__name__
    if turned is None or not {*camera.odd_in_x, *camera.odd_in_y} <= turned.keys():
        raise ValueError(
            f"{owner}: a quarter turn of the image has no camera of this model. "
            "RandomMount(roll=...) turns the camera, and convert() gives one of another model"
        )
    if {"tau_x", "tau_y"} <= {*names}:
        tilts = camera.distortion[..., [names.index("tau_x"), names.index("tau_y")]]
        if fails((tilts == 0).any(-1)):
            raise ValueError(
                f"{owner}: a sensor tilted about both axes, tau_x, tau_y = {tilts.tolist()}, has no "
                "quarter turn: the model tilts about one after the other"
            )
    source = [turned.get(name, name) for name in names]
    index = [names.index(name.removeprefix("-")) for name in source]
    sign = camera.distortion.new_tensor([-1.0 if name.startswith("-") else 1.0 for name in source])
    return camera.distortion[..., index] * sign
