"""The camera models, one file each."""

from camtorch.models.brown_conrady import BrownConrady
from camtorch.models.cylindrical import Cylindrical
from camtorch.models.equirectangular import Equirectangular
from camtorch.models.fisheye62 import Fisheye62
from camtorch.models.fisheye624 import Fisheye624, FisheyeRadTanThinPrism
from camtorch.models.kannala_brandt import KannalaBrandt
from camtorch.models.pinhole import Pinhole

__all__ = [
    "BrownConrady",
    "Cylindrical",
    "Equirectangular",
    "Fisheye62",
    "Fisheye624",
    "FisheyeRadTanThinPrism",
    "KannalaBrandt",
    "Pinhole",
]
