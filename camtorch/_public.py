"""The names that `camtorch` shows: this file imports what `camtorch/__init__.py` hands out at first use."""

from camtorch import augment, cabin, data, io, lenses, models, plot
from camtorch.boards.finding import BoardObservations, find_board
from camtorch.calibration.calibrate import Calibration, calibrate
from camtorch.calibration.from_rays import fit
from camtorch.calibration.hand_eye import HandEyeCalibration, calibrate_hand_eye
from camtorch.calibration.pnp import solve_pnp
from camtorch.calibration.rig import RigCalibration, calibrate_rig
from camtorch.calibration.triangulate import triangulate
from camtorch.camera import Camera
from camtorch.convert.conversion import Conversion
from camtorch.extrinsics import Extrinsics, head_angles, head_rotation
from camtorch.io import CameraFileError, load, save
from camtorch.maps.formats import load_map
from camtorch.maps.lookup import LookupMap
from camtorch.maps.report import MapReport
from camtorch.mixed import Mixed, cat
from camtorch.models import *  # noqa: F403 (the list is there)
from camtorch.native.library import native_available
from camtorch.networks import losses
from camtorch.networks.canonical import CanonicalCamera
from camtorch.networks.head import CameraHead
from camtorch.parametrize import PositiveFocal, TiedFocal
from camtorch.report.report import write_report
from camtorch.rig import Rig
from camtorch.stereo.rectification import Rectification, rectify
from camtorch.viewer.viewer import write_viewer
from camtorch.warp import views
from camtorch.warp.dewarp import Dewarp
from camtorch.warp.plane import BirdsEye, PlaneWarp
from camtorch.warp.reproject import Reproject
from camtorch.warp.shutter import RollingShutter
from camtorch.warp.surround import Surround, surround
from camtorch.warp.vignetting import vignetting
from camtorch.warp.warp import Warp
from camtorch.windshield import Windshield

__all__ = [
    "BirdsEye",
    "BoardObservations",
    "Calibration",
    "Camera",
    "CameraFileError",
    "CameraHead",
    "CanonicalCamera",
    "Conversion",
    "Dewarp",
    "Extrinsics",
    "HandEyeCalibration",
    "LookupMap",
    "MapReport",
    "Mixed",
    "PlaneWarp",
    "PositiveFocal",
    "Rectification",
    "Reproject",
    "Rig",
    "RigCalibration",
    "RollingShutter",
    "Surround",
    "TiedFocal",
    "Warp",
    "Windshield",
    "augment",
    "cabin",
    "calibrate",
    "calibrate_hand_eye",
    "calibrate_rig",
    "cat",
    "data",
    "find_board",
    "fit",
    "head_angles",
    "head_rotation",
    "io",
    "lenses",
    "load",
    "load_map",
    "losses",
    "native_available",
    "plot",
    "rectify",
    "save",
    "solve_pnp",
    "surround",
    "triangulate",
    "views",
    "vignetting",
    "write_report",
    "write_viewer",
]
__all__ += models.__all__
