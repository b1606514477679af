"""The door: which way a call takes. Natively on a CPU where nothing is recorded, else as torch records the formula."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.evaluate.regime import (
    has_tangent,
    in_jit_trace,
    in_memory,
    is_concrete,
    is_recorded,
    keeps_graph,
    nothing_is_under_way,
)


class Way(NamedTuple):
    """How a call is evaluated."""

    is_native: bool
    """By compiled code, if that has the model."""
    learns: bool
    """Whether derivatives are recorded of what is compiled."""
    is_known: bool
    """Whether the values of the parameters may be looked at, so that what is made of them is kept."""
    order: int
    """Of the derivatives that the recorded formula must have exactly."""


_NATIVE, _LEARNING = Way(True, False, True, 2), Way(True, True, True, 2)


def way_of(values: Tensor, *parameters: Tensor, owner: str) -> Way:
    """Return the way of a call with values and parameters; a RuntimeError where torch could record none."""
    inputs = (values, *parameters)
    if nothing_is_under_way() and all((type(t) is Tensor and not t.is_meta) or is_concrete(t) for t in inputs):
        if in_jit_trace() and torch.onnx.is_in_onnx_export():
            raise RuntimeError(
                f"{owner}: torch.onnx.export(dynamo=False) cannot record a camera; dynamo=True can. "
                "What a frozen camera or warp keeps is a constant: camera.rays() and warp(images), with "
                "requires_grad_(False) and called once before the export"
            )
        if is_native(values):
            return _LEARNING if keeps_graph(*inputs) else _NATIVE
    is_known = all(is_concrete(t) and not has_tangent(t) for t in parameters)
    # what is compiled has no derivatives of derivatives
    return Way(False, False, is_known, 1 if torch.compiler.is_compiling() else 2)


def is_native(values: Tensor) -> bool:
    """Return whether compiled code may read values, of a call in which nothing is under way."""
    return in_memory(values) and not is_recorded()
