"""What holds for every camera model: both directions, their derivatives, what is valid, and edited images."""

import math

import cameras
import pytest
import torch
from cameras import DISTINCT, KEYS, drawn, each_kind, every_model, fan, make, one, pixel_lattice, slow_unless, spread
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck, gradgradcheck
from torch.func import jacfwd, jacrev, jvp, vmap

import camtorch as ct
from camtorch.optics.backprojection import Inverted
from camtorch.optics.charts import CylinderChart, Perspective, SphereChart, Transverse
from camtorch.optics.lens import Lens

EPS = torch.finfo(torch.float64).eps
distinct_models = pytest.mark.parametrize("key", cameras.RARE_ARE_SLOW)
every_calibration = pytest.mark.parametrize(("key", "name"), cameras.REAL)
few_calibrations = pytest.mark.parametrize(("key", "name"), cameras.FEW_REAL)
drawn_models = pytest.mark.parametrize(
    ("key", "wild"),
    slow_unless(
        lambda case: case[0] in DISTINCT and not case[1],
        [(key, wild) for key in KEYS for wild in (False, True)[: 1 + (key in cameras.RANGES)]],
    ),
    ids=lambda value: value if isinstance(value, str) else ("plausible", "wild")[value],
)
both_precisions = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def optics(camera):
    return camera.optics(camera.distortion.detach().unbind(-1))


def end_degrees(camera):
    """How far out a fan makes orientation: the perspective chart ends at 90 degrees, short of which pixels run away."""
    return 88.0 if isinstance(optics(camera)[0], Perspective) else 179.0


def pixel_limit(pixels, px=1e-9, per=1000):
    return px * (pixels.norm(dim=-1) / per).clamp(min=1)


def px_per_rad(camera, rays):
    """The singular values (*N, 2) of d(pixel)/d(angle)."""
    rays = rays.detach().requires_grad_()
    u, v = camera.project(rays)[0].unbind(-1)
    rows = [torch.autograd.grad(plane.sum(), rays, retain_graph=True)[0] for plane in (u, v)]
    return torch.linalg.svdvals(torch.stack(rows, -2))


def rad_per_px(camera, rays):
    """How far a pixel's error turns the ray."""
    return 1 / px_per_rad(camera, rays)[..., 1]


def check_pixels_return(camera, pixels):
    rays, valid = camera.unproject(pixels)
    again, reachable = camera.project(rays)
    assert reachable[valid].all(), pixels[valid & ~reachable][:3].tolist()
    # where an angle ceases to ascend with the radius, as in a division camera, its rounding moves the pixel far
    limit = pixel_limit(pixels[valid]) + 8 * EPS * px_per_rad(camera, rays[valid])[..., 0]
    error = (again - pixels).norm(dim=-1)[valid] / limit
    assert (error < 1).all(), (error.max().item(), pixels[valid][error.argmax()].tolist())
    return valid


def check_rays_return(camera, rays, on_image=False, lost=0.0):
    """Back as itself; a lens that is not radial may send two azimuths to one pixel, then the other ray may return."""
    pixels, valid = (t.detach() for t in camera.project(rays))
    if on_image:
        valid = valid & camera.contains(pixels)
    condition = rad_per_px(camera, rays)
    # a few roundings of pixel and principal point, seen through the conditioning
    limit = 32 * EPS * (1 + (pixels.norm(dim=-1) + camera.intrinsics.detach().norm()) * condition)
    # within 1e-5 rad of a fold, and where a pixel does not tell rays apart, rounding decides; five images away a
    # prism of fourth order outweighs the lens itself, and turns azimuths by up to a right angle
    near = (pixels - camera.intrinsics[2:].detach()).norm(dim=-1) < 5 * max(camera.image_size)
    clear = valid & near & (condition * camera.intrinsics[0].item() < 1e5) & (limit < 1e-6)
    rays, pixels, limit = rays[clear], pixels[clear], limit[clear]
    again, valid = camera.unproject(pixels)
    assert (~valid).sum() <= lost * len(valid), (rays[~valid][:3].tolist(), pixels[~valid][:3].tolist())
    rays, pixels, limit, again = rays[valid], pixels[valid], limit[valid], again[valid]
    same = (again - rays).norm(dim=-1) < limit
    lens = optics(camera)[1]
    if on_image or not lens.stages or lens.is_radial:
        assert same.all(), (rays[~same][:3].tolist(), again[~same][:3].tolist())
    else:
        there = camera.project(again)[0]
        assert ((there - pixels).norm(dim=-1) < pixel_limit(pixels)).all()
        turn = torch.atan2(rays[:, 1], rays[:, 0]) - torch.atan2(again[:, 1], again[:, 0])
        assert (torch.sin(turn / 2).abs() > 1e-6)[~same].all(), rays[~same][:3].tolist()


@every_calibration
def test_round_trips_of_calibrations(key, name):
    camera = cameras.real(key)[name]
    valid = check_pixels_return(camera, pixel_lattice(camera))
    assert valid.double().mean() > 0.5
    check_rays_return(camera, fan(end_degrees(camera)), on_image=True)
    check_rays_return(camera, fan(end_degrees(camera)))


@drawn_models
@given(data=st.data())
def test_round_trips_of_drawn_cameras(key, wild, data):
    camera = data.draw(drawn(key, wild))
    check_pixels_return(camera, pixel_lattice(camera))
    # far outside the image of a wild prism lens the search loses a ray in some ten thousand
    check_rays_return(camera, fan(end_degrees(camera), angles=30, azimuths=12), lost=0.01 if wild else 0.0)


@few_calibrations
@pytest.mark.parametrize(("width", "limit"), [(1000, 1e-3), (4000, 1e-2)])
def test_single_precision(key, name, width, limit):
    camera = cameras.real(key)[name]
    height, old_width = camera.image_size
    exact = camera.resize(round(height * width / old_width), width)
    camera = cameras.real(key)[name].resize(round(height * width / old_width), width).float()
    pixels = pixel_lattice(camera)
    rays, valid = camera.unproject(pixels)
    assert rays.dtype == torch.float32
    again, reachable = camera.project(rays)
    assert reachable[valid].all()
    error = (again - pixels).norm(dim=-1)
    rays, expected = exact.unproject(pixels.double())
    # in a corner beyond its image circle a lens may stretch the angle sevenfold, and its rounding with it
    stretch = vmap(jacrev(lambda ray: exact.project(ray)[0]))(rays).norm(dim=(-1, -2))
    assert (error < (8 * 2**-24 * stretch).clamp(min=limit))[valid & expected].all()
    assert (error < limit)[valid & ~expected].all()

    condition = rad_per_px(exact, rays) * exact.intrinsics[0]
    clear = ~expected | (condition < 1e2)  # a hundredth of a radian from the fold
    clear &= expected | ~near_the_rim(exact, pixels.double())
    assert (valid == expected)[clear].all(), pixels[clear & (valid != expected)][:3].tolist()


def near_the_rim(camera, pixels):
    """Pixels, themselves without a ray, with one a pixel further in."""
    inwards = camera.intrinsics[2:].detach() - pixels
    return camera.unproject(pixels + inwards / inwards.norm(dim=-1, keepdim=True).clamp(min=1))[1]


@distinct_models
@both_precisions
def test_distance_does_not_matter(key, dtype):
    camera = one(key).to(dtype)
    rays = fan(60).to(dtype)
    pixels, valid = camera.project(rays)
    for scale in (2.0**-60, 2.0**60):
        scaled, still_valid = camera.project(rays * scale)
        assert torch.equal(still_valid, valid)
        # a power of two costs no bit
        assert torch.equal(scaled, pixels)


# -- derivatives


def near_and_far_rays():
    off_axis = torch.tensor([[0, 0], [1e-12, -1e-12], [1e-7, 2e-7], [0.02, -0.03], [-0.3, 0.2], [0.4, 0.5]])
    return torch.cat((off_axis.double(), torch.ones(len(off_axis), 1, dtype=torch.float64)), -1)


def leaves(camera):
    return tuple(t.detach().clone().requires_grad_(t.numel() > 0) for t in (camera.intrinsics, camera.distortion))


def learning(camera, intrinsics, distortion):
    """The camera of other parameters, but for what it takes as cameras.constants."""
    count = cameras.constants(camera)
    if count:
        distortion = torch.cat((camera.distortion.detach()[:count], distortion[count:]))
    return make(camera.key, intrinsics, distortion)


derivative_cameras = pytest.mark.parametrize(
    ("key", "camera_of"),
    slow_unless(
        lambda case: case[0] in {"brown_conrady", "division", "double_sphere", "fisheye624"} and case[1] is spread,
        [(key, spread) for key in KEYS] + [(key, one) for key in KEYS if (one(key).distortion == 0).any()],
    ),
)


@derivative_cameras
@pytest.mark.parametrize("method", ["project", "unproject"])
def test_derivatives(key, camera_of, method):
    camera, values, scale = camera_of(key), near_and_far_rays() * 1.7, 1.0
    if method == "unproject":
        # pixels in units of the focal length: steps of the numerical derivative must not drown in their rounding
        scale = camera.intrinsics[0].item() * cameras.axis_slope(key, camera.distortion.tolist())
        values = near_and_far_rays()[:, :2] + camera.intrinsics.detach()[2:] / scale
    assert getattr(camera, method)(values * scale)[1].all()

    def function(values, *parameters):
        return getattr(learning(camera, *parameters), method)(values * scale)[0]

    inputs = (values.requires_grad_(), *leaves(camera))
    assert gradcheck(function, inputs)
    if key in cameras.NOT_ANALYTIC:
        inputs = (values[3:].detach().requires_grad_(), *inputs[1:])
    # along random directions: entry by entry it takes three times as long
    assert gradgradcheck(function, inputs, fast_mode=True)


@every_model
def test_derivatives_at_the_axis(key):
    """On the axis a camera without even terms is a pinhole camera, first derivatives included."""
    camera = spread(key)
    # a table has its slope in the lens
    slope = 1 if key == "tabulated" else cameras.axis_slope(key, camera.distortion.tolist())
    fx, fy, _, _ = (slope * camera.intrinsics.detach()).tolist()
    _, lens = optics(camera)
    zero = torch.zeros((), dtype=torch.float64)
    ((ua, ub), (va, vb)) = jacfwd(lambda m: torch.stack(lens(m[0], m[1])))(torch.stack((zero, zero)))
    expected = torch.tensor([[fx * ua, fx * ub, 0], [fy * va, fy * vb, 0]], dtype=torch.float64)
    for offset in (0.0, 1e-300, 1e-12, 1e-7):
        result = jacrev(lambda p: camera.project(p)[0])(torch.tensor([offset, -offset, 1.0], dtype=torch.float64))
        torch.testing.assert_close(result.detach(), expected, rtol=0, atol=fx * (1e-12 + 4 * offset))


# -- what is not valid


def bad_points(camera):
    never = [[0, 0, 0], [math.nan, 0, 1], [0, math.nan, 1], [1, 2, math.nan], [math.inf, 0, 1], [0, 0, math.inf]]
    chart = optics(camera)[0]
    if isinstance(chart, Perspective):
        never += [[0, 0, -1], [0.1, 0.2, -1], [1, 0, 0], [1, 1, -1e-12]]
    elif not isinstance(chart, (CylinderChart, SphereChart, Transverse)):
        never += [[0, 0, -1], [0, 0, -1e-9]]
    return never


BAD_PIXELS = [[math.nan, 0], [0, math.nan], [math.inf, 0], [3, -math.inf], [math.nan, math.nan]]


@every_model
@both_precisions
@pytest.mark.parametrize("method", ["project", "unproject"])
def test_bad_rows(key, dtype, method):
    """Bad rows: invalid, finite, no gradient. Good rows and parameters: what they would be without the bad ones."""
    camera = one(key).to(dtype)
    parameters = [p for p in camera.parameters() if p.requires_grad]
    if method == "project":
        good, bad = near_and_far_rays().to(dtype), torch.tensor(bad_points(camera), dtype=dtype)
    else:
        good, bad = pixel_lattice(camera, 5, 7), torch.tensor(BAD_PIXELS, dtype=dtype)
        good = good[camera.unproject(good)[1]]
    values = torch.cat((good, bad)).requires_grad_()
    result, valid = getattr(camera, method)(values)
    assert result.isfinite().all()
    assert not valid[len(good) :].any(), bad[valid[len(good) :]]
    weights = torch.linspace(-1, 2, result.numel(), dtype=result.dtype).view_as(result)
    by_value, *by_parameter = torch.autograd.grad((result * weights).sum(), [values, *parameters])
    assert (by_value[len(good) :] == 0).all()

    alone = good.clone().requires_grad_()
    by_itself, valid = getattr(camera, method)(alone)
    assert valid.all()
    close = 100 * torch.finfo(result.dtype).eps
    torch.testing.assert_close(result[: len(good)], by_itself, rtol=close, atol=close)
    expected = torch.autograd.grad((by_itself * weights[: len(good)]).sum(), [alone, *parameters])
    for mine, reference in zip((by_value[: len(good)], *by_parameter), expected, strict=True):
        # sums over points, of which some cancel
        torch.testing.assert_close(mine, reference, rtol=close, atol=close * float(reference.abs().max()))


@each_kind
@pytest.mark.parametrize("again", [False, True])
def test_cotangents_of_invalid_rows_may_be_anything(key, again):
    """The root of a pixel of -1, or of the radius of the axis: an invalid row is left out later, not before."""
    camera = one(key)
    points = torch.tensor([[0.1, 0.2, 1.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    pixels = torch.cat((pixel_lattice(camera)[100:101], torch.full((1, 2), math.nan, dtype=torch.float64)))

    def of_points(points):
        return camera.project(points)[0].sqrt().sum(-1)

    def of_pixels(pixels):
        rays, _ = camera.unproject(pixels)
        return torch.atan2(rays[:, :2].square().sum(-1).sqrt(), rays[:, 2])

    for function, values in ((of_points, points), (of_pixels, pixels)):
        leaf = values.clone().requires_grad_()
        leaves = [leaf, *(p for p in camera.parameters() if p.numel())]
        gradients = torch.autograd.grad(function(leaf)[0], leaves, create_graph=again)
        assert all(g.isfinite().all() for g in gradients)
        assert torch.func.grad(lambda v, function=function: function(v)[0])(values).isfinite().all()


@pytest.mark.parametrize("coefficient", [1e12, 1e30])
def test_one_exploded_lens_leaves_the_others_alone(coefficient):
    lenses = torch.tensor([[-0.3, 0.1, 0, 0, 0], [0, 0, 0, 0, coefficient]])
    camera = ct.BrownConrady(torch.tensor([[280.0, 280, 320, 240]] * 2), lenses)
    pixels = 500 * torch.rand(2, 50, 2)
    rays, valid = camera.unproject(pixels)
    assert rays.isfinite().all()
    alone, still = ct.BrownConrady([280.0, 280, 320, 240], lenses[0]).unproject(pixels[0])
    assert torch.equal(valid[0], still)
    torch.testing.assert_close(rays[0], alone)


@distinct_models
@both_precisions
def test_pixels_far_beyond_every_image(key, dtype):
    """Valid only with the ray that projects there, at any distance."""
    for camera in (one(key).to(dtype), spread(key, dtype)):
        angle = torch.linspace(0, 2 * math.pi, 25, dtype=dtype)[:, None]
        ring = torch.cat((angle.cos(), angle.sin()), -1)
        for distance in 10.0 ** torch.arange(3, 19, 3):
            pixels = camera.intrinsics[2:].detach() + distance * ring
            rays, valid = camera.unproject(pixels)
            again, reachable = camera.project(rays)
            # next to a pole the ray's own rounding moves the pixel a long way
            stretch = vmap(jacrev(lambda ray, camera=camera: camera.project(ray)[0]))(rays.detach()).norm(dim=(-1, -2))
            limit = 100 * torch.finfo(dtype).eps * (distance + stretch)
            assert ((again - pixels).norm(dim=-1) < limit)[valid & reachable].all(), distance


@distinct_models
@both_precisions
@pytest.mark.parametrize("method", ["project", "unproject"])
@settings(max_examples=3)
@given(data=st.data())
def test_any_number_gives_finite_results(key, dtype, method, data):
    """Also the largest and smallest numbers there are; an invalid row has no gradient."""
    camera = one(key).to(dtype)
    columns = 3 if method == "project" else 2
    number = st.one_of(st.floats(width=32), st.floats(width=64), st.sampled_from([0.0, -0.0, 1.0, 1e-12, 1e-40]))
    rows = data.draw(st.lists(st.lists(number, min_size=columns, max_size=columns), min_size=1, max_size=5))
    values = torch.tensor(rows, dtype=dtype).requires_grad_()
    result, valid = getattr(camera, method)(values)
    assert result.isfinite().all()
    for gradient in torch.autograd.grad(result.sum(), [values, *(p for p in camera.parameters())], allow_unused=True):
        assert gradient is None or gradient.isfinite().all()
    (by_value,) = torch.autograd.grad(getattr(camera, method)(values)[0].sum(), values)
    assert (by_value[~valid] == 0).all()
    assert not valid[~values.isfinite().all(-1)].any()


# -- folds


def before_fold(camera, rays, samples, azimuths):
    """(samples, azimuths): before the chart turns back, and the determinant of the lens is first not positive.

    The determinant by autograd and sampled densely.
    """
    chart, lens = optics(camera)
    if not chart.has_scale:
        return (chart.margin(*rays.unbind(-1)) > 0).view(samples, azimuths)
    if isinstance(chart, Inverted):  # its formula leads from the radius to the angle
        radius = torch.linspace(0, chart.end(torch.float64), 100_001, dtype=torch.float64)
        x, _, z = chart.to_ray(radius, torch.zeros_like(radius))
        theta = torch.atan2(x, z)
        rises = torch.cat((torch.ones(1, dtype=torch.bool), theta[1:] > theta[:-1])).cummin(0).values
        return (torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2]) < theta[rises].max()).view(samples, azimuths)
    a, b = chart.to_plane(*(rays / rays.abs().amax(-1, keepdim=True)).unbind(-1))
    # outwards along the azimuth, which a pole turns round
    radius = ((a * rays[:, 0] + b * rays[:, 1]) / rays[:, :2].norm(dim=-1).clamp(min=1e-30)).view(samples, azimuths)
    rises = torch.cat((torch.ones(1, azimuths, dtype=torch.bool), radius[1:] > radius[:-1]))
    # so far out that its powers would leave the floating-point range no chart has an image
    before = (rises & (radius < 4e8)).cummin(0).values
    return before & regular(lens, a, b, samples, azimuths)


def regular(lens, a, b, samples, azimuths):
    """(samples, azimuths): before the determinant of the lens is first not positive at points of the plane."""
    before = torch.ones(samples, azimuths, dtype=torch.bool)
    if not lens.stages:
        return before
    tangents = [(torch.ones_like(a), torch.zeros_like(a)), (torch.zeros_like(a), torch.ones_like(a))]
    for last in range(1, len(lens.stages) + 1):
        # stage by stage: a tilt may bring back what the pole of the stage before it sent to infinity
        (ua, va), (ub, vb) = (jvp(Lens(*lens.stages[:last]), (a, b), along)[1] for along in tangents)
        before &= (ua * vb - ub * va > 0).view(samples, azimuths).cummin(0).values
    radial = getattr(lens.stages[0], "radial", None)
    if hasattr(radial, "denominator"):  # a pole with a zero right behind it is narrower than the samples
        before &= (radial.denominator(a * a + b * b) > 0).view(samples, azimuths).cummin(0).values
    edge = lens.at(a, b).edge
    if edge is not None:
        before &= (edge > 0).view(samples, azimuths).cummin(0).values
    return before


def within_reach(camera, rays, samples, azimuths):
    """(samples, azimuths): up to 10,000 focal lengths from the principal point.

    Further out, where no sensor is, these samples miss folds, and a wild Fisheye624 is valid again behind its
    own: k5 = 0.5, s1 = s3 = 0.03125, from 100,000 focal lengths on.
    """
    chart, lens = optics(camera)
    if not chart.has_scale or isinstance(chart, Inverted):
        return torch.ones(samples, azimuths, dtype=torch.bool)
    return (torch.hypot(*lens(*chart.to_plane(*rays.unbind(-1)))) < 1e4).view(samples, azimuths).cummin(0).values


def turned_little(camera, rays, samples, azimuths):
    """(samples, azimuths): up to where the lens, still regular, turns directions of the plane by a quarter.

    From there on it may count as turned over, which has a positive determinant too.
    """
    chart, lens = optics(camera)
    if not chart.has_scale or not lens.stages:
        return torch.ones(samples, azimuths, dtype=torch.bool)
    a, b = chart.to_plane(*rays.unbind(-1))
    one, zero = torch.ones_like(a), torch.zeros_like(a)
    (ua, _), (_, vb) = (jvp(lens, (a, b), along)[1] for along in ((one, zero), (zero, one)))
    return (ua + vb > 0).view(samples, azimuths).cummin(0).values


def check_fold(camera, azimuths=12, samples=900):
    """Valid exactly from the axis to the fold; where it ends abruptly, up to the nearer one of two azimuths."""
    rays = fan(end_degrees(camera), samples, azimuths)
    pixels, valid = camera.project(rays)
    valid, pixels = valid.view(samples, azimuths), pixels.detach().view(samples, azimuths, 2)
    most = before_fold(camera, rays, samples, azimuths)
    least = most & turned_little(camera, rays, samples, azimuths)
    # a finger of what lies beyond the fold may be narrower than the wedge
    for turn in (share * 2 * math.pi / 256 for share in (-1, -0.5, -0.25, 0.25, 0.5, 1)):
        about_z = torch.linalg.matrix_exp(torch.tensor([[0, -turn, 0], [turn, 0, 0], [0, 0, 0]], dtype=rays.dtype))
        least &= before_fold(camera, rays @ about_z.T, samples, azimuths)
    wrong = (valid & ~most) | (least & ~valid)
    # the samples next to a fold may go either way
    edge = torch.zeros_like(wrong)
    for limit in (most, least):
        here = limit ^ torch.cat((limit[1:], limit[-1:]))
        edge |= here | torch.cat((here[:1], here[:-1]))
    near = within_reach(camera, rays, samples, azimuths)
    wrong &= near & ~edge
    assert not wrong.any(), rays.view(samples, azimuths, 3)[wrong][:3].tolist()
    return pixels, valid & near


def check_no_shared_pixels(pixels, valid):
    """Along an azimuth the curve of pixels does not meet itself."""
    for azimuth in range(pixels.shape[1]):
        curve = pixels[:, azimuth][valid[:, azimuth]][::4]
        step = (curve[1:] - curve[:-1]).norm(dim=-1)
        if len(step) < 3:
            continue
        apart = torch.cdist(curve[:-1], curve[:-1], compute_mode="donot_use_mm_for_euclid_dist")
        bound = 0.3 * torch.minimum(step[:, None], step[None])
        index = torch.arange(len(step))
        neighbours = (index[:, None] - index[None]).abs() < 2
        assert ((apart > bound) | neighbours).all(), azimuth


@few_calibrations
def test_fold_of_calibrations(key, name):
    check_no_shared_pixels(*check_fold(cameras.real(key)[name]))


@drawn_models
@settings(max_examples=2)  # the dearest law of all
@given(data=st.data())
def test_fold_of_drawn_cameras(key, wild, data):
    check_no_shared_pixels(*check_fold(data.draw(drawn(key, wild)), azimuths=6))


@every_model
@settings(max_examples=3)
@given(data=st.data())
def test_nothing_is_found_beyond_the_fold(key, data):
    """A pixel further out than the image of the fold of a radial lens has no ray."""
    camera = data.draw(drawn(key, True))
    _, lens = optics(camera)
    if not lens.stages or not lens.is_radial:
        return
    rays = fan(end_degrees(camera), 2000, 3)
    pixels, valid = (t.detach().view(2000, 3, -1) for t in camera.project(rays))
    folds = ~valid[-1].flatten()
    centre = camera.intrinsics[2:].detach()
    rim = torch.where(valid, pixels - centre, 0.0)
    rim = rim.gather(0, rim.norm(dim=-1).argmax(0)[None, :, None].expand(1, -1, 2))[0][folds]
    assert camera.unproject(centre + 0.99 * rim)[1].all()
    # a table ends where it still ascends, anywhere between two samples
    for outside in (1.01 if key == "tabulated" else 1.001, 1.1, 2.0, 10.0, 1e3, 1e6):
        assert not camera.unproject(centre + outside * rim)[1].any()


def rim_of(camera, azimuths):
    """(M, 2): pixels of the last valid rays on some azimuths, by bisection, those that are no more than images away."""
    phi = torch.linspace(0.1, 2 * math.pi + 0.1, azimuths + 1, dtype=torch.float64)[:-1]

    def project(theta):
        sine = theta.sin()
        return camera.project(torch.stack((sine * phi.cos(), sine * phi.sin(), theta.cos() + 0 * phi), -1))

    theta = torch.linspace(0, math.radians(179.9), 400, dtype=torch.float64)[:, None]
    invalid = ~project(theta)[1]
    first = invalid.int().argmax(0)
    low, high = theta[(first - 1).clamp(min=0), 0], theta[first, 0]
    for _ in range(60):
        valid = project((low + high) / 2)[1]
        low, high = torch.where(valid, (low + high) / 2, low), torch.where(valid, high, (low + high) / 2)
    pixels = project(low)[0].detach()
    near = (pixels - camera.intrinsics[2:].detach()).norm(dim=-1) < 5 * max(camera.image_size)
    return pixels[invalid.any(0) & near]


@few_calibrations
@both_precisions
def test_pixels_around_the_image_of_the_fold(key, name, dtype):
    """A hair inside or outside the last pixel that has a ray: invalid, or a ray that projects there."""
    camera = cameras.real(key)[name]
    rim = rim_of(camera, 8)
    centre = camera.intrinsics[2:].detach()
    hair = 10.0 ** torch.linspace(-16, -3, 40, dtype=torch.float64)
    around = (centre + (rim - centre) * torch.cat((1 - hair, 1 + hair))[:, None, None]).view(-1, 2).to(dtype)
    camera = camera.to(dtype)
    rays, valid = camera.unproject(around)
    again, reachable = camera.project(rays)
    # single precision: looser than on an image, for some of these lenses fold a thousand times further out
    limit = pixel_limit(around, px=1e-9 if dtype == torch.float64 else 1e-2)
    right = reachable & ((again - around).norm(dim=-1) < limit)
    assert right[valid].all(), (around[valid & ~right][:3].tolist(), again[valid & ~right][:3].tolist())


@distinct_models
@both_precisions
@settings(max_examples=2)
@given(data=st.data())
def test_what_a_pixel_sees_is_seen(key, dtype, data):
    """Wherever a pixel has a ray, however near to a fold or to the end of a chart, that ray has a pixel."""
    camera = data.draw(drawn(key, data.draw(st.booleans())))
    centre = camera.intrinsics[2:].detach()
    rim = torch.cat((rim_of(camera, 8), centre[None]))  # if only that
    hair = torch.logspace(math.log10(torch.finfo(dtype).eps), -2, 48, dtype=torch.float64)[:, None, None]
    pixels = (centre + (rim - centre) * (1 - hair)).view(-1, 2).to(dtype)
    camera = camera.to(dtype)
    # native, and the formula
    for unproject, project in ((camera.unproject, camera.project), (vmap(camera.unproject), vmap(camera.project))):
        rays, valid = unproject(pixels)
        assert project(rays)[1][valid].all()


@pytest.mark.parametrize("key", [*sorted(DISTINCT), "ocamcalib"])  # whose chart is looked up before a lens
@pytest.mark.parametrize(("batch", "dims"), [((3,), ()), ((2, 3), (4, 2)), ((1,), (2, 1, 3))])
def test_batch_equals_loop(key, batch, dims):
    single = spread(key)
    count = math.prod(batch)
    draw = 1 + 0.1 * torch.rand(count, 1, dtype=torch.float64)
    intrinsics, distortion = single.intrinsics.detach() * draw, single.distortion.detach() / draw
    cameras = [make(key, *numbers) for numbers in zip(intrinsics, distortion, strict=True)]
    batched = make(key, intrinsics.view(*batch, 4), distortion.view(*batch, distortion.shape[-1]))
    assert (batched.batch_shape, batched.K.shape) == (batch, (*batch, 3, 3))
    points = torch.rand(*batch, *dims, 3, dtype=torch.float64) - 0.5
    points[..., 2] += 0.8
    for method, values in (("project", points), ("unproject", 480 * (points[..., :2] + 0.5))):
        results, valid = getattr(batched, method)(values)
        assert results.shape == (*batch, *dims, 5 - values.shape[-1])
        assert (valid.shape, valid.dtype) == ((*batch, *dims), torch.bool)
        loop = [getattr(c, method)(v) for c, v in zip(cameras, values.reshape(count, *dims, -1), strict=True)]
        alone = torch.stack([r for r, _ in loop])
        torch.testing.assert_close(results.reshape(count, *dims, -1), alone, rtol=1e-13, atol=1e-13)
        assert torch.equal(valid.reshape(count, *dims), torch.stack([v for _, v in loop]))


def test_batch_dims_of_one_broadcast():
    camera, points = spread("kannala_brandt"), fan(40).view(4, -1, 3)
    expected = camera.project(points)[0]
    torch.testing.assert_close(camera.expand(1).project(points)[0], expected)
    torch.testing.assert_close(camera.expand(3).project(points[:1])[0], expected[:1].expand(3, -1, -1))


@every_model
def test_no_points_give_no_pixels(key):
    pixels, valid = one(key).project(torch.zeros(0, 3))
    assert pixels.shape == (0, 2)
    assert valid.shape == (0,)
    if key != "tabulated":  # torch's gather under vmap takes no mapped dim of 0
        assert vmap(one(key).project)(torch.zeros(0, 4, 3))[0].shape == (0, 4, 2)
        assert vmap(one(key).unproject)(torch.zeros(0, 4, 2))[0].shape == (0, 4, 3)
    rays, valid = one(key).unproject(torch.zeros(4, 0, 2))
    assert rays.shape == (4, 0, 3)
    assert valid.shape == (4, 0)


# the edit; what it does to the scene; where a pixel goes; and the size
EDITS = {
    "crop": (lambda c: c.crop(20, -30, 200, 300), (1, 1), lambda u, v: (u + 30, v - 20), (200, 300)),
    "pad": (lambda c: c.pad(5, 6, 7, 8), (1, 1), lambda u, v: (u + 5, v + 7), (495, 651)),
    "resize": (lambda c: c.resize(240, 960), (1, 1), lambda u, v: (1.5 * u + 0.25, 0.5 * v - 0.25), (240, 960)),
    "hflip": (lambda c: c.hflip(), (-1, 1), lambda u, v: (639 - u, v), (480, 640)),
    "vflip": (lambda c: c.vflip(), (1, -1), lambda u, v: (u, 479 - v), (480, 640)),
    "rot90": (lambda c: c.rot90(), (1, -1), lambda u, v: (v, 639 - u), (640, 480)),
    "rot180": (lambda c: c.rot90(2), (-1, -1), lambda u, v: (639 - u, 479 - v), (480, 640)),
    "rot270": (lambda c: c.rot90(-1), (-1, 1), lambda u, v: (479 - v, u), (640, 480)),
}


@pytest.mark.parametrize(("key", "name"), [(k, n) for n in EDITS for k in (KEYS if "rot" in n else sorted(DISTINCT))])
def test_edits(key, name):
    edit, signs, move, size = EDITS[name]
    camera, quarter = spread(key), size == (640, 480)
    if "tau_x" in camera.distortion_names and quarter:
        with pytest.raises(ValueError, match="tau_x or tau_y must be 0"):
            edit(camera)
        k = camera.distortion.detach().clone()
        k[camera.distortion_names.index("tau_x")] = 0
        camera = camera.replace(distortion=k)
    if ct.MODELS[key].quarter_turn is None and quarter:
        with pytest.raises(ValueError, match="must be the same on its side"):
            edit(camera)
        return

    def seen(rays):
        across = rays[..., [1, 0] if quarter else [0, 1]]
        return torch.cat((across * torch.tensor(signs), rays[..., 2:]), -1)

    edited = edit(camera)
    assert (type(edited), edited.image_size) == (type(camera), size)
    assert (edited.intrinsics[..., :2] > 0).all()
    points, lattice = fan(end_degrees(camera)), pixel_lattice(camera)
    pixels, valid = camera.project(points)
    moved, still_valid = edited.project(seen(points))
    assert torch.equal(still_valid, valid)
    expected = torch.stack(move(*pixels.unbind(-1)), -1)
    assert ((moved - expected).norm(dim=-1)[valid] < pixel_limit(pixels[valid])).all()
    rays, valid = camera.unproject(lattice)
    moved, still_valid = edited.unproject(torch.stack(move(*lattice.unbind(-1)), -1))
    assert torch.equal(still_valid, valid)
    torch.testing.assert_close(moved, seen(rays), rtol=0, atol=1e-12)
    for whole, part in zip(edit(camera.expand(2)).parameters(), edited.parameters(), strict=True):
        torch.testing.assert_close(whole[1], part)
    if signs != (1, 1):
        back = edited.rot90(1 if name == "rot270" else -1) if quarter else edit(edited)
        torch.testing.assert_close(back.intrinsics, camera.intrinsics)
        torch.testing.assert_close(back.distortion, camera.distortion, rtol=0, atol=0)


@each_kind
def test_matrix(key):
    camera = spread(key)
    fx, fy, cx, cy = camera.intrinsics.tolist()
    assert camera.K.tolist() == [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    distortion = (camera.distortion.detach(),) if camera.distortion_names else ()
    again = type(camera).from_matrix(camera.K.detach(), *distortion, image_size=(480, 640))
    assert torch.equal(again.intrinsics, camera.intrinsics)
    assert torch.equal(again.distortion, camera.distortion)
    assert again.image_size == camera.image_size
    skewed = camera.K.detach() + torch.tensor([[0, 0.25, 0], [0, 0, 0], [0, 0, 0]])
    again = type(camera).from_matrix(skewed, *distortion, ignore_skew=True)
    assert torch.equal(again.intrinsics, camera.intrinsics)
    batched = type(camera).from_matrix(camera.K.detach().expand(2, 3, 3).numpy())
    assert batched.batch_shape == (2,)


@each_kind
def test_contains_the_outer_pixel_edges(key):
    camera = spread(key)
    inside = torch.tensor([[-0.5, -0.5], [639.5, 479.5], [0, 479.5], [300, 200]])
    outside = torch.tensor([[-0.6, 0], [0, -0.6], [639.6, 0], [0, 479.6], [math.nan, 3], [math.inf, 3], [3, -math.inf]])
    assert camera.contains(inside).all()
    assert not camera.contains(outside).any()
    assert not camera.contains(camera.project(torch.tensor([[0.0, 0, 0], [math.nan, 1, 1]]))[0]).any()


@each_kind
def test_pixel_grid_and_rays(key):
    camera = spread(key).resize(6, 8)
    grid = camera.pixel_grid()
    assert (grid.shape, grid.dtype) == ((6, 8, 2), torch.float64)
    assert grid[2, 5].tolist() == [5, 2]
    assert grid[-1, -1].tolist() == [7, 5]
    assert camera.contains(grid).all()
    rays, valid = camera.rays()
    assert rays.shape == (6, 8, 3)
    assert torch.equal(rays, camera.unproject(grid)[0])
    assert torch.equal(valid, camera.unproject(grid)[1])
    batched = make(key, camera.intrinsics.detach().expand(2, 4), camera.distortion.detach(), image_size=(6, 8))
    rays_of_two, valid = batched.rays()
    assert rays_of_two.shape == (2, 6, 8, 3)
    assert valid.shape == (2, 6, 8)
    torch.testing.assert_close(rays_of_two[1], rays)


@every_model
@settings(max_examples=2)
@given(data=st.data())
def test_coefficients_left_out_are_zeros(key, data):
    camera = data.draw(drawn(key, False))
    count = len(camera.distortion_names)
    if key == "tabulated":  # where zeros are another table
        return
    more = [n for n in range(count + 1, 15) if ct.MODELS[key].names_of(n)]
    rays = fan(40, 8, 5)
    for n in more:
        padded = torch.nn.functional.pad(camera.distortion.detach(), (0, n - count))
        wide = make(key, camera.intrinsics.detach(), padded)
        torch.testing.assert_close(wide.project(rays)[0], camera.project(rays)[0], rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("focal", "coefficients", "end"),
    [(15000.0, [-2013.7, 1814797, 0, 0, 11058511], 0.04), (1000.0, [-2.558, 2.9014, 0, 0, 0.1175], 1.0)],
)
def test_a_fold_and_its_end_close_together_are_found(focal, coefficients, end):
    """The radius turns back for a moment: within a degree of a telephoto lens, and within a wide one."""
    intrinsics = torch.tensor([focal, focal, 2000, 1500], dtype=torch.float64)
    camera = ct.BrownConrady(intrinsics, torch.tensor(coefficients, dtype=torch.float64))
    a = torch.linspace(0, end, 40001, dtype=torch.float64)
    _, valid = camera.project(torch.stack((a, 0 * a, 1 + 0 * a), -1))
    k1, k2, _, _, k3 = coefficients
    slope = 1 + 3 * k1 * a**2 + 5 * k2 * a**4 + 7 * k3 * a**6
    expected = (slope > 0).cummin(0).values
    assert not expected.all()
    assert slope[-1] > 0
    assert (valid != expected).sum() <= 1


def test_a_lens_shared_by_predicted_cameras_learns():
    lens = torch.nn.Parameter(torch.tensor([0.02, -0.01, 0.003, -0.001]))
    predicted = torch.tensor([[280.0, 281, 319.5, 239.5]] * 3, requires_grad=True)
    camera = ct.KannalaBrandt(predicted * 1, lens)
    assert camera.distortion is lens
    assert camera.batch_shape == (3,)
    camera.project(torch.rand(3, 5, 3))[0].sum().backward()
    assert (lens.grad != 0).all()
    assert (predicted.grad != 0).any()
