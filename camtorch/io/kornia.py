"""kornia's cameras as camtorch's, and back. `import camtorch` does not load kornia."""

from __future__ import annotations

from typing import Any

import torch

from camtorch.cameras.camera import Camera
from camtorch.models import MODELS, Pinhole
from camtorch.poses.extrinsics import Extrinsics
from camtorch.values.arguments import broadcast_shapes, shown

# kornia's distortion -> the key of the model, and in kornia.sensors.camera the class and its number of coefficients
_LENSES = {
    "AffineTransform": ("pinhole", "PinholeModel", 0),
    "BrownConradyTransform": ("brown_conrady", "BrownConradyModel", 8),
    "KannalaBrandtK3Transform": ("kannala_brandt", "KannalaBrandtK3", 4),
}


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
    if parts[0] != "Z1Projection" or parts[1] not in _LENSES:
        raise ValueError(f"from_kornia: theirs must have rays through one point; got {' and '.join(parts)}")
    vectors = [vector for vector in (numbers[..., :4], numbers[..., 4:]) if vector.shape[-1]]
    still = torch.zeros_like(numbers[..., :3], requires_grad=False)
    return MODELS[_LENSES[parts[1]][0]](*vectors, image_size=size), Extrinsics(still, still)


def to_kornia(camera: Camera, extrinsics: Extrinsics | None) -> Any:
    """Return kornia's camera; see `Camera.to_kornia`."""
    import kornia.sensors.camera as sensors
    from kornia.geometry import PinholeCamera
    from kornia.image import ImageSize

    owner, distortion = f"{type(camera).__name__}.to_kornia", camera.distortion
    _, name, count = next((lens for lens in _LENSES.values() if lens[0] == camera.key), ("", "", 0))
    if not name or bool(distortion[..., count:].any()):
        known = "a pinhole, brown_conrady of up to 8 or kannala_brandt of up to 4 coefficients"
        way = 'camera.convert("kannala_brandt", count=4).camera'
        raise ValueError(f"{owner}: camera must be {known}; got {distortion.shape[-1]} of {camera.key!r}. Write {way}")
    if camera.image_size is None:
        raise ValueError(f"{owner}: camera must have an image_size; got none")
    shape = broadcast_shapes(camera.batch_shape, extrinsics.batch_shape if extrinsics is not None else ())
    if len(shape) > 1:
        raise ValueError(f"{owner}: camera and extrinsics must have one batch dim or none; got {tuple(shape)}")
    if extrinsics is not None and name == "PinholeModel":
        matrix = torch.eye(4).to(camera.intrinsics).repeat(*(shape or (1,)), 1, 1)
        matrix[:, :3, :3] = camera.K
        sides = (torch.full(matrix.shape[:1], side, device=matrix.device) for side in camera.image_size)
        return PinholeCamera(matrix, extrinsics.matrix().expand_as(matrix).to(matrix.dtype), *sides)
    if extrinsics is not None and bool((extrinsics.matrix() != torch.eye(4).to(extrinsics.rotation)).any()):
        raise ValueError(f"{owner}: extrinsics must be None or the identity for kornia's {name}; got a pose")
    vectors = camera.intrinsics, distortion[..., :count], distortion.new_zeros(max(0, count - distortion.shape[-1]))
    params = torch.cat([vector.expand(*shape, -1) for vector in vectors], -1)
    return getattr(sensors, name)(ImageSize(*camera.image_size), params)
