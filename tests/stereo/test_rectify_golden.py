"""Rectification agrees with mrcal's, by numbers that its fork drcal gave; where its image is another, in that image."""

import json
from pathlib import Path

import pytest
import torch

import camtorch as ct
from camtorch.stereo.rectification import Rectification

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "stereo" / "drcal.json").read_text())
CASES = {case["projection"].removeprefix("LENSMODEL_").lower(): case for case in GOLDEN["cases"]}
FOV = 80, 60


def float64(values):
    return torch.tensor(values, dtype=torch.float64)


def pair():
    made = []
    for camera in GOLDEN["cameras"]:
        width, height = camera["width_height"]
        parameters = float64(camera["parameters"])
        pose = float64(camera["rotation_vector_and_translation_from_reference"])
        lens = ct.BrownConrady(parameters[:4], parameters[4:], image_size=(height, width)).requires_grad_(False)
        made.append((lens, ct.Extrinsics(pose[:3], pose[3:]).requires_grad_(False)))
    (left, first), (right, second) = made
    return left, right, second.compose(first.inverse())


def rectification(name):
    """Ours, with the image of theirs."""
    case = CASES[name]
    width, height = case["width_height"]
    if name == "latlon":
        return ct.rectify(*pair(), projection="latlon", fov=FOV, image_size=(height, width))
    # theirs takes the resolution of the middle for wider images; the choice of a camera is free
    camera = ct.Pinhole(float64(case["intrinsics"]), image_size=(height, width)).requires_grad_(False)
    return Rectification(*pair(), camera, "perspective", False, "mean")


@pytest.mark.parametrize("name", CASES)
def test_frames_maps_and_points_are_theirs(name):
    found, case = rectification(name), CASES[name]
    torch.testing.assert_close(found.camera_left.intrinsics, float64(case["intrinsics"]), rtol=1e-12, atol=1e-9)
    assert found.baseline.item() == pytest.approx(case["baseline"], rel=1e-13)
    for side in ("left", "right"):
        rotation, source = getattr(found, f"rotation_{side}"), getattr(found, f"source_{side}")
        torch.testing.assert_close(rotation.mT, float64(case[f"{side}_from_rectified"]), rtol=0, atol=1e-13)
        rays, valid = getattr(found, f"camera_{side}").unproject(float64(case["pixels"]))
        assert valid.all()
        # also outside the image, as far as the lens is one-to-one
        pixels, valid = source.project(rays @ rotation)
        assert valid.sum() >= 15
        torch.testing.assert_close(pixels[valid], float64(case[side])[valid], rtol=0, atol=1e-6)
    points, valid = found._points(float64(case["pixels"])[None], float64(case["disparity"])[None])
    assert valid.all()
    torch.testing.assert_close(points[0], float64(case["points"]), rtol=1e-9, atol=1e-9)
