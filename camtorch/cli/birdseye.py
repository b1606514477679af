"""The command `camtorch birdseye`: the ground of a photograph from above, in a scale that one can measure in."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from camtorch.cli.options import LARGEST_SIDE, add_output, add_photograph, parse_path

if TYPE_CHECKING:
    from camtorch.cli.options import Commands
    from camtorch.extrinsics import Extrinsics


def add(commands: Commands) -> None:
    """Add the command to a command line."""
    command = commands.add_parser(
        "birdseye",
        help="see the ground from above",
        description="See the ground from above: camtorch birdseye photo.jpg --camera camera.json --x -3 3 --y 1 9 "
        "--resolution 0.01 -o above.png. The pose in FILE is camera from ground, z up; without one, --height and "
        "--pitch say how the camera looks, and the ground's y axis lies ahead of it, x to its right, the origin "
        "below it.",
        allow_abbrev=False,
    )
    command.set_defaults(run=run)
    command.add_argument("image", type=parse_path, metavar="IMAGE", help="the image")
    ground = command.add_argument_group("ground, in the unit of the pose, or of --height")
    ground.add_argument(
        "--x", type=float, nargs=2, required=True, metavar=("FROM", "TO"), help="what is seen, left to right"
    )
    ground.add_argument(
        "--y", type=float, nargs=2, required=True, metavar=("FROM", "TO"), help="what is seen, bottom to top"
    )
    ground.add_argument("--resolution", type=float, required=True, metavar="UNITS", help="of a pixel: 0.01 for 1 cm")
    pose = command.add_argument_group("pose, instead of that in FILE")
    pose.add_argument("--height", type=float, help="of the camera above the ground")
    pose.add_argument(
        "--pitch", type=float, metavar="DEGREES", help="down from the horizon, 90 for straight down; 0 by default"
    )
    add_photograph(command)
    add_output(command, "birdseye.png")


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    import torch

    from camtorch.cli import cameras, images
    from camtorch.warp.plane import BirdsEye

    height, pitch = arguments.height, arguments.pitch
    if height is not None and not 0 < height < math.inf:
        raise ValueError(f"--height must be above 0; got {height:g}")
    if pitch is not None and height is None:
        raise ValueError("--pitch needs --height: together they are the camera's pose")
    if pitch is not None and not -90 < pitch <= 90:
        raise ValueError(f"--pitch must be above -90 and at most 90 degrees, down from the horizon; got {pitch:g}")
    images.check_target(arguments.output, force=arguments.force, inputs=(arguments.image, arguments.camera))
    image, _ = images.read(arguments.image)
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
        filled = images.filled(warp)
    print(
        f"{arguments.output}: the ground from above, x {_range(arguments.x)} and y {_range(arguments.y)} at "
        f"{arguments.resolution:g} a pixel, {columns}x{rows}, by {camera.key}, {float(pose.position[2]):.4g} above; "
        f"{100 * filled:.1f} % of it is filled"
    )


def _looking_down(height: float, pitch: float) -> Extrinsics:
    """Camera from ground of one above the origin that looks along y, `pitch` radians below the horizon."""
    import torch

    from camtorch.extrinsics import Extrinsics

    sine, cosine = math.sin(pitch), math.cos(pitch)
    rotation = torch.tensor([[1.0, 0.0, 0.0], [0.0, -sine, -cosine], [0.0, cosine, -sine]], dtype=torch.float64)
    place = torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    return Extrinsics.from_matrix(rotation, -rotation @ place).requires_grad_(False)


def _range(ends: list[float]) -> str:
    return f"{ends[0]:g} to {ends[1]:g}"
