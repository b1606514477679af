"""Tables against a spline of their own: another derivation, in float64, and a bisection for each point."""

import math

import numpy as np
import pytest
import torch

import camtorch as ct

CENTRE = (511.5, 511.5)


class Reference:
    """The spline of a table, from its second derivatives at the nodes, with Hyman's filter."""

    def __init__(self, angles, radii):
        nodes, values = np.concatenate(([0], angles)), np.concatenate(([0], radii))
        steps, secants = np.diff(nodes), np.diff(values) / np.diff(nodes)
        matrix, right = np.eye(len(nodes)), np.zeros(len(nodes))
        for i in range(1, len(steps)):
            matrix[i, i - 1 : i + 2] = steps[i - 1] / 6, (steps[i - 1] + steps[i]) / 3, steps[i] / 6
            right[i] = secants[i] - secants[i - 1]
        # the last two pieces have one third derivative
        matrix[-1, -3:] = -1 / steps[-2], 1 / steps[-2] + 1 / steps[-1], -1 / steps[-1]
        bends = np.linalg.solve(matrix, right)
        slopes = np.append(secants - steps * (2 * bends[:-1] + bends[1:]) / 6, 0)
        slopes[-1] = secants[-1] + steps[-1] * (bends[-2] + 2 * bends[-1]) / 6
        for i in range(len(nodes)):
            beside = secants[max(i - 1, 0) : i + 1]
            least = np.abs(beside).min()
            ascends = np.clip(slopes[i] * np.sign(beside[0]), 0.25 * least, 2.5 * least) * np.sign(beside[0])
            slopes[i] = ascends if len(beside) < 2 or beside[0] * beside[1] > 0 else 0
        self.nodes, self.values, self.steps, self.slopes = nodes, values, steps, slopes
        falls = np.flatnonzero(secants <= 0)
        self.end = nodes[falls[0]] if len(falls) else nodes[-1]

    def radius(self, theta):
        i = np.clip(np.searchsorted(self.nodes, theta, side="right") - 1, 0, len(self.steps) - 1)
        h, s = self.steps[i], (theta - self.nodes[i]) / self.steps[i]
        near = (1 + 2 * s) * self.values[i] + s * h * self.slopes[i]
        far = (3 - 2 * s) * self.values[i + 1] - (1 - s) * h * self.slopes[i + 1]
        return (1 - s) ** 2 * near + s**2 * far

    def angle(self, r):
        low, high = np.zeros_like(r), np.full_like(r, self.end)
        for _ in range(80):
            middle = (low + high) / 2
            below = self.radius(middle) < r
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return high


def data_sheet():
    angles = np.radians(np.arange(0.5, 100.25, 0.5))
    return angles, np.round(3 * (angles - 0.02 * angles**3 + 0.003 * angles**5), 3)


def drawn(seed, most=60, ratio=29.0):
    source = np.random.default_rng(seed)
    angles = np.cumsum(source.uniform(0.05, 1, source.integers(3, most)))
    angles *= source.uniform(0.2, 1.8) / angles[-1]
    slopes = np.exp(source.uniform(0, math.log(ratio), len(angles)))
    return angles, np.cumsum(slopes * np.diff(angles, prepend=0)) / slopes[0]


def both(table, dtype, image_height=500.0):
    """The camera of a table, and the reference of what it holds."""
    angles, radii = (torch.tensor(w, dtype=dtype) for w in table)
    scale = image_height / float(radii[-1])
    centre = torch.tensor(CENTRE, dtype=dtype)
    made = ct.Tabulated.from_table(centre, angles, radii, pixels_per_unit=scale, image_size=(1024, 1024))
    made.requires_grad_(False)
    return made, Reference(*made.distortion.double().numpy().reshape(2, -1))


TABLES = {"data sheet": data_sheet(), "turns back": (np.linspace(0.2, 1.4, 7), np.array([2, 4, 6, 8, 7, 6, 5.0]))}
TABLES |= {f"drawn {seed}": drawn(seed) for seed in range(6)} | {
    "fine": drawn(7, most=400, ratio=10.0),
    "long": drawn(101, most=300),
}


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_directions_are_those_of_the_reference(name, dtype):
    made, reference = both(TABLES[name], dtype)
    eps = torch.finfo(dtype).eps
    theta = torch.linspace(1e-3, float(reference.end) * (1 - 1e-5), 4001, dtype=dtype)
    rays = torch.stack((theta.sin() * 0.6, theta.sin() * 0.8, theta.cos()), -1)
    pixels, valid = made.project(rays)
    assert valid.all()
    seen = torch.atan2(torch.hypot(*rays[:, :2].double().unbind(-1)), rays[:, 2].double()).numpy()
    focal = float(made.intrinsics[0])
    radii = np.hypot(*(pixels.double().numpy() - CENTRE).T) / focal
    # a pixel is rounded, and so is the angle, which the steepest slope stretches
    steepest = reference.slopes.max()
    rounding = 4 * eps * (1000 / focal + steepest * theta.numpy())
    assert (np.abs(radii - reference.radius(seen)) < rounding).all()

    wanted = np.linspace(1e-3, reference.radius(reference.end) * (1 - 1e-4), 4001)
    pixels = torch.tensor(np.outer(wanted * focal, (0.6, 0.8)) + CENTRE, dtype=dtype)
    rays, valid = made.unproject(pixels)
    assert valid.all()
    wanted = np.hypot(*(pixels.double().numpy() - CENTRE).T) / focal
    theta = np.arctan2(np.hypot(*rays[:, :2].double().numpy().T), rays[:, 2].double().numpy())
    off = np.abs(reference.radius(np.minimum(theta, reference.end)) - wanted)
    assert (off < 8 * eps * (1000 / focal + steepest * (1 + theta))).all()
    # where it is steep enough, the angle itself
    steep = np.gradient(reference.radius(np.clip(theta, 0, reference.end)), theta) > 0.2
    angles = reference.angle(wanted)
    assert steep.sum() > 100
    assert (np.abs(angles - theta)[steep] < 20 * eps * (1000 / focal + steepest * (1 + theta[steep]))).all()


def test_a_data_sheet_in_float32_has_the_rays_of_float64():
    counts = []
    for dtype in (torch.float32, torch.float64):
        made, _ = both(data_sheet(), dtype)
        counts.append(int(made.rays()[1].sum()))
    assert abs(counts[0] - counts[1]) <= 4  # pixels on the very circle
    assert counts[1] > 0.7 * 1024 * 1024
