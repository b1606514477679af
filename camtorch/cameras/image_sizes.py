"""Warnings of image sizes that do not fit a camera's numbers: its principal point is far from the image's middle."""

from torch import Tensor

from camtorch.evaluate.tensors import is_kept, is_predicted, row_of, values_of
from camtorch.values.arguments import warn

Rows = list[list[float]]  # fx, fy, cx, cy of each camera

CAMERAS_LOOKED_AT = 64  # of a batch: a wrong order is in all of them
LEAST_SIDE = 32  # px, of an image
CENTRED_SHARE, _NEAR_SHARE = 0.1, 0.05
"""Parts of the image's sides: how far from its middle most principal points lie, and how near one lies on purpose."""
_FAR_SHARE = 0.14  # both parts, to one side: the images of the calibration were larger or smaller
_SIZES = """
224x224 256x256 240x320 270x480 360x480 360x640 400x640 480x640 480x752 512x512 540x960 576x720 600x800 600x960
720x1280 768x1024 800x1280 960x1280 1024x1024 1024x1280 1080x1440 1080x1920 1200x1600 1200x1920 1440x1920 1440x2560
1536x2048 1944x2592 2160x3840 2448x3264 3000x4000 3024x4032
"""  # of cameras
_CUT_OUT = "For a part of an image use camera.crop"


def off_centre(intrinsics: Tensor, size: tuple[int, int]) -> Rows:
    """Return the rows of plain numbers (*B, 4); none if a principal point is near the middle of images of `size`."""
    if is_kept(intrinsics) or is_predicted(intrinsics):
        return []
    row = row_of(intrinsics)
    known = values_of(intrinsics) if row is None else None
    rows = [row] if row is not None else [] if known is None else known.reshape(-1, 4)[:CAMERAS_LOOKED_AT].tolist()
    return [] if any(off_middle(cx, cy, size) <= CENTRED_SHARE for _, _, cx, cy in rows) else rows


def warn_of_order(rows: Rows, size: tuple[int, int], owner: str, order: str = "(height, width)") -> None:
    """Warn of rows `off_centre` that fit in another order only: sides exchanged, or as fx, cx, fy, cy.

    order: how the sides were given.
    """
    if not rows:
        return
    given = f"fx, fy, cx, cy = {rows[0]}"
    is_file = order == "(width, height)"
    sides = size[::-1] if is_file else size
    how = "Write image_width and image_height" if is_file else "Exchange OpenCV's (width, height)"
    if all(off_middle(cx, cy, size[::-1]) <= _NEAR_SHARE for _, _, cx, cy in rows):
        warn(
            f"{owner}: image_size={sides} is taken as {order}, but the principal point of {given} is the "
            f"middle of {sides[::-1]}. {how}. {_CUT_OUT}"
        )
    elif all(
        off_middle(fy, cy, size) <= _NEAR_SHARE
        and abs(cx - fx) <= _NEAR_SHARE * fx
        and abs(fy - fx) > CENTRED_SHARE * fx
        for fx, fy, cx, cy in rows
    ):
        warn(
            f"{owner}: {given} have their principal point far from the middle of images of {size}, and seem to be "
            f"fx, cx, fy, cy. Pass both focal lengths first. {_CUT_OUT}"
        )
    elif all(20 * max(fx, fy) < min(size) and max(abs(cx - 0.5), abs(cy - 0.5)) < 0.2 for fx, fy, cx, cy in rows):
        warn(
            f"{owner}: {given} seem to be parts of the image's width and height. Multiply fx and cx by the width, "
            "fy and cy by the height, and subtract 0.5 from cx and cy"
        )


def warn_of_size(rows: Rows, size: tuple[int, int], owner: str) -> None:
    """Warn of rows `off_centre` that seem to be of larger or of smaller images than those of `size`."""
    offs = [((cx + 0.5) / size[1] - 0.5, (cy + 0.5) / size[0] - 0.5) for _, _, cx, cy in rows]
    if not rows or not (all(min(off) > _FAR_SHARE for off in offs) or all(max(off) < -_FAR_SHARE for off in offs)):
        return
    cx, cy = rows[0][2:]
    known = [(int(a), int(b)) for a, b in (text.split("x") for text in _SIZES.split())]
    its = min(known + [size[::-1] for size in known], key=lambda size: off_middle(cx, cy, size))
    its = its if off_middle(cx, cy, its) < _NEAR_SHARE / 2 else (16 * round(cy / 8), 16 * round(cx / 8))
    if min(its) >= LEAST_SIDE:
        warn(
            f"{owner}: fx, fy, cx, cy = {rows[0]} have their principal point far from the middle of images of {size}, "
            f"and seem to be of images of about (height, width) = {its}. Pass image_size={its}, then scale that camera "
            f"by .resize{size}. {_CUT_OUT}"
        )


def warn_of_exchange(old: tuple[int, int], new: tuple[int, int], owner: str, how: str = "stretched") -> None:
    """Warn of a new size that has the shape of the old one on its side, as (width, height) would."""
    turned = new[0] * old[0] / (new[1] * old[1])
    if old[0] != old[1] and abs(turned - 1) < CENTRED_SHARE / 10:
        warn(
            f"{owner}: an image of (height, width) = {old} is {how} to {new}; it would keep its shape as "
            f"{new[::-1]}. For the image on its side use camera.rot90"
        )


def off_middle(cx: float, cy: float, size: tuple[int, int]) -> float:
    """Return the distance of a point from the middle of an image, the larger of the parts of its height and width."""
    height, width = size
    return max(abs(cx - (width - 1) / 2) / width, abs(cy - (height - 1) / 2) / height)
