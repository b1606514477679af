"""Depth maps: their check, and the distances along pixels' rays."""

import torch
from torch import Tensor

from camtorch.projection.camera_like import CameraLike
from camtorch.values.arguments import Numbers, as_values


def as_depth(depth: Numbers, kind: str, size: tuple[int, int], owner: str, device: torch.device) -> Tensor:
    """Return a checked depth map (B, D, H, W) or (H, W) of a size, and check its kind."""
    if not isinstance(kind, str) or kind not in ("z", "distance"):
        raise ValueError(f'{owner}: kind must be "z" (along the optical axis) or "distance"; got {kind!r}')
    depth = as_values(depth, "depth", owner, device)
    if not depth.is_floating_point():
        raise ValueError(
            f"{owner}: depth must be floating point, in units of length; got {depth.dtype}. Pass "
            "depth.astype(np.float32) / 1000 for millimetres in uint16"
        )
    if depth.ndim not in (2, 4) or depth.shape[-2:] != size:
        hint = ". Pass maps (B, H, W) as depth[:, None]" if depth.ndim == 3 and depth.shape[-2:] == size else ""
        raise ValueError(
            f"{owner}: depth must be (B, 1, H, W) or (H, W) of the camera's image_size {size}; got "
            f"{tuple(depth.shape)}{hint}"
        )
    return depth


def depth_scale(depth: Tensor, rays: Tensor, valid: Tensor, kind: str) -> tuple[Tensor, Tensor]:
    """Return the distances along unit rays (*B, H, W, 3) for depths of a kind, which broadcast, and which are valid."""
    z = rays[..., 2]
    ahead = valid & (z > 0) if kind == "z" else valid
    good = ahead & torch.isfinite(depth) & (depth > 0)
    length = torch.where(good, depth, 0.0)
    return (length / torch.where(ahead, z, 1.0) if kind == "z" else length), good


def backproject(camera: CameraLike, depth: Numbers, kind: str) -> tuple[Tensor, Tensor]:
    """Return points (*B, H, W, 3) and valid (*B, H, W); see `Camera.backproject`."""
    owner, batch = f"{type(camera).__name__}.backproject", camera.batch_shape
    depth = as_depth(depth, kind, camera.size_for("backproject"), owner, camera.intrinsics.device)
    fits = not batch or (depth.ndim == 4 and len(batch) == 1 and len(depth) in (1, *batch))
    if not fits or (depth.ndim == 4 and depth.shape[1] != 1):
        of = f" for cameras {tuple(batch)}" if batch else ""
        raise ValueError(f"{owner}: depth must be (B, 1, H, W){of}; got shape {tuple(depth.shape)}")
    rays, valid = camera.rays()
    scale, good = depth_scale(depth[:, 0] if depth.ndim == 4 else depth, rays, valid, kind)
    return rays * scale[..., None], good
