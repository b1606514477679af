"""The CAHVOR camera: radial distortion about an axis of its own, which need not be that of the image."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from camtorch.camera import Camera
from camtorch.optics import Before, Chart, Homography, Lens, Perspective, Planar, Polynomial, Rotation


def about(chart: Chart, k: Sequence[Tensor]) -> tuple[Chart, Lens]:
    """A chart about the axis of angles alpha, beta, of which r0, r1, r2 scale the points, and the way back."""
    alpha, beta, r0, r1, r2 = k
    ca, sa, cb, sb = torch.cos(alpha), torch.sin(alpha), torch.cos(beta), torch.sin(beta)
    across = ca, torch.zeros_like(ca), -sa
    down = -sa * sb, cb, -ca * sb
    axis = sa * cb, sb, ca * cb
    scale = 1 + r0
    columns = [w * scale for w in across], [w * scale for w in down], axis
    back = Homography(*(column[i] for i in range(3) for column in columns))
    return Before(Rotation(*across, *down, *axis), chart), Lens(Planar(Polynomial((r1 / scale, r2 / scale))), back)


class CAHVOR(Camera):
    """The CAHVOR camera of JPL: a perspective camera with radial distortion about an axis o of its own.

    o = (sin alpha cos beta, sin beta, cos alpha cos beta). Of a point p with w = p . o and tau = |p|^2 / w^2 - 1, the
    squared tangent of its angle from o, and mu = r0 + r1 tau + r2 tau^2, the point p + mu (p - w o) is seen by a
    pinhole camera. A ray is valid if that is in front of it, and before the first fold of the distortion.

    Distortion: alpha, beta in radians, r0, r1, r2. The same as mrcal's LENSMODEL_CAHVOR. Source: Gennery, "Generalized
    camera calibration including fish-eye lenses", IJCV 2006, and mrcal's documentation. See `Camera` for shapes,
    conventions and errors.
    """

    key = "cahvor"
    distortion_names: tuple[str, ...] = ("alpha", "beta", "r0", "r1", "r2")
    default_count = 5
    odd_in_x = frozenset({"alpha"})
    odd_in_y = frozenset({"beta"})
    quarter_turn = None
    special_cases: ClassVar[tuple[tuple[str, tuple[str, ...]], ...]] = (("pinhole", ()),)
    # without distortion no axis is better than another, and a search does not begin
    fit_starts: ClassVar[tuple[Mapping[str, float], ...]] = ({"r1": -0.1}, {"r1": 0.1})
    # beside the focal lengths it would be known by higher powers alone
    fit_bounds: ClassVar[dict[str, tuple[float, float] | None]] = {"r0": None}
    defined_text = "alpha, beta within pi / 2, r0 > -1"

    @staticmethod
    def defined(k: Sequence[Tensor]) -> Tensor | None:
        return torch.minimum(math.pi / 2 - torch.maximum(k[0].abs(), k[1].abs()), 1 + k[2])

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return about(Perspective(), k)
