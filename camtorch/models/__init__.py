"""The camera models, one file each.

The camera of parallel rays (orthographic, telecentric) is none of them: its rays do not pass one point, and a camera
here is a map between the directions from one point and pixels. `OrthographicFisheye` has r = sin(theta), which is
another thing.
"""

from camtorch.cameras.camera import MODELS
from camtorch.models.brown_conrady import BrownConrady
from camtorch.models.cylindrical import Cylindrical
from camtorch.models.division import Division
from camtorch.models.double_sphere import DoubleSphere
from camtorch.models.equirectangular import Equirectangular
from camtorch.models.equisolid import Equisolid
from camtorch.models.eucm import EUCM
from camtorch.models.f_theta import FTheta
from camtorch.models.f_theta import FThetaSheared as FThetaSheared
from camtorch.models.f_theta_backward import FThetaBackward
from camtorch.models.f_theta_backward import FThetaBackwardSheared as FThetaBackwardSheared
from camtorch.models.fisheye62 import Fisheye62
from camtorch.models.fisheye624 import Fisheye624, FisheyeRadTanThinPrism
from camtorch.models.fov import FOV
from camtorch.models.kannala_brandt import KannalaBrandt
from camtorch.models.lat_lon import LatLon
from camtorch.models.mei import Mei
from camtorch.models.ocamcalib import OCamCalib
from camtorch.models.orthographic_fisheye import OrthographicFisheye
from camtorch.models.pinhole import Pinhole
from camtorch.models.splined import Splined
from camtorch.models.stereographic import Stereographic
from camtorch.models.tabulated import Tabulated
from camtorch.models.thin_prism_fisheye import ThinPrismFisheye
from camtorch.models.transverse_cylindrical import TransverseCylindrical
from camtorch.models.ucm import UCM
from camtorch.models.woodscape import WoodScape

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
