"""Batches for a DataLoader of samples that hold cameras, and labels whose number differs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.sending import stacked, within_message
from camtorch.evaluate.known import in_worker
from camtorch.evaluate.private import collate as collate_by
from camtorch.evaluate.private import collate_functions
from camtorch.values.arguments import is_list


def collate(samples: Sequence[object]) -> object:
    """A batch of samples, of dicts, tuples or whatever they are: the `collate_fn` of a DataLoader.

    As torch's own `default_collate`, which stacks tensors, arrays and numbers; but tensors and arrays whose shapes
    differ, such as the keypoints of several faces, come as the list of tensors that the augmentations take. Cameras
    become a batch, or a `ct.Mixed` if they are of several models; so they do by `default_collate`. Their images are of
    one size: augment others in the workers, one by one.

    In a worker on Linux, batches go into shared memory that is used again when the main process has let go of them,
    as new memory takes as long to get as images take to be augmented; of no more bytes than were in use at once. What
    is small goes within the message. So the storage of what arrives cannot be resized. With torch's sharing strategy
    "file_system" all goes torch's own way.

    Raises:
        TypeError: no list of samples; what cannot be collated, as by `default_collate`. ValueError: an empty list,
            cameras whose images differ in size.
    """
    if not is_list(samples):
        raise TypeError(f"collate: samples must be a list of samples; got {type(samples).__name__}")
    if not samples:
        raise ValueError("collate: samples must not be empty; got an empty list")
    others = {kind: functools.partial(_others, function) for kind, function in collate_functions().items()}
    return collate_by(samples, {**others, Tensor: _tensors, np.ndarray: _arrays})


def _tensors(batch: Sequence[Tensor], *, collate_fn_map: Any = None) -> Tensor | list[Tensor]:
    if in_worker():  # which no graph can leave
        batch = [tensor.detach() for tensor in batch]
    if len({tensor.shape for tensor in batch}) > 1:
        return list(batch)
    sent = stacked(batch)
    return collate_functions()[Tensor](batch, collate_fn_map=collate_fn_map) if sent is None else sent


def _arrays(batch: Sequence[np.ndarray], *, collate_fn_map: Any = None) -> Tensor | list[Tensor]:
    return _tensors([torch.as_tensor(array) for array in batch], collate_fn_map=collate_fn_map)


def _others(function: Callable[..., Any], batch: Sequence[Any], *, collate_fn_map: Any = None) -> Any:
    return within_message(function(batch, collate_fn_map=collate_fn_map))
