"""Memory of large results, which is used again: memory that is new to a process takes as long to get as to sample."""

import ctypes
import functools
import math
import mmap
import weakref
from collections.abc import Callable
from contextlib import suppress

import torch
from torch import Tensor

LIMIT = 1 << 27
"""The most bytes that are kept for later results."""
LEAST = 1 << 18
"""The least bytes of a result that make this worth while. If results of a batch die together, the C library gives some
back to the system, and a worker of a DataLoader spent a third of the time of a sample on getting them again."""


def empty(shape: tuple[int, ...], dtype: torch.dtype, layout: torch.memory_format) -> Tensor:
    """Return an empty CPU tensor; large ones in pages that later results use again once no tensor is on them."""
    size, strides = _place(shape, dtype, layout)
    block = _block(size) if size >= LEAST else None
    if block is None:
        return torch.empty(shape, dtype=dtype, device="cpu", memory_format=layout)
    return tensor_on(block, dtype, shape, strides, lambda: _keep(block))


def tensor_on(
    block: mmap.mmap, dtype: torch.dtype, shape: tuple[int, ...], strides: tuple[int, ...], died: Callable[[], None]
) -> Tensor:
    """Return a tensor on the memory of a block; `died` is called when that memory is free."""
    memory = _bytes(len(block)).from_buffer(block)  # only the storage holds it
    weakref.finalize(memory, died).atexit = False
    count = math.prod(shape) * dtype.itemsize  # a storage is saved as a whole, so it has no bytes beyond the tensor's
    storage = torch.frombuffer(memory, dtype=torch.uint8, count=count).untyped_storage()
    # not a view, as some operations refuse views
    return torch.empty(0, dtype=dtype, device="cpu").set_(storage, 0, shape, strides)


@functools.lru_cache(maxsize=64)
def _bytes(count: int) -> type[ctypes.Array[ctypes.c_char]]:
    """Return the type of so many bytes, which ctypes makes anew each time."""
    return ctypes.c_char * count


@functools.lru_cache(maxsize=64)
def _place(shape: tuple[int, ...], dtype: torch.dtype, layout: torch.memory_format) -> tuple[int, tuple[int, ...]]:
    """Return the number of bytes, in whole pages so that large pages do not reach beyond, and the strides."""
    like = torch.empty(shape, dtype=dtype, device="meta", memory_format=layout)
    return -(-like.nbytes // mmap.PAGESIZE) * mmap.PAGESIZE, like.stride()


# There is no lock: a tensor may die wherever Python collects garbage, also within these functions. Each of their
# changes of the list is atomic. A fork's child has pages of its own.
_idle: list[mmap.mmap] = []


def _block(size: int) -> mmap.mmap | None:
    """Return `size` bytes: a kept block, or a new one; None if the system lacks large pages or the memory."""
    for block in tuple(_idle):
        if len(block) == size:
            with suppress(ValueError):  # another thread has it
                _idle.remove(block)
                return block
    if not hasattr(mmap, "MADV_HUGEPAGE"):
        return None
    with suppress(OSError):
        block = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        block.madvise(mmap.MADV_HUGEPAGE)  # small pages, each new to the process, would take several times as long
        return block
    return None


def _keep(block: mmap.mmap) -> None:
    """Keep a block, and drop the oldest ones if there are too many bytes."""
    _idle.append(block)
    while sum(map(len, tuple(_idle))) > LIMIT:
        with suppress(IndexError):  # another thread was here
            del _idle[0]
