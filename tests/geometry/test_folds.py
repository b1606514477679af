"""Where lenses fold, against the roots of their polynomials in 50 digits."""

import mpmath
import pytest
import torch
from cameras import slow_unless

import camtorch as ct
from camtorch import lenses

COUNT = 60


def odd(k):
    """d(x + k1 x^3 + k2 x^5 + ...)/dx, in x^2."""
    return [[1, *((2 * i + 3) * c for i, c in enumerate(k))]]


def rational(k):
    """The numerator of d(r N / D)/dr, and D, in r^2."""
    k1, k2, _, _, k3, *below = k
    n, d = [1, k1, k2, k3], [1, *below]
    products = [mpmath.mpf(0)] * 7
    for i, above in enumerate(n):
        for j, under in enumerate(d):
            products[i + j] += above * under * (1 + 2 * (i - j))
    return [products, d]


def all_powers(k):
    """d(x + k2 x^2 + k3 x^3 + ...)/dx, in x."""
    return [[1, *((i + 2) * c for i, c in enumerate(k))]]


def division(k):
    """The numerator of d(atan(r / D))/dr, in r^2."""
    return [[1, *(-(2 * i + 1) * c for i, c in enumerate(k))]]


# spreads of coefficients; the polynomials whose first root is the fold, or its square; how far the plane goes
MODELS = {
    "kannala_brandt": ("kannala_brandt", [0.1, 0.1, 0.05, 0.02], odd, True, torch.pi),
    "telephoto": ("kannala_brandt", [100, 1e4, 1e6, 1e8], odd, True, torch.pi),
    "nine": ("kannala_brandt", [0.1] * 9, odd, True, torch.pi),
    "equisolid": ("equisolid", [0.2, 0.1, 0.05], odd, True, 1.99),
    "brown_conrady": ("brown_conrady", [0.5, 0.5, 0, 0, 0.2], lambda k: odd([*k[:2], k[4]]), True, 1e9),
    "rational": ("brown_conrady", [3, 2, 0, 0, 1, 3, 2, 1], rational, True, 1e9),
    "f_theta": ("f_theta", [0.3, 0.2, 0.2, 0.1, 0.05], all_powers, False, torch.pi),
    "division": ("division", [0.5, 0.3, 0.2], division, True, 19.0),
    "f_theta_backward": ("f_theta_backward", [0.3, 0.2, 0.2], all_powers, False, 1.5),
}
FROM_PIXELS = ("division", "f_theta_backward")


def first_root(polynomial):
    while polynomial[-1] == 0:
        polynomial = polynomial[:-1]
    roots = mpmath.polyroots(polynomial[::-1], maxsteps=200, extraprec=100) if len(polynomial) > 1 else []
    return min(
        (r.real for r in roots if abs(r.imag) < mpmath.mpf(10) ** -30 * abs(r) and r.real > 0), default=mpmath.inf
    )


def folds_of(coefficients, polynomials, of_squares):
    with mpmath.workdps(50):
        folds = [min(map(first_root, polynomials([mpmath.mpf(c) for c in row]))) for row in coefficients.tolist()]
        return torch.tensor([float(mpmath.sqrt(f) if of_squares else f) for f in folds], dtype=torch.float64)


def valid_at(key, coefficients, radius):
    """Whether lenses (C, n) map what stands at a radius (C,) of the plane that their polynomial is of."""
    intrinsics = torch.tensor([300.0, 300.0, 0.0, 0.0], dtype=torch.float64).expand(len(coefficients), 4)
    camera = ct.MODELS[key](intrinsics, coefficients)
    zero = torch.zeros_like(radius)
    if key in FROM_PIXELS:
        return camera.unproject(torch.stack((300 * radius, zero), -1).unsqueeze(1))[1].squeeze(1)
    angle = {"brown_conrady": torch.atan, "equisolid": lambda r: 2 * torch.asin(r / 2)}.get(key, torch.positive)(radius)
    rays = (radius, zero, zero + 1) if key == "brown_conrady" else (torch.sin(angle), zero, torch.cos(angle))
    return camera.project(torch.stack(rays, -1).unsqueeze(1))[1].squeeze(1)


@pytest.mark.parametrize("name", slow_unless("kannala_brandt".__eq__, MODELS))
def test_a_lens_is_valid_up_to_the_first_root(name):
    key, spread, polynomials, of_squares, furthest = MODELS[name]
    draws = torch.randn(COUNT, len(spread), generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    coefficients = torch.tensor(spread, dtype=torch.float64) * draws
    folds = folds_of(coefficients, polynomials, of_squares)
    some = folds < furthest
    assert 20 < some.sum() < COUNT
    # of models from the pixel to the angle the angle is certain to rounding, and the radius to its root
    before = 1e-6 if key in FROM_PIXELS else 1e-12
    assert valid_at(key, coefficients, torch.where(some, folds, 1.0) * (1 - before))[some].all()
    assert not valid_at(key, coefficients, torch.where(some, folds, 1.0) * (1 + 1e-12))[some].any()


@pytest.mark.slow
def test_real_lenses_are_valid_up_to_the_first_root():
    real = [lens for lens in lenses.search("") if min(lens.intrinsics[:2]) > 0][::40]
    assert len(real) > 200
    coefficients = torch.tensor([lens.distortion for lens in real], dtype=torch.float64)
    folds = folds_of(coefficients, odd, True)
    some = folds < torch.pi
    assert valid_at("kannala_brandt", coefficients, folds.clamp(max=3.1) * (1 - 1e-12)).all()
    assert not valid_at("kannala_brandt", coefficients[some], folds[some] * (1 + 1e-12)).any()
