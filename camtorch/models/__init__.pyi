"""The camera models and the file of each, for type checkers, for `__init__.py`, and for `camtorch`."""

import camtorch.models.f_theta
import camtorch.models.f_theta_backward
from camtorch.cameras.camera import MODELS as MODELS
from camtorch.models.brown_conrady import BrownConrady as BrownConrady
from camtorch.models.cylindrical import Cylindrical as Cylindrical
from camtorch.models.division import Division as Division
from camtorch.models.double_sphere import DoubleSphere as DoubleSphere
from camtorch.models.equirectangular import Equirectangular as Equirectangular
from camtorch.models.equisolid import Equisolid as Equisolid
from camtorch.models.eucm import EUCM as EUCM
from camtorch.models.f_theta import FTheta as FTheta
from camtorch.models.f_theta_backward import FThetaBackward as FThetaBackward
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

# variants, which are no names of `camtorch`
FThetaSheared = camtorch.models.f_theta.FThetaSheared
FThetaBackwardSheared = camtorch.models.f_theta_backward.FThetaBackwardSheared
