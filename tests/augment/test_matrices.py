"""Laws of samples without a camera: a matrix K among their fields, and degrees of a guessed camera."""

import copy
import importlib
import pickle
import re
import unittest

import numpy as np
import pytest
import torch
from torchvision_stand_in import torchvision_of

import camtorch as ct
import camtorch.augment.numpy
from camtorch.augment import matrices
from camtorch.values.arguments import TOLD

A, SIZE = ct.augment, (96, 128)
K = torch.tensor([[120.0, 0, 61], [0, 124, 46], [0, 0, 1]])
POINTS = torch.rand(2, 9, 3, generator=torch.Generator().manual_seed(1)) - torch.tensor([0.5, 0.5, -1.5])
BOXES = torch.tensor([[[40.0, 30, 80, 70]]]).expand(2, -1, -1)
AUGMENTATIONS = {
    "mount": lambda **o: A.RandomMount(zoom=0.2, **o),
    "of half the rows": lambda **o: A.RandomMount(p=0.5, **o),
    "pinhole lens": lambda **o: A.RandomLens(fov=(40, 60), **o),
    "camera": lambda **o: A.RandomCamera("pinhole", fov=50, image_size=(60, 70), **o),
    "mirror": lambda **o: A.HorizontalFlip(p=1.0, **o),
    "upside down": lambda **o: A.VerticalFlip(**o),
    "quarter turn": lambda **o: A.Rotate90(same_on_batch=True, **o),
    "size": lambda **o: A.Resize((50, 80), **o),
    "part": lambda **o: A.RandomResizedCrop((40, 50), **o),
    "rim": lambda **o: A.Pad((1, 2, 3, 4), **o),
    "box": lambda **o: A.BoxCrop((64, 48), yaw=3, **o),
    "chain": lambda **o: A.Compose([A.RandomMount(), A.RandomCrop((80, 90)), A.HorizontalFlip()], **o),
    "box after a lens": lambda **o: A.Compose([A.RandomLens("dms130", fov=70, min_filled=0), A.BoxCrop((64, 48))], **o),
}


def projected(matrix, points):
    pixels = points.to(matrix) @ matrix[..., :3, :3].mT
    return pixels[..., :2] / pixels[..., 2:]


def sample(matrix, name="K", *, single=False):
    fields = {"image": torch.rand(2, 3, *SIZE), "points": POINTS, "boxes": BOXES, name: matrix}
    fields["keypoints"] = projected(matrix, POINTS)
    return {key: value[0] for key, value in fields.items()} if single else fields


def matrix_of(dims, dtype=torch.float32):
    """Two matrices, of which a larger one has a last row and column of its own."""
    matrix = torch.eye(dims).repeat(2, 1, 1).to(dtype)
    matrix[:, :3, :3] = K
    matrix[1, 0, 0] += 7
    return matrix


def of_matrix(matrix, size=SIZE):
    return ct.Pinhole.from_matrix(matrix[..., :3, :3], image_size=size).requires_grad_(False)


def fisheye_of(size):
    return ct.KannalaBrandt.from_fov(60, image_size=size)


def check_labels(out, name="K"):
    off = (projected(out[name], out["points"]) - out["keypoints"])[out["keypoints_valid"]]
    assert off.numel() == 0 or off.abs().max() < 0.01


# of the names, each in either shape, and of either name that is written, both
@pytest.mark.parametrize(
    ("field", "dims"), [("K", 3), ("K", 4), ("intrinsics", 4), ("camera_matrix", 3), ("of_cam", 4)]
)
@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_new_matrices_project_points_on_their_pixels(name, field, dims):
    augment = AUGMENTATIONS[name](fields={"of_cam": "K"})
    others = torch.ones(dims, dims, dtype=torch.bool)
    others[:2, :3] = torch.tensor([[False, True, False], [True, False, False]])
    for dtype, single in ((torch.float32, dims == 3), (torch.float64, dims == 4)):
        matrix = matrix_of(dims, dtype)
        given = sample(matrix, field, single=single)
        for _ in range(2):  # as first and as later samples
            out = augment(given)
            check_labels(out, field)
            assert (out[field].shape, out[field].dtype) == (given[field].shape, dtype)
            new = out[field][..., (0, 1, 0, 1), (0, 1, 2, 2)]
            torch.testing.assert_close(out["camera"].intrinsics, new, rtol=0, atol=0)
            assert torch.equal(out[field][..., others], given[field][..., others])
        torch.testing.assert_close(given[field], matrix[0] if single else matrix, rtol=0, atol=0)
        if name not in ("part", "of half the rows"):
            torch.testing.assert_close(augment.inverse(out)[field], given[field])


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_a_matrix_moves_as_its_camera(name):
    augment, fields = AUGMENTATIONS[name](), sample(matrix_of(3))
    draw = augment.draw(2)
    by_matrix = augment(fields, draw=draw)
    by_camera = augment({n: v for n, v in fields.items() if n != "K"}, camera=of_matrix(fields["K"]), draw=draw)
    assert by_matrix.keys() == by_camera.keys() | {"K"}
    for key in by_camera.keys() - {"camera"}:
        assert torch.equal(by_matrix[key], by_camera[key])


def test_lists_clips_frames_and_half_precision():
    matrix = matrix_of(3)
    fields = sample(matrix)
    out = A.RandomMount()({name: list(value) for name, value in fields.items()})
    for i in range(2):
        check_labels({name: value[i] for name, value in out.items() if name != "camera"})
    for given in (matrix, matrix[:, None].expand(-1, 4, -1, -1)):
        frames = {n: v[:, None].expand(-1, 4, *v.shape[1:]) for n, v in fields.items() if n not in ("K", "boxes")}
        out = A.RandomMount()(frames, K=given)
        assert out["K"].shape == given.shape
        each = out["K"] if out["K"].ndim == 4 else out["K"][:, None]
        check_labels({**out, "K": each})
    differ = torch.stack([matrix, 2 * matrix_of(3) - K, matrix, matrix], 1)
    with pytest.raises(ValueError, match="K must be the same in all frames of a clip"):
        A.RandomMount()(frames, K=differ)
    half = A.HorizontalFlip(p=1.0)(image=fields["image"], K=matrix.half())["K"]
    assert half.dtype == torch.float16
    assert half[0, 0, 2] == SIZE[1] - 1 - 61


def test_gradients_reach_a_matrix():
    matrix = matrix_of(3, torch.float64).requires_grad_()
    augment = A.RandomMount(yaw=5)
    draw, pixels = augment.draw(2), projected(matrix_of(3, torch.float64), POINTS)

    def moved(given):
        out = augment(image=torch.zeros(2, 1, *SIZE), K=given, keypoints=pixels, draw=draw)
        return out["keypoints"].sum() + out["K"].sum()

    moved(matrix).backward()
    step = torch.zeros_like(matrix)
    step[0, 0, 0] = 1e-4
    with torch.no_grad():
        numeric = (moved(matrix + step) - moved(matrix - step)) / 2e-4
    torch.testing.assert_close(matrix.grad[0, 0, 0], numeric, rtol=1e-4, atol=1e-4)


@pytest.mark.filterwarnings("ignore:.*will show nothing")
def test_who_wins():
    fields = sample(matrix_of(3))
    same, other = of_matrix(fields["K"]), ct.Pinhole.from_fov(60, image_size=SIZE)
    assert torch.equal(A.Resize(SIZE, camera=60)(fields)["camera"].intrinsics, same.intrinsics)  # K, else the number
    check_labels(A.RandomMount()(fields, camera=same))
    check_labels(A.RandomMount()(fields, camera=[same[0], same[1]]))
    for lens in (ct.BrownConrady(same[0].intrinsics, torch.zeros(5), image_size=SIZE), [same[0], fisheye_of(SIZE)]):
        with pytest.raises(ValueError, match=r"got the camera of the sample, a (BrownC|KannalaB).*more than a matrix"):
            A.RandomMount()(fields, camera=lens)
    chain = torch.nn.Sequential(A.RandomMount(), A.HorizontalFlip(), A.RandomMount(camera=60))
    check_labels(chain(fields))  # the second finds a camera beside K, which agrees
    fisheye = fisheye_of(SIZE)
    for wrong in (other, fisheye, [fisheye, other]):
        for message, call in (
            ("camera of the sample", lambda wrong=wrong: A.RandomMount()(fields, camera=wrong)),
            ("that of the augmentation", lambda wrong=wrong: A.RandomMount(camera=wrong)(fields)),
        ):
            if isinstance(wrong, list) and "augmentation" in message:
                continue
            for _ in range(2):
                with pytest.raises(ValueError, match=rf"K must be the camera.*{message}.*fields=\{{'K': 'keep'\}}"):
                    call()
    with pytest.raises(ValueError, match=r"intrinsics must be the camera.*got that of K"):
        A.RandomMount()(fields, intrinsics=matrix_of(3) * torch.tensor([2.0, 2, 1])[:, None])
    used = A.RandomMount(camera=same[0])
    once = {n: v[0] for n, v in fields.items()}
    used(once)
    with pytest.raises(ValueError, match="K must be the camera"):  # of a form that is known
        used(once, K=matrix_of(3)[1])
    kept = A.RandomMount(camera=other, fields={"K": "keep"})(fields)
    assert torch.equal(kept["K"], fields["K"])


@pytest.mark.parametrize("count", [3, [1, 2, 3], torch.tensor([1, 2, 3]), "K.txt"], ids=str)
def test_numbers_of_things_may_be_named_as_a_matrix(count):
    camera = ct.Pinhole([120.0, 124, 61, 46], image_size=SIZE)
    mount, image = A.RandomMount(camera=camera), torch.rand(3, *SIZE)
    array = count.numpy() if isinstance(count, torch.Tensor) else count
    for name in ("K", "intrinsics"):
        assert mount({"image": image, name: count})[name] is count
        assert mount({"image": image.expand(3, -1, -1, -1), name: count})[name] is count
        assert A.numpy.Transform(mount)({"image": image[0].numpy(), name: array})[name] is array


class Lens(A.Augmentation):
    def new_camera(self, source, values):
        return ct.KannalaBrandt(source.intrinsics, torch.zeros(4), image_size=source.image_size), None


@pytest.mark.parametrize(
    "make",
    [
        lambda: A.RandomLens("dms130", fov=50),
        lambda: A.RandomLens("real", p=1e-9),
        lambda: A.RandomCamera("kannala_brandt", fov=50),
        lambda: A.Compose([A.BoxCrop((64, 48)), A.RandomLens("dms130", fov=40), A.HorizontalFlip()], p=1e-9),
        Lens,
    ],
)
def test_lenses_are_refused(make):
    one = {name: value[0] for name, value in sample(matrix_of(3)).items()}
    with pytest.raises(ValueError, match=r"K must be.*only pinhole.*camera=ct\.Pinhole\.from_matrix\(K.*'keep'"):
        make()(one)
    with pytest.raises(ValueError, match="only pinhole cameras have one"):
        camtorch.augment.numpy.Transform(make())(
            image=np.zeros((*SIZE, 3), np.uint8), K=K.numpy(), boxes=BOXES[0].numpy()
        )


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (K, r"K must be \(B, 3, 3\).*got shape \(3, 3\).*K\.expand\(B, -1, -1\)"),
        (torch.tensor([[120.0, 124, 61, 46]] * 2), r"\(2, 4\).*camera=ct\.Pinhole\(numbers"),
        (matrix_of(3)[..., :2, :], r"\(2, 2, 3\)"),
        (matrix_of(3).mT, "fx, fy above 0 and no skew"),
        (-matrix_of(3), "fx, fy above 0"),
        (matrix_of(3) * torch.nan, "above 0"),
        (matrix_of(4) + 1, "no skew"),
        (matrix_of(3)[:1], "K must be of 2 samples"),
    ],
)
def test_what_is_no_matrix_is_refused(value, message):
    with pytest.raises(ValueError, match=message):
        A.RandomMount()(image=torch.rand(2, 3, *SIZE), K=value)
    with pytest.raises(ValueError, match="must have an image"):
        A.RandomMount()(K=K, points=POINTS[0])


@pytest.mark.parametrize(("scale", "message"), [(2, "of images of about"), (1 / 128, "parts of")])
def test_a_matrix_of_another_image_warns_once(scale, message):
    TOLD.clear()
    matrix = K * torch.tensor([scale, scale, 1.0])[:, None]
    with pytest.warns(UserWarning, match=f"Resize: .*{message}"):
        A.Resize(20)(image=torch.rand(3, *SIZE), K=matrix)
    A.Resize(20)(image=torch.rand(3, *SIZE), K=matrix)


def test_other_things_of_such_names_pass():
    for value in (5, "camera.yml", torch.tensor(3), torch.tensor([1, 2]), ["a", "b"]):
        out = A.RandomMount(camera=60)(image=torch.rand(2, 3, *SIZE), K=value, intrinsics=value)
        assert out["K"] is value
    for name in ("K_inv", "K_left", "cam_K"):  # an inverse, or a camera beside
        with pytest.raises(ValueError, match=f"'{name}' must have a kind"):
            A.RandomMount(camera=60)(image=torch.rand(3, *SIZE), **{name: K})


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_a_number_is_a_pinhole_for_images_of_any_size(name):
    augment = AUGMENTATIONS[name](camera=60)
    augment = pickle.loads(pickle.dumps(copy.deepcopy(augment)))
    for size in (SIZE, (128, 96), SIZE):
        camera = ct.Pinhole.from_fov(60, image_size=size).requires_grad_(False)
        fields = {"image": torch.rand(2, 3, *size), "keypoints": torch.rand(2, 5, 2) * 90, "boxes": BOXES}
        draw = augment.draw(2)
        out, want = augment(fields, draw=draw), augment(fields, camera=camera, draw=draw)
        assert out["camera"].image_size == want["camera"].image_size
        assert torch.equal(out["camera"].intrinsics, want["camera"].intrinsics)
        for key in ("image", "keypoints", "rotation"):
            assert torch.equal(out[key], want[key])
        again = A.HorizontalFlip(p=1.0, camera=90)(out)  # which goes on with the camera of the result
        assert torch.equal(again["camera"].fov[:, 1], out["camera"].fov[:, 1])
        listed = augment({n: list(value) for n, value in fields.items()}, draw=draw)
        assert torch.equal(listed["image"][1], out["image"][1])


def test_a_number_takes_the_place_of_a_camera():
    camera, fields = ct.Pinhole.from_fov(90, image_size=SIZE), {"image": torch.rand(3, *SIZE)}
    images = {"image": np.zeros((*SIZE, 3), np.uint8)}
    augment, transform = A.Resize(SIZE, camera=camera), camtorch.augment.numpy.Transform(A.Resize(SIZE), camera)
    for one, sample in ((augment, fields), (transform, images)):
        assert float(one(**sample)["camera"].fov[0]) == pytest.approx(90)
        for number in (60, np.float32(60), np.int64(60)):
            one.camera = number
            assert float(one(**sample)["camera"].fov[0]) == pytest.approx(60)
            one.camera = camera
            assert float(one(**sample)["camera"].fov[0]) == pytest.approx(90)


def test_a_guess_is_told_once():
    TOLD.clear()
    matrices._guessed.cache_clear()
    with unittest.TestCase().assertLogs("camtorch", "INFO") as logs:
        for size in (SIZE, (50, 60)):
            A.RandomMount(camera=60)(image=torch.rand(3, *size))
    assert [re.match("cameras are guessed", record.getMessage()) is not None for record in logs.records] == [True]


@pytest.mark.parametrize("value", [0, 180, -60, 1.0, float("nan"), True, "60"])
def test_bad_numbers_are_refused(value):
    error = ValueError if type(value) in (int, float) else TypeError
    for make in (A.RandomMount, A.Resize, lambda **o: A.Compose([A.RandomMount()], **o)):
        given = (SIZE,) if make is A.Resize else ()
        with pytest.raises(error, match="must be"):
            make(*given, camera=value)
    with pytest.raises(error, match=r"numpy\.Transform: (camera|fov) must be"):
        camtorch.augment.numpy.Transform(A.RandomMount(), value)


def test_a_number_needs_an_image():
    augment = A.RandomMount(camera=60)
    for call in (lambda: augment(gaze=torch.rand(3)), lambda: augment.change(None, augment.draw(1))):
        with pytest.raises(ValueError, match=r"must have an image|camera must be given; got 60"):
            call()
    with pytest.raises(ValueError, match="channels first"):
        augment(image=torch.rand(*SIZE, 3))


@pytest.mark.parametrize("kind", ["real", "stand-in"])
def test_a_dict_of_torchvision_gets_the_guessed_camera(kind, monkeypatch):
    with torchvision_of(kind, monkeypatch):
        transform = importlib.import_module("camtorch.augment.torchvision").Transform
        first, second = transform(A.BoxCrop((64, 48)), 60), transform(A.HorizontalFlip(p=1.0), 60)
        one = first({"image": torch.rand(3, *SIZE), "boxes": BOXES[0]})
        assert torch.equal(second(dict(one))["camera"].fov, one["camera"].fov)
        by_matrix = first({"image": torch.rand(3, *SIZE), "boxes": BOXES[0], "K": K})
        assert "camera" not in by_matrix
        assert by_matrix["K"][0, 2] == 23.5
        whole = first({"image": torch.rand(3, *SIZE), "boxes": BOXES[0], "K": K.round().long()})["K"]
        assert whole.is_floating_point()  # as the new focal length is none
        image, target = first(torch.rand(3, *SIZE), {"boxes": BOXES[0]})
        assert (tuple(image.shape), [*target]) == ((3, 64, 48), ["boxes"])


def test_a_skew_of_rounding_is_none():
    given = torch.tensor([[60.0, 1e-9, 31.5], [0, 60, 23.5], [0, 0, 1]], dtype=torch.float64)
    flip, image = ct.augment.HorizontalFlip(p=1), torch.rand(3, 48, 64)
    torch.testing.assert_close(flip(image=image, K=given)["K"], given)
    with pytest.raises(ValueError, match="no skew"):
        flip(image=image, K=given + torch.tensor([[0, 1e-3, 0], [0, 0, 0], [0, 0, 0]]))
    with pytest.raises(ValueError, match=r"pass K, K\[\.\.\., :3\]"):
        flip(image=image, K=given[:, [0, 1, 2, 2]])


def test_a_guess_is_shown():
    assert "camera=60, yaw" in repr(ct.augment.RandomMount(camera=60))


def test_a_camera_of_the_augmentation_comes_before_the_number_of_a_front_end(vision):
    front_end, tv_tensors = vision
    transform = front_end.Transform(A.Resize(SIZE, camera=ct.Pinhole.from_fov(90, image_size=SIZE)), 60)
    transform({"image": tv_tensors.Image(torch.zeros(3, *SIZE))})
    assert float(transform.last.target.fov[..., 0]) == pytest.approx(90)


def test_a_box_crop_that_may_not_apply_leaves_a_lens():
    lens = A.RandomLens("dms130", fov=70, min_filled=0)
    fields = {"image": torch.zeros(2, 3, *SIZE), "K": K.expand(2, 3, 3), "boxes": BOXES}
    assert A.Compose([lens, A.BoxCrop((64, 48))])(**fields)["K"].shape == (2, 3, 3)
    with pytest.raises(ValueError, match="only pinhole"):
        A.Compose([lens, A.BoxCrop(SIZE, p=0.5)])(**fields)
