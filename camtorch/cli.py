"""The command line: `camtorch dewarp` and `camtorch demo`. Degrees and WIDTHxHEIGHT here, and only here."""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from camtorch import __version__

_LARGEST_SIDE = 32768
_STRIP_PIXELS = 1 << 21


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} (see {self.prog} --help)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv`, by default the process's own.

    Returns:
        The exit status: 0, or 2 after an error, which is one line on stderr.
    """
    try:
        arguments = _parser().parse_args(argv)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            arguments.run(arguments)
        for warning in caught:
            _note(warning.message)
    except (ValueError, ImportError, OSError) as error:
        if isinstance(error, OSError) and error.strerror and error.filename:
            error = f"{error.filename}: {error.strerror}"
        print("camtorch: error:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("camtorch: interrupted", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="camtorch", description="Cameras as layers for PyTorch.", allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"camtorch {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    dewarp = commands.add_parser("dewarp", help="undistort a picture", allow_abbrev=False)
    dewarp.set_defaults(run=_dewarp)
    dewarp.add_argument("image", type=Path, metavar="IMAGE", help="the picture")
    dewarp.add_argument("--camera", type=Path, required=True, metavar="FILE", help="its camera: OpenCV's YAML or JSON")
    dewarp.add_argument(
        "--model",
        metavar="KEY",
        help="the camera model where the file does not say it: kannala_brandt, brown_conrady ...",
    )
    dewarp.add_argument("--name", help="which camera, in a file with several")
    dewarp.add_argument(
        "--projection", choices=("perspective", "cylindrical", "equirectangular"), default="perspective"
    )
    dewarp.add_argument(
        "--fov",
        type=float,
        metavar="DEGREES",
        help="horizontal field of view of the new picture; by default that of the old one, up to 120 in perspective",
    )
    dewarp.add_argument("--size", type=_size, metavar="WxH", help="size of the new picture; by default the old one's")
    dewarp.add_argument("--rescale", action="store_true", help="scale the camera to the picture's resolution")
    demo = commands.add_parser("demo", help="render, dewarp and measure a room seen by five lenses", allow_abbrev=False)
    demo.set_defaults(run=_demo)
    for command, output in ((dewarp, None), (demo, Path("demo.png"))):
        command.add_argument("-o", "--output", type=Path, required=output is None, default=output, metavar="OUT")
        command.add_argument("--force", action="store_true", help="overwrite OUT if it exists")
    return parser


def _note(text: object) -> None:
    print("camtorch: note:", text, file=sys.stderr)


def _size(text: str) -> tuple[int, int]:
    """(height, width) of "WIDTHxHEIGHT"."""
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() and len(side) < 9 for side in sides):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, as in 1280x720")
    width, height = map(int, sides)
    if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
        raise argparse.ArgumentTypeError(f"{text!r}: each side must be 1 to {_LARGEST_SIDE} pixels")
    return height, width


def _dewarp(arguments: argparse.Namespace) -> None:
    import torch

    from camtorch import Dewarp, image_files
    from camtorch.io import opencv

    fov = arguments.fov
    if fov is not None and not (0 < fov < 180 or (arguments.projection != "perspective" and 0 < fov <= 360)):
        wider = "; --projection cylindrical goes to 360" if arguments.projection == "perspective" and fov >= 180 else ""
        allowed = "below 180" if arguments.projection == "perspective" else "at most 360"
        raise ValueError(f"--fov must be above 0 and {allowed} degrees for {arguments.projection}; got {fov:g}{wider}")
    image_files.check_target(arguments.output, force=arguments.force)
    picture, orientation = image_files.read(arguments.image)
    camera = opencv.read(arguments.camera, arguments.model, name=arguments.name).requires_grad_(False)
    size = tuple(picture.shape[-2:])
    if camera.image_size is None:
        camera.image_size = size
        _note(f"{arguments.camera} states no image size; taken to be for {size[1]}x{size[0]}, as {arguments.image} is")
    elif camera.image_size != size:
        if not arguments.rescale:
            raise ValueError(_resolutions(arguments, size, camera.image_size))
        camera = camera.resize(*size)
    with torch.no_grad():
        warp = Dewarp(camera, projection=arguments.projection, fov=fov and math.radians(fov), image_size=arguments.size)
        result, filled = _in_strips(warp, picture)
        lattice = (camera.resize(64, 64).pixel_grid() + 0.5) * torch.tensor([size[1] / 64, size[0] / 64]) - 0.5
        shown = float(warp.transform_points(lattice)[1].double().mean())
    image_files.write(arguments.output, image_files.from_tensor(result), orientation=orientation)
    height, width = result.shape[-2:]
    fx, fy, cx, cy = warp.target.intrinsics.tolist()
    print(
        f"{arguments.output}: {camera.key} dewarped to {arguments.projection}, {_degrees(warp.target):.1f} degrees "
        f"wide, {width}x{height}, fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} cy {cy:.6g}; {100 * filled:.1f} % of it is "
        f"filled and shows {100 * shown:.0f} % of the photograph"
    )


def _in_strips(warp, picture):
    """The warped picture and the filled part of it, computed in strips that bound the memory of large targets."""
    import torch

    from camtorch import Warp

    height, width = warp.target.image_size
    rows = max(1, _STRIP_PIXELS // width)
    strips, filled = [], 0
    for top in range(0, height, rows):
        strip = Warp(warp.source, warp.target.crop(top, 0, min(rows, height - top), width))
        strips.append(strip(picture[None])[0])
        filled += int(strip.valid_mask().sum())
        if rows < height and sys.stderr.isatty():
            print(f"\r{min(100, 100 * (top + rows) // height)} %", end="", file=sys.stderr, flush=True)
    if rows < height and sys.stderr.isatty():
        print("\r", end="", file=sys.stderr)
    return torch.cat(strips, -2), filled / (height * width)


def _resolutions(arguments: argparse.Namespace, picture: tuple[int, int], camera: tuple[int, int]) -> str:
    (height, width), (camera_height, camera_width) = picture, camera
    text = (
        f"{arguments.image} is {width}x{height}, but the camera in {arguments.camera} is for "
        f"{camera_width}x{camera_height}; --rescale scales the camera to the picture"
    )
    if abs(width / camera_width - height / camera_height) * max(camera) > 1:
        text += ", but their shapes differ too, so the picture may be cropped, which scaling does not undo"
    return text


def _degrees(target) -> float:
    """The horizontal field of view of a target, from outer edge to outer edge."""
    fx, _, cx, _ = target.intrinsics.tolist()
    left, right = (cx + 0.5) / fx, (target.image_size[1] - 0.5 - cx) / fx
    if target.key == "pinhole":
        left, right = math.atan(left), math.atan(right)
    return math.degrees(left + right)


def _demo(arguments: argparse.Namespace) -> None:
    from camtorch import demo, image_files

    image_files.check_target(arguments.output, force=arguments.force)
    studies = demo.run(lambda line: print(line, flush=True))
    image_files.write(arguments.output, demo.picture(studies))
    print(f"{arguments.output}: the sources, what became of them, and what separates that from the truth")


if __name__ == "__main__":
    sys.exit(main())
