"""Panoramas whose rows are planes through the x axis: the formulas, and mrcal's LATLON in files."""

import math

import pytest
import torch

import camtorch as ct

INTRINSICS = [200.0, 210, 319, 239]


def rays():
    return torch.nn.functional.normalize(
        torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)).double(), dim=-1
    )


def test_formulas():
    x, y, z = rays().unbind(-1)
    for model, across in ((ct.LatLon, torch.asin(x)), (ct.TransverseCylindrical, x / torch.hypot(y, z))):
        pixels, valid = model(INTRINSICS).double().project(rays())
        assert valid.all()
        expected = torch.stack((200 * across + 319, 210 * torch.atan2(y, z) + 239), -1)
        # asin is ill-conditioned near the poles, where the camera's own formula is not
        torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("model", [ct.LatLon, ct.TransverseCylindrical])
def test_rows_are_planes_through_the_baseline(model):
    camera = model(INTRINSICS).double()
    moved = rays() * 3 + torch.tensor([0.7, 0, 0]).double()
    torch.testing.assert_close(camera.project(rays())[0][:, 1], camera.project(moved)[0][:, 1], rtol=0, atol=1e-10)


def test_files_of_mrcal(tmp_path):
    camera = ct.LatLon(INTRINSICS, image_size=(480, 640)).double()
    path = tmp_path / "panorama.cameramodel"
    ct.save(camera, path)
    assert "LENSMODEL_LATLON" in path.read_text()
    read = ct.load(path).camera
    assert isinstance(read, ct.LatLon)
    torch.testing.assert_close(read.intrinsics.double(), camera.intrinsics, rtol=0, atol=0)
    assert math.isclose(float(read.cx.detach()), 319)
