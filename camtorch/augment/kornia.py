"""The augmentations as kornia's: in AugmentationSequential and VideoSequential, for every data key, beside its own.

`import camtorch` does not load this module, nor kornia.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, cast

import kornia
import torch
from kornia.augmentation import GeometricAugmentationBase2D
from kornia.augmentation.container.params import ParamItem
from kornia.augmentation.utils import _transform_output_shape
from kornia.constants import Resample, SamplePadding
from kornia.geometry.boxes import Boxes
from kornia.geometry.keypoints import Keypoints
from torch import Tensor
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch._arguments import as_part, as_values, check_boxes, fails, shown
from camtorch._dtypes import narrow, widen
from camtorch._module import Memo, remade
from camtorch.augment import box_crop, compose, edits, random_camera
from camtorch.augment.augmentation import Augmentation, check_front_end, check_single, move_points
from camtorch.augment.change import Change
from camtorch.augment.collate import collate_cameras
from camtorch.augment.presets import PresetName
from camtorch.augment.sample import fixed_copy, on_samples
from camtorch.camera import Camera
from camtorch.warp.sampling import Mode

if not hasattr(GeometricAugmentationBase2D, "_gate"):
    raise ImportError(
        "camtorch.augment.kornia needs kornia 0.9 or newer, which needs Python 3.11; installed is kornia "
        f"{kornia.__version__}"
    )

__all__ = [
    "BoxCrop",
    "CameraAugmentation",
    "CenterCrop",
    "Compose",
    "HorizontalFlip",
    "Pad",
    "RandomCamera",
    "RandomCrop",
    "RandomLens",
    "RandomMount",
    "RandomResizedCrop",
    "Resize",
    "Rotate90",
    "VerticalFlip",
    "with_boxes",
    "with_cameras",
]

Params: TypeAlias = dict[str, Tensor]
Flags: TypeAlias = dict[str, Any]
_KIND = "source_kind"
_NUMBERS = "source_intrinsics", "source_distortion"


class CameraAugmentation(GeometricAugmentationBase2D):
    r"""An augmentation of camtorch as one of kornia: image, masks, keypoints and boxes move by the same warps.

    The same seed gives the same warps as calling the augmentation itself on a sample.

    Args:
        augmentation: a `camtorch.augment.Augmentation`, for example a `RandomCamera`.
        camera: the Camera of the images, of which this keeps a copy that does not learn; by default the augmentation's.
            `with_cameras` gives every sample its own, which may learn.
        p, p_batch: how likely a sample, and a batch, is augmented at all; p by default as the augmentation says.
        same_on_batch: the same draw for the whole batch; by default as the augmentation says.
        keepdim: whether images without batch dim stay without.

    Convention:
        - pixel coordinates are ``(x, y)`` at integer pixel centres, as in all of kornia and camtorch.
          ``align_corners`` means nothing; ``resample`` and ``padding_mode`` can be overridden by a call.
        - keypoints keep their count and order. ``keypoints_valid`` (B, N), an attribute, is which of those last moved
          lie on their new image. One without a place there becomes ``(-1, -1)``, and stays that, not valid, in
          whatever augmentations of camtorch follow.
        - boxes become those that enclose their moved outlines, which are curved; they are not clipped. A box of which
          no part, outline or inside, is on the new image is invalid, which kornia exports as zeros.
        - masks take the nearest value, the augmentation's `mask_fill` where nothing is seen, and never the colours and
          the light of the lens. ``extra_args={DataKey.MASK: {"resample": "bilinear"}}`` is for soft ones.
        - the warp is no matrix: ``transform_matrix`` is NaN, also of a container that holds the augmentation. ``last``
          and ``change(params)`` give what there is instead: the cameras before and after, and how far it turned.
        - edits of camtorch move the camera along, which kornia's own do not; ``landmarks`` of a flip are for keypoints.
          A chain in one `Compose` samples images once.
        - gaze, poses and 3D points have no data key in kornia, and containers leave them as they are. Turn them
          by ``aug.last.rays(...)``, or call the augmentation itself with samples.
        - ``inverse`` takes everything back by the inverse warp. What left the image, or fell between its pixels, is
          lost; boxes have grown; chromatic aberration and vignetting stay.
        - params are tensors, drawn on the CPU wherever the module is. A replay is bit-identical.
    """

    augmentation: Augmentation
    camera: Camera

    def __init__(
        self,
        augmentation: Augmentation,
        camera: Camera | None = None,
        *,
        p: float | None = None,
        p_batch: float = 1.0,
        same_on_batch: bool | None = None,
        keepdim: bool = False,
    ):
        name = type(self).__name__
        camera = check_front_end(name, augmentation, camera)
        camera = fixed_copy(augmentation.camera, name) if camera is None else camera
        if not isinstance(camera, Camera):
            raise TypeError(f"{name}: camera must be the Camera of the images; got {type(camera).__name__}")
        own_size = check_single(name, camera, (), ". with_cameras gives every sample its own")
        p = augmentation.p if p is None else as_part(p, "p", name, "probability")
        p_batch = as_part(p_batch, "p_batch", name, "probability")
        same_on_batch = augmentation.same_on_batch if same_on_batch is None else same_on_batch
        super().__init__(p=p, p_batch=p_batch, same_on_batch=same_on_batch, keepdim=keepdim)
        self.augmentation, self.camera = augmentation, camera
        self.flags: dict[str, Any] = {"resample": Resample.get(augmentation.options["mode"]), "align_corners": False}
        self.flags["padding_mode"] = SamplePadding.get(augmentation.options["padding_mode"])
        size = augmentation.size_after(own_size)
        if size != own_size:
            self.flags["size"] = size
        self._kind = _kind(camera)
        self.keypoints_valid: Tensor | None = None
        """(B, N) bool: which of the keypoints that were moved last lie on their image."""
        # lists of masks come row by row between other labels of the batch
        self._memos = Memo(), Memo()

    # -- parameters

    def set_rng_device_and_dtype(self, device: torch.device, dtype: torch.dtype) -> None:
        """Draws stay on the CPU: a seed then means the same everywhere, and params can be looked at for free."""
        super().set_rng_device_and_dtype(torch.device("cpu"), dtype)

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Draw, as `Augmentation.draw` does after its gate; images must be of the camera's image_size."""
        count = batch_shape[0]
        check_single(type(self).__name__, self.camera, [("images", tuple(batch_shape[-2:]))])
        if count:
            self.augmentation.tell_of_empty_images(self.camera)
        drawn = self.augmentation.drawn(count, 1.0, self.same_on_batch)
        del drawn["apply"]
        drawn |= {name: torch.full((count, 4), torch.nan) for name in self.augmentation.crops}
        drawn[_KIND] = torch.tensor(self._kind).expand(count, -1).contiguous()
        if "size" in self.flags:
            drawn["output_size"] = torch.tensor(self.flags["size"]).expand(count, -1).contiguous()
        return drawn

    def change(self, params: Params | None = None, device: torch.device | None = None) -> Change:
        """What params, by default the last, do to a batch: `source`, `target`, `rotation`, `points(...)` and so on."""
        params = self._params if params is None else params
        missing = [
            name for name in ("batch_prob", *self.augmentation.ranges, *self.augmentation.crops) if name not in params
        ]
        if missing:
            raise ValueError(f"{type(self).__name__}: the params lack {', '.join(missing)}; call it first")
        own = *self.augmentation.ranges, *self.augmentation.crops
        values = {"apply": self._gate(params), **{name: params[name] for name in own}}
        if self.augmentation.crops and any(fails(~values[name].isnan()) for name in self.augmentation.crops):
            raise ValueError(
                f"{type(self).__name__}: kornia hands on boxes after images, so that they go in before: "
                "params = aug.forward_parameters(images.shape), then aug(images, params=with_boxes(params, boxes))"
            )
        camera = self._source(params, device)
        inputs = [*values.values(), camera.intrinsics, camera.distortion]
        inputs += [*self.augmentation.parameters(), *self.augmentation.buffers()]
        if torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
            return self.augmentation.change(camera, values)
        memo = self._memos[len(values["apply"]) == 1]
        kept: Change = memo(inputs, (str(self.augmentation.options),), lambda: self.augmentation.change(camera, values))
        return kept

    @property
    def last(self) -> Change | None:
        """The change of the last call."""
        return self.change() if self._params else None

    def _source(self, params: Params, device: torch.device | None) -> Camera:
        own = self.camera.intrinsics, self.camera.distortion
        device = own[0].device if device is None else device
        intrinsics, distortion = (params.get(n, value).to(device) for n, value in zip(_NUMBERS, own, strict=True))
        same = intrinsics is own[0] and distortion is own[1]
        return self.camera if same else remade(self.camera, intrinsics=intrinsics, distortion=distortion)

    # -- moving

    @on_samples
    def _move(self, params: Params, value: Tensor, move: Callable[[Change, Tensor], Any], back: bool = False) -> Any:
        """`move(change, value)`, in the dtype of the value; positions in half precision would be off by pixels."""
        with torch.autocast(value.device.type, enabled=False):
            change = self.change(params, value.device)
            if len(value) != change.count:
                raise ValueError(f"{type(self).__name__}: params for {change.count} samples, here are {len(value)}")
            moved = move(change.inverse() if back else change, value)
        moved, valid = moved if isinstance(moved, tuple) else (moved, None)
        moved = narrow(moved, value.dtype)
        if back:  # what moves forth is blended by kornia
            moved = self._blend_by_prob(moved, value, self._gate(params))
        return moved if valid is None else (moved, valid)

    def apply_transform(
        self, input: Tensor, params: Params, flags: Flags, transform: Tensor | None = None, *, back: bool = False
    ) -> Tensor:
        options = {"mode": Resample.get(flags["resample"]).name.lower()}
        options["padding_mode"] = SamplePadding.get(flags["padding_mode"]).name.lower()
        moved: Tensor = self._move(params, input, lambda change, images: change.images(images, **options), back)
        return moved

    def apply_transform_mask(
        self, input: Tensor, params: Params, flags: Flags, transform: Tensor | None = None, *, back: bool = False
    ) -> Tensor:
        fill, mode = self.augmentation.mask_fill, cast("Mode", Resample.get(flags["resample"]).name.lower())
        moved: Tensor = self._move(params, input, lambda change, masks: change.labels(masks, fill, mode), back)
        return moved

    def apply_transform_keypoint(
        self, input: Keypoints, params: Params, flags: Flags, transform: Tensor | None = None, *, back: bool = False
    ) -> Keypoints:
        rows = input.data if input.data.ndim == 3 else input.data.unsqueeze(0)
        own = self.augmentation
        moved, valid = self._move(params, rows, lambda change, pixels: move_points(own, change, pixels), back)
        result = input.clone()
        result._data, self.keypoints_valid = moved.reshape(input.shape), valid.reshape(input.shape[:-1])
        return result

    def apply_transform_box(
        self, input: Boxes, params: Params, flags: Flags, transform: Tensor | None = None, *, back: bool = False
    ) -> Boxes:
        rows = input.data if input.data.ndim == 4 else input.data.unsqueeze(0)
        moved, seen = self._move(params, rows, lambda change, corners: change.quadrilaterals(widen(corners)), back)
        result = input.clone()
        result._data = moved.reshape(input.shape)
        result._valid = input._valid & seen.reshape(input._valid.shape)
        return result

    def inverse_inputs(
        self, input: Tensor, params: Params, flags: Flags, transform: Tensor | None = None, **kwargs: Any
    ) -> Tensor:
        return self.apply_transform(self.transform_tensor(input), params, {**flags, **kwargs}, back=True)

    def inverse_masks(
        self, input: Tensor, params: Params, flags: Flags, transform: Tensor | None = None, **kwargs: Any
    ) -> Tensor:
        shape = params["forward_input_shape"]
        flags = {**flags, "resample": Resample.NEAREST, **kwargs}
        rows = self.transform_tensor(input, shape=shape, match_channel=False)
        moved = self.apply_transform_mask(rows, params, flags, back=True)
        return _transform_output_shape(moved, input.shape, reference_shape=shape) if self.keepdim else moved

    def inverse_keypoints(
        self, input: Keypoints, params: Params, flags: Flags, transform: Tensor | None = None, **kwargs: Any
    ) -> Keypoints:
        return self.apply_transform_keypoint(input, params, flags, back=True)

    def inverse_boxes(
        self, input: Boxes, params: Params, flags: Flags, transform: Tensor | None = None, **kwargs: Any
    ) -> Boxes:
        return self.apply_transform_box(input, params, flags, back=True)

    def compute_transformation(self, input: Tensor, params: Params, flags: Flags) -> Tensor:
        """(B, 3, 3) of NaN: there is no matrix, and an identity would be silently wrong."""
        return torch.full((input.shape[0], 3, 3), torch.nan, device=input.device, dtype=input.dtype)

    def compute_inverse_transformation(self, transform: Tensor) -> Tensor:
        return transform

    def __getstate__(self) -> dict[str, Any]:
        # a tensor of a graph can be neither copied nor pickled
        kept = {k: v.detach() if isinstance(v, Tensor) else v for k, v in self._params.items()}
        return {**self.__dict__, "_params": kept}

    def __repr__(self) -> str:
        ranges = "".join(f"{name}={interval}, " for name, interval in self.augmentation.ranges.items())
        return super().__repr__().replace("(", f"({ranges}", 1)


class _Random(CameraAugmentation):
    """An augmentation of camtorch under its own name, made of its own arguments."""

    _wraps: Callable[..., Augmentation]

    def __init_subclass__(cls, wraps: type[Augmentation], **options: Any):
        super().__init_subclass__(**options)
        cls._wraps, name = wraps, wraps.__name__
        cls.__doc__ = f"""`camtorch.augment.{name}` for kornia. {cls.__doc__}

        Args:
            camera: of the images.
            given, options: those of `camtorch.augment.{name}`; what comes first there follows the camera, or goes by
                name.
            p, p_batch, same_on_batch, keepdim: see `CameraAugmentation`.

        Convention:
            as `CameraAugmentation`; yaw, pitch and roll are degrees by which the camera turns, not the image.
        """

    def __init__(
        self,
        *given: Camera | PresetName | str,
        camera: Camera | None = None,
        p: float | None = None,
        p_batch: float = 1.0,
        same_on_batch: bool = False,
        keepdim: bool = False,
        **options: Any,
    ):
        name = type(self).__name__
        first, own = (given[0], given[1:]) if camera is None and given else (camera, given)
        if not isinstance(first, Camera):
            example, got = f"{name}(camera)", type(first).__name__
            if isinstance(first, str):
                example, got = f"{name}(camera, {first!r})", repr(first)
            raise TypeError(f"{name}: camera must be the Camera of the images and comes first: {example}; got {got}")
        made = self._wraps(*own, **options)
        super().__init__(made, first, p=p, p_batch=p_batch, same_on_batch=same_on_batch, keepdim=keepdim)


class RandomMount(_Random, wraps=random_camera.RandomMount):
    """The camera turned and rolled where it stands, and zoomed."""


class RandomLens(_Random, wraps=random_camera.RandomLens):
    """Another lens before the camera, which stays where it looks."""


class RandomCamera(_Random, wraps=random_camera.RandomCamera):
    """Another camera in the same place, turned and with another lens."""


class RandomResizedCrop(_Random, wraps=edits.RandomResizedCrop):
    """A box at random, of another size."""


class RandomCrop(_Random, wraps=edits.RandomCrop):
    """A box of a size at random."""


class CenterCrop(_Random, wraps=edits.CenterCrop):
    """The middle of the image."""


class Resize(_Random, wraps=edits.Resize):
    """The image in another size."""


class Pad(_Random, wraps=edits.Pad):
    """A rim around the image."""


class HorizontalFlip(_Random, wraps=edits.HorizontalFlip):
    """Mirrored left to right, landmarks in their order in a mirror."""


class VerticalFlip(_Random, wraps=edits.VerticalFlip):
    """Mirrored top to bottom."""


class Rotate90(_Random, wraps=edits.Rotate90):
    """Turned by quarters."""


class BoxCrop(_Random, wraps=box_crop.BoxCrop):
    """What a camera sees that looks at a box of the sample, which `with_boxes` gives."""


class Compose(_Random, wraps=compose.Compose):
    """Several augmentations of camtorch, not of kornia, as one."""


def with_boxes(params: Any, boxes: Tensor) -> Any:
    """Params with the boxes (B, 4) that a `BoxCrop` crops, pixels x1, y1, x2, y2: of one augmentation, or a container.

    `params = aug.forward_parameters(images.shape)`, then `aug(images, params=with_boxes(params, boxes))`.

    Raises:
        ValueError: another shape or number, or nothing among the params that crops.
    """
    given = as_values(boxes, "boxes", "with_boxes")
    check_boxes(given, "boxes", "with_boxes")
    found: list[str] = []

    def changed(params: Any) -> Any:
        if not isinstance(params, dict):
            return [p._replace(data=changed(p.data)) if isinstance(p, ParamItem) and p.data else p for p in params]
        names = [name for name in params if name.rpartition(".")[2] == "box"]
        found.extend(names)
        for name in names:
            if tuple(given.shape) != (len(params[name]), 4):
                raise ValueError(f"with_boxes: boxes must be ({len(params[name])}, 4); got {tuple(given.shape)}")
        return {**params, **dict.fromkeys(names, given)}

    result = changed(params)
    if not found:
        raise ValueError(f"with_boxes: params must be those of a BoxCrop; got {shown(params)}")
    return result


def with_cameras(params: Any, cameras: Camera | Sequence[Camera]) -> Any:
    """Params for images whose cameras differ in their numbers: of one augmentation, or the list of a container.

    `params = aug.forward_parameters(images.shape)`, then `aug(images, params=with_cameras(params, cameras))`.

    Args:
        params: they stay as they are.
        cameras: a batch, or a list, that differ only in their numbers. Of a video, one for each clip or each frame.

    Raises:
        ValueError: cameras of another kind or number, or no camera augmentation among the params.
        TypeError: they are no cameras.
    """
    if isinstance(cameras, (list, tuple)) and all(isinstance(camera, Camera) for camera in cameras):
        cameras = collate_cameras(cameras)
    if not isinstance(cameras, Camera) or cameras.is_mixed:
        got = [type(one).__name__ for one in cameras] if isinstance(cameras, list) else type(cameras).__name__
        raise TypeError(
            "with_cameras: cameras must be a Camera with a batch dim, or single ones of one model and size, in a list; "
            f"got {got}"
        )
    found: list[Params] = []

    def changed(params: Any) -> Any:
        if isinstance(params, dict):
            found.extend([params] if _KIND in params else [])
            return {**params, **_numbers(params, cameras)} if _KIND in params else params
        return [p._replace(data=changed(p.data)) if isinstance(p, ParamItem) and p.data else p for p in params]

    result = changed(params)
    if not found:
        raise ValueError(f"with_cameras: params must be those of a camera augmentation; got {shown(params)}")
    return result


def _numbers(params: Params, cameras: Camera) -> dict[str, Tensor]:
    kinds, kind, batch = params[_KIND], _kind(cameras), tuple(cameras.batch_shape)
    if len(kinds) and kinds[0].tolist() != kind:
        need, got = (f"{k[1]} coefficients and image_size {tuple(k[2:])}" for k in (kinds[0].tolist(), kind))
        raise ValueError(f"with_cameras: needs the augmentation's model, {need}; got {type(cameras).__name__}, {got}")
    count, clips = len(kinds), int(params.get("video_batch_size", len(kinds)))
    if batch not in ((), (1,), (count,), (clips,)):
        raise ValueError(f"with_cameras: the params are for {count} samples; got cameras of batch dims {batch}")
    frames = count // clips if batch == (clips,) and clips else 1
    numbers = (t.expand(*(batch or (1,)), -1) for t in (cameras.intrinsics, cameras.distortion))
    rows = (t.repeat_interleave(frames, 0).expand(count, -1) for t in numbers)
    return dict(zip(_NUMBERS, rows, strict=True))


def _kind(camera: Camera) -> list[int]:
    """Model, number of coefficients and image_size as integers, for params hold tensors only."""
    return [
        zlib.crc32(type_before_parametrizations(camera).__name__.encode()),
        camera.distortion.shape[-1],
        *(camera.image_size or (0, 0)),
    ]
