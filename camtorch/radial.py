"""Radial factors of lenses whose radius is no odd function of the angle, and so not analytic at the centre."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from camtorch.analytic import root
from camtorch.lens import Polynomial


class RadiusPolynomial:
    """The radial factor R(t) = 1 + c0 s + c1 s^2 + ... of s = radius = sqrt(t).

    With odd powers of s the point m R(|m|^2) has one continuous derivative at the centre, and no second one: it depends
    on the direction from which the centre is approached. The one given there is zero, their mean.
    """

    def __init__(self, coefficients: Sequence[Tensor]):
        self.of_radius = Polynomial(coefficients)

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        return self.of_radius.parameters

    def __call__(self, t: Tensor) -> Tensor:
        return self.derivatives(t, 0)[0]

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """R and its first `order` derivatives by t, up to two; at the centre finite, for what is multiplied by t."""
        radius = root(t)
        factor, *by_radius = self.of_radius.derivatives(radius, order)
        if not order:
            return (factor,)
        slope = by_radius[0] / (2 * radius)
        if order == 1:
            return factor, slope
        return factor, slope, (by_radius[1] - 2 * slope) / (4 * radius * radius)

    def pull(self, t: Tensor, weight: Tensor) -> list[Tensor]:
        """The sums over the points of dR/dc weight, for each coefficient c."""
        return self.of_radius.pull(root(t), weight)


class RadiusTable:
    """The radial factor R(t) = r(s) / s of s = radius = sqrt(t), r a monotone cubic spline through (0, 0) and a table.

    Slopes at the nodes as Fritsch and Butland choose them (PCHIP), of the table and its mirror image through the
    origin. Behind its last node r turns back, so that the lens folds there. At the centre see `RadiusPolynomial`.
    """

    def __init__(self, nodes: Sequence[Tensor], values: Sequence[Tensor]):
        """nodes: ascending radii. values: r at the nodes, as many, two at least."""
        zero = torch.zeros_like(values[0])
        self.nodes, self.end = (zero, *nodes[:-1]), nodes[-1]
        steps = [after - before for before, after in pairwise((zero, *nodes))]
        secants = [
            (after - before) / step for (before, after), step in zip(pairwise((zero, *values)), steps, strict=True)
        ]
        slopes = _slopes(steps, secants)
        squares, cubes = [], []
        for (before, after), secant, step in zip(pairwise(slopes), secants, steps, strict=True):
            squares.append((3 * secant - 2 * before - after) / step)
            cubes.append((before + after - 2 * secant) / (step * step))
        self.cubics = (zero, *values[:-1]), slopes[:-1], squares, cubes

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        """The four coefficients of every piece, by powers."""
        return tuple(c for power in self.cubics for c in power)

    def __call__(self, t: Tensor) -> Tensor:
        return self.derivatives(t, 0)[0]

    def _at(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The radius, whether it lies behind the end (-1, or 1), the place in the table, its piece, the node before."""
        radius = root(t)
        behind = radius > self.end
        place = torch.where(behind, (2 * self.end - radius).clamp(min=0), radius)
        piece = sum((place >= node).long() for node in self.nodes[1:])
        return radius, torch.where(behind, -1.0, 1.0), place, piece, _pick(self.nodes, piece)

    def derivatives(self, t: Tensor, order: int) -> tuple[Tensor, ...]:
        """R and its first `order` derivatives by t, up to two; at the centre finite, for what is multiplied by t."""
        radius, sign, place, piece, node = self._at(t)
        constant, first, second, third = (_pick(power, piece) for power in self.cubics)
        v = place - node
        factor = (constant + v * (first + v * (second + v * third))) / radius
        if not order:
            return (factor,)
        by_radius = (sign * (first + v * (2 * second + 3 * v * third)) - factor) / radius
        slope = by_radius / (2 * radius)
        if order == 1:
            return factor, slope
        twice = (2 * second + 6 * v * third - 2 * by_radius) / radius
        return factor, slope, (twice - 2 * slope) / (4 * radius * radius)

    def pull(self, t: Tensor, weight: Tensor) -> list[Tensor]:
        """The sums over the points of dR/dc weight, for each coefficient c."""
        radius, _, place, piece, node = self._at(t)
        weight, v = weight / radius, place - node
        sums = []
        for _ in self.cubics:
            table = weight.new_zeros(*weight.shape[:-1], len(self.nodes)).scatter_add(-1, piece, weight)
            sums += table.split(1, -1)
            weight = weight * v
        return sums


def _pick(columns: Sequence[Tensor], index: Tensor) -> Tensor:
    """From each plane's own columns the one of that index."""
    table = torch.stack(torch.broadcast_tensors(*columns), -1)
    shape = torch.broadcast_shapes(table.shape[:-1], index.shape)
    return table.expand(*shape, -1).gather(-1, index.expand(shape).unsqueeze(-1)).squeeze(-1)


def _slopes(steps: Sequence[Tensor], secants: Sequence[Tensor]) -> list[Tensor]:
    """PCHIP's, at the nodes before, between and behind the pieces."""
    slopes = [secants[0]]  # the mirror image has the same secant
    for (h, step), (before, after) in zip(pairwise(steps), pairwise(secants), strict=True):
        some = before * after > 0
        left, right = 2 * step + h, step + 2 * h
        mean = left / torch.where(some, before, 1.0) + right / torch.where(some, after, 1.0)
        slopes.append(torch.where(some, (left + right) / torch.where(some, mean, 1.0), 0.0))
    (h, step), (before, after) = steps[-2:], secants[-2:]
    last = ((2 * step + h) * after - step * before) / (step + h)
    last = torch.where(last * after > 0, last, 0.0)
    bounded = (before * after <= 0) & (last.abs() > 3 * after.abs())
    return [*slopes, torch.where(bounded, 3 * after, last)]
