"""The cameras that the laws are tried on: real calibrations, and ranges to draw others from.

A model is tested by being in `ct.MODELS`. Its real calibrations are the mpmath files of its family; what else
helps to try it hard is its entry in RANGES. A model that has neither is tried with its default coefficients.
"""

import json
import math
import re
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from hypothesis import strategies as st

import camtorch as ct
from camtorch.native.library import native_available

GOLDEN = {path.stem: json.loads(path.read_text()) for path in sorted((Path(__file__).parent / "golden").glob("*.json"))}
_FILES = [path for path in sorted(Path(ct.__file__).parent.glob("models/*.py")) if not path.name.startswith("_")]
STATED = {path: re.findall(r'^    key = "(\w+)"', path.read_text(), re.M) for path in _FILES}
"""The keys that each file of a model states. A key of one list alone fails one test, tests/package/test_complete.py."""
KEYS = sorted({key for keys in STATED.values() for key in keys} & set(ct.MODELS))

# One model of each kind of chart and lens: the others are put together from the same parts
DISTINCT = {"pinhole", "kannala_brandt", "fisheye624", "cylindrical", "double_sphere", "division", "f_theta_backward"}
# Those, what most people have, and those with a part of their own
USUAL = DISTINCT | {"brown_conrady", "fisheye62", "fov", "equisolid", "tabulated"}


@contextmanager
def default_dtype_of_double():
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


def slow_unless(quick, cases):
    """The cases of a dear test, as pytest takes them: those that are not `quick(case)` are marked slow."""
    marked = [(case if isinstance(case, tuple) else (case,), () if quick(case) else pytest.mark.slow) for case in cases]
    return [pytest.param(*values, marks=marks) for values, marks in marked]


needs_library = pytest.mark.skipif(not native_available(), reason="the library is not compiled here, or turned off")
RARE_ARE_SLOW = slow_unless(DISTINCT.__contains__, KEYS)
every_model = pytest.mark.parametrize("key", KEYS)
# for what has nothing to do with the model, and might with the kinds of chart and lens
each_kind = pytest.mark.parametrize("key", sorted(DISTINCT))

# Coefficients drawn, plausible and wild, by the first letters of their names: up to that size, or between two numbers
RANGES = {
    "splined": {"x": (0.01, 0.1), "y": (0.01, 0.1)},
    "fov": {"omega": ((0.2, 1.2), (-3.0, 3.0))},
    "division": {"lambda": ((-0.4, 0.2), (-3.0, 3.0))},
    "equisolid": {"k": (0.05, 0.5)},
    "stereographic": {"k": (0.02, 0.3)},
    "orthographic_fisheye": {"k": (0.05, 0.5)},
    "thin_prism_fisheye": {"k": (0.05, 0.5), "p": (2e-3, 0.05), "s": (2e-3, 0.05)},
    "ocamcalib": {"d": (0.01, 0.3), "e": (0.01, 0.3), "a": (0.1, 0.5)},
    # steps from one node to the next
    "tabulated": {"theta": ((0.2, 0.4), (0.2, 0.8)), "r": ((0.15, 0.4), (-0.1, 1.0))},
    "f_theta": {"k": (0.1, 0.5)},
    "f_theta_backward": {"k": (0.1, 0.5)},
    "woodscape": {"k": (0.1, 0.5)},
    "f_theta_sheared": {"d": (0.01, 0.3), "e": (0.01, 0.3), "k": (0.1, 0.5)},
    "f_theta_backward_sheared": {"d": (0.01, 0.3), "e": (0.01, 0.3), "k": (0.1, 0.5)},
    "ucm": {"alpha": ((0.0, 1.0), (-1.0, 1.5))},
    "eucm": {"alpha": ((0.0, 1.0), (-1.0, 1.5)), "beta": ((0.5, 1.5), (0.01, 20.0))},
    "double_sphere": {"alpha": ((0.0, 1.0), (-0.5, 1.5)), "xi": ((-0.3, 0.6), (-0.9, 3.0))},
    "mei": {"xi": ((0.0, 2.0), (-0.9, 4.0)), "k": (0.3, 1.0), "p": (2e-3, 0.05)},
    "brown_conrady": {"k": (0.3, 1.0), "p": (2e-3, 0.05), "s": (2e-3, 0.05), "tau": (0.05, 0.3)},
    "kannala_brandt": {"k": (0.05, 0.5)},
    "fisheye62": {"k": (0.05, 0.5), "p": (2e-3, 0.05)},
    "fisheye624": {"k": (0.05, 0.5), "p": (2e-3, 0.05), "s": (2e-3, 0.05)},
}

_OCAM, _NCORE, _PIXEL = 206.517, 3139.4858, 5.3808565e-4
# Real calibrations of models that no reference file is of: intrinsics, distortion, image size
CALIBRATIONS = {
    # WoodScape, as its polynomial in pixels: 339.749, -31.988, 48.275, -7.201, and an offset of (3.942, -3.093)
    "woodscape": ((339.749, 339.749, 643.442, 479.407), [w / 339.749 for w in (-31.988, 48.275, -7.201)], (966, 1280)),
    # a result of the toolbox, printed in the README of omni_cam: ss is -206.517, 0, 2.207161e-3, -4.879622e-6,
    # 1.865656e-8, the centre is row 241.800066 and column 394.552874, and c, d, e are 1.00033, 0.000219, 0.000257
    "ocamcalib": (
        (_OCAM, _OCAM * 1.00033, 394.552874, 241.800066),
        (2.19e-4 / 1.00033, 2.57e-4, 0, -2.207161e-3 * _OCAM, 4.879622e-6 * _OCAM**2, -1.865656e-8 * _OCAM**3),
        (480, 752),
    ),
    # cameras in the tests of nvidia-ncore, one by its angles and one by its pixels, whose polynomials are in pixels
    "f_theta_sheared": (
        (_NCORE * 1.000084, _NCORE, 1909.3092, 1103.2788),
        (-7.3e-5, -2.8e-5 / 1.000084, *(w / _NCORE for w in (164.57259, -442.12897, 259.58273, 153.66644))),
        (2168, 3848),
    ),
    "f_theta_backward_sheared": (
        (1.1 / _PIXEL, 1 / _PIXEL, 1904.9485, 1090.5165),
        (0.02, -0.01 / 1.1, -1.2021252e-9 / _PIXEL**2, 4.5657002e-12 / _PIXEL**3, -5.5811181e-16 / _PIXEL**4),
        (2168, 3848),
    ),
    # KITTI-360, calibration/image_02.yaml
    "mei": (
        (1336.3220825849971, 1335.7883350012958, 716.94323510126321, 705.76498308221585),
        (2.2134047507854890, 1.6798235660113681e-2, 1.6548773243373522, 4.2223943394772046e-4, 4.2462134260997584e-4),
        (1400, 1400),
    ),
}


# Cameras with one continuous derivative on the axis, and no second one
NOT_ANALYTIC = {"ocamcalib", "woodscape", *(key for key in KEYS if key.startswith("f_theta"))}


def constants(camera):
    """How many coefficients, the first ones, do not learn."""
    return camera.distortion.shape[-1] // 2 if camera.key == "tabulated" else 0


def axis_slope(key, k):
    """d(r)/d(theta) on the axis."""
    if key == "tabulated":
        return k[len(k) // 2] / k[0]
    slopes = {
        "double_sphere": lambda xi, _: 1 / (1 + xi),
        "mei": lambda xi, *_: 1 / (1 + xi),
        "fov": lambda omega: 2 * math.tan(omega / 2) / omega if omega else 1.0,
    }
    return slopes[key](*k) if key in slopes else 1.0


def tensor(values) -> torch.Tensor:
    """Float64 of numbers with nulls, which become NaN."""

    def filled(value, width):
        if isinstance(value, list):
            return [filled(v, width[1:]) for v in value]
        if value is None and width:
            return [filled(None, width[1:])] * width[0]
        return math.nan if value is None else value

    def shape(value):
        lengths = [shape(v) for v in value if v is not None] if isinstance(value, list) else []
        return (len(value), *max(lengths, key=len, default=())) if isinstance(value, list) else ()

    return torch.tensor(filled(values, shape(values)), dtype=torch.float64)


class Unproject(torch.nn.Module):
    """A camera whose call is the other direction."""

    def __init__(self, camera):
        super().__init__()
        self.camera = camera

    def forward(self, pixels):
        return self.camera.unproject(pixels)


def make(key, intrinsics, distortion=None, **options):
    """A camera of any model, also of those that take no distortion."""
    has_some = distortion is not None and distortion.shape[-1] > 0
    arguments = (distortion,) if has_some else ()
    return ct.MODELS[key](intrinsics, *arguments, **options)


def golden_camera(case):
    """The camera of a file; a brown_conrady vector loses no coefficient, be it zero."""
    parameters = tensor(case["parameters"])
    size = tuple(case["image_size"])
    if case["family"] == "kannala_brandt_general":
        return ct.KannalaBrandt.from_general(parameters[:4], parameters[4:], image_size=size)
    return make(case["family"], parameters[:4], parameters[4:], image_size=size)


def real(key) -> dict:
    """Name -> camera, float64: the real calibrations of a model, or the one with its default coefficients."""
    cases = {name: case for name, case in GOLDEN.items() if name.startswith("mpmath") and case["family"] == key}
    named = {name: golden_camera(case) for name, case in cases.items()}
    if key in CALIBRATIONS:
        intrinsics, distortion, size = CALIBRATIONS[key]
        return {"published": make(key, tensor([*intrinsics]), tensor([*distortion]), image_size=size)}
    default = make(key, torch.tensor([300.0, 310.0, 318.5, 242.25], dtype=torch.float64), image_size=(480, 640))
    return named or {"default": default}


def one(key):
    """One real calibration, the one with the most going on."""
    return list(real(key).values())[-1]


SIZE = (48, 64)


def fisheye(size=SIZE, focal=0.375, dtype=torch.float32):
    """A fixed camera, its principal point a little beside the middle; `focal` is in widths of the image."""
    height, width = size
    numbers = [focal * width, 1.02 * focal * width, width / 2 - 1, height / 2 - 1], [0.02, -0.01, 0.004, -0.001]
    return ct.KannalaBrandt(*(torch.tensor(n, dtype=dtype) for n in numbers), image_size=size).requires_grad_(False)


def pinhole(size=SIZE, focal=30.0, dtype=torch.float32):
    """A fixed camera, its principal point in the middle; `focal` is in pixels."""
    numbers = torch.tensor([focal, focal, (size[1] - 1) / 2, (size[0] - 1) / 2], dtype=dtype)
    return ct.Pinhole(numbers, image_size=size).requires_grad_(False)


def turn(yaw=0.0, pitch=0.0, roll=0.0, dtype=torch.float32):
    return ct.augment.mount_rotation(*torch.tensor([yaw, pitch, roll], dtype=dtype))


# Every model with some of the others: all pairs would be too many
PAIRS = [(key, KEYS[(i + step) % len(KEYS)]) for i, key in enumerate(KEYS) for step in (1, 0, 6)]
REAL = [(key, name) for key in KEYS for name in real(key)]
# For dear tests: the first calibration of each kind
FEW_REAL = slow_unless(lambda case: case[0] in DISTINCT and case[1] == next(iter(real(case[0]))), REAL)


def spread(key, dtype=torch.float64):
    """A camera with every coefficient away from zero, so that no term of the formula can be forgotten."""
    names = one(key).distortion_names
    sign = torch.tensor([1.0, -1.0]).repeat(len(names))[: len(names)]
    limits = torch.tensor([limits_of(key, name, wild=False) for name in names]).view(-1, 2)
    middle, half = limits.mean(-1), (limits[:, 1] - limits[:, 0]) / 2
    distortion = nodes_of_steps(key, middle + 0.3 * sign * half)
    slope = axis_slope(key, distortion.tolist())
    intrinsics = torch.tensor([301.0 / slope, 310.5 / slope, 318.25, 243.5], dtype=dtype)
    return make(key, intrinsics, distortion.to(dtype), image_size=(480, 640))


def limits_of(key, name, wild):
    ranges = RANGES.get(key, {})
    letters = max((letters for letters in ranges if name.startswith(letters)), key=len, default=None)
    limits = ranges[letters][wild] if letters else 0.0
    return limits if isinstance(limits, tuple) else (-limits, limits)


def nodes_of_steps(key, numbers):
    """The nodes of steps; a table begins to ascend."""
    if key != "tabulated":
        return numbers
    angles, radii = numbers.chunk(2)
    first = radii[:1].abs().clamp(min=0.05)
    return torch.cat((angles.cumsum(0), torch.cat((first, radii[1:])).cumsum(0)))


@st.composite
def drawn(draw, key, wild):
    """A random camera of about 640 x 480, plausible or wild, with any number of coefficients that the model takes."""

    def number(low, high):
        return draw(st.floats(low, high, allow_subnormal=False))

    model = ct.MODELS[key]
    counts = [n for n in range(1, 15) if RANGES.get(key) and model.names_of(n)]
    names = model.names_of(draw(st.sampled_from(counts))) if counts else ()
    focal, aspect, across, down = number(150, 600), number(0.9, 1.1), number(-20, 20), number(-20, 20)
    distortion = [number(*limits_of(key, name, wild)) for name in names]
    if RANGES.get(key) and not counts:  # too many to be drawn one by one
        generator = torch.Generator().manual_seed(draw(st.integers(0, 1 << 20)))
        limits = torch.tensor([limits_of(key, name, wild) for name in model.distortion_names], dtype=torch.float64)
        share = torch.rand(len(limits), generator=generator, dtype=torch.float64)
        distortion = (limits[:, 0] + share * limits.diff()[:, 0]).tolist()
    distortion = nodes_of_steps(key, torch.tensor(distortion, dtype=torch.float64)).tolist()
    focal /= axis_slope(key, distortion)
    intrinsics = [focal, focal * aspect, 320 + across, 240 + down]
    intrinsics, distortion = (torch.tensor(v, dtype=torch.float64) for v in (intrinsics, distortion))
    return make(key, intrinsics, distortion, image_size=(480, 640))


def fan(end_degrees, angles=45, azimuths=24) -> torch.Tensor:
    """(angles * azimuths, 3): rays from the axis outwards, on even azimuths, none of them a coordinate axis."""
    theta = torch.linspace(0, math.radians(end_degrees), angles, dtype=torch.float64)
    phi = torch.linspace(0, 2 * math.pi, azimuths + 1, dtype=torch.float64)[:-1] + 0.1
    theta, phi = (plane.flatten() for plane in torch.meshgrid(theta, phi, indexing="ij"))
    return torch.stack((theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()), -1)


def pixel_lattice(camera, rows=25, columns=33) -> torch.Tensor:
    """(rows * columns, 2): pixels over the whole image, its corners included."""
    sides = zip(camera.image_size, (rows, columns), strict=True)
    v, u = (torch.linspace(0, side - 1, count, dtype=camera.intrinsics.dtype) for side, count in sides)
    return torch.cartesian_prod(v, u).flip(-1)
