"""Cameras as layers for PyTorch: learnable camera models, exact in both directions, and every warp between them."""

import importlib
import importlib.util
import sys
import threading
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from camtorch._public import *  # noqa: F403 (the list is there)
    from camtorch.models import *  # noqa: F403

_NAMES = {
    "": "augment data io lenses models plot",
    "boards.finding": "find_board",
    "calibration.calibrate": "calibrate",
    "calibration.from_rays": "fit",
    "calibration.pnp": "solve_pnp",
    "calibration.rig": "calibrate_rig",
    "calibration.triangulate": "triangulate",
    "cameras.camera": "Camera",
    "cameras.mixed": "Mixed cat",
    "cameras.rig": "Rig",
    "io": "CameraFileError load loads save",
    "io.kornia": "from_kornia",
    "maps.formats": "load_map save_map",
    "maps.lookup": "LookupMap",
    "models": "BrownConrady Cylindrical Division DoubleSphere EUCM Equirectangular Equisolid FOV FTheta FThetaBackward "
    "Fisheye62 Fisheye624 FisheyeRadTanThinPrism KannalaBrandt LatLon MODELS Mei OCamCalib OrthographicFisheye Pinhole "
    "Splined Stereographic Tabulated ThinPrismFisheye TransverseCylindrical UCM WoodScape",
    "networks": "losses",
    "networks.canonical": "CanonicalCamera",
    "networks.head": "CameraHead",
    "poses.extrinsics": "Extrinsics head_angles head_rotation",
    "stereo.rectification": "rectify",
    "viewer.viewer": "write_viewer",
    "warp": "views",
    "warp.dewarp": "Dewarp",
    "warp.plane": "BirdsEye PlaneWarp",
    "warp.reproject": "Reproject",
    "warp.shutter": "RollingShutter ShutterWarp",
    "warp.vignetting": "vignetting",
    "warp.warp": "Warp",
}
_PLACES = {name: f"camtorch.{place}".rstrip(".") for place, names in _NAMES.items() for name in names.split()}
"""The module or package of camtorch in which each public name is found."""

__version__ = "0.4.0"
__all__ = sorted(_PLACES)

# What is public needs torch, which takes a second to import; `camtorch --help` does not. So names come at first use.
_REGISTERED = f"{__name__}.cameras"  # has torch know operators of saved programs, and batches of cameras
_LOCK = threading.RLock()  # a package and its files, imported by two threads at once, could be seen half made

if not TYPE_CHECKING:  # a checker knows the names, and no others

    def __getattr__(name: str) -> Any:
        place = _PLACES.get(name)
        with _LOCK:
            if place is not None:
                importlib.import_module(_REGISTERED)
            if place is not None and place != __name__:
                module = importlib.import_module(place)
                found = getattr(module, name, None) or importlib.import_module(f"{place}.{name}")
            elif not name.startswith("_") and importlib.util.find_spec(f"{__name__}.{name}"):
                found = importlib.import_module(f"{__name__}.{name}")
            else:
                from camtorch.values.arguments import LEFT

                raise AttributeError(f"module {__name__!r} has no attribute {name!r}. {LEFT}")
        globals()[name] = found
        return found


def __dir__() -> list[str]:
    # packages that were imported on the way are not the public surface
    return [*__all__, *(name for name in globals() if name.startswith("__"))]


if "torch" in sys.modules:  # what `torch.export.load` reads may have camtorch's operators
    importlib.import_module(_REGISTERED)
