"""Camera models by their keys, and by the names that other tools give them."""

import difflib
import functools
import importlib
import inspect
from collections.abc import Iterator, MutableMapping
from typing import Any, TypeVar, cast

from torch.nn.utils import parametrize

from camtorch.evaluate.recorded import register
from camtorch.optics.model_spec import ModelSpec
from camtorch.projection.camera_like import CameraLike
from camtorch.values.arguments import LEFT, shown

KindT = TypeVar("KindT", bound=type[CameraLike])

_NAMES = {
    "brown_conrady": "opencv plumb_bob radtan pinhole-radtan brown",
    "kannala_brandt": "fisheye opencv_fisheye equidistant pinhole-equi kb4",
    "double_sphere": "ds",
    "mei": "omnidir omni-radtan",
}
ELSEWHERE = {name: key for key, names in _NAMES.items() for name in names.split()}
"""Names of some models in OpenCV, ROS, Kalibr, Basalt and COLMAP."""


class Catalogue(MutableMapping[str, KindT]):
    """The classes that are defined, and the files of others, each of which is imported when its key is looked up."""

    def __init__(self) -> None:
        self.classes: dict[str, KindT] = {}
        self.files: dict[str, str] = {}

    def __getitem__(self, key: str) -> KindT:
        if key not in self.classes and key in self.files:
            importlib.import_module(self.files[key])
        return self.classes[key]

    def __setitem__(self, key: str, model: KindT) -> None:
        self.classes[key] = model

    def __delitem__(self, key: str) -> None:
        del self.classes[key]
        self.files.pop(key, None)

    def __iter__(self) -> Iterator[str]:
        return iter({**self.files, **self.classes})

    def __len__(self) -> int:
        return len({**self.files, **self.classes})

    def __repr__(self) -> str:
        return f"MODELS({', '.join(self)})"

    def add(self, model: Any) -> None:
        """Check the statements of a new model, and register it under its key."""
        for name in ("optics", "defined"):
            stated = inspect.getattr_static(model, name)
            if not isinstance(stated, staticmethod):
                raise TypeError(
                    f"{model.__name__}: {name} must be a @staticmethod of the coefficients k alone; got a "
                    f"{type(stated).__name__}"
                )
        model.operator_name = register(model)
        model.always_defined = model.defined is ModelSpec.defined
        if "key" not in model.__dict__:
            model.key = ""
            return
        known = self.get(model.key)
        # a class that is defined again, in a notebook, replaces itself
        if known is not None and (known.__module__, known.__qualname__) != (model.__module__, model.__qualname__):
            owner = f"{known.__module__}.{known.__qualname__}"
            raise ValueError(f"{model.__name__}: key must be unique; got {model.key!r}, which is that of {owner}")
        self[model.key] = model

    def model_for(self, model: Any, owner: str) -> KindT:
        """Return a camera model, or the one with that key."""
        if isinstance(model, str):
            key, *texts = model.split(":")
            if texts and key in self:
                return functools.reduce(lambda kind, text: cast("KindT", kind.variant(text)), texts, self[key])
            if model not in self:
                keys = {name.lower(): key for key, cls in self.items() for name in (key, cls.__name__)} | ELSEWHERE
                close = difflib.get_close_matches(model.lower(), keys, 1)
                how = f" (did you mean {keys[close[0]]!r}?)" if close else ""
                raise ValueError(f"{owner}: model must be one of {', '.join(sorted(self))}; got {model!r}{how}. {LEFT}")
            return self[model]
        if isinstance(model, type) and model.__module__ == parametrize.__name__:  # the class of one parametrized camera
            model = model.__bases__[0]
        if not (isinstance(model, type) and issubclass(model, CameraLike) and model.optics is not ModelSpec.optics):
            raise TypeError(f"{owner}: model must be a camera model, or its key in ct.MODELS; got {shown(model)}")
        return cast("KindT", model)
