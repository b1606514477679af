"""Batches for a DataLoader of samples with cameras, and with labels whose number differs."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable, Sequence
from multiprocessing.reduction import ForkingPickler
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from camtorch.evaluate.door import COLLATE_FUNCTIONS, collate_by
from camtorch.evaluate.tensors import in_worker
from camtorch.native.shared_memory import Sent, is_plain, stacked
from camtorch.values.arguments import is_list


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
    sent = stacked(batch) if in_worker() else None
    return COLLATE_FUNCTIONS[Tensor](batch, collate_fn_map=collate_fn_map) if sent is None else sent


def _arrays(batch: Sequence[np.ndarray], *, collate_fn_map: Any = None) -> Tensor | list[Tensor]:
    return _tensors([torch.as_tensor(array) for array in batch], collate_fn_map=collate_fn_map)


def _others(function: Callable[..., Any], batch: Sequence[Any], *, collate_fn_map: Any = None) -> Any:
    """Return values collated by torch's `function`, in a worker so that small tensors go by value."""
    value = function(batch, collate_fn_map=collate_fn_map)
    if not in_worker():
        return value
    if is_plain(value):
        return value.as_subclass(Sent)
    if isinstance(value, nn.Module):
        ForkingPickler.register(type(value), lambda module: (pickle.loads, (pickle.dumps(module),)))
    return value
