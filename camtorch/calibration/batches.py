"""Arguments of functions of many independent rows: tensors that keep their graphs, cameras of as many rows."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.values.arguments import Numbers, as_values
from camtorch.values.module import BatchedModule, remade


def as_stacked(values: Numbers, name: str, owner: str, device: torch.device) -> Tensor:
    """Return a tensor of numbers, which may be NaN, from a tensor, an array, or lists, also of tensors of one shape."""
    if isinstance(values, (list, tuple)) and values and all(getattr(v, "ndim", 0) for v in values):
        return torch.stack([as_values(v, f"{name}[{i}]", owner, device) for i, v in enumerate(values)])
    return as_values(values, name, owner, device)


def as_point_sets(values: Numbers, name: str, size: int, owner: str, device: torch.device) -> Tensor:
    """Return points (*B, N, size) from such values, or from OpenCV's (*B, N, 1, size)."""
    vectors = as_stacked(values, name, owner, device)
    if vectors.ndim > 2 and vectors.shape[-2] == 1 and vectors.shape[-3] > 1:
        vectors = vectors.squeeze(-2)
    if vectors.ndim < 2 or vectors.shape[-1] != size:
        raise ValueError(f"{owner}: {name} must be (*B, N, {size}); got shape {tuple(vectors.shape)}")
    return vectors


def as_double_rows(camera: Camera, batch: torch.Size) -> Camera:
    """Return the camera in float64 with its graph: `math.prod(batch)` rows, or no batch if it is one for all rows."""
    if not camera.batch_shape and all(t.dtype == torch.float64 for t in camera.tensors):
        return camera
    tensors = {}
    shared, rows = math.prod(camera.batch_shape) == 1, math.prod(batch)
    for name in camera.tensor_names:
        tensor = getattr(camera, name).double()
        count = tensor.shape[-1]
        tensors[name] = tensor.reshape(count) if shared else tensor.expand(*batch, count).reshape(rows, count)
    return remade(camera, **tensors)


def root_of(mean: Tensor, valid: Tensor) -> Tensor:
    """Return the root of a valid mean, without a derivative if the fit is perfect; infinite if not valid."""
    return torch.where(valid & (mean > 0), torch.where(mean > 0, mean, 1.0).sqrt(), torch.where(valid, 0.0, torch.inf))


def learns(modules: Sequence[BatchedModule], *tensors: Tensor) -> bool:
    """Whether torch records a graph for any of the modules or tensors."""
    held = [getattr(module, name) for module in modules for name in module.tensor_names]
    return torch.is_grad_enabled() and any(t.requires_grad for t in (*held, *tensors))


def attached(objective: Callable[[Tensor], Tensor], optimum: Tensor, valid: Tensor) -> Tensor:
    """Return the optimum (B, K) in a graph, for first derivatives by everything that the objective depends on.

    By the implicit function theorem: the gradient of the objective, of costs (B,), remains zero when an optimum moves,
    so one Newton step with the exact Hessian has its derivatives. Rows that are not valid get no gradient.
    """
    with torch.enable_grad():
        unknowns = optimum.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(objective(unknowns).sum(), unknowns, create_graph=True)
        slopes = [torch.autograd.grad(one.sum(), unknowns, retain_graph=True)[0] for one in gradient.unbind(-1)]
        eye = torch.eye(optimum.shape[-1], dtype=optimum.dtype, device=optimum.device)
        hessian = torch.where(valid[:, None, None], torch.stack(slopes, -2).detach(), eye)
        inverse, failed = torch.linalg.inv_ex(hessian)
        fine = valid & (failed == 0) & torch.isfinite(inverse).all(-1).all(-1)
        inverse = torch.where(fine[:, None, None], inverse, 0.0)
        step = (inverse @ gradient[..., None])[..., 0]
        return optimum.detach() - (step - step.detach())
