"""The picture of a camera: its size, its pixels, and the cameras of its edited versions."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor, nn

from camtorch.parameters import GeometryModule, as_image_size, as_real, as_values, as_whole, is_concrete

if TYPE_CHECKING:
    from typing_extensions import Self


class Picture(GeometryModule):
    """The part of a camera that its intrinsics and image size alone decide. Used through `Camera`.

    The camera of an edited picture has no Parameters of its own while the original learns: its intrinsics are made
    from the original's, and that is where gradients go. From a frozen camera, or under no_grad, it is a plain copy.
    """

    intrinsics: Tensor
    distortion: Tensor
    distortion_names: tuple[str, ...] = ()
    image_size: tuple[int, int] | None
    odd_in_x: ClassVar[frozenset[str]] = frozenset()
    """The coefficients that change sign when the scene is mirrored left to right."""
    odd_in_y: ClassVar[frozenset[str]] = frozenset()
    """Likewise top to bottom."""

    @property
    def batch_shape(self) -> torch.Size:
        """*B, the batch dims of the parameters."""
        shapes = self.intrinsics.shape[:-1], self.distortion.shape[:-1]
        return shapes[0] if shapes[0] == shapes[1] else torch.broadcast_shapes(*shapes)

    @property
    def K(self) -> Tensor:  # noqa: N802 (the field's name for it)
        """The (*B, 3, 3) camera matrix."""
        fx, fy, cx, cy = self.intrinsics.expand(*self.batch_shape, 4).unbind(-1)
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        return torch.stack((fx, zero, cx, zero, fy, cy, zero, zero, one), -1).unflatten(-1, (3, 3))

    @classmethod
    def from_matrix(cls, K, distortion=None, *, image_size=None, ignore_skew: bool = False) -> Self:  # noqa: N803
        """A camera from its (*B, 3, 3) matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].

        Raises:
            ValueError: not such a matrix, or a skew (its K[0, 1]) that is not zero and not to be ignored.
        """
        K = as_real(K, "K", cls.__name__)  # noqa: N806
        if K.shape[-2:] != (3, 3):
            raise ValueError(f"{cls.__name__}: K must be (*B, 3, 3); got shape {tuple(K.shape)}")
        if is_concrete(K):
            bottom = K[..., 2, :].detach()
            if bool((bottom != bottom.new_tensor([0, 0, 1])).any()) or bool((K[..., 1, 0] != 0).any()):
                raise ValueError(f"{cls.__name__}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; got {K.tolist()}")
            skew = K[..., 0, 1].detach()
            if not ignore_skew and bool((skew != 0).any()):
                raise ValueError(
                    f"{cls.__name__}: K has a skew K[0, 1] = {skew.tolist()}, which this model does not have; "
                    "ignore_skew=True drops it"
                )
        intrinsics = torch.stack((K[..., 0, 0], K[..., 1, 1], K[..., 0, 2], K[..., 1, 2]), -1)
        if distortion is None:
            return cls(intrinsics, image_size=image_size)
        return cls(intrinsics, distortion, image_size=image_size)

    def contains(self, pixels: Tensor) -> Tensor:
        """Bool (...): whether pixels (..., 2) lie on the picture, its outer pixel edges included."""
        height, width = self._size("contains")
        pixels = as_values(pixels, "pixels", type(self).__name__)
        if pixels.ndim == 0 or pixels.shape[-1] != 2:
            raise ValueError(f"{type(self).__name__}: pixels must be (..., 2); got shape {tuple(pixels.shape)}")
        u, v = pixels.unbind(-1)
        return (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)

    def pixel_grid(self) -> Tensor:
        """(H, W, 2): the centre of every pixel."""
        height, width = self._size("pixel_grid")
        like = {"dtype": torch.promote_types(self.intrinsics.dtype, torch.float32), "device": self.intrinsics.device}
        v, u = torch.meshgrid(torch.arange(height, **like), torch.arange(width, **like), indexing="ij")
        return torch.stack((u, v), -1)

    def _size(self, what: str) -> tuple[int, int]:
        if self.image_size is None:
            raise ValueError(f"{type(self).__name__}: {what} needs the camera's image_size=(height, width)")
        return self.image_size

    # -- the camera of an edited picture

    def crop(self, top: int, left: int, height: int, width: int) -> Self:
        """The camera of the part of the picture whose top-left pixel is (left, top); it may reach outside."""
        top, left = (as_whole(v, name, "crop") for v, name in ((top, "top"), (left, "left")))
        return self._edited(shift=(-left, -top), size=(height, width))

    def pad(self, left: int, right: int, top: int, bottom: int) -> Self:
        """The camera of the picture with that many more pixels on each side."""
        height, width = self._size("pad")
        sides = ((left, "left"), (right, "right"), (top, "top"), (bottom, "bottom"))
        left, right, top, bottom = (as_whole(value, name, "pad") for value, name in sides)
        return self._edited(shift=(left, top), size=(height + top + bottom, width + left + right))

    def resize(self, height: int, width: int) -> Self:
        """The camera of the picture scaled to that size; pixel edges scale, as with align_corners=False."""
        old_height, old_width = self._size("resize")
        as_image_size((height, width), f"{type(self).__name__}.resize")
        return self._edited(scale=(width / old_width, height / old_height), size=(height, width))

    def hflip(self) -> Self:
        """The camera that sees the scene mirrored left to right: its picture is this one's, flipped."""
        return self._edited(mirror="x", size=self._size("hflip"))

    def vflip(self) -> Self:
        """The camera that sees the scene mirrored top to bottom: its picture is this one's, flipped."""
        return self._edited(mirror="y", size=self._size("vflip"))

    def _edited(self, *, size, shift=(0, 0), scale=(1.0, 1.0), mirror: str = "") -> Self:
        fx, fy, cx, cy = self.intrinsics.unbind(-1)
        cx, cy = (cx + 0.5) * scale[0] - 0.5 + shift[0], (cy + 0.5) * scale[1] - 0.5 + shift[1]
        odd: frozenset[str] = frozenset()
        if mirror == "x":
            cx, odd = size[1] - 1 - cx, self.odd_in_x
        elif mirror == "y":
            cy, odd = size[0] - 1 - cy, self.odd_in_y
        intrinsics = torch.stack((fx * scale[0], fy * scale[1], cx, cy), -1)
        arguments = [intrinsics]
        if self.distortion.shape[-1]:
            sign = self.distortion.new_tensor([-1.0 if name in odd else 1.0 for name in self.distortion_names])
            arguments.append(self.distortion * sign)
        edited = type(self)(*arguments, image_size=size)
        for mine, its in ((self.intrinsics, edited.intrinsics), (self.distortion, edited.distortion)):
            if isinstance(its, nn.Parameter) and not mine.requires_grad:
                its.requires_grad = False
        return edited
