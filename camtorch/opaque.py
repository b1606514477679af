"""What a traced graph does not look into: tables of a lens, and the search for what is left open by Newton's method.

As operators of their own they keep compiled graphs small, and look at values inside vmap as well.
"""

from __future__ import annotations

import torch
from torch import Tensor

from camtorch.azimuths import AZIMUTHS
from camtorch.domain import Domain, Optics, table_width
from camtorch.parameters import columns, same
from camtorch.solve import search

MODELS: dict[str, Optics] = {}
"""The optics of every class of cameras, by its full name: operators take no functions."""

_KEPT = 8
_domains: list[tuple[str, Tensor, Domain]] = []


def _domain(model: str, k: Tensor) -> Domain:
    """The domain of these values: one of the last ones, or a new one."""
    for name, values, domain in _domains:
        if name == model and same(values, k):
            return domain
    with torch.inference_mode(False), torch.no_grad():
        values = k.detach().clone()
        domain = Domain(MODELS[model], values)
    _domains.insert(0, (model, values, domain))
    del _domains[_KEPT:]
    return domain


@torch.library.custom_op("camtorch::tables", mutates_args=())
def tables(model: str, k: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`Domain.inner2`, `limits2` and `table` of coefficients (C, n); without columns where the lens needs none."""
    domain = _domain(model, k)
    empty = k.new_empty(len(k), 0)
    # clones: who gets them may write into them
    return (
        domain.inner2.clone(),
        empty if domain.lens.is_radial else domain.limits2.clone(),
        domain.table.clone() if domain.lens.radial else empty.clone(),
    )


@tables.register_fake
def _(model, k):
    lens = MODELS[model](columns(k))[1]
    widths = 1, 0 if lens.is_radial else AZIMUTHS, table_width() if lens.radial else 0
    return tuple(k.new_empty(len(k), width) for width in widths)


@torch.library.custom_op("camtorch::search", mutates_args=())
def search_open(
    model: str, k: Tensor, u: Tensor, v: Tensor, a: Tensor, b: Tensor, solved: Tensor, possible: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(a, b, solved) of `Found`, and what `search` finds of the points (C, N) that are not solved, but possible."""
    a, b, solved = a.clone(), b.clone(), solved.clone()
    camera, point = (~(solved > 0) & (possible > 0)).nonzero(as_tuple=True)
    if len(camera):
        found_a, found_b, found = search(_domain(model, k), camera, u[camera, point], v[camera, point])
        a[camera, point], b[camera, point] = found_a, found_b
        solved[camera, point] = torch.where(found, 1.0, -1.0).to(solved.dtype)
    return a, b, solved


@search_open.register_fake
def _(model, k, u, v, a, b, solved, possible):
    return torch.empty_like(a), torch.empty_like(b), torch.empty_like(solved)


@tables.register_vmap
def _(info, in_dims, model, k):
    results = tables(model, k.movedim(in_dims[1], 0).flatten(0, 1))
    return tuple(r.unflatten(0, (info.batch_size, -1)) for r in results), (0, 0, 0)


@search_open.register_vmap
def _(info, in_dims, model, k, *planes):
    # the mapped dim joins the cameras, or the points where the cameras are not mapped
    cameras = in_dims[1] is not None
    rows = []
    for plane, dim in zip(planes, in_dims[2:], strict=True):
        plane = plane.expand(info.batch_size, *plane.shape) if dim is None else plane.movedim(dim, 0)
        rows.append((plane if cameras else plane.movedim(0, 1)).flatten(*((0, 1) if cameras else (1, 2))))
    results = search_open(model, k.movedim(in_dims[1], 0).flatten(0, 1) if cameras else k, *rows)
    if cameras:
        return tuple(r.unflatten(0, (info.batch_size, -1)) for r in results), (0, 0, 0)
    return tuple(r.unflatten(1, (info.batch_size, -1)) for r in results), (1, 1, 1)
