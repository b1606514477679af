"""The central CAHVORE camera: CAHVOR for wide angles."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

from torch import Tensor

from camtorch.models.cahvor import CAHVOR, about
from camtorch.optics import Chart, Lens, Linearity


class CAHVORE(CAHVOR):
    """The CAHVORE camera of JPL whose rays pass one point: e = 0.

    o is an axis as of `CAHVOR`, theta the angle of a ray from it, and chi = tan(L theta) / L, theta or sin(L theta) / L
    where the linearity L is above, at or below 0. With the unit vector n across o towards the ray and
    mu = r0 + r1 chi^2 + r2 chi^4 the point o + (1 + mu) chi n is seen by a pinhole camera. A ray is valid if that is in
    front of it, for |L| theta < pi / 2, and before the first fold of the distortion.

    Distortion: alpha, beta in radians, r0, r1, r2, linearity. L = 1 is `CAHVOR`. At L = 0 the derivative by L is 0, and
    there is no second one. The same as mrcal's LENSMODEL_CAHVORE_linearity=... with e0 = e1 = e2 = 0; with others each
    angle has a centre of projection of its own, which no camera here has. Source: see `CAHVOR`. See `Camera` for
    shapes, conventions and errors.
    """

    key = "cahvore"
    distortion_names: tuple[str, ...] = (*CAHVOR.distortion_names, "linearity")
    default_count = 6
    special_cases = (("cahvor", CAHVOR.distortion_names),)
    # its derivative vanishes at zero
    fit_starts = tuple(MappingProxyType({"linearity": linearity}) for linearity in (0.9, 0.4, -0.4))

    @classmethod
    def ideal(cls, count: int) -> tuple[float, ...]:
        return (*(0.0,) * (count - 1), 1.0)

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return about(Linearity(k[5]), k[:5])
