"""The commands and their options. This module is light: what a command needs is imported when it runs."""

from __future__ import annotations

import argparse
import glob
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from camtorch.cli import words

Commands: TypeAlias = "argparse._SubParsersAction[Any]"
Add: TypeAlias = Callable[..., Any]
"""The method `add_argument` of a command, or of a group of its options."""
NEAR, FAR = 3.0, 100.0
"""Depths in baselines, of which disparities and points are by default."""
SHEET, SHEET_COUNT = "augment.png", 8
"""Of `camtorch augment`: the image that it writes, and how many cameras that shows."""
_FORMAT = "of OUT; by default what its name says"
_BOARDS = ("chessboard", "charuco", "aprilgrid")  # as `camtorch.boards` has them, which takes numpy to import


def add_all(commands: Commands) -> None:
    """Add the commands to a command line; each is carried out by the function `run` of the module of its name."""
    for add in (_dewarp, _rectify, _birdseye, _augment, _map, _convert, _show, _lenses, _calibrate, _board):
        add(commands)


def uses_processes(arguments: argparse.Namespace) -> bool:
    """Whether a command may be one on many files, for which processes are to be started early."""
    if getattr(arguments, "jobs", 1) == 1 or arguments.dry_run:
        return False
    return are_several(arguments.image) if arguments.command == "dewarp" else arguments.dataset is not None


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
    text = "the image; or images, videos, folders, quoted patterns"
    add("image", type=words.raw_path, nargs="+", metavar="IMAGE", help=text)
    _projection(add)
    _photograph(command)
    text = "the new image, dewarped.png by default; OUT/, a folder, where there are several"
    add("-o", "--output", type=words.raw_path, metavar="OUT", help=text)
    _force(add)
    text = "of new images or videos; by default those of the old ones"
    _many_files(command)("--suffix", type=words.suffix, metavar=".EXT", help=text)
    video = command.add_argument_group("videos (pip install 'camtorch[video]')").add_argument
    codecs = ("libx264", "libvpx-vp9", "ffv1")
    video("--codec", choices=codecs, help="the encoder; libx264 by default, in .webm libvpx-vp9; ffv1 loses nothing")
    video("--crf", type=int, metavar="N", help="its quality, lower is better; 18 in libx264")


def _rectify(commands: Commands) -> None:
    command = commands.add_parser(
        "rectify",
        help="rectify a stereo pair; disparities and points of it",
        description="Rectify a stereo pair: camtorch rectify left.jpg right.jpg --camera rig.json -o out. The folder "
        "OUT gets left.png and right.png, whose rows correspond, pair.png, both beside each other with lines along "
        "rows, rectified.json, their cameras, and in perspective opencv.yml: R1, R2, P1, P2, Q.",
    )
    add = command.add_argument
    add("left", type=words.path, metavar="LEFT", help="the left camera's image")
    add("right", type=words.path, metavar="RIGHT", help="the right camera's, of the same moment")
    add("--camera", type=words.path, metavar="RIG", help="its calibration with both poses, any format")
    add("--names", nargs=2, metavar=("LEFT", "RIGHT"), help="their cameras; by default the first and the second of two")
    _from_model(add)
    _rescale(add)
    image = command.add_argument_group("rectified images").add_argument
    ways = ("perspective", "latlon", "cylindrical")
    text = "perspective (the default) goes to some 120 degrees; latlon and cylindrical, about the baseline, further"
    image("--projection", choices=ways, default="perspective", help=text)
    text = "of view, horizontal, or horizontal,vertical; else what fits"
    image("--fov", type=words.span, metavar="DEGREES", help=text)
    image("--size", type=words.size, metavar="WxH", help="else what loses no detail")
    image("--vertical", action="store_true", help="LEFT is the upper of two: columns correspond")
    depth = command.add_argument_group('depth, with OpenCV: pip install "camtorch[stereo]"').add_argument
    text = "OUT/disparity.npy, in pixels, NaN where unknown; and disparity.png to look at"
    depth("--disparity", action="store_true", help=text)
    depth("--points", action="store_true", help="OUT/points.ply, coloured, in the left camera's frame and unit")
    text = (
        f"the depths to look for, in the unit of RIG's poses; FAR may be inf; else {NEAR:g} to {FAR:g} times "
        "the distance of the cameras for points, and what is farther too for disparities"
    )
    depth("--depth", nargs=2, type=float, metavar=("NEAR", "FAR"), help=text)
    _output(add, "rectified", "the folder of the new images")


def _birdseye(commands: Commands) -> None:
    command = commands.add_parser(
        "birdseye",
        help="see the ground from above",
        description="See the ground from above: camtorch birdseye photo.jpg --camera camera.json --x -3 3 --y 1 9 "
        "--resolution 0.01 -o above.png. The pose in FILE is camera from ground, z up; without one, --height and "
        "--pitch say how the camera looks, and the ground's y axis lies ahead of it, x to its right, the origin "
        "below it.",
    )
    command.add_argument("image", type=words.path, metavar="IMAGE", help="the image")
    ground = command.add_argument_group("ground, in the unit of the pose, or of --height").add_argument
    for name, text in (("--x", "what is seen, left to right"), ("--y", "what is seen, bottom to top")):
        ground(name, type=float, nargs=2, required=True, metavar=("FROM", "TO"), help=text)
    ground("--resolution", type=float, required=True, metavar="UNITS", help="of a pixel: 0.01 for 1 cm")
    pose = command.add_argument_group("pose, instead of that in FILE").add_argument
    pose("--height", type=float, help="of the camera above the ground")
    text = "down from the horizon, 90 for straight down; 0 by default"
    pose("--pitch", type=float, metavar="DEGREES", help=text)
    _photograph(command)
    _output(command.add_argument, "birdseye.png")


def _augment(commands: Commands) -> None:
    command = commands.add_parser(
        "augment",
        help="a sheet of an image with its labels, or a data set, as other cameras see them",
        description="A sheet of an image with its labels as other cameras see them. With --dataset a new data set: "
        "camtorch augment images/ --dataset annotations.json --camera camera.yml -o new/. A RANGE is LOW,HIGH, as in "
        "--yaw=-5,20, or a number: so far to either side of doing nothing, or just that --fov.",
    )
    add = command.add_argument
    text = "the image; the folder of images of a data set"
    add("image", type=words.path, nargs="?", metavar="IMAGE", help=text)
    text = "of IMAGE: JSON of keypoints, boxes, gaze_from in pixels, gaze, and perhaps its camera"
    add("--labels", type=words.path, metavar="FILE", help=text)
    add("--preset", default="none", metavar="NAME", help="whose lens the other cameras have")
    add("--list", action="store_true", help="print the presets, and nothing else")
    add("-n", type=words.count(100), metavar="COUNT", help=f"how many other cameras; {SHEET_COUNT} by default")
    add("--seed", type=words.count(2**63 - 1, 0), default=0, metavar="N", help="of what is drawn; 0 by default")
    add("--size", type=words.size, metavar="WxH", help="of the new images; by default the old one's")
    for name, text in (
        ("yaw", "degrees by which the camera turns to its right"),
        ("pitch", "degrees by which it then looks up"),
        ("roll", "degrees by which it then leans to its right"),
        ("zoom", "factor on the focal lengths"),
    ):
        add(f"--{name}", type=words.span, metavar="RANGE", help=text)
    text = "horizontal field of view in degrees; or source: as much of the lens's as the image fills"
    add("--fov", type=words.fov, metavar="RANGE", help=text)
    text = "of each new image that has to show something, 0 to 1: it zooms until it does; 0 by default"
    add("--min-filled", type=float, default=0.0, metavar="PART", help=text)
    _photograph(command)
    _output(add, None, f"the sheet, {SHEET} by default; of a data set, a folder")
    many = _many_files(command)
    text = "of all images of the folder IMAGE: a JSON file in COCO's format, or a folder of a JSON file for each"
    many("--dataset", type=words.path, metavar="LABELS", help=text)


def _map(commands: Commands) -> None:
    command = commands.add_parser(
        "map",
        help="write a dewarping as a lookup table for OpenCV, ONNX, STMap, camera chips",
        description="Write where each pixel of a dewarped image is taken from, for another runtime, and say how far "
        "that is from exact: camtorch map camera.yml -o map.exr",
    )
    add = command.add_argument
    add("camera", type=words.path, metavar="CAMERA", help="the calibration of the images, any format")
    _calibration(add, size="--camera-size")
    target = command.add_argument_group("the new image").add_argument
    _projection(target)
    text = "a calibration: the new image is what that camera would see"
    target("--target", type=words.path, metavar="FILE", help=text)
    file = command.add_argument_group("the map").add_argument
    text = "opencv, opencv_fixed, stmap, dw100, ti_ldc, depthai, obj or onnx; by default what OUT's name says"
    file("--format", help=text)
    file("--step", type=int, metavar="PIXELS", help="between nodes: ti_ldc, depthai, obj")
    file("--v", choices=("up", "down"), help="stmap: which way v runs; up by default, as in Nuke")
    file("--block", type=words.size, metavar="WxH", help="ti_ldc: of the new image; by default what fits")
    file("--dtype", choices=("float32", "uint8"), help="onnx: of images; float32 by default")
    file("--clip", action="store_true", default=None, help="dw100, ti_ldc: draw in what they cannot hold")
    text = "write nothing; say how far this map is from the dewarping"
    file("--check", type=words.path, metavar="MAP", help=text)
    _output(add, None, "the map")


def _convert(commands: Commands) -> None:
    command = commands.add_parser(
        "convert",
        help="write a calibration as another camera model, or in another format",
        description="Write the cameras of a calibration file as cameras of another model, and print how good that is.",
    )
    add = command.add_argument
    add("input", type=words.path, metavar="IN", help="a calibration file")
    add("new", type=words.path, nargs="?", metavar="OUT", help="the new one")
    add("-o", "--output", type=words.path, metavar="OUT", help="the same, as of other commands")
    add("--model", metavar="KEY", help="the model of OUT; by default that of IN")
    add("--count", type=int, metavar="N", help="of coefficients, where the model leaves a choice")
    add("--max-angle", type=float, metavar="DEGREES", help="from the axis, up to which rays matter")
    add("--format", help=_FORMAT)
    _calibration(add, "which camera is saved, alone and without its pose")
    _force(add)


def _show(commands: Commands) -> None:
    add = commands.add_parser("show", help="what a calibration says, in numbers and in an image").add_argument
    add("input", type=words.path, metavar="FILE", help="a calibration file")
    add("--against", type=words.path, metavar="OTHER", help="another calibration, to compare with")
    _calibration(add)
    text = "a page that shows the lens live: one file that needs no other"
    add("--html", type=words.path, metavar="PAGE", help=text)
    add("--image", type=words.path, metavar="PHOTO", help="of the camera, for the page")
    _output(add, None, "an image: distortion, radius over angle")


def _lenses(commands: Commands) -> None:
    command = commands.add_parser(
        "lenses",
        help="find a real lens by its name",
        description="List calibrated lenses by words of their names, best first: camtorch lenses GoPro HERO9 wide. "
        "Other commands take the first of a list as --lens 'GoPro HERO9 wide'.",
    )
    add = command.add_argument
    add("words", nargs="+", metavar="WORD", help="of brand, camera, lens and setting, in any order")
    add("--size", type=words.size, metavar="WxH", help="of images: only lenses of that aspect ratio, scaled to it")
    add("-n", type=words.count(100000), default=10, metavar="N", help="how many are listed at most; 10 by default")
    add("--format", help=_FORMAT)
    _output(add, None, "the calibration of the first")


def _calibrate(commands: Commands) -> None:
    command = commands.add_parser(
        "calibrate",
        help="calibrate a camera or a rig from photographs or a video of a board",
        description="Calibrate a camera from photographs of a board: camtorch calibrate images/*.jpg --board 9x6 "
        "--square 25mm -o camera.yml --report report.html. A video, board.mp4, does as well: sharp frames that differ "
        "are taken.",
    )
    add = command.add_argument
    add("images", nargs="*", metavar="IMAGE", help="files, quoted patterns, or folders; or a video")
    rig = command.add_argument_group("several cameras, instead of IMAGE").add_argument
    rig("--left", nargs="+", metavar="IMAGE", help="of the left camera of a pair")
    rig("--right", nargs="+", metavar="IMAGE", help="of the right one")
    rig("--rig", nargs="+", metavar="NAME=IMAGE", help="of any number of cameras: a folder or a pattern")
    _board_options(command, "if left out, distances are in squares")
    lens = command.add_argument_group("camera").add_argument
    lens("--model", metavar="KEY", help="kannala_brandt, brown_conrady ...; by default the one that fits")
    lens("--count", type=int, metavar="N", help="of coefficients, where the model leaves a choice")
    lens("--fixed", metavar="NAMES", help="held parameters, as cx,cy (in the middle) or k3 (at 0)")
    lens("--loss", choices=("huber", "cauchy"), help="for corners of which some are wrong")
    lens("--loss-scale", type=float, default=1.0, metavar="PX", help="of that loss; 1 by default")
    lens("--bend", action="store_true", help="the board is not quite flat: find its bend as well")
    add(
        "--corners",
        type=words.path,
        metavar="FILE",
        help="a .json to keep corners in; without images, to take them from",
    )
    add("--report", type=words.path, metavar="FILE", help="an .html to look at: how far the result can be trusted")
    add("--format", help=f"{_FORMAT}, OpenCV's for .yml")
    _output(add, "camera.json", "the calibration")


def _board(commands: Commands) -> None:
    command = commands.add_parser(
        "board",
        help="draw a board to print, for camtorch calibrate",
        description="Draw a board to print, to scale: camtorch board --board 9x6 --square 25mm -o board.pdf. "
        "Print it at 100 % (no fit to page), on something flat.",
    )
    _board_options(command, "by default as many whole millimetres as fit on the paper")
    papers = ", ".join(words.PAPERS)
    text = f"{papers}, WIDTHxHEIGHT as in 400x300mm, or board: as large as needed; a4 by default"
    command.add_argument("--paper", type=words.paper, default="a4", metavar="NAME", help=text)
    _output(command.add_argument, "board.pdf", "the drawing, a .pdf or .svg")


# -- options of several commands


def _photograph(command: argparse.ArgumentParser) -> None:
    """The calibration of an image."""
    which = command.add_mutually_exclusive_group().add_argument
    which("--camera", type=words.path, metavar="FILE", help="its calibration, of any format")
    text = "instead of a calibration, a real lens by its name: camtorch lenses lists them"
    which("--lens", type=lambda text: words.path(words.LENS + text), dest="camera", metavar="NAME", help=text)
    text = (
        "instead of a calibration, a guess: a camera of this horizontal field of view, pinhole below 100 degrees, "
        "equidistant kannala_brandt from there on, or what --model says"
    )
    which("--guess-fov", type=words.guess, dest="camera", metavar="DEGREES", help=text)
    _from_model(command.add_argument, "--model")
    command.add_argument("--name", help="which camera, in a file with several")
    _rescale(command.add_argument)


def _calibration(add: Add, of_name: str = "which camera, in a file with several", size: str = "--size") -> None:
    """How to read a calibration that is the command's subject; `size` is the option that says for which images."""
    add("--name", help=of_name)
    _from_model(add)
    add(size, type=words.size, metavar="WxH", help="of images, where the file does not say")


def _from_model(add: Add, *others: str) -> None:
    text = "the model in the file, where that does not say it: kannala_brandt, brown_conrady ..."
    add("--from-model", *others, metavar="KEY", help=text)


def _rescale(add: Add) -> None:
    add("--rescale", action="store_true", help="scale the camera to the image's resolution, of the same aspect ratio")


def _projection(add: Add) -> None:
    """What a dewarped image shows."""
    ways = ("perspective", "stereographic", "cylindrical", "equirectangular")
    text = "keeps lines straight (the default), shapes, upright lines; or shows all around"
    add("--projection", choices=ways, default="perspective", help=text)
    text = "horizontal field of view of the new image; by default that of the old one, up to 120 in perspective"
    add("--fov", type=float, metavar="DEGREES", help=text)
    add("--size", type=words.size, metavar="WxH", help="size of the new image; by default the old one's")


def _board_options(command: argparse.ArgumentParser, square: str) -> None:
    """The board, of which `square` says what its side is without --square."""
    add = command.add_argument_group("board").add_argument
    add("--type", choices=_BOARDS, help="chessboard by default")
    text = "columns and rows: of a chessboard's inner corners, of ChArUco's squares, of AprilGrid's tags"
    add("--board", type=words.board, metavar="CxR", help=text)
    text = f"the side of a square or AprilTag, as 30mm, or in metres: 0.03; {square}"
    add("--square", type=words.length, metavar="LENGTH", help=text)
    add("--marker", type=words.length, metavar="LENGTH", help="of ChArUco; by default 3/4 of a square")
    add("--legacy", action="store_true", help="a ChArUco board drawn by OpenCV before 4.6")
    add("--spacing", type=float, metavar="PART", help="of AprilTags, in sides of a tag; 0.3 by default")
    add("--border", type=int, metavar="CELLS", help="of AprilTags; 2 by default, as Kalibr prints")
    text = "of markers, as OpenCV calls it; 5X5_1000 for ChArUco and APRILTAG_36h11 by default"
    add("--dictionary", metavar="NAME", help=text)


def _output(add: Add, default: str | None, text: str = "the new image") -> None:
    """Where the result goes."""
    usual = f"; {default} by default" if default else ""
    path = default and Path(default)
    add("-o", "--output", type=words.path, default=path, metavar="OUT", help=text + usual)
    _force(add)


def _force(add: Add) -> None:
    add("--force", action="store_true", help="overwrite OUT if it exists")


def _many_files(command: argparse.ArgumentParser) -> Add:
    """How many files are worked on; what is returned adds more of this."""
    add = command.add_argument_group("many files").add_argument
    add("--jobs", type=words.count(1024), metavar="N", help="processes; by default as many as there are cores")
    text = "go on where a run was broken off; what is done and unchanged is kept"
    add("--resume", action="store_true", help=text)
    text = "only the I-th of N parts, as 1/4; processes of torchrun and srun know theirs"
    add("--shard", type=words.shard, metavar="I/N", help=text)
    add("--dry-run", action="store_true", help="print what would be done")
    return add
