"""The inverse of a radial factor: its fold, a table to start from, Newton's method, and at last a bracket."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from camtorch.evaluate.export import as_index, is_portable_export, of_points, repeat, times
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.recorded import CLASSES
from camtorch.evaluate.tensors import are_concrete, may_branch_on
from camtorch.native.structs import NODES
from camtorch.optics.charts import even_steps_and_ratios
from camtorch.optics.radial import RadialFactor
from camtorch.values.arguments import columns

RADII = 1024  # at which a factor is followed to its fold
_PARTS = 256  # of the interval with a fold, divided twice before the secant
TABLE_WIDTH = 2 + 2 * NODES  # columns of `tabulate`
_MOST_ROOTS = 16  # square ones, that are taken of a radius until its image is a number
_HALF_WAY = 2.0  # the squared radius in the middle of the table of a lens that never folds
MOST_STEPS = 5  # of Newton's method; slower methods finish what still moves
WITHOUT_FLOAT64 = ("mps",)  # types of devices


def precise(k: Tensor) -> Tensor:
    """Return the tensor in double precision, if the device has it."""
    return k if k.device.type in WITHOUT_FLOAT64 else k.double()


def short(dtype: torch.dtype) -> float:
    """Return the relative length of a step of Newton's method after which the next one is negligible."""
    # the next step is about the square of this one
    return math.sqrt(torch.finfo(dtype).eps) / 8


def within(fold: Tensor) -> Tensor:
    """Return the squared radius up to which a lens with this fold is certainly regular."""
    return times(fold, 1 - 4 * torch.finfo(fold.dtype).eps) ** 2


def first_loss(orientation: Tensor, spared: Tensor | None = None) -> Tensor:
    """Return the node (*B, A) at which (*B, A, S) is first lost, or dips outside of `spared`; S if never.

    The parabola through the values at three nodes is here - tilt x / 2 + bend x^2 / 2, at x nodes from the middle one.
    Its bottom is here - tilt^2 / (8 bend), at x = tilt / (2 bend).
    """
    before, here, after = orientation[..., :-2], orientation[..., 1:-1], orientation[..., 2:]
    bend, tilt = before - 2 * here + after, before - after
    bend_safe = torch.where(bend > 0, bend, 1.0)
    is_between = (bend > 0) & (tilt.abs() <= bend)  # the bottom is within half a node
    dips = is_between & (here - tilt * tilt / (8 * bend_safe) <= 0)
    dips = dips if spared is None else dips & ~spared[..., 1:-1]
    offset = torch.where(dips & (here > 0), tilt / (2 * bend_safe), 0.0)
    nodes = torch.arange(orientation.shape[-1], dtype=orientation.dtype, device=orientation.device)
    inner = torch.where(dips | ~(here > 0), nodes[1:-1] + offset, torch.inf)
    ends = torch.where(orientation[..., [0, -1]] > 0, torch.inf, nodes[[0, -1]])
    return torch.cat((inner, ends), -1).amin(-1).clamp(max=orientation.shape[-1])


def fold_of(radial: RadialFactor, sampled: Callable[[], Tensor], end: float | Tensor, most: float) -> Tensor:
    """Return the least radius (C, 1) at which a factor is irregular or its image above `most`, or the end.

    `sampled` returns ascending radii (RADII,), at which it is followed outwards if it has no closed form.
    """
    if radial.fold is not None:
        return radial.fold.clamp(max=end)
    # the fold is searched for if the numbers are not known
    k = radial.parameters[0]
    fold = radial.closed_fold() if k.dtype == torch.float64 and not k.is_meta else None
    if fold is not None:
        return _up_to_numbers(radial, fold.clamp(max=end), most)
    return _followed_to_fold(radial, sampled(), end, most)


def _up_to_numbers(radial: RadialFactor, fold: Tensor, most: float) -> Tensor:
    """Return the fold, or the radius (C, 1) before it from which the factor's image is above `most`."""

    def is_number(radius: Tensor) -> Tensor:
        return radius * radial(radius * radius) <= most

    good = is_number(fold)
    if bool(good.all()):
        return fold
    # roots of the radius, until its image is a number; then bisection of its logarithm
    low, high = fold, fold
    for _ in range(_MOST_ROOTS):
        low = torch.where(good | is_number(low), low, torch.where(low > 2, low.sqrt(), low / 2))
    for _ in range(64):
        middle = low.sqrt() * high.sqrt()
        inside = is_number(middle)
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    return torch.where(good, fold, low)


def _followed_to_fold(radial: RadialFactor, radii: Tensor, end: float | Tensor, most: float) -> Tensor:
    """Return `fold_of` (C, 1) of a factor that is followed outwards at radii (RADII,)."""

    def orientation(radius: Tensor) -> Tensor:
        found, image = radial.orientation(radius), radius * radial(radius * radius)
        return torch.where(image < most, found, -1.0)

    nodes = radii.clamp(max=end)
    followed = orientation(nodes)
    nodes, lost = nodes.expand_as(followed), first_loss(followed).unsqueeze(-1)
    last = nodes.shape[-1] - 1

    def node(index: Tensor) -> Tensor:
        return nodes.gather(-1, index.long().clamp(0, last))

    # the interval in which it is lost; at a dip between nodes its upper end is the bottom of the parabola
    low, high = node((lost - 1).floor()), node(lost.ceil())
    before_dip = node(lost.floor())
    at_dip = before_dip + (lost - lost.floor()) * (high - before_dip)
    high = torch.where(lost == lost.floor(), high, at_dip)
    # divided twice
    steps = torch.linspace(0, 1, _PARTS + 1, dtype=radii.dtype, device=radii.device)
    for _ in range(2):
        inner = low + (high - low) * steps
        # the upper end counts as lost, whatever its rounding is
        first = (orientation(inner) > 0).long().cumprod(-1).sum(-1, keepdim=True).clamp(1, _PARTS)
        low, high = inner.gather(-1, first - 1), inner.gather(-1, first)
    # and at last a secant
    before, after = orientation(low), orientation(high)
    crossing = (before > 0) & (after < 0)
    share = torch.where(crossing, before / torch.where(crossing, before - after, 1.0), 0.0)
    return torch.where(lost <= last, low + share * (high - low), end)


def tabulate(radial: RadialFactor, fold: Tensor, usual_end: float | Tensor) -> Tensor:
    """Return the table (C, 2 + 2 nodes) of an `InverseTable`."""
    # at points in even steps, the factor by which the inverse scales their images back, and the images' squared radii
    end = fold.clamp(max=usual_end)
    u = torch.linspace(0, 1, NODES + 1, dtype=fold.dtype, device=fold.device)
    square = _square(u, end * end)
    factor = radial(square)
    scale, r2 = factor.reciprocal(), (square * factor * factor).cummax(-1).values
    reach2 = r2[..., -1:]
    # the nodes are images in even steps: there it is interpolated
    at = _variable(r2, reach2)
    cell = (torch.searchsorted(at, u.expand_as(at).contiguous(), right=True) - 1).clamp(0, NODES - 1)
    low, high = at.gather(-1, cell), at.gather(-1, cell + 1)
    before, step = scale.gather(-1, cell), scale.diff(dim=-1).gather(-1, cell)
    values = before + ((u - low) / torch.where(high > low, high - low, 1.0)).clamp(0, 1) * step
    # and improved by two of Newton's steps for s R(r2 s^2) = 1, none longer than that between its neighbours
    wanted = _square(u, reach2)
    for _ in range(2):
        t = wanted * values * values
        factor, slope = radial.derivatives(t, 1)
        slope = factor + 2 * t * slope
        correction = (values * factor - 1) / torch.where(slope > 0, slope, 1.0)
        values = values - torch.maximum(torch.minimum(correction, step.abs()), -step.abs())
    values = torch.cat((values[..., :-1], scale[..., -1:]), -1)
    most2 = torch.where(fold > usual_end, torch.inf, reach2)
    return torch.cat((reach2, most2, values[..., :-1], values.diff(dim=-1)), -1)


def _variable(r2: Tensor, top2: Tensor) -> Tensor:
    """Return the variable u of an `InverseTable`, from 0 to 1 at `top2`, for squared radii."""
    x = r2 / (r2 + _HALF_WAY) * ((top2 + _HALF_WAY) / top2)
    return 1 - (1 - x).clamp(min=0).sqrt()


def _square(u: Tensor, top2: Tensor) -> Tensor:
    """Return the squared radii whose `_variable` is u."""
    x = u * (2 - u) * (top2 / (top2 + _HALF_WAY))
    return _HALF_WAY * x / (1 - x)


class InverseTable:
    """The factor by which the inverse of a radial factor scales a point, tabulated over the point's squared radius r2.

    The table's variable is 1 - sqrt(1 - x), x = r2 / (r2 + 2) scaled to 1 at the fold: it removes the root singularity
    at the fold from the inverse, and is as analytic in r2 as that.
    """

    def __init__(self, table: Tensor, *, is_constant: bool = False):
        """Split a `table` of `tabulate` into its parts, which are no views if `is_constant`."""
        self.is_constant = is_constant
        parts = table[..., :1], table[..., 1:2], table[..., 2 : 2 + NODES], table[..., 2 + NODES :]
        self.reach2, self.most2, self.values, self.steps = (p.clone() for p in parts) if is_constant else parts

    def __call__(self, r2: Tensor) -> Tensor:
        """Return the factor for (C, N), accurate to about 1e-6."""
        position = _variable(r2, self.reach2) * NODES
        node = as_index(position).clamp(0, NODES - 1)
        fraction = position - node
        if self.values.shape[0] > 1:
            node = node + torch.arange(self.values.shape[0], device=r2.device, dtype=node.dtype).unsqueeze(-1) * NODES
        node = node.flatten()
        value, step = self.values.flatten().index_select(0, node), self.steps.flatten().index_select(0, node)
        return torch.addcmul(value.view(r2.shape), fraction, step.view(r2.shape))


def solve(radial: RadialFactor, table: InverseTable, r2: Tensor) -> tuple[Tensor, Tensor]:
    """Return the factor by which the inverse scales points of squared radius r2, and a number > 0 if it converged."""
    scale, converged, looks = table(r2), None, may_branch_on(r2)
    for _ in range(MOST_STEPS):  # of Newton's method for s R(r2 s^2) = 1, in which the axis is not special
        t = r2 * scale * scale
        factor, slope = radial.derivatives(t, 1)
        step = (1 - scale * factor) / torch.addcmul(factor, t, slope, value=2)
        if converged is not None:  # stop converged points, so that a result is the same in any batch
            step = torch.where(converged > 0, 0.0, step)
        scale = scale + step
        converged = short(scale.dtype) * scale - step.abs()
        if looks and bool(converged.amin() > 0):
            break
    assert converged is not None  # there are steps
    return scale, converged


def bracketed(radial: RadialFactor, r2: Tensor, safe_radius_sq: Tensor) -> Tensor:
    """Return the factor of `solve` for single points (M,), each with its own coefficients and its own fold.

    Cauchy's method steps to the root of the local parabola: of third order at the fold too, where Newton's crawls.
    """
    eps = torch.finfo(r2.dtype).eps
    wanted, high = r2.sqrt(), safe_radius_sq.sqrt().expand_as(r2)

    def ahead_of(rho: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        t = rho * rho
        value, first, second = radial.derivatives(t, 2)
        slope, bend = value + 2 * t * first, rho * (6 * first + 4 * t * second)
        error = wanted - rho * value
        low, high = torch.where(error > 0, rho, low), torch.where(error > 0, high, rho)
        denominator = slope.abs() + (slope * slope + 2 * bend * error).clamp(min=0).sqrt()
        ahead = rho + 2 * error / torch.where(denominator > 0, denominator, 1.0)
        return torch.minimum(torch.maximum(ahead, low), high), low, high

    def step(moves: Tensor, rho: Tensor, low: Tensor, high: Tensor, width: Tensor) -> tuple[Tensor, ...]:
        ahead, low, high = ahead_of(rho, low, high)
        moves = moves & ((ahead - rho).abs() > 2 * eps * rho)
        rho = torch.where(moves, ahead, rho)
        ahead, low, high = ahead_of(rho, low, high)
        moves = moves & ((ahead - rho).abs() > 2 * eps * rho)
        ahead = torch.where(high - low > width / 2, (low + high) / 2, ahead)
        return moves, torch.where(moves, ahead, rho), low, high, high - low

    rho = torch.minimum(wanted, high)
    state = rho, torch.zeros_like(r2), high, high
    _, rho, *_ = repeat(step, torch.ones_like(rho, dtype=torch.bool), state, -2 * int(math.log2(eps)))
    return radial(rho * rho).reciprocal()


class RadialInverse:
    """The inverse of a factor, graph-free, up to the squared radii of its fold and of the fold's image, `most2`."""

    def __init__(self, factor: type[RadialFactor], parameters: Sequence[Tensor], end: float):
        """Tabulate a class of factors, for coefficients (C, 1) of cameras or (M,) of single points, up to a radius."""
        parameters = [w.detach() for w in parameters]
        self.factor, self.radial, self.end = factor, factor(parameters), end
        self.of_points = parameters[0].ndim < 2
        self.k = torch.stack(parameters, -1).reshape(parameters[0].numel(), len(parameters))
        k, rows = self.k, None
        self._table: InverseTable | None = None
        if is_portable_export():
            safe_radius_sq, table = _make_tables(factor.name, k, end)
            self._table = InverseTable(table, is_constant=True)
            most2 = self._table.most2
        else:
            if self.of_points and len(k) > 1:
                k, rows = k.unique(dim=0, return_inverse=True)
            _, safe_radius_sq, most2 = _inverse_of(factor.name, k, end, k.new_empty(len(k), 0))
        of_each = [w if rows is None else w[rows] for w in (safe_radius_sq, most2)]
        self.safe_radius_sq, self.most2 = (w.reshape(parameters[0].shape).clone() for w in of_each)

    def __call__(self, r2: Tensor) -> Tensor:
        """Return the factor by which it scales points of squared radius r2, (C, ...) or (M,), up to `most2`."""
        if self.of_points:
            return bracketed(self.radial, r2, self.safe_radius_sq)
        rows = r2.unsqueeze(-1).flatten(1)
        if self._table is not None:
            safe_radius_sq = self.safe_radius_sq.reshape(-1, 1)
            return _scale(self.factor.name, self.k, safe_radius_sq, self._table, rows).view_as(r2)
        return _inverse_of(self.factor.name, self.k, self.end, rows)[0].view_as(r2)


_tables = Kept(8)


def _make_tables(name: str, k: Tensor, end: float) -> tuple[Tensor, Tensor]:
    wide = precise(k)
    radial = CLASSES[name](columns(wide))
    most = torch.finfo(k.dtype).max ** 0.25
    fold = fold_of(radial, lambda: even_steps_and_ratios(RADII, end, end, wide, torch.positive), end, most)
    return within(fold.to(k.dtype)), tabulate(radial, fold, end).to(k.dtype)


def _scale(name: str, k: Tensor, safe_radius_sq: Tensor, table: InverseTable, r2: Tensor) -> Tensor:
    """Return the factors for coefficients (C, n) and r2 (C, N), by `solve`, or `bracketed` if Newton's method fails."""
    scale, converged = solve(CLASSES[name](columns(k)), table, r2)
    camera, point = (~(converged > 0)).nonzero(as_tuple=True)
    if table.is_constant or len(camera):
        radial = CLASSES[name](of_points(k, camera))
        found = bracketed(radial, r2[camera, point], safe_radius_sq[camera, 0])
        scale = scale.index_put((camera, point), found)
    return scale


def _compute_inverse(name: str, k: Tensor, end: float, r2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the factors for coefficients (C, n) and squared radii (C, N), and two tensors of `RadialInverse`."""
    safe_radius_sq, table = _tables((k,), (name, end), lambda: _make_tables(name, k.detach(), end))
    inverse = InverseTable(table)
    scale = _scale(name, k, safe_radius_sq, inverse, r2) if r2.numel() else torch.empty_like(r2)
    # clones, as the caller may write into them
    return scale, safe_radius_sq.clone(), inverse.most2.clone()


_radial_inverse = torch.library.custom_op("camtorch::radial_inverse", _compute_inverse, mutates_args=())


def _inverse_of(name: str, k: Tensor, end: float, r2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    # the operator serves graphs and transforms alone: its first call imports torch's compiler, which takes seconds
    of = _compute_inverse if are_concrete(k, r2) else _radial_inverse
    return of(name, k, end, r2)


@_radial_inverse.register_fake
def _(name: str, k: Tensor, end: float, r2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return torch.empty_like(r2), k.new_empty(len(k), 1), k.new_empty(len(k), 1)


@_radial_inverse.register_vmap
def _(info: Any, in_dims: tuple[Any, ...], name: str, k: Tensor, end: float, r2: Tensor) -> Any:
    _, of_k, _, of_r2 = in_dims
    r2 = r2.expand(info.batch_size, *r2.shape) if of_r2 is None else r2.movedim(of_r2, 0)
    if of_k is None:  # the mapped dim joins the points
        r2 = r2.movedim(0, 1)
        found, safe_radius_sq, most2 = _radial_inverse(name, k, end, r2.flatten(1))
        return (found.unflatten(1, r2.shape[1:]), safe_radius_sq, most2), (1, None, None)
    results = _radial_inverse(name, k.movedim(of_k, 0).flatten(0, 1), end, r2.flatten(0, 1))
    return tuple(r.unflatten(0, r2.shape[:2]) for r in results), (0, 0, 0)
