"""The inverse of a lens: two graph-free solvers, and one function that gives their result its derivatives."""

from collections.abc import Callable

import torch
from torch import Tensor

Planes2 = tuple[Tensor, Tensor]

_RADIAL_STEPS = 5  # of third order, from an interval of the table: 1e-2 -> 1e-6 -> 1e-18, with reserve for wild lenses
_PLANAR_STEPS = 12


def invert_radial(radial, radii: Tensor, u: Tensor, v: Tensor) -> Planes2:
    """The point m with m R(|m|^2) = (u, v), before the first turn of |m| R.

    radial: a radial factor with `derivatives`; radii: (S,) increasing, from 0 to the end of the chart;
    u, v: (*B, N). A target beyond the turn ends at the turn.

    The table of |m| R brackets the root; inside the bracket the steps of Cauchy's method (the root of
    the local parabola) converge with third order, at the turn as well, where Newton's method crawls.
    """
    target = (u * u + v * v).sqrt()
    table = radii * radial(radii * radii)
    # a table that has turned must not catch targets a second time: from the turn on it is the maximum
    table = torch.cummax(torch.nan_to_num(table, nan=0.0), dim=-1).values.expand(*target.shape[:-1], -1)
    low = (torch.searchsorted(table.contiguous(), target.contiguous(), right=True) - 1).clamp(0, len(radii) - 2)
    lower = radii[low]
    # the turn may lie one interval behind the last node that still rises
    upper = radii[(low + 2).clamp(max=len(radii) - 1)]
    rho = lower
    for _ in range(_RADIAL_STEPS):
        t = rho * rho
        value, first, second = radial.derivatives(t)
        slope = value + 2 * t * first
        bend = rho * (6 * first + 4 * t * second)
        error = target - rho * value
        denominator = slope.abs() + (slope * slope + 2 * bend * error).clamp(min=0).sqrt()
        step = 2 * error / torch.where(denominator > 0, denominator, 1.0)
        rho = torch.minimum(torch.maximum(rho + torch.where(slope < 0, -step, step), lower), upper)
    factor = radial(rho * rho)
    return u / factor, v / factor


def invert_planar(stage, u: Tensor, v: Tensor, a: Tensor, b: Tensor) -> Planes2:
    """Newton's method in the plane from (a, b); a step that does not come nearer, or crosses a fold, is shortened."""

    def miss(a: Tensor, b: Tensor):
        x, y = stage(a, b)
        du, dv = u - x, v - y
        return du, dv, du * du + dv * dv

    du, dv, best = miss(a, b)
    length = torch.ones_like(best)
    for _ in range(_PLANAR_STEPS):
        (ua, ub, va, vb), _ = stage.jacobian(a, b)
        determinant = ua * vb - ub * va
        scale = length / torch.where(determinant != 0, determinant, 1.0)
        next_a, next_b = a + (vb * du - ub * dv) * scale, b + (ua * dv - va * du) * scale
        next_du, next_dv, error = miss(next_a, next_b)
        better = (error < best) & (stage.jacobian(next_a, next_b)[1] > 0)
        a, b = torch.where(better, next_a, a), torch.where(better, next_b, b)
        du, dv, best = (
            torch.where(better, next_du, du),
            torch.where(better, next_dv, dv),
            torch.where(better, error, best),
        )
        length = torch.where(better, 1.0, length / 4)
    return a, b


def attach(
    function: Callable[[Tensor, Tensor], Planes2],
    solution: Planes2,
    inverse_jacobian: tuple[Tensor, Tensor, Tensor, Tensor],
    target: Planes2,
) -> Planes2:
    """Give a graph-free solution of function(solution) = target its exact first and second derivatives.

    Two steps of the chord method x <- x - J^-1 (f(x) - y) with the constant Jacobian of the solution. If
    parameters and target move by d, the solution after one step is off by O(d^2) and after two by O(d^3):
    its Taylor series agrees with that of the implicit function up to second order. The Jacobian itself never
    enters the graph. On the values the steps polish what rounding the solver left.
    """
    (a, b), (au, av, bu, bv), (u, v) = solution, inverse_jacobian, target
    for _ in range(2):
        x, y = function(a, b)
        du, dv = u - x, v - y
        a, b = a + au * du + av * dv, b + bu * du + bv * dv
    return a, b
