"""The command `camtorch rectify`: a pair of photographs whose rows correspond, and what is far from what is near."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from camtorch._drawing import BOX, GAZE, POINT
from camtorch.cli import images, targets
from camtorch.cli.cameras import read_pair
from camtorch.cli.commands import FAR, NEAR
from camtorch.cli.terminal import note
from camtorch.extrinsics import Extrinsics
from camtorch.io.formats import save
from camtorch.io.writing import replacing
from camtorch.rig import Rig
from camtorch.stereo.matching import match, opencv
from camtorch.stereo.point_cloud import write_ply
from camtorch.stereo.rectification import Rectification, rectify

_FRACTIONS, _UNKNOWN = 256, 0
"""Of a pixel in a PNG of disparities, as in KITTI's, and what stands where none is known."""
_DEEPEST = 65535
_LINES = 24  # over the longer side of the image of a pair


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    folder: Path = arguments.output
    matches = arguments.disparity is not None or arguments.points is not None
    if arguments.depth is not None:
        near, far = arguments.depth
        if not 0 < near < far:
            raise ValueError(f"--depth takes NEAR and FAR, 0 < NEAR < FAR; got {near:g} {far:g}")
        if not matches:
            raise ValueError("--depth is for --disparity and --points")
    _check_targets(arguments)
    if matches:
        opencv()
    taken = (arguments.left, arguments.right)
    (left, turned_left), (right, turned_right) = map(images.read, taken)
    if len(left) != len(right) or left.dtype != right.dtype:
        raise ValueError(f"{taken[0]} and {taken[1]} are images of different kinds: convert one")
    if any(turned not in (None, 1) for turned in (turned_left, turned_right)):
        note("by their Exif tags images are to be shown turned; they are taken as stored, as calibrations know them")
    sizes = [(image.shape[-2], image.shape[-1]) for image in (left, right)]
    rig = read_pair(taken, (sizes[0], sizes[1]), arguments)
    first, second = rig
    with torch.no_grad():
        rectification = rectify(
            rig[first],
            rig[second],
            rig.between(first, second),
            projection=arguments.projection,
            fov=arguments.fov,
            image_size=arguments.size,
            vertical=arguments.vertical,
            align=arguments.align,
        )
        limits = _limits(rectification, arguments) if matches else (0.0, 0.0)
        left, right = rectification.left(left[None])[0], rectification.right(right[None])[0]
        parts = [100 * int(mask.sum()) / mask.numel() for mask in rectification.valid_masks()]
        for name, image in (("left", left), ("right", right)):
            images.write(folder / f"{name}.png", images.from_tensor(image))
        images.write(folder / "pair.png", _side_by_side(left, right, arguments.vertical))
        _write_cameras(folder, rig, rectification)
        _tell(rectification, rig, folder, parts)
        if matches:
            _match(rectification, (left, right), limits, arguments)


def _check_targets(arguments: argparse.Namespace) -> None:
    """Refuse before the work what could not be written after it; fill in where disparities go."""
    folder: Path = arguments.output
    if arguments.disparity == Path():
        arguments.disparity = folder / "disparity.png"
    names = ["left.png", "right.png", "pair.png", "rectified.json"]
    names += ["opencv.yml"] if arguments.projection == "perspective" else []
    names += ["disparity_colours.png"] if arguments.disparity is not None else []
    files = [folder / name for name in names]
    for path, suffixes in ((arguments.disparity, (".png", ".npy")), (arguments.points, (".ply",))):
        if path is not None:
            if path.suffix.lower() not in suffixes:
                raise ValueError(f"{path}: must be called {' or '.join(suffixes)}")
            files.append(path)
    if len({path.absolute() for path in files}) < len(files):
        raise ValueError(f"{arguments.disparity}: is the name of another result")
    for path in files:
        check = images.check_target if path.suffix == ".png" else targets.check
        check(path, force=arguments.force, inputs=(arguments.left, arguments.right, arguments.camera))


def _limits(rectification: Rectification, arguments: argparse.Namespace) -> tuple[float, float]:
    """The disparities to look for.

    Raises:
        ValueError: some that the file of disparities does not hold.
    """
    near, far = arguments.depth or (NEAR * abs(float(rectification.baseline)), math.inf)
    least, most = rectification.disparity_range(near, far)
    path = arguments.disparity
    if path is not None and path.suffix.lower() == ".png":
        advice = "; name an .npy, which holds them"
        if float(rectification.baseline) < 0:
            raise ValueError(f"{path}: the right camera stands on the left, so disparities are negative{advice}")
        if most >= _DEEPEST // _FRACTIONS:
            raise ValueError(
                f"{path}: disparities go to {most:.0f} px, a .png to {_DEEPEST // _FRACTIONS}{advice}; or look for "
                f"less near things, by --depth, or make the images smaller, by --size"
            )
    return round(least, 6) + 0.0, most  # infinity is a rounding error off zero


def _write_cameras(folder: Path, rig: Rig, rectification: Rectification) -> None:
    """Of the rectified images: where they are in the rig, and what OpenCV's users take."""
    cameras, poses = {}, {}
    for name, side in zip(rig, ("left", "right"), strict=True):
        cameras[name] = getattr(rectification, f"camera_{side}")
        turn = Extrinsics.from_matrix(getattr(rectification, f"rotation_{side}"), [0.0] * 3)
        poses[name] = turn.compose(rig.extrinsics[name])
    save(Rig(cameras, poses), folder / "rectified.json")
    if rectification.projection == "perspective":
        rectification.save(folder / "opencv.yml")


def _tell(rectification: Rectification, rig: Rig, folder: Path, parts: list[float]) -> None:
    camera = rectification.camera_left
    fx, fy, cx, cy = camera.intrinsics.tolist()
    (across, down), (left, right, both) = camera.fov[:2].tolist(), parts
    print(
        f"{folder}: {' and '.join(rig[name].key for name in rig)} rectified to {rectification.projection}, "
        f"{across:.1f} x {down:.1f} degrees, {camera.width}x{camera.height}, fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} "
        f"cy {cy:.6g}; {'columns' if rectification.vertical else 'rows'} correspond, baseline "
        f"{float(rectification.baseline):.6g}; {left:.0f} % of left.png and {right:.0f} % of right.png are filled, "
        f"{both:.0f} % of both"
    )


def _match(
    rectification: Rectification,
    pair: tuple[Tensor, Tensor],
    limits: tuple[float, float],
    arguments: argparse.Namespace,
) -> None:
    """Disparities and points of a rectified pair, as files."""
    disparity, known = match(rectification, *pair, *limits)
    path: Path | None = arguments.disparity
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix.lower() == ".npy":
            with replacing(path) as (file,):
                np.save(file, disparity.numpy())
        else:
            parts = (disparity.nan_to_num(_UNKNOWN) * _FRACTIONS).round().clamp(0, _DEEPEST)
            images.write(path, Image.fromarray(parts.numpy().astype(np.uint16)))
        coloured = arguments.output / "disparity_colours.png"
        images.write(coloured, _coloured(disparity, known))
        part = 100 * float(known.double().mean())
        print(
            f"{path}: disparities from {limits[0]:.1f} to {limits[1]:.1f} px, known in {part:.0f} % of left.png; "
            f"{coloured}: in colour"
        )
    if arguments.points is not None:
        baseline = abs(float(rectification.baseline))
        near, far = arguments.depth or (NEAR * baseline, FAR * baseline)
        points, valid = rectification.disparity_to_points(disparity, known)
        depth = points[..., 2] if rectification.projection == "perspective" else rectification.distance(points)
        valid = valid & (depth >= near) & (depth <= far)
        write_ply(
            arguments.points,
            points[valid] @ rectification.rotation_left.to(points.dtype),
            images.in_colour(pair[0]).permute(1, 2, 0)[valid],
        )
        print(f"{arguments.points}: {int(valid.sum())} points at depths of {near:.4g} to {far:.4g}")


def _side_by_side(left: Tensor, right: Tensor, vertical: bool) -> Image.Image:
    """Both images beside each other, or one above the other, with lines along what corresponds."""
    whole = torch.cat((images.in_colour(left), images.in_colour(right)), 1 if vertical else 2)
    image = images.from_tensor(whole)
    draw = ImageDraw.Draw(image)
    width, height = image.size
    side = width if vertical else height
    step = max(side / _LINES, 4.0)
    for i in range(int(side / step)):
        at = round((i + 0.5) * step)
        ends = (at, 0, at, height) if vertical else (0, at, width, at)
        draw.line(ends, fill=(POINT, BOX, GAZE)[i % 3], width=max(1, round(side / 720)))
    return image


def _coloured(disparity: Tensor, known: Tensor) -> Image.Image:
    """Near things red, far ones blue, unknown ones black."""
    cv2 = opencv()
    found = disparity[known].abs().numpy()
    low, high = np.quantile(found, (0.01, 0.99)) if len(found) else (0.0, 1.0)
    scaled = (disparity.abs().nan_to_num(0.0).numpy() - low) / max(high - low, 1e-6)
    levels = np.rint(255 * scaled.clip(0, 1)).astype(np.uint8)
    colours = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1]
    return Image.fromarray(np.where(known.numpy()[..., None], colours, 0).astype(np.uint8))
