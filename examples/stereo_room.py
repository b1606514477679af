"""Measures a room by two fisheyes: rectifies them, matches by OpenCV, and compares with the true distances.

python examples/stereo_room.py -o stereo.png    # pip install -e ".[calibrate]"
"""

import argparse
import math
from typing import NamedTuple

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
from scenes import room
from torch import Tensor

import camtorch as ct
from camtorch.poses.rotations import rotation_matrix

BASELINE = 0.25  # metres
LEFT, RIGHT = (rotation_matrix(torch.tensor(r).double()) for r in ([-0.04, 0.05, 0.02], [0.03, -0.06, -0.03]))
"""Of the cameras from the room: nobody mounts two of them straight."""
PLACE = (-BASELINE / 2, 0.0, 0.0)
"""Of the left camera in the room."""
POSE = ct.Extrinsics.from_matrix(RIGHT @ LEFT.T, -RIGHT @ torch.tensor([BASELINE, 0, 0]).double()).requires_grad_(False)
"""The right camera from the left one."""


class Study(NamedTuple):
    """A rectified pair, and how far off its distances are."""

    images: tuple[Tensor, Tensor]
    """(3, H, W) uint8 each, rectified."""
    points: Tensor
    """(H, W, 3) metres in the frame of the room."""
    error: Tensor
    """(H, W): the part of the true distance by which the one found is off; NaN where none was found."""
    median: float
    """Of the errors."""
    share: float
    """Of what the left camera sees of the room, that a distance was found for."""


def photographs(size: int = 960, samples: int = 5) -> tuple[ct.Camera, Tensor, Tensor]:
    """A fisheye of 170 degrees, and the images (1, 3, size, size) uint8 of two of it."""
    lens = ct.KannalaBrandt.from_fov(170, image_size=(size, size), distortion=[0.02, -0.01, 0.003, -0.001])
    lens = lens.double().requires_grad_(False)
    views = ((LEFT, PLACE), (RIGHT, (BASELINE / 2, 0.0, 0.0)))
    images = [room.render(lens, turn, place=place, samples=samples, rough=True) for turn, place in views]
    left, right = ((255 * image[None]).round().byte() for image in images)
    return lens, left, right


def match(left: Tensor, right: Tensor, least: float, most: float) -> Tensor:
    """Disparities (H, W) in pixels from least to most by OpenCV's semi-global matching, NaN where it finds none."""
    start = math.floor(least)
    count = 16 * math.ceil((most + 1 - start) / 16)  # of disparities: OpenCV takes multiples of 16
    sides = 0, 0, max(start + count, 0), max(-start, 0)  # OpenCV leaves out columns that it would compare with none
    images = [image.permute(1, 2, 0).contiguous().numpy() for image in (left, right)]
    padded = [cv2.copyMakeBorder(image, *sides, cv2.BORDER_REPLICATE) for image in images]
    matcher = cv2.StereoSGBM.create(start, count, 5, 600, 2400, 1, 0, 10, 100, 2)
    found = matcher.compute(*padded)[:, sides[2] : sides[2] + left.shape[-1]]
    return torch.from_numpy(np.where(found < 16 * start, np.nan, found / 16))  # OpenCV's are sixteenths


@torch.no_grad()
def study(
    lens: ct.Camera, left: Tensor, right: Tensor, projection: str, fov: tuple[float, float], pose: ct.Extrinsics = POSE
) -> Study:
    """Rectify to a projection of (horizontal, vertical) degrees, match, and compare."""
    pair = ct.rectify(lens, lens, pose, projection=projection, fov=fov)  # type: ignore[arg-type]
    first, second = (image[0] for image in pair(left, right))
    most = float(pair.camera_left.fx * pair.baseline / 0.45)  # of points at least 45 cm away
    disparity = match(first, second, *sorted((0.0, most)))
    points, good = pair.disparity_to_points(disparity, pair.left.valid_mask()[0, 0])

    room_from_rectified = LEFT.T @ pair.rotation_left.T
    rays, has_ray = pair.camera_left.rays()
    truth = room.distances(rays @ room_from_rectified.T, PLACE).double()  # infinite out of the window
    visible = pair.left.valid_mask()[0, 0] & has_ray & truth.isfinite()
    known = good & visible
    error = torch.where(known, (points.norm(dim=-1) / truth - 1).abs(), torch.nan)
    in_room = points @ room_from_rectified.T + torch.tensor(PLACE).double()
    return Study((first, second), in_room, error, float(error.nanmedian()), float(known.sum() / visible.sum()))


def main(output: str, size: int = 960, samples: int = 5) -> dict[str, Study]:
    """Study the pair as panoramas about the baseline and as pinhole images, print a table, and write a figure."""
    lens, left, right = photographs(size, samples)
    figure, axes = plt.subplots(2, 5, figsize=(17, 7.4), layout="constrained")
    studies = {}
    for row, (projection, fov) in zip(axes, {"latlon": (150, 160), "perspective": (110, 100)}.items(), strict=True):
        studies[projection] = s = study(lens, left, right, projection, fov)
        found = f"{100 * s.share:.0f} % known, off by {100 * s.median:.2f} %, the median"
        print(f"{projection:<12}{fov[0]} x {fov[1]} degrees: {found}", flush=True)
        distance = torch.where(s.error.isnan(), torch.nan, (s.points - torch.tensor(PLACE)).norm(dim=-1))
        for axis, image, side in zip(row, s.images, ("left", "right"), strict=False):
            axis.imshow(image.permute(1, 2, 0).numpy())
            axis.set_title(f"{side}, rectified to {projection}")
            for y in torch.linspace(0, image.shape[1], 11)[1:-1].tolist():
                axis.axhline(y, color="#c4573a", linewidth=0.6)
        shown = row[2].imshow(distance.numpy(), cmap="viridis_r", vmin=0.8, vmax=5)
        figure.colorbar(shown, ax=row[2], shrink=0.7)
        row[2].set_title(f"distance in metres, {100 * s.share:.0f} % known")
        shown = row[3].imshow(100 * s.error.numpy(), cmap="Greys", vmin=0, vmax=5)
        figure.colorbar(shown, ax=row[3], shrink=0.7)
        row[3].set_title(f"off the truth in %, median {100 * s.median:.2f}")
        use = ~s.error.isnan() & (s.points[..., 1] > -1) & (s.points[..., 1] < 1)  # without ceiling and floor
        colours = s.images[0].permute(1, 2, 0)[use] / 255
        row[4].scatter(*s.points[use][:, ::2].T.numpy(), 0.2, colours.numpy())
        row[4].set(title="the points from above", xlim=(-3, 3), ylim=(-0.5, 5), aspect="equal")
        for axis in row:
            axis.set(xticks=[], yticks=[])
    figure.savefig(output, dpi=100)
    plt.close(figure)
    return studies


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="stereo.png")
    main(parser.parse_args().output)
