"""Rows of points and the cameras that see them: in blocks, with masks, and the sums of the parameters' cotangents."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import torch
from torch import Tensor

from camtorch._arguments import columns, holds
from camtorch._portable import is_portable_export
from camtorch._threads import ALONE, EVEN, on_one_thread, spread, thread_count
from camtorch._tracing import is_recorded
from camtorch.optics.radial import total
from camtorch.projection.domain import Domain, domain_of
from camtorch.projection.ops import tables

if TYPE_CHECKING:
    from camtorch.camera import Camera
    from camtorch.optics.charts import Chart
    from camtorch.optics.lens import Lens

Planes2 = tuple[Tensor, Tensor]
Planes3 = tuple[Tensor, Tensor, Tensor]
Columns = tuple[Tensor, ...]
R = TypeVar("R")

_BLOCK = 170 * EVEN  # points, not quite 2^16: temporaries stay in the cache, and each thread has one
FEW = 1024
"""Points of one camera that are fewer than the nodes of its table."""


# -- the cameras of rows (C, N)


class Cameras(NamedTuple):
    """Cameras, each of which sees one row: the values of their parameters, and what was tabulated for them.

    A camera that learning drove to NaN, to a focal length that is not positive or to coefficients without a formula is
    replaced by an ideal one, and all its results are invalid.
    """

    given: tuple[Tensor, Tensor]  # (C, 4), (C, n), as they came
    intrinsics: Tensor
    columns: tuple[Tensor, ...]  # those of the intrinsics
    domain: Domain
    usable: Tensor | None  # (C, 1) mask, None where all are
    adaptive: bool
    """Whether a look at values costs next to nothing, to take a shorter way with a whole block."""

    @classmethod
    def of(cls, model: type[Camera], intrinsics: Tensor, distortion: Tensor) -> Cameras:
        """Those of concrete values (C, 4), (C, n)."""
        with torch.no_grad():
            given = intrinsics.detach().clone(), distortion.detach().clone()
            usable, values, mask = _usable(model, *given), given, None
            if not holds(usable):
                ideal = _ideal(model, *given)
                values = torch.where(usable, given[0], ideal[0]), torch.where(usable, given[1], ideal[1])
                mask = usable.to(intrinsics.dtype)
            # what learns will not be seen again
            learns = distortion.requires_grad
            domain = Domain(model.optics, values[1]) if learns else domain_of(model._model, values[1], model.optics)
            return cls(given, values[0], columns(values[0]), domain, mask, intrinsics.is_cpu)

    def are(self, intrinsics: Tensor, distortion: Tensor) -> bool:
        """Whether they are those of these values."""
        for now, then in ((intrinsics, self.given[0]), (distortion, self.given[1])):
            if now.dtype != then.dtype or now.device != then.device or not torch.equal(now, then):
                return False
        return True


def _usable(model: type[Camera], intrinsics: Tensor, distortion: Tensor) -> Tensor:
    """Bool (C, 1): finite, with focal lengths that are positive, and coefficients for which the formula exists."""
    finite = torch.isfinite(intrinsics).all(-1) & torch.isfinite(distortion).all(-1)
    usable = finite & (intrinsics[..., :2] > 0).all(-1)
    defined = model.defined(distortion.unbind(-1)) if distortion.shape[-1] else None
    return (usable if defined is None else usable & (defined > 0)).unsqueeze(-1)


def _ideal(model: type[Camera], intrinsics: Tensor, distortion: Tensor) -> tuple[float, float | Tensor]:
    ideal = model.ideal(distortion.shape[-1])
    return 1.0, distortion.new_tensor(ideal) if any(ideal) else 0.0


class Traced(NamedTuple):
    """What a graph is recorded of: parameters that can be used, and what follows from their values."""

    model: type[Camera]
    intrinsics: Tensor
    distortion: Tensor
    domain: Domain
    usable: Tensor | None

    @classmethod
    def of(cls, model: type[Camera], intrinsics: Tensor, distortion: Tensor, cameras: Cameras | None) -> Traced:
        """cameras: those of the parameters, if their values may be looked at."""
        if cameras is not None:
            domain, usable = cameras.domain, cameras.usable
        else:
            able = _usable(model, intrinsics.detach(), distortion.detach())
            usable = able.to(intrinsics.dtype)
            k = torch.where(able, distortion.detach(), _ideal(model, intrinsics, distortion)[1])
            domain = Domain(model.optics, k)
            if is_portable_export():
                domain.with_all_tables()
            elif domain.lens.stages:
                domain.with_tables(*tables(model._model, k))
        if usable is not None:
            ideal = _ideal(model, intrinsics, distortion)
            intrinsics, distortion = (
                torch.where(usable > 0, t, w) for t, w in zip((intrinsics, distortion), ideal, strict=True)
            )
        return cls(model, intrinsics, distortion, domain, usable)


# -- blocks


class Block(NamedTuple):
    """A part of rows, and its cameras as columns that broadcast against planes of points, (C, N)."""

    cameras: slice
    points: slice
    here: tuple[slice, ...]  # both, or nothing for a block that is all there is
    intrinsics: Columns
    domain: Domain
    usable: Tensor | None

    @property
    def first(self) -> tuple[int, int]:
        """The first camera, and its first point."""
        return self.cameras.start, self.points.start


def blocks(given: Cameras, rows: Tensor) -> Iterator[Block]:
    """Parts of (C, N, ...) of about one size: of one camera's points, or of several cameras."""
    count, length = rows.shape[:2]
    if not rows.numel():
        return
    if not given.adaptive or count * length <= _BLOCK:  # elsewhere than on a CPU a kernel more costs more than memory
        everything = slice(0, count), slice(0, length)
        yield Block(*everything, (), given.columns, given.domain, given.usable)
        return
    if length > _BLOCK // 2:
        parts = -(-length // _BLOCK)
        even = EVEN if length // parts > ALONE else 1
        edges = [*(-(-length * i // (parts * even)) * even for i in range(parts)), length]
        spans = [(slice(c, c + 1), slice(*span)) for c in range(count) for span in pairwise(edges)]
    else:
        step = _BLOCK // length
        spans = [(slice(c, min(c + step, count)), slice(0, length)) for c in range(0, count, step)]
    last = None
    for cameras, points in spans:
        if last != cameras:
            last = cameras
            shared = columns(given.intrinsics[cameras]), given.domain.part(cameras)
            usable = None if given.usable is None else given.usable[cameras]
        yield Block(cameras, points, (cameras, points), *shared, usable)


def over_blocks(given: Cameras, rows: Tensor, work: Callable[[Block], R]) -> list[R]:
    """What is made of each block, in their order: several at a time, each on one thread.

    So results depend neither on the number of threads nor on who else wants the cores.
    """
    parts = list(blocks(given, rows))
    if not given.adaptive or rows.shape[:2].numel() <= ALONE:
        return list(map(work, parts))
    results: dict[int, R] = {}
    left, inference = iter(enumerate(parts)), torch.is_inference_mode_enabled()

    @on_one_thread
    def take() -> None:
        with torch.inference_mode(inference), torch.no_grad():
            for i, part in left:
                results[i] = work(part)

    spread(take, 1 if is_recorded() else min(thread_count(), len(parts)))
    return [results[i] for i in range(len(parts))]


def planes_of(rows: Tensor) -> tuple[Tensor, ...]:
    """(C, N, size) as contiguous planes (C, N)."""
    # twice as fast as a copy, and bit for bit the same
    return tuple([plane if plane.stride(-1) == 1 else plane - 0 for plane in rows.unbind(-1)])


# -- masks: 1 and 0 of the dtype of the planes, or None where all are 1
#
# On a CPU selecting by numbers is several times as fast as by bools, and compiled code writes bools one by one.


def to_mask(margin: Tensor, adaptive: bool) -> Tensor | None:
    """Where a margin is positive. adaptive: whether a look at it may find that it is so everywhere."""
    margin = margin.detach()
    if adaptive:
        return None if bool(margin.amin() > 0) else margin.nan_to_num(-1.0).relu().sign()
    return (margin > 0).to(margin.dtype)


def replace(mask: Tensor | None, plane: Tensor, value: float, adaptive: bool = False) -> Tensor:
    """The plane where the mask is 1, and the value where it is 0.

    adaptive: the faster way; it needs finite numbers in both places, and records no graph.
    """
    if mask is None:
        return plane
    if not adaptive:  # a cotangent need not be finite
        return torch.where(mask > 0, plane, value)
    return plane * mask if value == 0 else torch.lerp(plane.new_full((1, 1), value), plane, mask)


def both(*masks: Tensor | None) -> Tensor | None:
    """Where all masks are 1."""
    product = None
    for mask in masks:
        if mask is not None:
            product = mask if product is None else product * mask
    return product


# -- derivatives


class Sums:
    """The cotangents of the parameters, gathered from the blocks."""

    wants_intrinsics: bool
    wants_distortion: bool
    intrinsics: Tensor
    optics: list[Tensor]

    def __init__(self, cameras: Cameras, needs_input_grad: tuple[bool, ...], like: Tensor):
        self.cameras = cameras
        self.wants_intrinsics, self.wants_distortion = needs_input_grad[1:3]
        count = len(cameras.intrinsics)
        self.intrinsics = like.new_zeros(count, 4)
        learning = _parameters(cameras.domain.chart, cameras.domain.lens) if self.wants_distortion else ()
        self.optics = [like.new_zeros(count, 1) for _ in learning]

    def of_intrinsics(self, gu: Tensor, gv: Tensor, x: Tensor, y: Tensor) -> list[Tensor]:
        """Those of a block. gu, gv: the cotangents of pixels. x, y: the points on the plane of the lens."""
        return [total(plane) for plane in (gu * x, gv * y, gu, gv)] if self.wants_intrinsics else []

    def add(self, block: Block, of_intrinsics: list[Tensor], of_optics: list[Tensor]) -> None:
        """Add those of a block: of the intrinsics, and of the chart's parameters, then the lens's."""
        for i, part in enumerate(of_intrinsics):
            self.intrinsics[block.cameras, i, None] += part
        for whole, part in zip(self.optics, of_optics, strict=True):
            whole[block.cameras] += part

    def result(self) -> tuple[Tensor | None, Tensor | None]:
        """Those of the intrinsics and of the distortion, whose part in chart and lens is whatever the model says."""
        by_distortion = None
        if self.wants_distortion:
            with torch.enable_grad():
                k = self.cameras.domain.k.detach().requires_grad_()
                pairs = zip(_parameters(*self.cameras.domain.optics(columns(k))), self.optics, strict=True)
                outputs, sums = zip(*(pair for pair in pairs if pair[0].requires_grad), strict=True)
                (by_distortion,) = torch.autograd.grad(outputs, k, sums, materialize_grads=True)
        return self.intrinsics if self.wants_intrinsics else None, by_distortion


def _parameters(chart: Chart, lens: Lens) -> tuple[Tensor, ...]:
    return *chart.parameters, *lens.parameters


def by_formulas(
    traced: Callable[..., tuple[Tensor, Tensor]], inputs: Sequence[Tensor], wanted: tuple[bool, ...], cotangent: Tensor
) -> tuple[Tensor | None, ...]:
    """The cotangents of rows, intrinsics and distortion with a graph of their own, from what is traced of them."""
    leaves = [t for t, needed in zip(inputs, wanted, strict=False) if needed]
    result, _ = traced(*inputs)
    gradients = iter(torch.autograd.grad(result, leaves, cotangent, create_graph=True, materialize_grads=True))
    return tuple([next(gradients) if needed else None for needed in wanted[:3]])
