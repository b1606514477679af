"""Augmentations and cameras as numbers, strings, lists and dicts, as albumentations' `A.save` writes them, and back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from torch import nn

from camtorch import augment
from camtorch.augment.augmentation import Augmentation
from camtorch.augment.landmarks import Mirroring, Table
from camtorch.augment.ranges import Range
from camtorch.augment.sample import Calls
from camtorch.cameras.camera import Camera
from camtorch.evaluate.kept import Kept
from camtorch.values.arguments import shown

_CLASS = "__class__"  # the key of a saved value's class
_CONTAINERS = tuple, dict, nn.ModuleList  # saved with their class; a list is written as it is
_SAVED: tuple[Any, ...] = *_CONTAINERS, Range, Mirroring, Table, Kept
_OF_MODULES = nn.Module().__dict__


def as_plain(value: Any, name: str) -> Any:
    """Return numbers, strings, lists and dicts, of which `from_plain` makes `value` again."""
    if value is None:
        return None
    for plain in (bool, int, float, str):
        if isinstance(value, plain):
            return plain(value)
    if isinstance(value, Camera):
        return {_CLASS: "Camera", **value.to_dict()}
    if isinstance(value, (list, *_CONTAINERS)):
        items = map(list, value.items()) if isinstance(value, dict) else value  # YAML sorts dicts; ranges have an order
        values = [as_plain(one, f"{name}[{i}]") for i, one in enumerate(items)]
        kind = next((kind for kind in _CONTAINERS if isinstance(value, kind)), None)
        return values if kind is None else {_CLASS: kind.__name__, "values": values}
    if isinstance(value, Augmentation):
        state = {n: v for n, v in vars(value).items() if n not in _OF_MODULES and not isinstance(v, Calls)}
        state |= value._modules | value._parameters | value._buffers
    elif isinstance(value, _SAVED):
        state = value.__getstate__()
    else:
        must = "numbers, strings, cameras, or lists or dicts of them, to be saved"
        raise TypeError(f"{name} must be {must}; got {shown(value)}. Pickle the pipeline instead")
    return {_CLASS: _name_of(type(value)), **{key: as_plain(one, f"{name}.{key}") for key, one in state.items()}}


def from_plain(value: Any, owner: str) -> Any:
    """Return the value that `as_plain` was given, and other values unchanged."""
    if isinstance(value, list):
        return [from_plain(one, owner) for one in value]
    if not isinstance(value, Mapping):
        return value
    state = {key: from_plain(one, owner) for key, one in value.items()}
    name = state.pop(_CLASS, "Camera")
    if name == "Camera":
        return Camera.from_dict(state)
    kinds = {_name_of(kind): kind for kind in (*_SAVED, *_augmentations(Augmentation))}
    if name not in kinds:
        raise ValueError(f"{owner}: an augmentation's class must be imported before A.load; got {name!r}")
    if "values" in state:
        return kinds[name](state["values"])
    made: Any = kinds[name].__new__(kinds[name])
    if not isinstance(made, Augmentation):
        made.__dict__.update(state)
        return made
    nn.Module.__init__(made)
    parts = {key: one for key, one in state.items() if key == "camera" or isinstance(one, nn.Module)}
    made.__setstate__({**vars(made), **{key: one for key, one in state.items() if key not in parts}})
    for key, one in parts.items():
        setattr(made, key, one)
    return made


def _augmentations(kind: type[Augmentation]) -> Iterator[type[Augmentation]]:
    """Yield a class and those that are made of it."""
    yield kind
    for subclass in kind.__subclasses__():
        yield from _augmentations(subclass)


def _name_of(kind: type) -> str:
    """Return the name of a class of camtorch, and the full name of an augmentation by somebody else."""
    known = kind in _SAVED or getattr(augment, kind.__name__, None) is kind
    return kind.__name__ if known else f"{kind.__module__}.{kind.__qualname__}"
