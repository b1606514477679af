"""The layers learn: a camera and its poses from chessboard corners, by plain gradient descent."""

import json
import math
from pathlib import Path

import pytest
import torch

import camtorch as ct


@pytest.mark.slow
def test_adam_calibrates_a_camera_on_real_corners():
    data = json.loads((Path(__file__).parents[1] / "files" / "corners_opencv_left.json").read_text())
    corners, board, rotation, translation, matrix = (
        torch.tensor(data[name], dtype=torch.float64) for name in ("corners", "object_points", "rvecs", "tvecs", "K")
    )
    views = len(corners)
    generator = torch.Generator().manual_seed(0)
    axes = torch.nn.functional.normalize(torch.randn(views, 3, dtype=torch.float64, generator=generator), dim=-1)
    start = ct.Extrinsics(rotation.reshape(-1, 3) + math.radians(3) * axes, translation.reshape(-1, 3) * 1.1)
    focal = matrix.diagonal()[:2] * 1.15
    camera = ct.BrownConrady(torch.cat((focal, matrix[:2, 2])))
    layer = torch.nn.Sequential(start, camera)
    steps = 2000
    optimizer = torch.optim.Adam(
        [
            {"params": [camera.intrinsics], "lr": 5.0},
            {"params": [camera.distortion], "lr": 2e-2},
            {"params": start.parameters(), "lr": 1e-2},
        ]
    )
    rates = [group["lr"] for group in optimizer.param_groups]
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rates, total_steps=steps)
    points = board.expand(views, -1, -1)
    for _ in range(steps):
        optimizer.zero_grad()
        pixels, valid = layer(points)
        assert valid.all()
        loss = (pixels - corners).square().sum(-1).mean()
        loss.backward()
        optimizer.step()
        schedule.step()
    # the optimum, found by OpenCV, is 0.195 px
    assert loss.sqrt().item() < 0.3
