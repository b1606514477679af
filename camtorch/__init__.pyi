"""The public names and where each is, for type checkers and for `__init__.py`, which imports it at its first use."""

from camtorch import augment as augment
from camtorch import data as data
from camtorch import io as io
from camtorch import lenses as lenses
from camtorch import models as models
from camtorch import plot as plot
from camtorch.boards.finding import find_board as find_board
from camtorch.calibration.calibrate import calibrate as calibrate
from camtorch.calibration.from_rays import fit as fit
from camtorch.calibration.pnp import solve_pnp as solve_pnp
from camtorch.calibration.rig import calibrate_rig as calibrate_rig
from camtorch.calibration.triangulate import triangulate as triangulate
from camtorch.cameras.camera import Camera as Camera
from camtorch.cameras.mixed import Mixed as Mixed
from camtorch.cameras.mixed import cat as cat
from camtorch.cameras.rig import Rig as Rig
from camtorch.io import CameraFileError as CameraFileError
from camtorch.io import load as load
from camtorch.io import loads as loads
from camtorch.io import save as save
from camtorch.io.kornia import from_kornia as from_kornia
from camtorch.maps.formats import load_map as load_map
from camtorch.maps.formats import save_map as save_map
from camtorch.maps.lookup import LookupMap as LookupMap
from camtorch.models import *  # noqa: F403 (its stub has the list)
from camtorch.networks import losses as losses
from camtorch.networks.canonical import CanonicalCamera as CanonicalCamera
from camtorch.networks.head import CameraHead as CameraHead
from camtorch.poses.extrinsics import Extrinsics as Extrinsics
from camtorch.poses.extrinsics import head_angles as head_angles
from camtorch.poses.extrinsics import head_rotation as head_rotation
from camtorch.stereo.rectification import rectify as rectify
from camtorch.viewer.viewer import write_viewer as write_viewer
from camtorch.warp import views as views
from camtorch.warp.dewarp import Dewarp as Dewarp
from camtorch.warp.plane import BirdsEye as BirdsEye
from camtorch.warp.plane import PlaneWarp as PlaneWarp
from camtorch.warp.reproject import Reproject as Reproject
from camtorch.warp.shutter import RollingShutter as RollingShutter
from camtorch.warp.shutter import ShutterWarp as ShutterWarp
from camtorch.warp.vignetting import vignetting as vignetting
from camtorch.warp.warp import Warp as Warp

__version__: str
