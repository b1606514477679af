"""Ray Data with two workers makes what one process makes, to the bit."""

import os
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from test_data import augmentation, batch, camera, rows

import camtorch as ct

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    ray = pytest.importorskip("ray", exc_type=ImportError)
    pytest.importorskip("ray.data", exc_type=ImportError)

# what its own code and pyarrow's warn of
pytestmark = pytest.mark.filterwarnings("ignore")
ROWS = rows(24, ragged=True)


@pytest.fixture(scope="module")
def cluster():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # two workers, and what feeds them; workers find this file
        environment = {"env_vars": {"PYTHONPATH": os.pathsep.join(sys.path)}}
        quiet = {"include_dashboard": False, "log_to_driver": False, "configure_logging": False}
        ray.init(num_cpus=4, runtime_env=environment, **quiet)
        ray.data.DataContext.get_current().enable_progress_bars = False
        yield
        ray.shutdown()


def assert_as_by_one_process(found, function):
    """Rows are what a batch of each alone becomes."""
    expected = {row["path"]: function(batch([row])) for row in ROWS}
    assert len(found) == len(ROWS)
    for row in found:
        for name, (value,) in expected[row["path"]].items():
            now = np.asarray(row[name])
            assert now.shape == np.shape(value), name
            assert now.dtype.kind == np.asarray(value).dtype.kind, name
            np.testing.assert_array_equal(now, value, err_msg=name)


class Where:
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
    function = ct.data.MapBatches(augmentation(chromatic=0.003, vignetting=(0, 0.5)), key="path", seed=5, epoch=2)
    moved = ray.data.from_items(ROWS, override_num_blocks=blocks).map_batches(function, batch_size=size)
    two = {"compute": ray.data.ActorPoolStrategy(size=2), "batch_size": size}
    found = moved.map_batches(Where, fn_constructor_args=(str(tmp_path),), **two).take_all()
    assert len({row.pop("process") for row in found}) == 2
    assert_as_by_one_process(found, function)


def test_actors_that_are_made_by_ray(cluster):
    two = {"compute": ray.data.ActorPoolStrategy(size=2), "batch_size": 5}
    moved = ray.data.from_items(ROWS, override_num_blocks=4)
    moved = moved.map_batches(ct.data.MapBatches, fn_constructor_args=(ct.Dewarp(camera()),), **two)
    assert_as_by_one_process(moved.take_all(), ct.data.MapBatches(ct.Dewarp(camera())))
