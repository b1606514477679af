"""The method of Levenberg and Marquardt for a batch of problems, each of which goes its own way."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from camtorch.least_squares.equations import System

State = tuple[Tensor, ...]
"""What is looked for: tensors (B, ...), a row for each problem."""

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-15, 1e8
_GOOD, _FAIR = 0.75, 0.25  # parts of what a step promised that were kept


class Problem(Protocol):
    """Sums of squares to be made small, B of them; rows (R,) says which of them are meant."""

    rounding: Tensor
    """(B,) the sums of squares of what rounding does to the residuals, see `rounding_of`."""

    def cost(self, state: State, rows: Tensor) -> Tensor:
        """(R,); infinite where a state cannot be."""
        ...

    def linearised(self, state: State, rows: Tensor) -> System:
        """At a state of finite cost."""
        ...

    def moved(self, state: State, step: State, rows: Tensor) -> State:
        """The state a step further."""
        ...


class Minimum(NamedTuple):
    """Where a search ended: the state, its cost (B,), and whether nothing is left to gain, bool (B,)."""

    state: State
    cost: Tensor
    converged: Tensor


def rounding_of(pixels: Tensor, weights: Tensor) -> Tensor:
    """(B,) the weighted sums of squares of the rounding of pixels: eps of the dtype times the largest coordinate.

    The projections of all models are rounded by 0.2 to 0.4 of that, root mean square. weights: (B, ...) of the squares.
    """
    largest = torch.where(weights > 0, pixels.abs().amax(-1), 0.0).flatten(1).amax(-1)
    return (torch.finfo(pixels.dtype).eps * largest).square() * weights.flatten(1).sum(-1)


def minimise(
    problem: Problem,
    state: State,
    *,
    tolerance: Tensor | float,
    tiny: Tensor | float = 0.0,
    going: Tensor | None = None,
    steps: int = 60,
    damping: float = FIRST_DAMPING,
    progress: Callable[[int, Tensor], None] | None = None,
) -> Minimum:
    """The states of least cost near those given.

    No problem depends on another: those that have settled are left alone, so that each goes the way it would go alone.

    A step that promises less than rounding does to a cost cannot be judged by the cost: it is the last one, and taken
    unless the cost grows by more than that.

    Args:
        problem: B of them.
        state: where to start.
        tolerance: (B,) the part of a cost that a step has to promise, or the search has ended.
        tiny: (B,) costs up to which are as good as none.
        going: (B,) bool, those to search; all if left out.
        steps: at most so many, those that were tried in vain included.
        damping: the first one.
        progress: called after each step with its number and the costs.
    """
    rows = torch.arange(len(state[0]), device=state[0].device)
    cost = problem.cost(state, rows)
    state = tuple([t.clone() for t in state])
    tolerance, tiny = (torch.as_tensor(t, device=cost.device).to(cost).expand_as(cost) for t in (tolerance, tiny))
    weights = torch.full_like(cost, damping)
    growth = torch.full_like(cost, 4.0)
    converged = cost <= tiny
    going = torch.isfinite(cost) & ~converged & (torch.ones_like(converged) if going is None else going)
    system = None
    for number in range(steps):
        if system is None:
            (rows,) = going.nonzero(as_tuple=True)
            if len(rows) == 0:
                break
            old = tuple([t[rows] for t in state])
            system = problem.linearised(old, rows)
            before = cost[rows]
        weight = weights[rows]
        step, promised = system.step(weight)
        new = problem.moved(old, step, rows)
        after = problem.cost(new, rows)
        kept = (before - after) / promised.clamp(min=torch.finfo(cost.dtype).tiny)
        # sum((r + d)^2) - sum(r^2) is at most this, for residuals r and their rounding d
        rounding = 2 * (before * problem.rounding[rows]).sqrt() + problem.rounding[rows]
        enough = torch.maximum(tolerance[rows] * before, rounding)
        last = system.decrement <= enough
        better = (after < before) | (last & (after <= before + torch.maximum(rounding, 1e-12 * before)))
        stuck = ~better & ((weight >= MOST_DAMPING) | last)
        for whole, part in zip(state, new, strict=True):
            whole[rows[better]] = part[better]
        cost[rows] = torch.where(better, after, before)
        factor = torch.where(kept > _GOOD, 0.1, torch.where(kept > _FAIR, 1.0, 2.0))
        weights[rows] = (weight * torch.where(better, factor, growth[rows])).clamp(LEAST_DAMPING, MOST_DAMPING)
        growth[rows] = torch.where(better, 4.0, growth[rows] * 2).clamp(max=64.0)
        settled = last | (cost[rows] <= tiny[rows])
        if bool(stuck.any()):
            settled = settled | stuck & (system.firm_decrement <= enough)
        converged[rows] = settled
        going[rows] = ~(settled | stuck)
        if progress is not None:
            progress(number + 1, cost)
        if bool(better.any()) or bool(stuck.any()):
            system = None
    return Minimum(state, cost, converged)
