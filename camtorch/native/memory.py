"""Memory of large results, which is used again: to get what is new to a process takes as long as to sample."""

from __future__ import annotations

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
"""Bytes that are kept, at most, for results to come."""
LEAST = 1 << 18
"""Bytes of a result from which on it is worth while. Of the results of a batch that die together the C library gives
some back to the system, and in a worker of a DataLoader a third of the time of a sample went to getting them again."""


def empty(shape: tuple[int, ...], dtype: torch.dtype, layout: torch.memory_format) -> Tensor:
    """Return `torch.empty` on the CPU, in memory of large pages that nobody else gets while anything on it lives."""
    size, strides = _place(shape, dtype, layout)
    block = _block(size)
    if block is None:
        return torch.empty(shape, dtype=dtype, device="cpu", memory_format=layout)
    return tensor_on(block, dtype, shape, strides, lambda: _keep(block))


def tensor_on(
    block: mmap.mmap, dtype: torch.dtype, shape: tuple[int, ...], strides: tuple[int, ...], died: Callable[[], None]
) -> Tensor:
    """A tensor on the memory of a block; and what is called when it is gone."""
    memory = (ctypes.c_char * len(block)).from_buffer(block)  # which the storage holds, and nothing else
    weakref.finalize(memory, died).atexit = False
    count = math.prod(shape) * dtype.itemsize  # a storage is saved as a whole, so of the tensor's bytes alone
    storage = torch.frombuffer(memory, dtype=torch.uint8, count=count).untyped_storage()
    # not a view, of which there are things that cannot be done
    return torch.empty(0, dtype=dtype, device="cpu").set_(storage, 0, shape, strides)


@functools.lru_cache(maxsize=64)
def _place(shape: tuple[int, ...], dtype: torch.dtype, layout: torch.memory_format) -> tuple[int, tuple[int, ...]]:
    """Bytes of whole pages, with large ones within them and not beyond, and strides."""
    like = torch.empty(shape, dtype=dtype, device="meta", memory_format=layout)
    return -(-like.nbytes // mmap.PAGESIZE) * mmap.PAGESIZE, like.stride()


def release() -> None:
    """Give back to the system what is kept."""
    _idle.clear()


# No lock: a tensor may die wherever Python collects garbage, also within these functions. What they do to the list is
# done at once. A fork's child has pages of its own.
_idle: list[mmap.mmap] = []


def _block(size: int) -> mmap.mmap | None:
    """Of so many bytes: one that is kept, or a new one if the system has large pages, and so much memory."""
    for block in tuple(_idle):
        if len(block) == size:
            try:
                _idle.remove(block)
            except ValueError:  # another thread has it
                continue
            return block
    if not hasattr(mmap, "MADV_HUGEPAGE"):
        return None
    try:
        block = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        block.madvise(mmap.MADV_HUGEPAGE)  # small ones, each new to the process, would take several times as long
    except OSError:
        return None
    return block


def _keep(block: mmap.mmap) -> None:
    """Of what is kept, the oldest goes first."""
    _idle.append(block)
    while sum(map(len, tuple(_idle))) > LIMIT:
        with suppress(IndexError):  # another thread was here
            del _idle[0]
