"""Functions of cameras that compiled graphs call as one operator, without tracing them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.evaluate.recorded import CLASSES, Registry
from camtorch.values.module import remade

Function = Callable[..., tuple[Tensor, ...]]


def fixed_camera(
    model: type[Camera], intrinsics: Tensor, distortion: Tensor, image_size: Sequence[int] | None = None
) -> Camera:
    """Return the camera of unchecked numbers (*B, 4) and (*B, n), without a graph; bad ones give invalid results."""
    size = None if image_size is None else (image_size[0], image_size[1])
    template = _ideal_camera(model, distortion.shape[-1])  # type: ignore[arg-type]  # a class can be hashed
    return remade(template, intrinsics=intrinsics.detach(), distortion=distortion.detach(), image_size=size)


@functools.lru_cache(maxsize=32)
def _ideal_camera(model: type[Camera], count: int) -> Camera:
    with torch.inference_mode(False):
        return model(torch.ones(4), *[torch.tensor(model.ideal(n)) for n in (count,) if n])


class CameraNumbers(NamedTuple):
    """The tensors and the size of a camera before it has values."""

    intrinsics: Tensor
    distortion: Tensor
    image_size: tuple[int, int]


_FUNCTIONS = Registry()  # each function with its `shapes`


def opaque(shapes: Function) -> Callable[[Function], Function]:
    """Return a decorator for functions of cameras with an image_size, tensors, None, floats, strings and pairs of ints.

    Compiled graphs pass cameras without their derivatives, and no result may share memory with an argument. `shapes`
    makes empty tensors like the results, from the same arguments with `CameraNumbers` for cameras.
    """

    def decorate(function: Function) -> Function:
        name = f"{function.__module__}.{function.__qualname__}"
        _FUNCTIONS[name] = function, shapes

        @functools.wraps(function)
        def call(*arguments: Any) -> tuple[Tensor, ...]:
            if not torch.compiler.is_compiling():
                return function(*arguments)
            kinds: list[str] = []
            tensors: list[Tensor] = []
            sizes: list[int] = []
            floats: list[float] = []
            for argument in arguments:
                if isinstance(argument, Camera):
                    kinds.append(f"camera {argument.operator_name}")
                    tensors += [argument.intrinsics.detach(), argument.distortion.detach()]
                    sizes += argument.size_for(name)
                elif isinstance(argument, Tensor):
                    kinds.append("tensor")
                    tensors.append(argument)
                elif isinstance(argument, float):
                    kinds.append("float")
                    floats.append(argument)
                elif isinstance(argument, tuple):
                    kinds.append("pair")
                    sizes += argument
                else:
                    kinds.append("none" if argument is None else f"text {argument}")
            return tuple(_computed(name, "\n".join(kinds), tensors, sizes, floats))

        return call

    return decorate


def _arguments(
    kinds: str, tensors: Sequence[Tensor], sizes: Sequence[int], floats: Sequence[float], camera: Callable[..., Any]
) -> list[Any]:
    numbers, sides, shares = iter(tensors), iter(sizes), iter(floats)
    arguments: list[Any] = []
    for kind, _, text in (line.partition(" ") for line in kinds.split("\n")):
        if kind == "camera":
            arguments.append(camera(CLASSES[text], next(numbers), next(numbers), (next(sides), next(sides))))
        elif kind == "tensor":
            arguments.append(next(numbers))
        elif kind == "float":
            arguments.append(next(shares))
        elif kind == "pair":
            arguments.append((next(sides), next(sides)))
        else:
            arguments.append(text if kind == "text" else None)
    return arguments


@torch.library.custom_op("camtorch::computed", mutates_args=())
def _computed(
    name: str, kinds: str, tensors: Sequence[Tensor], sizes: Sequence[int], floats: Sequence[float]
) -> list[Tensor]:
    return list(_FUNCTIONS[name][0](*_arguments(kinds, tensors, sizes, floats, fixed_camera)))


@_computed.register_fake
def _(name: str, kinds: str, tensors: Sequence[Tensor], sizes: Sequence[int], floats: Sequence[float]) -> list[Tensor]:
    arguments = _arguments(kinds, tensors, sizes, floats, lambda _, *numbers: CameraNumbers(*numbers))
    return list(_FUNCTIONS[name][1](*arguments))


@_computed.register_vmap
def _(info: Any, in_dims: Any, name: str, kinds: str, tensors: Sequence[Tensor], *others: Any) -> tuple[Any, Any]:
    def row(i: int) -> list[Tensor]:
        return [t if dim is None else t.select(dim, i) for t, dim in zip(tensors, in_dims[2], strict=True)]

    rows = [_computed(name, kinds, row(i), *others) for i in range(info.batch_size)]
    results = [torch.stack(same) for same in zip(*rows, strict=True)]
    return results, [0] * len(results)
