"""Augmentations as a transform of torchvision.transforms.v2: tv_tensors move by their type, others by their name.

    transform = camtorch.augment.torchvision.Transform(camtorch.augment.RandomMount(yaw=20), camera)
    image, target = transform(image, target)

The module is imported by name: `import camtorch.augment.torchvision`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.augmentation import Augmentation
from camtorch.augment.cameras import camera_of_sample, known_camera
from camtorch.augment.change import Change
from camtorch.augment.fields import IMAGES, KEEP, KINDS, PLACE
from camtorch.augment.front_end import FrontEnd, check_front_end
from camtorch.augment.matrices import Guess
from camtorch.augment.names import kind_of, refuse_unknown
from camtorch.augment.reading import as_tensor
from camtorch.augment.sample import Frames, Sample, detached, on_samples
from camtorch.cameras.camera import Camera
from camtorch.evaluate.door import pytree
from camtorch.warp.arrays import as_planes_of

try:
    import PIL.Image
    from torchvision import tv_tensors
    from torchvision.transforms import v2
except Exception as error:  # a binary that does not match fails with a RuntimeError
    raise ImportError(
        "camtorch.augment.torchvision: torchvision must be installed, and be built for torch "
        f"{torch.__version__}; got {type(error).__name__}: {error}"
    ) from error

_OWNER = "torchvision.Transform"
_BY_TYPE = {
    tv_tensors.Image: "image",
    tv_tensors.Video: "image",
    tv_tensors.Mask: "mask",
    tv_tensors.BoundingBoxes: "boxes",
    tv_tensors.KeyPoints: "keypoints",
}
_HELD = Tensor, np.ndarray


class Transform(FrontEnd, v2.Transform):
    """An augmentation as a transform of v2: one draw for everything in a sample, a dict or any other nest.

    Values move by their type:

    * `Image`, `Video` (..., C, H, W) and PIL images; all frames of a clip share the draw. `Mask` (..., H, W) takes the
      nearest value, and so do PIL images whose names have the kind mask, as in `mask_iris`.
    * `KeyPoints` (..., 2), in pixels whose centres are whole numbers. A point without a place on the new image becomes
      (-1, -1), also in all later transforms of camtorch.
    * `BoundingBoxes` of a format without rotation, in torchvision's coordinates between pixel edges. The new boxes
      enclose the old ones, and are not clamped. A box without a place becomes (-1, -1, -1, -1) in XYXY.
    * `Camera`, the camera of the images, becomes that of the new image. Edits, and `Compose` of edits, need none.

    Plain tensors and arrays move by the name of their key, as in `Augmentation`: "gaze", "depth" and so on. An array of
    an image is (H, W, C) or (H, W). Labels of a clip may have its leading dims. Numbers under an unknown name that
    might be geometry raise an error; `fields={"lidar": "points", "logits": "keep"}` of the augmentation gives their
    kinds. The name of a tuple's element is its index: `fields={"[1]": "keep"}`. As in v2, the first plain tensor is the
    image if the sample has no other image and its name means nothing else. `valid=True` adds a flag for each point or
    box of a dict: `target["keypoints_valid"]`, a bool tensor, for `target["keypoints"]`: on the new image, and valid
    before. Flags that a sample already has are always updated. Count, order, formats and dtypes stay; canvas_size is
    the new camera's. Gradients reach the inputs, not the cameras. A dict gets the `crop_place` of `BoxCrop(place=True)`
    with the `rotation` and the `camera` from which it follows.

    Flips, crops and sizes of torchvision, before or after this transform, move keypoints and boxes, and leave `gaze`,
    `head_pose` and `camera`. In their place take camtorch's own, in one transform:
    `Transform(ct.augment.Compose([ct.augment.HorizontalFlip(landmarks="ibug68"), augmentation]), camera)`.

    Args:
        augmentation: the augmentation to apply.
        camera: for samples that hold none; default: the augmentation's. It is copied, and does not learn. A number is
            for photographs of unknown cameras, see `Augmentation`; a sample that is a dict then gets `camera`, that of
            the new image, for further transforms of camtorch.
        valid: whether points and boxes in dicts get flags.

    Raises:
        TypeError: If `augmentation` is no Augmentation, a call gets no sample, or labels are lists of plain numbers.
        ValueError: If there is no camera, or one with batch dims; if images, boxes or points are not of the camera's
            image_size; if numbers under an unknown name might be geometry; if a PIL image holds no colours.
    """

    camera: Camera | float | None
    valid: bool
    _name = _OWNER

    def __init__(self, augmentation: Augmentation, camera: Camera | float | None = None, *, valid: bool = False):
        super().__init__()
        check_front_end(_OWNER, augmentation)
        self.augmentation, self.camera, self.valid = augmentation, camera, bool(valid)

    @on_samples
    def forward(self, *inputs: Any) -> Any:
        if not inputs:
            raise TypeError(
                f"{_OWNER}: a sample must be given, as in transform(image, target) or transform({{'image': image}}); "
                "got nothing"
            )
        sample, kinds, write = self._read(inputs if len(inputs) > 1 else inputs[0])
        return write(*self.augmentation._augmented(sample, kinds))

    def _read(self, given: Any) -> tuple[Frames, dict[str, str], Callable[[Sample, Change], Any]]:
        """Return the leaves of a nest that may move as a sample, their kinds, and the function that writes moved ones.

        That function takes the moved sample and the change, and returns a nest like the given one.
        """
        nest = _Nest(given)
        keys, leaves, augmentation = nest.keys, nest.leaves, self.augmentation
        fields = {i: _read_leaf(nest.names[i], leaves[i], kind) for i, kind in self._kinds(nest).items()}
        cameras = [i for i, leaf in enumerate(leaves) if isinstance(leaf, Camera)]
        for name, count in (("camera", len(cameras)), (PLACE, nest.names.count(PLACE))):
            if count > 1:
                raise ValueError(f"{_OWNER}: a sample must have one {name}; got {count}")
        known = known_camera(leaves[cameras[0]] if cameras else self.camera, augmentation.camera)
        # a graph of the camera would make the warp slower, and could not leave a DataLoader's worker
        camera = detached(self._camera_of(nest, fields, known))
        sample = Frames({keys[i]: field.value for i, field in fields.items()}, camera=camera)
        kinds = {keys[i]: field.kind for i, field in fields.items()}
        is_guessed = isinstance(known, Guess) and "K" not in kinds.values()
        added = [name for name in (PLACE, "rotation") if augmentation.place and name not in sample]
        if is_guessed or (augmentation.place and not cameras):
            added.append("camera")

        def write(moved: Sample, change: Change) -> Any:
            part = change.parts[0]
            for i, field in fields.items():  # where nothing moves, PIL images and tv_tensors stay as they are
                if part.motion is not None or field.kind == KEEP or type(leaves[i]) in _HELD:
                    leaves[i] = field.write(moved[keys[i]], part.image_size)
            for i in cameras:
                leaves[i] = moved["camera"]
            result = pytree.tree_unflatten(leaves, nest.spec)
            if isinstance(result, dict):
                result |= {name: moved[name] for name in added}
            if self.valid:
                for i in fields:
                    nest.put_flags(i, moved.get(f"{keys[i]}_valid"), result)
            return result

        return sample, kinds, write

    def _camera_of(self, nest: _Nest, fields: Mapping[int, _Leaf], known: object) -> Camera:
        """Return the camera of a sample's images; known: what `known_camera` returns."""
        sizes = []
        for i, field in fields.items():
            size = field.value.shape[-2:] if field.kind in IMAGES else getattr(nest.leaves[i], "canvas_size", None)
            if size is not None:
                sizes.append((type(nest.leaves[i]).__name__, tuple(size)))
        matrix = next(((nest.keys[i], field.value) for i, field in fields.items() if field.kind == "K"), None)
        return camera_of_sample(_OWNER, known, self.augmentation.needs_camera, sizes, matrix)

    def _kinds(self, nest: _Nest) -> dict[int, str]:
        """Return the kind of each leaf that moves, and `KEEP` for those that may be flags or orders of landmarks."""
        fields, kinds = self.augmentation.fields, dict[int, str | None]()
        for i, (name, leaf) in enumerate(zip(nest.names, nest.leaves, strict=True)):
            if not (leaf is None or isinstance(leaf, Camera) or name == "camera"):
                kinds[i] = _kind(name, leaf, nest.paths[i], fields)
        unknown = [i for i, kind in kinds.items() if kind is None]
        if "image" not in kinds.values():
            first = next((i for i in unknown if isinstance(nest.leaves[i], Tensor) and nest.leaves[i].ndim > 1), None)
            if first is not None:
                kinds[first] = "image"
                unknown.remove(first)
        single = all(getattr(leaf, "ndim", 0) < 4 for leaf in nest.leaves)  # images of batches have as many dims
        for i in unknown:
            leaf = _in_lists(nest.leaves[i], nest.paths[i])
            refuse_unknown({nest.names[i]: leaf}, fields, _OWNER, single=single)
        return {i: kind or KEEP for i, kind in kinds.items() if kind in KINDS or isinstance(nest.leaves[i], _HELD)}


class _Nest:
    """The leaves of a sample, a nest of dicts, lists and tuples, in one order."""

    def __init__(self, given: Any):
        flat, self.spec = pytree.tree_flatten_with_path(given)
        self.paths = [path for path, _ in flat]
        self.leaves = [leaf for _, leaf in flat]
        self.names = [_name(path) for path in self.paths]
        self.keys = _keys(self.paths, self.names)  # the names, made distinct

    def put_flags(self, i: int, valid: Tensor | None, nest: Any) -> None:
        """Put the flags of leaf `i` beside it into a nest, if a dict holds it and has none."""
        path = self.paths[i]
        if valid is not None and path and isinstance(path[-1], pytree.MappingKey):
            holder = nest
            for step in path[:-1]:
                holder = step.get(holder)
            flags = valid if isinstance(self.leaves[i], Tensor) else valid.numpy()
            holder.setdefault(f"{self.names[i]}_valid", flags)


def _name(path: Any) -> str:
    """Return the last key of a path that is a word, or the whole path."""
    words = [getattr(step, "key", getattr(step, "name", None)) for step in path]
    return next((word for word in reversed(words) if isinstance(word, str)), pytree.keystr(path) or "[0]")


def _keys(paths: list[Any], names: list[str]) -> list[str]:
    """Return the names of leaves, with the path of what holds them in front if some are there twice."""
    if len(set(names)) == len(names):
        return names
    whole = [name for name in (PLACE, "rotation") if names.count(name) == 1]  # of the whole sample
    holders = [pytree.keystr(path[:-1] if path and isinstance(path[-1], pytree.MappingKey) else path) for path in paths]
    return [name if name in whole else f"{holder}/{name}" for holder, name in zip(holders, names, strict=True)]


def _kind(name: str, leaf: Any, path: Any, fields: Mapping[str, str]) -> str | None:
    """Return the kind of a leaf by its type, else by its name; see `kind_of`."""
    if isinstance(leaf, PIL.Image.Image):
        return "mask" if kind_of(name, [leaf], fields, _OWNER) == "mask" else "image"
    by_type = next((kind for of, kind in _BY_TYPE.items() if isinstance(leaf, of)), None)
    return by_type or kind_of(name, _in_lists(leaf, path), fields, _OWNER)


def _in_lists(leaf: Any, path: Any) -> Any:
    """Return a leaf without dims in the lists that hold it: a list of plain numbers is one value."""
    if getattr(leaf, "ndim", 0):
        return leaf
    for step in reversed(path[1:]):
        if not isinstance(step, pytree.SequenceKey):
            break
        leaf = [leaf]
    return leaf


class _Leaf(NamedTuple):
    """A leaf of a nest that may move."""

    kind: str  # KEEP: it may be a flag or an order of landmarks
    value: Any  # as the augmentation takes it
    write: Callable[[Any, tuple[int, int]], Any]  # (moved value, size of the new image) -> leaf like the given one


def _read_leaf(name: str, leaf: Any, kind: str) -> _Leaf:
    """Read an image of PIL or numpy, another array, a flag or an order, a tensor, points, or boxes, in this order."""
    if not isinstance(leaf, Tensor) and kind in IMAGES:
        planes, restored = as_planes_of(leaf, name, _OWNER)
        return _Leaf(kind, planes, lambda moved, size: restored(moved))
    if not isinstance(leaf, Tensor):
        value = leaf if kind == KEEP else as_tensor(leaf, name, kind, _OWNER)
        return _Leaf(kind, value, lambda moved, size: np.asarray(moved))
    if kind == KEEP:
        return _Leaf(kind, leaf, lambda moved, size: moved)
    lacking = KINDS[kind].dims - leaf.ndim  # of a single point, box or plane
    rows: Tensor = leaf.as_subclass(Tensor)[(None,) * lacking]
    if not isinstance(leaf, (tv_tensors.KeyPoints, tv_tensors.BoundingBoxes)):

        def write(moved: Tensor, size: tuple[int, int]) -> Any:
            plain = moved[(0,) * lacking]
            is_plain = not isinstance(leaf, tv_tensors.TVTensor)
            return plain if is_plain else tv_tensors.wrap(plain.to(leaf.dtype), like=leaf)

        return _Leaf(kind, rows, write)
    numbers = rows if rows.dtype == torch.float64 else rows.float()
    pixels, numbers_of = _read_points(numbers) if kind == "keypoints" else _read_boxes(numbers, leaf, name)

    def write_on_canvas(moved: Tensor, size: tuple[int, int]) -> Any:
        numbers = numbers_of(moved)[(0,) * lacking]
        numbers = numbers if leaf.is_floating_point() else numbers.round()
        return tv_tensors.wrap(numbers.to(leaf.dtype), like=leaf, canvas_size=size)

    return _Leaf(kind, pixels, write_on_canvas)


def _read_points(numbers: Tensor, centre: float = 0.0) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Return pixels of points, or of boxes' corners, and the function that makes such numbers of moved ones.

    Rows of -1 have no place: they are NaN. centre: that of the first pixel, in such numbers.
    """

    def numbers_of(moved: Tensor) -> Tensor:
        lost = ((moved == -1) | moved.isnan()).all(-1, keepdim=True)
        return torch.where(lost, -1.0, moved + centre)

    return torch.where((numbers == -1).all(-1, keepdim=True), torch.nan, numbers - centre), numbers_of


def _read_boxes(numbers: Tensor, leaf: Any, name: str) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Return pixels x1, y1, x2, y2 of numbers of a leaf's format, and the function that makes such numbers of them."""
    form, corners_form = leaf.format, tv_tensors.BoundingBoxFormat.XYXY
    is_whole, convert = not leaf.is_floating_point(), v2.functional.convert_bounding_box_format
    if numbers.shape[-1] > 4:
        raise ValueError(
            f"{_OWNER}: {name} must be boxes without rotation; got BoundingBoxes of the format {form.value}. To move "
            "them, pass their corners as keypoints"
        )
    corners = convert(numbers, form, corners_form)
    pixels, corners_of = _read_points(corners.trunc() if is_whole else corners, 0.5)  # as torchvision reads whole ones

    def numbers_of(moved: Tensor) -> Tensor:
        new = corners_of(moved)
        if is_whole:  # rounding errors are no reason for another pixel
            low, high = (new[..., :2] + 1e-3).floor(), (new[..., 2:] - 1e-3).ceil()
            new = torch.cat((low, high + (high - low) % 2 if form.value == "CXCYWH" else high), -1)
        converted: Tensor = convert(new, corners_form, form)
        return converted

    return pixels, numbers_of
