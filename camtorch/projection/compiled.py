"""Calls of the compiled geometry: cameras to codes and numbers, rows to pointers and strides, and tiles to threads."""

from __future__ import annotations

import ctypes
import functools
import operator
import struct
import threading
from collections.abc import Callable, Sequence
from ctypes import addressof, byref, c_bool, c_double, c_float, c_int32, c_int64, c_void_p, create_string_buffer
from itertools import accumulate
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from camtorch import optics
from camtorch.native import memory
from camtorch.native.library import library
from camtorch.native.sampler import CLASSIFICATION, PADDINGS, SCRATCH
from camtorch.optics.backprojection import FURTHEST
from camtorch.optics.radial_inverse import TABLE_WIDTH
from camtorch.values.arguments import columns
from camtorch.values.threads import spread, thread_count

if TYPE_CHECKING:
    from camtorch.optics.charts import Chart
    from camtorch.optics.lens import Lens, Stage
    from camtorch.optics.model_spec import Optics
    from camtorch.optics.radial import RadialFactor
    from camtorch.projection.domain import Domain

PROJECT, UNPROJECT, PROJECT_VJP, UNPROJECT_VJP = range(4)
_TILE = 1 << 14  # points of a tile, some 30 us
_SHARED = 1 << 15  # points that threads are woken for
_MOST_PARTS, _MOST_DEGREE = 5, 64
_RADII, _FOLLOWED, _AZIMUTHS = 512, 80, 336
_EXTENT = _FOLLOWED + _AZIMUTHS * (_FOLLOWED + 1)

_HAS_XI, _HAS_ALPHA, _HAS_BETA, _TRANSVERSE = 1, 2, 4, 8
_TANGENTIAL, _PRISM = 1, 2


def _fields(text: str, **others: type) -> tuple[tuple[str, type], ...]:
    """Those of a struct, by name: *pointers, numbers of 64 bits, and `others` of their own types."""
    return tuple((w.lstrip("*"), others.get(w, c_void_p if w[0] == "*" else c_int64)) for w in text.split())


class _Part(ctypes.Structure):
    """`Part` of geometry.h."""

    _fields_ = (
        *((name, c_int32) for name in ("kind", "flags", "factor", "n", "m")),
        ("constant", c_double),
        ("cells", c_double * 2),
        ("centre", c_double * 2),
    )


class _Cameras(ctypes.Structure):
    """`Cameras` of geometry.h."""

    _fields_ = _fields(
        "*parts part_count is_double cameras *intrinsics *parameters parameter_count *constants constant_count *usable "
        "*inner2 *usual2 *limits2 *extent *table *stagewise *circle2 *chart_inner2 *chart_most2 *chart_table"
    )


class _Domain(ctypes.Structure):
    """`Domain` of geometry.h."""

    _fields_ = _fields(
        "*parts part_count is_double cameras *parameters parameter_count *constants constant_count is_chart is_radial "
        "*ends *usual_ends *folds most *radii *coarse *even *inner2 *usual2 *circle2 *table *limits2 *extent "
        "*stagewise",
        most=c_double,
    )


_Rows = struct.Struct("20q").pack  # `Rows` of geometry.h
packed_move: Callable[..., bytes] = struct.Struct("8q2d12q").pack  # `Move` of geometry.h
packed_lattices: Callable[..., bytes] = struct.Struct(f"8q2d12q{CLASSIFICATION}6q").pack  # `Lattices`
POSITIONS, PIXELS, ON_IMAGE = range(3)
LEFT_FROM, LEFT_TO, LEFT_MOST = 1, 2, 4
_NO_ROWS = (0, 0, 0, 0)


class Plan:
    """What all cameras of a model and a number of coefficients have in common."""

    parts: ctypes.Array[_Part]
    count: int
    parameters: int
    places: Tensor | None
    is_all: bool
    is_chart: bool
    has_stages: bool
    is_radial: bool
    has_factor: bool
    has_rest: bool
    is_long: bool
    """Whether a radial factor has so many numbers that its fold is not found by a root."""

    def __init__(self, chart: Chart, lens: Lens, parts: Sequence[_Part], coefficients: Sequence[Tensor]):
        """Of the optics of coefficients, columns, whatever their values."""
        self.parts, self.count = (_Part * len(parts))(*parts), len(parts)
        parameters = (*chart.parameters, *lens.parameters)
        self.parameters = len(parameters)
        places = {id(c): i for i, c in enumerate(coefficients)}
        known = [places[id(p)] for p in parameters if id(p) in places]
        # which coefficients the parameters are; None where the model computes some
        self.places = torch.tensor(known, device="cpu") if len(known) == len(parameters) else None
        self.is_all = known == list(range(len(coefficients)))
        self.is_chart = isinstance(chart, optics.Inverted)
        self.has_stages, self.is_radial = bool(lens.stages), lens.is_radial
        self.has_factor, self.has_rest = lens.radial is not None, lens.rest is not None
        self.is_long = any(part.factor and part.n + part.m > _MOST_DEGREE for part in parts)
        self._ends: dict[torch.dtype, tuple[float, float]] = {}
        self._radii: dict[tuple[torch.dtype, int], Tensor] = {}

    def ends(self, chart: Callable[[], Chart], dtype: torch.dtype) -> tuple[float | Tensor, float | Tensor]:
        """The radii at which the chart of some cameras ends, and beyond which there are no images."""
        if self.is_chart:
            return FURTHEST, FURTHEST
        if dtype in self._ends:
            return self._ends[dtype]
        made = chart()
        end, usual_end = made.end(dtype), made.usual_end(dtype)
        if not (made.parameters or isinstance(end, Tensor) or isinstance(usual_end, Tensor)):
            self._ends[dtype] = end, usual_end
        return end, usual_end

    def radii(self, chart: Callable[[], Chart], count: int, like: Tensor) -> Tensor:
        """The radii of the chart of some cameras, as `Chart.radii` has them, in double precision."""
        key = like.dtype, count
        if key not in self._radii:
            made = chart()
            radii = made.radii(count, like).double()
            if made.parameters:
                return radii
            self._radii[key] = radii
        return self._radii[key]

    def parameters_of(self, optics_of: Optics, k: Tensor) -> Tensor:
        """(C, parameters) of coefficients (C, n)."""
        if self.places is not None:
            return k if self.is_all else k.index_select(1, self.places)
        chart, lens = optics_of(columns(k))
        return torch.cat([c.expand(len(k), 1) for c in (*chart.parameters, *lens.parameters)], -1)


_plans: dict[tuple[Optics, int], Plan | None] = {}


class Lenses:
    """Those of cameras (C,) as the compiled geometry takes them: numbers, and what was found of their domains."""

    plan: Plan
    cameras: int
    dtype: torch.dtype
    struct: _Cameras
    """What it has of them; pointers that are not set are of what is not yet known."""
    _kept: list[object]

    def __init__(self, plan: Plan, optics_of: Optics, k: Tensor, domain: Callable[[], Domain], tables: bool = False):
        """See `native_of`."""
        self.plan, self._optics_of, self._k, self._kept = plan, optics_of, k, [k]
        self._slow_domain, self.cameras, self.dtype = domain, len(k), k.dtype
        self.struct = struct = _Cameras()
        struct.parts, struct.part_count, struct.parameter_count = addressof(plan.parts), plan.count, plan.parameters
        struct.is_double, struct.cameras = self.dtype == torch.float64, self.cameras
        self._parameters = plan.parameters_of(optics_of, k) if plan.parameters else k
        if plan.parameters:
            struct.parameters = self._keep(self._parameters)
        if plan.places is None and (constants := _constants(optics_of(columns(k))[1])):
            struct.constants, struct.constant_count = self._keep_columns(constants), len(constants)
        if plan.is_chart:
            self._add_chart()
        if plan.has_stages:
            self._add_domain(tables)

    def _optics(self) -> tuple[Chart, Lens]:
        return self._optics_of(columns(self._k.double()))

    @functools.cached_property
    def _domain(self) -> _Domain:
        """What it is asked with; its optics are of double precision."""
        made, plan = _Domain(), self.plan
        known = plan.places is not None or not plan.parameters
        parameters = self._parameters if known else plan.parameters_of(self._optics_of, self._k.double())
        made.parts, made.part_count = addressof(plan.parts), plan.count
        made.is_double, made.cameras, made.is_radial = self.dtype == torch.float64, self.cameras, plan.is_radial
        made.parameters, made.parameter_count = self._keep(parameters.double()), plan.parameters
        made.most = torch.finfo(self.dtype).max ** 0.25
        made.ends, made.usual_ends = map(self._keep_ends, plan.ends(lambda: self._optics()[0], self.dtype))
        if plan.places is None or plan.is_long:
            chart, lens = self._optics()
            if constants := _constants(lens):
                made.constants, made.constant_count = self._keep_columns(constants, torch.float64), len(constants)
            factor = chart.factor(chart.parameters) if isinstance(chart, optics.Inverted) else lens.radial
            if factor is not None:
                many = len(factor.parameters) > _MOST_DEGREE
                fold = factor.closed_fold() if many and factor.fold is None else factor.fold
                made.folds = None if fold is None else self._keep(fold.expand(self.cameras, 1))
        return made

    def _keep_ends(self, end: float | Tensor) -> int:
        if isinstance(end, float):
            self._kept.append(ends := _same_ends(end, self.cameras))
            return addressof(ends)
        return self._keep(end.expand(self.cameras, 1).double())

    def _ask(self, wanted: dict[str, int]) -> None:
        """Fill in what of the domain is wanted: names and where it goes."""
        asked = _Domain.from_buffer_copy(self._domain)  # several threads may ask at once
        for name, place in wanted.items():
            setattr(asked, name, place)
        _entry("camtorch_domain", None)(byref(asked))

    def _new(self, columns: int, dtype: torch.dtype | None = None) -> int:
        return self._keep(torch.empty(self.cameras, columns, dtype=dtype or self.dtype, device="cpu"))

    def _add_chart(self) -> None:
        """The fold and the inverse of a chart that is given the other way round."""
        table, inner2 = torch.empty(self.cameras, TABLE_WIDTH, dtype=self.dtype, device="cpu"), self._new(1)
        place = self._keep(table)
        self._ask({"inner2": inner2, "table": place, "is_chart": True})
        struct = self.struct
        struct.chart_inner2, struct.chart_table, struct.chart_most2 = inner2, place, self._keep(table[:, 1])

    def _add_domain(self, tables: bool) -> None:
        plan = self.plan
        if plan.is_chart:  # whose end is that of a search
            domain = self._slow_domain()
            self.struct.usual2, self.struct.inner2 = self._keep(domain.usual2), self._keep(domain.inner2)
            return
        names = ["inner2", "usual2", *["circle2", "stagewise"] * plan.has_rest]
        has_table = tables and plan.has_factor  # at once, as there will be pixels
        start, step = self._new(len(names) + TABLE_WIDTH * has_table), self.cameras * self.dtype.itemsize
        wanted = {name: start + step * i for i, name in enumerate([*names, *["table"] * has_table])}
        radii = {} if plan.is_radial else {"radii": self._keep(plan.radii(lambda: self._optics()[0], _RADII, self._k))}
        self._ask(wanted | radii)
        for name, place in wanted.items():
            setattr(self.struct, name, place)

    def inverse_table(self) -> int:
        """What the inverse of the radial factor starts from; it is made when it is first asked for."""
        if self.struct.table is None:
            table = self._new(TABLE_WIDTH)
            self._ask({"table": table})
            self.struct.table = table  # when it is whole, for another thread may be looking
        return int(self.struct.table)

    def followed(self) -> tuple[int, int]:
        """The limits of each azimuth, and where the lens sends it: asked for only when a point lies far out."""
        struct = self.struct
        if struct.limits2 is None:
            chart, like = self._optics()[0], self._k.double()
            wanted = {"limits2": self._new(_AZIMUTHS), "extent": self._new(_EXTENT)}
            wanted |= {name: place for name in ("circle2", "stagewise") if (place := getattr(struct, name)) is not None}
            for name, count in (("radii", _RADII), ("even", _FOLLOWED), ("coarse", _FOLLOWED // 2)):
                wanted[name] = self._keep(self.plan.radii(lambda: chart, count, like))
            if self.plan.is_chart:
                wanted["ends"] = self._keep_ends(chart.end(self.dtype))
            self._ask(wanted)
            struct.extent, struct.limits2 = wanted["extent"], wanted["limits2"]
        return struct.limits2, struct.extent

    def _keep(self, tensor: Tensor) -> int:
        tensor = tensor.contiguous()
        self._kept.append(tensor)
        return tensor.data_ptr()

    def _keep_columns(self, columns: Sequence[Tensor], dtype: torch.dtype | None = None) -> int:
        return self._keep(torch.cat([c.expand(self.cameras, 1) for c in columns], -1).to(dtype or self.dtype))


@functools.lru_cache(maxsize=16)
def _same_ends(end: float, cameras: int) -> ctypes.Array[c_double]:
    return (c_double * cameras)(*[end] * cameras)


_MOST_LENSES, _LONGEST = 24, 512
_lenses: dict[tuple[object, ...], Lenses] = {}


def _lenses_of(plan: Plan, optics_of: Optics, k: Tensor, domain: Callable[[], Domain], tables: bool) -> Lenses:
    """Those of these values: of the last ones that were asked for, or new ones."""
    if k.numel() > _LONGEST:
        return Lenses(plan, optics_of, k, domain, tables)
    key = plan, k.dtype, k.shape, k.numpy().tobytes()
    found = _lenses.pop(key, None) or Lenses(plan, optics_of, k, domain, tables)
    _lenses[key] = found  # the last one
    while len(_lenses) > _MOST_LENSES:
        _lenses.pop(next(iter(_lenses)), None)
    return found


class Native:
    """Cameras (C,) of one model as the compiled geometry takes them."""

    plan: Plan
    struct: _Cameras
    cameras: int
    dtype: torch.dtype
    parameters: int
    pointer: int

    def __init__(self, lenses: Lenses, intrinsics: Tensor, usable: Tensor | None):
        """See `native_of`."""
        self._lenses, self.plan, self.struct = lenses, lenses.plan, _Cameras.from_buffer_copy(lenses.struct)
        self._kept = intrinsics.contiguous(), None if usable is None else (usable > 0).contiguous()
        self.cameras, self.dtype, self.parameters = intrinsics.shape[0], intrinsics.dtype, lenses.plan.parameters
        self.struct.intrinsics, self.struct.usable = map(_address, self._kept)
        self.pointer = addressof(self.struct)

    def before(self, intrinsics: Tensor) -> Native:
        """The same lenses with other intrinsics (C, 4), all usable."""
        return Native(self._lenses, intrinsics, None)

    def add_table(self) -> None:
        """Have what the inverse of a radial factor starts from."""
        if self.plan.has_factor and self.struct.table is None:
            self.struct.table = self._lenses.inverse_table()

    def follow(self) -> None:
        """Have the limits of each azimuth, and where it is sent."""
        self.struct.limits2, self.struct.extent = self._lenses.followed()


def native_of(
    optics_of: Optics,
    intrinsics: Tensor,
    k: Tensor,
    usable: Tensor | None,
    domain: Callable[[], Domain],
    tables: bool = False,
) -> Native | None:
    """Return cameras of intrinsics (C, 4) and coefficients (C, n) as the compiled geometry takes them.

    None without a library, on another device, and if a part of the optics has no code: a user's own. usable: (C, 1),
    None if all are. domain: for what the compiled geometry does not do. tables: whether the inverse is sure to come.
    """
    if library() is None or not intrinsics.is_cpu or not k.shape[0]:
        return None
    key = optics_of, k.shape[-1]
    if key not in _plans:
        given = [c.clone() for c in columns(k[:1].double())]
        chart, lens = optics_of(given)
        parts = codes(chart, lens)
        _plans[key] = None if parts is None else Plan(chart, lens, parts, given)
    plan = _plans[key]
    return None if plan is None else Native(_lenses_of(plan, optics_of, k, domain, tables), intrinsics, usable)


def codes(chart: Chart, lens: Lens) -> list[_Part] | None:
    """What chart and lens are made of, or None where one part has no code."""
    parts = [_chart(chart), *map(_stage, lens.stages)]
    known = [part for part in parts if part is not None]
    return known if len(known) == len(parts) <= _MOST_PARTS else None


def _code(part: Chart | Stage | RadialFactor | type[RadialFactor]) -> int | None:
    # a subclass may have another formula
    code: int | None = vars(part if isinstance(part, type) else type(part)).get("code")
    return code


def _chart(chart: Chart) -> _Part | None:
    flags = 0
    if type(chart) is optics.Transverse:
        chart, flags = chart.chart, _TRANSVERSE
    kind = _code(chart)
    if kind is None:
        return None
    part = _Part(kind, flags)
    if isinstance(chart, optics.Unified):
        part.flags |= _HAS_XI * chart.has_xi | _HAS_BETA * chart.has_beta
        part.flags |= _HAS_ALPHA * (chart.fixed_alpha is None)
        part.constant = chart.fixed_alpha or 0.0
    if isinstance(chart, optics.Inverted):
        part.factor, part.n = _code(chart.factor) or 0, len(chart.parameters)
        return part if part.factor else None
    return part


def _stage(stage: Stage) -> _Part | None:
    kind = _code(stage)
    if kind is not None and isinstance(stage, optics.Surface):
        return _Part(kind, stage.order, 0, stage.columns, stage.rows, stage.behind, stage.cells, stage.centre)
    if kind is None or not isinstance(stage, optics.Planar):
        return None if kind is None else _Part(kind)
    part, radial = _Part(kind, _TANGENTIAL * bool(stage.tangential) | _PRISM * bool(stage.prism)), stage.radial
    if radial is None:
        return part
    part.factor, part.n = _code(radial) or 0, len(radial.parameters)
    if isinstance(radial, optics.Rational):
        part.n, part.m = len(radial.numerator.parameters), len(radial.denominator.parameters)
        if part.n + part.m > _MOST_DEGREE:
            return None
    if isinstance(radial, optics.RadiusTable):
        part.n = len(radial.nodes)
    return part if part.factor else None


def _constants(lens: Lens) -> Sequence[Tensor]:
    radial = lens.radial
    return (*radial.nodes, radial.end) if isinstance(radial, optics.RadiusTable) else ()


def project_numbers(native: Native, points: Sequence[float]) -> list[float] | None:
    """x, y, z of some points to u, v of their pixels, by one camera; None where one is not valid."""
    kind, count = (c_double if native.dtype == torch.float64 else c_float), len(points) // 3
    given, pixels, valid = (kind * len(points))(*points), (kind * (2 * count))(), (c_bool * count)()
    rows = addressof(given), 0, 3, 1, addressof(pixels), 0, 2, 1, addressof(valid), 0, *_NO_ROWS, 0
    _call_and_follow(native, 1, count, PROJECT, rows)
    return list(pixels) if all(valid) else None


def project(native: Native, points: Tensor) -> tuple[Tensor, Tensor]:
    """Points (C, N, 3) to pixels (2, C, N), and whether they are valid (C, N). Points may have any strides."""
    cameras, count, _ = points.shape
    pixels = _empty((2, cameras, count), native.dtype)
    valid = torch.empty(cameras, count, dtype=torch.bool, device="cpu")
    rows = (
        points.data_ptr(),
        *points.stride(),
        pixels.data_ptr(),
        count,
        1,
        cameras * count,
        valid.data_ptr(),
        0,
        *_NO_ROWS,
        0,
    )
    _call_and_follow(native, cameras, count, PROJECT, rows)
    return pixels, valid


class Unprojected(NamedTuple):
    """Unit rays (3, C, N), whether there is one (C, N), and points on the chart's plane (2, C, N), if asked for."""

    rays: Tensor
    valid: Tensor
    solution: Tensor | None


def unproject(native: Native, pixels: Tensor, keeps: bool = False) -> Unprojected:
    """Pixels (C, N, 2) to rays. keeps: whether `unproject_vjp` is to follow."""
    cameras, count, _ = pixels.shape
    rays = _empty((3, cameras, count), native.dtype)
    valid = torch.empty(cameras, count, dtype=torch.bool, device="cpu")
    solution = _empty((2, cameras, count), native.dtype) if keeps else None
    native.add_table()
    rows = pixels.data_ptr(), *pixels.stride(), rays.data_ptr(), count, 1, cameras * count, valid.data_ptr()
    _call_and_follow(native, cameras, count, UNPROJECT, (*rows, _address(solution), *_NO_ROWS, 0))
    return Unprojected(rays, valid, solution)


def project_vjp(
    native: Native, points: Tensor, cotangents: Tensor, want_points: bool, want_parameters: bool
) -> tuple[Tensor | None, Tensor | None]:
    """Return the cotangents of points (C, N, 3), and of the cameras (C, 4 + n): intrinsics, `parameters` of the optics.

    cotangents: of pixels, (2, C, N), of any strides.
    """
    cameras, count, _ = points.shape
    results = _empty((cameras, count, 3), native.dtype) if want_points else None
    sums = _sums(native, cameras, count) if want_parameters else None
    rows = points.data_ptr(), *points.stride(), *_points(results), 0, 0
    _call(native, cameras, count, PROJECT_VJP, (*rows, *_cotangents(cotangents, cameras, count), _address(sums)))
    return results, None if sums is None else sums.sum(1).to(native.dtype)


def project_jacobians(native: Native, points: Tensor, by_camera: bool) -> tuple[Tensor, Tensor]:
    """The derivatives of pixels by points (C, N, 3), and by the numbers of the cameras if asked for: see `project_vjp`.

    (C, N, 2, 3) and (C, N, 2, 4 + n or 0), zero where there is no pixel.
    """
    cameras, count, _ = points.shape
    by_points = torch.empty(2, cameras, count, 3, dtype=native.dtype, device="cpu")
    sums = torch.zeros(2, cameras, count, (4 + native.parameters) * by_camera, dtype=torch.float64, device="cpu")
    tile = 1 if by_camera else _TILE
    for one, by, to in zip(torch.eye(2, dtype=native.dtype, device="cpu"), by_points, sums, strict=True):
        given = points.data_ptr(), *points.stride(), *_points(by), 0, 0, one.data_ptr(), 0, 0, 1
        _call(native, cameras, count, PROJECT_VJP, (*given, to.data_ptr() if by_camera else 0), tile)
    return by_points.movedim(0, 2), sums.movedim(0, 2)


def unproject_vjp(
    native: Native, valid: Tensor, solution: Tensor, cotangents: Tensor, want_pixels: bool, want_parameters: bool
) -> tuple[Tensor | None, Tensor | None]:
    """Return the cotangents of pixels (C, N, 2), and of the cameras, of results of `unproject`; see `project_vjp`."""
    cameras, count = valid.shape
    results = _empty((cameras, count, 2), native.dtype) if want_pixels else None
    sums = _sums(native, cameras, count) if want_parameters else None
    rows = *_NO_ROWS, *_points(results), valid.data_ptr(), solution.data_ptr()
    _call(native, cameras, count, UNPROJECT_VJP, (*rows, *_cotangents(cotangents, cameras, count), _address(sums)))
    return results, None if sums is None else sums.sum(1).to(native.dtype)


class Lattices(NamedTuple):
    """What `sampler.sample` takes of the positions of cameras (C,)."""

    nodes: Tensor
    """(C, 2, n + 5, m + 5)."""
    cells: Tensor
    """(C, n, m) int32."""
    exact: Tensor
    """(2, K, 8, 8), NaN where there is none."""


class Between:
    """Cameras, and others that see their rays after a turn: pixels of the first as pixels of the others."""

    cameras: int
    """Of each as many, or one for all."""
    is_batch: bool
    """Whether pixels have a batch dim."""
    dtype: torch.dtype

    def __init__(self, start: Native, end: Native, turns: Tensor | None, size: tuple[int, int], is_batch: bool):
        """turns: (3, 3) or (C, 3, 3), of their dtype. size: (height, width) of the others' image."""
        self._start, self._end, self._turns, self.is_batch = start, end, turns, is_batch
        self.dtype = start.dtype
        count, strides = (1, (0, 0)) if turns is None else (turns.numel() // 9, turns.stride())
        self.cameras = max(start.cameras, end.cameras, count)
        start.add_table()
        self._size = size
        by_camera = strides[0] if count > 1 else 0
        self._given = start.pointer, end.pointer, _address(turns), by_camera, *strides[-2:], self.cameras

    def rows(self, pixels: Tensor, form: int) -> tuple[Tensor, Tensor]:
        """Pixels (C or 1, N, 2) to (C, N, 2), and valid (C, N).

        form: `POSITIONS` as of `grid_sample`, -9 where there is none; `PIXELS`, -1 where there is none; or `ON_IMAGE`,
            the same, of which only those on the image are valid.
        """
        count = pixels.shape[1]
        result = torch.empty(self.cameras, count, 2, dtype=self._start.dtype, device="cpu")
        valid = torch.empty(self.cameras, count, dtype=torch.bool, device="cpu")
        rows = *rows_of(pixels), result.data_ptr(), 2 * count, 2, 1, valid.data_ptr(), count, _TILE
        call = packed_move(*self._given, form, *self._size, *rows, addressof(_kept.counters))
        tiles = -(-count // _TILE) * self.cameras
        self._run("camtorch_moves", call, tiles if self.cameras * count >= _SHARED else 1)
        return result, valid

    def lattices(
        self,
        probes: Tensor,
        size: tuple[int, int],
        first_row: int,
        tolerance: float,
        padding: str,
        jobs: Callable[[tuple[int, ...]], list[bytes]] = lambda on_lattice: [],
    ) -> Lattices | None:
        """Return positions from probes (1, N, 2) at nodes and at the rim, None if most cells would have their own.

        See `warp.grid.on_lattice`. size: (h, w) of the target. tolerance: in pixels of the source. jobs: `Job` of
        sampler.h, of images (C, ...) that are sampled in the same call, by where the lattices lie; of float32 alone.
        """
        cameras, dtype, count = self.cameras, self._start.dtype, probes.shape[1]
        n, m = (-(-side // 8) for side in size)
        nodes, most, is_double = (n + 5) * (m + 5), cameras * n * m, dtype == torch.float64
        result = torch.empty(cameras, 2, count, dtype=dtype, device="cpu")
        cells = torch.empty(cameras, n, m, dtype=torch.int32, device="cpu")
        # for this call alone: exact positions, of which parts are written; nodes in float32; scratch; what is mapped
        sizes = 128 * most * dtype.itemsize, 8 * cameras * nodes * is_double, 4 * SCRATCH * cameras * (m + 8)
        kept = _kept_memory(sum(sizes) + cameras * count)
        exact, narrow, scratch, valid = accumulate(sizes, initial=kept.data_ptr())
        at, used = result.data_ptr(), addressof(_kept.counters)
        rows = *rows_of(probes), at, 2 * count, 1, count, valid, count, count, used
        asked = at, 2 * count, count, valid, count, valid + nodes, count, cameras, n, m, *size
        how = *self._size, tolerance, PADDINGS[padding], cells.data_ptr(), scratch
        made = jobs((at, 2 * count, count, cells.data_ptr(), n * m, n, m, exact, 64 * most))
        images = create_string_buffer(b"".join(made))
        more = first_row, narrow if is_double else 0, exact, used + 8, addressof(images), len(made)
        call = packed_lattices(*self._given, POSITIONS, *self._size, *rows, *asked, *how, *more)
        if self._run("camtorch_lattices", call, cameras):
            return None
        if count := _kept.counters[1]:
            found = kept[: sizes[0]].view(dtype).view(2, most, 8, 8)[:, :count].clone()
        else:
            found = torch.empty(2, 0, 8, 8, dtype=dtype, device="cpu")
        return Lattices(result.as_strided((cameras, 2, n + 5, m + 5), (*result.stride()[:2], m + 5, 1)), cells, found)

    def _run(self, name: str, call: bytes, tiles: int) -> int:
        """Flags of what is not made. call: whose next tile, and number of places, are this thread's counters."""
        run, threads, counters = _entry(name, c_int64), min(thread_count(), tiles) if tiles > 1 else 1, _kept.counters
        while True:
            left: list[int] = []
            counters[:] = [0, 0]
            spread(lambda: left.append(run(call)), threads)  # noqa: B023 (which is called at once)
            flags = functools.reduce(operator.or_, left)
            if not flags & (LEFT_FROM | LEFT_TO):
                return flags
            for flag, native in ((LEFT_FROM, self._start), (LEFT_TO, self._end)):
                if flags & flag:
                    native.follow()


class _Kept(threading.local):
    def __init__(self) -> None:
        self.memory: Tensor | None = None
        self.counters = (c_int64 * 2)()


_kept = _Kept()
_MOST_KEPT = 1 << 22  # bytes


def _kept_memory(count: int) -> Tensor:
    """At least so many bytes, for this call of this thread: the same memory as before, unless they are many."""
    if count > _MOST_KEPT:
        return torch.empty(count, dtype=torch.uint8, device="cpu")
    if _kept.memory is None or _kept.memory.shape[0] < count:
        with torch.inference_mode(False):
            _kept.memory = torch.empty(count, dtype=torch.uint8, device="cpu")
    return _kept.memory


def rows_of(pixels: Tensor) -> tuple[int, int, int, int]:
    """Where pixels (C or 1, N, 2) lie, and their strides."""
    camera, point, component = pixels.stride()
    return pixels.data_ptr(), camera if pixels.shape[0] > 1 else 0, point, component


def _empty(size: tuple[int, int, int], dtype: torch.dtype) -> Tensor:
    # of large results the first write to each page would take longer than the geometry
    if size[0] * size[1] * size[2] * dtype.itemsize >= memory.LEAST:
        return memory.empty(size, dtype, torch.contiguous_format)
    return torch.empty(size, dtype=dtype, device="cpu")


def _sums(native: Native, cameras: int, count: int) -> Tensor:
    tiles = -(-count // _TILE)
    return torch.zeros(cameras, tiles, 4 + native.parameters, dtype=torch.float64, device="cpu")


def _points(results: Tensor | None) -> tuple[int, ...]:
    return _NO_ROWS if results is None else (results.data_ptr(), *results.stride())


def _cotangents(given: Tensor, cameras: int, count: int) -> tuple[int, int, int, int]:
    assert given.shape[1:] == (cameras, count)  # else C would read elsewhere
    component, camera, point = given.stride()
    return given.data_ptr(), camera, point, component


def _address(tensor: Tensor | None) -> int:
    return 0 if tensor is None else tensor.data_ptr()


def _call(native: Native, cameras: int, count: int, direction: int, rows: tuple[int, ...], tile: int = _TILE) -> int:
    """rows: what of `Rows` is between its cameras and its count."""
    assert cameras == native.cameras
    run, points = _entry("camtorch_geometry", c_int64), cameras * count
    if points < _SHARED:
        return run(_Rows(native.pointer, *rows, count, tile, direction, 0)) if points else 0
    following = c_int64(0)
    call = _Rows(native.pointer, *rows, count, tile, direction, addressof(following))
    left: list[int] = []
    spread(lambda: left.append(run(call)), min(thread_count(), -(-count // _TILE) * cameras))
    return sum(left)


def _call_and_follow(native: Native, cameras: int, count: int, direction: int, rows: tuple[int, ...]) -> None:
    """Call, and again with the limits of each azimuth if a point lies so far out that they decide."""
    if _call(native, cameras, count, direction, rows):
        native.follow()
        _call(native, cameras, count, direction, rows)


@functools.cache
def _entry(name: str, result: type | None) -> ctypes._NamedFuncPointer:
    found = library()
    assert found is not None  # or nobody has a `Native`
    entry: ctypes._NamedFuncPointer = getattr(found, name)
    entry.restype = result
    return entry
