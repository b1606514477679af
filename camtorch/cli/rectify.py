"""The command `camtorch rectify`: a pair of photographs whose rows correspond, and what is far from what is near."""

from __future__ import annotations

import argparse
import math

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

_LINES = 24  # over the longer side of the image of a pair


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    folder, taken = arguments.output, (arguments.left, arguments.right)
    names = ["left.png", "right.png", "pair.png", "rectified.json"]
    names += ["opencv.yml"] * (arguments.projection == "perspective")
    names += ["disparity.npy", "disparity.png"] * arguments.disparity + ["points.ply"] * arguments.points
    for name in names:
        targets.check(folder / name, force=arguments.force, inputs=(*taken, arguments.camera))
    if arguments.depth is not None:
        near, far = arguments.depth
        if not 0 < near < far:
            raise ValueError(f"--depth takes NEAR and FAR, 0 < NEAR < FAR; got {near:g} {far:g}")
        if not (arguments.disparity or arguments.points):
            raise ValueError("--depth is for --disparity and --points")
    if arguments.disparity or arguments.points:
        opencv()
    (left, turned_left), (right, turned_right) = map(images.read_stored, taken)
    if len(left) != len(right) or left.dtype != right.dtype:
        raise ValueError(f"{taken[0]} and {taken[1]} are images of different kinds: convert one")
    if any(turned not in (None, 1) for turned in (turned_left, turned_right)):
        note("by their Exif tags images are to be shown turned; they are taken as stored, as calibrations know them")
    rig = read_pair(taken, [(image.shape[-2], image.shape[-1]) for image in (left, right)], arguments)
    first, second = rig
    options = {"fov": arguments.fov, "image_size": arguments.size, "vertical": arguments.vertical}
    with torch.no_grad():
        rectification = rectify(
            rig[first], rig[second], rig.between(first, second), projection=arguments.projection, **options
        )
        left, right = rectification.left(left[None])[0], rectification.right(right[None])[0]
        parts = [100 * int(mask.sum()) / mask.numel() for mask in rectification.valid_masks()]
        for name, image in (("left", left), ("right", right)):
            images.write(folder / f"{name}.png", images.from_tensor(image))
        images.write(folder / "pair.png", _side_by_side(left, right, arguments.vertical))
        poses = {}
        for name, turn in ((first, rectification.rotation_left), (second, rectification.rotation_right)):
            poses[name] = Extrinsics.from_matrix(turn, [0.0] * 3).compose(rig.extrinsics[name])
        cameras = {first: rectification.camera_left, second: rectification.camera_right}
        save(Rig(cameras, poses), folder / "rectified.json")
        if rectification.projection == "perspective":
            rectification.save(folder / "opencv.yml")
        _tell(rectification, rig, arguments, parts)
        if arguments.disparity or arguments.points:
            _match(rectification, left, right, arguments)


def _tell(rectification: Rectification, rig: Rig, arguments: argparse.Namespace, parts: list[float]) -> None:
    camera = rectification.camera_left
    fx, fy, cx, cy = camera.intrinsics.tolist()
    (across, down), (left, right, both) = camera.fov[:2].tolist(), parts
    print(
        f"{arguments.output}: {' and '.join(rig[name].key for name in rig)} rectified to {rectification.projection}, "
        f"{across:.1f} x {down:.1f} degrees, {camera.width}x{camera.height}, fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} "
        f"cy {cy:.6g}; {'columns' if rectification.vertical else 'rows'} correspond, baseline "
        f"{float(rectification.baseline):.6g}; {left:.0f} % of left.png and {right:.0f} % of right.png are filled, "
        f"{both:.0f} % of both"
    )


def _match(rectification: Rectification, left: Tensor, right: Tensor, arguments: argparse.Namespace) -> None:
    """Disparities and points of a rectified pair, as files."""
    folder, baseline = arguments.output, abs(float(rectification.baseline))
    side = max(left.shape)  # more than that is seen by one camera only
    limits = rectification.disparity_range(*(arguments.depth or (NEAR * baseline, math.inf)))
    low, high = (min(max(limit, -side), side) for limit in limits)
    disparity, known = match(rectification, left, right, low, high)
    if arguments.disparity:
        with replacing(folder / "disparity.npy") as (file,):
            np.save(file, disparity.numpy())
        images.write(folder / "disparity.png", _coloured(disparity, known))
        print(
            f"{folder}/disparity.npy: disparities from {low + 0.0:.1f} to {high:.1f} px, known in "
            f"{100 * float(known.double().mean()):.0f} % of left.png; disparity.png: in colour"
        )
    if arguments.points:
        near, far = arguments.depth or (NEAR * baseline, FAR * baseline)
        points, valid = rectification.disparity_to_points(disparity, known)
        depth = points[..., 2] if rectification.projection == "perspective" else rectification.distance(points)
        valid = valid & (depth >= near) & (depth <= far)
        turned = points[valid] @ rectification.rotation_left.to(points.dtype)
        write_ply(folder / "points.ply", turned, images.in_colour(left).permute(1, 2, 0)[valid])
        print(f"{folder}/points.ply: {int(valid.sum())} points at depths of {near:.4g} to {far:.4g}")


def _side_by_side(left: Tensor, right: Tensor, vertical: bool) -> Image.Image:
    """Both images beside each other, or one above the other, with lines along what corresponds."""
    image = images.from_tensor(torch.cat((images.in_colour(left), images.in_colour(right)), 1 if vertical else 2))
    draw, (width, height) = ImageDraw.Draw(image), image.size
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
