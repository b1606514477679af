"""The command `camtorch dewarp`: a photograph without its lens's distortion."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from camtorch.cli.options import add_output, add_photograph, parse_path, parse_size

if TYPE_CHECKING:
    from camtorch.cli.options import Commands


_TOLERANCE = 0.001
"""Pixels that nobody sees, for a lattice of positions also where a calibration is in float64."""


def add(commands: Commands) -> None:
    """Add the command to a command line."""
    command = commands.add_parser(
        "dewarp",
        help="undistort an image",
        description="Undistort an image: camtorch dewarp photo.jpg --camera camera.yml -o straight.png",
        allow_abbrev=False,
    )
    command.set_defaults(run=run)
    command.add_argument("image", type=parse_path, metavar="IMAGE", help="the image")
    command.add_argument(
        "--projection", choices=("perspective", "cylindrical", "equirectangular"), default="perspective"
    )
    command.add_argument(
        "--fov",
        type=float,
        metavar="DEGREES",
        help="horizontal field of view of the new image; by default that of the old one, up to 120 in perspective",
    )
    command.add_argument(
        "--size", type=parse_size, metavar="WxH", help="size of the new image; by default the old one's"
    )
    add_photograph(command)
    add_output(command, "dewarped.png")


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    import torch

    from camtorch.cli import cameras, images
    from camtorch.cli.warping import warped
    from camtorch.warp.dewarp import Dewarp

    fov = arguments.fov
    if fov is not None and not (0 < fov < 180 or (arguments.projection != "perspective" and 0 < fov <= 360)):
        wider = "; --projection cylindrical goes to 360" if arguments.projection == "perspective" and fov >= 180 else ""
        allowed = "below 180" if arguments.projection == "perspective" else "at most 360"
        raise ValueError(f"--fov must be above 0 and {allowed} degrees for {arguments.projection}; got {fov:g}{wider}")
    images.check_target(arguments.output, force=arguments.force, inputs=(arguments.image, arguments.camera))
    image, orientation = images.read(arguments.image)
    rows, columns = image.shape[-2:]
    camera = cameras.read_camera_of(arguments.image, (rows, columns), arguments)
    with torch.no_grad():
        warp = Dewarp(
            camera,
            projection=arguments.projection,
            fov=None if fov is None else math.radians(fov),
            image_size=arguments.size,
            tolerance=_TOLERANCE,
        )
        result, filled = warped(warp, image, "dewarping")
        del image
        lattice = (camera.resize(64, 64).pixel_grid() + 0.5) * torch.tensor([columns / 64, rows / 64]) - 0.5
        shown = float(warp.transform_points(lattice)[1].double().mean())
    images.write(arguments.output, images.from_tensor(result), orientation=orientation)
    height, width = result.shape[-2:]
    fx, fy, cx, cy = warp.target.intrinsics.tolist()
    degrees = math.degrees(float(warp.target.field_of_view[0]))
    print(
        f"{arguments.output}: {camera.key} dewarped to {arguments.projection}, {degrees:.1f} degrees "
        f"wide, {width}x{height}, fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} cy {cy:.6g}; {100 * filled:.1f} % of it is "
        f"filled and shows {100 * shown:.0f} % of the photograph"
    )
