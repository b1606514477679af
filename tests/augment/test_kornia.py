import copy
import inspect
import io
import pickle
import runpy

import kornia.augmentation as K  # noqa: N812
import pytest
import torch
from kornia.augmentation.container.params import ParamItem
from kornia.geometry.boxes import Boxes
from kornia.geometry.keypoints import Keypoints

import camtorch as ct
from camtorch import augment
from camtorch.augment import kornia as adapter
from camtorch.augment.kornia import private

HEIGHT, WIDTH = SIZE = 96, 128
CLASSES = adapter.RandomMount, adapter.RandomLens, adapter.RandomCamera
KEYS = ["input", "mask", "keypoints", "bbox"]


def camera():
    numbers = [95.0, 96.0, 62.5, 48.25], [-0.2, 0.05, 0.001, -0.001, 0.0]
    return ct.BrownConrady(*numbers, image_size=SIZE).requires_grad_(False)


def images(count=3, channels=1, size=SIZE):
    seeded = torch.Generator().manual_seed(1)
    return torch.rand(count, channels, *size, generator=seeded)


def points(count=3, number=5):
    seeded = torch.Generator().manual_seed(2)
    return torch.rand(count, number, 2, generator=seeded) * torch.tensor([WIDTH * 0.6, HEIGHT * 0.6]) + 20


def masks(count=3):
    seeded = torch.Generator().manual_seed(3)
    return torch.randint(0, 200, (count, 1, *SIZE), generator=seeded)


def vertices(count=3):
    corners = torch.tensor([[[30.0, 25.0], [70.0, 25.0], [70.0, 60.0], [30.0, 60.0]]])
    return corners.expand(count, 1, 4, 2).contiguous()


def batch(count=3):
    return images(count), masks(count), points(count), vertices(count)


def equal(first, second):
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_a_made_augmentation_brings_its_camera_p_and_same_on_batch():
    made = augment.RandomMount(camera=camera(), p=0.25, same_on_batch=True)
    aug = adapter.CameraAugmentation(made)
    assert (aug.p, aug.same_on_batch) == (0.25, True)
    assert torch.equal(aug.camera.intrinsics, made.camera.intrinsics)
    assert adapter.CameraAugmentation(made, camera(), p=1.0).p == 1
    assert "yaw=(-10, 10)" in repr(aug)


@pytest.mark.parametrize("key", ["bbox_xywh", "bbox_xyxy", "bbox"])
def test_boxes_off_the_image_are_zeros_and_stay_that(key):
    corners = vertices(2).repeat(1, 2, 1, 1)
    corners[:, 1] += 4000
    own, kind = Boxes(corners.clone()), {"bbox": "vertices_plus"}.get(key, key.removeprefix("bbox_"))
    boxes = Boxes(corners).to_tensor(kind)
    aug = adapter.RandomMount(camera())
    seq = K.AugmentationSequential(aug, K.RandomHorizontalFlip(p=1.0), data_keys=["input", key])
    image, moved = seq(images(2), boxes)
    valid = aug.transform_boxes(own, aug._params, aug.flags)._valid
    assert valid.tolist() == [[True, False]] * 2
    assert torch.equal(own.data, corners)
    assert own._valid.all()
    _, back = seq.inverse(image, moved)
    for value in (moved, back):
        assert (value[:, 1] == 0).all()
        assert (value[:, 0] != 0).all()


def test_masks_keep_class_ids_and_lists_are_warped_one_by_one():
    aug = adapter.RandomCamera(camera(), mask_fill=255, tolerance=0.0)
    seq = K.AugmentationSequential(aug, data_keys=["input", "mask", "keypoints"])
    _, together, moved = seq(images(), masks(), points())
    assert together.dtype == torch.int64
    assert set(together.unique().tolist()) <= {*range(200), 255}
    params = seq._params
    _, listed, again = seq(images(), list(masks()), points(), params=params)
    assert equal([mask.reshape(1, *SIZE) for mask in listed], together)
    assert torch.equal(moved, again)
    assert aug.last.count == 3
    assert torch.equal(seq(images(), masks()[:, 0], points(), params=params)[1], together)


def test_same_on_batch_and_p_batch():
    same = images(1).expand(3, -1, -1, -1)
    # a container overrides what its children say
    all_alike = K.AugmentationSequential(adapter.RandomCamera(camera()), same_on_batch=True)
    for one in (adapter.RandomCamera(camera(), same_on_batch=True), all_alike):
        warped = one(same)
        assert torch.equal(warped[0], warped[2])
        assert not torch.equal(warped[0], same[0])
    for p, gates in ((0.0, {(0.0,) * 3}), (0.5, {(0.0,) * 3, (1.0,) * 3})):
        aug, applied = adapter.RandomCamera(camera(), p_batch=p), set()
        for _ in range(8):
            assert torch.equal(aug(same), same) == (aug._params["batch_prob"] == 0).all()
            applied.add(tuple(aug._params["batch_prob"].tolist()))
        assert applied == gates


def test_keepdim_and_images_without_batch():
    image = images(1, 3)[0]
    assert adapter.RandomMount(camera())(image).shape == (1, 3, *SIZE)
    kept = adapter.RandomMount(camera(), keepdim=True)
    assert kept(image).shape == (3, *SIZE)
    assert kept(image[0]).shape == SIZE
    assert kept.inverse(kept(image)).shape == (3, *SIZE)
    seq = K.AugmentationSequential(kept, data_keys=["input", "mask"], keepdim=True)
    assert [value.shape for value in seq(image, masks(1)[0])] == [(3, *SIZE), (1, *SIZE)]
    flat = masks(2)[:, 0]
    assert [v.shape for v in seq.inverse(*seq(images(2), flat))] == [(2, 1, *SIZE), flat.shape]


@pytest.mark.parametrize("p", [1.0, 0.5])
@pytest.mark.parametrize("cls", CLASSES)
def test_replays_are_bit_identical(cls, p):
    flip = K.RandomHorizontalFlip(p=0.5)
    seq, fresh = (K.AugmentationSequential(cls(camera(), p=p), flip, data_keys=KEYS) for _ in range(2))
    data = batch()
    first, params = seq(*data), seq._params
    for item in params:
        assert all(isinstance(v, torch.Tensor) and v.device.type == "cpu" for v in item.data.values())
    file = io.BytesIO()
    torch.save(params, file)
    file.seek(0)
    with torch.serialization.safe_globals([ParamItem]):
        loaded = torch.load(file, weights_only=True)
    assert equal(fresh(*data[1:], params=loaded, data_keys=KEYS[1:]), first[1:])
    for twin in (fresh, copy.deepcopy(seq), pickle.loads(pickle.dumps(seq))):
        assert equal(twin(*data, params=loaded), first)
        assert torch.equal(twin[0].last.rotation, seq[0].last.rotation)
    seq(*data)
    assert equal(seq(*data, params=params), first)
    assert copy.deepcopy(cls(camera())).last is None


@pytest.mark.parametrize("cls", CLASSES)
def test_inverse(cls):
    smooth = torch.nn.functional.interpolate(images(3, 1, (8, 10)), SIZE, mode="bicubic")
    blocks = (smooth > 0.5).long()
    seq = K.AugmentationSequential(cls(camera()), K.RandomHorizontalFlip(p=1.0), data_keys=KEYS)
    image, mask, moved, boxes = seq.inverse(*seq(smooth, blocks, points(), vertices()))
    inner = (slice(None), slice(None), slice(36, 60), slice(48, 80))
    assert (image - smooth)[inner].abs().max() < 0.05
    assert (mask != blocks)[inner].float().mean() < 0.05
    assert (moved - points()).abs().max() < 1e-3
    assert (boxes[:, :, 0] <= vertices()[:, :, 0]).all()
    assert (boxes[:, :, 2] >= vertices()[:, :, 2]).all()
    assert (boxes - vertices()).abs().max() < 15
    assert torch.isfinite(seq[0].inverse(smooth)).all()


MOVES = augment.RandomMount(camera=60, p=0.5), augment.HorizontalFlip(camera=camera()), augment.Resize(40, camera=60)


@pytest.mark.parametrize("augmentation", MOVES, ids=lambda one: type(one).__name__)
def test_the_matrix_is_that_of_the_move_if_it_is_a_homography(augmentation):
    parts = adapter.CameraAugmentation(augmentation), K.RandomAffine(9.0, p=1.0)
    seq = K.AugmentationSequential(*parts, data_keys=["input", "keypoints"])
    moved, matrix = seq(images(), points())[1], seq.transform_matrix
    expected = (torch.cat((points(), torch.ones_like(points()[..., :1])), -1) @ matrix.mT).unflatten(-1, (3,))
    seen = (moved != -1).all(-1)
    torch.testing.assert_close(moved[seen], (expected[..., :2] / expected[..., 2:])[seen], atol=1e-3, rtol=0)
    back = parts[0].compute_inverse_transformation(parts[0].transform_matrix)
    torch.testing.assert_close(back @ parts[0].transform_matrix, torch.eye(3).expand(3, 3, 3), atol=1e-4, rtol=0)


def test_params_can_be_edited_and_a_turned_lens_has_no_matrix():
    aug = adapter.RandomCamera(camera())
    seq = K.AugmentationSequential(aug, K.RandomAffine(10.0, p=1.0))
    seq(images())
    assert seq.transform_matrix.shape == (3, 3, 3)
    assert seq.transform_matrix.isnan().all()
    assert aug.compute_inverse_transformation(seq.transform_matrix).isnan().all()
    warped, params = aug(images()), dict(aug._params)
    assert all(len(value) == 3 for name, value in params.items() if name != "forward_input_shape")
    params["yaw"] = params["yaw"] + 5
    assert not torch.equal(aug(images(), params=params), warped)
    assert torch.allclose(aug.change(params).rotation, aug.last.rotation)


def test_another_output_size_reaches_the_next_child():
    seq = K.AugmentationSequential(
        adapter.RandomCamera(camera(), image_size=(60, 90)),
        K.RandomHorizontalFlip(p=1.0),
        K.RandomCrop((40, 40), p=1.0),
        data_keys=KEYS,
    )
    torch.manual_seed(11)
    image, mask, _, _ = seq(*batch())
    assert image.shape[-2:] == mask.shape[-2:] == (40, 40)
    assert seq._params[0].data["output_size"].tolist() == [[60, 90]] * 3
    assert seq._params[1].data["forward_input_shape"].tolist() == [3, 1, 60, 90]
    own = K.AugmentationSequential(adapter.RandomCamera(camera(), image_size=(60, 90)), data_keys=KEYS)
    moved = own(*batch())
    back = own.inverse(*moved)
    assert back[0].shape[-2:] == back[1].shape[-2:] == SIZE
    assert (back[2] - points()).abs().max() < 1e-3
    torch.manual_seed(0)
    with pytest.raises(ValueError, match=r"p < 1"):
        adapter.RandomCamera(camera(), image_size=(60, 90), p=0.5)(images(8))


def test_nested_containers_and_random_apply():
    seq = K.AugmentationSequential(
        K.AugmentationSequential(adapter.RandomMount(camera()), K.RandomHorizontalFlip(p=1.0)),
        K.ImageSequential(adapter.RandomLens(camera(), p=0.5)),
        adapter.RandomCamera(camera(), p=0.5),
        data_keys=KEYS,
    )
    for random_apply in (False, 2, True):
        seq.random_apply = seq._read_random_apply(random_apply, 3)
        first, params = seq(*batch()), seq._params
        seq(*batch())
        assert equal(seq(*batch(), params=params), first)
        assert (seq.inverse(*first, params=params)[2] - points()).abs().max() < 2e-3


def test_fields_of_dicts_that_kornia_does_not_know():
    given = dict(zip(("image", "mask_iris", "keypoints", "bbox"), batch(), strict=True))
    given |= {"gaze": points(3, 3).mT / 99, "boxes": torch.rand(3, 1, 4).sort().values * 60, "path": "stays"}
    mount, lens = adapter.RandomMount(camera()), adapter.RandomLens(camera(), p=0.5)
    seq = K.AugmentationSequential(K.ImageSequential(mount), K.ColorJiggle(), lens, data_keys=None)
    moved = seq(given)
    assert torch.equal(moved["gaze"], lens.last.rays(mount.last.rays(given["gaze"])))
    assert (moved["path"], moved["boxes_valid"].shape) == ("stays", (3, 1))
    back = seq.inverse(moved)
    for key in ("keypoints", "gaze"):
        assert (back[key] - given[key]).abs().max() < 1e-3
    again = seq({name: value for name, value in given.items() if name != "image"}, params=seq._params)
    assert torch.equal(again["gaze"], moved["gaze"])


def test_a_camera_of_a_dict_is_that_of_its_images():
    cameras, mount = several(), adapter.RandomMount(camera())
    seq = K.AugmentationSequential(mount, data_keys=None)
    torch.manual_seed(2)
    moved = seq({"image": images(), "camera": cameras})
    torch.manual_seed(2)
    want = augment.RandomMount()(image=images(), camera=cameras)
    assert torch.equal(moved["image"], want["image"])
    assert torch.equal(moved["camera"].intrinsics, want["camera"].intrinsics)
    assert torch.equal(seq.inverse(moved)["camera"].intrinsics, cameras.intrinsics)
    alone = seq({"image": images(1)[0], "gaze": torch.ones(3), "camera": camera()})
    assert (alone["gaze"].shape, alone["camera"].batch_shape) == ((3,), ())
    video = K.AugmentationSequential(K.VideoSequential(mount, data_format="BTCHW", same_on_frame=True), data_keys=None)
    clip = images(1).expand(2, 3, -1, -1, -1)
    moved = video({"image": clip, "gaze": torch.ones(2, 3, 3), "camera": [camera(), camera()]})
    assert torch.equal(moved["gaze"][:, 0], moved["gaze"][:, 2])
    assert not torch.equal(moved["gaze"][0], moved["gaze"][1])
    assert len(moved["camera"]) == 6


@pytest.mark.parametrize("field", [{"gaze": torch.ones(3, 3)}, {"camera": camera()}])
def test_what_would_leave_fields_behind_is_refused(field):
    flip = "got kornia's RandomHorizontalFlip. Use camtorch.augment.kornia.HorizontalFlip"
    affine = "got kornia's RandomAffine. Use augmentations of camtorch"
    cases = [(K.RandomHorizontalFlip(), flip), (K.ImageSequential(K.RandomAffine(3.0)), affine)]
    if "camera" in field:
        cases += [(adapter.RandomLens(camera()), "a camera must be .* camtorch.augment.kornia.Compose")]
    for other, text in cases:
        seq = K.AugmentationSequential(adapter.RandomMount(camera()), other, data_keys=None)
        assert seq({"image": images()})["image"].shape == images().shape
        with pytest.raises(ValueError, match=text):
            seq({"image": images(), **field})
    with pytest.raises(ValueError, match="no kornia key; got keypoints_valid"):
        seq({"image": images(), "keypoints": points(3, 2), "keypoints_valid": torch.ones(3, 2)})


@pytest.mark.parametrize("same_on_batch", [False, True])
@pytest.mark.parametrize("same_on_frame", [False, True])
@pytest.mark.parametrize("data_format", ["BTCHW", "BCTHW"])
def test_videos(data_format, same_on_frame, same_on_batch):
    clips, frames = 2, 3
    aug = adapter.RandomCamera(camera(), same_on_batch=same_on_batch)
    video = K.VideoSequential(aug, data_format=data_format, same_on_frame=same_on_frame)
    order = (0, 2, 1, 3, 4) if data_format == "BCTHW" else (0, 1, 2, 3, 4)
    image = images(1).expand(clips * frames, -1, -1, -1).unflatten(0, (clips, frames)).permute(order)
    mask = masks(1).expand(clips * frames, -1, -1, -1).unflatten(0, (clips, frames)).permute(order)
    seq = K.AugmentationSequential(video, data_keys=KEYS)
    labels = [v(1).expand(clips, frames, *v(1).shape[1:]).contiguous() for v in (points, vertices)]
    warped, classes, moved, boxes = seq(image, mask, *labels)
    params = seq._params
    assert warped.shape == image.shape
    assert classes.dtype == torch.int64
    for value in (warped.permute(order), moved, boxes):
        assert torch.equal(value[0, 0], value[0, 1]) == (same_on_frame or same_on_batch)
        assert torch.equal(value[0, 0], value[1, 0]) == same_on_batch
    assert equal(seq(image, mask, *labels, params=params), (warped, classes, moved, boxes))
    assert aug.last.count == clips * frames
    assert (seq.inverse(warped, classes, moved, boxes)[2] - labels[0]).abs().max() < 1e-3


def several(count=3):
    scale = torch.linspace(0.9, 1.1, count)[:, None]
    own = camera()
    return ct.BrownConrady(own.intrinsics * scale, own.distortion * scale, image_size=SIZE).requires_grad_(False)


@pytest.mark.parametrize("of", [adapter.RandomLens, adapter.RandomCamera])
def test_camera_and_lens_go_in_by_name(of):
    made = []
    for arguments, named in (
        ((camera(), "dms60"), {}),
        ((camera(),), {"like": "dms60"}),
        (("dms60",), {"camera": camera()}),
        ((), {"like": "dms60", "camera": camera()}),
    ):
        torch.manual_seed(3)
        made.append(of(*arguments, **named)(images()))
    assert all(torch.equal(one, made[0]) for one in made)
    says = rf"^{of.__name__}: camera must be .* comes first: {of.__name__}\(camera, 'dms60'\); got 'dms60'$"
    for beside in ((), (camera(),)):
        with pytest.raises(TypeError, match=says):
            of("dms60", *beside)
    with pytest.raises(TypeError, match=rf"^{of.__name__}: camera must be .*\(camera\); got NoneType"):
        of()


def test_errors_say_what_is_wrong():
    aug, own, mount = adapter.RandomMount(camera()), camera(), adapter.RandomMount
    others = aug, K.AugmentationSequential(K.RandomAffine(3.0))
    params, affine = (one.forward_parameters(images().shape) for one in others)

    def given(cameras):
        return lambda: adapter.with_cameras(params, cameras)

    numbers, fit = [90.0, 90.0, 60.0, 40.0], "of the params' model and image_size; got BrownConrady"
    for call, text in (
        (lambda: aug(images(1, 1, (50, 60))), r"\(96, 128\); got \(50, 60\)"),
        (lambda: mount(None), "camera must be the Camera"),
        (lambda: mount(ct.Pinhole([1.0, 1.0, 0.0, 0.0])), "image_size"),
        (lambda: mount(several()), "with_cameras"),
        (lambda: mount(own, p=2.0), r"p must be a probability in \[0, 1\]; got"),
        (lambda: adapter.CameraAugmentation(K.RandomAffine(3.0)), "augmentation must be"),
        (lambda: aug.change(), "must have batch_prob"),
        (given(ct.BrownConrady(numbers, [0.0] * 4, image_size=SIZE)), fit),
        (given(own.resize(48, 64)), fit),
        (given(ct.KannalaBrandt(numbers, [0.0] * 4, image_size=SIZE)), "got KannalaBrandt"),
        (given(several(2)), r"must be 3, .*\(2,\)"),
        (given([own, None]), "must be a batch, or a list"),
        (lambda: adapter.with_cameras(affine, own), "those of a camera augmentation"),
        (lambda: aug(images(2), params=params), "must be 3 samples; got 2"),
    ):
        with pytest.raises((TypeError, ValueError), match=text):
            call()


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_dtypes(dtype):
    aug = adapter.RandomCamera(camera())
    wide, params = aug(images()), aug._params
    # module.half() must not round the camera
    for each, given in ((aug, images().to(dtype)), (copy.deepcopy(aug).to(dtype), images())):
        assert (each(given, params=params) - wide).abs().max() < 0.01
    data = [v.to(dtype) if v.is_floating_point() else v for v in batch()]
    moved = K.AugmentationSequential(aug, data_keys=KEYS)(*data)
    assert [v.dtype for v in moved] == [v.dtype for v in data]
    assert all(torch.isfinite(v).all() for v in moved)


@pytest.mark.parametrize("key", ["input", "keypoints"])
def test_gradients_reach_cameras_of_samples(key):
    own = several().requires_grad_(True)
    seq = K.AugmentationSequential(adapter.RandomCamera(camera()), data_keys=["input", "keypoints"])
    params = adapter.with_cameras(seq.forward_parameters(images().shape), own)
    for _ in range(2):
        moved = dict(zip(("input", "keypoints"), seq(images(), points(), params=params), strict=True))
        for gradient in torch.autograd.grad((moved[key] ** 2).sum(), (own.intrinsics, own.distortion)):
            assert torch.isfinite(gradient).all()
            assert (gradient != 0).any(1).all()
    with torch.no_grad():
        frozen = seq(images(), points(), params=params)
    # without a graph, maps may come from a lattice
    assert torch.allclose(frozen[0], moved["input"], atol=0.02)
    aug = adapter.RandomMount(camera())
    aug(images(), params=adapter.with_cameras(aug.forward_parameters(images().shape), own))
    for one, twin in ((aug, pickle.loads(pickle.dumps(aug))), (seq[0], copy.deepcopy(seq)[0])):
        assert torch.equal(one.last.rotation, twin.last.rotation)


@pytest.mark.parametrize(
    ("owner", "name", "parameters"),
    [
        (K.GeometricAugmentationBase2D, "_gate", "self params"),
        (K.GeometricAugmentationBase2D, "_blend_by_prob", "transformed not_transformed to_apply"),
        (K.AugmentationSequential, "_read_datakeys_from_dict", "self keys"),
        (K.AugmentationSequential, "_preproc_boxes", "self arg dcate"),
        (K.container.ImageSequential, "__getstate__", "self"),
        (K.utils, "_transform_output_shape", "output shape reference_shape"),
    ],
)
def test_private_names_of_kornia_are_as_the_front_end_takes_them(owner, name, parameters):
    """Other tests notice changes of `_params`, and of `_data` and `_valid` of labels."""
    assert " ".join(inspect.signature(getattr(owner, name)).parameters) == parameters


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        *((K.GeometricAugmentationBase2D, n) for n in ("_blend_by_prob", "_gate", "_params", "transform_tensor")),
        *((K.AugmentationSequential, n) for n in ("_params", "_preproc_boxes", "_read_datakeys_from_dict")),
        *((Boxes, n) for n in ("_data", "_valid")),
        (Keypoints, "_data"),
        (K.base, "_BasicAugmentationBase"),
        (K.container.params, "ParamItem"),
        (K.utils, "_transform_output_shape"),
    ],
)
def test_a_kornia_that_lacks_a_part_is_refused_by_its_name(owner, name, monkeypatch):
    if inspect.isclass(owner):

        def without(self, asked):  # the part may be one of instances alone
            if asked == name:
                raise AttributeError
            return object.__getattribute__(self, asked)

        monkeypatch.setattr(owner, "__getattribute__", without)
    else:
        monkeypatch.delattr(owner, name)
    with pytest.raises(ImportError, match=rf"got 0.*\b{name}\b.*pip install 'kornia==0.9"):
        runpy.run_path(private.__file__)


def test_the_size_of_new_images_follows_another_camera():
    aug = adapter.CameraAugmentation(augment.Resize(40), camera=60)
    cameras = [ct.Pinhole.from_fov(60, image_size=size) for size in ((200, 100), (100, 200))]
    for given, size in ((60, SIZE), (cameras[0], (200, 100)), (cameras[1], (100, 200)), (60, (50, 60))):
        aug.camera = given
        out = aug(images(2, size=size))
        assert aug._params["output_size"].tolist() == [list(out.shape[-2:])] * 2


def test_a_number_gives_way_to_the_camera_of_the_augmentation():
    made = augment.RandomMount(camera=camera())
    assert torch.equal(adapter.CameraAugmentation(made, 60).camera.intrinsics, made.camera.intrinsics)


def test_what_never_applies_leaves_the_size():
    never, first = augment.Resize(40, p=0), augment.RandomMount(p=0, image_size=(20, 30))
    assert never.size_after(SIZE) == first.size_after(SIZE) == augment.Compose([first, never]).size_after(SIZE) == SIZE
    for aug in (adapter.CameraAugmentation(never, camera()), adapter.Compose(camera(), [first, never])):
        assert aug(images()).shape[-2:] == SIZE
        assert "output_size" not in aug._params
    always = adapter.CameraAugmentation(never, camera(), p=1)
    out = always(images())
    assert tuple(always._params["output_size"][0]) == out.shape[-2:] == (40, 53)


class Halved(augment.Augmentation):
    """An augmentation of one's own, which says only by `size_after` how large new images are."""

    def new_camera(self, source, values):
        return source.resize(*self.size_after(source.image_size)), None

    def size_after(self, size):
        return size[0] // 2, size[1] // 2


def test_the_size_of_ones_own_augmentation_reaches_the_next_child():
    parts = adapter.CameraAugmentation(Halved(), camera()), K.RandomHorizontalFlip(p=1.0), K.RandomCrop((40, 40), p=1.0)
    seq = K.AugmentationSequential(*parts, data_keys=["input"])
    assert seq(images()).shape[-2:] == (40, 40)
    assert seq._params[0].data["output_size"].tolist() == [[48, 64]] * 3
    assert seq._params[1].data["forward_input_shape"].tolist() == [3, 1, 48, 64]


def test_labels_follow_a_lens_in_the_container_in_which_theirs_stay_behind():
    """kornia#4420: its fisheye and its elastic map move images, and no keypoints and boxes."""
    spot = torch.zeros(1, 1, *SIZE)
    spot[..., 24:31, 36:43] = 1  # a blob about (39, 27)
    point, box = torch.tensor([[[39.0, 27.0]]]), torch.tensor([[[36.0, 24, 42, 30]]])
    grid = torch.stack(torch.meshgrid(torch.arange(WIDTH), torch.arange(HEIGHT), indexing="xy"), -1)
    narrow = torch.tensor([-0.01, 0.01])
    ours = adapter.RandomLens("kannala_brandt", fov=80, centre=None, focal=None, camera=60, min_filled=0)
    theirs = K.RandomFisheye(narrow, narrow, torch.tensor([0.9, 1.0]), p=1.0), K.RandomElasticTransform(p=1.0)
    for aug in (*theirs, ours):
        torch.manual_seed(1)
        pipeline = K.AugmentationSequential(aug, data_keys=["input", "keypoints", "bbox_xyxy"])
        image, moved, boxes = pipeline(spot, point, box)
        centroid = (image[0, 0, :, :, None] * grid).sum((0, 1)) / image.sum()
        assert (centroid - point[0, 0]).norm() > 0.3
        if aug is ours:
            torch.testing.assert_close(moved[0, 0], centroid, rtol=0, atol=0.1)
            assert (boxes - box).abs().max() > 1
            assert (boxes[0, 0].unflatten(0, (2, 2)).mean(0) - centroid).norm() < 0.5
        else:
            assert torch.equal(moved, point)
            assert torch.equal(boxes, box)
