"""The direction of a gaze as pitch and yaw."""

import torch
from torch import Tensor

from camtorch.values.arguments import as_coordinates, check_angles


def from_pitch_yaw(angles: Tensor) -> Tensor:
    """Return unit gaze vectors (..., 3) of pitch and yaw (..., 2) in radians, as in MPIIGaze and ETH-XGaze.

    Zero looks into the camera, along -z. Source: Zhang et al., ETH-XGaze, 2020, and its code.

    Raises:
        ValueError: If the shape is wrong, or plain angles are more than a turn and so may be degrees.
    """
    angles = as_coordinates(angles, "angles", 2, "from_pitch_yaw")
    check_angles(angles, "from_pitch_yaw")
    pitch, yaw = angles.unbind(-1)
    return torch.stack((-pitch.cos() * yaw.sin(), -pitch.sin(), -pitch.cos() * yaw.cos()), -1)


def to_pitch_yaw(gaze: Tensor) -> Tensor:
    """Return pitch and yaw (..., 2) in radians of gaze vectors (..., 3): pitch = asin(-y), yaw = atan2(-x, -z)."""
    x, y, z = as_coordinates(gaze, "gaze", 3, "to_pitch_yaw").unbind(-1)
    return torch.stack((torch.atan2(-y, torch.hypot(x, z)), torch.atan2(-x, -z)), -1)
