"""Derivatives by autograd, for charts, stages and radial factors that only state their formula."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import torch
from torch import Tensor

from camtorch.evaluate.tensors import is_unknown


def jacobian_of(part: Any, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return du/da, du/db, dv/da, dv/db of a map (a, b) -> (u, v), such as a stage, at each point. Graph-free."""
    if is_unknown(a):
        one, zero = torch.ones_like(a), torch.zeros_like(a)
        (ua, va), (ub, vb) = (torch.func.jvp(part, (a, b), along)[1] for along in ((one, zero), (zero, one)))
        return ua, ub, va, vb
    # an operator's code may run where no transform works, so reverse mode is used
    with _recorded():
        leaves = _leaf(a), _leaf(b)
        u, v = _usable(part)(*leaves)
        ua, ub = torch.autograd.grad(u.sum(), leaves, retain_graph=True, materialize_grads=True)
        va, vb = torch.autograd.grad(v.sum(), leaves, materialize_grads=True)
    return ua, ub, va, vb


def derivatives_of(part: Any, t: Tensor, order: int) -> tuple[Tensor, ...]:
    """Return the value and the first `order` derivatives of a factor at each number; the derivatives are graph-free."""
    if order == 0:
        return (part(t),)
    if is_unknown(t):

        def slope(of: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
            return lambda t: torch.func.jvp(of, (t,), (torch.ones_like(t),))[1]

        formula, results = part, [part(t)]
        for _ in range(order):
            formula = slope(formula)
            results.append(formula(t))
        return tuple(results)
    with _recorded():
        leaf = _leaf(t)
        results = [_usable(part)(leaf)]
        for _ in range(order):
            results += torch.autograd.grad(results[-1].sum(), leaf, create_graph=True, materialize_grads=True)
    return tuple([w.detach() for w in results])


@contextmanager
def _recorded() -> Iterator[None]:
    """Record a graph for this derivative alone, whatever is recorded around it and however that keeps its tensors."""
    with ExitStack() as stack:
        stack.enter_context(torch.inference_mode(False))
        stack.enter_context(torch.enable_grad())
        with suppress(RuntimeError):  # within torch.func's transforms there are no hooks, and torch refuses new ones
            stack.enter_context(torch.autograd.graph.saved_tensors_hooks(lambda tensor: tensor, lambda tensor: tensor))
        yield


def _usable(part: Any) -> Any:
    """Return the stage or factor with parameters that a graph may keep, unlike those made in inference mode."""
    if not any(w.is_inference() for w in getattr(part, "parameters", ())):
        return part
    usable = copy.copy(part)
    usable.parameters = tuple(w.clone() for w in part.parameters)
    return usable


def _leaf(plane: Tensor) -> Tensor:
    return (plane.clone() if plane.is_inference() else plane.detach()).requires_grad_()
