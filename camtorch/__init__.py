"""Cameras as layers for PyTorch: learnable camera models, exact in both directions, and every warp between them."""

from camtorch import augment, io
from camtorch.camera import MODELS, Camera
from camtorch.dewarp import Dewarp
from camtorch.extrinsics import Extrinsics
from camtorch.io import CameraFileError
from camtorch.models import (
    EUCM,
    UCM,
    BrownConrady,
    Cylindrical,
    DoubleSphere,
    Equirectangular,
    Fisheye62,
    Fisheye624,
    FisheyeRadTanThinPrism,
    KannalaBrandt,
    Mei,
    Pinhole,
)
from camtorch.warp import Warp

__version__ = "0.1.0"

__all__ = [
    "EUCM",
    "MODELS",
    "UCM",
    "BrownConrady",
    "Camera",
    "CameraFileError",
    "Cylindrical",
    "Dewarp",
    "DoubleSphere",
    "Equirectangular",
    "Extrinsics",
    "Fisheye62",
    "Fisheye624",
    "FisheyeRadTanThinPrism",
    "KannalaBrandt",
    "Mei",
    "Pinhole",
    "Warp",
    "augment",
    "io",
]
