"""Stand-ins for the parts of torchvision that are used, for where its binary does not match torch."""

import contextlib
import enum
import functools
import importlib
import re
import sys
import types

import pytest
import torch

import camtorch as ct


class TVTensor(torch.Tensor):
    def __new__(cls, data, **meta):
        return cls._with(torch.as_tensor(data).as_subclass(cls), meta)

    @staticmethod
    def _with(tensor, meta):
        for name, value in meta.items():
            setattr(tensor, name, value)
        return tensor

    @classmethod
    def wrap(cls, tensor, like, **kwargs):
        return cls._with(tensor.as_subclass(cls), {k: kwargs.get(k, v) for k, v in like.__dict__.items()})

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        with torch._C.DisableTorchFunctionSubclass():
            result = func(*args, **(kwargs or {}))
        return result.as_subclass(torch.Tensor) if isinstance(result, TVTensor) else result


def stand_in():
    tv_tensors = types.ModuleType("torchvision.tv_tensors")
    tv_tensors.TVTensor = TVTensor
    for name in ("Image", "Video", "Mask", "KeyPoints", "BoundingBoxes"):
        setattr(tv_tensors, name, type(name, (TVTensor,), {}))
    names = ("XYXY", "XYWH", "CXCYWH", "XYWHR", "CXCYWHR", "XYXYXYXY")
    tv_tensors.BoundingBoxFormat = enum.Enum("BoundingBoxFormat", {name: name for name in names})
    tv_tensors.wrap = lambda wrappee, *, like, **kwargs: type(like).wrap(wrappee, like, **kwargs)

    def convert(boxes, old, new):
        one, two = boxes[..., :2], boxes[..., 2:]
        low = one - two / 2 if old.name == "CXCYWH" else one
        high = two if old.name == "XYXY" else low + two
        pairs = {"XYXY": (low, high), "XYWH": (low, high - low), "CXCYWH": ((low + high) / 2, high - low)}
        return torch.cat(pairs[new.name], -1)

    names = ("torchvision", "torchvision.transforms", "torchvision.transforms.v2")
    torchvision, transforms, v2 = (types.ModuleType(name) for name in names)
    v2.Transform, transforms.v2 = torch.nn.Module, v2
    v2.functional = types.SimpleNamespace(convert_bounding_box_format=convert)
    torchvision.tv_tensors, torchvision.transforms = tv_tensors, transforms
    return {module.__name__: module for module in (torchvision, transforms, v2, tv_tensors)}


DECLARED = torch.library.Library("torchvision", "FRAGMENT")


def import_error():
    try:
        importlib.import_module("torchvision.transforms.v2")
    except Exception as error:
        return error
    return None


@functools.cache
def why_not():
    """Why the real torchvision cannot be had; its transforms and tv_tensors can even where its binary does not load.

    Then the import stops at operators that the binary would have made; none of them is called here.
    """
    error = import_error()
    while missing := re.match(r"operator torchvision::(\w+) does not exist", str(error)):
        DECLARED.define(f"{missing[1]}(Tensor _) -> Tensor")
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        error = import_error()
    return error and f"torchvision cannot be imported: {type(error).__name__}: {error}"


@contextlib.contextmanager
def torchvision_of(kind, monkeypatch):
    """The tv_tensors of torchvision, "real", or of its stand-in; the front end may be imported meanwhile."""
    if kind == "stand-in":
        for name, module in stand_in().items():
            monkeypatch.setitem(sys.modules, name, module)
    elif why_not():
        pytest.skip(why_not())
    sys.modules.pop("camtorch.augment.torchvision", None)
    yield sys.modules["torchvision.tv_tensors"]
    sys.modules.pop("camtorch.augment.torchvision", None)
    vars(ct.augment).pop("torchvision", None)
