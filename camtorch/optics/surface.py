"""The surface stage: a uniform B-spline surface that is added to a plane.

`Surface(controls, columns, rows, order=3, cells=(sa, sb), centre=(ca, cb))` is a stage for any lens: the only one of
the splined stereographic camera, or one more after those of another lens, `Lens(*lens.stages, Surface(...))`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from camtorch.native.structs import SURFACE
from camtorch.optics.charts import Planes2
from camtorch.optics.lens import Jacobian, Stage, StageAt

BEHIND = 1e-4  # cells past its edge that belong to a surface, so that points on its edge are on it in any rounding


class SurfaceAt(StageAt):
    """A `Surface` at points."""

    stage: Surface

    def __init__(self, stage: Surface, a: Tensor, b: Tensor):
        super().__init__(stage, a, b)
        # control points (..., order + 1, order + 1, 2), rows first, and weights and slopes along a and b;
        # computed at once: torch.compile cannot enter the lock that cached_property has before Python 3.12
        controls = stage.parameters
        points = torch.stack(controls, -1).unflatten(-1, (len(controls) // 2, 2)).flatten(0, -2)
        (i, wa, da), (j, wb, db) = self._place(0), self._place(1)
        # each camera, or point, has its own control points
        first = (torch.ones_like(controls[0], dtype=torch.int64).flatten().cumsum(0) - 1).view(controls[0].shape)
        index = first * (stage.columns * stage.rows) + j * stage.columns + i
        steps = torch.arange(stage.order + 1, device=index.device)
        index = index[..., None, None] + steps[:, None] * stage.columns + steps
        self._patch = points.index_select(0, index.flatten()).view(*index.shape, 2), wa, da, wb, db

    def _place(self, axis: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the first of the control points that contribute, weights (..., order + 1), and their slopes."""
        stage, w = self.stage, (self.a, self.b)[axis]
        size = (stage.columns, stage.rows)[axis]
        position = (w - stage.centre[axis]) * stage.cells[axis] + (size - 1) / 2
        near = position.detach().nan_to_num(0.0)
        cell = (near.floor() if stage.order == 3 else (near + 0.5).floor()).clamp(1, size - stage.order)
        x = position - cell
        if stage.order == 3:
            y, xx = 1 - x, x * x
            weights = y * y * y, (3 * x - 6) * xx + 4, ((3 - 3 * x) * x + 3) * x + 1, xx * x
            slopes = -y * y / 2, (3 * x - 4) * x / 2, (1 + (2 - 3 * x) * x) / 2, xx / 2
            return cell.long() - 1, torch.stack(weights, -1) / 6, torch.stack(slopes, -1)
        few = (4 * x - 4) * x + 1, 6 - 8 * x * x, (4 * x + 4) * x + 1
        return cell.long() - 1, torch.stack(few, -1) / 8, torch.stack((x - 0.5, -2 * x, x + 0.5), -1)

    @staticmethod
    def _sum(patch: Tensor, along: Tensor, down: Tensor) -> Planes2:
        x, y = ((patch * down[..., None, None]).sum(-3) * along[..., None]).sum(-2).unbind(-1)
        return x, y

    @property
    def value(self) -> Planes2:
        patch, wa, _, wb, _ = self._patch
        x, y = self._sum(patch, wa, wb)
        return self.a + x, self.b + y

    @property
    def jacobian(self) -> Jacobian:
        patch, wa, da, wb, db = self._patch
        sa, sb = self.stage.cells
        (ua, va), (ub, vb) = self._sum(patch, da, wb), self._sum(patch, wa, db)
        return 1 + ua * sa, ub * sb, va * sa, 1 + vb * sb

    @property
    def edge(self) -> Tensor:
        """The distance from the edge in cells."""
        stage = self.stage
        (sa, sb), (ca, cb) = stage.cells, stage.centre
        across = (stage.columns - stage.order) / 2 + stage.behind - ((self.a - ca) * sa).abs()
        return torch.minimum(across, (stage.rows - stage.order) / 2 + stage.behind - ((self.b - cb) * sb).abs())


class Surface(Stage):
    """(a, b) -> (a, b) + du(a, b), du a uniform B-spline surface of order 2 (quadratic) or 3 (cubic).

    Control point (i, j) of the grid, i < columns, j < rows, lies at (a, b) = ((i - (columns - 1) / 2) / sa + ca,
    (j - (rows - 1) / 2) / sb + cb). The surface ends where one more control point would contribute: 1 control point
    (order 3) or 1/2 (order 2) from the outermost ones. Behind that edge, where nothing is valid, the outermost
    pieces go on. Source: mrcal.c, `sample_bspline_surface_cubic` and `..._quadratic`.

    Args:
        controls: 2 columns rows coefficients, columns that broadcast against planes: du_a and du_b of point (0, 0), of
            (1, 0), ...: those of (i, j) at 2 (j columns + i).
        columns: Control points along a, more than the order.
        rows: Control points along b.
        order: 2 or 3.
        cells: (sa, sb), the number of cells in a unit of a and of b, positive.
        centre: (ca, cb), the middle of the grid. The origin of the plane must be on the surface.
        behind: Cells past its edge that belong to it.
    """

    code: ClassVar[int | None] = SURFACE
    _at = SurfaceAt

    columns: int
    rows: int
    order: int
    cells: tuple[float, float]
    centre: tuple[float, float]
    behind: float

    def __init__(
        self,
        controls: Sequence[Tensor],
        columns: int,
        rows: int,
        *,
        order: int = 3,
        cells: tuple[float, float],
        centre: tuple[float, float] = (0.0, 0.0),
        behind: float = BEHIND,
    ):
        self.columns, self.rows, self.order, self.behind = columns, rows, order, behind
        self.cells, self.centre = cells, centre
        self.parameters: tuple[Tensor, ...] = tuple(controls)

    def __call__(self, a: Tensor, b: Tensor) -> Planes2:
        return self.at(a, b).value

    def lower_bound(self, radius: Tensor) -> Planes2:
        """Return the bounds of `Stage.lower_bound`: slopes of a spline lie between those of lines from control point to
        control point, and the spline between these lines, for those that contribute within the circle.
        """
        grid = torch.stack(self.parameters, -1).unflatten(-1, (self.rows, self.columns, 2))
        sizes = self.columns, self.rows

        def nearest(more_a: int, more_b: int) -> Tensor:
            """Return the distances (P,) from the origin at which differences along a or b begin to contribute."""
            reach = (self.order + 1) / 2
            sides = []
            for size, more, s, c in zip(sizes, (more_a, more_b), self.cells, self.centre, strict=True):
                middle = torch.arange(size - more, dtype=radius.dtype, device=radius.device) - (size - 1 - more) / 2
                sides.append(((middle / s + c).abs() - (reach - more / 2) / s).clamp(min=0))
            return torch.hypot(sides[0].unsqueeze(-2), sides[1].unsqueeze(-1)).flatten(-2)

        def most(values: Tensor, begin: Tensor) -> Tensor:
            """Return (*C, S), the largest of (*C, 1, P) that begin before each radius; 0 if all are less."""
            values = torch.where(begin <= radius.unsqueeze(-1), values.flatten(-2), 0.0)
            return values.amax(-1)

        along, down = grid.diff(dim=-2) * self.cells[0], grid.diff(dim=-3) * self.cells[1]
        here, there = nearest(1, 0), nearest(0, 1)
        steepest = torch.maximum(most(-along[..., 0], here), most(-down[..., 1], there))
        across = (most(along[..., 1].abs(), here) + most(down[..., 0].abs(), there)) / 2
        edge = [(n - self.order) / 2 / s - abs(c) for n, s, c in zip(sizes, self.cells, self.centre, strict=True)]
        inside = min(edge) - radius
        far = radius + most(torch.hypot(*grid.unbind(-1)), nearest(0, 0))
        return torch.where(inside > 0, 1 - steepest - across, inside.clamp(max=-1e-3)), far

    def start(self, u: Tensor, v: Tensor) -> Planes2:
        (sa, sb), (ca, cb) = self.cells, self.centre
        half_a, half_b = (self.columns - self.order) / 2 / sa, (self.rows - self.order) / 2 / sb
        a, b = u, v
        for _ in range(3):  # stay on the surface, behind which it may be anywhere
            a, b = a.clamp(ca - half_a, ca + half_a), b.clamp(cb - half_b, cb + half_b)
            x, y = self.at(a, b).value
            a, b = a + u - x, b + v - y
        return a, b
