"""The command `camtorch map`: a dewarping as a lookup table for another runtime, with its error."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from camtorch.cli.options import add_calibration, add_output, add_projection, parse_path, parse_size

if TYPE_CHECKING:
    from camtorch.cli.options import Commands
    from camtorch.warp.warp import Warp

_OPTIONS = ("step", "v", "order", "block", "dtype", "clip")


def add(commands: Commands) -> None:
    """Add the command to a command line."""
    command = commands.add_parser(
        "map",
        help="write a dewarping as a lookup table for OpenCV, ONNX, STMap, camera chips",
        description="Write where each pixel of a dewarped image is taken from, for another runtime, and say how far "
        "that is from exact: camtorch map camera.yml -o map.exr",
        allow_abbrev=False,
    )
    command.set_defaults(run=run)
    command.add_argument("camera", type=parse_path, metavar="CAMERA", help="the calibration of the images, any format")
    add_calibration(command, size="--camera-size")
    target = command.add_argument_group("the new image")
    add_projection(target)
    target.add_argument(
        "--target", type=parse_path, metavar="FILE", help="a calibration: the new image is what that camera would see"
    )
    file = command.add_argument_group("the map")
    file.add_argument(
        "--format",
        help="opencv, opencv_fixed, stmap, dw100, ti_ldc, depthai, obj, gltf or onnx; by default what OUT's name says",
    )
    file.add_argument("--step", type=int, metavar="PIXELS", help="between nodes: ti_ldc, depthai, obj, gltf")
    file.add_argument("--v", choices=("up", "down"), help="stmap: which way v runs; up by default, as in Nuke")
    file.add_argument("--order", choices=("yx", "xy"), help="depthai: yx for loadMeshFiles (the default), or xy")
    file.add_argument("--block", type=parse_size, metavar="WxH", help="ti_ldc: of the new image; by default what fits")
    file.add_argument("--dtype", choices=("float32", "uint8"), help="onnx: of images; float32 by default")
    file.add_argument("--clip", action="store_true", default=None, help="dw100, ti_ldc: draw in what they cannot hold")
    file.add_argument(
        "--check", type=parse_path, metavar="MAP", help="write nothing; say how far this map is from the dewarping"
    )
    add_output(command, None, "the map")


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    from camtorch.cli import targets
    from camtorch.maps.formats import files_of

    output: Path | None = arguments.output
    if (output is None) == (arguments.check is None):
        raise ValueError("which map? -o OUT writes one, --check MAP measures one")
    if output is not None:
        for name in files_of(output, arguments.format):
            targets.check(Path(name), force=arguments.force, inputs=(arguments.camera, arguments.target))
    warp = _warp(arguments)
    if output is None:
        print(_checked(warp, arguments))
        return
    output.parent.mkdir(parents=True, exist_ok=True)
    report = warp.save(output, arguments.format, **{name: getattr(arguments, name) for name in _OPTIONS})
    print(report)


def _warp(arguments: argparse.Namespace) -> Warp:
    from camtorch.cli.cameras import read_camera
    from camtorch.warp.dewarp import Dewarp
    from camtorch.warp.warp import Warp

    camera = read_camera(arguments.camera, arguments.name, arguments.from_model, arguments.camera_size)
    if camera.image_size is None:
        raise ValueError(f"{arguments.camera} states no image size; --camera-size WxH says it")
    if arguments.target is None:
        return Dewarp(
            camera, projection=arguments.projection, fov=arguments.fov, image_size=arguments.size, tolerance=0
        )
    for name in ("fov", "size"):
        if getattr(arguments, name) is not None:
            raise ValueError(f"--{name} is for a dewarping; --target {arguments.target} says it")
    return Warp(camera, read_camera(arguments.target), tolerance=0)


def _checked(warp: Warp, arguments: argparse.Namespace) -> str:
    """The report on a map that is there."""
    from camtorch.maps.formats import check_map

    given = {name: getattr(arguments, name) for name in ("step", "v", "order")}
    return str(check_map(warp, arguments.check, arguments.format, **given))
