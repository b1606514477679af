"""A single sample is made by one call of compiled code, to the very numbers that its change makes step by step."""

import math

import numpy as np
import pytest
import torch

import camtorch as ct
import camtorch.augment.numpy
from camtorch.augment import Compose, RandomCamera, RandomLens, RandomMount

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
    "mount": lambda: RandomMount(zoom=0.2, padding_mode="border"),
    "lens": lambda: RandomLens(mode="bicubic", fill=(1, 2, 3), mask_fill=7),
    "another lens": lambda: RandomCamera("dms60", image_size=(90, 120), min_filled=0),
    "filled": lambda: RandomMount(min_filled=0.9, p=0.7),
    "chain": lambda: Compose([RandomMount(), RandomLens()], antialias=False),
}


def sample_for(dtype):
    torch.manual_seed(0)
    pixels = torch.rand(9, 2, dtype=dtype) * 150 - 10
    image = torch.randint(256, (3, *SIZE), dtype=torch.uint8)
    mask = torch.randint(9, SIZE)
    return {"image": image, "mask": mask, "keypoints": pixels, "polygons": pixels.view(3, 3, 2)}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", AUGMENTATIONS)
@pytest.mark.parametrize("key", LENSES)
def test_as_step_by_step(key, name, dtype):
    camera = example(key, SIZE).to(dtype).requires_grad_(False)
    augment, sample = AUGMENTATIONS[name](), sample_for(dtype)
    for seed in range(2):
        torch.manual_seed(seed)
        out = augment(sample, camera=camera)
        change, fill = augment.last, augment.mask_fill
        assert torch.equal(out["image"], change.images(sample["image"][None])[0])
        assert torch.equal(out["mask"], change.labels(sample["mask"][None, None], fill)[0, 0])
        for field in ("keypoints", "polygons"):
            moved, valid = change.points(sample[field][None])
            torch.testing.assert_close(out[field], moved[0], rtol=0, atol=0)
            assert torch.equal(out[f"{field}_valid"], valid[0])
        assert torch.equal(out["rotation"], change.rotation[0])
        assert torch.equal(out["camera"].intrinsics, change.target.intrinsics[0])
        assert torch.equal(out["camera"].distortion, change.target.distortion[0])


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("name", AUGMENTATIONS)
@pytest.mark.parametrize("key", LENSES)
def test_batches_as_step_by_step(key, name, threads):
    """Each sample of a batch goes to a thread: the numbers do not depend on that."""
    camera, before = example(key, SIZE).requires_grad_(False), torch.get_num_threads()
    sample = {field: torch.stack([value, value.flip(-1)] * 2) for field, value in sample_for(torch.float32).items()}
    torch.manual_seed(0)
    augment = AUGMENTATIONS[name]()
    torch.set_num_threads(threads)
    try:
        out = augment(sample, camera=camera)
    finally:
        torch.set_num_threads(before)
    change = augment.last
    assert torch.equal(out["image"], change.images(sample["image"]))
    assert torch.equal(out["mask"], change.labels(sample["mask"][:, None], augment.mask_fill)[:, 0])
    assert torch.equal(out["keypoints"], change.points(sample["keypoints"])[0])


def test_what_comes_out_is_not_what_the_change_keeps():
    camera = example("brown_conrady", SIZE).requires_grad_(False)
    augment, sample = RandomMount(camera=camera), sample_for(torch.float32)
    out = augment(sample)
    before = augment.last.target.distortion.clone()
    with torch.no_grad():
        for tensor in (out["camera"].intrinsics, out["camera"].distortion, out["rotation"], out["image"]):
            tensor.fill_(1)
    assert torch.equal(augment.last.target.distortion, before)
    assert torch.equal(camera.distortion, example("brown_conrady", SIZE).distortion)
    back = augment.inverse(image=torch.zeros(3, *SIZE))
    assert back["image"].shape == (3, *SIZE)
    assert not torch.equal(augment.last.rotation[0], torch.ones(3, 3))
    with torch.inference_mode():
        made = augment(sample)["camera"]
    assert not made.intrinsics.is_inference()


def test_samples_of_any_layout_and_form_follow_each_other():
    """What one form of samples is known by says nothing of the next one."""
    random = np.random.default_rng(0)
    for front_end in range(2):
        transform = camtorch.augment.numpy.Transform(RandomMount(camera=example("pinhole", SIZE).requires_grad_(False)))
        for shape, dtype in (
            ((*SIZE, 3), np.uint8),
            (SIZE, np.float32),
            ((*SIZE, 1), np.uint16),
            ((*SIZE, 5), np.uint8),
        ):
            image = random.integers(0, 200, shape).astype(dtype)
            for array in (image, image[::-1], np.asfortranarray(image)):
                torch.manual_seed(front_end)
                out = transform(image=array, keypoints=np.zeros((0, 2)))
                torch.manual_seed(front_end)
                again = transform(image=np.ascontiguousarray(array), keypoints=[[3, 4]])
                assert out["image"].dtype == dtype
                # planes and channels side by side may be rounded otherwise
                np.testing.assert_allclose(out["image"].astype(float), again["image"].astype(float), rtol=1e-5, atol=1)
                assert (out["keypoints"].shape, again["keypoints"].shape) == ((0, 2), (1, 2))
    for size, axis in (((1, 48), 0), ((48, 1), 1)):  # numpy calls them contiguous
        row = np.flip(random.integers(0, 200, (*size, 3)).astype(np.uint8), axis)
        one = transform(image=row, camera=example("pinhole", size).requires_grad_(False))
        assert one["image"].shape == row.shape
    with pytest.raises(ValueError, match=r"image is .* but the image_size of camera"):
        transform(image=image[:-1])
    with pytest.raises(ValueError, match=r"keypoints must be \(N, 2\)"):
        transform(image=image, keypoints=np.zeros((4, 3), np.float32))
    boxes = np.array([[10.0, 20.0, 30.0, 40.0]])
    transform(image=image, bboxes=boxes)
    with pytest.raises(ValueError, match=r"bboxes must be x1, y1, x2, y2"):
        transform(image=image, bboxes=boxes[:, ::-1].copy())
    with pytest.raises(ValueError, match="holds real numbers"):
        transform(image=image, lidar=np.zeros((4, 3)))


@pytest.mark.parametrize("lead", [(), (2,)])
def test_pixels_of_half_precision_stay_finite(lead):
    """The image of a ray nearly across the axis is farther away than half precision has numbers."""
    focal = 40 / (math.pi / 2 - 5e-4)
    camera = ct.KannalaBrandt([focal, focal, 48.0, 32.0], [0.0] * 4, image_size=(64, 96)).requires_grad_(False)
    flat = dict.fromkeys(("yaw", "pitch", "roll", "focal", "centre", "distortion", "crop"))
    pixels = torch.tensor([[88.0, 32.0], [50.0, 30.0]]).half().expand(*lead, 2, 2)
    out = RandomCamera("pinhole", fov=(60, 60), camera=camera, **flat)(keypoints=pixels)
    assert out["keypoints"].dtype == torch.float16
    assert torch.isfinite(out["keypoints"]).all()
    assert out["keypoints_valid"].tolist() == torch.tensor([False, True]).expand(*lead, 2).tolist()
