"""Where lenses fold, against the roots of their polynomials in 50 digits."""

import mpmath
import pytest
import torch
from cameras import DISTINCT, KEYS, axis_slope, fan, limits_of, make, nodes_of_steps, one, pixel_lattice, slow_unless

import camtorch as ct
from camtorch.optics import Equidistant, Lens, Planar, Polynomial, Tilt
from camtorch.values.arguments import columns

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
    least = mpmath.mpf(10) ** -30
    return min((r.real for r in roots if abs(r.imag) < least * abs(r) and r.real > 0), default=mpmath.inf)


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


LENSES = [key for key in KEYS if one(key).distortion_names]
STAGES = [key for key in LENSES if type(one(key)).optics(columns(one(key).distortion[None]))[1].stages]


class Leaning(ct.KannalaBrandt):
    """A radial lens before a sensor that is tilted."""

    distortion_names = ("k1", "k2", "tau_x", "tau_y")

    @staticmethod
    def optics(k):
        return Equidistant(), Lens(Planar(Polynomial(k[:2])), Tilt(*k[2:]))


def batch_of(key, size, count=12):
    """A batch of lenses: 'mild', as real ones are, or up to the 'plausible' or the 'wild' limits of the laws."""
    generator = torch.Generator().manual_seed(count)
    names = one(key).distortion_names
    limits = torch.tensor([limits_of(key, name, size == "wild") for name in names], dtype=torch.float64).view(-1, 2)
    share = torch.rand(count, len(names), generator=generator, dtype=torch.float64)
    distortion = limits[:, 0] + (limits[:, 1] - limits[:, 0]) * share
    if size == "mild":
        lopsided = torch.tensor([name in one(key).odd_in_x | one(key).odd_in_y for name in names])
        distortion = torch.where(lopsided, distortion / 4, distortion)
    distortion = torch.stack([nodes_of_steps(key, row) for row in distortion])
    slopes = torch.tensor([axis_slope(key, row.tolist()) for row in distortion], dtype=torch.float64)
    focal = torch.linspace(150, 400, count, dtype=torch.float64) / slopes
    intrinsics = torch.stack((focal, focal * 1.05, *(torch.full_like(focal, c) for c in (322.0, 236.0))), -1)
    return make(key, intrinsics, distortion, image_size=(480, 640)).requires_grad_(False)


def check(camera):
    """What a ray is seen at has a ray, up to the rim of each lens; what has one beyond that returns to its pixel."""
    rays = fan(179, 400, 16)
    seen, valid = (w.unflatten(1, (400, 16)) for w in camera.project(rays.expand(len(camera), -1, -1)))
    centre = camera.intrinsics[:, None, None, 2:]
    before = valid.long().cumprod(1).bool()
    # the last ray may be within rounding of the fold; five images away it moves the pixel of a prism far
    clear = before & torch.cat((before[:, 1:], before[:, -1:]), 1) & ((seen - centre).norm(dim=-1) < 5 * 640)
    assert clear.double().mean() > 0.05
    again, found = camera.unproject(seen.flatten(1, 2))
    assert found.unflatten(1, (400, 16))[clear].all(), seen[clear & ~found.unflatten(1, (400, 16))][:3].tolist()
    # the image and far around it, and close to the rim of what each lens shows, on both sides
    last = (before.sum(1, keepdim=True) - 1).clamp(min=0)
    rim = seen.gather(1, last.unsqueeze(-1).expand(-1, -1, -1, 2))[:, 0] - centre[:, 0]
    far = torch.tensor([[1e4, 100], [-1e7, 3e6], [320, -1e12]], dtype=torch.float64)
    wide = torch.cat(((pixel_lattice(camera, 21, 29) - 320) * 1.7 + 320, far)).expand(len(camera), -1, -1)
    pixels = torch.cat((wide, *(centre[:, 0] + rim * f for f in (0.99, 0.9999, 1.0001, 1.003, 1.02))), 1)
    rays, valid = camera.unproject(pixels)
    again, reachable = camera.project(rays)
    # next to a pole, so far from the image, rounding decides
    valid &= pixels.abs().amax(-1) < 1e12
    assert reachable[valid].all()
    size = (pixels - camera.intrinsics[:, None, 2:]).norm(dim=-1)
    assert ((again - pixels).norm(dim=-1) <= 1e-9 * (1 + size))[valid].all()


@pytest.mark.parametrize(
    ("key", "size"),
    slow_unless(
        lambda case: case[0] in DISTINCT and case[1] != "wild",
        [(k, size) for k in STAGES for size in ("mild", "plausible", "wild") if k in DISTINCT or size == "plausible"],
    ),
)
def test_what_is_seen_has_a_ray_up_to_the_rim(key, size):
    check(batch_of(key, size))


def test_a_tilted_sensor_behind_a_radial_lens():
    intrinsics = torch.tensor([[210.0, 212.0, 322.0, 236.0]], dtype=torch.float64)
    distortion = torch.tensor([[-0.1, -0.02, 0.02, -0.03]], dtype=torch.float64)
    check(Leaning(intrinsics, distortion, image_size=(480, 640)).requires_grad_(False))


@pytest.mark.parametrize("key", LENSES)
def test_what_inference_mode_tabulates_serves_a_graph_later(key):
    camera = one(key).requires_grad_(False)
    rays, pixels = fan(60, 6, 6), pixel_lattice(camera, 5, 5)
    with torch.inference_mode():
        camera.project(rays)
        camera.unproject(pixels * 1.5 - 50)
    for method, values in ((camera.project, rays), (camera.unproject, pixels * 1.5 - 50)):
        values = values.clone().requires_grad_()
        (first,) = torch.autograd.grad(method(values)[0].square().sum(), values, create_graph=True)
        (second,) = torch.autograd.grad(first.square().sum(), values)
        assert torch.isfinite(second).all()
