"""Cameras as layers for PyTorch: learnable camera models, exact in both directions, and every warp between them."""

from camtorch.camera import MODELS, Camera
from camtorch.models import (
    BrownConrady,
    Cylindrical,
    Equirectangular,
    Fisheye62,
    Fisheye624,
    FisheyeRadTanThinPrism,
    KannalaBrandt,
    Pinhole,
)

__version__ = "0.1.0"

__all__ = [
    "MODELS",
    "BrownConrady",
    "Camera",
    "Cylindrical",
    "Equirectangular",
    "Fisheye62",
    "Fisheye624",
    "FisheyeRadTanThinPrism",
    "KannalaBrandt",
    "Pinhole",
]
