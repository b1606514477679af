"""The camera models, one file each.

The camera of parallel rays (orthographic, telecentric) is not included: its rays do not pass one point, and a camera
here maps the directions from one point to pixels. `OrthographicFisheye`, r = sin(theta), is another model.
"""

import importlib
import re
from typing import TYPE_CHECKING, Any

from camtorch.cameras.camera import MODELS
from camtorch.values.arguments import LEFT

if TYPE_CHECKING:
    from camtorch.models.brown_conrady import BrownConrady as BrownConrady
    from camtorch.models.cylindrical import Cylindrical as Cylindrical
    from camtorch.models.division import Division as Division
    from camtorch.models.double_sphere import DoubleSphere as DoubleSphere
    from camtorch.models.equirectangular import Equirectangular as Equirectangular
    from camtorch.models.equisolid import Equisolid as Equisolid
    from camtorch.models.eucm import EUCM as EUCM
    from camtorch.models.f_theta import FTheta as FTheta
    from camtorch.models.f_theta import FThetaSheared as FThetaSheared
    from camtorch.models.f_theta_backward import FThetaBackward as FThetaBackward
    from camtorch.models.f_theta_backward import FThetaBackwardSheared as FThetaBackwardSheared
    from camtorch.models.fisheye62 import Fisheye62 as Fisheye62
    from camtorch.models.fisheye624 import Fisheye624 as Fisheye624
    from camtorch.models.fisheye624 import FisheyeRadTanThinPrism as FisheyeRadTanThinPrism
    from camtorch.models.fov import FOV as FOV
    from camtorch.models.kannala_brandt import KannalaBrandt as KannalaBrandt
    from camtorch.models.lat_lon import LatLon as LatLon
    from camtorch.models.mei import Mei as Mei
    from camtorch.models.ocamcalib import OCamCalib as OCamCalib
    from camtorch.models.orthographic_fisheye import OrthographicFisheye as OrthographicFisheye
    from camtorch.models.pinhole import Pinhole as Pinhole
    from camtorch.models.splined import Splined as Splined
    from camtorch.models.stereographic import Stereographic as Stereographic
    from camtorch.models.tabulated import Tabulated as Tabulated
    from camtorch.models.thin_prism_fisheye import ThinPrismFisheye as ThinPrismFisheye
    from camtorch.models.transverse_cylindrical import TransverseCylindrical as TransverseCylindrical
    from camtorch.models.ucm import UCM as UCM
    from camtorch.models.woodscape import WoodScape as WoodScape

__all__ = [
    "EUCM",
    "FOV",
    "MODELS",
    "UCM",
    "BrownConrady",
    "Cylindrical",
    "Division",
    "DoubleSphere",
    "Equirectangular",
    "Equisolid",
    "FTheta",
    "FThetaBackward",
    "Fisheye62",
    "Fisheye624",
    "FisheyeRadTanThinPrism",
    "KannalaBrandt",
    "LatLon",
    "Mei",
    "OCamCalib",
    "OrthographicFisheye",
    "Pinhole",
    "Splined",
    "Stereographic",
    "Tabulated",
    "ThinPrismFisheye",
    "TransverseCylindrical",
    "WoodScape",
]

# the file of each class, which the first use of the class or of its key in MODELS imports
_FILES = {name: re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower() for name in __all__ if name != "MODELS"} | {
    "FTheta": "f_theta",
    "FThetaSheared": "f_theta",
    "FThetaBackward": "f_theta_backward",
    "FThetaBackwardSheared": "f_theta_backward",
    "FisheyeRadTanThinPrism": "fisheye624",
    "OCamCalib": "ocamcalib",
    "WoodScape": "woodscape",
}
_KEYS = {"LatLon": "latlon", "FThetaSheared": "f_theta_sheared", "FThetaBackwardSheared": "f_theta_backward_sheared"}
"""Keys of classes whose key is not the name of the file."""


MODELS.files.update(sorted((_KEYS.get(name, file), f"{__name__}.{file}") for name, file in _FILES.items()))

if not TYPE_CHECKING:  # type checkers must see only the names above

    def __getattr__(name: str) -> Any:
        if name not in _FILES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}. {LEFT}")
        globals()[name] = found = getattr(importlib.import_module(f"{__name__}.{_FILES[name]}"), name)
        return found


def __dir__() -> list[str]:
    return [*(globals() | _FILES)]
