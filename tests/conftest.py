import gc
import os
import random
import sys
import warnings

import pytest

os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")  # its import asks a server, and warns if none answers


@pytest.hookimpl(wrapper=True)
def pytest_collection(session):
    """Prepare torch and hypothesis in each process that runs tests, before it imports them.

    Imported modules and tests stay: the garbage collector need not look at them, again and again, nor after every 700
    objects at what a test holds.
    """
    if session.config.pluginmanager.hasplugin("dsession"):  # xdist's own process waits for the others
        return (yield)
    gc.disable()
    import torch
    from hypothesis import settings

    with warnings.catch_warnings():
        # forward-mode derivatives load it on first use, and it uses the deprecated torch.jit.script
        warnings.simplefilter("ignore")
        import torch._decomp.decompositions_for_jvp
    # torch's own keeps a traceback for each kind of device, 0.9 ms of the 28 that a test takes
    if not torch.accelerator.is_available():
        torch.manual_seed = torch.default_generator.manual_seed
    # 9 ms for each of 670 files, 6 s in all; none must outlive a loss of power, and test_saving.py has its own
    os.fsync = lambda file: None
    # xdist has a process on every core already
    torch.set_num_threads(1)
    # the same examples on every machine and in every run; speed is not what these tests are about
    settings.register_profile("camtorch", derandomize=True, deadline=None, max_examples=5, database=None)
    settings.load_profile("camtorch")
    collected = yield
    gc.freeze()
    gc.set_threshold(50_000)
    gc.enable()
    return collected


def pytest_collection_modifyitems(items):
    """Begin with the longest, or one core has nothing to do while the other ends."""
    items.sort(key=lambda item: item.path.name not in ("test_devices.py", "test_same_everywhere.py"))


@pytest.fixture(autouse=True)
def _random_numbers_are_the_same():
    """In every run and on every machine, in whatever order tests run: what fails, fails again."""
    import numpy as np
    import torch

    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _compiled_code_is_forgotten():
    """Programs of one function are counted, and refused from the ninth on, also where tests of their own made them."""
    yield
    dynamo = sys.modules.get("torch._dynamo")
    if dynamo is not None and dynamo.convert_frame.FRAME_COUNTER:
        dynamo.reset()
