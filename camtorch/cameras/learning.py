"""Groups of a camera's parameters for an optimizer, whose steps are measured in pixels."""

import math
from typing import Any

import torch
from torch import Tensor

from camtorch.cameras.freezing import all_frozen
from camtorch.projection.camera_like import CameraLike
from camtorch.rays.lattices import movement
from camtorch.values.arguments import as_number


def parameter_groups(camera: CameraLike, lr: float) -> list[dict[str, Any]]:
    """Return the groups of a camera, or of all that a `Mixed` is made of; see `Camera.parameter_groups`."""
    owner = f"{type(camera).__name__}.parameter_groups"
    lr = as_number(lr, "lr", owner)
    if not 0 < lr < math.inf:
        raise ValueError(f"{owner}: lr must be a positive number of pixels; got {lr!r}")
    steps: dict[Tensor, float] = {}
    for one in (part for part in camera.modules() if isinstance(part, CameraLike) and not part.is_mixed):
        for name in one.tensor_names:
            for tensor in _sources(one, name) if not all_frozen(one, name) else ():
                if not tensor.is_leaf:
                    instead = "Pass the parameters of the network or camera that it is made of to the optimizer"
                    raise TypeError(f"{owner}: {name} must be a Parameter; got a tensor of a graph. {instead}")
                steps[tensor] = min(lr / _effect(one, name, tensor), steps.get(tensor, math.inf))
    if not steps:
        raise ValueError(f"{owner}: camera must learn; got a fixed one. Call camera.requires_grad_() before")
    return [{"params": [tensor], "lr": step, "weight_decay": 0.0} for tensor, step in steps.items()]


def _sources(camera: CameraLike, name: str) -> list[Tensor]:
    """Return the tensors that learn of which a camera's tensor is made: itself, or those of its parametrization."""
    parts: Any = camera._modules.get("parametrizations", {})
    held: Any = parts[name].parameters() if name in parts else [{**camera._buffers, **camera._parameters}[name]]
    return [tensor for tensor in held if tensor.requires_grad]


def _effect(camera: CameraLike, name: str, tensor: Tensor) -> float:
    """Return by how many pixels one unit of a number of `tensor`, which `name` is made of, moves it at most."""
    given = name == "intrinsics"
    weights = torch.ones(4) if given else movement(camera, camera.distortion, camera.intrinsics, lattice=33)
    count = weights.shape[-1]
    with torch.enable_grad():
        pixels = (getattr(camera, name) * weights.reshape(-1, count).amax(0).to(tensor)).reshape(-1, count).sum(0)
        moved = [torch.autograd.grad(one, tensor, retain_graph=True)[0].abs().amax() for one in pixels]
    return max(map(float, moved)) or 1e3  # small steps without an effect, like that of FOV's omega at 0
