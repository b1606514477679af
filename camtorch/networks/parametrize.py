"""Parametrizations of a camera's intrinsics, for `torch.nn.utils.parametrize`: positive, and tied to each other."""

import torch
from torch import Tensor, nn


class PositiveFocal(nn.Module):
    """Focal lengths that remain positive in every step of an optimizer: the logarithms of fx and fy learn.

        register = torch.nn.utils.parametrize.register_parametrization
        register(camera, "intrinsics", PositiveFocal())

    An optimizer's step of 0.01 is one percent of a focal length; the principal point learns in pixels.
    """

    def forward(self, unconstrained: Tensor) -> Tensor:
        """Return intrinsics (*B, 4) for (*B, 4) log fx, log fy, cx, cy."""
        return torch.cat((unconstrained[..., :2].exp(), unconstrained[..., 2:]), -1)

    def right_inverse(self, intrinsics: Tensor) -> Tensor:
        """Return log fx, log fy, cx, cy (*B, 4) for intrinsics (*B, 4)."""
        return torch.cat((intrinsics[..., :2].log(), intrinsics[..., 2:]), -1)


class TiedFocal(nn.Module):
    """Square pixels, fx = fy: the logarithm of one focal length learns; see `PositiveFocal`.

    A camera whose focal lengths differ gets their geometric mean.
    """

    def forward(self, unconstrained: Tensor) -> Tensor:
        """Return intrinsics (*B, 4) for (*B, 3) log f, cx, cy."""
        focal = unconstrained[..., :1].exp()
        return torch.cat((focal, focal, unconstrained[..., 1:]), -1)

    def right_inverse(self, intrinsics: Tensor) -> Tensor:
        """Return log f, cx, cy (*B, 3) for intrinsics (*B, 4) of square pixels."""
        return torch.cat((intrinsics[..., :2].log().mean(-1, keepdim=True), intrinsics[..., 2:]), -1)
