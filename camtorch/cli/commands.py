"""The commands and their options. Imports are light: the modules of a command are imported when it runs."""

import argparse
import glob
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from camtorch.cli import words

Commands: TypeAlias = "argparse._SubParsersAction[Any]"
Add: TypeAlias = Callable[..., Any]  # the method `add_argument` of a command, or of a group of its options
_FORMAT = "of OUT; by default as its name ends"


def add_all(commands: Commands) -> None:
    """Add the commands to a command line; each is run by the function `run` of the module of its name."""
    for add in (_dewarp, _map, _convert, _show, _lenses, _calibrate):
        add(commands)


def are_several(names: list[str]) -> bool:
    """Whether names mean more than one file."""
    is_pattern = glob.has_magic(names[0]) and not os.path.lexists(names[0])
    return len(names) > 1 or os.path.isdir(names[0]) or is_pattern


def _dewarp(commands: Commands) -> None:
    command = commands.add_parser(
        "dewarp",
        help="undistort images and videos",
        description="Undistort an image: camtorch dewarp photo.jpg --camera camera.yml -o straight.png; or all of a "
        "folder: camtorch dewarp images/ --camera camera.yml -o straight/",
    )
    add = command.add_argument
    add("image", type=words.raw_path, nargs="+", metavar="IMAGE", help="images, videos, folders, quoted patterns")
    _projection(add)
    which = command.add_mutually_exclusive_group().add_argument
    which("--camera", type=words.path, metavar="FILE", help="its calibration, of any format")
    text = "instead of a calibration, a real lens by its name: camtorch lenses lists them"
    which("--lens", type=lambda text: words.path(words.LENS + text), dest="camera", metavar="NAME", help=text)
    text = (
        "instead, a guess by its horizontal field of view: pinhole below 100 degrees, else kannala_brandt, or --model"
    )
    which("--guess-fov", type=words.guess, dest="camera", metavar="DEGREES", help=text)
    _from_model(add, "--model")
    add("--name", help="which camera, in a file with several")
    add("--rescale", action="store_true", help="scale the camera to the image's resolution, of the same aspect ratio")
    text = "the new image, dewarped.png by default; OUT/, a folder, for several"
    add("-o", "--output", type=words.raw_path, metavar="OUT", help=text)
    if_there = command.add_mutually_exclusive_group().add_argument
    _force(if_there)
    if_there("--resume", action="store_true", help="make only what OUT/ does not hold yet, as after a broken run")
    many = command.add_argument_group("many files").add_argument
    many("--jobs", type=words.count(1024), metavar="N", help="processes; by default as many as there are cores")
    many("--suffix", type=words.suffix, metavar=".EXT", help="of new images or videos, else as the old ones")
    video = command.add_argument_group("videos (pip install -e '.[video]')").add_argument
    text = "the encoder; libx264 by default, in .webm libvpx-vp9; ffv1 is lossless"
    video("--codec", choices=("libx264", "libvpx-vp9", "ffv1"), help=text)
    video("--crf", type=int, metavar="N", help="its quality, lower is better; 18 in libx264")


def _map(commands: Commands) -> None:
    command = commands.add_parser(
        "map",
        help="write a dewarping as a lookup table for OpenCV, ONNX, camera chips",
        description="Write where each pixel of a dewarped image is taken from, for another runtime, and print how far "
        "that is from exact: camtorch map camera.yml -o map.npz",
    )
    add = command.add_argument
    add("camera", type=words.path, metavar="CAMERA", help="the calibration of the images, any format")
    _calibration(add, size="--camera-size")
    target = command.add_argument_group("the new image").add_argument
    _projection(target)
    target("--target", type=words.path, metavar="FILE", help="a calibration: what that camera would see")
    file = command.add_argument_group("the map").add_argument
    file("--format", help="opencv, opencv_fixed, dw100, ti_ldc or onnx; by default as OUT ends")
    file("--step", type=int, metavar="PIXELS", help="ti_ldc: between nodes; 8 by default")
    file("--dtype", choices=("float32", "uint8"), help="onnx: of images; float32 by default")
    file("--clip", action="store_true", default=None, help="dw100, ti_ldc: clip positions that they cannot hold")
    file("--check", type=words.path, metavar="MAP", help="write nothing; print how far this map is from the dewarping")
    _output(add, "the map")


def _convert(commands: Commands) -> None:
    add = commands.add_parser(
        "convert",
        help="write a calibration as another camera model, or in another format",
        description="Write the cameras of a calibration file as cameras of another model, and print how good that is.",
    ).add_argument
    add("input", type=words.path, metavar="IN", help="a calibration file")
    add("new", type=words.path, nargs="?", metavar="OUT", help="the new one")
    add("-o", "--output", type=words.path, metavar="OUT", help="the same, as of other commands")
    add("--model", metavar="KEY", help="the model of OUT; by default that of IN")
    add("--count", type=int, metavar="N", help="of coefficients, if the model has several counts")
    add("--max-angle", type=float, metavar="DEGREES", help="from the axis, up to which rays matter")
    add("--format", help=_FORMAT)
    _calibration(add, "which camera is saved, alone and without its pose")
    _force(add)


def _show(commands: Commands) -> None:
    add = commands.add_parser(
        "show",
        help="show a calibration in numbers and in an image",
        description="Print the cameras of a calibration file, compare two of them, or draw one: camtorch show "
        "camera.yml -o lens.png",
    ).add_argument
    add("input", type=words.path, metavar="FILE", help="a calibration file")
    add("--against", type=words.path, metavar="OTHER", help="another calibration, to compare with")
    _calibration(add)
    add("--html", type=words.path, metavar="PAGE", help="a page that shows the lens live: one file that needs no other")
    add("--image", type=words.path, metavar="PHOTO", help="of the camera, for the page")
    _output(add, "an image: distortion, radius over angle")


def _lenses(commands: Commands) -> None:
    add = commands.add_parser(
        "lenses",
        help="find a real lens by its name",
        description="List calibrated lenses by words of their names, best first: camtorch lenses GoPro HERO9 wide. "
        "Other commands take the first of a list as --lens 'GoPro HERO9 wide'.",
    ).add_argument
    add("words", nargs="+", metavar="WORD", help="of brand, camera, lens and setting, in any order")
    add("--size", type=words.size, metavar="WxH", help="of images: only lenses of that aspect ratio, scaled to it")
    add("-n", type=words.count(100000), default=10, metavar="N", help="how many are listed at most; 10 by default")
    add("--format", help=_FORMAT)
    _output(add, "the calibration of the first")


def _calibrate(commands: Commands) -> None:
    command = commands.add_parser(
        "calibrate",
        help="calibrate a camera or a rig from photographs or a video of a board",
        description="Calibrate a camera from photographs of a board: camtorch calibrate images/*.jpg --board 9x6 "
        "--square 25mm -o camera.yml. A video, board.mp4, does as well: sharp frames that differ are taken.",
    )
    add = command.add_argument
    add("images", nargs="*", metavar="IMAGE", help="files, quoted patterns, or folders; or a video")
    rig = command.add_argument_group("several cameras, instead of IMAGE").add_argument
    rig("--left", nargs="+", metavar="IMAGE", help="of the left camera of a pair")
    rig("--right", nargs="+", metavar="IMAGE", help="of the right one")
    rig("--rig", nargs="+", metavar="NAME=IMAGE", help="of any number of cameras: a folder or a pattern")
    board = command.add_argument_group("board").add_argument
    kinds = ("chessboard", "charuco", "aprilgrid")  # copied from `camtorch.boards`, whose import needs numpy
    board("--type", choices=kinds, help="chessboard by default")
    text = "columns and rows: of a chessboard's inner corners, of ChArUco's squares, of AprilGrid's tags"
    board("--board", type=words.board, metavar="CxR", help=text)
    text = "the side of a square or AprilTag, as 30mm, or in metres: 0.03; if left out, distances are in squares"
    board("--square", type=words.length, metavar="LENGTH", help=text)
    board("--marker", type=words.length, metavar="LENGTH", help="of ChArUco; by default 3/4 of a square")
    board("--legacy", action="store_true", help="a ChArUco board drawn by OpenCV before 4.6")
    board("--spacing", type=float, metavar="PART", help="of AprilTags, in sides of a tag; 0.3 by default")
    board("--border", type=int, metavar="CELLS", help="of AprilTags; 2 by default, as Kalibr prints")
    board("--dictionary", metavar="NAME", help="of markers, by OpenCV's name; by default 5X5_1000, or APRILTAG_36h11")
    lens = command.add_argument_group("camera").add_argument
    lens("--model", metavar="KEY", help="kannala_brandt, brown_conrady ...; by default the one that fits")
    lens("--count", type=int, metavar="N", help="of coefficients, if the model has several counts")
    lens("--fixed", metavar="NAMES", help="held parameters, as cx,cy (in the middle) or k3 (at 0)")
    lens("--loss", choices=("huber", "cauchy"), help="a robust loss, if some corners are wrong")
    lens("--loss-scale", type=float, default=1.0, metavar="PX", help="of that loss; 1 by default")
    lens("--bend", action="store_true", help="the board is not quite flat: find its bend as well")
    add("--format", help=f"{_FORMAT}, OpenCV's for .yml")
    _output(add, "the calibration; camera.json by default", Path("camera.json"))


def _calibration(add: Add, of_name: str = "which camera, in a file with several", size: str = "--size") -> None:
    """Add options for reading a calibration; `size` is the name of the option for the image size."""
    add("--name", help=of_name)
    _from_model(add)
    add(size, type=words.size, metavar="WxH", help="of images, if the file has none")


def _from_model(add: Add, *others: str) -> None:
    text = "the model in the file, if it names none: kannala_brandt, brown_conrady ..."
    add("--from-model", *others, metavar="KEY", help=text)


def _projection(add: Add) -> None:
    ways = ("perspective", "stereographic", "cylindrical", "equirectangular")
    text = "keeps lines straight (the default), shapes, upright lines; or shows all around"
    add("--projection", choices=ways, default="perspective", help=text)
    text = "horizontal field of view of the new image; by default that of the old one, up to 120 in perspective"
    add("--fov", type=float, metavar="DEGREES", help=text)
    add("--size", type=words.size, metavar="WxH", help="size of the new image; by default the old one's")


def _output(add: Add, text: str, default: Path | None = None) -> None:
    add("-o", "--output", type=words.path, default=default, metavar="OUT", help=text)
    _force(add)


def _force(add: Add) -> None:
    add("--force", action="store_true", help="overwrite OUT if it exists")
