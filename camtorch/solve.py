"""The inverse of a lens: graph-free solvers, and one function that gives their result its derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from camtorch.parameters import is_concrete

if TYPE_CHECKING:
    from camtorch.domain import Domain

Planes2 = tuple[Tensor, Tensor]

_RADIAL_STEPS = 6  # of third order, from one interval of the table: 1e-2, 1e-6, 1e-18, with a reserve for wild lenses
_START_ROUNDS = 6
_CLOSE = 0.1
_SLOWEST_TURN = 0.05
_GIVE_UP = 1e-4
# Nearly all points need 4 or 5 steps. The rest lie next to a fold, or so far out that a prism dominates, or have no
# solution; a traced graph is unrolled, cannot set them apart, and has to do with fewer.
_FIRST_STEPS, _LATE_STEPS, _TRACED_STEPS = 6, 54, 20


def invert(domain: Domain, u: Tensor, v: Tensor) -> Planes2:
    """The plane point that the lens of `domain` sends to (u, v), both (*B, N), or one near it if there is none."""
    return (_invert_radial if domain.lens.is_radial else _invert_planar)(domain, u, v)


def rounding(u: Tensor, v: Tensor, stretch: Tensor | float = 0.0) -> Tensor:
    """How far from (u, v) rounding may leave a lens that `stretch`es the rounding of its solution by so much."""
    return 32 * torch.finfo(u.dtype).eps * (1 + torch.maximum(u.abs(), v.abs()) + stretch)


def _invert_radial(domain: Domain, u: Tensor, v: Tensor) -> Planes2:
    """Steps of Cauchy's method inside a bracket.

    They go to the root of the local parabola: of third order, and at the fold too, where Newton's method crawls.
    """
    factor = domain.lens.stages[0].radial
    target = (u * u + v * v).sqrt()
    lower, rho, upper = domain.bracket(target, u, v)
    for _ in range(_RADIAL_STEPS):
        t = rho * rho
        value, first, second = factor.derivatives(t, 2)
        slope = value + 2 * t * first
        bend = rho * (6 * first + 4 * t * second)
        error = target - rho * value
        denominator = slope.abs() + (slope * slope + 2 * bend * error).clamp(min=0).sqrt()
        step = 2 * error / torch.where(denominator > 0, denominator, 1.0)
        rho = torch.minimum(torch.maximum(rho + torch.where(slope < 0, -step, step), lower), upper)
    scale = factor(rho * rho)
    return u / scale, v / scale


def _invert_planar(domain: Domain, u: Tensor, v: Tensor) -> Planes2:
    """Newton's method for all points; for the few that need many steps, by themselves."""
    u, v, a, b = torch.broadcast_tensors(u, v, *_planar_start(domain, u, v))
    if not is_concrete(a):
        return _newton(domain, u, v, a, b, _TRACED_STEPS)[:2]
    a, b, active = _newton(domain, u, v, a, b, _FIRST_STEPS)
    if bool(active.any()):
        late = _newton(domain.lanes(active), *(plane[active] for plane in (u, v, a, b)), _LATE_STEPS)
        a, b = (plane.masked_scatter(active, solved) for plane, solved in zip((a, b), late[:2], strict=True))
    return a, b


def _newton(domain: Domain, u: Tensor, v: Tensor, a: Tensor, b: Tensor, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Newton's method in the plane, each step shortened until it comes nearer and stays in the domain.

    Nearer in Deuflhard's sense: the next step by the same Jacobian is shorter. Where a lens stretches one direction
    far more than the other, the residual itself would reject every good step.

    Returns the points, and which of them would still move.
    """
    lens = domain.lens
    value, jacobian, _ = lens.linearise(a, b)
    enough = rounding(u, v) / 8
    length = torch.ones_like(u)
    for step_number in range(steps + 1):
        miss = u - value[0], v - value[1]
        active = (torch.maximum(miss[0].abs(), miss[1].abs()) > enough) & (length > _GIVE_UP)
        if step_number == steps or (is_concrete(active) and not bool(active.any())):
            break
        step = _newton_step(jacobian, *miss)
        trial = a + length * step[0], b + length * step[1]
        trial_value, trial_jacobian, sense = lens.linearise(*trial)
        ahead = _newton_step(jacobian, u - trial_value[0], v - trial_value[1])
        nearer = ahead[0] * ahead[0] + ahead[1] * ahead[1] < step[0] * step[0] + step[1] * step[1]
        good = active & nearer & domain.contains(*trial, sense)
        old, new = (a, b, *value, *jacobian), (*trial, *trial_value, *trial_jacobian)
        a, b, x, y, *jacobian = (torch.where(good, n, o) for n, o in zip(new, old, strict=True))
        value = x, y
        length = torch.where(good, (length * 4).clamp(max=1), length / 4)
    return a, b, active


def _newton_step(jacobian, du: Tensor, dv: Tensor) -> Planes2:
    ua, ub, va, vb = jacobian
    determinant = ua * vb - ub * va
    scale = 1 / torch.where(determinant != 0, determinant, 1.0)
    return (vb * du - ub * dv) * scale, (ua * dv - va * du) * scale


def _planar_start(domain: Domain, u: Tensor, v: Tensor) -> Planes2:
    """The best of some points that the lens sends as far out as (u, v), each on another azimuth.

    The azimuth is followed by the secant method: it is nearly that of (u, v), unless a prism dominates.
    """
    target, wanted = (u * u + v * v).sqrt(), torch.atan2(v, u)
    a, b, best = torch.zeros_like(u), torch.zeros_like(v), target * target
    azimuth, step, last_off = wanted, torch.zeros_like(u), torch.zeros_like(u)
    for _ in range(_START_ROUNDS):
        c, s = torch.cos(azimuth), torch.sin(azimuth)
        rho = domain.bracket(target, c, s)[1]
        x, y = domain.lens(rho * c, rho * s)
        error = (u - x) ** 2 + (v - y) ** 2
        better = error < best
        a, b, best = torch.where(better, rho * c, a), torch.where(better, rho * s, b), torch.where(better, error, best)
        if is_concrete(best) and bool((best <= _CLOSE**2 * target * target).all()):
            break
        off = torch.atan2(x * v - y * u, x * u + y * v)
        slope = torch.where(step != 0, (last_off - off) / torch.where(step != 0, step, 1.0), 1.0)
        step, last_off = (off / slope.clamp(_SLOWEST_TURN, 2.0)).clamp(-1.0, 1.0), off
        azimuth = azimuth + step
    return a, b


def attach(
    function: Callable[[Tensor, Tensor], Planes2],
    solution: Planes2,
    inverse_jacobian: tuple[Tensor, Tensor, Tensor, Tensor],
    target: Planes2,
) -> Planes2:
    """Give a graph-free solution of function(solution) = target its exact first and second derivatives.

    Two steps of the chord method x <- x - J^-1 (f(x) - y) with the constant Jacobian of the solution. If
    parameters and target move by d, the solution is off by O(d^2) after one step and by O(d^3) after two:
    its Taylor series agrees with that of the implicit function up to second order. The Jacobian itself never
    enters the graph. On the values the steps polish what rounding left.
    """
    (a, b), (au, av, bu, bv), (u, v) = solution, inverse_jacobian, target
    for _ in range(2):
        x, y = function(a, b)
        du, dv = u - x, v - y
        a, b = a + au * du + av * dv, b + bu * du + bv * dv
    return a, b
