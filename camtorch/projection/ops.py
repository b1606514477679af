"""Parts that a traced graph does not follow: tables of a lens, and the search where Newton's method stays open.

As operators they keep compiled graphs small, and can read values inside vmap as well.
"""

from typing import Any

import torch
from torch import Tensor

from camtorch.evaluate.recorded import CLASSES
from camtorch.native.structs import AZIMUTHS
from camtorch.optics.radial_inverse import TABLE_WIDTH, InverseTable
from camtorch.projection.camera_like import CameraLike
from camtorch.projection.domain import domain_of, way_of_inverse
from camtorch.projection.solve import search
from camtorch.values.arguments import columns


def recorded_tables(model: type[CameraLike], k: Tensor) -> dict[str, object]:
    """Return the properties of a `Domain` that a graph needs, in which no value may be read to choose an inverse."""
    chart, lens = model.optics(columns(k))
    if not lens.stages:
        return {}
    safe_radius_sq, limits2, table = tables(model.operator_name, k)
    return {
        "safe_radius_sq": safe_radius_sq,
        "image_radius_sq": safe_radius_sq.clamp(max=chart.usual_end(k.dtype) ** 2),
        "limits2": limits2,
        "inverse": InverseTable(table) if lens.radial else None,
        "inverse_by": way_of_inverse(lens.is_radial, None),
    }


@torch.library.custom_op("camtorch::tables", mutates_args=())
def tables(model: str, k: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return `safe_radius_sq`, `limits2` and `table` of a `Domain`, without columns if the lens needs none."""
    domain = domain_of(model, k, CLASSES[model].optics)
    empty = k.new_empty(len(k), 0)
    # clones, as the caller may write into them
    return (
        domain.safe_radius_sq.clone(),
        empty if domain.lens.is_radial else domain.limits2.clone(),
        domain.table.clone() if domain.lens.radial else empty.clone(),
    )


@tables.register_fake
def _(model: str, k: Tensor) -> tuple[Tensor, ...]:
    lens = CLASSES[model].optics(columns(k))[1]
    widths = 1, 0 if lens.is_radial else AZIMUTHS, TABLE_WIDTH if lens.radial else 0
    return tuple(k.new_empty(len(k), width) for width in widths)


@torch.library.custom_op("camtorch::search_", mutates_args=("a", "b", "solved"))
def search_in_place(
    model: str, k: Tensor, u: Tensor, v: Tensor, a: Tensor, b: Tensor, solved: Tensor, possible: Tensor
) -> None:
    """Write the results of `search` for points (C, N), possible but not solved, into (a, b, solved) of `Found`."""
    if not solved.numel() or bool(solved.amin() > 0):
        return
    camera, point = (~(solved > 0) & (possible > 0)).nonzero(as_tuple=True)
    if len(camera):
        domain = domain_of(model, k, CLASSES[model].optics)
        found_a, found_b, found = search(domain, camera, u[camera, point], v[camera, point])
        a[camera, point], b[camera, point] = found_a, found_b
        solved[camera, point] = torch.where(found, 1.0, -1.0).to(solved.dtype)


@torch.library.custom_op("camtorch::search", mutates_args=())
def search_open(
    model: str, k: Tensor, u: Tensor, v: Tensor, a: Tensor, b: Tensor, solved: Tensor, possible: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the results of `search_in_place` in copies: vmap has no rule for operators that write."""
    results = a.clone(), b.clone(), solved.clone()
    search_in_place(model, k, u, v, *results, possible)
    return results


@search_in_place.register_fake
def _(*_: Any) -> None:
    pass


@search_open.register_fake
def _(model: str, *planes: Tensor) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(plane) for plane in planes[3:6])


@tables.register_vmap
def _(info: Any, in_dims: tuple[Any, ...], model: str, k: Tensor) -> Any:
    k = k.movedim(in_dims[1], 0)
    return tuple(r.unflatten(0, k.shape[:2]) for r in tables(model, k.flatten(0, 1))), (0, 0, 0)


@search_open.register_vmap
def _(info: Any, in_dims: tuple[Any, ...], model: str, k: Tensor, *planes: Tensor) -> Any:
    # the mapped dim joins the cameras, or the points if the cameras are not mapped
    cameras = in_dims[1] is not None
    rows = []
    for plane, dim in zip(planes, in_dims[2:], strict=True):
        plane = plane.expand(info.batch_size, *plane.shape) if dim is None else plane.movedim(dim, 0)
        rows.append(plane if cameras else plane.movedim(0, 1))
    joined = 0 if cameras else 1
    shape = rows[0].shape[joined : joined + 2]
    k = k.movedim(in_dims[1], 0).flatten(0, 1) if cameras else k
    results = search_open(model, k, *(plane.flatten(joined, joined + 1) for plane in rows))
    return tuple(r.unflatten(joined, shape) for r in results), (joined,) * 3
