"""Laws of the augmentations: whatever the cameras, all fields of a sample move together."""

import copy
import math
import pickle

import pytest
import torch
from cameras import DISTINCT, KEYS, PAIRS, default_dtype_of_double, pinhole, slow_unless, spread

import camtorch as ct
from camtorch.augment import PRESETS, RandomCamera, RandomLens, RandomMount

# wide lenses for narrow images, on purpose
pytestmark = pytest.mark.filterwarnings("ignore:.*will show nothing")

A = ct.augment
SIZE = (240, 320)


def source(key):
    """A camera of any model, of about 75 degrees, with every coefficient away from zero."""
    camera = spread(key, torch.float32).requires_grad_(False).resize(*SIZE)
    camera.intrinsics[:2] *= 1.6
    return camera


def lattice(rows=4, columns=5, size=SIZE):
    v, u = torch.linspace(45, size[0] - 46, rows), torch.linspace(45, size[1] - 46, columns)
    return torch.cartesian_prod(v, u).flip(-1)


def discs(pixels, size=SIZE, radius=2.5, fine=5):
    """(N, H, W): one image of a bright disc for each pixel (N, 2), anti-aliased.

    Small ones: where a lens bends, the centroid of a large disc lies beside its centre, by the square of the radius.
    """
    offsets = (torch.arange(fine) + 0.5) / fine - 0.5
    v = (torch.arange(size[0])[:, None] + offsets).reshape(-1, 1)
    u = (torch.arange(size[1])[:, None] + offsets).reshape(-1)
    images = [((u - x) ** 2 + (v - y) ** 2 < radius**2).float() for x, y in pixels.tolist()]
    return torch.nn.functional.avg_pool2d(torch.stack(images)[:, None], fine)[:, 0]


def centroids(images):
    """(N, 2) of images (N, H, W)."""
    v, u = torch.meshgrid(*(torch.arange(float(side)) for side in images.shape[-2:]), indexing="ij")
    mass = images.sum((-1, -2))
    return torch.stack(((images * u).sum((-1, -2)) / mass, (images * v).sum((-1, -2)) / mass), -1)


def inner(pixels, valid, size=SIZE, margin=12):
    """Which moved points are so far from the rim that their disc is whole."""
    u, v = pixels.unbind(-1)
    return valid & (u > margin) & (u < size[1] - margin) & (v > margin) & (v < size[0] - margin)


# Every preset with some models, and some pairs of models: all would take minutes
WITH_PRESETS = [(i, KEYS[(5 * i + j) % len(KEYS)]) for j in range(2) for i in range(0, len(PRESETS), 2)]
WITH_MODELS = [(len(PRESETS) + KEYS.index(like), key) for like, key in PAIRS[::6]]
FEW = {WITH_PRESETS[0], WITH_MODELS[4]}


@pytest.mark.parametrize(("which", "key"), slow_unless(FEW.__contains__, WITH_PRESETS + WITH_MODELS))
def test_every_field_moves_together_between_any_two_models(key, which):
    """Keypoints sit on the discs, 3D points project onto keypoints through the camera that comes out, gaze is R g."""
    camera, like = source(key), [*PRESETS, *KEYS][which]
    like = like if like in PRESETS else source(like)
    torch.manual_seed(which)
    pixels = lattice()
    rays, seen = camera.unproject(pixels)
    points = rays * torch.linspace(0.4, 3, len(rays))[:, None]
    images = discs(pixels)
    gaze = torch.nn.functional.normalize(torch.randn(3), dim=-1)
    # shows at least a third of a narrow image: otherwise discs become too small to measure
    augmentation = RandomCamera(like, fov=(60, 90), camera=camera, yaw=12, pitch=12, roll=25)
    out = augmentation(image=images, keypoints=pixels, points=points, gaze=gaze)
    target, keypoints = out["camera"], out["keypoints"]
    use = inner(keypoints, out["keypoints_valid"] & seen)
    assert use.sum() > 5
    error = (centroids(out["image"])[use] - keypoints[use]).norm(dim=-1)
    # on the rim of these the scale falls to nothing along the azimuth, and a disc is no longer one
    steep = {key, getattr(like, "key", "")} & {"orthographic_fisheye", "division"}
    assert error.max() < (0.2 if steep else 0.1)
    projected, valid = target.project(out["points"])
    assert valid[use].all()
    assert (projected - keypoints)[use].norm(dim=-1).max() < 1e-2
    torch.testing.assert_close(out["gaze"], out["rotation"] @ gaze, atol=1e-6, rtol=0)
    back = augmentation.inverse(out)
    torch.testing.assert_close(back["keypoints"][use], pixels[use], atol=2e-3, rtol=0)
    torch.testing.assert_close(back["gaze"], gaze, atol=1e-6, rtol=0)
    torch.testing.assert_close(back["points"], points, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("angle", "moves"), [("yaw", (-1, 0)), ("pitch", (0, 1)), ("roll", None)])
def test_signs_of_the_angles(angle, moves):
    """Turning right moves the image left, looking up moves it down, leaning right turns it counterclockwise."""
    still, ten = dict.fromkeys(("yaw", "pitch", "roll"), (0, 0)), math.radians(10)
    augmentation = RandomMount(camera=pinhole(SIZE, 250.0), **{**still, angle: (10, 10)})
    centre = (torch.tensor(SIZE[::-1]) - 1) / 2
    pixel = centre if moves else centre + torch.tensor([100.0, 0.0])
    shift = augmentation(keypoints=pixel[None])["keypoints"][0] - pixel
    expected = torch.tensor([math.cos(ten) - 1, -math.sin(ten)]) * 100
    if moves:
        expected = torch.tensor(moves) * 250 * math.tan(ten)
    torch.testing.assert_close(shift, expected, atol=1e-3, rtol=0)


def sample(count=3, camera=None):
    generator = torch.Generator().manual_seed(5)

    def rand(*shape):
        return torch.rand(*shape, generator=generator)

    pose = torch.eye(4).repeat(count, 1, 1)
    pose[:, :3, :3] = ct.Extrinsics(rand(count, 3), torch.zeros(count, 3)).matrix()[:, :3, :3].detach()
    pose[:, :3, 3] = rand(count, 3) + torch.tensor([-0.5, -0.5, 1.0])
    return {
        "image": rand(count, 3, 60, 80),
        "mask": (5 * rand(count, 60, 80)).long(),
        "keypoints": rand(count, 7, 2) * torch.tensor([79.0, 59.0]),
        "boxes": torch.tensor([[10.0, 10, 40, 30], [30, 20, 70, 50]]).repeat(count, 1, 1),
        "polygons": rand(count, 2, 5, 2) * 50 + 5,
        "points": rand(count, 4, 3) + torch.tensor([-0.5, -0.5, 1.0]),
        "landmarks": rand(count, 4, 3),
        "gaze": torch.nn.functional.normalize(rand(count, 2, 3) - 0.5, dim=-1),
        "pitch_yaw": rand(count, 2) - 0.5,
        "head_pose": pose,
        "rvec": rand(count, 3),
        "tvec": rand(count, 3),
        "depth": rand(count, 1, 60, 80) + 1,
        "label": torch.arange(count),
        "name": [f"{i}.png" for i in range(count)],
        "camera": pinhole((60, 80), 60.0) if camera is None else camera,
    }


AUGMENTATIONS = {
    "mount": lambda **options: RandomMount(roll=30, zoom=(0.9, 1.2), **options),
    "lens": lambda **options: RandomLens(**options),
    "family": lambda **options: RandomLens("kannala_brandt", fov=(80, 110), **options),
    "camera": lambda **options: RandomCamera("dms130", chromatic=0.004, vignetting=(0.2, 0.5), **options),
    "filled": lambda **options: RandomCamera("dms130", fov="source", min_filled=0.9, **options),
    "chain": lambda **options: A.Compose([A.RandomResizedCrop((60, 80)), A.HorizontalFlip(), RandomLens()], **options),
}


def equal(a, b):
    """Whether two samples are the same, bit for bit."""
    assert a.keys() == b.keys()
    for name in a:
        if isinstance(a[name], torch.Tensor):
            assert torch.equal(a[name], b[name]), name
        elif isinstance(a[name], ct.Camera):
            assert type(a[name]) is type(b[name])
            for one, other in zip(a[name], b[name], strict=True) if a[name].batch_shape else [(a[name], b[name])]:
                assert type(one) is type(other)
                assert torch.equal(one.intrinsics, other.intrinsics)
                assert torch.equal(one.distortion, other.distortion)


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_a_batch_is_its_samples(name):
    augmentation, batch = AUGMENTATIONS[name](valid_mask=True), sample()
    draw = augmentation.draw(3, torch.Generator().manual_seed(0))
    out = augmentation(batch, draw=draw)
    for i in range(3):
        one = {k: v if k == "camera" else v[i] for k, v in batch.items()}
        alone = augmentation(one, draw={k: v[i : i + 1] for k, v in draw.items()})
        assert alone["camera"].batch_shape == ()
        for field, value in alone.items():
            if isinstance(value, torch.Tensor) and value.is_floating_point():
                torch.testing.assert_close(value, out[field][i], atol=2e-3, rtol=1e-4, msg=f"{field}: {{}}".format)
            elif isinstance(value, torch.Tensor):
                assert value.shape == out[field][i].shape
                assert (value != out[field][i]).float().mean() < 1e-3, field
            elif field == "name":
                assert value == out[field][i]


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_replay_is_bit_identical(name, tmp_path):
    augmentation, batch = AUGMENTATIONS[name](p=0.6), sample(5)
    draw = augmentation.draw(5, torch.Generator().manual_seed(1))
    torch.save(draw, tmp_path / "draw.pt")
    again = torch.load(tmp_path / "draw.pt", weights_only=True)
    with default_dtype_of_double():
        equal(draw, augmentation.draw(5, torch.Generator().manual_seed(1)))
    first = augmentation(batch, draw=draw)
    equal(first, augmentation(batch, draw=again))
    equal(first, copy.deepcopy(augmentation)(batch, draw=draw))
    copied = pickle.loads(pickle.dumps(augmentation))
    assert (copied.last, repr(copied)) == (None, repr(augmentation))
    equal(first, copied(batch, draw=draw))
    labels = {k: v for k, v in batch.items() if k in ("keypoints", "camera", "gaze")}
    alone = augmentation(labels, draw=draw)
    assert torch.equal(alone["keypoints"], first["keypoints"])
    assert torch.equal(alone["gaze"], first["gaze"])


@pytest.mark.parametrize("name", ["mount", "family"])
def test_skipped_samples_stay_bit_identical(name):
    augmentation, batch = AUGMENTATIONS[name](p=0.5), sample(8)
    draw = augmentation.draw(8, torch.Generator().manual_seed(2))
    out = augmentation(batch, draw=draw)
    skipped = ~draw["apply"]
    assert 0 < skipped.sum() < 8
    for field, value in batch.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(out[field][skipped], value[skipped]), field
            if field in ("image", "keypoints") or (name == "mount" and field in ("gaze", "head_pose", "rvec")):
                assert not torch.equal(out[field][~skipped], value[~skipped]), field
    assert torch.equal(out["rotation"][skipped], torch.eye(3).expand(int(skipped.sum()), 3, 3))
    if name == "family":  # of two models, so they come one by one
        assert [c.key for c in out["camera"]] == ["kannala_brandt" if a else "pinhole" for a in draw["apply"]]
    else:
        assert torch.equal(out["camera"].intrinsics[skipped][0], batch["camera"].intrinsics)


def test_ranges_of_a_chain_are_those_of_its_parts():
    chain = ct.augment.Compose([ct.augment.RandomMount(yaw=5)])
    with pytest.raises(AttributeError, match="ranges must be those of the parts"):
        chain.ranges = {"yaw": ct.augment.Range(1, 2)}
    chain.augmentations[0].ranges["yaw"] = ct.augment.Range(1, 2)
    assert chain.ranges["0.yaw"] == ct.augment.Range(1, 2)


def test_chains_carry_validity_on():
    batch = {k: v for k, v in sample().items() if k != "depth"}
    half = RandomMount(yaw=25, valid_mask=True)(batch)
    out = RandomLens("kannala_brandt", fov=(70, 90), valid_mask=True)(half)
    assert not out["keypoints_valid"][~half["keypoints_valid"]].any()
    warp = ct.Warp(batch["camera"], out["camera"], out["rotation"])
    # nothing is valid twice that one warp would not see, but for the rim of the image in between
    assert (out["image_valid"] & ~warp.valid_mask()).float().mean() < 0.01
    straight, _ = warp.transform_points(batch["camera"].project(batch["points"])[0])
    torch.testing.assert_close(out["camera"].project(out["points"])[0], straight, atol=1e-3, rtol=0)


def test_poses_turn_with_the_camera():
    batch = sample()
    out = RandomMount(roll=60)(batch)
    rotation = out["rotation"]
    torch.testing.assert_close(out["head_pose"][:, :3], rotation @ batch["head_pose"][:, :3], atol=1e-6, rtol=0)
    assert torch.equal(out["head_pose"][:, 3], batch["head_pose"][:, 3])
    head, straight = torch.rand(3, 9, 3), ct.augment.from_pitch_yaw
    after, before = (ct.Extrinsics(s["rvec"], s["tvec"])(head) for s in (out, batch))
    torch.testing.assert_close(after, before @ rotation.mT, atol=2e-6, rtol=0)
    gaze = rotation @ straight(batch["pitch_yaw"])[..., None]
    torch.testing.assert_close(straight(out["pitch_yaw"]), gaze[..., 0], atol=1e-6, rtol=0)
    assert torch.equal(straight(torch.zeros(2)), torch.tensor([0.0, 0.0, -1.0]))
    one = RandomMount(camera=batch["camera"])(gaze=torch.rand(2, 3), rvec=batch["rvec"][0])  # both eyes of a head
    assert one["rotation"].shape == (3, 3)


def test_jittered_lenses_stay_invertible_and_bounded():
    for key, amount in [(key, 0.05) for key in KEYS] + [(key, 1.0) for key in sorted(DISTINCT)]:
        camera = source(key)
        change = RandomLens(camera=camera, focal=(1, 1), centre=(0, 0), distortion=amount).change(
            None, RandomLens(focal=(1, 1), centre=(0, 0), distortion=amount).draw(8, torch.Generator().manual_seed(0))
        )
        edge = torch.cat((camera.pixel_grid()[[0, -1]].reshape(-1, 2), camera.pixel_grid()[:, [0, -1]].reshape(-1, 2)))
        rays, seen = camera.unproject(edge)
        target = change.target
        still = target.unproject(edge.expand(8, -1, -1))[1]
        assert (still | ~seen).all(), key
        moved, valid = target.project(rays.expand(8, -1, -1))
        if target.distortion.shape[-1] and amount < 1:
            shift = (moved - edge).norm(dim=-1)[valid & seen].max() / math.hypot(SIZE[0] / 2, SIZE[1] / 2)
            assert amount / 50 < shift < 1.5 * amount, key
            moved = change.target.distortion.std(0) > 0
            assert moved.any() if key in ("tabulated", "splined") else moved.all()  # these go on beyond the image


def test_a_family_has_the_field_of_view_that_is_asked_for():
    for key, degrees in {"kannala_brandt": 130, "pinhole": 100, "equirectangular": 200, "fisheye62": 150}.items():
        lens = RandomLens(key, fov=degrees, focal=None, centre=None, distortion=None, camera=pinhole(SIZE, 250.0))
        target = lens.change(None, lens.draw(1)).target
        ends = torch.tensor([[-0.5, (SIZE[0] - 1) / 2], [SIZE[1] - 0.5, (SIZE[0] - 1) / 2]])
        left, right = target.unproject(ends.expand(1, -1, -1))[0][0]
        across = math.degrees(math.atan2(-left[0], left[2]) + math.atan2(right[0], right[2]))
        assert abs(across - degrees) < 1e-2, key


def test_presets_show_what_they_say():
    across = {"webcam": 67, "dms60": 60, "dms90": 93, "dms130": 130, "surround190": 190, "tumvi": 154, "aria": 151}
    for name, degrees in {**across, "aria_rgb": 115}.items():
        camera = PRESETS[name].camera()
        assert not any(p.requires_grad for p in camera.parameters())
        width = camera.image_size[1]
        _, _, _, cy = camera.intrinsics.tolist()
        rays, valid = camera.unproject(torch.tensor([[u, cy] for u in range(width)]))
        angles = torch.atan2(rays[:, 0], rays[:, 2])[valid].rad2deg()
        assert abs(float(angles.max() - angles.min()) - degrees) < 1, name


def test_output_size_and_light():
    camera = pinhole(SIZE, 250.0)
    out = RandomCamera(
        "webcam", camera=camera, image_size=(60, 90), vignetting=0.6, centre=(0, 0), yaw=0, pitch=0, roll=0
    )(image=torch.ones(1, 3, *SIZE), keypoints=lattice()[None])
    assert out["image"].shape == (1, 3, 60, 90)
    assert out["camera"].image_size == (60, 90)
    light = out["image"][0, 0]
    assert light[30, 45] > 0.98
    outside = torch.nn.functional.pad((light == 0).float()[None], (2, 2, 2, 2), value=1)  # its border blends
    inside = torch.nn.functional.max_pool2d(outside, 5, 1)[0] == 0
    assert 0.35 < light[inside].min() < 0.7


def test_chromatic_aberration_scales_red_and_blue():
    camera = pinhole(SIZE, 250.0)
    pixels = lattice()[[0, 4, 15, 19]]
    images = discs(pixels)[:, None].expand(-1, 3, -1, -1)
    lens = RandomLens(camera=camera, focal=None, centre=None, distortion=None, chromatic=(0.01, 0.02))
    draw = lens.draw(4, torch.Generator().manual_seed(0))
    out = lens(image=images, keypoints=pixels[:, None], draw=draw)
    centre = (torch.tensor(SIZE[::-1]) - 1) / 2
    green = centroids(out["image"][:, 1]) - centre
    torch.testing.assert_close(green, pixels - centre, atol=0.02, rtol=0)
    for channel, column in ((0, 0), (2, 1)):
        shifted = centroids(out["image"][:, channel]) - centre
        torch.testing.assert_close(shifted, green * (1 + draw["chromatic"][:, column, None].float()), atol=0.05, rtol=0)
    grey = lens(image=images[:, :1], draw=draw)["image"]
    torch.testing.assert_close(grey, out["image"][:, 1:2])


@pytest.mark.parametrize("own", [0.0, (0.1, 0.2, 0.3)])
def test_a_given_fill_counts_for_each_colour(own):
    camera, images = pinhole(SIZE, 250.0), torch.rand(2, 3, *SIZE)
    still = {"camera": camera, "zoom": (0.5, 0.5), "min_filled": 0, "fill": own}
    shifted = RandomMount(chromatic=(0.01, 0.01), **still)
    shifted(image=images)
    for fill in (0.5, [0.5], (0.4, 0.5, 0.6), torch.tensor([0.4, 0.5, 0.6])):
        corner = shifted.last.images(images, fill=fill)[:, :, 0, 0]
        assert torch.equal(corner, torch.as_tensor(fill).expand(2, 3)), fill
    assert torch.equal(shifted.last.images(images)[:, :, 0, 0], torch.as_tensor(own).expand(2, 3))
    with pytest.raises(ValueError, match="fill must have 1 value or 3, one for each channel; got 2"):
        shifted.last.images(images, fill=(0.4, 0.5))


def test_empty_batches():
    empty = {k: v[:0] if isinstance(v, torch.Tensor) else v for k, v in sample().items()}
    makers = [lambda make=make: make(image_size=(30, 40)) for name, make in AUGMENTATIONS.items() if name != "chain"]
    makers += [lambda: A.RandomResizedCrop((30, 40)), lambda: A.Compose([A.Resize((30, 40)), A.HorizontalFlip()])]
    for make in makers:
        out = make()(empty)
        assert out["image"].shape == (0, 3, 30, 40)
        assert out["keypoints_valid"].shape == (0, 7)
        assert out["camera"].batch_shape == (0,)
    shifted = RandomMount(shift=(0.1,) * 3)({**empty, "depth": empty["image"][:, :1]})
    assert shifted["depth"].shape == (0, 1, *empty["image"].shape[-2:])
    for make in (RandomMount(), A.HorizontalFlip(1.0, landmarks={"keypoints": "ibug68"})):
        out = make({**sample(), "keypoints": torch.zeros(3, 0, 2), "boxes": torch.zeros(3, 0, 4)})
        assert out["keypoints"].shape == (3, 0, 2)
        assert out["boxes_valid"].shape == (3, 0)


def test_gradients_reach_images_labels_and_a_learning_camera():
    camera = ct.KannalaBrandt([60.0, 60, 39.5, 29.5], [0.02, -0.01, 0.003, -0.001], image_size=(60, 80))
    batch = sample(2, camera)
    batch["image"].requires_grad_()
    batch["keypoints"].requires_grad_()
    out = RandomCamera("dms130")(batch)
    (out["image"].square().mean() + out["keypoints"][out["keypoints_valid"]].mean()).backward()
    for tensor in (batch["image"], batch["keypoints"], camera.intrinsics, camera.distortion):
        assert torch.isfinite(tensor.grad).all()
        assert tensor.grad.abs().sum() > 0


def test_autocast_moves_nothing():
    batch, augmentation = sample(), RandomCamera("aria")
    draw = augmentation.draw(3)
    plain = augmentation(batch, draw=draw)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = augmentation(batch, draw=draw)
    for name in ("keypoints", "points", "gaze", "rotation", "head_pose"):
        torch.testing.assert_close(cast[name], plain[name], atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(cast["image"], plain["image"], atol=1e-3, rtol=0)


def test_padding_and_fill():
    batch = sample()
    mount = {"yaw": (40, 40), "pitch": (0, 0), "roll": (0, 0), "tolerance": 0}  # a lattice may differ by padding
    black, grey = (RandomMount(**mount, fill=fill, mask_fill=9, valid_mask=True)(batch) for fill in (0.0, 0.5))
    border = RandomMount(**mount, padding_mode="border")(batch)["image"]
    seen = black["image_valid"].expand_as(border)
    assert 0.1 < seen.float().mean() < 0.9
    inside, outside = (torch.nn.functional.max_pool2d(w.float(), 7, 1, 3) == 0 for w in (~seen, seen))
    torch.testing.assert_close(black["image"][inside], grey["image"][inside])
    assert (grey["image"][outside] == 0.5).all()
    assert (black["mask"][~seen[:, 0]] == 9).all()
    assert (border[outside] > 0).any()
    # which cells are interpolated depends on the padding: 0.001 px of an image whose pixels differ by 1 at the most
    torch.testing.assert_close(border[inside], black["image"][inside], atol=1e-3, rtol=0)


def test_vignetting_reaches_its_share_in_the_farthest_corner():
    lens = RandomLens(vignetting=0.5, focal=None, centre=None, distortion=None, camera=pinhole((7, 9), 9.0))
    light = lens(image=torch.ones(3, 7, 9))["image"][0]
    assert light[0, 0].item() == pytest.approx(0.5, abs=1e-3)
    assert light[3, 4].item() == pytest.approx(1, abs=1e-3)


def test_a_part_of_a_chain_may_be_the_same_on_a_batch():
    chain = A.Compose([RandomMount(same_on_batch=True), RandomLens()], camera=pinhole(SIZE, 250.0))
    draw = chain.draw(4)
    assert len(set(draw["0.yaw"].tolist())) == 1
    assert len(set(draw["1.focal"].tolist())) == 4


@pytest.mark.parametrize("first", [RandomMount, A.VerticalFlip])
@pytest.mark.parametrize("second", [RandomMount, A.VerticalFlip, lambda **given: RandomLens("dms130", **given)])
@pytest.mark.parametrize("batched", [False, True])
def test_changes_in_turn_keep_the_options_of_the_second(first, second, batched):
    camera = pinhole(SIZE, 250.0)
    options = {"mode": "nearest", "fill": 0.5, "tolerance": 0.0}
    one, other = first(camera=camera, p=1.0), second(camera=camera, p=1.0, **options)
    count = 3 if batched else 1
    before = one.change(camera, one.draw(count))
    after = other.change(before.target, other.draw(count))
    (part,) = before.then(after).parts
    assert part.warp.options == after.parts[0].warp.options
    assert (part.warp.options["mode"], part.warp.options["fill"]) == ("nearest", (0.5,))


@pytest.mark.parametrize("shape", [(3,), (2, 3), (2, 4, 3)])
def test_inverse_takes_the_new_camera_as_a_keyword(shape):
    camera, augment = ct.Pinhole.from_fov(70, image_size=(24, 32)), A.RandomMount(zoom=(2, 3))
    out = augment(image=torch.rand(*shape, 24, 32), camera=camera)
    assert torch.equal(augment.inverse(out)["image"], augment.inverse(**out)["image"])
    with pytest.raises(ValueError, match="must be those that this change made"):
        augment.inverse(image=out["image"], camera=camera)
