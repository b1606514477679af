"""COLMAP's camera models as what they are: ours, with some coefficients tied or zero.

Written apart from what reads COLMAP's files, and without its half pixel, to try the models on COLMAP's numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

# COLMAP's name: the key of ours, COLMAP's parameters, and what our distortion is of them. f stands for fx and fy
_MODELS = {
    "SIMPLE_PINHOLE": ("pinhole", "f cx cy", ""),
    "PINHOLE": ("pinhole", "fx fy cx cy", ""),
    "SIMPLE_RADIAL": ("brown_conrady", "f cx cy k", "k 0 0 0"),
    "RADIAL": ("brown_conrady", "f cx cy k1 k2", "k1 k2 0 0"),
    "OPENCV": ("brown_conrady", "fx fy cx cy k1 k2 p1 p2", "k1 k2 p1 p2"),
    "FULL_OPENCV": ("brown_conrady", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_FISHEYE": ("kannala_brandt", "f cx cy", "0"),
    "FISHEYE": ("kannala_brandt", "fx fy cx cy", "0"),
    "SIMPLE_RADIAL_FISHEYE": ("kannala_brandt", "f cx cy k", "k"),
    "RADIAL_FISHEYE": ("kannala_brandt", "f cx cy k1 k2", "k1 k2"),
    "OPENCV_FISHEYE": ("kannala_brandt", "fx fy cx cy k1 k2 k3 k4", "k1 k2 k3 k4"),
    "FOV": ("fov", "fx fy cx cy omega", "omega"),
    "THIN_PRISM_FISHEYE": ("thin_prism_fisheye", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1", "k1 k2 p1 p2 k3 k4 sx1 sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        "fisheye624",
        "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
        "k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
    ),
    "SIMPLE_DIVISION": ("division", "f cx cy k", "k"),
    "DIVISION": ("division", "fx fy cx cy k", "k"),
    "EUCM": ("eucm", "fx fy cx cy alpha beta", "alpha beta"),
    "EQUIRECTANGULAR": ("equirectangular", "w h", ""),
}


def from_colmap(name: str, parameters: Sequence[float]) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
    """The key in `ct.MODELS`, intrinsics and distortion of a COLMAP camera, pixel centres at 0.5.

    Raises:
        KeyError: an unknown model. ValueError: not as many parameters as it has.
    """
    key, names, distortion = _MODELS[name]
    if len(parameters) != len(names.split()):
        raise ValueError(f"{name} has the parameters {names}; got {len(parameters)} numbers")
    given = dict(zip(names.split(), parameters, strict=True))
    if key == "equirectangular":
        width, height = parameters
        return key, (width / (2 * math.pi), height / math.pi, width / 2, height / 2), ()
    focal = given.get("fx", given.get("f")), given.get("fy", given.get("f"))
    return key, (*focal, given["cx"], given["cy"]), tuple(given.get(k, 0.0) for k in distortion.split())
