"""Edits of images and their labels: crops, sizes, flips and quarter turns."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Unpack

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor

from camtorch.augment.augmentation import Augmentation, AugmentationOptions, OptionsBesideP
from camtorch.augment.change import Change, by_models
from camtorch.augment.landmarks import Mirroring, TableLike
from camtorch.augment.part import Part
from camtorch.augment.ranges import Draw, Range, as_range, rows_of
from camtorch.cameras.camera import Camera
from camtorch.cameras.editing import edited, quarter_turns
from camtorch.evaluate.tensors import known_false, known_some, known_true
from camtorch.values.arguments import as_known_size, as_whole
from camtorch.warp.affine import AffineWarp, Map, Rows, after, map_as_tensor
from camtorch.warp.options import Options

Size = int | Sequence[int]


class Edit(Augmentation):
    """An edit of the image, `sample -> sample`: all labels follow, and the camera, if there is one.

    Fields are those of `Augmentation`. Pixels move by an affine map, also those without a ray; pixel edges scale. Depth
    and distance keep their values. In a mirror directions, points and poses are mirrored, and landmarks and fields
    `..._left` and `..._right` change places: `rotation` is Q of `ray_after = Q ray_before`, with determinant -1. Whole
    steps, flips and quarter turns copy pixels bit by bit. For an edit of your own, write a subclass with `edit`.

    Args:
        ranges: see `Augmentation`.
        antialias: whether a pixel is the mean of the area it covers; None: if more than one and a half pixels along a
            side come to one.
        options: camera, p, same_on_batch, fields, mode, padding_mode, fill, mask_fill, valid_mask, tolerance; see
            `Augmentation`.
    """

    def __init__(self, ranges: Mapping[str, Range] | None = None, **options: Unpack[AugmentationOptions]):
        options.setdefault("antialias", None)
        super().__init__(ranges, min_filled=0, **options)  # only pixels that the caller asks for are empty

    needs_camera = False
    drawn_on_host = True
    _chooses_antialias = True

    @abstractmethod
    def edit(self, size: tuple[int, int], values: Mapping[str, Tensor]) -> tuple[Map, tuple[int, int]]:
        """Return the map of pixels, and the new size.

        Args:
            size: (height, width) of the image.
            values: the drawn numbers, (*B,) or (*B, n) in float64, as in `Augmentation.new_camera`.

        Returns:
            (*B, 2, 3) or (2, 3) in float64, from pixels (u, v, 1) to those of the new image, along its axes, or rows of
            plain numbers, which torch.compile can read; and (height, width).
        """

    def _size_if_applied(self, size: tuple[int, int]) -> tuple[int, int]:
        nothing = {n: torch.full(() if r.size is None else (r.size,), r.low).double() for n, r in self.ranges.items()}
        return self.edit(size, nothing)[1]

    def _change(self, camera: Camera, draw: Draw) -> Change:
        return change_by([(self, draw)], camera, self.options)

    def map_of(self, draw: Draw, size: tuple[int, int]) -> tuple[Map | None, tuple[int, int]]:
        """Return the map of a draw for images of a size (None if it never applies), and the new size."""
        applied = torch.as_tensor(draw["apply"])
        if self.p == 0 and not known_some(applied):  # as `p` says, where values may not be read
            return None, size
        values = {n: torch.as_tensor(value, dtype=torch.float64) for n, value in draw.items() if n != "apply"}
        matrix, new = self.edit(size, values)
        all_are = known_true(applied) or (self.p == 1 and not known_false(applied))
        if new != size and (not all_are or 0 < self.p < 1):
            raise ValueError(
                f"{self._name}: images must keep their size {size} with p < 1, so that all results have one size; "
                f"got {new}"
            )
        if all_are:
            return matrix, new
        if known_true(~applied):
            return None, new
        matrix = map_as_tensor(matrix)
        still = matrix.new_tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        return torch.where(applied[:, None, None].to(matrix.device), matrix, still), new


def change_by(edits: Sequence[tuple[Edit, Draw]], camera: Camera, options: Options) -> Change:
    """Return the change of `camera`'s images by edits and their draws, in order; `options` are those of warps."""

    def part(rows: list[int] | None, source: Camera) -> Part:
        matrix: Map | None = None
        size = (source.height, source.width)
        for edit, draw in edits:
            one, size = edit.map_of(rows_of(draw, rows), size)
            if one is not None:
                matrix = one if matrix is None else after(one, matrix)
        if matrix is None:
            return Part(source)
        may_be_one = isinstance(matrix, Tensor) and matrix.ndim == 3 and not source.batch_shape
        if may_be_one and known_true(map_as_tensor(matrix) == map_as_tensor(matrix)[:1]):
            matrix = map_as_tensor(matrix)[0]  # one map serves the whole batch
        warp = AffineWarp(source, edited(source, matrix, size), matrix, _turn(matrix, source), **options)
        return Part(source, warp)

    return by_models(len(edits[0][1]["apply"]), camera, part)


def _turn(matrix: Map, source: Camera) -> Tensor | None:
    """Return the effect (*B, 3, 3) of an edit on rays; None if it leaves them unchanged."""
    if not isinstance(matrix, Tensor) and matrix[0][0] > 0 and matrix[1][1] > 0:
        return None
    factors, like = map_as_tensor(matrix)[..., :2], source.intrinsics
    if known_true(factors.diagonal(dim1=-2, dim2=-1) > 0):
        return None
    signs = factors.sign()  # of a mirror, or a turn about the axis
    rotation = F.pad(signs, (0, 1, 0, 1)) + signs.new_tensor([0.0, 0.0, 1.0]).diag()
    return rotation.to(like.device, torch.promote_types(like.dtype, torch.float32))


def _map(across: float, left: float, down: float, top: float) -> Rows:
    """Return the map (2, 3): (across u + left, down v + top)."""
    return (across, 0.0, float(left)), (0.0, down, float(top))


def _box_to(size: tuple[int, int], corner: Tensor, sides: Tensor) -> Tensor:
    """Return maps (*B, 2, 3) from boxes, (left, top) and (width, height) of outer edges (*B, 2), to a size."""
    scale = sides.new_tensor(size[::-1]) / sides
    shift = (0.5 - corner) * scale - 0.5
    return torch.cat((torch.diag_embed(scale), shift.unsqueeze(-1)), -1)


class RandomResizedCrop(Edit):
    """A random box of the image, resized: as in torchvision, with a draw for each sample.

    Args:
        size: (height, width) of the result, or one number for a square.
        scale: area of the box, as a part of the image's area.
        ratio: width to height of the box, drawn evenly in its logarithm. If a box of that area would be wider or higher
            than the image, it is smaller.
        options: see `Edit`.
    """

    image_size: tuple[int, int]

    def __init__(
        self,
        size: Size,
        *,
        scale: Sequence[float] = (0.08, 1.0),
        ratio: Sequence[float] = (3 / 4, 4 / 3),
        **options: Unpack[AugmentationOptions],
    ):
        name = type(self).__name__
        ratios = as_range(ratio, "ratio", name, least=1e-3, most=1e3, is_pair=True)
        ranges = {
            "scale": as_range(scale, "scale", name, least=1e-6, most=1.0, is_pair=True),
            "ratio": Range(math.log(ratios.low), math.log(ratios.high)),
            "place": Range(0, 1, 2),
        }
        super().__init__(ranges, **options)
        self.image_size = _as_size(size, self._name)

    def edit(self, size: tuple[int, int], values: Mapping[str, Tensor]) -> tuple[Map, tuple[int, int]]:
        rows, cols = size
        ratio = values["ratio"].exp()
        width = (values["scale"] * rows * cols * ratio).sqrt()
        width = torch.minimum(width.clamp(max=cols), rows * ratio)
        whole = width.new_tensor([cols, rows])
        sides = torch.minimum(torch.stack((width, width / ratio), -1).round().clamp(min=1), whole)
        return _box_to(self.image_size, (values["place"] * (whole - sides)).round(), sides), self.image_size


class RandomCrop(Edit):
    """A box of one size at a random place of the image.

    Args:
        size: (height, width), or one number for a square; no larger than the image, which `Pad` enlarges.
        options: see `Edit`.
    """

    image_size: tuple[int, int]

    def __init__(self, size: Size, **options: Unpack[AugmentationOptions]):
        super().__init__({"place": Range(0, 1, 2)}, **options)
        self.image_size = _as_size(size, self._name)

    def edit(self, size: tuple[int, int], values: Mapping[str, Tensor]) -> tuple[Map, tuple[int, int]]:
        (height, width), new = size, self.image_size
        if new[0] > height or new[1] > width:
            raise ValueError(f"{self._name}: size must be within the image's {size}; got {new}. Pad enlarges the image")
        corner = (values["place"] * values["place"].new_tensor([width - new[1], height - new[0]])).round()
        return _box_to(new, corner, corner.new_tensor(new[::-1]).expand_as(corner)), new


class CenterCrop(Edit):
    """The middle of the image, with `fill` around it if the image is smaller.

    Args:
        size: (height, width), or one number for a square.
        options: see `Edit`.
    """

    image_size: tuple[int, int]

    def __init__(self, size: Size, **options: Unpack[AugmentationOptions]):
        super().__init__(**options)
        self.image_size = _as_size(size, self._name)

    def edit(self, size: tuple[int, int], values: Mapping[str, Tensor]) -> tuple[Map, tuple[int, int]]:
        top, left = ((before - now) // 2 for before, now in zip(size, self.image_size, strict=True))
        return _map(1.0, -left, 1.0, -top), self.image_size


class Resize(Edit):
    """The image at another size.

    Args:
        size: (height, width), or one number for the shorter side, as in torchvision.
        options: see `Edit`.
    """

    shorter: int | None

    def __init__(self, size: Size, **options: Unpack[AugmentationOptions]):
        super().__init__(**options)
        alone = size[0] if isinstance(size, Sequence) and len(size) == 1 else size  # torchvision's (256,) is 256
        self.shorter = None if isinstance(alone, Sequence) else as_whole(alone, "size", self._name, least=1)
        self.image_size: tuple[int, int] | None = _as_size(size, self._name) if self.shorter is None else None

    def edit(self, size: tuple[int, int], values: Mapping[str, Tensor]) -> tuple[Map, tuple[int, int]]:
        height, width = size
        if self.image_size is None and self.shorter is not None:
            height, width = (max(int(self.shorter * side / min(size)), 1) for side in size)
        new = self.image_size or (height, width)
        across, down = new[1] / size[1], new[0] / size[0]
        return _map(across, 0.5 * across - 0.5, down, 0.5 * down - 0.5), new


class Pad(Edit):
    """The image with a rim of `fill`.

    Args:
        padding: pixels on every side; or (across, down); or (left, top, right, bottom), as in torchvision.
        size: instead of padding, (height, width) to which the image is padded, evenly on both sides.
        options: see `Edit`.
    """

    least: tuple[int, int] | None

    def __init__(
        self, padding: Size | None = None, *, size: Size | None = None, **options: Unpack[AugmentationOptions]
    ):
        super().__init__(**options)
        if (padding is None) == (size is None):
            raise TypeError(f"{self._name}: either padding or size must be given; got {padding!r} and {size!r}")
        self.least = None if size is None else _as_size(size, self._name)
        self.padding: tuple[int, ...] = ()
        if padding is not None:
            given = tuple(padding) if isinstance(padding, Sequence) else (padding,)
            sides = tuple(as_whole(side, "padding", self._name) for side in given)
            if len(sides) not in (1, 2, 4) or min(sides) < 0:
                form = "one number, (across, down) or (left, top, right, bottom), and none negative"
                raise ValueError(f"{self._name}: padding must be {form}; got {padding!r}")
            self.padding = sides * (4 // len(sides))

    def edit(self, size: tuple[int, int], values: Mapping[str, Tensor]) -> tuple[Map, tuple[int, int]]:
        if self.least is not None:
            new = max(self.least[0], size[0]), max(self.least[1], size[1])
            top, left = ((now - before) // 2 for before, now in zip(size, new, strict=True))
        else:
            left, top, right, bottom = self.padding
            new = size[0] + top + bottom, size[1] + left + right
        return _map(1.0, left, 1.0, top), new


class Rotate90(Edit):
    """The image turned by quarters, counterclockwise as by torch.rot90, with its camera, which is then on its side.

    Another lens can follow a quarter turn if its model is the same on its side; cylinders and spheres are not.

    Args:
        times: number of turns; or (least, most), each equally likely. If images are not square, samples of a batch must
            take either odd or even numbers: draw one for all, `same_on_batch=True`, or (0, 2) by `step=2`.
        step: between the numbers.
        options: see `Edit`.
    """

    times: tuple[int, int, int]

    def __init__(self, times: int | Sequence[int] = (0, 3), *, step: int = 1, **options: Unpack[AugmentationOptions]):
        name = type(self).__name__
        given = times if isinstance(times, Sequence) else (times, times)
        ends = tuple(as_whole(end, "times", name) for end in given)
        if len(ends) != 2 or not -90 < ends[0] <= ends[1] < 90:
            raise ValueError(f"{name}: times must be quarter turns, one number or (least, most); got {times!r}")
        self.times = ends[0], ends[1], as_whole(step, "step", name, least=1)
        super().__init__({"times": Range(0, 1)}, **options)

    def edit(self, size: tuple[int, int], values: Mapping[str, Tensor]) -> tuple[Map, tuple[int, int]]:
        (low, high, step), (height, width) = self.times, size
        count = (high - low) // step + 1
        turns = (low + step * (values["times"] * count).floor().clamp(max=count - 1)).long() % 4
        maps = turns.new_tensor(quarter_turns(size), dtype=torch.float64)
        on_side = turns % 2
        if height != width and on_side.ndim and known_false(on_side == on_side[:1]):
            raise ValueError(
                f"{self._name}: results of one batch must have one size; got {size} and {size[::-1]}. "
                "same_on_batch=True turns all alike, step=2 keeps the size"
            )
        turned = known_false(on_side == 0) or bool(low % 2 and not known_true(on_side == 0))
        return maps[turns], size[::-1] if turned else size


class _Flip(Edit):
    """A flip, whose args are those of `HorizontalFlip`."""

    def __init__(
        self,
        p: float = 0.5,
        *,
        landmarks: TableLike | Mapping[str, TableLike | None] | None = None,
        lateral_axis: str = "x",
        swap_sides: bool = True,
        **options: Unpack[OptionsBesideP],
    ):
        super().__init__(p=p, **options)
        self.mirroring: Mirroring | None = Mirroring(landmarks, lateral_axis, swap_sides, self._name)


class HorizontalFlip(_Flip):
    """The image mirrored left to right, and all labels as the mirror shows them.

    Gaze, directions, points and rotations of `rays` have x negated. A head pose becomes Q R M, the mirrored head: M
    mirrors the head's own axis from side to side back, so that R stays a rotation and landmark i is point i of the
    same, symmetric, model.

    Args:
        p: probability of a flip.
        landmarks: which landmarks of each face change places: one of `LANDMARKS` ("ibug68", "wflw98", "lapa106",
            "coco17", "mediapipe468", "mediapipe478"), or the index of each landmark's partner, or pairs (left, right);
            for all keypoints, landmarks and points, or a dict by field, which may also name a field that does not move,
            such as visibility. None: all keep their order.
        lateral_axis: "x", "y" or "z" of the head's own frame, from one side of the head to the other.
        swap_sides: whether fields named `..._left` and `..._right` change places.
        options: see `Edit`.
    """

    def edit(self, size: tuple[int, int], values: Mapping[str, Tensor]) -> tuple[Map, tuple[int, int]]:
        return _map(-1.0, size[1] - 1, 1.0, 0.0), size


class VerticalFlip(_Flip):
    """The image mirrored top to bottom. Left and right change places as well: a mirrored left hand is a right one.

    Args are those of `HorizontalFlip`.
    """

    def edit(self, size: tuple[int, int], values: Mapping[str, Tensor]) -> tuple[Map, tuple[int, int]]:
        return _map(1.0, 0.0, -1.0, size[0] - 1), size


def _as_size(size: Size, owner: str) -> tuple[int, int]:
    """Return (height, width); one number makes a square."""
    sides = tuple(size) if isinstance(size, Sequence) and not isinstance(size, str) else (size,)
    return as_known_size(sides * 2 if len(sides) == 1 else sides, owner, "size")
