"""kornia's cameras as camtorch's. `import camtorch` does not load kornia."""

from typing import Any

import torch

from camtorch.cameras.camera import Camera
from camtorch.cameras.kornia import LENSES
from camtorch.models import MODELS, Pinhole
from camtorch.poses.extrinsics import Extrinsics
from camtorch.values.arguments import shown


def from_kornia(theirs: Any) -> tuple[Camera, Extrinsics]:
    """Return a camera and its pose, so that `camera(extrinsics(points))` projects as a camera of kornia.

    Gradients reach their tensors if those require grad. Behind the camera kornia returns mirrored pixels, also for
    fisheyes; here `valid` is False, or the fisheye sees the point.

    Args:
        theirs: A `kornia.geometry.PinholeCamera`, or a camera of `kornia.sensors.camera`.

    Returns:
        camera: A `Pinhole`, `BrownConrady` or `KannalaBrandt`, with the batch dim of theirs.
        extrinsics: Camera from world; the identity for `kornia.sensors.camera`, whose cameras have no pose.

    Raises:
        TypeError: If it is no camera of kornia.
        ValueError: If it is orthographic, has a skew, or the images of a batch differ in size.
    """
    try:
        heights, widths = (torch.as_tensor(side).unique().tolist() for side in (theirs.height, theirs.width))
        pose = getattr(theirs, "extrinsics", None)
        numbers = theirs.params if pose is None else theirs.intrinsics
        parts = [] if pose is not None else [type(part).__name__ for part in (theirs.projection, theirs.distortion)]
    except (AttributeError, TypeError, RuntimeError):
        known = "a PinholeCamera or a camera of kornia.sensors.camera"
        raise TypeError(f"from_kornia: theirs must be {known}; got {shown(theirs)}") from None
    if len(heights) != 1 or len(widths) != 1 or {heights[0] % 1, widths[0] % 1} != {0}:
        got = f"heights {heights}, widths {widths}"
        raise ValueError(f"from_kornia: theirs must have one size in whole pixels; got {got}. Pass one for each size")
    size = int(heights[0]), int(widths[0])
    if pose is not None:
        return Pinhole.from_matrix(numbers, image_size=size), Extrinsics.from_matrix(pose)
    if parts[0] != "Z1Projection" or parts[1] not in LENSES:
        raise ValueError(f"from_kornia: theirs must have rays through one point; got {' and '.join(parts)}")
    vectors = [vector for vector in (numbers[..., :4], numbers[..., 4:]) if vector.shape[-1]]
    still = torch.zeros_like(numbers[..., :3], requires_grad=False)
    return MODELS[LENSES[parts[1]][0]](*vectors, image_size=size), Extrinsics(still, still)
