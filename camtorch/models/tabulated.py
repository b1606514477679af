"""The radially symmetric camera of a table, as lens vendors hand it out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from camtorch.camera import Camera
from camtorch.charts import EquidistantUpTo
from camtorch.lens import Lens, Planar
from camtorch.parameters import as_real
from camtorch.radial import RadiusTable

if TYPE_CHECKING:
    from typing_extensions import Self


class Tabulated(Camera):
    """A radially symmetric camera whose r(theta) is a table: (u, v) = f r (cos phi, sin phi) + c.

    theta = atan2(hypot(x, y), z), so that angles past 90 degrees are real. Between the nodes r is the monotone cubic
    spline of Fritsch and Butland (PCHIP), of the table and its mirror image through (0, 0), which is no node of its
    own. A ray is valid up to the last angle, and before r ceases to ascend.

    The camera has one continuous derivative on the axis and at the nodes, and no second one there.

    Distortion: theta1 ... thetaN r1 ... rN, N >= 2: the angles in radians, ascending, which stay as they are (their
    gradient is zero), and the radii in units of the focal length, which learn. Equidistant, up to 90 degrees, if left
    out. A table in millimetres comes in through `from_table`. Source: Fritsch and Butland, "A method for
    constructing local monotone piecewise cubic interpolants", SIAM J. Sci. Stat. Comput. 1984. See `Camera` for
    shapes, conventions and errors.
    """

    key = "tabulated"
    distortion_names = (*(f"theta{i}" for i in range(1, 7)), *(f"r{i}" for i in range(1, 7)))
    default_count = 12
    defined_text = "angles that ascend from above 0"

    @classmethod
    def names_of(cls, count):
        numbers = range(1, count // 2 + 1)
        even = count >= 4 and count % 2 == 0
        return (*(f"theta{i}" for i in numbers), *(f"r{i}" for i in numbers)) if even else None

    @classmethod
    def counts_text(cls):
        return "n = 4, 6, 8, ... (theta1 theta2 ... r1 r2 ...)"

    @classmethod
    def ideal(cls, count):
        angles = tuple(math.pi * i / count for i in range(1, count // 2 + 1))
        return angles + angles

    @staticmethod
    def defined(k):
        angles = torch.stack((torch.zeros_like(k[0]), *k[: len(k) // 2]), -1)
        return angles.diff(dim=-1).amin(-1)

    @staticmethod
    def optics(k):
        angles, radii = [w.detach() for w in k[: len(k) // 2]], k[len(k) // 2 :]
        return EquidistantUpTo(angles[-1]), Lens(Planar(RadiusTable(angles, radii)))

    @classmethod
    def from_table(cls, centre, angles, radii, *, pixels_per_unit: float = 1.0, image_size=None) -> Self:
        """From a table of angles and image heights, in any unit of length or in pixels.

        The focal length becomes the slope of the table at its beginning, so that r is nearly theta there.

        Args:
            centre: (2,) cx, cy, the pixel of the axis.
            angles: (N,) ascending, in radians; a first 0 is left out, and has the height 0.
            radii: (N,) the image heights.
            pixels_per_unit: of length in which the heights are given.
            image_size: (height, width) in pixels.

        Raises:
            ValueError: the table has another shape, or does not begin to ascend from the origin.
        """
        centre, angles, radii = (
            as_real(v, n, cls.__name__) for v, n in ((centre, "centre"), (angles, "angles"), (radii, "radii"))
        )
        if centre.shape != (2,) or angles.ndim != 1 or angles.shape != radii.shape:
            shapes = [tuple(t.shape) for t in (centre, angles, radii)]
            raise ValueError(f"{cls.__name__}: centre must be (2,), angles and radii (N,); got shapes {shapes}")
        if len(angles) and angles[0] == 0 == radii[0]:
            angles, radii = angles[1:], radii[1:]
        if len(angles) < 2 or not (angles[0] > 0 and radii[0] > 0):
            raise ValueError(
                f"{cls.__name__}: the table needs two nodes that ascend from the origin; got angles {angles.tolist()} "
                f"and radii {radii.tolist()}"
            )
        focal = radii[:1] / angles[:1]
        intrinsics = torch.cat((focal * pixels_per_unit, focal * pixels_per_unit, centre))
        return cls(intrinsics, torch.cat((angles, radii / focal)), image_size=image_size)
