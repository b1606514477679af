"""Ray Data with two workers makes what one process makes, to the bit."""

import os
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

import camtorch as ct

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    ray = pytest.importorskip("ray", exc_type=ImportError)
    pytest.importorskip("ray.data", exc_type=ImportError)

SIZE = (48, 64)
COUNT = 24
# what its own code and pyarrow's warn of
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module")
def cluster():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # workers find this file
        environment = {"env_vars": {"PYTHONPATH": os.pathsep.join(sys.path)}}
        ray.init(
            num_cpus=4,  # two workers, and what feeds them
            include_dashboard=False,
            log_to_driver=False,
            configure_logging=False,
            runtime_env=environment,
        )
        ray.data.DataContext.get_current().enable_progress_bars = False
        yield
        ray.shutdown()


def camera():
    intrinsics, coefficients = torch.tensor([36.0, 36.4, 31.2, 23.1]), torch.tensor([0.02, -0.01, 0.004, -0.001])
    return ct.KannalaBrandt(intrinsics, coefficients, image_size=SIZE).requires_grad_(False)


def augmentation():
    return ct.augment.RandomCamera(
        yaw=8, pitch=8, roll=10, chromatic=0.003, vignetting=(0, 0.5), min_filled=0.9, camera=camera()
    )


def samples():
    rng = np.random.default_rng(0)
    return [
        {
            "path": f"day/{i}.jpg",
            "image": rng.integers(0, 255, (*SIZE, 3), np.uint8),
            "keypoints": rng.uniform(2, 40, (i % 3, 2)).astype(np.float32),
            "boxes": rng.uniform(2, 10, (1, 4)) * [1, 1, 3, 3],
            "gaze": np.float32([0.1, 0, -1]),
            "label": i,
        }
        for i in range(COUNT)
    ]


def by_one_process(function):
    """Rows by their paths, each from a batch of its own."""
    result = {}
    for row in samples():
        moved = function({name: np.asarray(value)[None] for name, value in row.items()})
        result[row["path"]] = {name: value[0] for name, value in moved.items()}
    return result


def assert_same(found, expected):
    assert len(found) == len(expected)
    for row in found:
        for name, value in expected[row["path"]].items():
            now = np.asarray(row[name])
            assert now.shape == np.shape(value), name
            assert now.dtype.kind == np.asarray(value).dtype.kind, name
            np.testing.assert_array_equal(now, value, err_msg=name)


class Where:
    """Says which process a batch was in; the first one waits for the second."""

    def __init__(self, folder):
        self.folder = Path(folder)

    def __call__(self, batch):
        (self.folder / str(os.getpid())).touch()
        deadline = time.monotonic() + 120
        while len(list(self.folder.iterdir())) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        return batch | {"process": np.full(len(batch["path"]), os.getpid())}


@pytest.mark.parametrize(("blocks", "size"), [(8, 2), (12, 5)])
def test_two_workers_make_what_one_process_makes(cluster, tmp_path, blocks, size):
    function = ct.data.MapBatches(augmentation(), key="path", seed=5, epoch=2)
    rows = ray.data.from_items(samples(), override_num_blocks=blocks)
    moved = rows.map_batches(function, batch_size=size).map_batches(
        Where, fn_constructor_args=(str(tmp_path),), compute=ray.data.ActorPoolStrategy(size=2), batch_size=size
    )
    found = moved.take_all()
    assert len({row.pop("process") for row in found}) == 2
    assert_same(found, by_one_process(function))


def test_actors_that_are_made_by_ray(cluster):
    rows = ray.data.from_items(samples(), override_num_blocks=4)
    dewarped = rows.map_batches(
        ct.data.MapBatches,
        fn_constructor_args=(ct.Dewarp(camera()),),
        compute=ray.data.ActorPoolStrategy(size=2),
        batch_size=5,
    )
    assert_same(dewarped.take_all(), by_one_process(ct.data.MapBatches(ct.Dewarp(camera()))))
