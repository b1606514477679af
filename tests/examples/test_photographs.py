"""The photograph of the README: its calibration fits it, and straight edges come out straight."""

import json
from pathlib import Path

import torch
from boards import FOLDER, ov_plane
from PIL import Image

import camtorch as ct

PHOTOGRAPHS = Path(__file__).parents[2] / "examples" / "photographs"


def test_the_calibration_fits_the_photograph():
    camera = ct.load(PHOTOGRAPHS / "fisheye.yml").camera.requires_grad_(False)
    with Image.open(PHOTOGRAPHS / "fisheye.jpg") as image:
        assert image.size == (camera.width, camera.height)
    views = [view["image"] for view in json.loads((FOLDER / "ov_plane.json").read_text())["train"]]
    train = ov_plane("train")
    seen = train.image_points[views.index("br0_cam01-2020-05-07-14-00-30")]
    _, rms, valid = ct.solve_pnp(camera, train.object_points, seen)
    assert valid
    assert rms < 0.6
    # columns of the board lie on straight lines once it is dewarped, and do not before
    straight, on_image = ct.Dewarp(camera).transform_points(seen)

    def bend(pixels):
        columns = zip(pixels.view(22, 22, 2).transpose(0, 1), on_image.view(22, 22).T, strict=True)
        lines = [column[use] for column, use in columns if use.sum() > 5]
        return max(float(torch.linalg.svdvals(line - line.mean(0))[1]) / len(line) ** 0.5 for line in lines)

    assert bend(straight) < 1
    assert bend(seen) > 10
