"""A random rolling shutter in front of the camera of a sample."""

from typing import ClassVar, Unpack

import torch

from camtorch.augment.augmentation import Augmentation, AugmentationOptions
from camtorch.augment.part import Part
from camtorch.augment.ranges import Draw, RangeLike, as_range, as_tensors, values_for
from camtorch.cameras.camera import Camera
from camtorch.values.arguments import one_of
from camtorch.warp.shutter import DIRECTIONS, Direction, RollingShutter, ShutterWarp


class RandomShutter(Augmentation):
    """A random rolling shutter while the camera turns: images, and labels by the row that sees them.

    The camera stays. Points in space, gaze and poses are those of the middle of the readout. In a `Compose` it goes
    last, after mount and lens, and images are sampled once. For blur use kornia's `RandomMotionBlur`, for example.

    Args:
        readout: seconds from the first row to the last: a number, or (low, high). Below 0 it reads the other way.
        rates: degrees per second about x (up), y (right) and z (clockwise), each drawn separately: (low, high), or x
            for (-x, x).
        direction: the direction in which the sensor is read; see `RollingShutter`.
        options: camera, p, same_on_batch, fields, mode, padding_mode, fill, antialias, tolerance, mask_fill and
            valid_mask; see `Augmentation`.

    Raises:
        ValueError: If a range is in the wrong order or out of bounds, or the direction is unknown.
        TypeError: If a range is not numeric, or a keyword is unknown.
    """

    keeps_lens: ClassVar[bool] = True

    def __init__(
        self,
        readout: RangeLike,
        rates: RangeLike,
        *,
        direction: Direction = "down",
        **options: Unpack[AugmentationOptions],
    ):
        name = type(self).__name__
        readout = (readout, readout) if isinstance(readout, (int, float)) else readout
        ranges = {
            "rates": as_range(rates, "rates", name, least=-3600, most=3600, size=3, degrees="degrees per second"),
            "readout": as_range(readout, "readout", name, least=-1, most=1),
        }
        super().__init__(ranges, min_filled=0, **options)  # only the rim may be empty
        self.direction: Direction = one_of(direction, DIRECTIONS, "direction", name)

    def _part(self, source: Camera, draw: Draw) -> Part:
        values = as_tensors(source, values_for(source, draw))
        shutter = RollingShutter(values["readout"], torch.deg2rad(values["rates"]), direction=self.direction)
        return Part(source, ShutterWarp(source, source, target_shutter=shutter, **self.options))
