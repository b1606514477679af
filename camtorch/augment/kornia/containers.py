"""kornia's containers of camera augmentations, in which dicts move whole.

In containers that hold one of them, `wrap_containers` wraps methods of kornia's:

* `forward` and `inverse`, since fields of a dict that kornia does not know would stay as they are, without a warning;
* `_preproc_boxes`, since kornia takes no boxes of zeros, which it makes of those that are lost;
* `__getstate__`, since params of a graph could be neither copied nor pickled.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from kornia.augmentation import AugmentationSequential, IntensityAugmentationBase2D
from kornia.augmentation.container.image import ImageSequential
from kornia.constants import DataKey
from kornia.geometry.boxes import Boxes
from torch import Tensor, nn

from camtorch import augment
from camtorch.augment.augmentation import put_crop_place
from camtorch.augment.change import Change
from camtorch.augment.fields import PLACE
from camtorch.augment.front_end import FrontEnd
from camtorch.augment.kornia.params import Params, params_of_each, with_cameras
from camtorch.augment.kornia.private import BasicAugmentationBase
from camtorch.augment.matrices import Guess, pinhole_of_matrix
from camtorch.augment.names import is_text, kind_of
from camtorch.augment.sample import Sample, Single, detached, on_samples


class _Dict(NamedTuple):
    """The dict of a call of a container, read."""

    texts: Sample  # values that are strings: image_path is no image
    rest: Sample  # the others, which the container gets
    fields: Sample  # of them, those that change and that kornia does not know; a `Single` if the image has no dim B
    kinds: dict[str, str]  # of these fields, but for flags and orders of landmarks
    image: Tensor | None
    camera: Any


def _read_dict(container: Any, given: Sample, ours: list[FrontEnd]) -> _Dict:
    owner = type(container).__name__
    texts = {name: value for name, value in given.items() if is_text(value)}
    rest = {name: value for name, value in given.items() if name not in texts}
    keys = {name: container._read_datakeys_from_dict((name,))[0] for name in rest}
    unknown = [name for name, key in keys.items() if key in ([], [DataKey.CLASS], [DataKey.LABEL])]
    if flags := [name for name in rest if name.endswith("_valid") and name not in unknown]:
        raise ValueError(f"{owner}: a flag must be no kornia key; got {flags[0]}. Use its own keypoints_valid")
    image = next((rest[name] for name, key in keys.items() if key == [DataKey.INPUT]), None)
    is_single = image is not None and image.ndim < 4
    option = {name: kind for one in ours for name, kind in one.augmentation.fields.items()}
    kinds = {}
    for name in unknown:
        kind = None if rest[name] is None else kind_of(name, rest[name], option, owner, is_single)
        if kind is not None:
            kinds[name] = kind
    if rest.get(PLACE) is not None and "rotation" not in kinds:
        raise ValueError(
            f"{owner}: a sample with {PLACE} must have the rotation that came with it, as it follows from that and the "
            f"camera; got {', '.join(given)}. Leave {PLACE} out, or keep the rotation"
        )
    moving = [*kinds, *(["camera"] if rest.get("camera") is not None else [])]
    _check_others(container, [*moving, *(PLACE for one in ours if one.augmentation.place)])
    tables = {n for one in ours if one.augmentation.mirroring for n in one.augmentation.mirroring.by_name}
    fields = {n: rest[n] for n in unknown if n in kinds or n.removesuffix("_valid") in kinds or n in tables}
    if rest.get(PLACE) is not None:
        fields[PLACE] = rest[PLACE]
    return _Dict(texts, rest, Single(fields) if is_single else fields, kinds, image, given.get("camera"))


def _check_others(container: Any, names: list[str]) -> None:
    """Raise a ValueError if the container holds augmentations of kornia's own that would leave fields unmoved."""
    for module in container.modules() if names else ():
        if not isinstance(module, BasicAugmentationBase) or isinstance(module, (FrontEnd, IntensityAugmentationBase2D)):
            continue
        theirs = type(module).__name__
        ours = next((name for name in (theirs, theirs.removeprefix("Random")) if hasattr(augment, name)), None)
        how = f"camtorch.augment.kornia.{ours}, which moves" if ours else "augmentations of camtorch alone, which move"
        raise ValueError(
            f"{type(container).__name__}: parts must move {', '.join(names)} too; got kornia's {theirs}. Use {how} "
            "everything"
        )


def _given_camera(container: Any, read: _Dict, ours: list[FrontEnd]) -> Any:
    """Return the camera of a dict, else that of its field K if no camera is known; None if it brings none."""
    camera, image, owner = read.camera, read.image, type(container).__name__
    name = next((name for name, kind in read.kinds.items() if kind == "K"), None)
    if camera is None and name and image is not None and all(isinstance(one.camera, Guess) for one in ours):
        value = read.fields[name]
        value = value.flatten(0, -3) if value.ndim > 3 else value  # of the frames of videos
        camera = pinhole_of_matrix(name, value, (image.shape[-2], image.shape[-1]), owner)
    if camera is not None and len(ours) > 1:
        raise ValueError(
            f"{owner}: a camera must be that of one camera augmentation; got {len(ours)}. "
            "camtorch.augment.kornia.Compose makes one of several"
        )
    return camera


@on_samples
def _fields_moved(one: Any, fields: Sample, params: Params, kinds: dict[str, str], back: bool) -> Sample:
    """Move the fields of a dict that kornia does not know by one of ours, and return them with their flags.

    From an augmentation with `place`, `crop_place` comes out as well, and the rotation from which it follows.
    """
    device = next((value.device for value in fields.values() if isinstance(value, Tensor)), torch.device("cpu"))
    clips = int(params["video_batch_size"]) if "video_batch_size" in params else None
    flat = {n: v.flatten(0, 1) for n, v in fields.items()} if clips else fields
    with torch.autocast(device.type, enabled=False):
        change = one.change(params, device)
        if kinds:
            moved = one.augmentation.moved_by(change.inverse() if back else change, flat, kinds, predicted=back)
        else:  # beside the crop's place
            batched = not isinstance(fields, Single)
            moved = {"rotation": change.rotation_for_sample(batched), "camera": change.camera_for_sample(batched)}
    names = {*fields, PLACE, "rotation"} if one.augmentation.place else {*fields}
    if PLACE in names and not back:
        put_crop_place(flat, moved, type(one).__name__)
    kept = {n: v for n, v in moved.items() if n in names or n.removesuffix("_valid") in kinds}
    return {n: v.unflatten(0, (clips, -1)) for n, v in kept.items()} if clips else type(fields)(kept)


def _with_fields(
    call: Callable[..., Any], self: Any, *args: Any, back: bool, params: Any = None, data_keys: Any = None
) -> Any:
    """Move dicts together with the fields that kornia does not know."""
    if len(args) != 1 or not isinstance(args[0], dict):
        return call(self, *args, params=params, data_keys=data_keys)
    ours = [one for one in self.modules() if isinstance(one, FrontEnd)]
    read = _read_dict(self, args[0], ours)
    camera = _given_camera(self, read, ours)
    if camera is not None and not back:
        if params is None and read.image is not None:
            dims = (3, 5) if self.contains_video_sequential else (2, 4)
            params = self.forward_parameters(self.autofill_dim(read.image, dim_range=dims)[1])
        params = with_cameras(params, camera)
    result = call(self, read.rest, params=params)
    fields, kinds, with_camera = read.fields, read.kinds, read.camera is not None
    applied = [pair for pair in params_of_each(self._params if params is None else params, self) if pair[0] in ours]
    for one, its_params in reversed(applied) if back else applied:
        adds_place = one.augmentation.place and not back
        if kinds or adds_place:
            fields = _fields_moved(one, fields, its_params, kinds, back)
        if adds_place:  # it follows from both, also through later augmentations
            kinds, with_camera = {**kinds, "rotation": "rotation"}, True
        if with_camera:
            change: Change = one.change(its_params)
            cameras = change.source if back else change.target
            cameras = (cameras[0] if isinstance(read.fields, Single) else cameras).clone()
            result["camera"] = list(cameras) if isinstance(read.camera, list) else cameras
    result = {**result, **fields, **read.texts}
    if back:
        result.pop(PLACE, None)  # what comes back is no crop
    return result


def _lost_stay_lost(call: Callable[..., Boxes], self: Any, boxes: Any, key: DataKey) -> Boxes:
    """Read boxes of zeros as lost: kornia exports lost boxes so, and refuses them as input."""
    if not isinstance(boxes, Tensor):
        return call(self, boxes, key)
    lost = (boxes == 0).all(-1) if key is not DataKey.BBOX else (boxes == 0).all(-1).all(-1)
    if key is DataKey.BBOX_XYWH:
        boxes = torch.where(lost.unsqueeze(-1), boxes.new_tensor((0, 0, 1, 1)), boxes)
    result = call(self, boxes, key)
    result._valid = result._valid & ~lost.reshape(result._valid.shape)
    return result


def _put(of: type[nn.Module], name: str, by: Callable[..., Any]) -> None:
    """Replace method `name` of the class `of` by `by(old, container, *args)`, for containers of our augmentations."""
    call = getattr(of, name)
    call = getattr(call, "__wrapped__", call)  # modules may be imported again

    @functools.wraps(call)
    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        ours = any(isinstance(one, FrontEnd) for one in self.modules())
        return by(call, self, *args, **kwargs) if ours else call(self, *args, **kwargs)

    setattr(of, name, method)


def wrap_containers() -> None:
    """Wrap the methods of kornia's containers; see the module."""
    _put(AugmentationSequential, "forward", functools.partial(_with_fields, back=False))
    _put(AugmentationSequential, "inverse", functools.partial(_with_fields, back=True))
    _put(AugmentationSequential, "_preproc_boxes", _lost_stay_lost)
    _put(ImageSequential, "__getstate__", lambda call, self: detached(call(self)))
