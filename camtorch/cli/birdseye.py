"""The command `camtorch birdseye`: the ground of a photograph from above, in a scale that one can measure in."""

from __future__ import annotations

import argparse
import math

import torch

from camtorch.cli import cameras, images
from camtorch.cli.words import LARGEST_SIDE
from camtorch.extrinsics import Extrinsics
from camtorch.warp.plane import BirdsEye


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    height, pitch = arguments.height, arguments.pitch
    if height is not None and not 0 < height < math.inf:
        raise ValueError(f"--height must be above 0; got {height:g}")
    if pitch is not None and height is None:
        raise ValueError("--pitch needs --height: together they are the camera's pose")
    if pitch is not None and not -90 < pitch <= 90:
        raise ValueError(f"--pitch must be above -90 and at most 90 degrees, down from the horizon; got {pitch:g}")
    images.check_target(arguments.output, force=arguments.force, inputs=(arguments.image, arguments.camera))
    image, _ = images.read_stored(arguments.image)
    camera, pose = cameras.read_posed(arguments.image, (image.shape[-2], image.shape[-1]), arguments)
    if height is not None:
        pose = _looking_down(height, math.radians(pitch or 0.0))
    if pose is None:
        raise ValueError(
            f"{arguments.camera}: no pose, so where the ground is is not known; --height and --pitch say it, or a "
            "rig whose pose is camera from ground"
        )
    with torch.no_grad():
        warp = BirdsEye(camera, pose, x=tuple(arguments.x), y=tuple(arguments.y), resolution=arguments.resolution)
        rows, columns = warp.target.height, warp.target.width
        if max(rows, columns) > LARGEST_SIDE:
            ranges = "--x, --y and --resolution"
            raise ValueError(f"{ranges} make {columns}x{rows} pixels; each side must be at most {LARGEST_SIDE}")
        images.write(arguments.output, images.from_tensor(warp(image[None])[0]))
        filled = float(warp.valid_mask().double().mean())
    x, y = (f"{low:g} to {high:g}" for low, high in (arguments.x, arguments.y))
    print(
        f"{arguments.output}: the ground from above, x {x} and y {y} at {arguments.resolution:g} a pixel, "
        f"{columns}x{rows}, by {camera.key}, {float(pose.position[2]):.4g} above; {100 * filled:.1f} % of it is filled"
    )


def _looking_down(height: float, pitch: float) -> Extrinsics:
    """Camera from ground of one above the origin that looks along y, `pitch` radians below the horizon."""
    sine, cosine = math.sin(pitch), math.cos(pitch)
    rotation = torch.tensor([[1.0, 0.0, 0.0], [0.0, -sine, -cosine], [0.0, cosine, -sine]], dtype=torch.float64)
    place = torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    return Extrinsics.from_matrix(rotation, -rotation @ place).requires_grad_(False)
