"""A missing library speaks: once a process, at the first call that is much slower without it."""

import functools
import os
import warnings

import pytest
import torch

import camtorch as ct
from camtorch.native import library

CAMERA = ct.KannalaBrandt.from_fov(100, image_size=(48, 64))
MANY = torch.rand(1_000_000, 3)
CALLS = {
    "warp": lambda camera: ct.Dewarp(camera)(torch.zeros(1, 3, 48, 64)),
    "learning warp": lambda camera: ct.Dewarp(camera.requires_grad_())(torch.zeros(1, 3, 48, 64)),
    "sample": lambda camera: ct.augment.RandomMount(yaw=9, camera=camera)(image=torch.zeros(3, 48, 64)),
    "labels": lambda camera: ct.augment.RandomMount(yaw=9, camera=camera)(keypoints=torch.zeros(5, 2)),
    "project": lambda camera: camera.project(MANY),
    "unproject": lambda camera: camera.unproject(MANY[:, :2]),
}


@pytest.fixture
def missing(monkeypatch):
    """A process that has not looked for its library yet, which is not there."""
    cached = [f for f in vars(library).values() if isinstance(f, functools._lru_cache_wrapper)]
    monkeypatch.setattr(library, "LIBRARY", "none.so")
    monkeypatch.setattr(library, "REASON", "none.txt")
    monkeypatch.delenv("CAMTORCH_NATIVE", raising=False)
    monkeypatch.setattr(library, "_told", set())
    for each in cached:
        each.cache_clear()
    yield monkeypatch
    for each in cached:
        each.cache_clear()


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_the_first_call_that_is_much_slower_warns(call, missing):
    CAMERA.clone().project(MANY[1:])  # warnings are errors here
    says = (
        r"library is not built \(.*C compiler `python -m camtorch.native.build` .* 4 to 80 times as long\. CAMTORCH_NAT"
    )
    with pytest.warns(UserWarning, match=says) as caught:
        call(CAMERA.clone())
    assert [warning.filename for warning in caught] == [__file__]
    call(CAMERA.clone())


def test_nothing_is_said_if_the_environment_turned_it_off(missing):
    missing.setenv("CAMTORCH_NATIVE", "0")
    for call in CALLS.values():
        call(CAMERA.clone())


def warp(_):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        CALLS["warp"](CAMERA.clone())
    return len(caught)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_the_first_worker_of_a_loader_speaks_for_all(missing):
    loader = torch.utils.data.DataLoader(range(4), num_workers=2, collate_fn=warp, multiprocessing_context="fork")
    assert [*loader] == [1, 0, 0, 0]
