"""Augmentations as a transform of torchvision.transforms.v2, for samples of tv_tensors.

    transform = camtorch.augment.torchvision.Transform(camtorch.augment.RandomMount(yaw=20), camera)
    image, target = transform(image, target)

The module is imported by name: `import camtorch.augment.torchvision`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from camtorch.augment.augmentation import Augmentation, camera_of_sample, check_front_end, move_points
from camtorch.augment.change import Change
from camtorch.augment.numpy import as_array, as_tensor
from camtorch.augment.sample import KINDS, together
from camtorch.camera import Camera

try:
    import PIL.Image
    from torchvision import tv_tensors
    from torchvision.transforms import v2
except Exception as error:  # a binary that does not match fails with a RuntimeError
    raise ImportError(
        "camtorch.augment.torchvision needs a torchvision that was built for the installed torch "
        f"{torch.__version__}; importing it failed with {type(error).__name__}: {error}"
    ) from error

_OWNER = "torchvision.Transform"
_NO_COLOURS = "1", "P", "PA"  # modes of PIL
# since torchvision 0.23
_PLACES: Any = (tv_tensors.BoundingBoxes, *([tv_tensors.KeyPoints] if hasattr(tv_tensors, "KeyPoints") else []))


class Transform(v2.Transform):
    """A transform of v2: one draw for all that a sample holds, a dict or any other nest.

    * `Image` (..., C, H, W), `Video` (..., T, C, H, W), PIL images, and by v2's rule the first plain tensor
      of a sample without any of these.
    * `Mask` (..., H, W), by the nearest value.
    * `KeyPoints` (..., 2), for torchvision as for camtorch in pixels whose centres are whole numbers. One that has no
      place on the new camera becomes (-1, -1), and stays that in whatever transforms of camtorch follow.
    * `BoundingBoxes` of every format without rotation, whose coordinates are torchvision's, between pixel edges. The
      new ones enclose all of what the old ones did, with whole numbers too, and are not clamped:
      `v2.ClampBoundingBoxes` and `v2.SanitizeBoundingBoxes` follow where wanted. One that has no place on the new
      camera becomes (-1, -1, -1, -1) in XYXY, which has no area.
    * A `Camera` in the sample is the sample's camera, and comes out as that of the new image. Edits, and `Compose` of
      them alone, need none.

    `valid=True` gives all `KeyPoints` and `BoundingBoxes` that are values of dicts a flag for each point or box beside
    them: `target["keypoints_valid"]`, a plain bool tensor, for `target["keypoints"]`. It says that the point, or a part
    of the box, lies on the new image, and was valid before if the dict said so. Order and count stay, so a DataLoader
    collates them as it does the points.

    Formats and dtypes stay; canvas_size becomes that of the new camera. All else stays as it is, also
    3D labels in plain tensors: `last.rotation` (1, 3, 3), or `last.rays`, turns them. Gradients
    reach the inputs, not the cameras.

    Args:
        augmentation: what to do.
        camera: of samples that hold none; by default the augmentation's.
        valid: whether points and boxes in dicts get flags.

    Raises:
        TypeError: it is no augmentation; a camera that is none; an image of a sample as a NumPy array.
        ValueError: no camera, or one with batch dims; images, boxes or points that are not of the camera's
            image_size; rotated boxes; PIL images of palettes or single bits.
    """

    _transformed_types = (torch.Tensor, PIL.Image.Image, Camera)
    camera: Camera | None
    valid: bool

    def __init__(self, augmentation: Augmentation, camera: Camera | None = None, *, valid: bool = False):
        super().__init__()
        self.camera, self.valid = check_front_end(_OWNER, augmentation, camera), bool(valid)
        self.augmentation = augmentation
        self._flags: list[tuple[Tensor, Tensor]] = []

    def forward(self, *inputs: Any) -> Any:
        if any(isinstance(one, np.ndarray) and one.ndim > 1 and one.dtype == np.uint8 for one in tree_leaves(inputs)):
            raise TypeError(f"{_OWNER}: an array would stay as it is; v2.ToImage() before makes an Image of it")
        outputs = super().forward(*inputs)
        if self.valid:
            _put(outputs, self._flags)
        self._flags = []
        return outputs

    @property
    def last(self) -> Change | None:
        """The change of the last call: its `source`, `target` and `rotation`."""
        return self.augmentation.last

    def make_params(self, flat_inputs: list[Any]) -> dict[str, Any]:
        """Draw once for all inputs of a sample.

        Returns:
            `change`, `camera`, the new one, and `made`, the inputs that are moved already, and what became of them.
        """
        cameras = [one for one in flat_inputs if isinstance(one, Camera)]
        if len(cameras) > 1:
            raise ValueError(f"{_OWNER}: a sample has one camera; here are {len(cameras)}")
        sizes = [(type(one).__name__, size) for one in flat_inputs if (size := _size(one)) is not None]
        camera = camera_of_sample(_OWNER, self.augmentation, cameras[0] if cameras else self.camera, sizes)
        with torch.no_grad():
            self.augmentation.tell_of_empty_images(camera)
            boxes = next((one for one in flat_inputs if isinstance(one, tv_tensors.BoundingBoxes)), None)
            if boxes is not None and self.augmentation.crops:
                plain = boxes.as_subclass(torch.Tensor)
                boxes = torch.cat(_ends(plain.reshape(-1, 4), boxes.format.value), -1)[None] - 0.5
            change = self.augmentation.change(camera, self.augmentation.with_boxes(self.augmentation.draw(1), boxes))
            self.augmentation.last, self._flags = change, []
            fields = {str(i): field for i, one in enumerate(flat_inputs) if (field := _field(one)) is not None}
            made = together(change, fields, self.augmentation.mask_fill)
            left = [(flat_inputs[int(i)], result) for i, result in made.items()]
            return {"change": change, "camera": change.single, "made": left}

    def transform(self, inpt: Any, params: dict[str, Any]) -> Any:
        """Move one input of a sample by the `params` of `make_params`."""
        # a graph of the camera would make the warp slower, and could not leave a DataLoader's worker
        with torch.set_grad_enabled(torch.is_grad_enabled() and getattr(inpt, "requires_grad", False)):
            left = params.get("made", [])
            place = next((i for i, (one, _) in enumerate(left) if one is inpt), None)
            made = None if place is None else left.pop(place)[1]
            return self._moved(inpt, params["change"], params["camera"], made)

    def _moved(self, inpt: Any, change: Change, camera: Camera, made: Any = None) -> Any:
        if isinstance(inpt, Camera):
            return camera
        plain = inpt.as_subclass(torch.Tensor) if isinstance(inpt, tv_tensors.TVTensor) else inpt
        if isinstance(inpt, _PLACES):
            of_boxes = isinstance(inpt, tv_tensors.BoundingBoxes)
            moved, valid = _boxes(change, plain, inpt.format.value) if of_boxes else self._points(change, plain, made)
            if change.parts[0].moves is None:
                moved = plain
            result = tv_tensors.wrap(moved, like=inpt, canvas_size=camera.image_size)
            self._flags.append((result, valid))
            return result
        if change.parts[0].moves is None:
            return inpt
        if isinstance(inpt, PIL.Image.Image):
            return _pil(change, inpt, made)
        if isinstance(inpt, tv_tensors.Mask):
            masks = _labels(change, plain, self.augmentation.mask_fill) if made is None else made[0][0]
            return tv_tensors.wrap(masks, like=inpt)
        if isinstance(inpt, tv_tensors.TVTensor) and not isinstance(inpt, (tv_tensors.Image, tv_tensors.Video)):
            return inpt
        images = _images(change, plain) if made is None else made[0][0]
        return tv_tensors.wrap(images, like=inpt) if isinstance(inpt, tv_tensors.TVTensor) else images

    def _points(self, change: Change, points: Tensor, made: Any) -> tuple[Tensor, Tensor]:
        """Pixels (..., 2), and valid (...)."""
        number = points.shape[-2] if points.ndim > 1 else 1
        rows = _wide(points).reshape(1, math.prod(points.shape[:-2]), number, 2)
        moved, valid = move_points(self.augmentation, change, rows, made)
        moved = moved if points.is_floating_point() else moved.round()
        return moved.reshape(points.shape).to(points.dtype), valid.reshape(points.shape[:-1])


def _put(outputs: Any, flags: list[tuple[Tensor, Tensor]]) -> None:
    """Put flags beside their tensors into the dicts of a nest."""
    if isinstance(outputs, (list, tuple)):
        for item in outputs:
            _put(item, flags)
    if not isinstance(outputs, dict):
        return
    for name, value in list(outputs.items()):
        _put(value, flags)
        for tensor, valid in flags:
            if value is tensor:
                before = outputs.get(f"{name}_valid")
                outputs[f"{name}_valid"] = valid if before is None else valid & (torch.as_tensor(before) != 0)


def _size(inpt: Any) -> tuple[int, int] | None:
    """(height, width) of the image that an input is, or lies on."""
    if isinstance(inpt, PIL.Image.Image):
        return inpt.size[::-1]
    if isinstance(inpt, _PLACES):
        return tuple(inpt.canvas_size)
    if isinstance(inpt, (tv_tensors.Image, tv_tensors.Video, tv_tensors.Mask)):
        return tuple(inpt.shape[-2:])
    return None if isinstance(inpt, (Camera, tv_tensors.TVTensor)) else tuple(inpt.shape[-2:])


def _field(inpt: Any) -> tuple[str, Tensor] | None:
    """An input as the field of a batch of one; None for what moves by itself."""
    if isinstance(inpt, PIL.Image.Image):
        return None if inpt.mode in _NO_COLOURS else ("image", as_tensor("image", np.asarray(inpt))[None])
    kinds = {"image": tv_tensors.Image, "mask": tv_tensors.Mask, "keypoints": _PLACES[1:]}
    plain = None if isinstance(inpt, (Camera, tv_tensors.TVTensor)) else "image"
    kind = next((kind for kind, types in kinds.items() if isinstance(inpt, types)), plain)
    if kind is None or inpt.ndim != KINDS[kind].dims or inpt.requires_grad:
        return None
    value = inpt.as_subclass(torch.Tensor)[None]
    return kind, _wide(value) if kind == "keypoints" else value


def _images(change: Change, images: Tensor) -> Tensor:
    """Images (..., C, H, W), or (H, W), all of one sample."""
    frames = images.reshape(-1, *images.shape[-3:]) if images.ndim > 2 else images[None, None]
    spread = Change(len(frames), [replace(part, rows=None) for part in change.parts])
    moved = spread.images(frames)
    return moved.reshape(*images.shape[:-2], *moved.shape[-2:])


def _pil(change: Change, image: PIL.Image.Image, made: Any) -> PIL.Image.Image:
    if image.mode in _NO_COLOURS:
        raise ValueError(
            f"{_OWNER}: values between those of a PIL image of mode {image.mode!r} mean nothing; "
            "image.convert('RGB') makes it an image, tv_tensors.Mask(image) labels"
        )
    array = np.asarray(image)
    images = change.images(as_tensor("image", array)[None]) if made is None else made[0]
    moved = as_array(images[0], array)
    return PIL.Image.frombuffer(image.mode, moved.shape[1::-1], moved, "raw", image.mode, 0, 1)


def _labels(change: Change, masks: Tensor, fill: float) -> Tensor:
    moved = change.labels(masks.reshape(1, math.prod(masks.shape[:-2]), *masks.shape[-2:]), fill)
    return moved.reshape(*masks.shape[:-2], *moved.shape[-2:])


def _ends(boxes: Tensor, form: str) -> tuple[Tensor, Tensor]:
    """(M, 2) and (M, 2): the lower and the upper corners of boxes of one of torchvision's formats."""
    if form not in ("XYXY", "XYWH", "CXCYWH"):
        raise ValueError(
            f"{_OWNER}: boxes of the format {form} turn with no lens; v2.ConvertBoundingBoxFormat('XYXY') encloses them"
        )
    one, two = _wide(boxes).chunk(2, -1)
    low = one - two / 2 if form == "CXCYWH" else one
    return low, {"XYXY": two, "XYWH": one + two, "CXCYWH": one + two / 2}[form]


def _boxes(change: Change, boxes: Tensor, form: str) -> tuple[Tensor, Tensor]:
    """Boxes (M, 4) between pixel edges, of one of torchvision's formats, and valid (M,)."""
    low, high = _ends(boxes, form)
    whole = not boxes.is_floating_point()
    if whole:  # as torchvision reads them
        low, high = low.trunc(), high.trunc()
    given = torch.cat((low, high), -1)
    moved, valid = (t[0] for t in change.boxes((given - 0.5)[None]))
    lost = ((moved == -1) | (given == -1).all(-1, keepdim=True)).all(-1, keepdim=True)
    low, high = torch.where(lost, -1.0, moved + 0.5).chunk(2, -1)
    if whole:
        # rounding errors are no reason for another pixel
        low, high = (low + 1e-3).floor(), (high - 1e-3).ceil()
        if form == "CXCYWH":  # whose centres are whole numbers too
            high = high + (high - low) % 2
    pairs = {"XYXY": (low, high), "XYWH": (low, high - low), "CXCYWH": ((low + high) / 2, high - low)}
    return torch.cat(pairs[form], -1).to(boxes.dtype), valid & ~lost.squeeze(-1)


def _wide(values: Tensor) -> Tensor:
    return values if values.dtype == torch.float64 else values.float()
