"""Augmentations that move image, masks, landmarks, boxes, gaze and head pose together, with the camera.

`camtorch.augment.kornia`, `.torchvision`, `.albumentations` and `.numpy` offer them in those libraries' pipelines.
"""

from typing import TYPE_CHECKING

from camtorch.augment.augmentation import Augmentation
from camtorch.augment.box_crop import BoxCrop
from camtorch.augment.change import Change
from camtorch.augment.collate import collate
from camtorch.augment.compose import Compose
from camtorch.augment.edits import (
    CenterCrop,
    Edit,
    HorizontalFlip,
    Pad,
    RandomCrop,
    RandomResizedCrop,
    Resize,
    Rotate90,
    VerticalFlip,
)
from camtorch.augment.face import FaceNormalizer
from camtorch.augment.landmarks import LANDMARKS, face_points
from camtorch.augment.presets import PRESETS, Preset
from camtorch.augment.random_camera import RandomCamera, RandomLens, RandomMount
from camtorch.augment.ranges import Range
from camtorch.augment.shutter import RandomShutter
from camtorch.poses.gaze import from_pitch_yaw, to_pitch_yaw
from camtorch.poses.rotations import mount_rotation
from camtorch.values.arguments import LEFT
from camtorch.warp.boxes import outlines

__all__ = [
    "LANDMARKS",
    "PRESETS",
    "Augmentation",
    "BoxCrop",
    "CenterCrop",
    "Change",
    "Compose",
    "Edit",
    "FaceNormalizer",
    "HorizontalFlip",
    "Pad",
    "Preset",
    "RandomCamera",
    "RandomCrop",
    "RandomLens",
    "RandomMount",
    "RandomResizedCrop",
    "RandomShutter",
    "Range",
    "Resize",
    "Rotate90",
    "VerticalFlip",
    "collate",
    "face_points",
    "from_pitch_yaw",
    "mount_rotation",
    "outlines",
    "to_pitch_yaw",
]


if not TYPE_CHECKING:  # type checkers know the names above, and no others

    def __getattr__(name: str) -> None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}. {LEFT}")
