"""The camera whose r(theta) is a table, as provided by lens vendors."""

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import Self

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, EquidistantUpTo, Lens, Planar, RadiusTable
from camtorch.values.arguments import Numbers, as_number, as_real


class Tabulated(Camera):
    """A radially symmetric camera whose r(theta) is a table: (u, v) = f r (cos phi, sin phi) + c.

    theta = atan2(hypot(x, y), z), so that angles past 90 degrees are real. Between the nodes, and (0, 0), r is a cubic
    spline with two continuous derivatives, odd in theta, and kept monotone by Hyman's filter where the table is; at
    nodes that the filter changes only the first derivative is continuous. A ray is valid up to the last angle, and
    before r stops ascending.

    Distortion: theta1 ... thetaN r1 ... rN, N >= 2: the angles in radians, ascending, which do not learn (their
    gradient is zero), and the radii in units of the focal length, which do. By default equidistant. `from_table` takes
    a table in millimetres. Source of the filter: Hyman, "Accurate monotonicity preserving cubic
    interpolation", SIAM J. Sci. Stat. Comput. 1983. See `Camera` for shapes, conventions and errors.
    """

    key = "tabulated"
    distortion_names: tuple[str, ...] = (*(f"theta{i}" for i in range(1, 7)), *(f"r{i}" for i in range(1, 7)))
    default_count = 12
    fit_counts = (128,)
    # a fit samples the curve; near the axis few pixels would determine so many nodes
    fit_bounds = MappingProxyType({f"{c}{i}": None for c in ("theta", "r") for i in range(1, 1001)})
    defined_text = "angles that ascend from above 0"

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        numbers = range(1, count // 2 + 1)
        even = count >= 4 and count % 2 == 0
        return (*(f"theta{i}" for i in numbers), *(f"r{i}" for i in numbers)) if even else None

    @classmethod
    def counts_text(cls) -> str:
        return "n = 4, 6, 8, ... (theta1 theta2 ... r1 r2 ...)"

    @classmethod
    def ideal(cls, count: int) -> tuple[float, ...]:
        angles = tuple(2 * math.pi * i / count for i in range(1, count // 2 + 1))
        return angles + angles

    @staticmethod
    def defined(k: Sequence[Tensor]) -> Tensor | None:
        angles = torch.stack((torch.zeros_like(k[0]), *k[: len(k) // 2]), -1)
        return angles.diff(dim=-1).amin(-1)

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        angles, radii = [w.detach() for w in k[: len(k) // 2]], k[len(k) // 2 :]
        return EquidistantUpTo(angles[-1]), Lens(Planar(RadiusTable(angles, radii)))

    @classmethod
    def fit_start(cls, names: tuple[str, ...], angles: Tensor, radii: Tensor) -> Tensor:
        count = len(names) // 2
        # rounding would lose a ray at the last node itself
        nodes = angles[:, -1:] * (1 + 1e-9) * torch.arange(1, count + 1).to(angles) / count
        place = nodes / angles[:, :1]
        before = place.long().clamp(max=angles.shape[-1] - 1)
        table = torch.cat((torch.zeros_like(radii[:, :1]), radii), -1)
        low, high = table.gather(-1, before), table.gather(-1, before + 1)
        return torch.cat((nodes.clamp(max=math.pi), low + (place - before) * (high - low)), -1)[None]

    @classmethod
    def from_table(
        cls,
        centre: Numbers,
        angles: Numbers,
        radii: Numbers,
        *,
        pixels_per_unit: float = 1.0,
        image_size: Sequence[int] | None = None,
    ) -> Self:
        """Return the camera of a table of angles and image heights, in any unit of length or in pixels.

        The focal length becomes the slope of the table at its beginning, so that r is nearly theta there.

        Args:
            centre: cx, cy (2,), the pixel of the axis.
            angles: Ascending angles (N,) in radians; a first 0 with the height 0 is left out.
            radii: Image heights (N,).
            pixels_per_unit: Pixels per unit of the heights.
            image_size: (height, width) in pixels.

        Raises:
            ValueError: If the table has another shape, does not ascend from the origin, or exceeds half a turn.
        """
        pixels_per_unit = as_number(pixels_per_unit, "pixels_per_unit", cls.__name__)
        centre = as_real(centre, "centre", cls.__name__)
        angles = as_real(angles, "angles", cls.__name__, centre.device)
        radii = as_real(radii, "radii", cls.__name__, centre.device)
        if centre.shape != (2,) or angles.ndim != 1 or angles.shape != radii.shape:
            shapes = [tuple(t.shape) for t in (centre, angles, radii)]
            raise ValueError(f"{cls.__name__}: centre must be (2,), angles and radii (N,); got shapes {shapes}")
        if len(angles) and angles[0] == 0 == radii[0]:
            angles, radii = angles[1:], radii[1:]
        if len(angles) < 2 or not (angles[0] > 0 and radii[0] > 0):
            raise ValueError(
                f"{cls.__name__}: the table must have two nodes that ascend from (0, 0); got angles {angles.tolist()} "
                f"and radii {radii.tolist()}"
            )
        if angles[-1] > math.pi * (1 + 1e-6):
            raise ValueError(f"{cls.__name__}: angles must be at most pi radians; got {float(angles[-1])}. Use radians")
        focal = radii[:1] / angles[:1]
        intrinsics = torch.cat((focal * pixels_per_unit, focal * pixels_per_unit, centre))
        return cls(intrinsics, torch.cat((angles, radii / focal)), image_size=image_size)
