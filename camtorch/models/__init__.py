"""The camera models, one file each.

The camera of parallel rays (orthographic, telecentric) is not included: its rays do not pass one point, and a camera
here maps the directions from one point to pixels. `OrthographicFisheye`, r = sin(theta), is another model.
"""

import importlib
from typing import Any

from camtorch.cameras.camera import MODELS
from camtorch.values.arguments import LEFT
from camtorch.values.stub import listed_names

# the module of each class, which the first use of the class or of its key in MODELS imports
_PLACES = listed_names(__path__[0])
__all__ = sorted(_PLACES)
del _PLACES["MODELS"]
_PLACES |= {f"{name}Sheared": _PLACES[name] for name in ("FTheta", "FThetaBackward")}  # variants in the same files
_KEYS = {"LatLon": "latlon", "FThetaSheared": "f_theta_sheared", "FThetaBackwardSheared": "f_theta_backward_sheared"}
"""Keys of classes whose key is not the name of the file."""
MODELS.files.update(sorted((_KEYS.get(name, place.rpartition(".")[2]), place) for name, place in _PLACES.items()))


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}. {LEFT}")
    globals()[name] = found = getattr(importlib.import_module(_PLACES[name]), name)
    return found


def __dir__() -> list[str]:
    return [*(globals() | _PLACES)]
