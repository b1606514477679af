"""The rows of the page on nvTorchCam: by what its documentation says."""

import math

import torch

import camtorch as ct

from . import SIZE, close, photograph, pixels, points, row, trap

HEIGHT, WIDTH = SIZE
HALF = torch.tensor([WIDTH, HEIGHT]) / 2
AFFINE = torch.tensor([0.94, 1.25, 0.01, -0.02])
INTRINSICS = torch.cat([AFFINE[:2] * HALF, (AFFINE[2:] + 1) * HALF - 0.5])  # as on the page
KS, PS = torch.tensor([-0.28, 0.1, -0.01, 0.02, 0.01, -0.003]), torch.tensor([1e-3, -5e-4])
FISHEYE = torch.tensor([0.02, -0.01, 0.003, -0.001])
POLYNOMIAL = torch.tensor([0.0, 0.9, -0.02, 0.01])
POINTS = torch.from_numpy(points()).float()
POSE = ct.Extrinsics([0.1, -0.2, 0.05], [0.1, 0.2, 0.3]).requires_grad_(False)


def normalised(uv):
    return (uv + 0.5) / HALF - 1


def agrees(camera, flat):
    """A camera of ours projects to what is documented, before the affine map."""
    uv, valid = camera.project(POINTS)
    assert valid.all()
    close(normalised(uv), flat * AFFINE[:2] + AFFINE[2:], 1e-5)


def pinhole():
    return ct.Pinhole(INTRINSICS, image_size=SIZE).requires_grad_(False)


def fisheye():
    return ct.KannalaBrandt(INTRINSICS, FISHEYE, image_size=SIZE).requires_grad_(False)


def polar():
    rays = torch.nn.functional.normalize(POINTS, dim=-1)
    return rays[:, 2].acos(), torch.nn.functional.normalize(POINTS[:, :2], dim=-1)


@row("nvtorchcam.cameras.PinholeCamera", "nvtorchcam.cameras.CameraBase.project_to_pixel")
def pinhole_camera():
    agrees(pinhole(), POINTS[:, :2] / POINTS[:, 2:])


@row("nvtorchcam.cameras.OpenCVCamera")
def opencv_camera():
    (x, y), (k0, k1, k2, k3, k4, k5), (p0, p1) = (POINTS[:, :2] / POINTS[:, 2:]).T, KS, PS
    r = x * x + y * y
    radial = (1 + k0 * r + k1 * r**2 + k2 * r**3) / (1 + k3 * r + k4 * r**2 + k5 * r**3)
    u = x * radial + 2 * p0 * x * y + p1 * (r + 2 * x * x)
    v = y * radial + p0 * (r + 2 * y * y) + 2 * p1 * x * y
    ours = ct.BrownConrady(INTRINSICS, torch.cat([KS[:2], PS, KS[2:]]), image_size=SIZE)
    agrees(ours, torch.stack([u, v], -1))


@row("nvtorchcam.cameras.OpenCVFisheyeCamera")
def opencv_fisheye():
    theta, across = polar()
    radius = theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(FISHEYE)))
    agrees(fisheye(), across * radius[:, None])


@row("nvtorchcam.cameras.Kitti360FisheyeCamera")
def kitti360():
    xi, k1, k2 = 2.2, 0.05, 1.0
    rays = torch.nn.functional.normalize(POINTS, dim=-1)
    flat = rays[:, :2] / (rays[:, 2:] + xi)
    square = flat.square().sum(-1, keepdim=True)
    ours = ct.Mei(INTRINSICS, [xi, k1, k2, 0.0, 0.0], image_size=SIZE)
    agrees(ours, flat * (1 + k1 * square + k2 * square**2))


@row("nvtorchcam.cameras.BackwardForwardPolynomialFisheyeCamera", slow=True)
def polynomials():
    theta, across = polar()
    radius = sum(p * theta**i for i, p in enumerate(POLYNOMIAL))
    p = POLYNOMIAL
    ours = ct.FTheta(torch.cat([INTRINSICS[:2] * p[1], INTRINSICS[2:]]), p[2:] / p[1], image_size=SIZE)
    close(normalised(ours.project(POINTS)[0]), across * radius[:, None] * AFFINE[:2] + AFFINE[2:], 1e-5)
    p = torch.tensor([0.0, 1.1, 0.02, -0.01])
    ours = ct.FThetaBackward(torch.cat([INTRINSICS[:2] / p[1], INTRINSICS[2:]]), p[2:] / p[1] ** torch.arange(2.0, 4))
    uv = torch.from_numpy(pixels()).float()
    rays, valid = ours.unproject(uv)
    assert valid.all()
    radius = ((normalised(uv) - AFFINE[2:]) / AFFINE[:2]).norm(dim=-1)
    close(torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2]), sum(q * radius**i for i, q in enumerate(p)), 1e-5)


@row("nvtorchcam.cameras.EquirectangularCamera")
def panorama():
    affine = torch.tensor([1 / math.pi, 2 / math.pi, 0.0, -1.0])  # the whole sphere
    turned = affine + torch.tensor([0, 0, 0, affine[1] * math.pi / 2])
    intrinsics = torch.cat([turned[:2] * HALF, (turned[2:] + 1) * HALF - 0.5])
    x, y, z = POINTS.T
    documented = torch.stack([torch.atan2(x, z), (-y / POINTS.norm(dim=-1)).acos()], -1) * affine[:2] + affine[2:]
    ours = normalised(ct.Equirectangular(intrinsics, image_size=SIZE).project(POINTS)[0])
    close(ours, documented, 1e-5)


@row("nvtorchcam.cameras.CameraBase.pixel_to_ray", "nvtorchcam.cameras.CameraBase.get_camera_rays")
@row("nvtorchcam.utils.get_normalized_grid")
def rays():
    grid = (fisheye().pixel_grid() + 0.5) / HALF - 1
    close(grid[0, 0], torch.tensor([1 / WIDTH - 1, 1 / HEIGHT - 1]), 1e-6)
    close(grid, fisheye().pixel_grid() * 2 / torch.tensor([WIDTH, HEIGHT]) + grid[0, 0], 1e-6)
    found, seen = fisheye().rays()
    close(fisheye().unproject(fisheye().pixel_grid())[0], found, 1e-6)
    close(found.norm(dim=-1)[seen], torch.ones(int(seen.sum())), 1e-5)


@row("nvtorchcam.cameras.CameraBase.unproject_depth")
def depth():
    depth = 2 + torch.rand(SIZE, generator=torch.Generator().manual_seed(0))
    world = {kind: POSE.inverse()(fisheye().backproject(depth, kind=kind)[0]) for kind in ("z", "distance")}
    close((POSE(world["distance"])).norm(dim=-1), depth.expand_as(world["distance"][..., 0]), 1e-4)
    close(POSE(world["z"])[..., 2].abs(), depth.expand_as(world["z"][..., 0]), 1e-4)


@row("nvtorchcam.cameras.TensorDictionaryAffineCamera.crop")
def crop():
    cropped = fisheye().crop(20, 30, 60, 80)
    close(cropped.project(POINTS)[0], fisheye().project(POINTS)[0] - torch.tensor([30.0, 20.0]), 1e-4)


def image():
    return torch.from_numpy(photograph()).permute(2, 0, 1)[None].float()


@row("nvtorchcam.warpings.resample_by_intrinsics")
def resample():
    turn = POSE.matrix()[:3, :3]  # source from target
    warp = ct.Warp(fisheye(), pinhole(), turn.mT)
    spot, _ = warp.transform_points(torch.tensor([[79.5, 59.5]]))
    ray = turn.mT @ fisheye().unproject(torch.tensor([79.5, 59.5]))[0]
    close(spot[0], pinhole().project(ray)[0], 1e-3)


@row("nvtorchcam.warpings.backward_warp")
def backward_warp():
    depth = 2 + torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(0))
    _, seen = ct.Reproject(fisheye(), pinhole(), POSE)(image(), depth)
    assert seen.float().mean() > 0.3


@row("nvtorchcam.warpings.stereo_rectify")
def stereo():
    right = ct.Extrinsics([0.01, 0.05, -0.02], [-0.12, 0.01, 0.005]).requires_grad_(False)
    pair = ct.rectify(fisheye(), fisheye(), right, projection="latlon")
    flat = ct.rectify(pinhole(), pinhole(), right, image_size=SIZE)
    close(pair.rotation_left, flat.rotation_left, 1e-5)


@row("nvtorchcam.warpings.RandomResizedCropFlip")
def crop_and_flip():
    augment = ct.augment.Compose(
        [ct.augment.RandomResizedCrop((60, 80)), ct.augment.HorizontalFlip(p=1.0)], camera=pinhole()
    )
    sample = augment(image=image(), points=POINTS[None], keypoints=pinhole().project(POINTS)[0][None])
    close(sample["camera"].project(sample["points"])[0], sample["keypoints"], 1e-2)
    assert (sample["camera"].intrinsics[..., :2] > 0).all()


@row("nvtorchcam.utils.normalized_intrinsics_from_pixel_intrinsics")
def pixel_intrinsics():
    of_edges = pinhole().intrinsics + torch.tensor([0, 0, 0.5, 0.5])
    close(torch.cat([of_edges[:2] / HALF, of_edges[2:] / HALF - 1]), AFFINE, 1e-6)


@row("nvtorchcam.utils.samples_from_image")
def samples():
    warp = ct.Warp(fisheye(), pinhole())
    found = torch.nn.functional.grid_sample(image(), warp.grid(), align_corners=False)
    shown = warp.valid_mask().expand_as(found)
    assert (found - warp(image())).abs()[shown].max() < 0.1


@trap
def what_they_call_valid():
    folded = torch.tensor([[math.sin(2.6), 0.0, math.cos(2.6)]])
    assert not fisheye().project(folded)[1]
    axis = torch.tensor([[0.0, 0.0, 1.0]], requires_grad=True)
    (gradient,) = torch.autograd.grad(fisheye().project(axis)[0][0, 0], axis)
    close(gradient[0, 0], INTRINSICS[0], 1e-3)
