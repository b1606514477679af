"""A contestant's direction as something to time: forward, and forward with backward."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from benchmarks.point_peers import COPY, Contestant, Direction
from benchmarks.timing import Run


def prepared(everyone: list[Contestant], name: str, source: Tensor) -> dict[str, tuple[Direction, Any]]:
    """Who has a direction, with the input as it takes it."""
    directions = {c.name: d for c in everyone if (d := getattr(c, name)) is not None}
    return {who: (d, d.prepare(source)) for who, d in directions.items()}


def passes(everyone: list[Contestant], name: str, source: Tensor) -> Iterator[tuple[str, dict[str, Run]]]:
    """Both operations of a direction, each with those that can do it; a cold copy is the floor of either."""
    found = prepared(everyone, name, source)
    yield name, {who: inference(d, x) for who, (d, x) in found.items()}
    both = {who: learning(d, x) for who, (d, x) in found.items() if d.learns is not None}
    if COPY in found:
        both[COPY] = inference(*found[COPY])
    yield f"{name} f+b", both


def inference(direction: Direction, source: Any) -> Run:
    """The forward pass alone, without a graph."""

    def run():
        with torch.no_grad():
            return direction.call(source)

    return run


def learning(direction: Direction, source: Tensor) -> Run:
    """Forward and backward, with gradients to the input and all parameters.

    The gradient that comes in has the layout of the result, as that of a loss would.
    """
    gradient = None

    def run():
        nonlocal gradient
        leaf = source.detach().requires_grad_()
        values = direction.values(leaf)
        gradient = torch.ones_like(values) if gradient is None else gradient
        return torch.autograd.grad(values, (leaf, *direction.learns), gradient)

    return run
