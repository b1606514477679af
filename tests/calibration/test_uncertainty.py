"""Covariances and projection uncertainty: by brute force, and by what repeated calibrations scatter by."""

import math

import pytest
import torch
from boards import seen_by

import camtorch as ct
from camtorch.calibration.bundle import CameraObservations, Free, Poses, State, adjust, pixel_jacobians
from camtorch.calibration.robust import Loss
from camtorch.calibration.uncertainty import spread, uncertainty
from camtorch.poses.rotations import rotation_matrix

pytestmark = pytest.mark.slow

F64 = {"dtype": torch.float64}
NOISE = 0.2  # px
KANNALA_BRANDT = torch.tensor((285.0, 286, 318, 243), **F64), torch.tensor((-0.012, 0.03, -0.02, 0.004), **F64)
LENS = ct.KannalaBrandt(*KANNALA_BRANDT, image_size=(480, 640))
PIXELS = torch.tensor([(320.0, 240), (20, 20), (620, 460)], **F64)


class Problem:
    """A board, seen without noise by cameras at the mounts (C, 3, 3), (C, 3); the first one's are nothing."""

    def __init__(self, *cameras, mounts=None, views=16):
        corners, rotations, translations = seen_by(cameras[0], views, columns=7, rows=6, square=0.04)
        middle = corners.object_points.mean(0)
        self.cameras, self.points = cameras, corners.object_points - middle
        self.boards = Poses(rotations[None], (translations + rotations @ middle)[None])
        self.mounts = mounts or Poses.none(1, len(cameras), self.points)
        self.parameters = [torch.cat((c.intrinsics, c.distortion)).detach() for c in cameras]
        self.pixels, self.seen = [], []
        generator = torch.Generator().manual_seed(0)
        for camera, rotation, translation in zip(cameras, *(t[0] for t in self.mounts), strict=True):
            points = self.boards.moved(self.points[None, None])[0] @ rotation.mT + translation
            pixels, valid = (t.detach() for t in camera.project(points))
            self.pixels.append(pixels)
            self.seen.append(valid & camera.contains(pixels) & (torch.rand(valid.shape, generator=generator) > 0.1))

    def state(self, batch=1):
        parameters = tuple(p.expand(batch, -1) for p in self.parameters)
        return State(parameters, self.mounts.expand(batch), self.boards.expand(batch), torch.zeros(batch, 2, **F64))

    def free(self, *fixed, **more):
        names = [("fx", "fy", "cx", "cy", *camera.distortion_names) for camera in self.cameras]
        learns = tuple(torch.tensor([name not in fixed for name in of_one]) for of_one in names)
        return Free(learns, mounts=True, **more)

    def observed(self, batch=1, noise=NOISE):
        draw, observed, shape = torch.Generator().manual_seed(0), [], (1, *self.seen[0].shape, 3)
        for camera, pixels, seen in zip(self.cameras, self.pixels, self.seen, strict=True):
            noisy = pixels + noise * torch.randn(batch, *pixels.shape, generator=draw, **F64)
            observed.append(CameraObservations(type(camera), self.points.expand(shape), noisy, seen[None].double()))
        return observed


def test_of_a_rig_is_that_of_mrcal_by_brute_force():
    """Second camera: every derivative by autograd of formulas written out, one dense system for all unknowns."""
    mounts = Poses(
        torch.stack((torch.eye(3, **F64), rotation_matrix(torch.tensor([0.02, -0.1, 0.03], **F64))))[None],
        torch.tensor([[[0.0, 0, 0], [-0.05, 0.01, 0.02]]], **F64),
    )
    problem = Problem(LENS, LENS, mounts=mounts, views=6)
    free = problem.free("k4", bend=True)
    state = problem.state()
    adjusted = adjust(problem.observed(noise=0.0), state, free, steps=0)
    views, held = 6, [8 * c + i for c in range(2) for i in range(8) if i == 7]

    def moved(x):
        parameters = [p + x[8 * c : 8 * c + 8] for c, p in enumerate(problem.parameters)]
        mount = rotation_matrix(x[16:19]) @ mounts.rotations[0, 1], mounts.translations[0, 1] + x[19:22]
        steps = x[24:].view(views, 6)
        boards = rotation_matrix(steps[:, :3]) @ problem.boards.rotations[0]
        return parameters, mount, (boards, problem.boards.translations[0] + steps[:, 3:]), x[22:24]

    def project(parameters, points):
        return ct.KannalaBrandt(parameters[:4], parameters[4:]).project(points)[0]

    def predicted(x):
        parameters, mount, (rotations, translations), bend = moved(x)
        x, y, _ = (problem.points / problem.points.abs().amax(0).clamp(min=1e-9)).unbind(-1)
        depth = bend[0] * (1 - x * x) + bend[1] * (1 - y * y)
        board = problem.points + torch.nn.functional.pad(depth[:, None], (2, 0))
        first = board @ rotations.mT + translations[:, None]
        seen = project(parameters[0], first), project(parameters[1], first @ mount[0].mT + mount[1])
        return torch.cat([pixels[here].flatten() for pixels, here in zip(seen, problem.seen, strict=True)])

    def seen_again(x, point):
        """Where the second camera sees its own point, taken to the boards and back."""
        _, (turn, shift), (rotations, translations), _ = moved(zero)
        first = turn.mT @ (point - shift)
        on_boards = (rotations.mT @ (first - translations)[..., None])[..., 0]
        parameters, (turn, shift), (rotations, translations), _ = moved(x)
        back = (rotations @ on_boards[..., None])[..., 0] + translations
        return project(parameters[1], turn @ back.mean(0) + shift)

    zero = torch.zeros(24 + 6 * views, **F64)
    use = [i for i in range(len(zero)) if i not in held]
    slopes = torch.autograd.functional.jacobian(predicted, zero)[:, use]
    inverse = torch.linalg.pinv(slopes, rtol=1e-14)
    covariance = NOISE**2 * inverse @ inverse.mT
    values = spread(adjusted, ct.KannalaBrandt, 1).scaled(torch.tensor([NOISE], **F64))
    own = [use.index(8 + i) for i in range(7)]
    assert torch.allclose(values.covariance[0, :7, :7], covariance[own][:, own], rtol=1e-6, atol=1e-14)
    assert not values.covariance[0, 7].any()
    rays = problem.cameras[1].unproject(PIXELS)[0].detach()
    for i, (distance, ray) in enumerate(zip((0.4, 5.0, math.inf), rays, strict=True)):
        # so far away that it is infinity, to within rounding
        far = ray * min(distance, 1e7)
        by_all = torch.autograd.functional.jacobian(lambda x, far=far: seen_again(x, far), zero)[:, use]
        worst = torch.linalg.eigvalsh(by_all @ covariance @ by_all.mT)[-1].sqrt()
        found = uncertainty(values, PIXELS[i], distance)
        assert torch.allclose(found, worst, rtol=1e-5)


def robustly(loss, scale, share, batch):
    """Refits with a share of gross errors: errors, and standard deviations by the noise that the loss leaves."""
    problem = Problem(LENS, views=24)
    free = problem.free()
    (observed,) = problem.observed(batch)
    generator = torch.Generator().manual_seed(7)
    bad = torch.rand(observed.pixels.shape[:-1], generator=generator) < share
    push = 40 * (torch.rand(observed.pixels.shape, generator=generator, **F64) - 0.5)
    observed = observed._replace(pixels=observed.pixels + bad[..., None] * push)
    adjusted = adjust([observed], problem.state(batch), free, loss=Loss(loss, scale), steps=200)
    assert bool(adjusted.converged.all())
    unknowns = len(free.parameters[0]) + 6 * 24
    noise = Loss(loss, scale).noise(adjusted.residuals[0], problem.seen[0][None], unknowns)
    values = spread(adjusted, ct.KannalaBrandt, 0).scaled(noise)
    return adjusted.state.parameters[0] - problem.parameters[0], values.std, noise


@pytest.mark.parametrize(("loss", "share", "slack"), [(None, 0.0, 2.0), ("cauchy", 0.05, 3.0)])
def test_refits_scatter_as_predicted(loss, share, slack):
    """Among outliers nearly: they come to views by chance, and the formulas know only their share."""
    errors, std, _ = robustly(loss, 0.5, share, 200)
    # scatter over prediction, and intervals of 95 %, with some slack for chance: with 2,000 draws all are within 1.0
    ratio = errors.square().mean(0).sqrt() / std.square().mean(0).sqrt()
    assert bool(((ratio - 1).abs() < 0.1 * slack).all()), ratio
    covered = (errors.abs() < 1.959964 * std).double().mean(0)
    assert bool(((covered - 0.95).abs() < 0.02 * slack).all()), covered


def test_huber_leaves_the_noise_alone_without_outliers():
    *_, noise = robustly("huber", 1.0, 0.0, 20)
    assert torch.allclose(noise, noise.new_full((), NOISE), rtol=0.1)


def test_projections_are_known_where_parameters_are_not():
    """A panorama that looks elsewhere, with its middle elsewhere, is the same camera."""
    camera = ct.Cylindrical(torch.tensor([120.0, 120, 320, 240], **F64), image_size=(480, 640))
    problem = Problem(camera)
    noise = torch.tensor([NOISE], **F64)
    observed, state = problem.observed(noise=0.0), problem.state()
    ends = (adjust(observed, state, problem.free(*names), steps=0) for names in ((), ("cx",)))
    loose, held = (spread(end, type(camera), 0).scaled(noise) for end in ends)
    assert loose.std[0, 2] > 1e6 * loose.std[0, 0]
    for distance in (0.4, math.inf):
        assert torch.allclose(uncertainty(loose, PIXELS, distance), uncertainty(held, PIXELS, distance), rtol=1e-5)


@pytest.mark.parametrize("learns", [True, False])
def test_derivatives_go_on_to_the_end_of_the_chart(learns):
    camera = ct.Pinhole(torch.tensor([[10.0, 11, 320, 240]], **F64))
    angles = torch.tensor([60.0, 86.9, 87.5, 89.5], **F64).deg2rad()
    rays = torch.stack((0.6 * angles.sin(), 0.8 * angles.sin(), angles.cos()), -1)[None]
    with torch.set_grad_enabled(learns):  # by the formula, by native code
        by_point, by_own = pixel_jacobians(camera, rays)
    expected = torch.func.vmap(torch.func.jacrev(lambda ray: camera[0].detach().project(ray)[0]))(rays[0])
    torch.testing.assert_close(by_point[0], expected, rtol=1e-12, atol=0)
    plane = rays[0, :, :2] / rays[0, :, 2:]
    torch.testing.assert_close(by_own[0, :, 0, 0], plane[:, 0], rtol=1e-12, atol=0)
    assert bool((by_own[0, :, 1, 3] == 1).all())
