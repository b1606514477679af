"""Images of the guides, rendered: `python docs/guide_images.py`, or those named: `... dewarp learn`."""

import io
import sys
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
from make_images import HERE, PAPER, tiles
from PIL import Image

import camtorch as ct
from camtorch.calibration.boards import Chessboard
from camtorch.demo import room

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from photographs import fisheye, photograph


def dewarp() -> Image.Image:
    """A fisheye image of a room, and what `ct.Dewarp` makes of it."""
    lens = ct.KannalaBrandt.from_fov(190, image_size=(600, 800), distortion=[0.02, -0.01, 0.003, -0.001])
    lens = lens.requires_grad_(False)
    image = room.render(lens, samples=4)[None]
    size = (300, 400)
    options = {"image_size": size, "antialias": True}
    warps = {
        "a fisheye of 190 degrees": ct.Warp(lens, lens.resize(*size), antialias=True),
        "perspective, 100 degrees": ct.Dewarp(lens, fov=1.75, **options),
        "cylindrical, 180 degrees": ct.Dewarp(lens, projection="cylindrical", fov=3.14, **options),
        "equirectangular": ct.Dewarp(lens, projection="equirectangular", **options),
    }
    return tiles([(warp(image)[0], title) for title, warp in warps.items()], 2)


def calibration() -> Image.Image:
    """Photographs of a board with the corners that were found, and how far projections are known."""
    board, lens = Chessboard(9, 6, 0.024), fisheye()
    poses = [
        ((0.5 * np.cos(a), 0.5 * np.sin(a), 0.1), (0.12 * np.sin(a) - 0.1, 0.08 * np.cos(a) - 0.07, 0.18 + 0.01 * a))
        for a in np.linspace(0, 6, 12)
    ]
    views = [photograph(board, lens, *pose, seed=i) for i, pose in enumerate(poses)]
    found = [cv2.findChessboardCornersSB(image, (9, 6))[1] for image, _ in views]
    seen = [np.full((54, 2), np.nan) if corners is None else corners.reshape(54, 2) for corners in found]
    result = ct.calibrate("kannala_brandt", board.points(), seen, image_size=(480, 640))
    figure, axes = plt.subplots(
        2, 2, figsize=(8.3, 6.6), facecolor=[value / 255 for value in PAPER], layout="constrained"
    )
    for axis, i in zip(axes.flat, (1, 6, 11), strict=False):
        axis.imshow(views[i][0], cmap="gray", vmin=0, vmax=255)
        axis.plot(*seen[i].T, "o", color="#e0245e", markersize=3.5)
        axis.set(xticks=[], yticks=[], title=f"photograph {i}, and its corners")
    ct.plot.uncertainty(result, axes[1, 1])
    axes[1, 1].set_title("how far projections are known")
    file = io.BytesIO()
    figure.savefig(file, dpi=100)
    plt.close(figure)
    return Image.open(file).convert("RGB")


def learn() -> Image.Image:
    """A camera that learns from rays and pixels: the image that it dewarps, while it does."""
    truth = ct.KannalaBrandt.from_fov(170, image_size=(480, 640), distortion=[0.02, -0.01, 0.003, -0.001])
    image = room.render(truth.requires_grad_(False), samples=4)[None]
    points, _ = truth.unproject(truth.pixel_grid(40).reshape(-1, 2))
    wanted = truth.pixel_grid(40).reshape(-1, 2)
    camera = ct.KannalaBrandt([260.0, 260.0, 290.0, 255.0], image_size=(480, 640))
    groups = [{"params": [camera.intrinsics], "lr": 1.0}, {"params": [camera.distortion], "lr": 0.002}]
    optimizer = torch.optim.Adam(groups)
    target = ct.Pinhole.from_fov(100, image_size=(300, 400)).requires_grad_(False)
    panels = [(ct.Warp(truth, truth.resize(300, 400), antialias=True)(image)[0], "a fisheye of 170 degrees")]
    for step in range(301):
        pixels, valid = camera(points)
        loss = (pixels - wanted)[valid].square().sum(-1).mean()
        if step in (0, 20, 300):
            with torch.no_grad():
                straight = ct.Warp(camera, target, antialias=True)(image)[0]
            panels.append((straight, f"dewarped after {step} steps: {loss.sqrt():.1f} px"))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return tiles(panels, 2)


IMAGES = {"dewarp": dewarp, "calibration": calibration, "learn": learn}

if __name__ == "__main__":
    for name in sys.argv[1:] or IMAGES:
        IMAGES[name]().save(HERE / f"{name}.jpg", quality=82)
