"""Linearised least squares as triangles of a QR: of each view's own unknowns, and of those that all views share."""

from ctypes import addressof, c_int64
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from camtorch.native.library import library, loaded
from camtorch.native.structs import Steps


@dataclass(frozen=True)  # and no tuple: pickles of 0.5.0 have one of three fields, which nobody reads
class Equations:
    """Triangles of the linearised problem, with L unknowns of each view, and G unknowns that all views share.

    A row of `view` means view[:L] * step of the view + view[L:-1] * shared step = -view[-1].
    """

    view: Tensor  # (B, V, L, L + G + 1)
    shared: Tensor  # (B, G + 1, G + 1): the rest of all views


_NOTHING = 1e-20  # of a column's squares: the rounding left of a column that is a sum of others
_FEW_UNKNOWNS = 64  # shared ones, up to which native code is faster than LAPACK
_FIRM = 1e-4  # of the largest singular value: smaller ones belong to unknowns that the data hardly determine


class System:
    """Linear problems with their damped steps, for `levenberg_marquardt.minimise`."""

    def __init__(self, equations: Equations, width: int, held: Tensor):
        self.width = width
        of_views, own = equations.view.square().sum((1, 2)), equations.shared[:, :-1].square().sum(-2)
        # unknowns that the views' own unknowns can replace, like a turn about a panorama's axis, are held
        held = held | (own < _NOTHING * (own + of_views[:, width:]))[:, :-1]
        # the decrease of the cost by a full step if the problem were linear
        self.equations, self.decrement = equations, of_views[:, -1] + own[:, -1]
        if bool(held.any()):
            keep = torch.nn.functional.pad(~held, (width, 1), value=True)
            equations = Equations(
                torch.where(keep[:, None, None], equations.view, 0.0),
                torch.where(keep[:, None, width:], equations.shared, 0.0),
            )
            # without a column the rest is not a triangle
            self.equations = replace(equations, shared=torch.linalg.qr(equations.shared, mode="r").R)
            view, shared = self.equations.view[..., -1], self.equations.shared[:, :-1, -1]
            self.decrement = view.square().sum((-1, -2)) + shared.square().sum(-1)

    @property
    def firm_decrement(self) -> Tensor:
        """The decrement (R,) without combinations of unknowns that the data hardly determine."""
        view, shared = self.equations.view[..., -1], self.equations.shared
        if shared.shape[-1] == 1:
            return self.decrement
        matrix = shared[:, :-1, :-1]
        scale = torch.linalg.vector_norm(matrix, dim=-2, keepdim=True)
        axes, sizes, _ = torch.linalg.svd(matrix / torch.where(scale > 0, scale, 1.0))
        along = (axes.mT @ shared[:, :-1, -1:])[..., 0]
        firm = sizes > _FIRM * sizes[:, :1]
        return view.square().sum((-1, -2)) + torch.where(firm, along, 0.0).square().sum(-1)

    def step(self, damping: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Return steps of the views (R, V, L) and of shared unknowns (R, G), and the linear cost's decrease (R,)."""
        view, shared, width = self.equations.view, self.equations.shared, self.width
        is_usual = shared.is_cpu and shared.dtype == torch.float64 and shared.shape[-1] <= _FEW_UNKNOWNS
        if is_usual and library() is not None:
            return self._compiled_step(damping)
        squares, root = view[..., :-1].square().sum(-2), damping.sqrt()
        rest = shared.shape[-1] - 1
        scale = squares[..., :width].sqrt()
        scale = torch.where(scale > 0, scale, 1.0) * root[:, None, None]
        damped = torch.cat((torch.diag_embed(scale), view.new_zeros(*scale.shape, rest + 1)), -1)
        rows = torch.cat((view, damped), -2)
        if rest:
            view = torch.linalg.qr(rows, mode="r").R
            left = view[..., width:, width:].flatten(1, 2)
            view = view[..., :width, :]
            scale = (squares[..., width:].sum(1) + shared[:, :-1, :-1].square().sum(-2)).sqrt()
            scale = torch.where(scale > 0, scale, 1.0)
            damped = torch.nn.functional.pad(torch.diag_embed(root[:, None].expand_as(scale)), (0, 1))
            # columns differ by many orders of magnitude
            by = torch.nn.functional.pad(scale, (0, 1), value=1.0)[:, None]
            triangle = torch.linalg.qr(torch.cat((shared / by, left / by, damped), 1), mode="r").R
            whole = -_solve(triangle[:, :rest, :rest], triangle[:, :rest, -1:])[..., 0] / scale
        else:
            view, whole = triangle_of_few(rows), shared.new_zeros(len(shared), 0)
        right = view[..., -1:] + view[..., width:-1] @ whole[:, None, :, None]
        of_views = -_solve(view[..., :width], right)[..., 0]
        fine = torch.isfinite(whole).all(-1) & torch.isfinite(of_views).all(-1).all(-1)
        of_views, whole = torch.where(fine[:, None, None], of_views, 0.0), torch.where(fine[:, None], whole, 0.0)
        # the part of the decrement that remains after the step
        steps = torch.cat((of_views, whole[:, None].expand(-1, of_views.shape[1], -1)), -1)
        mine = (self.equations.view[..., :-1] @ steps[..., None])[..., 0] + self.equations.view[..., -1]
        ours = (shared[:, :-1, :-1] @ whole[..., None])[..., 0] + shared[:, :-1, -1]
        return (of_views, whole), self.decrement - (mine.square().sum((-1, -2)) + ours.square().sum(-1))

    def _compiled_step(self, damping: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor]:
        given = [t.contiguous() for t in (self.equations.view, self.equations.shared, damping)]
        (count, views), columns = given[0].shape[:2], given[1].shape[-1] - 1
        of_views, whole = damping.new_empty(count, views, self.width), damping.new_empty(count, columns)
        left, rest, call = c_int64(0), torch.empty_like(damping), Steps()
        call.view, call.shared, call.damping = (t.data_ptr() for t in given)
        call.problems, call.views, call.width, call.columns = count, views, self.width, columns
        call.of_views, call.of_shared, call.rest = (t.data_ptr() for t in (of_views, whole, rest))
        call.left = addressof(left)
        loaded().camtorch_steps(call)
        if left.value:
            raise MemoryError(f"no memory for {views} views. Pass fewer")
        return (of_views, whole), self.decrement - rest


def triangle_of_few(rows: Tensor) -> Tensor:
    """Return a triangle (..., L, L + 1) of rows (..., M, L + 1) with few, well separated columns."""
    products = rows.mT @ rows
    squares, right = products[..., :-1, :-1], products[..., :-1, -1:]
    scale = squares.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(scale > 0, scale, 1.0).rsqrt()
    scaled = squares * scale[..., None] * scale[..., None, :]
    # a view with no or too few points keeps its pose
    scaled = scaled + torch.diag_embed(torch.full_like(scale, 1e-14))
    lower, _ = torch.linalg.cholesky_ex(scaled)
    turned = torch.linalg.solve_triangular(lower, scale[..., None] * right, upper=False)
    return torch.cat((lower.mT / scale[..., None, :], turned), -1)


def _solve(triangle: Tensor, right: Tensor) -> Tensor:
    """Solve the triangular system; unknowns with a zero on the diagonal are zero."""
    empty = triangle.diagonal(dim1=-2, dim2=-1) == 0
    triangle = triangle + torch.diag_embed(empty.to(triangle.dtype))
    solution: Tensor = torch.linalg.solve_triangular(triangle, torch.where(empty[..., None], 0.0, right), upper=True)
    return solution


def padded(rows: Tensor) -> Tensor:
    """Pad rows (..., M, K) with zeros to at least K rows."""
    missing = rows.shape[-1] - rows.shape[-2]
    return torch.nn.functional.pad(rows, (0, 0, 0, missing)) if missing > 0 else rows
