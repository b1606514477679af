"""Ray Data with two workers makes what one process makes, to the bit."""

import os
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from test_data import augmentation, camera, rows

import camtorch as ct

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    ray = pytest.importorskip("ray", exc_type=ImportError)
    pytest.importorskip("ray.data", exc_type=ImportError)

# what its own code and pyarrow's warn of
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module")
def cluster():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # workers find this file; two of them, and what feeds them
        environment = {"env_vars": {"PYTHONPATH": os.pathsep.join(sys.path)}}
        ray.init(num_cpus=4, include_dashboard=False, log_to_driver=False, configure_logging=False,
                 runtime_env=environment)  # fmt: skip
        ray.data.DataContext.get_current().enable_progress_bars = False
        yield
        ray.shutdown()


def samples():
    return rows(24, ragged=True)


def assert_made_as_by_one_process(found, function):
    """Each row as of a batch of its own."""
    assert len(found) == len(samples())
    given = {row["path"]: row for row in samples()}
    for row in found:
        expected = function({name: np.asarray(value)[None] for name, value in given[row["path"]].items()})
        for name, (value,) in expected.items():
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
    function = ct.data.MapBatches(augmentation(chromatic=0.003, vignetting=(0, 0.5)), key="path", seed=5, epoch=2)
    moved = ray.data.from_items(samples(), override_num_blocks=blocks).map_batches(function, batch_size=size)
    actors = {"fn_constructor_args": (str(tmp_path),), "compute": ray.data.ActorPoolStrategy(size=2)}
    found = moved.map_batches(Where, batch_size=size, **actors).take_all()
    assert len({row.pop("process") for row in found}) == 2
    assert_made_as_by_one_process(found, function)


def test_actors_that_are_made_by_ray(cluster):
    numbers = ray.data.from_items(samples(), override_num_blocks=4).map(lambda row: row | ct.data.to_columns(camera()))
    actors = {"fn_constructor_args": (ct.Dewarp,), "compute": ray.data.ActorPoolStrategy(size=2)}
    dewarped = numbers.map_batches(ct.data.MapBatches, batch_size=5, **actors)
    assert_made_as_by_one_process(dewarped.take_all(), ct.data.MapBatches(ct.Dewarp(camera())))


def test_what_is_wrong_names_the_sample(cluster):
    given = ray.data.from_items([row | {"image": row["image"][:-1]} for row in samples()[:1]])
    function = ct.data.MapBatches(augmentation(), key="path")
    with pytest.raises(Exception, match=r"MapBatches: sample 'day/0.jpg': RandomCamera: image is \(23, 32\)"):
        given.map_batches(function).take_all()
