"""Modules whose own tensors are constants of an exported program."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from camtorch.evaluate.door import is_exporting, is_fake, keeps_graph, set_aside


def is_constant(module: nn.Module) -> bool:
    """Whether a module is exported whose tensors are its own, not given, and do not learn: their values are known."""
    if not is_exporting() or torch.compiler.is_dynamo_compiling():
        return False
    for part in module.modules():
        own = part.__dict__.get("_own", {})
        for name, tensor in (*part._parameters.items(), *part._buffers.items()):
            known = own.get(name)
            if tensor is None or tensor is known:
                continue
            if known is None or not is_fake(tensor) or is_fake(known) or keeps_graph(tensor):
                return False
            mode: Any = getattr(tensor, "fake_mode", None)
            if mode.from_tensor(known, static_shapes=True) is not tensor:
                return False
    return True


@contextmanager
def with_values(module: nn.Module) -> Iterator[None]:
    """Nothing is traced in here, and a module that `is_constant` has its own tensors, to make constants from."""
    places: list[tuple[dict[str, Any], str, Tensor]] = []
    for part in module.modules():
        own = part.__dict__.get("_own", {})
        places += [(tensors, name, own[name]) for tensors in (part._parameters, part._buffers) for name in tensors]
    traced = [tensors[name] for tensors, name, _ in places]
    with set_aside():
        try:
            for tensors, name, own in places:
                tensors[name] = own
            yield
        finally:
            for (tensors, name, _), tensor in zip(places, traced, strict=True):
                tensors[name] = tensor
