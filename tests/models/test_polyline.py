"""Straight edges in space as curves in the image."""

import itertools

import torch
from cameras import every_model, one

import camtorch as ct


def distance(points, curve):
    """(N,) of points (N, 2) to a curve (M, 2)."""
    start, way = curve[:-1], curve.diff(dim=0)
    share = ((points[:, None] - start) * way).sum(-1) / way.square().sum(-1).clamp(min=1e-30)
    return (points[:, None] - start - share.clamp(0, 1)[..., None] * way).norm(dim=-1).amin(-1)


@every_model
def test_the_curve_is_near_with_short_pieces_and_ends_where_the_lens_does(key):
    camera = one(key).requires_grad_(False)
    camera = camera.resize(camera.height * 640 // camera.width, 640)
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    points[::2, 2] = points[::2, 2].abs()  # some in front, and some edges that go behind
    curves = camera.project_polyline(points)
    assert curves
    for curve in curves:
        assert len(curve) > 1
        assert curve.diff(dim=0).norm(dim=-1).max() <= 20
    share = torch.linspace(0, 1, 201, dtype=torch.float64)[:, None]
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
