"""Losses of residuals: least squares, and robust ones, for which outliers count less."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.values.arguments import as_number, shown

LOSSES = ("huber", "cauchy")


class Loss(NamedTuple):
    """A loss by its name, None for least squares, and the length in px from which it grows slower."""

    name: str | None = None
    scale: float = 1.0

    def of(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        """Return the costs of residuals by their squared lengths, and the derivatives: the weights of the squares.

        huber: s if s <= c^2, else 2 c sqrt(s) - c^2. cauchy: c^2 log(1 + s / c^2).
        """
        c2 = self.scale * self.scale
        if self.name == "huber":
            length = squares.clamp(min=c2).sqrt()
            return torch.where(squares <= c2, squares, 2 * self.scale * length - c2), self.scale / length
        if self.name == "cauchy":
            return c2 * torch.log1p(squares / c2), 1 / (1 + squares / c2)
        return squares, torch.ones_like(squares)

    def noise(self, residuals: Tensor, seen: Tensor, free: float) -> Tensor:
        """Return the noise (*B,), px per coordinate, at which a weighted problem has the covariance of its optimum.

        Of least squares it is sqrt(sum of squares / (2 N - free)). With weights w of the squares s of a robust loss it
        is sqrt(mean(w^2 s) mean(w)) / mean(w + s dw/ds), the scale of an M-estimator, which is right if outliers fall
        on all corners alike. residuals: (*B, V, N, 2). free: number of free parameters, poses included.
        """
        squares = residuals.square().sum(-1)
        _, weights = self.of(squares)
        change = torch.zeros_like(weights)
        if self.name == "huber":
            change = torch.where(weights < 1, -weights / 2, 0.0)
        elif self.name == "cauchy":
            change = weights * (weights - 1)
        terms = weights.square() * squares, weights, weights + change, torch.ones_like(weights)
        force, weight, slope, count = ((term * seen).sum((-1, -2)) for term in terms)
        return (force / (2 * count - free).clamp(min=1) * weight * count).sqrt() / slope.clamp(min=1)


LEAST_SQUARES = Loss()


def as_loss(name: str | None, scale: float, owner: str) -> Loss:
    """Return the loss of the arguments `loss` and `loss_scale`."""
    if name is not None and not (isinstance(name, str) and name in LOSSES):
        raise ValueError(f"{owner}: loss must be None or one of {LOSSES}; got {shown(name)}")
    if not 0 < as_number(scale, "loss_scale", owner) < math.inf:
        raise ValueError(f"{owner}: loss_scale must be positive pixels; got {scale}")
    return Loss(name, scale)
