"""Parameters that learning or a network made unusable: the others live, and what happened is said."""

import copy

import pytest
import torch
from cameras import constants, each_kind, every_model, fan, make, one, spread
from torch.nn.utils import parametrize

import camtorch as ct
from camtorch.networks.parametrize import PositiveFocal, TiedFocal

POINTS = fan(40, 4, 3)


def predicted(key):
    """Leaves of a batch as a network makes it, its numbers, of which some rows are no camera's; and which are."""
    camera, count = spread(key), 7
    leaves = [t.detach().repeat(count, 1).requires_grad_() for t in (camera.intrinsics, camera.distortion)]
    numbers, good = [leaf * 1 for leaf in leaves], torch.ones(count, dtype=torch.bool)
    for row, column, value in ((1, 0, -300.0), (3, 1, 0.0), (4, 2, torch.nan), (5, 3, torch.inf)):
        numbers[0][row, column], good[row] = value, False
    if camera.distortion_names:
        numbers[1][6, -1], good[6] = torch.nan, False
    return leaves, numbers, good


@each_kind
@pytest.mark.parametrize("graph", [True, False])
def test_bad_rows_of_a_predicted_batch_are_invalid_and_the_others_live(key, graph):
    """The results of the others and their gradients are those of cameras that are alone, and reach every number."""
    with torch.set_grad_enabled(graph):
        leaves, numbers, good = predicted(key)
        camera = make(key, *numbers, image_size=(480, 640))
        points, at = POINTS.expand(len(good), -1, 3), torch.full((len(good), 3, 2), 250.0, dtype=torch.float64)
        (pixels, valid), (rays, has_ray) = camera.project(points), camera.unproject(at)
    alone = make(key, *(leaf.detach()[0] for leaf in leaves))
    expected, seen = alone.project(POINTS)
    assert torch.equal(valid, seen & good[:, None])
    assert pixels.isfinite().all()
    assert rays.isfinite().all()
    # torch.atan2 rounds the last elements of a tensor otherwise than the others
    torch.testing.assert_close(pixels[2], expected, rtol=1e-15, atol=0)
    assert torch.equal(has_ray[:, 0], good)
    assert [c.project(POINTS)[1].any().item() for c in camera] == good.tolist()
    if graph:
        (pixels.sum() + rays.square().sum()).backward()
        (expected.sum() + alone.unproject(at[0])[0].square().sum()).backward()
        for leaf, one in zip(leaves, alone.parameters(), strict=False):
            assert leaf.grad.isfinite().all()
            assert not leaf.grad[~good].any()
            torch.testing.assert_close(leaf.grad[2], one.grad)
            assert (one.grad[constants(alone) if one is alone.distortion else 0 :] != 0).all()


@every_model
def test_an_undefined_row_of_predicted_coefficients(key):
    model = ct.MODELS[key]
    if model.defined_text == "":
        pytest.skip("its formula always exists")
    good = spread(key)
    distortion = good.distortion.detach().repeat(2, 1)
    distortion[1, {"eucm": 1}.get(key, 0)] = -1e3
    camera = model(good.intrinsics.detach(), distortion.requires_grad_())
    assert camera.project(POINTS.expand(2, -1, 3))[1].any(-1).tolist() == [True, False]


def test_bad_poses_of_a_predicted_batch():
    rotation = torch.zeros(2, 3, requires_grad=True) * torch.tensor([[1.0], [torch.nan]])
    pixels, valid = ct.Pinhole([300.0, 300.0, 0.0, 0.0])(ct.Extrinsics(rotation, torch.ones(2, 3))(torch.ones(2, 1, 3)))
    assert valid.tolist() == [[True], [False]]
    assert pixels.isfinite().all()


PARAMETRIZATIONS = pytest.mark.parametrize("parametrization", [PositiveFocal, TiedFocal])


def tied(key):
    camera = one(key)
    intrinsics = camera.intrinsics.detach().clone()
    intrinsics[..., 1] = intrinsics[..., 0]
    return make(key, intrinsics, camera.distortion.detach(), image_size=camera.image_size)


@each_kind
@PARAMETRIZATIONS
def test_parametrized_cameras_are_the_same_and_copied(key, parametrization):
    plain, camera, fresh = (tied(key) for _ in range(3))
    for made in (camera, fresh):
        parametrize.register_parametrization(made, "intrinsics", parametrization())
    with torch.no_grad():
        fresh.parametrizations.intrinsics.original.mul_(0.9)
    fresh.load_state_dict(camera.state_dict())
    for other in (camera, copy.deepcopy(camera), fresh):
        for mine, expected in zip(other.project(POINTS), plain.project(POINTS), strict=True):
            torch.testing.assert_close(mine, expected, rtol=1e-12, atol=1e-12)
        centre = plain.intrinsics.detach()[2:]
        torch.testing.assert_close(other.unproject(centre)[0], plain.unproject(centre)[0], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(camera.hflip().hflip().project(POINTS)[0], plain.project(POINTS)[0])
    assert camera.hflip().intrinsics.requires_grad
    parametrize.remove_parametrizations(camera, "intrinsics")
    torch.testing.assert_close(camera.project(POINTS)[0], plain.project(POINTS)[0])


@PARAMETRIZATIONS
@pytest.mark.parametrize("batch", [(), (2,)])
def test_training_never_leaves_the_positive(parametrization, batch):
    camera = ct.KannalaBrandt(torch.tensor([4.0, 4.0, 320.0, 240.0]).expand(*batch, 4), [0.01, 0.0, 0.0, 0.0])
    parametrize.register_parametrization(camera, "intrinsics", parametrization())
    optimizer = torch.optim.SGD(camera.parameters(), lr=1e-4)
    for _ in range(50):
        optimizer.zero_grad()
        pixels, valid = camera(POINTS.float().expand(*batch, -1, 3))
        assert valid.all()
        # it would have them negative, and not equal
        (pixels.new_tensor([1.0, 0.9]) * (pixels - 320).square()).sum().backward()
        optimizer.step()
    fx, fy = camera.fx.detach(), camera.fy.detach()
    assert (fx > 0).all()
    assert (fx < 3.9).all()
    assert torch.equal(fx, fy) == (parametrization is TiedFocal)


@PARAMETRIZATIONS
def test_parametrized_cameras_are_of_their_model(parametrization, tmp_path):
    intrinsics = torch.tensor([300.0, 300.0, 319.5, 239.5]).expand(2, 4)
    plain, camera = (ct.KannalaBrandt(intrinsics, [0.02, -0.01, 0.003, -0.001], image_size=(480, 640)) for _ in "ab")
    parametrize.register_parametrization(camera, "intrinsics", parametrization())
    for model in ("fisheye62", "kannala_brandt"):
        expected, conversion = plain.convert(model), camera.convert(model)
        assert conversion.source_name == "KannalaBrandt"
        assert type(conversion.camera) is ct.MODELS[model]
        assert torch.equal(conversion.exact, expected.exact)
        torch.testing.assert_close(conversion.max_error, expected.max_error, rtol=1e-3, atol=1e-6)
        assert all(p.requires_grad for p in conversion.camera.parameters())
    assert parametrize.is_parametrized(camera, "intrinsics")
    assert type(plain.convert(type(camera)).camera) is ct.KannalaBrandt
    assert not any(p.requires_grad for p in camera.requires_grad_(False).convert("fisheye62").camera.parameters())
    mean = ct.Pinhole([100.0, 400.0, 3.0, 4.0])
    parametrize.register_parametrization(mean, "intrinsics", TiedFocal())
    torch.testing.assert_close(mean.intrinsics.detach(), torch.tensor([200.0, 200.0, 3.0, 4.0]))
    turned = ct.augment.RandomMount(yaw=5)(image=torch.rand(2, 1, 480, 640), camera=camera)["camera"]
    assert type(turned) is ct.KannalaBrandt
    assert type(copy.deepcopy(camera).crop(1, 2, 30, 40)) is type(camera.resize(240, 320)) is ct.KannalaBrandt
    camera, plain = camera[1], plain[1]
    path = tmp_path / "camera.json"
    ct.save(camera, path)
    loaded = ct.load(path).cameras["camera"]
    assert type(loaded) is ct.KannalaBrandt
    torch.testing.assert_close(loaded.intrinsics, plain.intrinsics, check_dtype=False)


@each_kind
def test_a_step_to_a_negative_focal_length_is_said_once(key):
    camera = spread(key)
    with torch.no_grad():
        camera.intrinsics[0] = -3.0
    says = rf"{type(camera).__name__}: intrinsics became unusable: fx = -3 is not positive"
    says = rf"{says}.*PositiveFocal.* in {PositiveFocal.__module__}$"
    with pytest.warns(UserWarning, match=says):
        assert not camera.project(POINTS)[1].any()
    with torch.no_grad():
        camera.intrinsics[0] = -4.0
    assert not camera.project(POINTS)[1].any()  # a warning would be an error here
    assert not camera.unproject(POINTS[:, :2])[1].any()


@pytest.mark.skipif(torch.__version__.startswith("2.10."), reason="torch 2.10 compiles no Warp in one graph")
@pytest.mark.filterwarnings("ignore:.*became unusable")
def test_a_compiled_warp_of_a_bad_camera_shows_nothing():
    source = ct.KannalaBrandt([15.0, 15.0, 12.0, 9.0], [0.0, 0.0, 0.0, 0.0], image_size=(80, 96)).requires_grad_(False)
    source.distortion.data[0] = torch.nan
    target = ct.Pinhole([15.0, 15.0, 12.0, 9.0], image_size=(80, 96)).requires_grad_(False)
    warp = ct.Warp(source, target, tolerance=0.05)
    images = torch.rand(1, 1, 80, 96)
    assert torch.equal(warp(images), torch.zeros(1, 1, 80, 96))
    assert torch.equal(torch.compile(warp, fullgraph=True, backend="eager")(images), torch.zeros(1, 1, 80, 96))
