"""The camera of an edited image: cropped, padded, scaled, flipped, turned by quarters."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Self, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from camtorch.cameras.image_sizes import warn_of_exchange
from camtorch.evaluate.tensors import are_numbers, known_false, known_true
from camtorch.optics.radial_inverse import precise
from camtorch.projection.camera_like import CameraLike
from camtorch.values.arguments import as_known_size, as_whole, hinting
from camtorch.values.module import remade

CameraT = TypeVar("CameraT", bound=CameraLike)


def quarter_turns(image_size: tuple[int, int]) -> tuple[tuple[tuple[int, int, int], tuple[int, int, int]], ...]:
    """Return the maps (2, 3) from pixels (u, v, 1) to those of the image turned counterclockwise by 0 to 3 quarters."""
    bottom, right = (side - 1 for side in image_size)
    return (
        ((1, 0, 0), (0, 1, 0)),
        ((0, 1, 0), (-1, 0, right)),
        ((-1, 0, right), (0, -1, bottom)),
        ((0, -1, bottom), (1, 0, 0)),
    )


def edited(camera: CameraT, matrix: Tensor | Sequence[Sequence[float]], image_size: tuple[int, int] | None) -> CameraT:
    """Return the camera of an image whose pixels move by a `matrix` each, (*B, 2, 3): quarter turns, flips, scales.

    Without a graph it is fixed.
    """
    if camera.is_mixed:
        return cast("CameraT", cast("Any", camera).by_groups(lambda group: edited(group, matrix, image_size)))
    own, given = camera.intrinsics, [matrix] if isinstance(matrix, Tensor) else []
    xp: Any = np if are_numbers(own, camera.distortion, *given) else torch
    rows: Any = matrix
    if isinstance(matrix, Tensor):
        maps: Any = matrix.detach().double().numpy() if xp is np else precise(matrix.to(own.device))
        rows = [[maps[..., i, j] for j in range(3)] for i in range(2)]
    (a, b, left), (c, d, top) = rows
    fx, fy, cx, cy = _unstack_numbers(own, xp)
    focal = abs(a) * fx + abs(b) * fy, abs(c) * fx + abs(d) * fy
    centre = a * cx + b * cy + left, c * cx + d * cy + top
    turns = turned = b != 0
    if isinstance(matrix, Tensor):  # read where it was drawn, so as not to wait for a device
        turns = np.any(turned) if xp is np else not known_true(matrix[..., 0, 1] == 0)
    distortion = _edit_distortion(camera, a - b, c + d, turned if turns else None)
    intrinsics = _stack_numbers((*focal, *centre), own, xp)
    return remade(camera, intrinsics=intrinsics, distortion=distortion, image_size=image_size)


def _unstack_numbers(intrinsics: Tensor, xp: Any) -> Iterable[Any]:
    """Return fx, fy, cx, cy of intrinsics (*B, 4) in float64, as tensors, or as numbers and arrays."""
    if xp is torch:
        return precise(intrinsics).unbind(-1)
    return intrinsics.tolist() if intrinsics.ndim == 1 else intrinsics.detach().double().numpy().T


def _stack_numbers(numbers: Sequence[Any], like: Tensor, xp: Any) -> Tensor:
    """Return (*B, n) for n tensors (*B,), or for numbers and arrays, in the dtype of a tensor."""
    if xp is torch:
        return torch.stack(torch.broadcast_tensors(*numbers), -1).to(like.dtype)
    kind = np.float64 if like.dtype == torch.float64 else np.float32
    if {float, np.float64}.issuperset(map(type, numbers)):
        return torch.from_numpy(np.array(numbers, kind))
    return torch.from_numpy(np.stack(np.broadcast_arrays(*numbers), -1).astype(kind, copy=False))


def _edit_distortion(camera: CameraLike, across: Any, down: Any, on_side: Any) -> Tensor:
    """Return coefficients after a clockwise quarter turn of rows `on_side`, (*B,) bool, and flips by signs (*B,)."""
    k, names = camera.distortion, camera.distortion_names
    if on_side is not None:
        quarter, owner = camera.quarter_turn, type(camera).__name__
        if quarter is None or not {*camera.odd_in_x, *camera.odd_in_y} <= quarter.keys():
            raise ValueError(
                f"{owner}: the model must be the same on its side for a quarter turn; got {owner}. "
                "Turn the camera by RandomMount(roll=...), or convert() it to another model"
            )
        if {"tau_x", "tau_y"} <= {*names}:
            tilts = camera.distortion[..., [names.index("tau_x"), names.index("tau_y")]]
            if known_false((tilts == 0).any(-1)):
                raise ValueError(
                    f"{owner}: tau_x or tau_y must be 0 for a quarter turn, as the model tilts about "
                    f"one axis after the other; got {tilts.tolist()}"
                )
        k = torch.where(torch.as_tensor(on_side, device=k.device).unsqueeze(-1), _rename(k, names, quarter), k)
    for sign, mirrored in ((across, camera.mirror_x), (down, camera.mirror_y)):
        if mirrored:
            flipped = torch.as_tensor(sign < 0, device=k.device).unsqueeze(-1)
            k = torch.where(flipped, _rename(k, names, mirrored), k)
    for sign, odd in ((across, camera.odd_in_x), (down, camera.odd_in_y)):
        if not odd.isdisjoint(names):
            is_odd = torch.tensor([name in odd for name in names], device=k.device)
            k = torch.where(is_odd & torch.as_tensor(sign < 0, device=k.device).unsqueeze(-1), -k, k)
    return k.clone() if k is camera.distortion else k


def _rename(k: Tensor, names: Sequence[str], turned: Mapping[str, str]) -> Tensor:
    """Return coefficients (*B, n) of these names, each replaced by the one that `turned` gives for it; "-" negates."""
    places = {name: i for i, name in enumerate(names)}
    source = [turned.get(name, name) for name in names]
    index = [places[name.removeprefix("-")] for name in source]
    return k[..., index] * k.new_tensor([-1.0 if name.startswith("-") else 1.0 for name in source])


class Editable(CameraLike):
    """A camera that can be edited like its image: each edit returns the camera of the edited image.

    While the original learns, the edited camera has no Parameters of its own: its intrinsics are made from the
    original's, where gradients go. The edited camera of a frozen one, or under `no_grad`, is a copy.
    """

    def _edited(self, matrix: Sequence[Sequence[float]], image_size: tuple[int, int]) -> Self:
        """Return the camera of an image edited by a matrix, see `edited`; its Parameters learn if this one's do."""
        if self.is_mixed:
            return cast("Self", cast("Any", self).by_groups(lambda group: group._edited(matrix, image_size)))
        return edited(self, matrix, image_size).learn_like(self)

    def crop(self, top: int, left: int, height: int, width: int) -> Self:
        """Return the camera of the part of the image whose top-left pixel is (left, top); it may reach outside.

        Raises:
            ValueError: If the part has no pixel of the image.
        """
        top, left = (as_whole(v, name, "crop") for v, name in ((top, "top"), (left, "left")))
        new_size = as_known_size((height, width), f"{type(self).__name__}.crop")
        size = self.image_size
        if size and (top >= size[0] or left >= size[1] or top + height <= 0 or left + width <= 0):
            raise ValueError(
                f"{type(self).__name__}.crop: (top, left, height, width) must hold a pixel of the "
                f"image (height, width) = {size}; got {(top, left, height, width)}"
            )
        return self._edited(((1, 0, -left), (0, 1, -top)), new_size)

    def pad(self, left: int, right: int, top: int, bottom: int) -> Self:
        """Return the camera of the image with that many more pixels on each side."""
        height, width = self.size_for("pad")
        sides = ((left, "left"), (right, "right"), (top, "top"), (bottom, "bottom"))
        left, right, top, bottom = (as_whole(value, name, "pad") for value, name in sides)
        new_size = as_known_size((height + top + bottom, width + left + right), type(self).__name__)
        return self._edited(((1, 0, left), (0, 1, top)), new_size)

    @hinting("It takes camera.resize(height, width), two numbers")
    def resize(self, height: int, width: int) -> Self:
        """Return the camera of the image scaled to that size; pixel edges scale, as with align_corners=False.

        It warns if the new size is like the old one with height and width exchanged.
        """
        old_height, old_width = self.size_for("resize")
        new_size = as_known_size((height, width), f"{type(self).__name__}.resize")
        warn_of_exchange((old_height, old_width), (height, width), f"{type(self).__name__}.resize")
        across, down = width / old_width, height / old_height
        return self._edited(((across, 0, (across - 1) / 2), (0, down, (down - 1) / 2)), new_size)

    def hflip(self) -> Self:
        """Return the camera that sees the scene mirrored left to right: its image is this one's, flipped."""
        height, width = self.size_for("hflip")
        return self._edited(((-1, 0, width - 1), (0, 1, 0)), (height, width))

    def vflip(self) -> Self:
        """Return the camera that sees the scene mirrored top to bottom: its image is this one's, flipped."""
        height, width = self.size_for("vflip")
        return self._edited(((1, 0, 0), (0, -1, height - 1)), (height, width))

    def rot90(self, k: int = 1) -> Self:
        """Return the camera whose image is this one's, turned counterclockwise k times as by torch.rot90.

        It sees turned points: `camera.rot90().project((y, -x, z))` is the turned pixel (v, W - 1 - u).

        Raises:
            ValueError: If a model that is not the same on its side, like a cylinder's, is turned by a quarter.
        """
        size, turns = self.size_for("rot90"), as_whole(k, "k", "rot90") % 4
        return self._edited(quarter_turns(size)[turns], size[::-1] if turns % 2 else size)
