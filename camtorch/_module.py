"""What all modules of camtorch are: parameters that hold geometry, and a memo of what follows from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from camtorch._tracing import has_tangent, in_graph, in_transform, is_concrete

if TYPE_CHECKING:
    from typing_extensions import Self


class GeometryModule(nn.Module):
    """A module whose tensors are geometry: Parameters, or tensors of a graph, never of less than float32."""

    def hold(self, name: str, value: Tensor, shape: tuple[int, ...]) -> None:
        """Register plain values as a new Parameter of that shape, a Parameter or a tensor of a graph as it is.

        Those keep their own shape, which broadcasts to `shape`: a lens shared by a batch of cameras stays one.
        """
        wide = torch.promote_types(value.dtype, torch.float32)
        if shape[-1] == 0:  # an optimizer has nothing to learn here
            self.register_buffer(name, value.detach().expand(shape), persistent=False)
        elif isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
        elif in_graph(value):
            self.register_buffer(name, value.to(wide), persistent=False)
        else:
            self.register_parameter(name, nn.Parameter(value.detach().to(wide).expand(shape).clone()))

    def freeze_like(self, *sources: nn.Module) -> Self:
        """Leave nothing to learn where the modules that this one was made from have nothing either."""
        tensors = [t for source in sources for t in (*source.parameters(), *source.buffers())]
        if not any(t.requires_grad for t in tensors):
            for parameter in self.parameters():
                parameter.requires_grad = False
        return self

    def _apply(self, fn, recurse=True):
        # network.half() must not round a principal point to whole pixels
        def at_least_float32(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            if moved.is_floating_point() and torch.finfo(moved.dtype).bits < 32:
                return tensor.to(moved.device)
            return moved

        return super()._apply(at_least_float32, recurse)

    def __getstate__(self):
        # a tensor of a graph cannot be copied with its graph: the copy is a leaf
        state = self.__dict__.copy()
        state["_buffers"] = {
            name: b if b is None or b.is_leaf else b.detach().requires_grad_() for name, b in self._buffers.items()
        }
        return state


class Memo:
    """The last result of a computation, kept until one of its inputs changes.

    Values are compared, not versions: a change through `.data`, or by functional_call, leaves no other trace.
    Nothing is kept while the values may not be looked at. Copies and pickles begin empty.
    """

    def __init__(self):
        self._kept = None

    def __call__(self, inputs: Sequence[Tensor], options: tuple, compute: Callable[[], object]):
        """`compute()` without a graph, or its kept result; it depends on the tensors `inputs` and on `options`."""
        if not all(is_concrete(t) and not has_tangent(t) for t in inputs):
            return compute()
        if self._kept is not None:
            kept_inputs, kept_options, result = self._kept
            if options == kept_options and all(map(same, inputs, kept_inputs)):
                return result
        if in_transform():  # what a transform makes dies with it
            return compute()
        # what inference mode makes could not be used in a graph later
        with torch.inference_mode(False), torch.no_grad():
            copies = [t.detach().clone() for t in inputs]
            result = compute()
        self._kept = (copies, options, result)
        return result

    def __getstate__(self):
        return {"_kept": None}


def same(a: Tensor, b: Tensor) -> bool:
    """Whether shape, dtype, device and all values agree."""
    return a.shape == b.shape and a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)
