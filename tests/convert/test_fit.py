"""Cameras from rays, whatever predicted them: a camera is found again, and what none can see is said."""

import math

import pytest
import torch
from cameras import DISTINCT, KEYS, one, slow_unless

import camtorch as ct


def seen_by(camera, step=37):
    """Its pixels and rays, NaN where there are none."""
    pixels = camera.pixel_grid()[::step, ::step].detach()
    rays, valid = camera.unproject(pixels)
    return pixels, torch.where(valid[..., None], rays.detach(), torch.nan)


# the angles of a table are its own
OWN = {"tabulated"}


@pytest.mark.parametrize("key", slow_unless(DISTINCT.__contains__, [key for key in KEYS if key not in OWN]))
def test_a_camera_is_found_by_its_rays(key):
    camera = one(key).requires_grad_(False)
    if camera.image_size is None:
        camera = type(camera)(camera.intrinsics, camera.distortion, image_size=(480, 640)).double()
    pixels, rays = seen_by(camera)
    found = ct.fit(key, pixels, rays * 2, image_size=camera.image_size, count=camera.distortion.shape[-1])
    assert float(found.rms) < 1e-3


def test_a_batch_of_rays_makes_a_batch_of_cameras():
    cameras = [
        ct.KannalaBrandt([300.0 + 9 * i, 310, 320, 240], [0.02, -0.01, 0, 0], image_size=(480, 640)) for i in range(3)
    ]
    pixels, rays = zip(*(seen_by(camera.double()) for camera in cameras), strict=True)
    found = ct.fit(ct.KannalaBrandt, pixels[0], torch.stack(rays))
    assert found.camera.batch_shape == (3,) == found.rms.shape
    for i, camera in enumerate(cameras):
        torch.testing.assert_close(found.camera.intrinsics[i], camera.intrinsics, rtol=1e-6, atol=1e-6)


def test_weights_leave_out_what_is_wrong():
    camera = ct.KannalaBrandt([300.0, 310, 320, 240], [0.02, -0.01, 0, 0], image_size=(480, 640)).double()
    pixels, rays = seen_by(camera)
    weights = torch.ones(rays.shape[:-1])
    weights[:5] = 0
    rays[:5] = rays[:5].flip(1)
    found = ct.fit("kannala_brandt", pixels, rays, weights=weights)
    torch.testing.assert_close(found.camera.intrinsics, camera.intrinsics, rtol=1e-6, atol=1e-6)
    assert float(found.max_error) < 1e-5
    assert float(ct.fit("kannala_brandt", pixels, rays).rms) > 1


def test_learning_rays_of_float32_arrays():
    camera = ct.Pinhole([300.0, 310, 320, 240], image_size=(480, 640))
    pixels, rays = seen_by(camera)
    found = ct.fit("pinhole", pixels.numpy(), rays.clone().requires_grad_(), image_size=(480, 640)).camera
    torch.testing.assert_close(found.intrinsics.float(), camera.intrinsics, rtol=1e-5, atol=1e-3)
    assert found.intrinsics.requires_grad
    assert found.image_size == (480, 640)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p, r: (p, r[..., :2]), "rays"),
        (lambda p, r: (p[:2], r), "pixels must be"),
        (lambda p, r: (p, -r), "OpenGL"),
        (lambda p, r: (p[0, :3], r[0, :3]), "4 rays"),
        (lambda p, r: (p[0, :0], r[0, :0]), "4 rays"),
        (lambda p, r: (p, torch.full_like(r, math.nan)), "4 rays"),
    ],
)
def test_what_cannot_be_fitted_is_said(change, words):
    camera = ct.Pinhole([300.0, 310, 320, 240], image_size=(480, 640)).double()
    with pytest.raises(ValueError, match=words):
        ct.fit("pinhole", *change(*seen_by(camera)))
