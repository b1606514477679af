"""Exported programs: modules that are constants of them, recorded with operators that other runtimes have."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import reduce
from typing import Any

import torch
from torch import Tensor, nn

from camtorch.evaluate.door import set_aside, while_loop

_recording = False


def is_portable_export() -> bool:
    """Whether a camera is recorded as a constant of an exported program, without operators of our own."""
    return _recording


@contextmanager
def portable_export() -> Iterator[None]:
    """Record cameras like that in here."""
    global _recording
    before, _recording = _recording, True
    try:
        yield
    finally:
        _recording = before


# the optimiser of ONNX programs drops terms that are nearly 0 and factors that are nearly 1, to 1e-8 and 1e-5


def plus(a: Tensor, least: float) -> Tensor:
    """Return the sum of a tensor and a tiny number, which is not left out."""
    if not torch.compiler.is_exporting():
        return a + least
    bits = -math.floor(math.log2(abs(least)))
    # powers of two cost no bit; numbers of float64 programs go by way of float32, in which 2^100 is one
    steps = [2.0**100] * (bits // 100) + [2.0 ** (bits % 100)]
    a = reduce(torch.mul, steps, a) + least * 2.0**bits
    return reduce(torch.mul, (1 / step for step in steps), a)


def times(a: Tensor, nearly_one: float) -> Tensor:
    """Return the product of a tensor and a number next to 1."""
    return a * nearly_one if not torch.compiler.is_exporting() else a * 0.5 * (2 * nearly_one)


def as_index(position: Tensor) -> Tensor:
    """Return the integer below a position, in as few bits as serve; NaN becomes some integer."""
    return position.to(torch.int64 if torch.compiler.is_exporting() else torch.int32)


def of_points(k: Tensor, camera: Tensor) -> tuple[Tensor, ...]:
    """Return the columns (M,) of coefficients (C, n) for points seen by the cameras of these indices."""
    if is_portable_export():  # a recorded loop takes no views of one tensor, and no tensor of size one
        return tuple(c[camera] for c in k.unbind(-1))
    # a single camera serves all points
    return (k[0].unsqueeze(-1) if len(k) == 1 else k[camera].mT).unbind(0)


def repeat(
    step: Callable[..., tuple[Tensor, ...]], moves: Tensor, state: Sequence[Tensor], most: int
) -> tuple[Tensor, ...]:
    """Return moves and state after at most `most` steps, which end if none of `moves`, bool, is set."""
    if not is_portable_export():
        for _ in range(most):
            if not bool(moves.any()):
                break
            moves, *state = step(moves, *state)
        return (moves, *state)

    start = (torch.zeros((), dtype=torch.int64, device=moves.device), moves, *(w.clone() for w in state))
    return while_loop(
        lambda count, moves, *_: (count < most) & moves.any(), lambda count, *given: (count + 1, *step(*given)), start
    )[1:]


def piece_of(nodes: tuple[Tensor, ...], place: Tensor) -> Tensor:
    """Return how many of the nodes, columns that broadcast against planes, lie at or before each place."""
    if torch.compiler.is_exporting():  # one by one, as all comparisons together take memory
        return reduce(torch.add, [(node <= place).long() for node in nodes])
    table = torch.stack(nodes, -1).contiguous()
    if not table.shape[:-1] or table.shape[-2] != 1:  # each place has its own nodes
        return torch.searchsorted(table, place.unsqueeze(-1).contiguous(), right=True).squeeze(-1)
    table = table.squeeze(-2).expand(*place.shape[:-1], -1)
    return torch.searchsorted(table.contiguous(), place.contiguous(), right=True)


def pick(columns: Sequence[Tensor], index: Tensor) -> Tensor:
    """Return at each place the value of the column with its `index`."""
    if torch.compiler.is_exporting():  # sizes may be unknown, and are not compared
        found = columns[0] + torch.zeros_like(index, dtype=columns[0].dtype)
        for i, column in enumerate(columns[1:], 1):
            found = torch.where(index == i, column, found)
        return found
    table = torch.stack(torch.broadcast_tensors(*columns), -1)
    _, index = torch.broadcast_tensors(table[..., 0], index)
    return table.expand(*index.shape, -1).gather(-1, index.unsqueeze(-1)).squeeze(-1)


def solve_tridiagonal(below: Tensor, main: Tensor, above: Tensor, right: Tensor) -> Tensor:
    """Return the solution (*B, N) of equations with diagonals (*B, N - 1), (*B, N), (*B, N - 1)."""
    if not torch.compiler.is_exporting():
        matrix = torch.diag_embed(main) + torch.diag_embed(above, 1) + torch.diag_embed(below, -1)
        found: Tensor = torch.linalg.solve(matrix, right.unsqueeze(-1)).squeeze(-1)
        return found
    # by Gaussian elimination from the first to the last, and back
    lower, upper, pivots, values = below.unbind(-1), above.unbind(-1), [main[..., 0]], [right[..., 0]]
    for i, factor in enumerate(lower):
        share = factor / pivots[i]
        pivots.append(main[..., i + 1] - share * upper[i])
        values.append(right[..., i + 1] - share * values[i])
    solution = [values[-1] / pivots[-1]]
    for i in reversed(range(len(upper))):
        solution.append((values[i] - upper[i] * solution[-1]) / pivots[i])
    return torch.stack(solution[::-1], -1)


def unbound(table: Tensor) -> tuple[Tensor, ...]:
    """Return the columns (...) of a table (..., N)."""
    columns = table.unbind(-1)
    # a recorded loop takes no views of one tensor
    return tuple(c.clone() for c in columns) if torch.compiler.is_exporting() else columns


def atan2(y: Tensor, x: Tensor) -> Tensor:
    """Return torch.atan2; ONNX's composed one is -pi at y = 0, x < 0, and ONNX Runtime has none in float64."""
    if not torch.compiler.is_exporting():
        return torch.atan2(y, x)
    y, x = torch.broadcast_tensors(y, x)
    behind = (y == 0) & (x < 0)
    if y.dtype != torch.float64:
        return torch.where(behind, math.pi, torch.atan2(y, x))
    nearly = torch.where(behind, math.pi, torch.atan2(y.float(), x.float())).double()
    c, s = torch.cos(nearly), torch.sin(nearly)
    along = x * c + y * s
    # the rest is about 1e-7, whose fifth power is negligible
    rest = torch.where(along > 0, (y * c - x * s) / torch.where(along > 0, along, 1.0), 0.0)
    return nearly + (rest - rest * rest * rest / 3)


def as_constant() -> AbstractContextManager[None]:
    """Make constants in here, if a camera is recorded without operators of our own."""
    return set_aside() if is_portable_export() else nullcontext()


@contextmanager
def with_values(module: nn.Module) -> Iterator[None]:
    """Suspend tracing in here, and give a module that `is_constant` its own tensors, to make constants from."""
    places: list[tuple[dict[str, Any], str, Tensor]] = []
    for part in module.modules():
        own = part.__dict__.get("_untraced", {})
        places += [(tensors, name, own[name]) for tensors in (part._parameters, part._buffers) for name in tensors]
    traced = [tensors[name] for tensors, name, _ in places]
    with set_aside():
        try:
            for tensors, name, own in places:
                tensors[name] = own
            yield
        finally:
            for (tensors, name, _), tensor in zip(places, traced, strict=True):
                tensors[name] = tensor
