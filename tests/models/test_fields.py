"""What networks are told of cameras: patches, lines in the world, local pinholes, latitude and up."""

import itertools
import math

import pytest
import torch
from cameras import DISTINCT, KEYS, each_kind, every_model, one, real
from test_mixed import one_of_each

import camtorch as ct

SIZE = (224, 224)
PIXELS = torch.tensor([[20.0, 40.0], [150.0, 30.0]], dtype=torch.float64)
FISHEYE = [70.0, 71.0, 111.0, 112.5], [0.05, -0.01, 0.002, 0.0]


def fisheye():
    return ct.KannalaBrandt(*(torch.tensor(t, dtype=torch.float64) for t in FISHEYE), image_size=SIZE)


def posed():
    torch.manual_seed(0)
    cameras = [camera.requires_grad_(False) for camera in one_of_each()]
    return cameras, [ct.Extrinsics(*torch.randn(2, 3, dtype=torch.float64)).requires_grad_(False) for _ in cameras]


@pytest.mark.parametrize("stride", [8, 14, 16])
def test_patches_are_the_pixels_of_the_image_made_smaller(stride):
    camera = fisheye()
    rays, valid = camera.rays(stride)
    small = camera.resize(224 // stride, 224 // stride)
    assert rays.shape == (224 // stride, 224 // stride, 3)
    assert (rays - small.rays()[0]).abs().max() < 1e-13
    assert torch.equal(valid, small.rays()[1])
    assert camera.pixel_grid(stride)[1, 2].tolist() == [2 * stride + (stride - 1) / 2, stride + (stride - 1) / 2]


def test_what_is_kept_is_its_owners_and_follows_what_changes():
    camera = fisheye().requires_grad_(False)
    first, _ = camera.rays(16)
    expected = first.clone()
    first.zero_()
    assert torch.equal(camera.rays(16)[0], expected)
    assert camera.rays(8)[0].shape == (28, 28, 3)
    camera.intrinsics.data[0] += 1
    assert not torch.equal(camera.rays(16)[0], expected)
    camera.requires_grad_()
    assert camera.rays(16)[0].requires_grad
    for number in (camera.intrinsics, camera.distortion):
        number.grad = None
    camera.perspective_field((0.0, 1.0, 0.2), stride=16)[0].sum().backward()
    assert (camera.intrinsics.grad != 0).all()


def test_lines_through_one_point_meet():
    """The reciprocal product of the lines by which two posed cameras of any models see one point is zero."""
    cameras, poses = posed()
    for i, (first, pose) in enumerate(zip(cameras, poses, strict=True)):
        second, other = cameras[i - 5], poses[i - 5]
        lines, valid = first.plucker(pose)
        rays, _ = first.rays()
        direction, moment = lines[valid][::97].split(3, -1)
        points = pose.inverse()(rays[valid][::97] * 2.5)
        assert (torch.linalg.cross(points, direction) - moment).norm(dim=-1).max() < 1e-12
        pixels, seen = second.project(other(points))
        for pixel, line in zip(pixels[seen][:4], lines[valid][::97][seen][:4], strict=True):
            # the camera whose top-left pixel is that one
            shifted = second.intrinsics - torch.cat((pixel.new_zeros(2), pixel))
            one = second.replace(intrinsics=torch.nn.Parameter(shifted))
            one.image_size = (1, 1)
            its, valid_there = one.plucker(other)
            if valid_there.item():
                its = its[0, 0]
                assert abs(line[:3] @ its[3:] + line[3:] @ its[:3]) < 1e-9, (first, second)


def test_lines_in_the_cameras_own_frame_and_in_batches():
    camera = fisheye().requires_grad_(False)
    lines, _ = camera.plucker(stride=16)
    assert torch.equal(lines[..., :3], camera.rays(16)[0])
    assert not lines[..., 3:].any()
    poses = ct.Extrinsics(torch.randn(5, 3), torch.randn(5, 3)).double()
    lines, valid = camera.plucker(poses, stride=32)
    assert lines.shape == (5, 7, 7, 6)
    assert valid.shape == (5, 7, 7)
    lines.sum().backward()
    assert poses.translation.grad.abs().min() > 0
    assert torch.equal(lines[2], camera.plucker(poses[2], stride=32)[0])


def test_lines_without_a_ray_are_zeros_without_a_gradient():
    narrow = torch.tensor([20.0, 20.0, 111.5, 111.5], requires_grad=True)
    camera = ct.OrthographicFisheye(narrow, image_size=SIZE)
    lines, valid = camera.plucker(ct.Extrinsics([0.1, 0.2, 0.3], [1.0, 2.0, 3.0]))
    assert not valid.all()
    assert not lines[~valid].any()
    (by_lines,) = torch.autograd.grad(lines[~valid].sum(), narrow)
    assert not by_lines.any()


def missed(camera, distance):
    """The mean error in pixels of local pinholes, over a ring of that radius around pixels all over the image."""
    pixels = camera.resize(9, 9).pixel_grid().flatten(0, 1)
    height, width = camera.image_size
    pixels = (pixels + 0.5) * pixels.new_tensor([width / 9, height / 9]) - 0.5
    rotation, matrix = camera.local_pinhole(pixels)
    assert torch.isfinite(rotation).all()
    assert torch.isfinite(matrix).all()
    eye = torch.eye(3, dtype=torch.float64)
    assert (rotation @ rotation.mT - eye).abs().max() < 1e-12
    assert (torch.linalg.det(rotation) - 1).abs().max() < 1e-12
    assert not matrix[:, 1, 0].any()
    angles = torch.arange(8, dtype=torch.float64) * (math.pi / 4)
    around = pixels[:, None] + distance * torch.stack((angles.cos(), angles.sin()), -1)
    _, valid = camera.unproject(pixels)
    rays, seen = camera.unproject(around)
    local = (rotation[:, None] @ rays[..., None]).squeeze(-1)
    again = (matrix[:, None] @ (local / local[..., 2:])[..., None]).squeeze(-1)[..., :2]
    # away from where the lens ends or folds, where a pixel is worth many times what it is in the middle
    tame = torch.linalg.det(matrix) > 0.2 * torch.linalg.det(matrix).max()
    clear = (seen.all(-1) & valid & tame & (local[..., 2] > 0.9).all(-1))[:, None].expand_as(seen)
    return (again - around).norm(dim=-1)[clear].mean().item()


@each_kind
def test_local_pinholes_miss_by_the_square_of_the_distance(key):
    camera = next(iter(real(key).values()))
    camera.image_size = camera.image_size or (480, 640)
    errors = [missed(camera.requires_grad_(False), distance) for distance in (8.0, 4.0, 2.0)]
    assert errors[0] < 1.0, errors
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.15), errors
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.1), errors


def test_the_local_pinhole_of_a_pinhole_is_itself():
    camera = ct.Pinhole(torch.tensor([100.0, 110.0, 50.0, 60.0], dtype=torch.float64))
    rotation, matrix = camera.local_pinhole([[50.0, 60.0], [90.0, 20.0]])
    assert torch.equal(rotation[0], torch.eye(3, dtype=torch.float64))
    assert (matrix[0] - camera.K).abs().max() < 1e-12
    # elsewhere a homography, K R ~ the camera's K to first order: the same derivative by the pixel
    assert matrix[1, 0, 0] > 100
    rotation, matrix = fisheye().local_pinhole([[math.nan, 0.0], [1e6, 0.0]])
    eye = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    assert torch.equal(rotation, eye)
    assert torch.equal(matrix, eye)


def test_local_pinholes_in_vmap_and_with_gradients():
    camera, pixels = fisheye().requires_grad_(False), PIXELS
    for found, wanted in zip(torch.func.vmap(camera.local_pinhole)(pixels), camera.local_pinhole(pixels), strict=True):
        assert (found - wanted).abs().max() < 1e-10

    def matrices(pixels, intrinsics, distortion):
        return ct.KannalaBrandt(intrinsics, distortion).local_pinhole(pixels)[1]

    numbers = [torch.tensor(t, dtype=torch.float64, requires_grad=True) for t in FISHEYE]
    assert torch.autograd.gradcheck(matrices, (pixels.clone().requires_grad_(), *numbers))


@pytest.mark.slow
def test_fields_in_compiled_code():
    camera = ct.UCM.from_fov(100, image_size=(480, 640)).double().requires_grad_(False)
    pose = ct.Extrinsics([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])

    def fields(pixels):
        return *camera.local_pinhole(pixels), *camera.plucker(pose, 32), *camera.perspective_field((0, 1, 0.1), 32)

    compiled = torch.compile(fields, fullgraph=True, backend="eager")
    for found, wanted in zip(compiled(PIXELS), fields(PIXELS), strict=True):
        assert torch.allclose(found, wanted, atol=1e-10)


@pytest.mark.parametrize("level", [True, False])
def test_latitude_and_up_are_those_of_points_that_rise(level):
    down = torch.tensor([0.0, 9.81, 0.0] if level else [0.3, 0.8, -0.5], dtype=torch.float64)
    camera = fisheye().requires_grad_(False)
    latitude, up, valid = camera.perspective_field(down, stride=16)
    rays, _ = camera.rays(16)
    upward = -down / down.norm()
    assert (latitude.sin() - (rays * upward).sum(-1)).abs().max() < 1e-14
    moved = camera.project(rays + 1e-6 * upward)[0] - camera.project(rays - 1e-6 * upward)[0]
    assert (moved / moved.norm(dim=-1, keepdim=True) - up).abs()[valid].max() < 1e-8
    if level:
        assert latitude[0, 7] > 0  # the sky is above
        assert up[13, 7, 1] < -0.9  # and v goes down


@pytest.mark.parametrize("keys", [DISTINCT, pytest.param(set(KEYS), marks=pytest.mark.slow)], ids=["distinct", "all"])
def test_fields_of_a_mixed_batch_are_those_of_each(keys):
    cameras = [camera for camera in one_of_each() if camera.key in keys]
    mixed, poses = ct.Mixed(cameras), ct.Extrinsics(*torch.randn(2, len(cameras), 3, dtype=torch.float64))
    down = torch.randn(len(cameras), 3, dtype=torch.float64)
    fields = *mixed.perspective_field(down, stride=8), *mixed.plucker(poses, stride=8)
    for i, camera in enumerate(cameras):
        alone = *camera.perspective_field(down[i], stride=8), *camera.plucker(poses[i], stride=8)
        for field, its in zip(fields, alone, strict=True):
            assert torch.equal(field[i], its), camera


def distance(points, curve):
    """(N,) of points (N, 2) to a curve (M, 2)."""
    start, way = curve[:-1], curve.diff(dim=0)
    share = ((points[:, None] - start) * way).sum(-1) / way.square().sum(-1).clamp(min=1e-30)
    return (points[:, None] - start - share.clamp(0, 1)[..., None] * way).norm(dim=-1).amin(-1)


@every_model
def test_the_curve_is_near_with_short_pieces_and_ends_where_the_lens_does(key):
    camera = one(key).requires_grad_(False)
    camera = camera.resize(camera.height * 640 // camera.width, 640)
    points = torch.randn(4, 3, dtype=torch.float64)
    points[::2, 2] = points[::2, 2].abs()  # some in front, and some edges that go behind
    curves = camera.project_polyline(points)
    assert curves
    for curve in curves:
        assert len(curve) > 1
        assert curve.diff(dim=0).norm(dim=-1).max() <= 20
    share = torch.linspace(0, 1, 101, dtype=torch.float64)[:, None]
    dense = torch.cat([a + share * (b - a) for a, b in itertools.pairwise(points)])
    pixels, valid = camera.project(dense)
    near = valid & ((pixels - pixels.new_tensor([camera.width / 2, camera.height / 2])).norm(dim=-1) < 3 * camera.width)
    best = torch.stack([distance(pixels[near], curve) for curve in curves]).amin(0)
    # of a lens whose image ends, the last of the dense points may be beyond the last of the curve
    assert (best < 0.1).double().mean() > 0.98
    assert best.max() < 20


def test_an_edge_of_a_pinhole_is_straight_and_cut_at_its_plane():
    camera = ct.Pinhole([100.0, 100, 50, 50], image_size=(100, 100))
    extrinsics = ct.Extrinsics([0.0, 0, 0], [0.0, 0, 1.0])
    (curve,) = camera.project_polyline([[-1.0, 1, 0], [1, 1, 0]], extrinsics)  # lists, seen from one behind
    assert curve.dtype == torch.float32
    torch.testing.assert_close(curve[[0, -1]], torch.tensor([[-50.0, 150], [150, 150]]))
    assert (curve[:, 1] == 150).all()
    (behind,) = camera.project_polyline([[0.5, 0.0, 1], [0.5, 0.0, -1]])
    assert behind[0].tolist() == [100, 50]
    assert 1000 < behind[-1, 0] <= 50 + 16 * 100
    assert camera.project_polyline([[0.5, 0.0, -1], [0.5, 1.0, -1]]) == []


def test_over_the_seam_of_a_panorama_there_are_two():
    camera = ct.Equirectangular.from_fov(360, image_size=(100, 200)).double().requires_grad_(False)
    curves = camera.project_polyline([[-1.0, 0, -1], [1.0, 0, -1]])
    assert len(curves) == 2
    ends = sorted(round(float(curve[i, 0]), 1) for curve in curves for i in (0, -1))
    assert ends == [-0.5, 24.5, 174.5, 199.5]


def test_edges_of_a_box_are_lines_of_their_own_and_have_gradients():
    camera = one("kannala_brandt")
    corners = torch.cartesian_prod(*[torch.tensor([-0.2, 0.2], dtype=torch.float64)] * 3) + torch.tensor([0.1, 0, 1])
    pairs = [(i, j) for i in range(8) for j in range(i) if (i ^ j) in (1, 2, 4)]
    edges = torch.stack([corners[list(pair)] for pair in pairs]).requires_grad_()
    curves = camera.project_polyline(edges)
    assert len(curves) == len(edges) == 12
    for curve, edge in zip(curves, edges, strict=True):
        assert torch.equal(curve[[0, -1]], camera.project(edge)[0])
    torch.cat(curves).sum().backward()
    assert torch.isfinite(edges.grad).all()
    assert camera.intrinsics.grad[0] != 0
