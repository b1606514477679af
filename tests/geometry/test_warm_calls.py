"""How many files and functions a warm call leads its reader through, and how many calls of torch it makes."""

import statistics
import sys
from pathlib import Path

import pytest
import torch
from cameras import needs_library, one
from torch.overrides import TorchFunctionMode

import camtorch as ct

pytestmark = needs_library

# files, functions
MOST = {"project": (4, 16), "unproject": (5, 18)}
ROOT = Path(ct.__file__).parent
MORE = 8  # calls of torch, for the dim of a batch of one


def entered(function, *arguments):
    """The (file, name) of every function of camtorch that a call enters."""
    seen = set()

    def note(frame, event, _):
        if event == "call" and ROOT in (path := Path(frame.f_code.co_filename)).parents:
            seen.add((path.relative_to(ROOT).as_posix(), frame.f_code.co_name))

    sys.setprofile(note)
    try:
        function(*arguments)
    finally:
        sys.setprofile(None)
    return seen


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", MOST)
@pytest.mark.parametrize("key", ["kannala_brandt", "brown_conrady", "fisheye624"])
def test_a_warm_call_is_a_short_way(key, method, dtype):
    camera = one(key).to(dtype).requires_grad_(False)
    values = torch.cat((torch.rand(1000, 2, dtype=dtype) - 0.5, torch.ones(1000, 1, dtype=dtype)), -1)
    if method == "unproject":
        values = camera.project(values)[0].contiguous()
    call = getattr(camera, method)
    assert call(values)[1].all()
    seen = entered(call, values)
    files, functions = MOST[method]
    assert len({path for path, _ in seen}) <= files, sorted(seen)
    assert len(seen) <= functions, sorted(seen)


class Calls(TorchFunctionMode):
    """Counts calls of torch but reads of properties."""

    count = 0

    def __torch_function__(self, func, types, args=(), kwargs=None):
        self.count += func.__name__ != "__get__"
        return func(*args, **(kwargs or {}))


def median_of_calls(function):
    counts = []
    for _ in range(10):
        with Calls() as calls:
            function()
        counts.append(calls.count)
    return statistics.median(counts[1:])


def warped(image):
    camera = ct.KannalaBrandt([300.0, 300.0, 319.5, 239.5], [0.01, -0.002, 0.001, 0.0], image_size=(480, 640))
    target = ct.Pinhole([300.0, 300.0, 319.5, 239.5], image_size=(480, 640))
    return ct.Warp(camera.requires_grad_(False), target.requires_grad_(False))(image)


def test_a_new_camera_and_its_warp_take_few_calls_of_torch():
    image = torch.rand(1, 3, 480, 640)
    assert median_of_calls(lambda: warped(image)) <= 180


def test_an_augmentation_takes_few_calls_of_torch():
    camera = ct.Pinhole([500.0, 500.0, 319.5, 239.5], image_size=(480, 640)).requires_grad_(False)
    augmentation = ct.augment.RandomCamera("kannala_brandt", fov=(60, 70), camera=camera)
    image = torch.zeros(8, 1, 480, 640, dtype=torch.uint8)
    sample = {"image": image, "mask": image, "keypoints": torch.rand(8, 68, 2) * 400}
    assert median_of_calls(lambda: augmentation(sample)) <= 400


def test_a_batch_of_one_takes_as_few_calls_of_torch_as_its_sample():
    camera = ct.BrownConrady([200.0, 200, 63.5, 63.5], [-0.1, 0.02, 0, 0], image_size=(128, 128)).requires_grad_(False)
    augmentation = ct.augment.RandomCamera()
    sample = {"image": torch.zeros(3, 128, 128, dtype=torch.uint8), "keypoints": torch.rand(68, 2) * 100}
    batch = {name: value[None] for name, value in sample.items()}
    least = median_of_calls(lambda: augmentation(sample, camera=camera))
    batches = camera.expand(1)
    assert median_of_calls(lambda: augmentation(batch, camera=batches)) <= least + MORE


def test_a_warp_takes_as_few_calls_of_torch_with_a_batch_of_one():
    camera = ct.BrownConrady([200.0, 200, 63.5, 63.5], [-0.1, 0.02, 0, 0], image_size=(128, 128)).requires_grad_(False)
    pixels, rotation = torch.rand(68, 2) * 100, torch.eye(3)
    least = median_of_calls(lambda: ct.Warp(camera, camera, rotation).transform_points(pixels))
    batch = camera.expand(1), camera.expand(1), rotation[None]
    assert median_of_calls(lambda: ct.Warp(*batch).transform_points(pixels[None])) <= least + MORE
