"""What is handed out belongs to the caller; what is exported can be loaded."""

import io

import pytest
import torch
from cameras import each_kind, fan, one, pixel_lattice, real
from torch import nn

import camtorch as ct


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


@each_kind
def test_validity_may_be_edited_in_a_chain_of_layers(key):
    camera = one(key).requires_grad_(True)
    layers = nn.Sequential(ct.Extrinsics([0.1, 0.0, 0.0], [0.0, 0.1, 0.0]).double(), camera)
    pixels, valid = layers(values_of(key, "project"))
    valid &= camera.contains(pixels)
    pixels[valid].sum().backward()
    assert layers[0].rotation.grad.isfinite().all()
    assert valid.any()


@pytest.mark.slow
@pytest.mark.parametrize(("key", "method"), [("pinhole", "project"), ("equirectangular", "unproject")])
def test_an_exported_camera_without_coefficients_can_be_loaded(key, method):
    camera = next(iter(real(key).values())).requires_grad_(False)
    values = values_of(key, method)

    class Method(nn.Module):
        def __init__(self):
            super().__init__()
            self.camera = camera

        def forward(self, values):
            return getattr(self.camera, method)(values)

    file = io.BytesIO()
    torch.export.save(torch.export.export(Method(), (values,)), file)
    file.seek(0)
    loaded = torch.export.load(file).module()
    for result, expected in zip(loaded(values), getattr(camera, method)(values), strict=True):
        torch.testing.assert_close(result, expected)


@pytest.mark.slow
def test_an_exported_dewarp_of_a_pinhole_can_be_loaded():
    dewarp = ct.Dewarp(one("pinhole").float().requires_grad_(False), image_size=(6, 8))
    images = torch.rand(1, 3, *one("pinhole").image_size)
    file = io.BytesIO()
    torch.export.save(torch.export.export(dewarp, (images,)), file)
    file.seek(0)
    torch.testing.assert_close(torch.export.load(file).module()(images), dewarp(images))
