"""Batches for a DataLoader of samples with cameras, and with labels whose number differs.

Workers send them in shared memory that is used again or, if small, within the message. Memory that is new to a process
takes as long to get as images take to be augmented; and every tensor that torch sends has a file of its own, for which
the other process has to ask. This is the life of a block of such memory:

* Idle: no process has a tensor in it.
* Held: a batch of this process lies in it; once it is sent, the block's last byte says that another process has it.
* Away: the batch died here; the other process may still have its tensor, which sets the byte again when it dies.
* Idle again; or lost, if one of both processes has forked meanwhile, since the fork has the tensor for good.
"""

from __future__ import annotations

import functools
import mmap
import os
import pickle
import threading
import weakref
from collections.abc import Callable, Sequence
from multiprocessing.reduction import ForkingPickler
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.multiprocessing import get_sharing_strategy
from torch.multiprocessing.reductions import reduce_tensor

from camtorch.evaluate.door import COLLATE_FUNCTIONS, NO_TORCH_FUNCTION, collate_by
from camtorch.evaluate.tensors import in_worker
from camtorch.native.memory import LIMIT, tensor_on
from camtorch.values.arguments import is_list

_LEAST_SHARED_BYTES = 1 << 16
"""Bytes below which a tensor goes within the message."""
_MOST_BLOCKS = 32
"""Blocks that are idle, and blocks that are away: for those who keep more batches than that, memory is torch's own."""
# the last byte of a block
_HOME = 0  # it is idle or held
_AWAY = 1
_LOST = 2


def collate(samples: Sequence[object]) -> object:
    """Return a batch of samples, such as dicts or tuples: the `collate_fn` of a DataLoader.

    It works like torch's `default_collate`, which stacks tensors, arrays and numbers, except that tensors and arrays of
    different shapes, such as the keypoints of several faces, become the list of tensors that augmentations take.
    Cameras become a batch, or a `ct.Mixed` if they are of several models, as in `default_collate`. Their images must be
    of one size: augment others in the workers, one by one. In a worker on Linux, batches go into shared memory, which
    is used again once the main process has released it, as allocating memory takes as long as augmenting images. It
    holds no more bytes than were in use at once. Small values go within the message. The storage of the results cannot
    be resized. With torch's sharing strategy "file_system" everything goes torch's own way.

    Raises:
        TypeError: If samples are no list, or cannot be collated by `default_collate` either. ValueError: If the list is
            empty, or the cameras' images differ in size.
    """
    if not is_list(samples):
        raise TypeError(f"collate: samples must be a list of samples; got {type(samples).__name__}")
    if not samples:
        raise ValueError("collate: samples must not be empty; got an empty list")
    others = {kind: functools.partial(_others, function) for kind, function in COLLATE_FUNCTIONS.items()}
    return collate_by(samples, collate_fn_map={**others, Tensor: _tensors, np.ndarray: _arrays})


def _tensors(batch: Sequence[Tensor], *, collate_fn_map: Any = None) -> Tensor | list[Tensor]:
    if in_worker():  # no graph can leave a worker
        batch = [tensor.detach() for tensor in batch]
    if len({tensor.shape for tensor in batch}) > 1:
        return list(batch)
    sent = _stacked(batch)
    return COLLATE_FUNCTIONS[Tensor](batch, collate_fn_map=collate_fn_map) if sent is None else sent


def _arrays(batch: Sequence[np.ndarray], *, collate_fn_map: Any = None) -> Tensor | list[Tensor]:
    return _tensors([torch.as_tensor(array) for array in batch], collate_fn_map=collate_fn_map)


def _others(function: Callable[..., Any], batch: Sequence[Any], *, collate_fn_map: Any = None) -> Any:
    """Return values collated by torch's `function`, in a worker so that small tensors go by value."""
    value = function(batch, collate_fn_map=collate_fn_map)
    if not in_worker():
        return value
    if _is_plain(value):
        return value.as_subclass(_Sent)
    if isinstance(value, nn.Module):
        ForkingPickler.register(type(value), lambda module: (pickle.loads, (pickle.dumps(module),)))
    return value


class _Sent(Tensor):
    """A batch in a worker, which comes out of the DataLoader as a plain tensor; so does what is computed from it."""

    __torch_function__ = NO_TORCH_FUNCTION

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self.as_subclass(Tensor).__reduce_ex__(protocol)  # to files and the like

    def __deepcopy__(self, memo: Any) -> Tensor:
        return self.as_subclass(Tensor).__deepcopy__(memo)  # type: ignore[no-any-return]


class _Block:
    """Shared memory; see the module."""

    def __init__(self, size: int):
        self.size, self.forks = size, _forks
        self.file = os.memfd_create("camtorch")
        weakref.finalize(self, os.close, self.file).atexit = False
        os.ftruncate(self.file, size + 1)
        self.memory = _mapped(os.getpid(), self.file, size)

    def batch_died(self, address: int) -> None:
        """Be held no more: the block is away if its batch was sent, and else idle, as its last byte says."""
        del _held[address]
        _away.append(self)


_held: dict[int, _Block] = {}
"""Blocks in which this process has a tensor, by their addresses."""
_away: list[_Block] = []
"""Blocks in which another process may have a tensor."""
_idle: list[_Block] = []
_lock = threading.Lock()  # of the lists; `batch_died` goes without it: tensors die wherever Python collects garbage
_forks = 0  # grows with each fork; blocks of before may have a tensor in the fork


def _is_plain(value: Any) -> bool:
    """Whether it is a tensor that its bytes, dtype and shape say all of."""
    if type(value) is not Tensor or value.layout != torch.strided or not value.is_cpu:
        return False
    return not (value.requires_grad or value.is_quantized or value.is_conj() or value.is_neg())


def _stacked(batch: Sequence[Tensor]) -> Tensor | None:
    """Return tensors of one shape as a batch ready to be sent; None outside of workers, and if torch's own way does."""
    first = batch[0]
    if not in_worker() or any(t.dtype != first.dtype or not _is_plain(t) for t in batch):
        return None
    like = torch.empty(len(batch), *first.shape, dtype=first.dtype, device="meta")
    if like.nbytes < _LEAST_SHARED_BYTES:
        return torch.stack(list(batch)).as_subclass(_Sent)
    block = _free_block(like.nbytes)
    if block is None:
        return None
    address = torch.frombuffer(block.memory, dtype=torch.uint8).data_ptr()
    _held[address] = block
    died = functools.partial(block.batch_died, address)
    result = tensor_on(block.memory, like.dtype, like.shape, like.stride(), died)
    return torch.stack(list(batch), out=result).as_subclass(_Sent)


def _free_block(size: int) -> _Block | None:
    """Return a free block of `size` bytes; None if the system or the user requires torch's own way of sharing."""
    if get_sharing_strategy() == "file_system" or not _can_open_files_of(os.getppid()):
        return None
    with _lock:
        for block in [block for block in _away if block.memory[-1] != _AWAY]:
            _away.remove(block)
            _idle.append(block)
        _idle[:] = [block for block in _idle if block.memory[-1] == _HOME and block.forks == _forks]  # else lost
        for i in reversed(range(len(_idle))):
            if _idle[i].size == size:
                return _idle.pop(i)
        while len(_idle) >= _MOST_BLOCKS or sum(block.size for block in _idle) > LIMIT:
            del _idle[0]
    try:
        return _Block(size) if len(_away) < _MOST_BLOCKS else None
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


def _reduction(sent: _Sent) -> tuple[Callable[..., Tensor], tuple[Any, ...]]:
    """Return the function and arguments by which another process makes the tensor."""
    block, form = _held.get(sent.data_ptr()), (sent.dtype, tuple(sent.shape))
    if sent.is_contiguous() and not sent.requires_grad:
        if block is not None and block.memory[-1] == _HOME:
            block.memory[-1] = _AWAY
            return _tensor_of_block, (os.getpid(), block.file, block.size, *form)
        if sent.nbytes < _LEAST_SHARED_BYTES:
            return _tensor_of_bytes, (sent.reshape(-1).view(torch.uint8).numpy().tobytes(), *form)
    reduced: tuple[Callable[..., Tensor], tuple[Any, ...]] = reduce_tensor(
        sent.detach().as_subclass(Tensor).clone().requires_grad_(sent.requires_grad)
    )
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


ForkingPickler.register(_Sent, _reduction)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_forked, after_in_parent=_forked, after_in_child=_forked)  # threads go on in between
