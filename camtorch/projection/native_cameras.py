"""Cameras of one model in the form of the native geometry: codes of their parts, numbers, and tables.

`native_of` makes a `Native` of three layers: a `ModelPlan` that all cameras of a model share, `NativeLenses` that all
cameras of the same coefficients share, and intrinsics. C reads structs of addresses: the struct X belongs to a class
`NativeX`, which keeps alive what it points to, as `NativeMove`; that of `Native` and of its lenses is `Cameras`.
A part is a chart or a stage; `parameters` are what parts compute with: coefficients, or numbers made of them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import addressof, c_double
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from camtorch import optics
from camtorch.evaluate.kept import Kept
from camtorch.native import structs
from camtorch.native.library import library, loaded
from camtorch.optics.backprojection import FURTHEST
from camtorch.optics.radial_inverse import TABLE_WIDTH
from camtorch.projection.domain import Domain
from camtorch.values.arguments import columns, present

if TYPE_CHECKING:
    from collections.abc import Callable

    from camtorch.optics.charts import Chart
    from camtorch.optics.lens import Lens, Stage
    from camtorch.optics.model_spec import Optics
    from camtorch.optics.radial import RadialFactor


class ModelPlan:
    """The properties that all cameras of a model and a number of coefficients have in common."""

    def __init__(self, chart: Chart, lens: Lens, parts: Sequence[structs.Part], coefficients: Sequence[Tensor]):
        """Make the plan of optics whose coefficients are columns, whatever their values."""
        self.parts = (structs.Part * len(parts))(*parts)
        parameters = (*chart.parameters, *lens.parameters)
        self.parameters = len(parameters)
        # which coefficient each parameter is, as the same tensor; None if the model computes some
        index = {id(c): i for i, c in enumerate(coefficients)}
        known = [index[id(p)] for p in parameters if id(p) in index]
        self.places = torch.tensor(known, device="cpu") if len(known) == len(parameters) else None
        self._is_all = known == list(range(len(coefficients)))
        self.chart_is_inverted = isinstance(chart, optics.Inverted)
        self.has_stages, self.is_radial = bool(lens.stages), lens.is_radial
        self.has_factor, self.has_rest = lens.radial is not None, lens.rest is not None
        # a radial factor has more coefficients than C finds roots for
        self.is_long = any(part.factor and part.n + part.m > structs.MOST_DEGREE for part in parts)
        self.fixed_ends: dict[torch.dtype, tuple[float, float]] = {}  # if all cameras have them, after a call of `ends`
        self._radii: dict[tuple[torch.dtype, int], Tensor] = {}

    def ends(self, lenses: NativeLenses) -> tuple[float | Tensor, float | Tensor]:
        """Return the radii at which the chart of some lenses ends, and beyond which there are no images."""
        if self.chart_is_inverted:
            return FURTHEST, FURTHEST
        dtype = lenses.k.dtype
        if dtype in self.fixed_ends:
            return self.fixed_ends[dtype]
        chart, _ = lenses.precise_optics
        end, usual_end = chart.end(dtype), chart.usual_end(dtype)
        if not (chart.parameters or isinstance(end, Tensor) or isinstance(usual_end, Tensor)):
            self.fixed_ends[dtype] = end, usual_end
        return end, usual_end

    def radii(self, lenses: NativeLenses, count: int, dtype: torch.dtype) -> Tensor:
        """Return the radii of the chart of some lenses, like `Chart.radii`, in double precision."""
        key = dtype, count
        if key in self._radii:
            return self._radii[key]
        chart, _ = lenses.precise_optics
        radii = chart.radii(count, lenses.k.to(dtype)).double()
        if not chart.parameters:
            self._radii[key] = radii
        return radii

    def parameters_of(self, optics_of: Optics, k: Tensor) -> Tensor:
        """Return the parameters (C, parameters) for coefficients (C, n)."""
        if self.places is not None:
            return k if self._is_all else k.index_select(1, self.places)
        chart, lens = optics_of(columns(k))
        return torch.cat([c.expand(len(k), 1) for c in (*chart.parameters, *lens.parameters)], -1)

    def by_coefficients(self, by_parameters: Tensor, count: int) -> Tensor:
        """Return derivatives (..., count) by coefficients for those by parameters, which are some of them."""
        if self._is_all:
            return by_parameters
        zeros = by_parameters.new_zeros(*by_parameters.shape[:-1], count)
        return zeros.index_add_(-1, present(self.places, "parameters that are coefficients"), by_parameters)


_plans = Kept(64)  # keyed by optics and number of coefficients


class NativeLenses:
    """The lenses of cameras (C,) in the form of the native geometry: numbers, and their domains as far as known."""

    def __init__(self, plan: ModelPlan, optics_of: Optics, k: Tensor, struct: structs.Cameras):
        """Take coefficients (C, n) and their struct, null where nothing is known."""
        self.plan, self.optics_of, self.k, self.struct = plan, optics_of, k, struct

    @classmethod
    def of(cls, plan: ModelPlan, optics_of: Optics, k: Tensor) -> NativeLenses:
        """Return the lenses of coefficients (C, n) with their domains."""
        struct = structs.Cameras(cameras=len(k), is_double=k.dtype == torch.float64)
        struct.hold(k)
        struct.parts, struct.part_count = addressof(plan.parts), len(plan.parts)
        struct.parameter_count = plan.parameters
        lenses = cls(plan, optics_of, k, struct)
        if plan.parameters:
            struct.parameters = lenses._keep(plan.parameters_of(optics_of, k))
        constants = _constants(optics_of(columns(k))[1]) if plan.places is None else ()
        if constants:
            struct.constants, struct.constant_count = lenses._keep_columns(constants, k.dtype), len(constants)
        if plan.chart_is_inverted:
            lenses._add_chart()
        if plan.has_stages:
            lenses._add_domain()
        return lenses

    @cached_property
    def precise_optics(self) -> tuple[Chart, Lens]:
        """The chart and the lens in double precision."""
        return self.optics_of(columns(self.k.double()))

    @cached_property
    def request(self) -> structs.Domain:
        """The request for the domain, with optics in double precision."""
        plan, k = self.plan, self.k
        made = structs.Domain(is_double=self.struct.is_double, cameras=self.struct.cameras, is_radial=plan.is_radial)
        made.parts, made.part_count = addressof(plan.parts), len(plan.parts)
        made.parameter_count = plan.parameters
        # parameters that the model computes are computed in double precision
        given = k if plan.places is not None else k.double()
        parameters = plan.parameters_of(self.optics_of, given) if plan.parameters else k
        made.parameters = self._keep(parameters.double())
        made.most = torch.finfo(k.dtype).max ** 0.25
        made.ends, made.usual_ends = map(self._keep_ends, plan.ends(self))
        if plan.places is None or plan.is_long:
            chart, lens = self.precise_optics
            constants = _constants(lens)
            if constants:
                made.constants, made.constant_count = self._keep_columns(constants, torch.float64), len(constants)
            factor = chart.factor(chart.parameters) if isinstance(chart, optics.Inverted) else lens.radial
            if factor is not None:
                many = len(factor.parameters) > structs.MOST_DEGREE
                fold = factor.closed_fold() if many and factor.fold is None else factor.fold
                made.folds = None if fold is None else self._keep(fold.expand(self.struct.cameras, 1))
        return made

    def _fill(self, wanted: dict[str, int]) -> None:
        """Have C fill in parts of the domain: wanted are their addresses, and those of inputs, by name."""
        request = structs.Domain.from_buffer_copy(self.request)  # several threads may request at once
        for name, pointer in wanted.items():
            setattr(request, name, pointer)
        loaded().camtorch_domain(request)

    def _add_chart(self) -> None:
        """Set the fold and the inverse of a chart that is defined in the other direction."""
        struct, table = self.struct, self.k.new_empty(self.struct.cameras, TABLE_WIDTH)
        struct.chart_safe_radius_sq, struct.chart_table = self._new(1), self._keep(table)
        self._fill({"safe_radius_sq": struct.chart_safe_radius_sq, "table": struct.chart_table, "is_chart": True})
        struct.chart_most2 = self._keep(table[:, 1])

    def _add_domain(self) -> None:
        """Set how far out the lenses are one-to-one."""
        plan, struct = self.plan, self.struct
        if plan.chart_is_inverted:  # its end comes from a search, which C lacks
            domain = Domain(self.optics_of, self.k)
            struct.image_radius_sq, struct.safe_radius_sq = map(
                self._keep, (domain.image_radius_sq, domain.safe_radius_sq)
            )
            return
        names = ["safe_radius_sq", "image_radius_sq"]
        if plan.has_rest:
            names += ["image_circle_sq", "stagewise"]
        # in one piece of memory: a column each
        start, step = self._new(len(names)), struct.cameras * self.k.dtype.itemsize
        made = {name: start + step * i for i, name in enumerate(names)}
        inputs = {} if plan.is_radial else {"radii": self._keep(plan.radii(self, structs.MOST_RADII, self.k.dtype))}
        self._fill(made | inputs)
        for name, pointer in made.items():
            setattr(struct, name, pointer)

    def radii_wanted(self) -> dict[str, Tensor]:
        """Return the radii on which lenses are followed, by their names in a request."""
        names = {"radii": structs.MOST_RADII, "even": structs.RADII, "coarse": structs.RADII // 2}
        return {name: self.plan.radii(self, count, torch.float64) for name, count in names.items()}

    def inverse_table(self) -> int:
        """Return the address of the table for the inverse of the radial factor, made at first use."""
        if self.struct.table is None:
            table = self._new(TABLE_WIDTH)
            self._fill({"table": table})
            self.struct.table = table  # set when it is whole, as another thread may be reading
        return int(self.struct.table)

    def followed(self) -> tuple[int | None, int | None]:
        """Return the addresses of the limits of each azimuth and of its extent, made if a point lies far out."""
        struct = self.struct
        if struct.limits2 is None:
            wanted = {"limits2": self._new(structs.AZIMUTHS), "extent": self._new(structs.EXTENT)}
            wanted |= {name: getattr(struct, name) for name in ("image_circle_sq", "stagewise")}
            wanted |= {name: self._keep(radii) for name, radii in self.radii_wanted().items()}
            if self.plan.chart_is_inverted:
                wanted["ends"] = self._keep_ends(self.precise_optics[0].end(self.k.dtype))
            self._fill(wanted)
            struct.extent, struct.limits2 = wanted["extent"], wanted["limits2"]
        return struct.limits2, struct.extent

    def tables(self) -> dict[str, Tensor]:
        """Return copies (C, n) of the library's tables, by their names as attributes of `projection.domain.Domain`."""
        if self.plan.has_stages and self.plan.has_factor:
            self.inverse_table()
        if self.plan.has_stages and not self.plan.is_radial:
            self.followed()
        widths = dict.fromkeys(("safe_radius_sq", "image_radius_sq", "image_circle_sq", "stagewise"), 1)
        widths |= {"table": TABLE_WIDTH, "limits2": structs.AZIMUTHS}
        made, count = {}, self.struct.cameras
        for name, width in widths.items():
            pointer = getattr(self.struct, name)
            if pointer is not None:
                dtype = torch.bool if name == "stagewise" else self.k.dtype
                memory = (ctypes.c_char * (count * width * dtype.itemsize)).from_address(pointer)
                made[name] = torch.frombuffer(memory, dtype=dtype).view(count, width).clone()
        return made

    def _new(self, columns: int) -> int:
        return self._keep(self.k.new_empty(self.struct.cameras, columns))

    def _keep(self, tensor: Tensor) -> int:
        return self.struct.keep(tensor.contiguous())

    def _keep_ends(self, end: float | Tensor) -> int:
        if isinstance(end, Tensor):
            return self._keep(end.expand(self.struct.cameras, 1).double())
        return self.struct.keep((c_double * self.struct.cameras)(*[end] * self.struct.cameras))

    def _keep_columns(self, columns: Sequence[Tensor], dtype: torch.dtype) -> int:
        return self._keep(torch.cat([c.expand(self.struct.cameras, 1) for c in columns], -1).to(dtype))


_MOST_COEFFICIENTS = 512  # of lenses that are kept
_lenses = Kept(24)


def lenses_of(plan: ModelPlan, k: Tensor, make: Callable[[], NativeLenses]) -> NativeLenses:
    """Return the lenses of coefficients (C, n): one of the last ones used, or new ones."""
    if k.numel() > _MOST_COEFFICIENTS:
        return make()
    return _lenses((), (plan, k.dtype, k.shape, k.numpy().tobytes()), make)


class Native:
    """Cameras (C,) of one model in the form of the native geometry."""

    def __init__(self, plan: ModelPlan, struct: structs.Cameras, lenses: Callable[[], NativeLenses]):
        """Take the cameras' struct and a function for their lenses, which keep alive what the struct points to."""
        self.plan, self.struct, self.pointer, self._find_lenses = plan, struct, addressof(struct), lenses
        self.cameras, self.dtype = struct.cameras, torch.float64 if struct.is_double else torch.float32

    def __deepcopy__(self, memo: object) -> Native:
        """Return itself: the cameras stay, and their struct points to memory, which has no copies."""
        return self

    @cached_property
    def lenses(self) -> NativeLenses:
        """The lenses of the cameras, which other cameras may share."""
        return self._find_lenses()

    def keep_lenses(self) -> None:
        """Have other cameras of the same coefficients find these lenses."""
        _ = self.lenses

    def add_table(self) -> None:
        """Set the table from which the inverse of a radial factor starts."""
        if self.plan.has_factor and self.struct.table is None:
            self.struct.table = self.lenses.inverse_table()

    def follow(self) -> None:
        """Set the limits of each azimuth, and its extent."""
        self.struct.limits2, self.struct.extent = self.lenses.followed()


def native_of(optics_of: Optics, intrinsics: Tensor, k: Tensor, usable: Tensor | None) -> Native | None:
    """Return cameras of intrinsics (C, 4) and coefficients (C, n) in the form of the native geometry.

    None without a library, on another device, and if a part of the optics has no code: a user's own. usable: (C, 1),
    None if all are.
    """
    if library() is None or not intrinsics.is_cpu or not k.shape[0]:
        return None

    def planned() -> ModelPlan | None:
        given = [c.clone() for c in columns(k[:1].double())]
        chart, lens = optics_of(given)
        parts = codes(chart, lens)
        return None if parts is None else ModelPlan(chart, lens, parts, given)

    plan = _plans((), (optics_of, k.shape[-1]), planned)
    if plan is None:
        return None
    lenses = lenses_of(plan, k, lambda: NativeLenses.of(plan, optics_of, k))
    struct = structs.Cameras.from_buffer_copy(lenses.struct)
    struct.intrinsics = struct.keep(intrinsics.contiguous())
    struct.usable = None if usable is None else struct.keep((usable > 0).contiguous())
    return Native(plan, struct, lambda: lenses)


def codes(chart: Chart, lens: Lens) -> list[structs.Part] | None:
    """Return the parts of chart and lens, or None if one part has no code."""
    parts = [_chart(chart), *map(_stage, lens.stages)]
    known = [part for part in parts if part is not None]
    return known if len(known) == len(parts) <= structs.MOST_PARTS else None


def _code(kind: type[Chart | Stage | RadialFactor]) -> int | None:
    # a subclass, which inherits the code, may have another formula
    return vars(kind).get("code")


def _chart(chart: Chart) -> structs.Part | None:
    flags = 0
    if type(chart) is optics.Transverse:
        chart, flags = chart.chart, structs.TRANSVERSE
    kind = _code(type(chart))
    if kind is None:
        return None
    part = structs.Part(kind=kind, flags=flags)
    if isinstance(chart, optics.Unified):
        part.flags |= structs.HAS_XI * chart.has_xi | structs.HAS_BETA * chart.has_beta
        part.flags |= structs.HAS_ALPHA * (chart.fixed_alpha is None)
        part.constant = chart.fixed_alpha or 0.0
    if isinstance(chart, optics.Inverted):
        factor = _code(chart.factor)
        if factor is None:
            return None
        part.factor, part.n = factor, len(chart.parameters)
    return part


def _stage(stage: Stage) -> structs.Part | None:
    kind = _code(type(stage))
    if kind is None:
        return None
    part = structs.Part(kind=kind)
    if isinstance(stage, optics.Surface):
        part.flags, part.n, part.m, part.constant = stage.order, stage.columns, stage.rows, stage.behind
        part.cells[:], part.centre[:] = stage.cells, stage.centre
    if isinstance(stage, optics.Planar):
        part.flags = structs.TANGENTIAL * bool(stage.tangential) | structs.PRISM * bool(stage.prism)
    radial = stage.radial
    if radial is None:
        return part
    factor = _code(type(radial))
    if factor is None:
        return None
    part.factor, part.n = factor, len(radial.parameters)
    if isinstance(radial, optics.Rational):
        part.n, part.m = len(radial.numerator.parameters), len(radial.denominator.parameters)
        if part.n + part.m > structs.MOST_DEGREE:
            return None
    if isinstance(radial, optics.RadiusTable):
        part.n = len(radial.nodes)
    return part


def _constants(lens: Lens) -> Sequence[Tensor]:
    radial = lens.radial
    return (*radial.nodes, radial.end) if isinstance(radial, optics.RadiusTable) else ()
