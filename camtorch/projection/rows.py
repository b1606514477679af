"""The cameras that see rows of points: the values of their parameters, and the results made of them once.

`CameraRows` has known values, their domain and native form; `Traced` is what a formula computes with, known or not.
Both put an ideal camera in place of one that is not `usable`. A mask is 1 or 0, or None if it is 1 everywhere.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from camtorch.evaluate.devices import on_cpu, sent
from camtorch.evaluate.kept import note
from camtorch.evaluate.tensors import known_true
from camtorch.optics.radial_inverse import InverseTable
from camtorch.projection.camera_like import CameraLike
from camtorch.projection.domain import Domain, domain_of, way_of_inverse
from camtorch.projection.native_cameras import Native, native_of
from camtorch.projection.ops import recorded_tables
from camtorch.values.arguments import columns, present

if TYPE_CHECKING:
    from camtorch.optics.charts import Chart
    from camtorch.optics.lens import Lens

_NUMBERS_LOOKED_AT = 512  # one by one


class CameraRows:
    """Cameras (C,) of one model, each of which sees one row: the values of their parameters, and their domain.

    A camera that learning drove to NaN, to a focal length that is not positive or to coefficients without a formula is
    replaced by an ideal one, and all its results are invalid.
    """

    def __init__(self, model: type[CameraLike], intrinsics: Tensor, distortion: Tensor):
        """Take concrete values (C, 4), (C, n); or (4,), (n,) of one camera."""
        self.model, self._learns = model, distortion.requires_grad
        known = on_cpu(intrinsics, distortion)  # None if they are there already
        self._same_on_cpu = None if known is None else CameraRows(model, known[0], known[1])
        self.notes = note(intrinsics), note(distortion)
        first, second = (then if mark is None else then.clone() for then, mark in self.notes)
        self.given = (first[None], second[None]) if intrinsics.ndim == 1 else (first, second)
        self.intrinsics, self.k = self.given
        self.usable: Tensor | None = None  # (C, 1)
        are_usable = self._same_on_cpu is not None and self._same_on_cpu.usable is None
        usable = None if are_usable else _usable_unless_all(model, *self.given)
        if usable is not None:
            ideal, ideal_k = _ideal(model, *self.given)
            self.intrinsics, self.k = torch.where(usable, self.intrinsics, ideal), torch.where(usable, self.k, ideal_k)
            self.usable = usable.to(intrinsics.dtype)

    @cached_property
    def domain(self) -> Domain:
        """The domain in which the lenses are one-to-one; see `Domain`."""
        native = None if self._same_on_cpu is None else self._same_on_cpu.native
        if native is not None:  # its tables are known on the CPU
            tables = native.lenses.tables()
            there = sent([*tables.values()], self.k.device) if tables else ()  # nothing is a transfer, too
            known: dict[str, object] = dict(zip(tables, there, strict=True))
            known["inverse_by"] = way_of_inverse(native.plan.is_radial, tables.get("stagewise"))
            return Domain(self.model.optics, self.k, known)
        if self._learns:  # and so will not be used again
            return Domain(self.model.optics, self.k)
        return domain_of(self.model.operator_name, self.k, self.model.optics)

    def as_constant(self) -> CameraRows:
        """Return the same as a constant of an exported program, with all tables that its graph may need."""
        made, domain = copy.copy(self), self.domain
        made.domain = Domain(domain.optics, domain.k.clone(), _constant_tables(domain), is_constant=True)
        return made

    @cached_property
    def native(self) -> Native | None:
        """The cameras in the form of the native geometry; None if that lacks this model, or there is no library."""
        return native_of(self.model.optics, self.intrinsics, self.k, self.usable)

    def cotangents(self, sums: Tensor | None, wanted: Sequence[bool]) -> tuple[Tensor | None, Tensor | None]:
        """Return the cotangents of intrinsics and distortion, if wanted, for sums of `native_calls.project_vjp`."""
        if sums is None:
            return None, None
        of_intrinsics = sums[:, :4] if wanted[0] else None
        if not wanted[1]:
            return of_intrinsics, None
        sums = sums[:, 4:]
        plan = present(self.native, "compiled code, which gave the sums,").plan
        if plan.places is not None:
            return of_intrinsics, plan.by_coefficients(sums, self.k.shape[1])
        # the model computes parameters from coefficients: torch differentiates that
        with torch.enable_grad():
            k = self.k.detach().requires_grad_()
            chart, lens = self.model.optics(columns(k))
            pairs = zip((*chart.parameters, *lens.parameters), sums.split(1, -1), strict=True)
            outputs, of_outputs = zip(*(pair for pair in pairs if pair[0].requires_grad), strict=True)
            (by_coefficients,) = torch.autograd.grad(outputs, k, of_outputs, materialize_grads=True)
        return of_intrinsics, by_coefficients


def _constant_tables(domain: Domain) -> dict[str, object]:
    """Return the properties of a domain whose values are known, as far as a graph may need them; none is a view."""
    if not domain.lens.stages:
        return {}
    names, known = ["safe_radius_sq"], dict[str, object]()
    if domain.inverse_by in ("stages", "either"):
        names += ["image_circle_sq", "stagewise"]
    if not domain.is_circular:
        names += ["image_radius_sq", "limits2"]
        known["extent"] = domain.extent
    known |= {name: getattr(domain, name).clone() for name in names}
    inverse = InverseTable(domain.table, is_constant=True) if domain.lens.radial else None
    return {**known, "inverse": inverse, "inverse_by": domain.inverse_by}


def _usable_unless_all(model: type[CameraLike], intrinsics: Tensor, distortion: Tensor) -> Tensor | None:
    """Return `_usable`, or None if a short look shows that all are."""
    count = intrinsics.numel() + distortion.numel()
    is_always_defined = model.always_defined or not distortion.numel()
    if intrinsics.is_cpu and is_always_defined and 0 < count <= _NUMBERS_LOOKED_AT:
        rows = intrinsics.tolist()
        total = math.fsum(map(sum, (*rows, *distortion.tolist())))  # not finite if a number is not
        if math.isfinite(total) and all(fx > 0 and fy > 0 for fx, fy, *_ in rows):
            return None
    usable = _usable(model, intrinsics, distortion)
    return None if known_true(usable) else usable


def _usable(model: type[CameraLike], intrinsics: Tensor, distortion: Tensor) -> Tensor:
    """Return whether (C, 1) numbers are finite, focal lengths positive, and the formula exists for the coefficients."""
    finite = torch.isfinite(intrinsics).all(-1) & torch.isfinite(distortion).all(-1)
    usable = finite & (intrinsics[..., :2] > 0).all(-1)
    defined = model.defined(distortion.unbind(-1)) if distortion.shape[-1] else None
    return (usable if defined is None else usable & (defined > 0)).unsqueeze(-1)


def unusable(camera: CameraLike, intrinsics: Tensor, distortion: Tensor) -> tuple[str, str] | None:
    """Return why a camera of values (4,) and (n,) has no pixels at all, as a tensor's name and a reason, or None."""
    for tensor, names, values in (
        ("intrinsics", ("fx", "fy", "cx", "cy"), intrinsics.tolist()),
        ("distortion", camera.distortion_names, distortion.tolist()),
    ):
        for name, value in zip(names, values, strict=True):
            if not math.isfinite(value):
                return tensor, f"{name} = {value}"
            if name in ("fx", "fy") and value <= 0:
                return tensor, f"{name} = {value:.6g} is not positive"
    defined = camera.defined(distortion.unbind(-1)) if camera.distortion_names else None
    if defined is not None and not bool(defined > 0):
        return "distortion", f"the formula needs {camera.defined_text}"
    return None


def _ideal(model: type[CameraLike], intrinsics: Tensor, distortion: Tensor) -> tuple[float, float | Tensor]:
    ideal = model.ideal(distortion.shape[-1])
    return 1.0, distortion.new_tensor(ideal) if any(ideal) else 0.0


class Direction(NamedTuple):
    """One direction of cameras (C,) of a model, for rows (C, N, size): as torch records it, and in native code."""

    name: str  # the rows' name in messages
    size: int
    size_out: int
    formula: Callable[..., tuple[Tensor, Tensor]]
    """The formula: model, rows, intrinsics (C, 4), distortion (C, n) and cameras to planes (size_out, C, N) and valid.

    `cameras` are those of the parameters, None if values may not be read.
    """
    native: Callable[[Native, Tensor, bool], tuple[Tensor, Tensor, tuple[Tensor, ...]]]
    """The native call: cameras, rows and whether anything learns to planes, valid and what `native_vjp` then needs."""
    native_vjp: Callable[..., tuple[Tensor | None, Tensor | None]]
    """The native cotangents of rows and of the numbers of the cameras."""


class Traced(NamedTuple):
    """The inputs of a recorded graph: parameters that can be used, and results of their values."""

    model: type[CameraLike]
    intrinsics: Tensor
    distortion: Tensor
    domain: Domain
    usable: Tensor | None

    @classmethod
    def of(cls, model: type[CameraLike], intrinsics: Tensor, distortion: Tensor, cameras: CameraRows | None) -> Traced:
        """Prepare parameters; `cameras` are those of the parameters, if their values may be read."""
        if cameras is not None:
            domain, usable = cameras.domain, cameras.usable
        else:
            able = _usable(model, intrinsics.detach(), distortion.detach())
            usable = able.to(intrinsics.dtype)
            k = torch.where(able, distortion.detach(), _ideal(model, intrinsics, distortion)[1])
            domain = Domain(model.optics, k, recorded_tables(model, k))
        if usable is not None:
            pairs = zip((intrinsics, distortion), _ideal(model, intrinsics, distortion), strict=True)
            intrinsics, distortion = (replace(usable, values, ideal) for values, ideal in pairs)
        return cls(model, intrinsics, distortion, domain, usable)

    def optics(self, distortion: Tensor) -> tuple[Chart, Lens]:
        """Return the chart and lens of the coefficients in a graph, or the ready ones of a constant camera."""
        domain = self.domain
        return (domain.chart, domain.lens) if domain.is_constant else self.model.optics(columns(distortion))


def replace(mask: Tensor | None, plane: Tensor, value: float | Tensor) -> Tensor:
    """Return the plane where the mask is 1, and the value where it is 0."""
    return plane if mask is None else torch.where(mask > 0, plane, value)


def to_mask(margin: Tensor, looks: bool = False) -> Tensor | None:
    """Return 1 for a positive margin, else 0, in its dtype: compiled graphs write bools one by one.

    If the call `looks` at values, it is None for margins that are all positive.
    """
    margin = margin.detach()
    return None if looks and bool(margin.amin() > 0) else (margin > 0).to(margin.dtype)


def both(mask: Tensor | None, other: Tensor | None) -> Tensor | None:
    """Return the product of two masks."""
    return other if mask is None else mask if other is None else mask * other
