"""The Brown-Conrady camera, OpenCV's: a pinhole with radial, tangential, thin-prism and tilt distortion."""

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import ClassVar

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Lens, Perspective, Planar, Polynomial, Rational, Tilt


class BrownConrady(Camera):
    """OpenCV's pinhole camera with distortion; valid up to its fold.

    With a = x/z, b = y/z and t = a^2 + b^2:

        R  = (1 + k1 t + k2 t^2 + k3 t^3) / (1 + k4 t + k5 t^2 + k6 t^3)
        a' = a R + 2 p1 a b + p2 (t + 2 a^2) + s1 t + s2 t^2
        b' = b R + p1 (t + 2 b^2) + 2 p2 a b + s3 t + s4 t^2

    then the homography of a sensor tilted by (tau_x, tau_y) radians. A ray is valid for z > 0, before the pole of R and
    before the fold of the map; the fold depends on the azimuth if p, s or tau are not zero.

    Distortion: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]: 4, 5, 8, 12 or 14 coefficients; 5 by default.
    COLMAP OPENCV (4) and FULL_OPENCV (8). Source: OpenCV, `projectPoints`. See `Camera` for conventions and errors.

    Example:
        >>> ct.BrownConrady([300.0, 300.0, 319.5, 239.5], [-0.25, 0.0, 0.0, 0.0]).project([0.5, 0.0, 1.0])[0].tolist()
        [460.125, 239.5]
    """

    key = "brown_conrady"
    distortion_names: tuple[str, ...] = (
        *("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
        *("s1", "s2", "s3", "s4", "tau_x", "tau_y"),
    )
    default_count = 5
    counts: ClassVar[tuple[int, ...]] = (4, 5, 8, 12, 14)
    special_cases = (("pinhole", ()),)
    fit_counts = (5, 8)
    odd_in_x = frozenset({"p2", "s1", "s2", "tau_y"})
    odd_in_y = frozenset({"p1", "s3", "s4", "tau_x"})
    quarter_turn = MappingProxyType(
        {
            **{"p1": "p2", "p2": "-p1", "tau_x": "-tau_y", "tau_y": "tau_x"},
            **{"s1": "-s3", "s2": "-s4", "s3": "s1", "s4": "s2"},
        }
    )

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        return cls.distortion_names[:count] if count in cls.counts else None

    @classmethod
    def counts_text(cls) -> str:
        return "n = 4, 5, 8, 12 or 14 (k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]])"

    @classmethod
    def fit_start(cls, names: tuple[str, ...], angles: Tensor, radii: Tensor) -> Tensor:
        zeros = super().fit_start(names, angles, radii)
        if "k6" not in names:
            return zeros
        # N - R D = 0 is linear in the coefficients; the first weights are those of a D that follows the tangent
        ahead = angles < math.radians(85)
        tangent = torch.tan(torch.where(ahead, angles, 0.1))
        t, ratio = tangent**2, radii / tangent
        powers = torch.stack((t, t**2, t**3), -1)
        terms = torch.cat((powers, -ratio[..., None] * powers), -1)
        denominator = 1 + t
        for _ in range(3):
            weight = ahead * tangent / denominator
            scale = (terms * weight[..., None]).square().sum(-2, keepdim=True).sqrt().clamp(min=1e-30)
            q, r = torch.linalg.qr(terms * weight[..., None] / scale)
            damped = r + 1e-10 * torch.eye(6, dtype=r.dtype, device=r.device)
            right = q.mT @ ((ratio - 1) * weight)[..., None]
            k = (torch.linalg.solve_triangular(damped, right, upper=True) / scale.mT)[..., 0]
            denominator = (1 + (powers * k[:, None, 3:]).sum(-1)).clamp(min=1e-3)
        start = zeros.clone()
        for i, name in enumerate(("k1", "k2", "k3", "k4", "k5", "k6")):
            start[..., names.index(name)] = k[:, i].nan_to_num(0.0, 0.0, 0.0)
        return torch.cat((zeros, start))

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        k1, k2, p1, p2, *more = k
        numerator = [k1, k2, *more[:1]]
        radial = Rational(numerator, more[1:4]) if len(more) > 1 else Polynomial(numerator)
        # OpenCV numbers the decentering coefficients the other way round: p2 is the one along x
        stages: list[Planar | Tilt] = [Planar(radial, tangential=(p2, p1), prism=more[4:8])]
        if len(more) > 8:
            stages.append(Tilt(*more[8:]))
        return Perspective(), Lens(*stages)
