"""Dewarps what five lenses see of a room, and compares with the room rendered directly.

python examples/dewarp_room.py -o room.png
"""

import argparse
import math
from typing import NamedTuple

import matplotlib.pyplot as plt
import torch
from scenes import room
from torch import Tensor

import camtorch as ct
from camtorch.poses.rotations import mount_rotation

LENSES = {"webcam": 52, "dms90": 76, "tumvi": 85, "aria": 95, "surround190": 105}
"""A preset, and the degrees to which its images are dewarped."""
TILT = mount_rotation(*torch.tensor([0.0, -4.0, 6.0], dtype=torch.float64))  # camera from room: looks down, leans right


class Study(NamedTuple):
    """Images (3, H, W), and how close the dewarped one is to the one that was rendered directly."""

    seen: Tensor
    dewarped: Tensor
    truth: Tensor
    valid: Tensor
    """(H, W) bool: where all around a pixel the lens sees something."""
    psnr: float
    """dB, where valid."""
    keypoints: Tensor
    """(N, 2): where the warp moves corners of the room."""
    keypoint_error: float
    """Pixels by which the worst of them is off."""
    bends: tuple[float, float]
    """Pixels, rms, by which straight edges of the room are bent before and after."""


@torch.no_grad()
def study(camera: ct.Camera, fov: float, samples: int = 6) -> Study:
    """Render a level room by a tilted camera, dewarp it to a level pinhole, and compare."""
    dewarp = ct.Dewarp(camera, fov=fov, image_size=(270, 360), rotation=TILT.T)
    seen, truth = room.render(camera, TILT, samples=samples), room.render(dewarp.target, samples=2 * samples)
    dewarped = dewarp(seen[None])[0]
    valid = torch.nn.functional.avg_pool2d(dewarp.valid_mask().float(), 3, stride=1, padding=1)[0, 0] == 1
    psnr = -10 * math.log10(float((dewarped - truth)[:, valid].square().mean()))

    points = room.keypoints()
    points = points[room.visible(points)]
    pixels, in_view = camera.project(points @ TILT.T)
    moved, on_image = dewarp.transform_points(pixels)
    use = in_view & camera.contains(pixels) & on_image
    error = (moved - dewarp.target.project(points)[0])[use].norm(dim=-1).max()

    bends = []
    for start, end in room.lines():
        pixels, in_view = camera.project(torch.lerp(start, end, torch.linspace(0, 1, 100)[:, None].double()) @ TILT.T)
        after, on_image = dewarp.transform_points(pixels)
        if (both := in_view & camera.contains(pixels) & on_image).sum() >= 20:
            bends.append([_bend(pixels[both]), _bend(after[both])])
    before, now = torch.tensor(bends).square().mean(0).sqrt().tolist()
    return Study(seen, dewarped, truth, valid, psnr, moved[use], float(error), (before, now))


def _bend(pixels: Tensor) -> float:
    """Rms distance of pixels (N, 2) from the straight line that fits them best."""
    return float(torch.linalg.svdvals(pixels - pixels.mean(0))[1]) / math.sqrt(len(pixels))


def main(output: str, height: int = 480, samples: int = 6) -> dict[str, Study]:
    """Study all lenses, print a table, and write a figure."""
    figure, axes = plt.subplots(len(LENSES), 3, figsize=(12, 3.2 * len(LENSES)), layout="constrained")
    print(f"{'':<14}{'PSNR':>10}{'edges bent by':>16}{'after dewarping':>18}{'keypoints off by':>19}")
    studies = {}
    for (name, fov), row in zip(LENSES.items(), axes, strict=True):
        camera = ct.augment.PRESETS[name].camera().double()
        camera = camera.resize(height, round(height * camera.width / camera.height))
        studies[name] = s = study(camera, fov, samples)
        numbers = f"{s.psnr:7.1f} dB{s.bends[0]:13.2f} px{s.bends[1]:15.0e} px{s.keypoint_error:16.0e} px"
        print(f"{name:<14}{numbers}", flush=True)
        off = (10 * (s.dewarped - s.truth).abs().mean(0) * s.valid).clamp(max=1)
        row[0].set_title(f"{name}, {float(camera.fov[0]):.0f} degrees")
        row[1].set_title(f"dewarped, and dots with it: {s.psnr:.1f} dB")
        row[2].set_title("off the true view, tenfold")
        for axis, image in zip(row, (s.seen.permute(1, 2, 0), s.dewarped.permute(1, 2, 0), off), strict=True):
            axis.imshow(image.numpy(), cmap="Greys", vmin=0, vmax=1)
            axis.set_axis_off()
        row[1].plot(*s.keypoints.T.numpy(), ".", color="#e21d48", markersize=4)
    figure.savefig(output, dpi=100)
    plt.close(figure)
    return studies


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="room.png")
    main(parser.parse_args().output)
