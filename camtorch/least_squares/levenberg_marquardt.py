"""The Levenberg-Marquardt method for a batch of independent problems."""

from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from camtorch.least_squares.equations import System

State = tuple[Tensor, ...]  # the unknowns: tensors (B, ...), a row for each problem

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-15, 1e8
_GOOD, _FAIR = 0.75, 0.25  # of a step's predicted decrease, achieved


class Problem(Protocol):
    """B sums of squares to minimise; rows (R,) selects some of them."""

    rounding: Tensor  # (B,) the sums of squares of the residuals' rounding, see `rounding_of`

    def cost(self, state: State, rows: Tensor) -> Tensor:
        """Return the costs (R,); infinite if a state is impossible."""

    def linearised(self, state: State, rows: Tensor) -> System:
        """Return the linearised problem at a state of finite cost."""

    def moved(self, state: State, step: State, rows: Tensor) -> State:
        """Return the state after a step."""


class Minimum(NamedTuple):
    """The end of a search: the state, its cost (B,), and whether it converged, bool (B,)."""

    state: State
    cost: Tensor
    converged: Tensor


def rounding_of(pixels: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted sums of squares (B,) of the rounding of pixels: dtype's eps times the largest coordinate.

    The rms rounding of all models' projections is 0.2 to 0.4 of that. weights: (B, ...) of the squares.
    """
    largest = torch.where(weights > 0, pixels.abs().amax(-1), 0.0).flatten(1).amax(-1)
    return (torch.finfo(pixels.dtype).eps * largest).square() * weights.flatten(1).sum(-1)


@np.errstate(all="ignore")  # costs may be infinite
def minimise(
    problem: Problem,
    state: State,
    *,
    tolerance: Tensor | float,
    tiny: Tensor | float = 0.0,
    going: Tensor | None = None,
    steps: int = 60,
    damping: float = FIRST_DAMPING,
) -> Minimum:
    """Return the states of least cost near the given ones; no problem depends on another.

    A step with a predicted decrease below the cost's rounding is the last one, taken unless the cost grows by more.

    For B problems: a search ends if the predicted decrease is below the part `tolerance` (B,) of the cost, or the cost
    is at most `tiny` (B,). `going` (B,) bool selects the problems to search, all by default. `steps` limits all steps,
    rejected ones included; `damping` is the first one.
    """
    device = state[0].device
    every = torch.arange(len(state[0]), device=device)
    # these are a few numbers a problem, for which NumPy is faster than torch
    cost, own_rounding = (t.numpy(force=True).copy() for t in (problem.cost(state, every), problem.rounding))
    given = (t.numpy(force=True) if isinstance(t, Tensor) else t for t in (tolerance, tiny))
    parts, least = (np.broadcast_to(t, cost.shape) for t in given)
    weights, growth, converged = np.full_like(cost, damping), np.full_like(cost, 4.0), cost <= least
    is_going = np.isfinite(cost) & ~converged & (True if going is None else going.numpy(force=True))
    system = None
    for _ in range(steps):
        if system is None:
            (rows,) = is_going.nonzero()
            if len(rows) == 0:
                break
            whole = len(rows) == len(cost)
            at = every if whole else torch.from_numpy(rows).to(device)
            old = state if whole else tuple([t[at] for t in state])
            system = problem.linearised(old, at)
            before = cost[rows]
            # an upper bound of sum((r + d)^2) - sum(r^2) for residuals r and their rounding d
            rounding = 2 * np.sqrt(before * own_rounding[rows]) + own_rounding[rows]
            enough = np.maximum(parts[rows] * before, rounding)
            last = system.decrement.numpy(force=True) <= enough
        weight = weights[rows]
        step, promised = system.step(torch.from_numpy(weight).to(device))
        new = problem.moved(old, step, at)
        after = problem.cost(new, at).numpy(force=True)
        kept = (before - after) / np.maximum(promised.numpy(force=True), np.finfo(cost.dtype).tiny)
        better = (after < before) | (last & (after <= before + np.maximum(rounding, 1e-12 * before)))
        stuck = ~better & ((weight >= MOST_DAMPING) | last)
        if whole and better.all():
            state = new
        elif better.any():
            where = torch.from_numpy(better).to(device)
            state = tuple([t.index_copy(0, at[where], part[where]) for t, part in zip(state, new, strict=True)])
        cost[rows] = np.where(better, after, before)
        factor = np.where(kept > _GOOD, 0.1, np.where(kept > _FAIR, 1.0, 2.0))
        weights[rows] = (weight * np.where(better, factor, growth[rows])).clip(LEAST_DAMPING, MOST_DAMPING)
        growth[rows] = np.where(better, 4.0, growth[rows] * 2).clip(max=64.0)
        settled = last | (cost[rows] <= least[rows])
        if stuck.any():
            settled = settled | stuck & (system.firm_decrement.numpy(force=True) <= enough)
        converged[rows] = settled
        is_going[rows] = ~(settled | stuck)
        if better.any() or stuck.any():
            system = None
    return Minimum(state, *(torch.from_numpy(t).to(device) for t in (cost, converged)))
