"""What an optimum owes to the numbers that it was found from: its derivatives by the implicit function theorem."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def attached(objective: Callable[[Tensor], Tensor], optimum: Tensor, valid: Tensor) -> Tensor:
    """Return the optimum (B, K) with a graph, for first derivatives by whatever the objective depends on.

    The gradient of the objective, of costs (B,) that are each of its own row, is zero at an optimum and stays zero when
    it moves: one step by Newton's method, with the exact Hessian, has the derivatives of the optimum however that was
    found. Rows that are not valid, bool (B,), get no gradient.
    """
    with torch.enable_grad():
        unknowns = optimum.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(objective(unknowns).sum(), unknowns, create_graph=True)
        rows = [
            torch.autograd.grad(column.sum(), unknowns, retain_graph=True)[0].detach() for column in gradient.unbind(-1)
        ]
        hessian = torch.stack(rows, -2)
        eye = torch.eye(optimum.shape[-1], dtype=optimum.dtype, device=optimum.device)
        hessian = torch.where(valid[:, None, None], hessian, eye)
        inverse, failed = torch.linalg.inv_ex(hessian)
        fine = valid & (failed == 0) & torch.isfinite(inverse).all(-1).all(-1)
        inverse = torch.where(fine[:, None, None], inverse, 0.0)
        step = (inverse @ gradient[..., None])[..., 0]
        return optimum.detach() - (step - step.detach())
