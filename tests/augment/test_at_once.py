"""What native code moves at once, samples and batches, has the very numbers that their change makes step by step."""

import math
import platform
from functools import partial
from itertools import product

import numpy as np
import pytest
import torch
from cameras import slow_unless

import camtorch as ct
import camtorch.augment.numpy
import camtorch.augment.plan
from camtorch.augment.sample import Single
from camtorch.evaluate.kept import Kept
from camtorch.native.library import native_available
from camtorch.poses.rotations import rotation_matrix, rotation_vector

A = ct.augment
SIZE = (96, 130)
DTYPES = torch.float32, torch.float64
LENSES = {
    "pinhole": None,
    "brown_conrady": [-0.2, 0.05, 1e-3, -1e-3],
    "kannala_brandt": [0.02, -0.01, 2e-3, -1e-3],
    "mei": [0.8, -0.1, 0.02, 1e-3, 1e-3],
    "double_sphere": [-0.1, 0.55],
    "equirectangular": None,
}


def example(key, size):
    width = 130.0 if key != "equirectangular" else size[1] / (2 * math.pi)
    middle = [(size[1] - 1) / 2, (size[0] - 1) / 2]
    lens = LENSES[key]
    return ct.MODELS[key]([width, width, *middle], *([] if lens is None else [lens]), image_size=size)


AUGMENTATIONS = {
    "mount": lambda: A.RandomMount(zoom=0.2, padding_mode="border"),
    "lens": lambda: A.RandomLens(mode="bicubic", fill=(1, 2, 3), mask_fill=7),
    "another lens": lambda: A.RandomCamera("dms60", image_size=(90, 120), min_filled=0),
    "filled": lambda: A.RandomMount(min_filled=0.9, p=0.7),
    "chain": lambda: A.Compose([A.RandomMount(), A.RandomLens()], antialias=False),
    "chain that decides": lambda: A.Compose([A.RandomMount(), A.RandomLens()]),
    "flipped chain": lambda: A.Compose([A.RandomResizedCrop(SIZE, scale=(0.5, 1)), A.HorizontalFlip(), A.RandomLens()]),
    "chain that shrinks": lambda: A.Compose([A.RandomMount(), A.RandomLens(), A.Resize((40, 54))], mask_fill=3),
    "a lens that shrinks": lambda: A.Compose([A.RandomCamera("dms60", image_size=(64, 70), min_filled=0)]),
    "edits": lambda: A.Compose([A.RandomResizedCrop((64, 80), scale=(0.3, 0.6)), A.HorizontalFlip()], fill=9),
}


def sample_for(dtype):
    torch.manual_seed(0)
    pixels = torch.rand(9, 2, dtype=dtype) * 150 - 10
    image = torch.randint(256, (3, *SIZE), dtype=torch.uint8)
    mask = torch.randint(9, SIZE)
    return {"image": image, "mask": mask, "keypoints": pixels, "polygons": pixels.view(3, 3, 2)}


ROUNDED = 0 if native_available() else 1e-4  # torch moves all pixels at once, and rounds the last ones differently
# on ARM torch's functions round as no code of C does: of a value, and so of a grey level
ON_ARM = platform.machine() in ("aarch64", "arm64")
CASES, FEW = list(product(LENSES, AUGMENTATIONS, DTYPES)), {"mount", "chain", "edits"}


@pytest.mark.parametrize(("key", "name", "dtype"), slow_unless(lambda c: c[2] == DTYPES[0] or c[1] in FEW, CASES))
def test_as_step_by_step(key, name, dtype):
    camera = example(key, SIZE).to(dtype).requires_grad_(False)
    augment, sample = AUGMENTATIONS[name](), sample_for(dtype)
    for seed in range(2):  # as a first and as a later sample
        torch.manual_seed(seed)
        out = augment(sample, camera=camera)
        change, fill = augment.last, augment.mask_fill
        levels = out["image"].int() - change.images(sample["image"][None])[0].int()
        assert levels.abs().max() <= ON_ARM
        assert torch.equal(out["mask"], change.labels(sample["mask"][None, None], fill)[0, 0])
        for field in ("keypoints", "polygons"):
            moved, valid = change.points(sample[field][None])
            torch.testing.assert_close(out[field], moved[0], rtol=0, atol=ROUNDED)
            assert torch.equal(out[f"{field}_valid"], valid[0])
        assert torch.equal(out["rotation"], change.rotation[0])
        assert torch.equal(out["camera"].intrinsics, change.target.intrinsics[0])
        assert torch.equal(out["camera"].distortion, change.target.distortion[0])


@pytest.mark.parametrize("threads", [pytest.param(1, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("name", AUGMENTATIONS)
@pytest.mark.parametrize("key", LENSES)
def test_batches_as_step_by_step(key, name, threads):
    """Each sample of a batch goes to a thread: the numbers do not depend on that."""
    camera, before = example(key, SIZE).requires_grad_(False), torch.get_num_threads()
    sample = {field: torch.stack([value, value.flip(-1)] * 2) for field, value in sample_for(torch.float32).items()}
    augment = AUGMENTATIONS[name]()
    torch.set_num_threads(threads)
    try:
        out = augment(sample, camera=camera)
    finally:
        torch.set_num_threads(before)
    change = augment.last
    assert torch.equal(out["image"], change.images(sample["image"]))
    assert torch.equal(out["mask"], change.labels(sample["mask"][:, None], augment.mask_fill)[:, 0])
    torch.testing.assert_close(out["keypoints"], change.points(sample["keypoints"])[0], rtol=0, atol=ROUNDED)


LAST = {
    "lens": lambda: A.RandomLens("pinhole", fov=(65, 80), min_filled=0),
    "fisheye": lambda: A.RandomLens("kannala_brandt", fov=(65, 80), min_filled=0),
    "its like": lambda: A.RandomLens(min_filled=0),
    "mount": lambda: A.RandomMount(min_filled=0),
    "quarters": lambda: A.Rotate90((0, 2), step=2),
    "camera": lambda: A.RandomCamera(min_filled=0.9),
}


@pytest.mark.skipif(not native_available(), reason="formulas of torch round numbers of a batch differently")
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", LAST)
def test_a_sample_of_a_batch_is_what_it_is_alone(name, dtype):
    augment = A.Compose([A.RandomResizedCrop(SIZE), A.HorizontalFlip(landmarks={}), LAST[name]()])
    camera, alone = example("brown_conrady", SIZE).to(dtype).requires_grad_(False), sample_for(dtype)
    alone |= {"boxes": torch.tensor([[20, 20, 60, 50]], dtype=dtype), "gaze": torch.tensor([0.6, 0, -0.8], dtype=dtype)}
    draw = augment.draw(4)
    batch = augment({field: torch.stack([value] * 4) for field, value in alone.items()}, camera=camera, draw=draw)
    cameras = batch.pop("camera")
    for i in range(4):
        one = augment(alone, camera=camera, draw={key: value[i : i + 1] for key, value in draw.items()})
        assert torch.equal(cameras[i].intrinsics, one["camera"].intrinsics)
        assert torch.equal(cameras[i].distortion, one["camera"].distortion)
        assert all(torch.equal(value[i], one[field]) for field, value in batch.items())


@pytest.mark.parametrize("batch", [(), (1,)])
@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_a_batch_of_one_moves_as_its_sample(name, batch):
    camera, alone = example("brown_conrady", SIZE).requires_grad_(False), sample_for(torch.float32)
    augment, together = AUGMENTATIONS[name](), {field: value[None] for field, value in alone.items()}
    for seed in range(3):  # the first calls make the plans that others keep
        torch.manual_seed(seed)
        one = augment(alone, camera=camera)
        torch.manual_seed(seed)
        batched = augment(together, camera=camera.expand(*batch))
        ours, its = batched.pop("camera"), one.pop("camera")
        assert ours.batch_shape == (1,)
        assert torch.equal(ours.intrinsics[0], its.intrinsics)
        assert torch.equal(ours.distortion[0], its.distortion)
        assert all(torch.equal(value[0], one[field]) for field, value in batched.items())


ANGLES = 0, 1e-30, 1e-8, 1e-3, 0.09, 0.11, 1, 2, math.pi - 1e-3, math.pi - 1e-7, math.pi, 4


@pytest.mark.parametrize("scale", [1, 1e-6])
@pytest.mark.parametrize("dtype", DTYPES)
def test_rotation_vectors_turn_by_the_formulas_of_torch(dtype, scale):
    augment = A.RandomMount(camera=example("pinhole", SIZE).to(dtype).requires_grad_(False))
    axes = torch.nn.functional.normalize(torch.randn(len(ANGLES), 8, 3, dtype=torch.float64), dim=-1)
    vectors = (axes * torch.tensor(ANGLES, dtype=torch.float64)[:, None, None]).flatten(0, 1).to(dtype)
    draws, singles, rotations = augment.draw(len(vectors)), [], []
    draws |= {key: draws[key] * scale for key in ("yaw", "pitch", "roll")}
    for i, vector in enumerate(vectors):
        draw = {key: value[i : i + 1] for key, value in draws.items()}
        singles.append(augment(rvec=vector, draw=draw)["rvec"])
        rotations.append(augment.last.rotation[0] @ rotation_matrix(vector))
        assert not native_available() or [*camtorch.augment.plan._own.calls.result._readers] == ["rvec"]  # C turns it
    turned, wanted, tolerance = torch.stack(singles), torch.stack(rotations), 8 * torch.finfo(dtype).eps
    assert turned.dtype == dtype
    torch.testing.assert_close(rotation_matrix(turned), wanted, rtol=0, atol=tolerance)
    sure = turned.norm(dim=-1) < math.pi - 1e-3  # vectors of opposite axes are nearly one rotation around pi
    torch.testing.assert_close(turned[sure], rotation_vector(wanted[sure]), rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", DTYPES)
def test_rotation_vectors_that_are_none_stay_none_and_those_that_do_not_turn_stay(dtype):
    camera = example("pinhole", SIZE).to(dtype).requires_grad_(False)
    still, turns = A.RandomMount(yaw=0, pitch=0, roll=0, camera=camera), A.RandomMount(camera=camera)
    for values in ((math.nan, 1, 2), (0.1, 0.2, 0.3), (0, -0.0, 0)):
        for vector in (torch.tensor(values, dtype=dtype), torch.tensor([values], dtype=dtype)):
            moved = turns(rvec=vector)["rvec"]
            assert torch.isfinite(moved).all() if math.isfinite(sum(values)) else torch.isnan(moved).all()
            if native_available():  # torch reads and writes vectors of a single sample
                out = still(rvec=vector)["rvec"]
                torch.testing.assert_close(1 / out, 1 / vector, rtol=0, atol=0, equal_nan=True)


def test_rotation_vectors_in_degrees_are_refused_after_others():
    for dtype in DTYPES:
        camera = example("pinhole", SIZE).to(dtype).requires_grad_(False)
        for augment in (A.RandomMount(camera=camera), A.RandomMount(yaw=0, pitch=0, roll=0, camera=camera)):
            augment(rvec=torch.tensor([0.1, 0.2, 0.3], dtype=dtype))
            for _ in range(2):
                with pytest.raises(ValueError, match=r"rvec must be .* in radians; got an angle of 37"):
                    augment(rvec=torch.tensor([30.0, 20, 10], dtype=dtype))
            augment(rvec=torch.tensor([0.0, 4 * math.pi, 0], dtype=dtype))


@pytest.mark.parametrize("name", LAST)
def test_boxes_of_a_sample_move_as_by_its_warp(name):
    camera, first = example("brown_conrady", SIZE).requires_grad_(False), torch.tensor([20.0, 20, 60, 50])
    rows = [first, first - 30, first + 1000, first * math.nan, first[[0, 1, 0, 1]]]
    for boxes in (torch.stack(rows[:1]), torch.stack(rows[:2]), torch.stack(rows), torch.zeros(0, 4)):
        augment = LAST[name]()
        for _ in range(2):
            out = augment({**sample_for(torch.float32), "boxes": boxes}, camera=camera)
            want, valid = augment.last.boxes(boxes[None])
            assert torch.equal(out["boxes"], want[0])
            assert torch.equal(out["boxes_valid"], valid[0])


@pytest.mark.parametrize("lead", [(), (2,)])
def test_pixels_of_half_precision_stay_finite(lead):
    """The image of a ray nearly across the axis is farther away than half precision has numbers."""
    focal = 40 / (math.pi / 2 - 5e-4)
    camera = ct.KannalaBrandt([focal, focal, 48.0, 32.0], [0.0] * 4, image_size=(64, 96)).requires_grad_(False)
    flat = dict.fromkeys(("yaw", "pitch", "roll", "focal", "centre", "distortion", "crop"))
    pixels = torch.tensor([[88.0, 32.0], [50.0, 30.0]]).half().expand(*lead, 2, 2)
    out = A.RandomCamera("pinhole", fov=(60, 60), camera=camera, **flat)(keypoints=pixels)
    assert out["keypoints"].dtype == torch.float16
    assert torch.isfinite(out["keypoints"]).all()
    assert out["keypoints_valid"].tolist() == torch.tensor([False, True]).expand(*lead, 2).tolist()


def odd_samples():
    sample, nan = sample_for(torch.float32), float("nan")
    image, pixels = sample["image"], sample["keypoints"]
    return {
        "no pixels": {"image": image, "keypoints": pixels[:0]},
        "lost pixels": {"image": image, "keypoints": torch.cat((pixels, torch.tensor([[nan, 1.0], [math.inf, 2.0]])))},
        "other precision": {"image": image.half(), "keypoints": pixels.half(), "landmarks": pixels.double()},
        "gaps": {"image": torch.cat((image, image), 2)[:, :, ::2], "keypoints": torch.cat((pixels, pixels), 1)[:, ::2]},
        "turned in memory": {"image": image.mT.contiguous().mT, "keypoints": pixels.T.contiguous().T},
        "expanded": {"image": image[:1].expand(3, -1, -1), "keypoints": pixels[1:2].expand(5, -1)},
        "masks": {"image": image[:1], "mask": image[:1] > 99, "mask_b": image[:2].int(), "mask_c": image[0].double()},
        "many images": {f"image_{i}": (image + i).float() if i % 2 else image + i for i in range(10)},
        "a batch of one": {"image": image[None], "mask": image[None, 0], "keypoints": pixels[None]},
        "vectors": {
            "image": image,
            "gaze": torch.tensor([0.1, 0.2, -0.9]),
            "points": torch.cat((torch.rand(7, 3), torch.tensor([[nan, 1.0, 2.0]]))),
            "landmarks": torch.rand(2, 5, 3),
            "head_pose": torch.cat((torch.eye(3), torch.rand(3, 1)), 1),
            "rotation": torch.eye(3).mT,
        },
        "given flags": {"image": image, "keypoints": pixels[:, None], "keypoints_valid": torch.arange(9)[:, None] % 2},
    }


def test_what_is_kept_of_a_form_serves_no_other():
    """Images of one shape lie in memory in several ways here; labels alone are a batch, or of a face, by the type."""
    camera = example("brown_conrady", SIZE).requires_grad_(False)
    used, fresh = A.RandomMount(camera=camera), partial(A.RandomMount, camera=camera)
    odd = [odd_samples()[name] for name in ("gaps", "expanded", "turned in memory")]
    whole = [{name: value.contiguous() for name, value in form.items()} for form in odd]
    faces = {"keypoints": odd[0]["keypoints"][None]}
    for sample in [*whole, *odd, faces, Single(faces), *whole]:
        outs = []
        for augment in (used, used, fresh()):
            torch.manual_seed(0)
            outs.append(augment(sample))
        for out, name in product(outs[:2], {*sample, "keypoints_valid", "rotation"}):
            assert torch.equal(out[name], outs[2][name])


@pytest.mark.parametrize("name", ["mount", "lens", "chain that decides", "flipped chain"])
@pytest.mark.parametrize("form", odd_samples())
def test_odd_samples_as_step_by_step(form, name, monkeypatch):
    sample, camera = odd_samples()[form], example("brown_conrady", SIZE).requires_grad_(False)
    augment = A.RandomMount() if name == "mount" else A.RandomLens() if name == "lens" else AUGMENTATIONS[name]()
    for _ in range(2):  # of which the second is ready
        torch.manual_seed(0)
        out = augment(sample, camera=camera)
    monkeypatch.setattr(camtorch.augment.plan, "call_for", lambda *given: None)
    camtorch.augment.plan._own.calls = Kept(16)
    torch.manual_seed(0)
    expected = augment(sample, camera=camera)
    assert out.keys() == expected.keys()
    for field in expected.keys() - {"camera"}:
        least = 3e-7 * (ON_ARM and field == "points")
        torch.testing.assert_close(out[field], expected[field], rtol=0, atol=least, equal_nan=True)


@pytest.mark.parametrize("name", ["mount", "chain that decides", "flipped chain"])
def test_what_goes_at_once_makes_no_warp(name):
    camera, sample = example("brown_conrady", SIZE).requires_grad_(False), sample_for(torch.float32)
    augment = AUGMENTATIONS[name]()
    augment(sample, camera=camera)
    assert augment.last.parts[0].motion._warp is None


CHANGES = {
    "options": lambda augment, camera: augment.options.update(mode="nearest"),
    "mask_fill": lambda augment, camera: setattr(augment, "mask_fill", 5.0),
    "range": lambda augment, camera: augment.ranges.update(yaw=A.Range(20, 30)),
    "p": lambda augment, camera: setattr(augment, "p", 0.0),
    "size": lambda augment, camera: setattr(augment, "image_size", (80, 70)),
    "filled": lambda augment, camera: setattr(augment, "min_filled", 0.95),
    "valid_mask": lambda augment, camera: setattr(augment, "valid_mask", True),
    "keep": lambda augment, camera: augment.fields.update(mask="keep"),
    "values": lambda augment, camera: camera.intrinsics.data.mul_(1.1),
    "like": lambda augment, camera: augment.like is None or augment.like.distortion.data.mul_(0.5),
    "learns": lambda augment, camera: camera.requires_grad_(True),
    "precision": lambda augment, camera: camera.double(),
}


@pytest.mark.parametrize("kind", [A.RandomMount, A.RandomLens, partial(A.RandomCamera, "dms60", image_size=(90, 120))])
@pytest.mark.parametrize("change", CHANGES)
def test_what_is_ready_heeds_changes(change, kind):
    """An augmentation that has moved samples of a form does what a new one does, whatever has changed since."""
    vectors = {"boxes": torch.tensor([[20.0, 20, 60, 50]]), "gaze": torch.tensor([0.0, 0, -1]), "rvec": torch.rand(3)}
    outs = []
    for calls in (3, 0):
        augment, camera = kind(min_filled=0), example("kannala_brandt", SIZE).requires_grad_(False)
        sample = {**sample_for(torch.float32), **vectors, "pitch_yaw": torch.tensor([0.1, 0.2])}
        for _ in range(calls):
            augment(sample, camera=camera)
        assert not calls or not native_available() or camtorch.augment.plan._own.calls.result is not None  # C serves it
        CHANGES[change](augment, camera)
        torch.manual_seed(1)
        outs.append(augment(sample, camera=camera))
        back = augment.inverse(outs[-1])
        outs[-1] |= {f"{key}_back": value for key, value in back.items() if key in vectors}
    first, second = outs
    assert first.keys() == second.keys()
    for field in first.keys() - {"camera"}:
        torch.testing.assert_close(first[field], second[field], rtol=0, atol=0)
    torch.testing.assert_close(first["camera"].state_dict(), second["camera"].state_dict(), rtol=0, atol=0)


def test_samples_of_any_form_follow_each_other():
    """What one form of samples is known by says nothing of the next one."""
    random = np.random.default_rng(0)
    transform = camtorch.augment.numpy.Transform(A.RandomMount(camera=example("pinhole", SIZE).requires_grad_(False)))
    for shape, dtype in (((*SIZE, 3), "uint8"), (SIZE, "float32"), ((*SIZE, 1), "uint16"), ((*SIZE, 5), "uint8")):
        image = random.integers(0, 200, shape).astype(dtype)
        for keypoints, count in ((np.zeros((0, 2)), 0), ([[3, 4]], 1)):
            out = transform(image=image, keypoints=keypoints)
            assert (out["image"].shape, out["image"].dtype, out["keypoints"].shape) == (shape, dtype, (count, 2))
    boxes = np.array([[10.0, 20.0, 30.0, 40.0]])
    transform(image=image, bboxes=boxes)
    for text, fields in (
        (r"image must be of camera's image_size", {"image": image[:-1]}),
        (r"keypoints must be \(N, 2\)", {"keypoints": np.zeros((4, 3), np.float32)}),
        (r"bboxes must be x1, y1, x2, y2", {"bboxes": boxes[:, ::-1].copy()}),
        ("must have a kind", {"lidar": np.zeros((4, 3))}),
    ):
        with pytest.raises(ValueError, match=text):
            transform({"image": image, **fields})


@pytest.mark.skipif(not native_available(), reason="calls of C are kept")
def test_a_thread_keeps_few_calls_however_many_augmentations_move_samples():
    """A call holds a lattice of its own. Augmentations of the same options share one."""
    camera, calls = example("pinhole", SIZE).requires_grad_(False), camtorch.augment.plan._own.calls
    A.RandomMount(camera=camera)(sample_for(torch.float32))
    known = calls.result
    for fill in range(20):
        A.RandomMount(camera=camera)(sample_for(torch.float32))
        assert calls.result is known
        A.RandomMount(camera=camera, fill=fill + 1)(sample_for(torch.float32))
    assert len(calls._kept) == calls.capacity == 16


class Tagged(torch.Tensor):
    """A class of tensors, which results keep."""


def test_calls_of_plain_labels_serve_no_labels_of_another_class():
    camera, sample = example("pinhole", SIZE).requires_grad_(False), sample_for(torch.float32)
    labels = {"boxes": torch.tensor([[20.0, 20, 60, 50]]), "gaze": torch.tensor([0.0, 0, -1])}
    A.RandomMount(camera=camera)({**sample, **labels})
    out = A.RandomMount(camera=camera)(sample, **{name: value.as_subclass(Tagged) for name, value in labels.items()})
    assert isinstance(out["boxes"], Tagged)
    assert isinstance(out["gaze"], Tagged)
