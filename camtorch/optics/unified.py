"""The unified chart: the plane of catadioptric and of many fisheye cameras, with up to three learnable parameters."""

import math
from typing import ClassVar

import torch
from torch import Tensor

from camtorch.native.structs import UNIFIED
from camtorch.optics.charts import Chart, Perspective, Planes3, even_steps_and_ratios, unit


class Unified(Chart):
    """(x, y) / (alpha d' + (1 - alpha) z'), d' = sqrt(beta (x^2 + y^2) + z'^2), z' = z + xi sqrt(x^2 + y^2 + z^2).

    A ray is covered before r stops ascending, and before its pole: the denominator, alpha z' + (1 - alpha) d' (the
    numerator of dr/dtheta behind the shift) and 1 + xi z / d (that of the shift itself) must be positive.

    xi > -1 shifts the centre of the sphere, beta > 0 makes it an ellipsoid; any alpha is allowed. A part that is left
    out is 0, 0 and 1, which is the perspective chart; a number is a part that does not learn.
    """

    code: ClassVar[int | None] = UNIFIED

    fixed_alpha: float | None
    has_xi: bool
    has_beta: bool

    def __init__(self, xi: Tensor | None = None, alpha: Tensor | float = 0.0, beta: Tensor | None = None):
        self.fixed_alpha = alpha if isinstance(alpha, float) else None
        self.has_xi, self.has_beta = xi is not None, beta is not None
        self.parameters: tuple[Tensor, ...] = tuple(w for w in (xi, alpha, beta) if isinstance(w, Tensor))

    def _parts(self) -> tuple[Tensor | None, Tensor | float, Tensor | None]:
        parts = list(self.parameters)
        xi = parts.pop(0) if self.has_xi else None
        alpha = parts.pop(0) if self.fixed_alpha is None else self.fixed_alpha
        return xi, alpha, parts[0] if self.has_beta else None

    def _shifted(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return x^2 + y^2, z', d' and d, the last one only if it is needed."""
        xi, _, beta = self._parts()
        rho2 = torch.addcmul(x * x, y, y)
        distance = None
        if xi is not None:
            distance = torch.addcmul(rho2, z, z).sqrt()
            z = torch.addcmul(z, xi, distance)
        around = rho2 if beta is None else rho2 * beta
        return rho2, z, torch.addcmul(around, z, z).sqrt(), distance

    def _below(self, rho2: Tensor, z: Tensor, sphere: Tensor) -> Tensor:
        """Return the denominator for x^2 + y^2, z' and d'."""
        _, alpha, beta = self._parts()
        if self.fixed_alpha == 0:
            return z
        if self.fixed_alpha == 1:
            return sphere
        # behind the camera its terms cancel, all the more for alpha near 1/2
        ahead = z > 0
        around = rho2 if beta is None else rho2 * beta
        behind = alpha * alpha * around + (2 * alpha - 1) * (z * z)
        behind = behind / torch.where(ahead, 1.0, alpha * sphere - (1 - alpha) * z)
        return torch.where(ahead, z + alpha * (sphere - z), behind)

    def margin(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        xi, alpha, _ = self._parts()
        rho2, shifted, sphere, distance = self._shifted(x, y, z)
        below = self._below(rho2, shifted, sphere)
        margin = Perspective().end(z.dtype) * below - torch.maximum(x.abs(), y.abs())
        margin = torch.minimum(margin, alpha * shifted + (1 - alpha) * sphere)
        return margin if xi is None or distance is None else torch.minimum(margin, torch.addcmul(distance, xi, z))

    def scale(self, x: Tensor, y: Tensor, z: Tensor, order: int = 2) -> Tensor:
        rho2, shifted, sphere, _ = self._shifted(x, y, z)
        return self._below(rho2, shifted, sphere).reciprocal()

    def on_plane(self, a: Tensor, b: Tensor) -> Tensor:
        xi, alpha, beta = self._parts()
        rho2 = torch.addcmul(a * a, b, b)
        around = rho2 if beta is None else rho2 * beta
        # stay away from the fold, which the ray's own rounding would cross
        floor = 64 * torch.finfo(a.dtype).eps
        margin = Perspective().end(a.dtype) / 2 - torch.maximum(a.abs(), b.abs())
        margin = torch.minimum(margin, 1 - floor - (2 * alpha - 1) * around)
        if xi is None:
            return margin
        ahead = self._ahead(around, alpha)
        before = torch.addcmul(ahead * ahead, (1 - xi) * (1 + xi), rho2)
        margin = torch.minimum(margin, before - floor * torch.addcmul(rho2, ahead, ahead))
        # the line from the shifted centre meets the sphere ahead; from outside of it, xi > 1, it may do so behind
        reach = torch.addcmul(before.clamp(min=0).sqrt(), xi, ahead)
        return torch.minimum(margin, reach - floor * ahead.abs())

    def to_ray(self, a: Tensor, b: Tensor, order: int = 2) -> Planes3:
        xi, alpha, beta = self._parts()
        rho2 = torch.addcmul(a * a, b, b)
        ahead = self._ahead(rho2 if beta is None else rho2 * beta, alpha)
        if xi is None:
            return unit(a, b, ahead)
        # the line from the shifted centre meets the unit sphere here, on the side of the axis
        before = torch.addcmul(ahead * ahead, (1 - xi) * (1 + xi), rho2).sqrt()
        reach = torch.addcmul(before, xi, ahead) / torch.addcmul(rho2, ahead, ahead)
        return a * reach, b * reach, torch.addcmul(-xi, ahead, reach)

    @staticmethod
    def _ahead(around: Tensor, alpha: Tensor | float) -> Tensor:
        """Return the z' of the ray (a, b, z') whose denominator is 1; around = beta (a^2 + b^2)."""
        if isinstance(alpha, float) and alpha == 0:
            return torch.ones_like(around)
        root = (1 - (2 * alpha - 1) * around).sqrt()
        # two forms of one function: the first one divides by zero at 1/2, the second one may far from there
        if isinstance(alpha, float):
            if abs(2 * alpha - 1) > 0.5:
                return (alpha * root + (alpha - 1)) / (2 * alpha - 1)
            return (1 - alpha * alpha * around) / (alpha * root + (1 - alpha))
        first = (2 * alpha - 1).abs() > 0.5
        slope = torch.where(first, 2 * alpha - 1, 1.0)
        above = torch.where(first, alpha - 1, 1.0) + torch.where(first, alpha, 0.0) * root
        above = torch.addcmul(above, torch.where(first, 0.0, -alpha * alpha), around)
        below = torch.where(first, slope, 1 - alpha) + torch.where(first, 0.0, alpha) * root
        return above / below

    def end(self, dtype: torch.dtype) -> float | Tensor:
        xi, alpha, beta = self._parts()
        most, inside = Perspective().end(dtype) / 2, 1 - 64 * torch.finfo(dtype).eps
        if xi is None and not isinstance(alpha, Tensor):
            return min(most, inside / (2 * alpha - 1) ** 0.5) if alpha > 0.5 else most
        fold = (2 * alpha - 1) * (torch.ones_like(self.parameters[0]) if beta is None else beta)
        end = torch.where(fold > 0, inside * torch.where(fold > 0, fold, 1.0).rsqrt(), most)
        if xi is not None:  # from outside of the sphere lines touch it where ahead = r sqrt(xi^2 - 1)
            beyond = (xi - 1) * (xi + 1)
            below = alpha * xi + (1 - alpha) * torch.where(beyond > 0, beyond, 1.0).sqrt()
            end = torch.minimum(end, torch.where(beyond > 0, inside / below, most))
        return end.clamp(max=most)

    def usual_end(self, dtype: torch.dtype) -> float | Tensor:
        usual = math.tan(math.radians(87)) / (1.0 if self.has_xi else self.fixed_alpha or 1.0)
        end = self.end(dtype)
        return end.clamp(max=usual) if isinstance(end, Tensor) else min(end, usual)

    def radii(self, count: int, like: Tensor) -> Tensor:
        end = self.end(like.dtype)
        most = Perspective().end(like.dtype) / 2 if isinstance(end, Tensor) else end
        if most < 2:
            return even_steps_and_ratios(count, most, most, like, torch.positive)
        return even_steps_and_ratios(count, math.radians(88), most, like, torch.tan)
