"""The names that `camtorch` shows: this file imports what `camtorch/__init__.py` hands out at first use."""

from camtorch import augment, data, io, lenses
from camtorch.calibration.calibrate import Calibration, calibrate
from camtorch.calibration.from_rays import fit
from camtorch.calibration.pnp import solve_pnp
from camtorch.calibration.report import write_report
from camtorch.calibration.rig import RigCalibration, calibrate_rig
from camtorch.calibration.triangulate import triangulate
from camtorch.camera import MODELS, Camera
from camtorch.convert.conversion import Conversion
from camtorch.extrinsics import Extrinsics
from camtorch.io import CameraFileError, load, save
from camtorch.maps.formats import load_map
from camtorch.maps.lookup import LookupMap
from camtorch.maps.report import MapReport
from camtorch.mixed import Mixed
from camtorch.models import (
    EUCM,
    FOV,
    UCM,
    BrownConrady,
    Cylindrical,
    Division,
    DoubleSphere,
    Equirectangular,
    Equisolid,
    Fisheye62,
    Fisheye624,
    FisheyeRadTanThinPrism,
    FTheta,
    FThetaBackward,
    KannalaBrandt,
    LatLon,
    Mei,
    OCamCalib,
    OrthographicFisheye,
    Pinhole,
    Stereographic,
    Tabulated,
    ThinPrismFisheye,
    TransverseCylindrical,
    WoodScape,
)
from camtorch.native.library import native_available
from camtorch.networks import losses
from camtorch.networks.canonical import CanonicalCamera
from camtorch.networks.head import CameraHead
from camtorch.parametrize import PositiveFocal, TiedFocal
from camtorch.rig import Rig
from camtorch.stereo.rectification import Rectification, rectify
from camtorch.warp import views
from camtorch.warp.dewarp import Dewarp
from camtorch.warp.light import vignetting
from camtorch.warp.plane import BirdsEye, PlaneWarp
from camtorch.warp.reproject import Reproject
from camtorch.warp.shutter import RollingShutter
from camtorch.warp.surround import Surround, surround
from camtorch.warp.warp import Warp

__all__ = [
    "EUCM",
    "FOV",
    "MODELS",
    "UCM",
    "BirdsEye",
    "BrownConrady",
    "Calibration",
    "Camera",
    "CameraFileError",
    "CameraHead",
    "CanonicalCamera",
    "Conversion",
    "Cylindrical",
    "Dewarp",
    "Division",
    "DoubleSphere",
    "Equirectangular",
    "Equisolid",
    "Extrinsics",
    "FTheta",
    "FThetaBackward",
    "Fisheye62",
    "Fisheye624",
    "FisheyeRadTanThinPrism",
    "KannalaBrandt",
    "LatLon",
    "LookupMap",
    "MapReport",
    "Mei",
    "Mixed",
    "OCamCalib",
    "OrthographicFisheye",
    "Pinhole",
    "PlaneWarp",
    "PositiveFocal",
    "Rectification",
    "Reproject",
    "Rig",
    "RigCalibration",
    "RollingShutter",
    "Stereographic",
    "Surround",
    "Tabulated",
    "ThinPrismFisheye",
    "TiedFocal",
    "TransverseCylindrical",
    "Warp",
    "WoodScape",
    "augment",
    "calibrate",
    "calibrate_rig",
    "data",
    "fit",
    "io",
    "lenses",
    "load",
    "load_map",
    "losses",
    "native_available",
    "rectify",
    "save",
    "solve_pnp",
    "surround",
    "triangulate",
    "views",
    "vignetting",
    "write_report",
]
