"""Torch's private parts that camtorch uses in addition to those in `door`; tests check them on all versions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch.utils import _pytree

NO_TORCH_FUNCTION: Any = torch._C._disabled_torch_function_impl
"""The `__torch_function__` of a class of tensors whose operators return plain tensors."""
pytree = _pytree
"""Trees, with the paths of their leaves."""
TORCH_LIBRARY: str = torch._C.__file__
"""The shared library of torch, which has the functions of OpenMP and MKL that it uses."""


def while_loop(condition: Callable[..., Any], body: Callable[..., Any], state: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the state after a loop, which is recorded as one."""
    # torch does not import it at first
    from torch._higher_order_ops.while_loop import while_loop as loop

    return cast("tuple[Any, ...]", loop(condition, body, state))


def collate(batch: Any, functions: dict[Any, Callable[..., Any]]) -> Any:
    """Collate a batch as `default_collate` does, with a function for each type of its parts."""
    from torch.utils.data._utils.collate import collate as collate_by

    return collate_by(batch, collate_fn_map=functions)


def collate_functions() -> dict[Any, Callable[..., Any]]:
    """Return the functions of `default_collate`, which uses what is added to them."""
    from torch.utils.data._utils.collate import default_collate_fn_map

    return default_collate_fn_map
