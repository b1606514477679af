"""Derivatives of dear functions, checked along one direction of all that goes in."""

import torch


def check_slope(function, inputs, step=1e-6, rtol=1e-4):
    """That the gradient of a random sum of what comes out is the difference between two steps, by three calls."""
    generator = torch.Generator().manual_seed(11)
    ways = [torch.randn(given.shape, generator=generator).to(given) for given in inputs]

    def total(part):
        moved = [(given + part * way).detach().requires_grad_() for given, way in zip(inputs, ways, strict=True)]
        weights = torch.Generator().manual_seed(12)
        return moved, sum((out * torch.randn(out.shape, generator=weights).to(out)).sum() for out in function(*moved))

    at, value = total(0.0)
    slopes = torch.autograd.grad(value, at)
    expected = (total(step)[1] - total(-step)[1]).detach() / (2 * step)
    found = sum((slope * way).sum() for slope, way in zip(slopes, ways, strict=True))
    torch.testing.assert_close(found, expected, rtol=rtol, atol=1e-6)
    assert all(slope.isfinite().all() and slope.any() for slope in slopes)
