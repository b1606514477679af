"""What is handed out belongs to the caller."""

import pytest
import torch
from cameras import each_kind, fan, one, pixel_lattice


def values_of(key, method):
    """Of each model some that are valid and some that are not."""
    camera = one(key)
    values = torch.cat((fan(60), torch.tensor([[0.0, 0, 0], [0, 0, -1]]).double()))
    if method == "unproject":
        values = torch.cat((pixel_lattice(camera, 5, 7), torch.full((1, 2), torch.nan).double()))
    return values


def learning(key):
    camera = one(key)
    return [p.detach().clone().requires_grad_() for p in camera.parameters()], type(camera)


@each_kind
@pytest.mark.parametrize("method", ["project", "unproject"])
@pytest.mark.parametrize("rows", [(), (2, 3)])
def test_results_may_be_edited_in_place(key, method, rows):
    """The gradient is that of the same edits made out of place."""
    values = values_of(key, method).expand(*rows, -1, -1)
    gradients = []
    for in_place in (True, False):
        leaves, model = learning(key)
        points = values.clone().requires_grad_()
        result, valid = getattr(model(*leaves), method)(points)
        keep = torch.arange(valid.shape[-1]) % 3 > 0
        weights = torch.linspace(-1, 2, result.numel(), dtype=result.dtype).view_as(result)
        if in_place:
            valid &= keep
            result *= weights
            result[..., 0] += 1.0
            result[~valid] = 7.0
            valid |= True
        else:
            result = torch.where((valid & keep)[..., None], result * weights + torch.eye(result.shape[-1])[0], 7.0)
        result.square().sum().backward()
        gradients.append([points.grad, *(leaf.grad for leaf in leaves)])
    for edited, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(edited, expected, rtol=1e-9, atol=1e-9)
