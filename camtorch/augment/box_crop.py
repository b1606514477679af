"""Crops that look at a box of each sample, such as a face, without perspective error; labels and camera follow."""

from collections.abc import Mapping, Sequence
from typing import Unpack

import torch
from torch import Tensor

from camtorch.augment.augmentation import Augmentation, AugmentationOptions
from camtorch.augment.ranges import TURN, RangeLike, as_range
from camtorch.cameras.camera import Camera
from camtorch.poses.rotations import mount_rotation
from camtorch.values.arguments import as_flag, as_known_size, as_whole
from camtorch.warp.views import as_margin, looking_at, pinhole


class BoxCrop(Augmentation):
    """An augmentation that crops a box of the sample by a pinhole camera that looks at it, as `ct.views.look_at`.

    Landmarks, other boxes, masks, depth, gaze, head pose and the camera move too, and `inverse` moves them back. A draw
    holds the boxes as `draw["box"]` (B, 4), which `forward` takes from the sample's boxes; for `change`, and for the
    first of several calls of a replay, put them there. In a `Compose` the box moves with the parts before. If it left
    the image, the crop shows the middle of the image, and the labels are invalid. Gradients go to boxes that require
    grad. A sample has one crop: for all F boxes of each image, `ct.views.look_at` takes (B, F, 4).

        >>> crop = ct.augment.BoxCrop((64, 64), camera=ct.Pinhole([80.0, 80.0, 63.5, 47.5], image_size=(96, 128)))
        >>> crop(image=torch.zeros(3, 96, 128), boxes=torch.tensor([[40.0, 30.0, 70.0, 60.0]]))["image"].shape
        torch.Size([3, 64, 64])

    Args:
        image_size: (height, width) of the crop.
        margin: how far left and right move out, in widths of the box, and top and bottom, in heights.
        index: index of the box among those of a sample; -1 is the last one.
        place: whether `crop_place` (B, 5) comes out, for the network: the ray of the crop's middle in the frame of the
            first camera and the tangents of its half angles; see `ct.views.crop_place`. Later augmentations renew it,
            by the sample's `camera` and `rotation`.
        yaw, pitch, roll: ranges of degrees by which the camera turns away from the box, as in `RandomMount`.
        zoom: range of the factor on the focal length; below 1 more than box and margin is shown.
        options: see `Augmentation`.

    Raises:
        ValueError: If a sample lacks that box, or `ct.views.look_at` refuses it; the message names its place in the
            batch.
    """

    image_size: tuple[int, int]
    crops: Mapping[str, int]
    margin: float

    def __init__(
        self,
        image_size: Sequence[int],
        *,
        margin: float = 0.25,
        index: int = 0,
        place: bool = False,
        yaw: RangeLike | None = None,
        pitch: RangeLike | None = None,
        roll: RangeLike | None = None,
        zoom: RangeLike | None = None,
        **options: Unpack[AugmentationOptions],
    ):
        name = type(self).__name__
        turns = {"yaw": yaw, "pitch": pitch, "roll": roll}
        ranges = {n: as_range(v, n, name, **TURN) for n, v in turns.items() if v is not None}
        if zoom is not None:
            ranges["zoom"] = as_range(zoom, "zoom", name, around=1, least=1e-3, most=1e3)
        super().__init__(ranges, min_filled=0, **options)  # a box at the rim of the image is intended
        self.image_size, self.margin = as_known_size(image_size, name), as_margin(margin, name)
        if isinstance(index, (list, tuple)):
            raise TypeError(
                f"{name}: index must be a whole number; got {index!r}. F boxes of each sample go in flattened, as "
                "image.repeat_interleave(F, 0) and boxes.flatten(0, 1)[:, None]; ct.views.look_at takes boxes (B, F, 4)"
            )
        self.crops = {"box": as_whole(index, "index", name)}
        self.place: bool = as_flag(place, "place", name)

    def new_camera(self, source: Camera, values: Mapping[str, Tensor]) -> tuple[Camera, Tensor | None]:
        """Return the camera that looks at `values["box"]`, (*B, 4), and its rotation; see `Augmentation.new_camera`."""
        box = values["box"]
        rows = box.reshape(-1, 4)
        found = looking_at(source, rows, self.image_size, self.margin, self._name)
        intrinsics, rotation = (t[0] if box.ndim == 1 else t for t in found)
        if "zoom" in values:
            zoom = values["zoom"].double()
            one = torch.ones_like(zoom)
            intrinsics = intrinsics * torch.stack((zoom, zoom, one, one), -1)
        if {"yaw", "pitch", "roll"} & values.keys():
            nothing = torch.zeros_like(box[..., 0])
            rotation = mount_rotation(*(values.get(n, nothing).double() for n in ("yaw", "pitch", "roll"))) @ rotation
        return pinhole(intrinsics.to(box), self.image_size), rotation.to(box)

    def extra_repr(self) -> str:
        own = f"image_size={self.image_size}, margin={self.margin:g}, index={self.crops['box']}, place={self.place}"
        return f"{own}, {super().extra_repr()}"
