"""The commands `camtorch convert` and `camtorch show`. Degrees here, and only here."""

from __future__ import annotations

import argparse
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from camtorch.cli.options import parse_size

if TYPE_CHECKING:
    from camtorch.camera import Camera


def add(commands) -> None:
    """Add both to the subparsers of a command line."""
    convert = commands.add_parser(
        "convert",
        help="write a calibration as another camera model, or in another format",
        description="Write the cameras of a calibration file as cameras of another model, and print how good that is.",
        allow_abbrev=False,
    )
    convert.set_defaults(run=_convert)
    convert.add_argument("input", type=Path, metavar="IN", help="a calibration file")
    convert.add_argument("output", type=Path, metavar="OUT", help="the new one")
    convert.add_argument("--model", metavar="KEY", help="the new model; by default the model stays")
    convert.add_argument("--count", type=int, metavar="N", help="of coefficients, where the model leaves a choice")
    convert.add_argument("--max-angle", type=float, metavar="DEGREES", help="from the axis, up to which rays matter")
    convert.add_argument("--format", help="of OUT; by default what its name says")
    show = commands.add_parser("show", help="what a calibration says, in numbers and in an image", allow_abbrev=False)
    show.set_defaults(run=_show)
    show.add_argument("input", type=Path, metavar="FILE", help="a calibration file")
    show.add_argument("--against", type=Path, metavar="OTHER", help="another calibration of the camera, to compare")
    show.add_argument("-o", "--output", type=Path, metavar="OUT", help="an image: distortion, radius over angle")
    for command in (convert, show):
        command.add_argument("--name", help="which camera, in a file with several")
        command.add_argument("--from-model", metavar="KEY", help="the model in the file, where that does not say it")
        command.add_argument("--size", type=parse_size, metavar="WxH", help="of images, where the file does not say")
        command.add_argument("--force", action="store_true", help="overwrite OUT if it exists")


def _convert(arguments: argparse.Namespace) -> None:
    from camtorch.cli.cameras import read_rig
    from camtorch.io import formats
    from camtorch.rig import Rig

    path = arguments.output
    if path.is_file() and not arguments.force:
        raise ValueError(f"{path}: exists already; --force overwrites it")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"{path}: the folder {path.parent} cannot be written to")
    angle = arguments.max_angle
    if angle is not None and not 0 < angle <= 180:
        raise ValueError(f"--max-angle must be above 0 and at most 180 degrees; got {angle:g}")
    rig, notes = read_rig(arguments.input, arguments.name, arguments.from_model, arguments.size), []
    cameras = {}
    for name, camera in rig.cameras.items():
        model = arguments.model or camera.key
        result = camera.convert(model, count=arguments.count, max_angle=None if angle is None else math.radians(angle))
        cameras[name] = result.camera
        part = "what the image has rays for" if camera.image_size else "its rays"
        degrees, covered = math.degrees(float(result.max_angle)), 100 * float(result.valid_fraction)
        errors = "exact" if bool(result.exact) else f"rms {result.rms:.3g} px, at most {result.max_error:.3g} px"
        notes.append(
            f"{path}: {name}, {camera.key} to {result.camera.key}: {errors}, "
            f"up to {degrees:.1f} degrees from the axis, {covered:.4g} % of {part}"
        )
    # camtorch's own JSON holds every model; the format that the rig comes from may not
    stays = rig.format if arguments.model is None or path.suffix != ".json" else None
    changed = Rig(cameras, rig.extrinsics, images=rig.images, format=stays)
    there = [name for name in formats.rendered(changed, path, arguments.format) if os.path.exists(name)]
    if there and not arguments.force:
        raise ValueError(f"{', '.join(there)}: exists already; --force overwrites it")
    formats.save(changed, path, arguments.format)
    print("\n".join(notes))


def _show(arguments: argparse.Namespace) -> None:
    from camtorch.analysis.difference import difference
    from camtorch.analysis.summary import summarise
    from camtorch.cli import images
    from camtorch.cli.cameras import read_other, read_rig

    if arguments.output is not None:
        images.check_target(arguments.output, force=arguments.force)
    cameras = read_rig(arguments.input, arguments.name, arguments.from_model, arguments.size).cameras
    single = arguments.output is not None or arguments.against is not None
    if single and len(cameras) > 1:
        raise ValueError(f"{arguments.input}: --name says which camera is meant: {', '.join(cameras)}")
    ((name, camera), *_), other = cameras.items(), None
    if single and camera.image_size is None:
        raise ValueError(f"{arguments.input} states no image size; --size says which")
    if arguments.against is not None:
        other = read_other(arguments.against, arguments.name)
    for name, camera in cameras.items():
        print(f"{arguments.input}: {name}", *summarise(camera).lines(), sep="\n")
    if other is not None:
        compared = difference(camera, other)
        print(f"against {arguments.against}: {compared}, over {100 * compared.part:.4g} % of the image")
    if arguments.output is not None:
        height, width = camera.image_size
        title = f"{arguments.input.name}: {name if name != 'camera' else camera.key}, {width} x {height}"
        _draw(arguments.output, camera, other, title)
        print(f"{arguments.output}: distortion, radius over angle{', difference' if other is not None else ''}")


def _draw(path: Path, camera: Camera, other: Camera | None, title: str) -> None:
    import numpy
    from PIL import Image

    from camtorch import plot
    from camtorch.cli import images

    figure = plot.portrait(camera, other, title=title)
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # after `portrait` said what to install

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    images.write(path, Image.fromarray(numpy.array(canvas.buffer_rgba())[..., :3]))
