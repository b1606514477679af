"""The rows of the page on nvTorchCam: by what its documentation says."""

import math

import torch

import camtorch as ct

from . import SIZE, equal, pixels, plane, points

HEIGHT, WIDTH = SIZE
HALF = torch.tensor([WIDTH, HEIGHT]) / 2
AFFINE = torch.tensor([0.94, 1.25, 0.01, -0.02])
INTRINSICS = torch.cat([AFFINE[:2] * HALF, (AFFINE[2:] + 1) * HALF - 0.5])  # as on the page
KS, PS = torch.tensor([-0.28, 0.1, -0.01, 0.02, 0.01, -0.003]), torch.tensor([1e-3, -5e-4])
K4, PROJECTING, UNPROJECTING = ([0.02, -0.01, 0.003, -0.001], [0.0, 0.9, -0.02, 0.01], [0.0, 1.1, 0.02, -0.01])
POINTS, PIXELS = torch.from_numpy(points()).float(), torch.from_numpy(pixels()).float()
RAYS = torch.nn.functional.normalize(POINTS, dim=-1)
THETA, ACROSS = RAYS[:, 2:].acos(), torch.nn.functional.normalize(POINTS[:, :2], dim=-1)


def normalised(uv, affine=None):
    seen = (uv + 0.5) / HALF - 1
    return seen if affine is None else (seen - affine[2:]) / affine[:2]


def ours(model, *distortion, focal=1.0):
    """What a camera of ours makes of the points, before the affine map."""
    intrinsics = torch.cat([INTRINSICS[:2] * focal, INTRINSICS[2:]])
    return normalised(model(intrinsics, *distortion, image_size=SIZE).project(POINTS)[0], AFFINE)


def opencv():
    (x, y), (k0, k1, k2, k3, k4, k5), (p0, p1) = plane(POINTS).T, KS, PS
    r = x * x + y * y
    radial = (1 + k0 * r + k1 * r**2 + k2 * r**3) / (1 + k3 * r + k4 * r**2 + k5 * r**3)
    u = x * radial + 2 * p0 * x * y + p1 * (r + 2 * x * x)
    return torch.stack([u, y * radial + p0 * (r + 2 * y * y) + 2 * p1 * x * y], -1)


def kitti360(xi, k1, k2):
    flat = RAYS[:, :2] / (RAYS[:, 2:] + xi)
    square = flat.square().sum(-1, keepdim=True)
    return flat * (1 + k1 * square + k2 * square**2)


def polynomial(coefficients, at):
    return sum(p * at**i for i, p in enumerate(coefficients))


def backwards():
    p = torch.tensor(UNPROJECTING)
    camera = ct.FThetaBackward(torch.cat([INTRINSICS[:2] / p[1], INTRINSICS[2:]]), p[2:] / p[1] ** torch.arange(2.0, 4))
    rays, radius = camera.unproject(PIXELS)[0], normalised(PIXELS, AFFINE).norm(dim=-1)
    return torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2]), polynomial(UNPROJECTING, radius), 1e-5


def panorama():
    affine = torch.tensor([1 / math.pi, 2 / math.pi, 0.0, -1.0])  # the whole sphere
    turned = affine + torch.tensor([0, 0, 0, affine[1] * math.pi / 2])
    intrinsics = torch.cat([turned[:2] * HALF, (turned[2:] + 1) * HALF - 0.5])
    x, y, z = POINTS.T
    documented = torch.stack([torch.atan2(x, z), (-y / POINTS.norm(dim=-1)).acos()], -1) * affine[:2] + affine[2:]
    return normalised(ct.Equirectangular(intrinsics, image_size=SIZE).project(POINTS)[0]), documented, 1e-5


equal("nvtorchcam.cameras", {
    "PinholeCamera CameraBase.project_to_pixel": lambda: [(ours(ct.Pinhole), plane(POINTS), 1e-5)],
    "OpenCVCamera": lambda: [(ours(ct.BrownConrady, torch.cat([KS[:2], PS, KS[2:]])), opencv(), 1e-5)],
    "OpenCVFisheyeCamera": lambda: [
        (ours(ct.KannalaBrandt, K4), ACROSS * THETA * (1 + polynomial([0, *K4], THETA**2)), 1e-5)
    ],
    "Kitti360FisheyeCamera": lambda: [(ours(ct.Mei, [2.2, 0.05, 1.0, 0.0, 0.0]), kitti360(2.2, 0.05, 1.0), 1e-5)],
    "BackwardForwardPolynomialFisheyeCamera": lambda: [
        (ours(ct.FTheta, [p / 0.9 for p in PROJECTING[2:]], focal=0.9), ACROSS * polynomial(PROJECTING, THETA), 1e-5),
        backwards(),
    ],
    "EquirectangularCamera": lambda: [panorama()],
})  # fmt: skip
