"""Batches of a DataLoader's worker in memory that it shares with the process to which it sends them.

Memory is used again, or goes within the message if it is small. Memory that is new to a process takes as long to get as
images take to be augmented; and every tensor that torch sends has a file of its own, for which the other process has to
ask. This is the life of a block of such memory:

* A batch of this process lies in it. Once that is sent, the block's last byte says that another process has it.
* The batch died here, and the block is spare. The other process may still have its tensor, which sets the byte again
  when it dies: then the next batch takes the block.
* If one of both processes has forked meanwhile, the fork has the tensor for good, and the block is lost.
"""

from __future__ import annotations

import functools
import mmap
import os
import threading
import weakref
from collections.abc import Callable, Sequence
from multiprocessing.reduction import ForkingPickler
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing import get_sharing_strategy
from torch.multiprocessing.reductions import reduce_tensor

from camtorch.evaluate.door import NO_TORCH_FUNCTION
from camtorch.native.memory import LIMIT, tensor_on

_LEAST_SHARED_BYTES = 1 << 16
"""Bytes below which a tensor goes within the message."""
_MOST_BLOCKS = 32
"""Spare blocks that are here, and that another process has: for more batches than that, memory is torch's own."""
# the last byte of a block
_HOME = 0  # no other process has it
_AWAY = 1
_LOST = 2


class _Block:
    """Shared memory; see the module."""

    def __init__(self, size: int):
        self.size, self.forks = size, _forks
        self.file = os.memfd_create("camtorch")
        weakref.finalize(self, os.close, self.file).atexit = False
        os.ftruncate(self.file, size + 1)
        self.memory = _mapped(os.getpid(), self.file, size)
        self.address = torch.frombuffer(self.memory, dtype=torch.uint8).data_ptr()

    @property
    def is_lost(self) -> bool:
        state = self.memory[-1]
        return state == _LOST or (state == _HOME and self.forks != _forks)


class Sent(Tensor):
    """A batch in a worker, which comes out of the DataLoader as a plain tensor; so does what is computed from it."""

    block: _Block | None = None  # in which it lies
    __torch_function__ = NO_TORCH_FUNCTION

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self.as_subclass(Tensor).__reduce_ex__(protocol)  # to files and the like

    def __deepcopy__(self, memo: Any) -> Tensor:
        return self.as_subclass(Tensor).__deepcopy__(memo)  # type: ignore[no-any-return]


_spare: list[_Block] = []
"""Blocks in which no tensor of this process lies. Tensors die, and append to it, wherever Python collects garbage."""
_lock = threading.Lock()  # of what takes a block from the list
_forks = 0  # grows with each fork; blocks of before may have a tensor in the fork


def is_plain(value: Any) -> bool:
    """Whether it is a tensor that its bytes, dtype and shape say all of."""
    if type(value) is not Tensor or value.layout != torch.strided or not value.is_cpu:
        return False
    return not (value.requires_grad or value.is_quantized or value.is_conj() or value.is_neg())


def stacked(batch: Sequence[Tensor]) -> Tensor | None:
    """Return a worker's tensors of one shape as a batch ready to be sent; None if torch's own way does that."""
    first = batch[0]
    if any(tensor.dtype != first.dtype or not is_plain(tensor) for tensor in batch):
        return None
    like = torch.empty(len(batch), *first.shape, dtype=first.dtype, device="meta")
    if like.nbytes < _LEAST_SHARED_BYTES:
        return torch.stack(list(batch)).as_subclass(Sent)
    block = _free_block(like.nbytes)
    if block is None:
        return None
    memory = tensor_on(block.memory, like.dtype, like.shape, like.stride(), functools.partial(_spare.append, block))
    sent = torch.stack(list(batch), out=memory).as_subclass(Sent)
    sent.block = block
    return sent


def _free_block(size: int) -> _Block | None:
    """Return a free block of `size` bytes; None if the system or the user requires torch's own way of sharing."""
    if get_sharing_strategy() == "file_system" or not _can_open_files_of(os.getppid()):
        return None
    with _lock:
        for block in tuple(_spare):
            if block.is_lost:
                _spare.remove(block)
        here = [block for block in tuple(_spare) if block.memory[-1] == _HOME]
        for block in reversed(here):
            if block.size == size:
                _spare.remove(block)
                return block
        away = len(_spare) - len(here)
        while len(here) >= _MOST_BLOCKS or sum(block.size for block in here) > LIMIT:
            _spare.remove(here.pop(0))
    try:
        return _Block(size) if away < _MOST_BLOCKS else None
    except OSError:
        return None


@functools.cache
def _can_open_files_of(process: int) -> bool:
    """Whether files of such a process can be opened by others of the same user, as Linux has it."""
    try:
        return hasattr(os, "memfd_create") and bool(os.listdir(f"/proc/{process}/fd"))
    except OSError:
        return False


def _mapped(process: int, file: int, size: int) -> mmap.mmap:
    """Return the memory of a block, with its last byte, by the number that a process has for its file."""
    with open(f"/proc/{process}/fd/{file}", "r+b", buffering=0) as opened:
        return mmap.mmap(opened.fileno(), size + 1)


def _reduction(sent: Sent) -> tuple[Callable[..., Tensor], tuple[Any, ...]]:
    """Return the function and arguments by which another process makes the tensor."""
    block, form = sent.block, (sent.dtype, tuple(sent.shape))
    if sent.is_contiguous() and not sent.requires_grad:
        if block is not None and block.address == sent.data_ptr() and block.memory[-1] == _HOME:
            block.memory[-1] = _AWAY
            return _tensor_of_block, (os.getpid(), block.file, block.size, *form)
        if sent.nbytes < _LEAST_SHARED_BYTES:
            return _tensor_of_bytes, (sent.reshape(-1).view(torch.uint8).numpy().tobytes(), *form)
    copied = sent.detach().as_subclass(Tensor).clone().requires_grad_(sent.requires_grad)
    reduced: tuple[Callable[..., Tensor], tuple[Any, ...]] = reduce_tensor(copied)
    return reduced


def _tensor_of_block(process: int, file: int, size: int, dtype: torch.dtype, shape: tuple[int, ...]) -> Tensor:
    """Return the tensor that a worker sent in a block, which is the worker's again when the tensor dies."""
    memory, forks = _mapped(process, file, size), _forks

    def died() -> None:
        memory[-1] = _HOME if forks == _forks else _LOST

    return tensor_on(memory, dtype, shape, torch.empty(shape, device="meta").stride(), died)


def _tensor_of_bytes(data: bytes, dtype: torch.dtype, shape: tuple[int, ...]) -> Tensor:
    if not data:
        return torch.empty(shape, dtype=dtype, device="cpu")
    return torch.frombuffer(bytearray(data), dtype=dtype).view(shape)


def _forked() -> None:
    """Forget blocks that two processes have from now on: neither may write to them."""
    global _forks
    _forks += 1


ForkingPickler.register(Sent, _reduction)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_forked, after_in_parent=_forked, after_in_child=_forked)  # threads go on in between
