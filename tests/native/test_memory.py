"""Laws of the memory of large results: it is used again, and never while anybody has it."""

import copy
import mmap
import os
import pickle
import threading

import pytest
import torch
from cameras import needs_library

import camtorch as ct
from camtorch.native import memory

LAYOUTS = (torch.contiguous_format, torch.channels_last)
SHAPE = (2, 3, 640, 480)  # 7 MB of float32

pytestmark = pytest.mark.skipif(not hasattr(mmap, "MADV_HUGEPAGE"), reason="the system has no large pages")


@pytest.fixture(autouse=True)
def nothing_kept():
    memory._idle.clear()
    yield
    memory._idle.clear()


def made(dtype=torch.float32, shape=SHAPE, layout=torch.contiguous_format):
    return memory.empty(shape, dtype, layout)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dtype", [torch.uint8, torch.bool, torch.float16, torch.float32, torch.float64])
def test_it_is_as_empty_is(dtype, layout):
    for shape in (SHAPE, (1, 3, 2000, 3000), (8, 1, 2000, 3000), (2, 3, 1, 1 << 22)):
        result, expected = made(dtype, shape, layout), torch.empty(shape, dtype=dtype, memory_format=layout)
        for tensor in (result, expected):
            assert tensor.dtype == dtype
            assert (tensor.shape, tensor.stride()) == (expected.shape, expected.stride())
            assert tensor.storage_offset() == 0
            assert not tensor._is_view()
            assert not tensor.requires_grad
            assert tensor.device.type == "cpu"


def test_memory_is_used_again_when_all_have_let_go_of_it():
    holders = {
        "itself": lambda t: t,
        "a view": lambda t: t[1, 2, 5:9, ::7],
        "an array": lambda t: t[0, 0].numpy(),
        "its storage": lambda t: t.untyped_storage(),
        "a parameter": lambda t: torch.nn.Parameter(t),
        "a capsule": lambda t: torch.utils.dlpack.to_dlpack(t),
        "a graph": lambda t: (torch.ones((), requires_grad=True) * t).sum(),
    }
    for name, hold in holders.items():
        tensor = made()
        place = tensor.data_ptr()
        held = hold(tensor)
        del tensor
        assert made().data_ptr() != place, name
        memory._idle.clear()
        del held
        assert made().data_ptr() == place, name
        memory._idle.clear()


def test_what_is_kept_has_a_limit():
    tensors = [made() for _ in range(40)]
    assert sum(t.nbytes for t in tensors) > 2 * memory.LIMIT
    del tensors
    assert memory.LIMIT / 2 < sum(map(len, memory._idle)) <= memory.LIMIT
    del memory._idle[1:]
    large = made(shape=(16, 3, 1024, 1024))
    assert large.nbytes > memory.LIMIT
    del large
    assert not memory._idle


def test_it_can_be_copied_sent_and_shared():
    tensor = made().fill_(3)
    for other in (copy.deepcopy(tensor), pickle.loads(pickle.dumps(tensor)), tensor.clone()):
        assert torch.equal(other, tensor)
        assert other.data_ptr() != tensor.data_ptr()
    odd = made(shape=(3, 301, 401))  # which ends within a page
    assert odd.untyped_storage().nbytes() == odd.nbytes
    place = tensor.data_ptr()
    assert torch.equal(tensor.share_memory_(), torch.full(SHAPE, 3.0))
    assert made().data_ptr() == place  # which sharing has left


def test_threads_never_share_it():
    wrong = []

    def work(number):
        for _ in range(20):
            tensor = made().fill_(number)
            if not bool((tensor == number).all()):
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert sum(map(len, memory._idle)) <= memory.LIMIT


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_child_has_memory_of_its_own():
    tensor = made().fill_(1)
    made()  # kept
    child = os.fork()
    if not child:
        try:
            again = made()
            again.view(-1)[:9] = 7
            tensor.view(-1)[:9] = 7
            del tensor
        finally:
            os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert bool((tensor == 1).all())


@needs_library
@pytest.mark.parametrize("layout", LAYOUTS)
def test_results_of_warps_are_of_it(layout):
    source = ct.KannalaBrandt([700.0, 700, 640, 360], [0.02, -0.01, 0.004, -0.001], image_size=(720, 1280))
    warp = ct.Dewarp(source.requires_grad_(False))
    images = torch.rand(1, 3, 720, 1280, generator=torch.Generator().manual_seed(0)).contiguous(memory_format=layout)
    first = warp(images)
    expected, place = first.clone(), first.data_ptr()
    second = warp(images)
    assert second.data_ptr() != place
    assert torch.equal(first, expected)
    assert second.stride() == images.stride()
    del first
    with torch.device("meta"):
        third = warp(images)
    assert third.data_ptr() == place
    assert torch.equal(third, second)
    assert torch.equal(second, expected)
