"""Few points of a camera that is about to change are answered without its tables, and alike."""

import pytest
import torch
from cameras import RARE_ARE_SLOW, fan, make, one, pixel_lattice, spread

from camtorch.projection import domain

DTYPES = [torch.float32, torch.float64]


def both(key, dtype, calibration=one):
    """The same camera twice: frozen, and learning."""
    camera = calibration(key).to(dtype)
    tensors = camera.intrinsics.detach(), camera.distortion.detach()
    return [
        make(key, *(t.clone() for t in tensors), image_size=(480, 640)).requires_grad_(learns)
        for learns in (False, True)
    ]


@pytest.mark.parametrize("key", RARE_ARE_SLOW)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("end", [20, 179])
@pytest.mark.parametrize("calibration", [spread])
def test_few_points_of_a_learning_camera(key, dtype, end, calibration):
    frozen, learning = both(key, dtype, calibration)
    rays = fan(end, 20, 12).to(dtype)
    (expected, valid), (pixels, found) = (camera.project(rays) for camera in (frozen, learning))
    assert torch.equal(found, valid)
    assert torch.equal(pixels, expected)
    values = expected[valid] if end < 90 else pixel_lattice(frozen, 20, 30).to(dtype) * 1.5 - 100
    (expected, valid), (rays, found) = (camera.unproject(values) for camera in (frozen, learning))
    assert torch.equal(found, valid)
    torch.testing.assert_close(rays, expected, rtol=0, atol=200 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("key", ["kannala_brandt", "brown_conrady", "fisheye624"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_step_makes_no_tables(key, dtype, monkeypatch):
    """They are as dear as thousands of points. A camera that stays as it is gets them."""
    made = []
    monkeypatch.setattr(domain, "tabulate", lambda *inputs, of=domain.tabulate: (made.append(1), of(*inputs))[1])
    monkeypatch.setattr(domain, "fold_of", lambda *inputs, of=domain.fold_of: (made.append(1), of(*inputs))[1])
    camera = spread(key, dtype)
    rays = fan(30).to(dtype)[:1000]
    for step in range(3):
        with torch.no_grad():
            camera.distortion.mul_(0.99)
            camera.intrinsics.mul_(1.001)
        pixels, valid = camera.project(rays)
        assert valid.all()
        assert camera.unproject(pixels.detach())[1].all()
        assert not made, step
    for _ in range(2):
        camera.unproject(pixels.detach())
    assert made
