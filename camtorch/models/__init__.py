"""The camera models, one file each."""

from camtorch.models.brown_conrady import BrownConrady
from camtorch.models.cylindrical import Cylindrical
from camtorch.models.double_sphere import DoubleSphere
from camtorch.models.equirectangular import Equirectangular
from camtorch.models.eucm import EUCM
from camtorch.models.fisheye62 import Fisheye62
from camtorch.models.fisheye624 import Fisheye624, FisheyeRadTanThinPrism
from camtorch.models.kannala_brandt import KannalaBrandt
from camtorch.models.mei import Mei
from camtorch.models.pinhole import Pinhole
from camtorch.models.ucm import UCM

__all__ = [
    "EUCM",
    "UCM",
    "BrownConrady",
    "Cylindrical",
    "DoubleSphere",
    "Equirectangular",
    "Fisheye62",
    "Fisheye624",
    "FisheyeRadTanThinPrism",
    "KannalaBrandt",
    "Mei",
    "Pinhole",
]
