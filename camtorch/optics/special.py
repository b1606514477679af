"""Functions that are smooth where their textbook formulas divide zero by zero.

Each takes the squared angle (or squared radius): in that variable the functions are analytic, so that values and
derivatives of every order are exact on the axis and at any distance from it.

The closed forms themselves are exact there to first order in this sense: the part of their derivative by t that
cancels is multiplied by t in the derivative by a point. Order 1 uses them directly, at a third of the cost.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from camtorch.evaluate.export import atan2, plus
from camtorch.evaluate.tensors import may_branch_on

# Below these the power series is used. Its first dropped term is below 1e-21, and above them the closed form still has
# a first derivative accurate to 1e-13 of the function's own scale.
_SMALL_ANGLE2 = 1e-2
_SMALL_SLOPE2 = 1e-3
_MANY_VALUES = 1000  # of which the small ones are taken out


def _series(t: Tensor, coefficients: list[float]) -> Tensor:
    result = torch.full_like(t, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        result = result * t + c
    return result


def _blend(
    small: Tensor,
    near: Callable[..., Tensor],
    far: Callable[..., Tensor],
    planes: tuple[Tensor, ...],
    in_near: tuple[float, ...],
    in_far: tuple[float | None, ...],
) -> Tensor:
    """Return `near` of planes where they are small, else `far`.

    `in_near` and `in_far`: harmless inputs where the other branch counts; None leaves the plane.
    """
    looks = may_branch_on(small, *planes) and small.numel() > _MANY_VALUES
    places = small.nonzero(as_tuple=True) if looks else ()
    if looks and not len(places[0]):
        return far(*planes)
    large = far(*(p if w is None else torch.where(small, w, p) for w, p in zip(in_far, planes, strict=True)))
    if looks:  # mostly few are small
        return large.index_put(places, near(*(p.expand_as(small)[places] for p in planes)))
    return torch.where(small, near(*(torch.where(small, p, w) for w, p in zip(in_near, planes, strict=True))), large)


def _blend_series(t: Tensor, series: list[float], closed_form: Callable[[Tensor], Tensor]) -> Tensor:
    return _blend(
        t < _SMALL_ANGLE2, lambda t: _series(t, series), lambda t: closed_form(t.sqrt()), (t,), (0.0,), (1.0,)
    )


def root(square: Tensor) -> Tensor:
    """Return the square root, with a finite derivative at zero."""
    # the tiny number adds nothing to 1, and the reciprocal of its square is still a number
    return plus(square, torch.finfo(square.dtype).tiny ** 0.5).sqrt()


_COS = [(-1) ** n / math.factorial(2 * n) for n in range(8)]
_SINC = [(-1) ** n / math.factorial(2 * n + 1) for n in range(8)]
_COSC = [(-1) ** n / math.factorial(2 * n + 2) for n in range(8)]
_TANC = [1, 1 / 3, 2 / 15, 17 / 315, 62 / 2835, 1382 / 155925, 21844 / 6081075, 929569 / 638512875]
_ATAN = [(-1) ** n / (2 * n + 1) for n in range(8)]


def cos_root(t: Tensor, order: int = 2) -> Tensor:
    """Return cos(theta) for t = theta^2."""
    return _blend_series(t, _COS, torch.cos) if order > 1 else torch.cos(root(t))


def sinc_root(t: Tensor, order: int = 2) -> Tensor:
    """Return sin(theta) / theta for t = theta^2."""
    if order > 1:
        return _blend_series(t, _SINC, lambda angle: torch.sin(angle) / angle)
    angle = root(t)
    return torch.sin(angle) / angle


def cosc_root(t: Tensor) -> Tensor:
    """Return (1 - cos(theta)) / theta^2 for t = theta^2."""

    def half_angle(angle: Tensor) -> Tensor:  # 1 - cos cancels, sin^2 of the half does not
        ratio = torch.sin(angle / 2) / angle
        return 2 * ratio * ratio

    return _blend_series(t, _COSC, half_angle)


def angle_per_radius(rho2: Tensor, z: Tensor, order: int = 2) -> Tensor:
    """Return the ratio theta / rho with theta = atan2(rho, z) in [0, pi] and rho2 = rho^2; 1 / z on the axis.

    rho2 must be > 0 if z <= 0: the exact backward direction has every azimuth at once.
    """
    if order <= 1:
        rho = root(rho2)
        return atan2(rho, z) / rho

    def near(rho2: Tensor, z: Tensor) -> Tensor:
        reciprocal = 1 / z
        return reciprocal * _series(rho2 * reciprocal * reciprocal, _ATAN)

    def far(rho2: Tensor, z: Tensor) -> Tensor:
        rho = rho2.sqrt()
        return atan2(rho, z) / rho

    small = (z > 0) & (rho2 < _SMALL_SLOPE2 * z * z)
    return _blend(small, near, far, (rho2, z), (0.0, 1.0), (1.0, None))


def tanc_root(t: Tensor) -> Tensor:
    """Return tan(angle) / angle for t = angle^2."""
    return _blend_series(t, _TANC, lambda angle: torch.tan(angle) / angle)


def first_root(*coefficients: Tensor) -> Tensor:
    """Return the smallest t > 0 at which 1 + c0 t + c1 t^2 + ... turns negative; infinite if none, 0 for no numbers.

    The coefficients are float64 with values, of which no graph is kept. The roots of the reversed polynomial are the
    eigenvalues of its companion matrix, without dividing by a highest coefficient that may be zero. They divide the
    axis into intervals of one sign each; at the root before the first negative one Newton's method finds the last
    bits. NumPy's functions take a fraction of the time of torch's for so few numbers.
    """
    first = coefficients[0]
    c = np.stack(np.broadcast_arrays(*(w.detach().cpu().numpy() for w in coefficients)), -1)
    known = np.isfinite(c).all(-1, keepdims=True)
    c = np.where(known, c, 0.0)
    degree = c.shape[-1]
    companion = np.zeros((*c.shape, degree))
    companion[..., range(1, degree), range(degree - 1)] = 1
    companion[..., 0, :] = -c
    powers, terms = np.arange(degree + 1), np.concatenate((np.ones_like(c[..., :1]), c), -1)
    with np.errstate(all="ignore"):  # infinity and NaN mean no root
        roots = 1 / np.linalg.eigvals(companion)
        # an end of an interval from a pair that is not real does no harm
        roots = np.sort(np.where(roots.real > 0, roots.real, np.inf), -1)
        ends = np.concatenate(((roots[..., :-1] + roots[..., 1:]) / 2, 2 * roots[..., -1:]), -1)
        ends = np.where(np.isfinite(ends), ends, 2 * roots)
        negative = ((terms[..., None, :] * ends[..., None] ** powers).sum(-1) < 0) & np.isfinite(ends)
        t = np.take_along_axis(roots, negative.argmax(-1, keepdims=True), -1)
        for _ in range(2):
            value = (terms * t**powers).sum(-1, keepdims=True)
            step = value / (c * powers[1:] * t ** powers[:-1]).sum(-1, keepdims=True)
            t = np.where(np.abs(step) < 0.1 * t, t - step, t)
        t = np.where(known, np.where(negative.any(-1, keepdims=True), t, np.inf), 0.0)
    return torch.from_numpy(t[..., 0]).to(first.device)
