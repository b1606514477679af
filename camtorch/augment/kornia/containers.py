"""kornia's containers that hold augmentations of camtorch: what they do in another way, and how.

kornia has no hook for it, so `wrap_containers`, called when `camtorch.augment.kornia` is imported, puts a function of
this file around four methods of kornia's. Of containers without an augmentation of camtorch they do what they did. The
oldest kornia that is allowed, 0.9.0, needs all four:

* `AugmentationSequential.forward` and `.inverse` return fields of a dict that kornia does not know as they are, without
  a warning: `_with_fields` moves them as well;
* `AugmentationSequential._preproc_boxes` refuses boxes x, y, width, height of zeros, which kornia makes of those that
  are lost, and takes other zeros for boxes: `_lost_stay_lost` marks them as lost;
* `ImageSequential.__getstate__` holds the params of the last call: with a graph, as cameras that learn have one, they
  could be neither copied nor pickled.

A call with a dict goes through the functions below in their order: the dict is read; its camera goes into the params;
kornia moves what it knows; then each augmentation of camtorch moves the other fields, one after the other.
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
from camtorch.augment.fields import KEEP, PLACE
from camtorch.augment.front_end import FrontEnd
from camtorch.augment.kornia.params import Params, params_of_each, with_cameras
from camtorch.augment.kornia.private import BasicAugmentationBase
from camtorch.augment.matrices import Guess, pinhole_of_matrix
from camtorch.augment.names import is_text, kind_of, refuse_unknown
from camtorch.augment.sample import Sample, Single, detached, on_samples

_NOT_MOVED = None, DataKey.CLASS, DataKey.LABEL  # the keys of fields that kornia leaves as they are


def wrap_containers() -> None:
    """Wrap the methods of kornia's containers; see the module."""
    _wrap(AugmentationSequential, "forward", functools.partial(_with_fields, back=False))
    _wrap(AugmentationSequential, "inverse", functools.partial(_with_fields, back=True))
    _wrap(AugmentationSequential, "_preproc_boxes", _lost_stay_lost)
    _wrap(ImageSequential, "__getstate__", lambda call, container: detached(call(container)))


def _wrap(of: type[nn.Module], name: str, by: Callable[..., Any]) -> None:
    """Replace method `name` of the class `of` by `by(old, container, *args)`, for containers of our augmentations."""
    call = getattr(of, name)
    call = getattr(call, "__wrapped__", call)  # modules may be imported again

    @functools.wraps(call)
    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        return by(call, self, *args, **kwargs) if _ours_in(self) else call(self, *args, **kwargs)

    setattr(of, name, method)


def _ours_in(container: nn.Module) -> list[FrontEnd]:
    """Return the augmentations of camtorch in a container and in those that it holds."""
    return [one for one in container.modules() if isinstance(one, FrontEnd)]


def _with_fields(
    call: Callable[..., Any], container: Any, *args: Any, back: bool, params: Any = None, data_keys: Any = None
) -> Any:
    """Call `forward` or, if `back`, `inverse` of kornia, and move the fields of a dict that it does not know, too."""
    if len(args) != 1 or not isinstance(args[0], dict):
        return call(container, *args, params=params, data_keys=data_keys)
    ours = _ours_in(container)
    read = _read_dict(container, args[0], ours)
    _check_dict(container, args[0], read.kinds, ours)
    camera = _camera_of_dict(container, read, ours)
    if camera is not None and not back:
        params = with_cameras(_drawn_before(container, read.image) if params is None else params, camera)
    result = call(container, read.rest, params=params)
    applied = params_of_each(container._params if params is None else params, container)
    steps = [pair for pair in applied if isinstance(pair[0], FrontEnd)]
    if back:
        steps.reverse()
    fields, kinds, has_camera = read.fields, read.kinds, read.camera is not None
    for one, its_params in steps:
        adds_place = one.augmentation.place and not back
        if kinds or adds_place:
            fields = _fields_moved(one, fields, its_params, kinds, back)
        if adds_place:  # it follows from both, also through later augmentations
            kinds, has_camera = {**kinds, "rotation": "rotation"}, True
    if has_camera and steps:
        one, its_params = steps[-1]
        change = one.change(its_params)
        cameras = change.source if back else change.target
        cameras = (cameras[0] if isinstance(read.fields, Single) else cameras).clone()
        result["camera"] = list(cameras) if isinstance(read.camera, list) else cameras
    result = {**args[0], **result, **fields}
    if back:
        result.pop(PLACE, None)  # what comes back is no crop
    return result


class _Dict(NamedTuple):
    """The dict of a call of a container, read."""

    rest: Sample  # what the container gets, all but strings: image_path is no image
    fields: Sample  # of them, those that change and that kornia does not move; a `Single` if the image has no dim B
    kinds: dict[str, str]  # of these fields, but for flags and orders of landmarks
    image: Tensor | None
    camera: Any


def _read_dict(container: Any, given: Sample, ours: list[FrontEnd]) -> _Dict:
    owner = type(container).__name__
    rest = {name: value for name, value in given.items() if not is_text(value)}
    keys = {name: next(iter(container._read_datakeys_from_dict((name,))[0]), None) for name in rest}
    unmoved = [name for name, key in keys.items() if key in _NOT_MOVED]
    for name in rest:
        if name.endswith("_valid") and name not in unmoved:
            raise ValueError(f"{owner}: a flag must be no kornia key; got {name}. Use its own keypoints_valid")
    image = next((rest[name] for name, key in keys.items() if key == DataKey.INPUT), None)
    is_single = image is not None and image.ndim < 4
    option = {name: kind for one in ours for name, kind in one.augmentation.fields.items()}
    refuse_unknown({name: rest[name] for name in unmoved}, option, owner, single=is_single)
    kinds = {}
    for name in unmoved:
        kind = kind_of(name, rest[name], option, owner)
        if rest[name] is not None and kind is not None and kind != KEEP:
            kinds[name] = kind
    tables = {name for one in ours if one.augmentation.mirroring for name in one.augmentation.mirroring.by_name}
    changing = kinds.keys() | tables
    fields = {name: rest[name] for name in unmoved if name in changing or name.removesuffix("_valid") in kinds}
    if rest.get(PLACE) is not None:
        fields[PLACE] = rest[PLACE]
    return _Dict(rest, Single(fields) if is_single else fields, kinds, image, given.get("camera"))


def _check_dict(container: Any, given: Sample, kinds: dict[str, str], ours: list[FrontEnd]) -> None:
    """Raise a ValueError for a crop's place alone, or if augmentations of kornia's own would leave fields unmoved."""
    owner = type(container).__name__
    if given.get(PLACE) is not None and "rotation" not in kinds:
        raise ValueError(
            f"{owner}: a sample with {PLACE} must have the rotation that came with it, as it follows from that and the "
            f"camera; got {', '.join(given)}. Leave {PLACE} out, or keep the rotation"
        )
    moving = [*kinds, *(["camera"] if given.get("camera") is not None else [])]
    moving += [PLACE for one in ours if one.augmentation.place]
    for module in container.modules() if moving else ():
        if not isinstance(module, BasicAugmentationBase) or isinstance(module, (FrontEnd, IntensityAugmentationBase2D)):
            continue
        theirs = type(module).__name__
        like = next((name for name in (theirs, theirs.removeprefix("Random")) if hasattr(augment, name)), None)
        how = f"camtorch.augment.kornia.{like}, which moves" if like else "augmentations of camtorch alone, which move"
        raise ValueError(
            f"{owner}: parts must move {', '.join(moving)} too; got kornia's {theirs}. Use {how} everything"
        )


def _camera_of_dict(container: Any, read: _Dict, ours: list[FrontEnd]) -> Any:
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


def _drawn_before(container: Any, image: Tensor | None) -> Any:
    """Return params that a call of `forward` would draw for an image; None without one."""
    if image is None:
        return None
    dims = (3, 5) if container.contains_video_sequential else (2, 4)
    return container.forward_parameters(container.autofill_dim(image, dim_range=dims)[1])


@on_samples
def _fields_moved(one: Any, fields: Sample, params: Params, kinds: dict[str, str], back: bool) -> Sample:
    """Move the fields of a dict that kornia does not know by one of ours, and return them with their flags.

    From an augmentation with `place`, `crop_place` comes out as well, and the rotation from which it follows.
    """
    device = next((value.device for value in fields.values() if isinstance(value, Tensor)), torch.device("cpu"))
    clips = int(params["video_batch_size"]) if "video_batch_size" in params else None
    flat = {name: value.flatten(0, 1) for name, value in fields.items()} if clips else fields
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
    kept = {name: v for name, v in moved.items() if name in names or name.removesuffix("_valid") in kinds}
    return {name: v.unflatten(0, (clips, -1)) for name, v in kept.items()} if clips else type(fields)(kept)


def _lost_stay_lost(call: Callable[..., Boxes], container: Any, boxes: Any, key: DataKey) -> Boxes:
    """Call `_preproc_boxes` of kornia, and mark boxes of zeros as lost."""
    if not isinstance(boxes, Tensor):
        return call(container, boxes, key)
    lost = (boxes == 0).all(-1) if key is not DataKey.BBOX else (boxes == 0).all(-1).all(-1)
    if key is DataKey.BBOX_XYWH:  # which must have an extent
        boxes = torch.where(lost.unsqueeze(-1), boxes.new_tensor((0, 0, 1, 1)), boxes)
    result = call(container, boxes, key)
    result._valid = result._valid & ~lost.reshape(result._valid.shape)
    return result
