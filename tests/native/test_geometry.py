"""Laws of the native geometry: what Python's formulas say of a ray or a pixel, it says too, and their derivatives."""

import math
from unittest.mock import patch

import pytest
import torch
from cameras import (
    KEYS,
    constants,
    every_model,
    fan,
    limits_of,
    make,
    nodes_of_steps,
    one,
    pixel_lattice,
    real,
    slow_unless,
    spread,
)

import camtorch as ct
from camtorch.native.build import VARIANTS
from camtorch.native.library import library, native_available
from camtorch.optics import Equidistant, Lens, Stage
from camtorch.projection import native_calls as geometry
from camtorch.projection import native_cameras
from camtorch.projection.project import PROJECT
from camtorch.projection.rows import CameraRows
from camtorch.projection.unproject import UNPROJECT
from camtorch.values.arguments import columns

pytestmark = pytest.mark.skipif(not native_available(), reason="the library is not compiled here, or turned off")

# one calibration of each model and the others, which take a while
each_kind = pytest.mark.parametrize("key", slow_unless(KEYS.__contains__, [*KEYS, *(f"{k} others" for k in KEYS)]))
each_dtype = pytest.mark.parametrize("dtype", slow_unless([torch.float64].__contains__, [torch.float64, torch.float32]))

# models that native code must know
CODED = {
    "brown_conrady", "cylindrical", "division", "double_sphere", "equirectangular", "equisolid", "eucm",
    "f_theta", "f_theta_backward", "f_theta_backward_sheared", "f_theta_sheared", "fisheye62", "fisheye624",
    "fov", "kannala_brandt", "latlon", "mei", "ocamcalib", "orthographic_fisheye", "pinhole", "splined",
    "stereographic", "tabulated", "thin_prism_fisheye", "transverse_cylindrical", "ucm", "woodscape",
}  # fmt: skip

# no rays, none that a chart may cover, and some that are
WILD = [[0, 0, 0], [math.nan, 0, 1], [1, math.nan, 1], [math.inf, 0, 1], [0, -math.inf, math.nan], [0, 0, -1]]
WILD += [[1e-30, 0, 1e-30], [1e30, 2e30, 3e30], [1e-12, 1e-12, 1], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, -1e-9]]


def native(camera):
    """A camera's, or a batch's (C,)."""
    intrinsics = camera.intrinsics.detach().reshape(-1, 4)
    distortion = camera.distortion.detach().reshape(len(intrinsics), -1)
    found = CameraRows(type(camera), intrinsics, distortion).native
    if found is None and type(camera).key not in CODED:
        pytest.skip("its parts have no codes of C, which are optional")
    assert found is not None
    return found


def formula_of(camera, direction, values):
    """What the recorded formula says, (N, size), and of which it is valid; with a graph to the camera's parameters."""
    intrinsics, distortion = camera.intrinsics[None], camera.distortion[None]
    rows = CameraRows(type(camera), intrinsics, distortion)
    planes, valid = direction.formula(type(camera), values[None], intrinsics, distortion, rows)
    return planes[:, 0].mT, valid[0]


def cameras(name, dtype):
    key, _, others = name.partition(" ")
    found = list(real(key).values())[:-1] if others else [one(key), spread(key)]
    return [camera.to(dtype) for camera in found]


def points(dtype):
    rays = fan(178, 46, 13) * 3.7
    return torch.cat((rays, torch.tensor(WILD, dtype=torch.float64))).to(dtype)


def pixels(camera):
    """Some thrice as far out as the image, and some that are none."""
    inside = pixel_lattice(camera, 23, 31)
    wide = (inside - inside.mean(0)) * 3 + inside.mean(0)
    return torch.cat((wide, wide.new_tensor([[math.nan, 0], [math.inf, 0], [1e30, 1]])))


def _moved(tensor, sizes, seed):
    noise = 2 * torch.rand(tensor.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1
    return tensor.double() * (1 + sizes * noise)


def moved(camera, roundings, seed):
    """The coefficients, by so many roundings; nodes stay."""
    k, nodes = camera.distortion.detach(), constants(camera)
    return torch.cat((k[:nodes].double(), _moved(k[nodes:], roundings * torch.finfo(k.dtype).eps, seed)))


def formula(camera, p, k):
    """Pixels of a formula alone, in float64: of points that it has, whatever is valid."""
    x, y, z = (p.double() / p.double().abs().amax(-1, keepdim=True)).unbind(-1)
    chart, lens = type(camera).optics(columns(k.double()[None]))
    a, b = chart.to_plane(x[None], y[None], z[None], order=1)
    return torch.stack(lens(a, b), -1)[0] * camera.intrinsics.detach().double()[:2]


def lost(camera, p):
    """How far rounding may carry pixels: what a formula says where all that it is made of moves by some roundings."""
    near = [(_moved(p, 4 * torch.finfo(p.dtype).eps, seed), moved(camera, 4, seed)) for seed in range(3)]
    here = formula(camera, p, camera.distortion.detach())
    return 24 * torch.stack([(formula(camera, *there) - here).abs() for there in near]).amax((0, -1))


@each_kind
@each_dtype
def test_projects_as_the_formula_does(key, dtype):
    p, eps = points(dtype), torch.finfo(dtype).eps
    for camera in cameras(key, dtype):
        with torch.no_grad():
            expected, valid = formula_of(camera, PROJECT, p)
            exact = (camera.distortion.double(), moved(camera, 16, 3))
            others = [make(camera.key, camera.intrinsics.double(), k) for k in exact]
            near = [formula_of(other, PROJECT, _moved(p, 64 * eps, seed))[1] for other in others for seed in range(2)]
        found, found_valid = (w[..., 0, :] for w in geometry.project(native(camera), p[None])[:2])
        found = found.mT
        # next to a fold rounding decides
        sure = torch.stack(near).eq(valid).all(0)
        assert (found_valid == valid)[sure].all()
        both = valid & found_valid
        allowed = 32 * eps * (1000 + expected[both].abs().amax(-1)) + lost(camera, p[both])
        assert ((found - expected)[both].abs().amax(-1) <= allowed).all()
        assert (found[~found_valid] == -1).all()


@each_kind
@each_dtype
def test_unprojects_as_the_formula_does(key, dtype):
    eps = torch.finfo(dtype).eps
    for camera in cameras(key, dtype):
        q = pixels(camera)
        with torch.no_grad():
            expected, valid = formula_of(camera, UNPROJECT, q)
            exact = make(camera.key, camera.intrinsics.double(), camera.distortion.double())
            around = [formula_of(exact, UNPROJECT, _moved(q, 32 * eps, seed)) for seed in range(2)]
            there = formula_of(exact, UNPROJECT, q.double())[0]
        rays, found_valid, _ = geometry.unproject(native(camera), q[None], learns=True)
        rays, found_valid = rays[:, 0].mT, found_valid[0]
        sure = torch.stack([ok for _, ok in around]).eq(valid).all(0)
        assert found_valid[sure & valid].all()
        assert not found_valid[sure & ~valid].any()
        both = valid & found_valid
        off = torch.stack([(ray - there).norm(dim=-1) for ray, _ in around]).amax(0)
        assert ((rays - expected).norm(dim=-1) <= 32 * eps + 8 * off)[both].all()
        assert (rays[~found_valid] == rays.new_tensor([0, 0, 1])).all()


def close(found, expected, loss):
    largest = expected.abs().max() + 1e-30
    assert ((found - expected).abs() <= loss * torch.finfo(found.dtype).eps * largest).all()


def of_coefficients(camera, sums):
    """What cotangents of the parameters of chart and lens are those of the distortion."""
    k = camera.distortion.detach().clone().requires_grad_()
    chart, lens = type(camera).optics(columns(k[None]))
    pairs = zip((*chart.parameters, *lens.parameters), sums, strict=True)
    pairs = [(p, s.expand_as(p)) for p, s in pairs if p.requires_grad]
    outputs, cotangents = zip(*pairs, strict=True)
    return torch.autograd.grad(outputs, k, cotangents, materialize_grads=True)[0]


@every_model
@each_dtype
def test_derivatives_are_those_of_the_formula(key, dtype):
    generator = torch.Generator().manual_seed(1)
    for camera in (one(key).to(dtype), spread(key, dtype)):
        camera.requires_grad_()
        leaves = [camera.intrinsics, *([camera.distortion] if camera.distortion.numel() else [])]
        made = native(camera)
        # away from the fold, where derivatives are of no size
        inside = pixel_lattice(camera, 9, 11)
        q = (inside - inside.mean(0)) * 0.4 + inside.mean(0)
        q = torch.cat((q, q.new_tensor([[math.nan, 3]]), camera.intrinsics[None, 2:].detach())).requires_grad_()
        p = torch.cat((camera.unproject(q)[0].detach() * 2, q.new_tensor([[0, 0, 1], [math.nan, 0, 1]])))
        p.requires_grad_()

        for direction, values, loss in ((PROJECT, p, 256), (UNPROJECT, q, 4096)):
            out, _ = formula_of(camera, direction, values)
            weight = torch.randn(out.shape, generator=generator, dtype=dtype)
            expected = torch.autograd.grad(out, [values, *leaves], weight)
            rows, cotangents = values.detach()[None], weight.mT[:, None]
            if direction is PROJECT:
                by_value, sums = geometry.project_vjp(made, rows, cotangents, True, True)
            else:
                *_, solved = geometry.unproject(made, rows, learns=True)
                by_value, sums = geometry.unproject_vjp(made, *solved, cotangents, True, True)
            found = [by_value[0], sums[0, :4]]
            found += [of_coefficients(camera, sums[0, 4:])] if camera.distortion.numel() else []
            for have, want in zip(found, expected, strict=True):
                close(have, want, loss)


@pytest.mark.parametrize("key", slow_unless({"brown_conrady", "fisheye624"}.__contains__, sorted(CODED)))
def test_derivatives_of_far_points_need_no_call_before(key):
    """Up to the fold and behind the camera, of so many lenses that none of them is kept."""
    model, names = ct.MODELS[key], one(key).distortion_names
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor([limits_of(key, name, wild=True) for name in names] or [(0, 0)]).double().unbind(-1)
    count = 520 // len(low) + 1  # more than 512 numbers
    wild = low + torch.rand(count, len(low), generator=generator, dtype=torch.float64) * (high - low)
    k = torch.stack([nodes_of_steps(key, row) for row in wild])[:, : len(names)]
    intrinsics = torch.tensor([[300.0, 310, 320, 240]], dtype=torch.float64).expand(count, 4).contiguous()
    rays = fan(178, 30, 13)
    rays = rays[rays @ rays.new_tensor([2, 1, 0]) > 0].expand(count, -1, -1)  # on one side, so that sums do not cancel
    before = CameraRows(model, intrinsics, k).native
    if before is None:
        pytest.skip("its parts have no codes of C, which are optional")
    seen = geometry.project(before, rays)[1]
    leaves = torch.where(seen[..., None], rays, rays.new_tensor([0, 0, 1])), intrinsics, k
    here, *numbers = [leaf.requires_grad_() for leaf in leaves]
    chart, lens = model.optics(columns(k))
    sensor = torch.stack(lens(*chart.to_plane(*here.unbind(-1))), -1)
    planes = (sensor * intrinsics[:, None, :2] + intrinsics[:, None, 2:]).unbind(-1)
    expected = [torch.autograd.grad(plane.sum(), leaves, retain_graph=True, materialize_grads=True) for plane in planes]
    made = CameraRows(model, *(number.detach() for number in numbers)).native
    found = geometry.project_jacobians(made, here.detach(), by_camera=True)
    if key in ("brown_conrady", "splined"):
        assert made.struct.limits2 is not None  # some points lay so far out
    for i, (by_points, by_intrinsics, by_k) in enumerate(expected):
        close(found[0][:, :, i], by_points, 4096)
        sums = found[1][:, :, i].sum(1)
        close(sums[:, :4], by_intrinsics, 4096)
        if names and made.plan.places is not None:
            close(sums[:, 4:], by_k[:, made.plan.places], 4096)


@every_model
def test_a_row_is_what_it_is_alone(key):
    base = one(key).float()
    intrinsics = torch.stack([base.intrinsics * s for s in (1.0, 0.9, 1.1)])
    batch = type(base)(intrinsics, *([base.distortion.expand(3, -1)] if base.distortion.numel() else []))
    p = torch.cat((points(torch.float32), fan(100, 300, 80).float()))
    rows = p.flip(0).expand(3, -1, -1)  # one row for all
    with patch.object(geometry, "thread_count", lambda: 3):
        together, valid, _ = geometry.project(native(batch), rows)
    for i in range(3):
        alone = type(base)(intrinsics[i], *([base.distortion] if base.distortion.numel() else []))
        found = geometry.project(native(alone), p[None])
        assert together[:, i].flip(-1).equal(found[0][:, 0])
        assert valid[i].flip(-1).equal(found[1][0])
        few = geometry.project(native(alone), p[None, 5:17:3])
        assert few[0].equal(found[0][..., 5:17:3])


@pytest.mark.parametrize("key", ["kannala_brandt", "fisheye624", "double_sphere"])
def test_any_strides_and_threads(key):
    made = native(one(key).float())
    q = pixels(one(key).float()).repeat(40, 1)
    expected, _, solved = geometry.unproject(made, q[None], learns=True)
    weight = torch.randn(expected.shape, generator=torch.Generator().manual_seed(0))
    cotangents = geometry.unproject_vjp(made, *solved, weight, True, True)
    wide = torch.full((len(q), 7), math.nan)
    wide[:, 1:6:4] = q
    for rows in (q.mT.contiguous().mT, wide[:, 1:6:4], q.flip(-1).flip(-1)):
        assert geometry.unproject(made, rows[None])[0].equal(expected)
    with patch.object(geometry, "thread_count", lambda: 3):
        again, _, solved = geometry.unproject(made, q[None], learns=True)
        assert again.equal(expected)
        turned = weight.movedim(0, -1).contiguous().movedim(-1, 0)
        found = geometry.unproject_vjp(made, *solved, turned, True, True)
    assert all(a.equal(b) for a, b in zip(found, cotangents, strict=True))


def test_what_users_make_has_no_code():
    class Wave(Stage):
        def __call__(self, a, b):
            return a + 0.1 * torch.sin(b), b

    class Wide(Equidistant):
        pass

    assert native_cameras.codes(Equidistant(), Lens()) is not None
    assert native_cameras.codes(Equidistant(), Lens(Wave())) is None
    assert native_cameras.codes(Wide(), Lens()) is None


# -- pixels that are moved: one call says what unproject, turn and project say one by one

TURN = ct.Extrinsics([0.1, -0.2, 0.05], [0, 0, 0]).matrix()[:3, :3].detach()


def sized(camera, dtype):
    camera = camera.to(dtype).requires_grad_(False)
    return camera.replace(image_size=camera.image_size or (480, 640))


def one_by_one(source, target, rotation, pixels):
    rays, has_ray = source.unproject(pixels)
    turned = rays if rotation is None else rays @ rotation.mT.to(rays.dtype)
    moved, valid = target.project(turned)
    valid = valid & has_ray
    return torch.where(valid[..., None], moved, -1.0), valid


def check_moves(found, expected, image_size):
    (moved, valid), (there, mapped) = found, expected
    # whether a ray next to the end of a chart is seen hangs on the last bit of the turn
    assert (valid != mapped).double().mean() < 2e-3
    both = valid & mapped
    near = both & ((there - there.new_tensor(image_size[::-1]) / 2).abs().amax(-1) < 3 * max(image_size))
    eps = torch.finfo(moved.dtype).eps
    assert ((moved - there).abs().amax(-1)[near] <= 4096 * eps * max(image_size)).double().mean() > 0.99


@every_model
@each_dtype
def test_points_move_as_by_a_ray(key, dtype):
    camera, straight = sized(one(key), dtype), ct.Pinhole.from_fov(80, image_size=(200, 300)).to(dtype)
    straight = straight.requires_grad_(False)
    for source, target in ((camera, straight), (straight, camera)):
        pixels = pixel_lattice(source, 23, 31).to(dtype)
        pixels = torch.cat((pixels, pixels.new_tensor([[math.nan, 3], [math.inf, 0], [1e30, 1]])))
        for rotation in (None, TURN.to(dtype)):
            warp = ct.Warp(source, target, rotation)
            moved, valid = warp.transform_points(pixels)
            there, mapped = one_by_one(source, target, rotation, pixels)
            check_moves((moved, valid), (there, mapped & target.contains(there)), target.image_size)


@every_model
def test_a_batch_moves_as_each_alone_and_in_any_memory(key):
    camera = sized(one(key), torch.float64)
    focal = torch.tensor([[1.0, 1, 1, 1], [1.1, 1.1, 1, 1], [0.9, 0.95, 1, 1]], dtype=torch.float64)
    cameras = camera.expand(3).replace(intrinsics=camera.intrinsics * focal).requires_grad_(False)
    straight = ct.Pinhole.from_fov(80, image_size=(200, 300)).double().requires_grad_(False)
    turns = torch.stack([torch.matrix_power(TURN, i) for i in range(len(cameras))]).double()
    warp = ct.Warp(cameras, straight, turns)
    pixels = pixel_lattice(cameras[0], 7, 9).expand(len(cameras), -1, -1)
    found = warp.transform_points(pixels)
    assert torch.equal(found[1], straight.contains(found[0]))  # what has no place is at (-1, -1)
    for rows in (pixels.contiguous(), pixels.movedim(-1, 0).contiguous().movedim(0, -1), pixels.flip(1).flip(1)):
        again = warp.transform_points(rows)
        assert all(map(torch.equal, found, again))
    for i, camera in enumerate(cameras):
        alone = ct.Warp(camera, straight, turns[i]).transform_points(pixels[i])
        assert torch.equal(alone[0], found[0][i])
        assert torch.equal(alone[1], found[1][i])


def test_a_lens_that_must_be_searched_is_whole():
    """Pixels that only brackets and damped steps find, from the middle of a map to its corners."""
    names = [key for key in KEYS if key in ("fisheye624", "brown_conrady", "thin_prism_fisheye")]
    for key in names:
        camera = sized(one(key), torch.float64)
        odd = camera.distortion.clone()
        odd[-2:] = 0.08
        strong = make(key, camera.intrinsics, odd, image_size=camera.image_size).requires_grad_(False)
        target = ct.Pinhole.from_fov(100, image_size=(160, 200)).double().requires_grad_(False)
        pixels = pixel_lattice(strong, 31, 41)
        moved = ct.Warp(strong, target, TURN.double()).transform_points(pixels)
        there, mapped = one_by_one(strong, target, TURN.double(), pixels)
        check_moves(moved, (there, mapped & target.contains(there)), target.image_size)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("driver", "sources", "jobs"),
    [("geometry_fuzz.c", ["geometry.c"], 800), ("poses_fuzz.c", ["poses.c", "consensus.c", "views.c"], 4000)],
)
def test_no_read_outside_and_nothing_undefined(fuzzed, driver, sources, jobs):
    options = VARIANTS[library().camtorch_variant().decode()]  # these files are the same in each variant
    fuzzed(driver, sources, {"fuzzed": options}, 1, jobs)
