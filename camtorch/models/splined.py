"""mrcal's splined stereographic camera: a B-spline surface over the stereographic plane."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, ClassVar

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.cameras.freezing import INTRINSICS, learning_words
from camtorch.evaluate.tensors import values_of
from camtorch.native.structs import UNIFIED
from camtorch.optics import Chart, Lens, Surface, Unified
from camtorch.optics.surface import BEHIND
from camtorch.values.arguments import as_whole, hinting

_VARIANT = re.compile(r"order=(\d),columns=(\d{1,3}),rows=(\d{1,3}),fov_x=(\d{1,3})")


class StereographicUpTo(Unified):
    """The stereographic chart of a lens that ends within a radius."""

    code: ClassVar[int | None] = UNIFIED

    def __init__(self, last: float):
        super().__init__(alpha=0.5)
        self.last = last

    def end(self, dtype: torch.dtype) -> float:
        return self.last

    def usual_end(self, dtype: torch.dtype) -> float:
        return self.last

    radii = Chart.radii


class Splined(Camera):
    """mrcal's splined stereographic camera, `LENSMODEL_SPLINED_STEREOGRAPHIC`: (u, v) = f (m + du(m)) + c.

    m = 2 tan(theta / 2) (cos phi, sin phi), theta = atan2(hypot(x, y), z); du is a uniform B-spline surface of order 2
    (quadratic) or 3 (cubic) over columns x rows control points. It can follow any lens, symmetric or not, and is
    undetermined where it was not fitted. A ray is valid on the surface, which ends fov_x / 2 to the left and to
    the right of the axis and, in the plane, (rows - order) / (columns - order) as far above and below; and before a
    fold. Another grid than that of this class is a class of its own, `Splined.with_grid(...)`.

    Distortion: x0_0 y0_0 x1_0 y1_0 ..., du of the control points in units of the focal length, row by row: xi_j and
    yi_j of column i and row j. Intrinsics could also do the surface's scales and shifts, so fits hold them.
    Sources: mrcal.c, and https://mrcal.secretsauce.net/splined-models.html. See `Camera` for conventions and errors.
    """

    key = "splined"
    order: ClassVar[int] = 3
    columns: ClassVar[int] = 10
    rows: ClassVar[int] = 8
    fov_x: ClassVar[int] = 160
    quarter_turn = None

    @classmethod
    @hinting("Call ct.Splined.with_grid(columns=16, rows=11, fov_x=120), mrcal's Nx, Ny and fov_x_deg")
    def with_grid(cls, *, columns: int, rows: int, fov_x: float, order: int = 3) -> type[Splined]:
        """Return the class of cameras of another grid: a model for `convert`, `calibrate` and files like any other.

        Args:
            columns: Control points across, more than the order, up to 999.
            rows: Control points down.
            fov_x: Horizontal field of view of the surface in whole DEGREES, as in mrcal's files, from 1 to 359.
            order: Order of the spline, 2 or 3.

        Raises:
            ValueError: If the order, a size of the grid or the field of view is out of these ranges.
        """
        owner = "Splined.with_grid"
        fov_x = int(fov_x) if isinstance(fov_x, float) and fov_x.is_integer() else fov_x
        order, columns, rows, fov_x = (
            as_whole(value, name, owner)
            for value, name in ((order, "order"), (columns, "columns"), (rows, "rows"), (fov_x, "fov_x"))
        )
        if order not in (2, 3):
            raise ValueError(f"{owner}: order must be 2 or 3; got {order}")
        for name, count in (("columns", columns), ("rows", rows)):
            if not order < count < 1000:
                raise ValueError(f"{owner}: {name} must be from {order + 1} to 999 at order {order}; got {count}")
        if not 0 < fov_x < 360:
            raise ValueError(f"{owner}: fov_x must be degrees, from 1 to 359; got {fov_x}")
        return _with_grid(order, columns, rows, fov_x)

    @classmethod
    def variant(cls, text: str) -> type[Camera]:
        if cls is not Splined:  # a grid class has no variants
            return super().variant(text)
        found = _VARIANT.fullmatch(text)
        if found is None:
            raise ValueError(
                f"a grid must be written as 'splined:order=3,columns=16,rows=11,fov_x=120'; got {text!r:.60}"
            )
        order, columns, rows, fov_x = map(int, found.groups())
        return cls.with_grid(order=order, columns=columns, rows=rows, fov_x=fov_x)

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        return tuple(cls.distortion_names) if count == cls.default_count else None

    @classmethod
    def counts_text(cls) -> str:
        return f"n = {cls.default_count} (x and y of {cls.columns} x {cls.rows} control points: x0_0 y0_0 x1_0 ...)"

    @classmethod
    def smoothness(cls) -> Tensor:
        grid = torch.eye(cls.default_count, dtype=torch.float64).view(cls.rows, cls.columns, 2, -1)
        across, down = grid.diff(dim=1), grid.diff(dim=0)
        parts = across.diff(dim=1), down.diff(dim=0), math.sqrt(2) * across.diff(dim=0)
        return torch.cat([part.flatten(0, 2) for part in parts])

    @classmethod
    @cache
    def model_for_search(cls) -> type[Camera]:
        # the outermost pieces are longer, as corners at the edge would block the search
        optics = _optics_of(cls.order, cls.columns, cls.rows, cls.fov_x, behind=1.0)
        named = {"__module__": Camera.__module__, "__qualname__": f"{cls.key}:searched", "__doc__": cls.__doc__}
        return type("Splined", (cls,), {**named, "optics": staticmethod(optics)})

    def extra_repr(self) -> str:
        """Return the fields with the grid instead of its control points."""
        parts = [f"batch_shape={tuple(self.batch_shape)}"] if self.batch_shape else []
        numbers = None if self.batch_shape else values_of(self.intrinsics)
        if numbers is not None:
            parts += [f"{name}={value:.6g}" for name, value in zip(INTRINSICS, numbers.tolist(), strict=True)]
        parts.append(f"order={self.order}, columns={self.columns}, rows={self.rows}, fov_x={self.fov_x}")
        parts += [f"image_size={self.image_size}"] if self.image_size else []
        return ", ".join([*parts, *learning_words(self)])


def _optics_of(
    order: int, columns: int, rows: int, fov_x: int, behind: float
) -> Callable[[Sequence[Tensor]], tuple[Chart, Lens]]:
    """Return the optics of a surface that ends `behind` cells beyond its edge."""
    cells = (columns - order) / (4 * math.tan(math.radians(fov_x) / 4))
    last = math.hypot((columns - order) / 2 + behind, (rows - order) / 2 + behind) / cells * (1 + 1e-3)

    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        surface = Surface(k, columns, rows, order=order, cells=(cells, cells), behind=behind)
        return StereographicUpTo(last), Lens(surface)

    return optics


def _of_grid(order: int, columns: int, rows: int, fov_x: int) -> dict[str, Any]:
    def mirror(turn: str, place: Any) -> Mapping[str, str]:
        signs = {axis: "-" if axis == turn else "" for axis in "xy"}
        pairs = [(i, j) for j in range(rows) for i in range(columns)]
        return {f"{w}{i}_{j}": f"{signs[w]}{w}{place(i, j)}" for i, j in pairs for w in "xy"}

    return {
        "optics": staticmethod(_optics_of(order, columns, rows, fov_x, BEHIND)),
        "default_count": 2 * columns * rows,
        "distortion_names": tuple(f"{w}{i}_{j}" for j in range(rows) for i in range(columns) for w in "xy"),
        "mirror_x": mirror("x", lambda i, j: f"{columns - 1 - i}_{j}"),
        "mirror_y": mirror("y", lambda i, j: f"{i}_{rows - 1 - j}"),
    }


@cache
def _with_grid(order: int, columns: int, rows: int, fov_x: int) -> type[Splined]:
    grid = {"order": order, "columns": columns, "rows": rows, "fov_x": fov_x}
    if all(getattr(Splined, name) == value for name, value in grid.items()):
        return Splined
    text = ",".join(f"{name}={value}" for name, value in grid.items())
    # a place where pickle finds it
    named = {"__module__": Camera.__module__, "__qualname__": f"{Splined.key}:{text}", "__doc__": Splined.__doc__}
    made: type[Splined] = type("Splined", (Splined,), {**named, **grid, **_of_grid(**grid)})
    made.key = made.__qualname__  # found by its text, without an entry in MODELS
    return made


for _name, _value in _of_grid(Splined.order, Splined.columns, Splined.rows, Splined.fov_x).items():
    setattr(Splined, _name, _value)
