"""The commands and their options. This module is light: what a command needs is imported when it runs."""

from __future__ import annotations

import argparse
import glob
import os
from pathlib import Path
from typing import Any, TypeAlias

from camtorch.cli.options import (
    PAPERS,
    add_board,
    add_calibration,
    add_force,
    add_jobs,
    add_output,
    add_pair,
    add_photograph,
    add_projection,
    parse_count,
    parse_fov,
    parse_paper,
    parse_path,
    parse_range,
    parse_size,
    parse_suffix,
    parse_word,
)

Commands: TypeAlias = "argparse._SubParsersAction[Any]"
NEAR, FAR = 3.0, 100.0
"""Depths in baselines, of which disparities and points are by default."""
SHEET, SHEET_COUNT = "augment.png", 8
"""Of `camtorch augment`: the image that it writes, and how many cameras that shows."""


def add_all(commands: Commands) -> None:
    """Add the commands to a command line; each is carried out by the function `run` of the module of its name."""
    for add in (_dewarp, _rectify, _birdseye, _augment, _map, _convert, _show, _lenses, _calibrate, _board):
        add(commands)


def uses_processes(arguments: argparse.Namespace) -> bool:
    """Whether a command may be one on many files, for which processes are to be started early."""
    if getattr(arguments, "jobs", 1) == 1 or arguments.dry_run:
        return False
    return are_several(arguments.image) if arguments.command == "dewarp" else arguments.dataset is not None


def are_several(words: list[str]) -> bool:
    """Whether words mean more than one file."""
    is_pattern = glob.has_magic(words[0]) and not os.path.lexists(words[0])
    return len(words) > 1 or os.path.isdir(words[0]) or is_pattern


def _dewarp(commands: Commands) -> None:
    command = commands.add_parser(
        "dewarp",
        help="undistort images and videos",
        description="Undistort an image: camtorch dewarp photo.jpg --camera camera.yml -o straight.png; or all of a "
        "folder: camtorch dewarp images/ --camera camera.yml -o straight/",
    )
    add = command.add_argument
    add(
        "image",
        type=parse_word,
        nargs="+",
        metavar="IMAGE",
        help="the image; or images, videos, folders, quoted patterns",
    )
    add_projection(command)
    add_photograph(command)
    add(
        "-o",
        "--output",
        type=parse_word,
        metavar="OUT",
        help="the new image, dewarped.png by default; OUT/, a folder, where there are several",
    )
    add_force(command)
    many = add_jobs(command)
    many.add_argument(
        "--suffix", type=parse_suffix, metavar=".EXT", help="of new images or videos; by default those of the old ones"
    )
    video = command.add_argument_group("videos (pip install 'camtorch[video]')")
    video.add_argument(
        "--codec", metavar="NAME", help="an encoder of ffmpeg's; libx264 by default, in .webm libvpx-vp9"
    )
    video.add_argument("--crf", type=int, metavar="N", help="the encoder's quality, lower is better; 18 in libx264")


def _rectify(commands: Commands) -> None:
    command = commands.add_parser(
        "rectify",
        help="rectify a stereo pair; disparities and points of it",
        description="Rectify a stereo pair: camtorch rectify left.jpg right.jpg --camera rig.json -o out. The folder "
        "OUT gets left.png and right.png, whose rows correspond, pair.png, both beside each other with lines along "
        "rows, rectified.json, their cameras, and in perspective opencv.yml: R1, R2, P1, P2, Q.",
    )
    add = command.add_argument
    add("left", type=parse_path, metavar="LEFT", help="the left camera's image")
    add("right", type=parse_path, metavar="RIGHT", help="the right camera's, of the same moment")
    add_pair(command)
    images = command.add_argument_group("rectified images")
    images.add_argument(
        "--projection",
        choices=("perspective", "latlon", "cylindrical"),
        default="perspective",
        help="perspective (the default) goes to some 120 degrees; latlon and cylindrical, about the baseline, further",
    )
    images.add_argument(
        "--fov", type=parse_range, metavar="DEGREES", help="of view, horizontal, or horizontal,vertical; else what fits"
    )
    images.add_argument("--size", type=parse_size, metavar="WxH", help="else what loses no detail")
    images.add_argument("--vertical", action="store_true", help="LEFT is the upper of two: columns correspond")
    images.add_argument(
        "--align",
        choices=("mean", "opencv"),
        default="mean",
        help="mean: look where both cameras look on average (the default); opencv: halve their rotation, as it does",
    )
    depth = command.add_argument_group('depth, with OpenCV: pip install "camtorch[stereo]"')
    depth.add_argument(
        "--disparity",
        nargs="?",
        type=parse_path,
        const=Path(),
        metavar="FILE",
        help="pixels of disparity: a .png of 16 bits, 256 times as many, 0 where unknown, or an .npy, NaN where "
        "unknown; OUT/disparity.png by default. And OUT/disparity_colours.png to look at",
    )
    depth.add_argument(
        "--points", type=parse_path, metavar="FILE.ply", help="coloured points, in the left camera's frame and unit"
    )
    depth.add_argument(
        "--depth",
        nargs=2,
        type=float,
        metavar=("NEAR", "FAR"),
        help=f"the depths to look for, in the unit of RIG's poses; FAR may be inf; else {NEAR:g} to {FAR:g} times "
        "the distance of the cameras for points, and what is farther too for disparities",
    )
    add_output(command, "rectified", "the folder of the new images")


def _birdseye(commands: Commands) -> None:
    command = commands.add_parser(
        "birdseye",
        help="see the ground from above",
        description="See the ground from above: camtorch birdseye photo.jpg --camera camera.json --x -3 3 --y 1 9 "
        "--resolution 0.01 -o above.png. The pose in FILE is camera from ground, z up; without one, --height and "
        "--pitch say how the camera looks, and the ground's y axis lies ahead of it, x to its right, the origin "
        "below it.",
    )
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


def _augment(commands: Commands) -> None:
    command = commands.add_parser(
        "augment",
        help="a sheet of an image with its labels, or a data set, as other cameras see them",
        description="A sheet of an image with its labels as other cameras see them. With --dataset a new data set: "
        "camtorch augment images/ --dataset annotations.json --camera camera.yml -o new/. A RANGE is LOW,HIGH, as in "
        "--yaw=-5,20, or a number: so far to either side of doing nothing, or just that --fov.",
    )
    add = command.add_argument
    add("image", type=parse_path, nargs="?", metavar="IMAGE", help="the image; the folder of images of a data set")
    add(
        "--labels",
        type=parse_path,
        metavar="FILE",
        help="of IMAGE: JSON of keypoints, boxes, gaze_from in pixels, gaze, and perhaps its camera",
    )
    add("--preset", default="none", metavar="NAME", help="whose lens the other cameras have")
    add("--list", action="store_true", help="print the presets, and nothing else")
    add("-n", type=parse_count(100), metavar="COUNT", help=f"how many other cameras; {SHEET_COUNT} by default")
    add("--seed", type=int, default=0, help="of what is drawn; 0 by default")
    add("--size", type=parse_size, metavar="WxH", help="of the new images; by default the old one's")
    for name, text in (
        ("yaw", "degrees by which the camera turns to its right"),
        ("pitch", "degrees by which it then looks up"),
        ("roll", "degrees by which it then leans to its right"),
        ("zoom", "factor on the focal lengths"),
    ):
        add(f"--{name}", type=parse_range, metavar="RANGE", help=text)
    add(
        "--fov",
        type=parse_fov,
        metavar="RANGE",
        help="horizontal field of view in degrees; or source: as much of the lens's as the image fills",
    )
    add(
        "--min-filled",
        type=float,
        default=0.0,
        metavar="PART",
        help="of each new image that has to show something, 0 to 1: it zooms until it does; 0 by default",
    )
    add_photograph(command)
    add_output(command, None, f"the sheet, {SHEET} by default; of a data set, a folder")
    many = add_jobs(command)
    many.add_argument(
        "--dataset",
        type=parse_path,
        metavar="LABELS",
        help="of all images of the folder IMAGE: a JSON file in COCO's format, or a folder of a JSON file for each",
    )
    many.add_argument("--copies", type=parse_count(10000), metavar="N", help="new images of each; 1 by default")


def _map(commands: Commands) -> None:
    command = commands.add_parser(
        "map",
        help="write a dewarping as a lookup table for OpenCV, ONNX, STMap, camera chips",
        description="Write where each pixel of a dewarped image is taken from, for another runtime, and say how far "
        "that is from exact: camtorch map camera.yml -o map.exr",
    )
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


def _convert(commands: Commands) -> None:
    command = commands.add_parser(
        "convert",
        help="write a calibration as another camera model, or in another format",
        description="Write the cameras of a calibration file as cameras of another model, and print how good that is.",
    )
    add = command.add_argument
    add("input", type=parse_path, metavar="IN", help="a calibration file")
    add("output", type=parse_path, metavar="OUT", help="the new one")
    add("--model", metavar="KEY", help="the model of OUT; by default that of IN")
    add("--count", type=int, metavar="N", help="of coefficients, where the model leaves a choice")
    add("--max-angle", type=float, metavar="DEGREES", help="from the axis, up to which rays matter")
    add("--format", help="of OUT; by default what its name says")
    add_calibration(command, "which camera is saved, alone and without its pose")
    add_force(command)


def _show(commands: Commands) -> None:
    command = commands.add_parser("show", help="what a calibration says, in numbers and in an image")
    add = command.add_argument
    add("input", type=parse_path, metavar="FILE", help="a calibration file")
    add("--against", type=parse_path, metavar="OTHER", help="another calibration, to compare with")
    add_calibration(command)
    add_output(command, None, "an image: distortion, radius over angle")


def _lenses(commands: Commands) -> None:
    command = commands.add_parser(
        "lenses",
        help="find a real lens by its name",
        description="List calibrated lenses by words of their names, best first: camtorch lenses GoPro HERO9 wide. "
        "Other commands take the first of a list as --lens 'GoPro HERO9 wide'.",
    )
    add = command.add_argument
    add("words", nargs="+", metavar="WORD", help="of brand, camera, lens and setting, in any order")
    add("--size", type=parse_size, metavar="WxH", help="of images: only lenses of that aspect ratio, scaled to it")
    add("-n", type=parse_count(100000), default=10, metavar="N", help="how many are listed at most; 10 by default")
    add("--format", help="of OUT; by default what its name says")
    add_output(command, None, "the calibration of the first")


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
    rigs = command.add_argument_group("several cameras, instead of IMAGE")
    rigs.add_argument("--left", nargs="+", metavar="IMAGE", help="of the left camera of a pair")
    rigs.add_argument("--right", nargs="+", metavar="IMAGE", help="of the right one")
    rigs.add_argument("--rig", nargs="+", metavar="NAME=IMAGE", help="of any number of cameras: a folder or a pattern")
    rigs.add_argument(
        "--match",
        choices=("name", "order"),
        help="what says which images were taken together; by default names where they agree, else the order",
    )
    add_board(command, "if left out, distances are in squares")
    lens = command.add_argument_group("camera")
    lens.add_argument("--model", metavar="KEY", help="kannala_brandt, brown_conrady ...; by default the one that fits")
    lens.add_argument("--count", type=int, metavar="N", help="of coefficients, where the model leaves a choice")
    lens.add_argument("--fixed", metavar="NAMES", help="held parameters, as cx,cy (in the middle) or k3 (at 0)")
    lens.add_argument("--loss", choices=("huber", "cauchy"), help="for corners of which some are wrong")
    lens.add_argument("--loss-scale", type=float, default=1.0, metavar="PX", help="of that loss; 1 by default")
    lens.add_argument("--bend", action="store_true", help="the board is not quite flat: find its bend as well")
    add("--corners", type=parse_path, metavar="FILE", help="a .json to keep corners in, and to take them from")
    add("--report", type=parse_path, metavar="FILE", help="an .html to look at: how far the result can be trusted")
    add("--format", help="of OUT; by default what its name says, OpenCV's for .yml")
    add_output(command, "camera.json", "the calibration")


def _board(commands: Commands) -> None:
    command = commands.add_parser(
        "board",
        help="draw a board to print, for camtorch calibrate",
        description="Draw a board to print, to scale: camtorch board --board 9x6 --square 25mm -o board.pdf. "
        "Print it at 100 % (no fit to page), on something flat.",
    )
    add_board(command, "by default as many whole millimetres as fit on the paper")
    command.add_argument(
        "--paper",
        type=parse_paper,
        default="a4",
        metavar="NAME",
        help=f"{', '.join(PAPERS)}, WIDTHxHEIGHT as in 400x300mm, or board: as large as needed; a4 by default",
    )
    add_output(command, "board.pdf", "the drawing, a .pdf or .svg")
