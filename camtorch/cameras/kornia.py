"""Cameras as kornia has them. `import camtorch` does not load kornia."""

from typing import Any

import torch

from camtorch.poses.extrinsics import Extrinsics
from camtorch.projection.camera_like import CameraLike
from camtorch.values.arguments import broadcast_shapes

# kornia's distortion -> the key of the model, and in kornia.sensors.camera the class and its number of coefficients
LENSES = {
    "AffineTransform": ("pinhole", "PinholeModel", 0),
    "BrownConradyTransform": ("brown_conrady", "BrownConradyModel", 8),
    "KannalaBrandtK3Transform": ("kannala_brandt", "KannalaBrandtK3", 4),
}


def to_kornia(camera: CameraLike, extrinsics: Extrinsics | None) -> Any:
    """Return kornia's camera; see `Camera.to_kornia`."""
    import kornia.sensors.camera as sensors
    from kornia.geometry import PinholeCamera
    from kornia.image import ImageSize

    owner, distortion = f"{type(camera).__name__}.to_kornia", camera.distortion
    _, name, count = next((lens for lens in LENSES.values() if lens[0] == camera.key), ("", "", 0))
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
