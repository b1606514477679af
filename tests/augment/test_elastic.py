"""Elastic images: labels by a dense evaluation of the surface, one warp for the image, any camera."""

import copy
import pickle

import numpy as np
import pytest
import torch
from cameras import one

import camtorch as ct

KEYS = "pinhole", "brown_conrady", "kannala_brandt", "fisheye624", "double_sphere"


def sample_of(camera, seed=0):
    generator = torch.Generator().manual_seed(seed)
    height, width = camera.image_size
    places = torch.rand(40, 2, generator=generator, dtype=torch.float64) * torch.tensor([width - 1, height - 1])
    grid = camera.pixel_grid().movedim(-1, 0).float()
    return {"image": torch.cat((grid, grid[:1] * 0)), "keypoints": places, "gaze": torch.tensor([[0.1, 0.2, -1]])}


def dense(bends, amount, grid, size, places):
    """Where places go, by all control points at once, in pixels: cubic B-splines as their recursion has them."""
    height, width = size
    down, across = grid
    values = amount * min(size) * bends.reshape(down + 4, across + 4, 2)

    def spline(x):  # around 0, of support (-2, 2)
        x = np.abs(x)
        return np.where(x < 1, 2 / 3 - x**2 + x**3 / 2, np.where(x < 2, (2 - x) ** 3 / 6, 0))

    u = (places[:, 0] - (width - 1) / 2) * across / width + (across + 3) / 2
    v = (places[:, 1] - (height - 1) / 2) * down / height + (down + 3) / 2
    of_u = spline(u[:, None] - np.arange(across + 4))
    of_v = spline(v[:, None] - np.arange(down + 4))
    return places + np.einsum("nj,ni,jic->nc", of_v, of_u, values)


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("grid", [6, (3, 5)])
def test_keypoints_are_a_dense_evaluation_of_the_surface(key, grid):
    camera = one(key).requires_grad_(False)
    elastic = ct.augment.RandomElastic(amount=(0.01, 0.03), grid=grid, camera=camera)
    draw = elastic.draw(1, torch.Generator().manual_seed(3))
    warp = elastic.change(camera, draw).parts[0].warp
    sample = sample_of(camera)
    moved, valid = warp.transform_points(sample["keypoints"])
    amount, bends = draw["amount"].item(), draw["bends"].numpy()
    expected = dense(bends, amount, elastic.grid, camera.image_size, sample["keypoints"].numpy())
    known = camera.unproject(sample["keypoints"])[1]
    there = known & camera.contains(torch.from_numpy(expected))
    assert torch.equal(valid.view(-1), there)
    assert there.sum() > 15
    np.testing.assert_allclose(moved.view(-1, 2)[there].numpy(), expected[there], rtol=0, atol=1e-6)
    assert np.abs(expected - sample["keypoints"].numpy()).max() > 1
    back, _ = warp.inverse().transform_points(moved.view(-1, 2)[there])
    torch.testing.assert_close(back.view(-1, 2), sample["keypoints"][there], rtol=0, atol=1e-6)


@pytest.mark.parametrize("key", KEYS)
def test_the_image_moves_as_the_keypoints_do(key):
    camera = one(key).float().requires_grad_(False)
    sample = sample_of(camera) | {"keypoints": sample_of(camera)["keypoints"].float()}
    torch.manual_seed(1)
    out = ct.augment.RandomElastic(amount=0.03, camera=camera)(sample)
    height, width = camera.image_size
    places = out["keypoints"] * 2 / torch.tensor([width, height]) + 1 / torch.tensor([width, height]) - 1
    shown = torch.nn.functional.grid_sample(out["image"][None], places[None, None], align_corners=False)[0, :2, 0].T
    inside = out["keypoints_valid"] & ((sample["keypoints"] > 4) & (sample["keypoints"] < width - 20)).all(-1)
    inside &= ((out["keypoints"] > 2) & (out["keypoints"] < torch.tensor([width - 3, height - 3]))).all(-1)
    inside &= (shown - sample["keypoints"]).norm(dim=-1) < 20  # the rim of a lens mixes with what is empty
    assert inside.sum() > 10
    # images are read with bilinear weights, twice
    assert (shown - sample["keypoints"])[inside].abs().max() < 0.05
    assert torch.equal(out["gaze"], sample["gaze"])
    rays = camera.unproject(sample["keypoints"])[0]
    seen, valid = out["camera"].project(rays)
    torch.testing.assert_close(seen[valid & inside], out["keypoints"][valid & inside], rtol=0, atol=2e-3)


@pytest.mark.parametrize("side", [64, 128, 256])
@pytest.mark.parametrize("grid", [3, 4, 6, 12])
def test_images_keep_the_tolerance_and_do_not_hang_on_the_batch(side, grid):
    """Cells of a lattice that cubics, the surface's slopes or Newton's steps lay, on small images too."""
    camera = ct.BrownConrady([1.1 * side] * 2 + [side / 2] * 2, [0.1, -0.05, 0.001, -0.001, 0], image_size=(side, side))
    elastic = ct.augment.RandomElastic(amount=0.02, grid=grid, camera=camera.requires_grad_(False))
    image = torch.rand(1, side, side, generator=torch.Generator().manual_seed(0))
    for seed in range(3):
        draw = elastic.draw(1, torch.Generator().manual_seed(seed))
        alone = elastic({"image": image}, draw=draw)
        batch = elastic({"image": image[None]}, draw=draw)
        assert torch.equal(alone["image"], batch["image"][0])
        assert torch.equal(alone["camera"].distortion, batch["camera"].distortion.view(-1))
        exact = ct.Warp(copy.deepcopy(camera).double(), copy.deepcopy(alone["camera"]).double(), tolerance=0.0)
        off = (exact.grid() - ct.Warp(camera, alone["camera"]).grid())[exact.valid_mask()[:, 0]].norm(dim=-1)
        assert off.max() * side / 2 < 0.001


def test_batches_front_ends_and_cut_images():
    camera = ct.KannalaBrandt([250.0, 250, 320, 240], [0.05, -0.01, 0, 0], image_size=(480, 640)).requires_grad_(False)
    face = camera.crop(40, 420, 64, 64)  # whose principal point lies far outside
    elastic = ct.augment.RandomElastic(amount=0.02, camera=face)
    out = elastic({"image": torch.rand(3, 1, 64, 64), "keypoints": torch.full((3, 5, 2), 30.0)})
    assert out["keypoints_valid"].all()
    assert 0.1 < (out["keypoints"] - 30).norm(dim=-1).max() < 3
    assert (out["image"] > 0).double().mean() > 0.9
    chain = ct.augment.Compose([ct.augment.HorizontalFlip(p=1.0), elastic, ct.augment.RandomMount(yaw=3, min_filled=0)])
    assert chain({"image": torch.rand(3, 1, 64, 64), "camera": face})["image"].shape == (3, 1, 64, 64)
    one_image = elastic({"image": torch.rand(1, 64, 64)})
    again = pickle.loads(pickle.dumps(one_image["camera"]))
    for other in (again, copy.deepcopy(one_image["camera"])):
        assert type(other) is type(one_image["camera"])
    flipped = one_image["camera"].hflip()
    rays, valid = one_image["camera"].unproject(torch.tensor([[20.0, 30.0], [40.0, 11.0]]))
    assert valid.all()
    pixels = flipped.project(rays * torch.tensor([-1.0, 1, 1]))[0]
    torch.testing.assert_close(63 - pixels[:, 0], torch.tensor([20.0, 40.0]), rtol=0, atol=1e-3)


def test_surfaces_of_many_and_of_few_control_points_are_the_formula():
    """Up to a number of them they become polynomials, piece by piece."""
    camera = ct.KannalaBrandt([600.0, 600, 320, 240], [0.01, 0, 0, 0], image_size=(480, 1400)).requires_grad_(False)
    counts = []
    for left in (200, 1100):
        elastic = ct.augment.RandomElastic(amount=0.005, grid=24, camera=camera.double().crop(120, left, 240, 240))
        bent = elastic({"keypoints": torch.rand(5, 2).double()})["camera"]
        counts.append(bent.distortion.numel() // 2)
        pixels = bent.pixel_grid()[::9, ::9].reshape(-1, 2).double()
        rays, valid = bent.unproject(pixels)
        assert valid.double().mean() > 0.9
        torch.testing.assert_close(rays, torch.func.vmap(bent.unproject)(pixels)[0], rtol=0, atol=1e-9)
        torch.testing.assert_close(bent.project(rays)[0][valid], pixels[valid], rtol=0, atol=1e-9)
    assert counts[0] < 64 * 64 < counts[1] - 4


@pytest.mark.parametrize("key", ["splined", "splined:order=2,columns=9,rows=5,fov_x=120", "kannala_brandt"])
@pytest.mark.parametrize("windshield", [False, True])
def test_it_goes_through_pickles_and_files_whatever_it_was_before(key, windshield, tmp_path):
    plain = one("kannala_brandt").convert(key).camera if ":" in key else one(key)
    if windshield:
        plain = plain.behind(ct.Windshield([0.0, 0.99, 0.01], [0.0, 0.0, 1.0]))
    bent = ct.augment.RandomElastic()(camera=plain.double(), keypoints=torch.rand(2, 2))["camera"]
    ct.save(bent, tmp_path / "bent.json")
    for other in (pickle.loads(pickle.dumps(bent)), ct.load(tmp_path / "bent.json").camera):
        assert type(other) is type(bent)
        assert torch.equal(other.distortion, bent.distortion.double())


def test_files_hold_it(tmp_path):
    camera = ct.Pinhole.from_fov(60, image_size=(48, 64)).double().requires_grad_(False)
    elastic = ct.augment.RandomElastic(amount=0.03, grid=6)
    bent = elastic({"image": torch.rand(1, 48, 64), "camera": camera})["camera"]
    ct.save(bent, tmp_path / "bent.json")
    found = ct.load(tmp_path / "bent.json").camera
    assert found.key == bent.key == "pinhole:elastic=10,10"
    rays = camera.rays()[0]
    torch.testing.assert_close(found.project(rays)[0], bent.project(rays)[0].double(), rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match="elastic already"):
        ct.augment.RandomElastic(camera=bent)({"image": torch.rand(1, 48, 64)})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"amount": 0.1, "grid": 6}, "amount must be below 0.0417 for 6 cells"),
        ({"amount": 0.1}, "amount must be below 0.0625 for 4 cells"),
        ({"amount": (-0.01, 0.01)}, "amount must lie within"),
        ({"grid": 0}, "grid must be from 1 to 32 cells"),
        ({"grid": (3, 4, 5)}, "grid must be"),
        ({"alpha": 30}, "did you mean 'amount'"),
    ],
)
def test_what_is_refused(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        ct.augment.RandomElastic(**options)


ALONE = {"fov", "division", "cylindrical", "equirectangular", "latlon", "transverse_cylindrical"}


@pytest.mark.parametrize("way", ["native", "formula"])
@pytest.mark.parametrize("key", sorted(set(ct.MODELS) - ALONE))
def test_an_elastic_camera_of_any_model_ends_where_its_own_does(key, way):
    plain = one(key).double().requires_grad_(False)
    camera = ct.augment.RandomElastic()(camera=plain, keypoints=torch.rand(2, 2))["camera"]
    pixels = torch.rand(500, 2, generator=torch.Generator().manual_seed(3)).double()
    pixels = pixels * torch.tensor([plain.width, plain.height]) - 0.5
    rays, valid = camera.unproject(pixels) if way == "native" else torch.func.vmap(camera.unproject)(pixels)
    seen, back = camera.project(rays[valid])
    assert back.all()
    assert valid.any()
    torch.testing.assert_close(seen, pixels[valid], rtol=0, atol=1e-6)


@pytest.mark.parametrize("xi", [-0.27, 0.3, 1.3])
@pytest.mark.parametrize("alpha", [0.0, 0.55, 0.8])
def test_an_elastic_double_sphere_ends_at_both_of_its_folds(xi, alpha):
    plain = ct.DoubleSphere([150.0, 150, 319.5, 239.5], [xi, alpha], image_size=(480, 640)).double()
    plain.requires_grad_(False)
    camera = ct.augment.RandomElastic(amount=1e-9)(camera=plain, keypoints=torch.rand(2, 2))["camera"]
    pixels = torch.cartesian_prod(torch.linspace(0, 639, 33), torch.linspace(0, 479, 25)).double()
    for unproject in (camera.unproject, torch.func.vmap(camera.unproject)):
        rays, valid = unproject(pixels)
        assert (valid == plain.unproject(pixels)[1]).double().mean() > 0.99  # but for pixels at the fold
        seen, back = camera.project(rays[valid])
        assert back.all()
        torch.testing.assert_close(seen, pixels[valid], rtol=0, atol=1e-6)


@pytest.mark.parametrize("key", sorted(ALONE))
def test_a_model_that_no_lens_follows_is_refused(key):
    with pytest.raises(ValueError, match=f"no surface can follow {ct.MODELS[key].__name__}"):
        ct.augment.RandomElastic()(camera=one(key).requires_grad_(False), keypoints=torch.rand(2, 2))
