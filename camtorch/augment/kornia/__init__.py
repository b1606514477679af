"""Augmentations for kornia, in AugmentationSequential and VideoSequential, for every data key, next to kornia's own.

Fields of a dict (`data_keys=None`) that kornia does not know move by their names, as in `Augmentation`, and are
returned with their validity; a dict gets the `crop_place` of `BoxCrop(place=True)` too, with the `rotation` and the
`camera` from which it follows. Numbers under an unknown name that might be geometry raise an error; `fields={"lidar":
"points", "logits": "keep"}` of the augmentation gives their kinds. A "camera" is the camera of the images; the result
holds the new one. Next to such fields, kornia's own augmentations that move pixels raise an error, as they would not
move the fields.

`import camtorch` does not load this module, nor kornia.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, cast

import torch
from kornia.augmentation import GeometricAugmentationBase2D
from kornia.constants import Resample, SamplePadding
from kornia.geometry.boxes import Boxes
from kornia.geometry.keypoints import Keypoints
from torch import Tensor

from camtorch.augment import box_crop, compose, edits, random_camera
from camtorch.augment.augmentation import Augmentation
from camtorch.augment.cameras import check_single, known_camera
from camtorch.augment.change import Change
from camtorch.augment.front_end import FrontEnd, check_front_end
from camtorch.augment.kornia.containers import wrap_containers
from camtorch.augment.kornia.params import KIND, Params, camera_with_params, kind_of_camera, with_boxes, with_cameras
from camtorch.augment.kornia.private import input_metadata_only, transform_output_shape
from camtorch.augment.matrices import Guess
from camtorch.augment.part import Part
from camtorch.augment.sample import detached, on_samples
from camtorch.cameras.camera import Camera
from camtorch.cameras.mixed import kind
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import known_some
from camtorch.models import Pinhole
from camtorch.optics.radial_inverse import precise
from camtorch.values.arguments import as_part, no_camera
from camtorch.values.dtypes import narrow, widen
from camtorch.warp.affine import AffineWarp
from camtorch.warp.options import Mode

Flags: TypeAlias = dict[str, Any]
_BACK = "back"  # the flag of moving back, among those of kornia


class CameraAugmentation(FrontEnd, GeometricAugmentationBase2D):
    r"""An augmentation of camtorch as one of kornia: images, masks, keypoints and boxes move by the same warps.

    The same seed gives the same warps as calling the augmentation itself on a sample.

    Args:
        augmentation: a `camtorch.augment.Augmentation`, for example a `RandomCamera`.
        camera: the Camera of the images, copied without gradients; default: the augmentation's. `with_cameras` gives
            every sample its own, which may learn. A number is for photographs of unknown cameras, see `Augmentation`;
            a `K` (B, 3, 3) in a dict, the matrix of the image, comes before it.
        p, p_batch: probability that a sample, and a batch, is augmented; the default of p is the augmentation's.
        same_on_batch: the same draw for the whole batch; default: as in the augmentation.
        keepdim: whether images without batch dim stay without.

    Convention:
        - pixel coordinates are ``(x, y)`` at integer pixel centres, as in all of kornia and camtorch.
          ``align_corners`` has no effect; a call can override ``resample`` and ``padding_mode``.
        - keypoints keep their count and order, except ``landmarks`` of a flip. A keypoint without a place on the new
          image becomes ``(-1, -1)``, also in all later augmentations of camtorch.
        - boxes enclose their moved outlines, which are curved, and are not clipped. A box off the new image is invalid,
          which kornia exports as zeros; it stays zeros in ``inverse``.
        - masks take the nearest value, or the augmentation's `mask_fill` for nothing, and never the colours and the
          light of the lens. ``extra_args={DataKey.MASK: {"resample": "bilinear"}}`` is for soft masks.
        - in a dict (``data_keys=None``) fields that kornia does not know move by their names, see the module.
        - ``transform_matrix`` is exact if the move is a homography: flips, sizes and crops of any lens, and turns
          between pinhole cameras. For other lenses it is NaN, also in a container that holds the augmentation.
          ``last`` and ``change(params)`` give the cameras before and after, and the rotation.
        - ``inverse`` moves everything back by the inverse warp. Pixels that left the image, or fell between its pixels,
          are lost; boxes have grown; chromatic aberration and vignetting stay.
        - params are tensors, drawn on the CPU wherever the module is. A replay is bit-identical.
    """

    augmentation: Augmentation
    camera: Camera | Guess
    _compute_matrix_lazily = True  # when it is read

    def __init__(
        self,
        augmentation: Augmentation,
        camera: Camera | float | None = None,
        *,
        p: float | None = None,
        p_batch: float = 1.0,
        same_on_batch: bool | None = None,
        keepdim: bool = False,
    ):
        name = type(self).__name__
        check_front_end(name, augmentation)
        camera = known_camera(Guess.instead(camera, name), augmentation.camera)
        if not isinstance(camera, (Camera, Guess)):
            raise TypeError(f"{name}: camera must be the Camera of the images; got {no_camera(camera)}")
        super().__init__(
            p=augmentation.p if p is None else as_part(p, "p", name, "probability"),
            p_batch=as_part(p_batch, "p_batch", name, "probability"),
            same_on_batch=augmentation.same_on_batch if same_on_batch is None else same_on_batch,
            keepdim=keepdim,
        )
        self.augmentation, self.camera = augmentation, camera
        kind_of_camera(self.camera_for((1, 1)))  # which torch.compile looks up
        self.flags: dict[str, Any] = {
            "resample": Resample.get(augmentation.options["mode"]),
            "align_corners": False,
            "padding_mode": SamplePadding.get(augmentation.options["padding_mode"]),
        }
        if isinstance(camera, Camera):
            self._set_size(check_single(name, camera, (), ". with_cameras gives every sample its own"))
        self.keypoints_valid: Tensor | None = None
        """(B, N) bool: whether the keypoints that were moved last lie on their image."""
        # of a row and of a batch: kornia moves lists of masks row by row, between labels of the whole batch
        self._memos = Kept(), Kept()

    def _set_size(self, own_size: tuple[int, int]) -> None:
        """Tell kornia the size of new images of a size."""
        self.flags.pop("size", None)
        if not self.p:
            size = own_size
        elif self.augmentation.p:
            size = self.augmentation.size_after(own_size)
        else:  # the p given to kornia applies what never applies by itself
            size = self.augmentation._size_if_applied(own_size)
        if size != own_size:
            self.flags["size"] = size

    def camera_for(self, size: Sequence[int]) -> Camera:
        """Return the camera of images of a size (height, width)."""
        return self.camera.pinhole_for((size[0], size[1])) if isinstance(self.camera, Guess) else self.camera

    def set_rng_device_and_dtype(self, device: torch.device, dtype: torch.dtype) -> None:
        """Keep draws on the CPU: a seed then draws the same on every device, and reading params needs no wait."""
        super().set_rng_device_and_dtype(torch.device("cpu"), dtype)

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Draw numbers as `Augmentation.draw` does after its gate; images must be of the camera's image_size."""
        count = batch_shape[0]
        camera = self.camera_for(batch_shape[-2:])
        self._set_size(check_single(type(self).__name__, camera, [("images", tuple(batch_shape[-2:]))]))
        if count:
            self.augmentation.tell_of_empty_images(camera)
        drawn = self.augmentation.drawn(count, 1.0, self.same_on_batch)
        del drawn["apply"]
        drawn |= {name: torch.full((count, 4), torch.nan) for name in self.augmentation.crops}
        drawn[KIND] = torch.tensor(kind_of_camera(camera)).expand(count, -1).contiguous()
        if "size" in self.flags:
            drawn["output_size"] = torch.tensor(self.flags["size"]).expand(count, -1).contiguous()
        return drawn

    def change(self, params: Params | None = None, device: torch.device | None = None) -> Change:
        """Return the change by params, by default the last: `source`, `target`, `rotation`, `points(...)` and so on."""
        params = self._params if params is None else params
        draw, camera, augmentation = self._draw_of(params), self._camera_of(params, device), self.augmentation
        inputs = [*draw.values(), camera.intrinsics, camera.distortion]
        inputs += [*augmentation.parameters(), *augmentation.buffers()]
        key = type(camera), camera.image_size, _state_key(augmentation)
        of_row, of_batch = self._memos
        memo = of_row if len(draw["apply"]) == 1 else of_batch
        return memo.unless_learning(inputs, key, lambda: augmentation.change(camera, draw))

    def _draw_of(self, params: Params) -> dict[str, Tensor]:
        """Return the draw that params hold, as `Augmentation.draw` returns one."""
        name, crops = type(self).__name__, self.augmentation.crops
        ours = *self.augmentation.ranges, *crops
        if missing := [key for key in ("batch_prob", *ours) if key not in params]:
            need, has = ", ".join(missing), ", ".join(params) or "none"
            raise ValueError(f"{name}: params must have {need}; got {has}. Call it first")
        if any(known_some(params[key].isnan()) for key in crops):
            raise ValueError(
                f"{name}: params must hold boxes, as kornia passes boxes after images; got none. Use "
                "params = aug.forward_parameters(images.shape), then aug(images, params=with_boxes(params, boxes))"
            )
        return {"apply": self._gate(params), **{key: params[key] for key in ours}}

    def _camera_of(self, params: Params, device: torch.device | None) -> Camera:
        """Return the cameras of the images of params, on a device; None: on that of the known camera."""
        camera = self.camera
        if isinstance(camera, Guess):
            camera = self.camera_for(params["forward_input_shape"][-2:].tolist())
        return camera_with_params(params, camera, device)

    @property
    def last(self) -> Change | None:
        """The change of the last call."""
        return self.change() if self._params else None

    # The methods that follow are those by which kornia moves each kind of value. Its own move labels, and everything
    # back, by a matrix, which most moves of lenses are none of; here all move by the change, and back by its inverse.

    @on_samples
    def _move(
        self, value: Tensor, params: Params, flags: Flags, move: Callable[[Change, Tensor], Any]
    ) -> tuple[Tensor, Any]:
        """Return `move(change, value)` in the value's dtype; positions in half precision would be off by pixels."""
        with torch.autocast(value.device.type, enabled=False):
            change = self.change(params, value.device)
            if len(value) != change.count:
                raise ValueError(f"{type(self).__name__}: values must be {change.count} samples; got {len(value)}")
            moved = move(change.inverse() if _BACK in flags else change, value)
        moved, valid = moved if isinstance(moved, tuple) else (moved, None)
        moved = narrow(moved, value.dtype)
        if _BACK in flags:  # kornia blends the forward direction
            moved = self._blend_by_prob(moved, value, self._gate(params))
        return moved, valid

    def _move_rows(
        self, input: Any, dims: int, params: Params, flags: Flags, move: Callable[[Change, Tensor], Any]
    ) -> tuple[Any, Tensor]:
        """Move Keypoints or Boxes, with data (B, ...) of `dims` dims or without it; return which are valid, too."""
        moved, valid = self._move(input.data[(None,) * (dims - input.data.ndim)], params, flags, move)
        result = input.clone()
        result._data = moved.reshape(input.shape)
        return result, valid.reshape(input.shape[: 2 - dims])

    def apply_transform(self, input: Tensor, params: Params, flags: Flags, transform: Any = None) -> Tensor:
        options: Any = {
            "mode": Resample.get(flags["resample"]).name.lower(),
            "padding_mode": SamplePadding.get(flags["padding_mode"]).name.lower(),
        }
        return self._move(input, params, flags, lambda change, images: change.images(images, **options))[0]

    def apply_transform_mask(self, input: Tensor, params: Params, flags: Flags, transform: Any = None) -> Tensor:
        fill = self.augmentation.mask_fill
        mode = cast("Mode", Resample.get(flags["resample"]).name.lower())
        return self._move(input, params, flags, lambda change, masks: change.labels(masks, fill, mode))[0]

    def apply_transform_keypoint(self, input: Keypoints, params: Params, flags: Flags, transform: Any = None) -> Any:
        def move(change: Change, pixels: Tensor) -> tuple[Tensor, Tensor]:
            placed = torch.where((pixels == -1).all(-1, keepdim=True), torch.nan, pixels)
            moved = self.augmentation.moved_by(change, {"keypoints": placed}, predicted=True)
            return torch.where(moved["keypoints"].isnan(), -1.0, moved["keypoints"]), moved["keypoints_valid"]

        result, self.keypoints_valid = self._move_rows(input, 3, params, flags, move)
        return result

    def apply_transform_box(self, input: Boxes, params: Params, flags: Flags, transform: Any = None) -> Boxes:
        result: Boxes
        result, seen = self._move_rows(input, 4, params, flags, lambda change, c: change.quadrilaterals(widen(c)))
        result._valid = result._valid & seen
        return result

    def inverse_inputs(self, input: Tensor, params: Params, flags: Flags, transform: Any = None, **more: Any) -> Tensor:
        return self.apply_transform(self.transform_tensor(input), params, {**flags, **more, _BACK: True})

    def inverse_masks(self, input: Tensor, params: Params, flags: Flags, transform: Any = None, **more: Any) -> Tensor:
        shape = params["forward_input_shape"]
        flags = {**flags, "resample": Resample.NEAREST, **more, _BACK: True}
        rows = self.transform_tensor(input, shape=shape, match_channel=False)
        moved = self.apply_transform_mask(rows, params, flags)
        return transform_output_shape(moved, input.shape, reference_shape=shape) if self.keepdim else moved

    def inverse_keypoints(self, input: Any, params: Params, flags: Flags, transform: Any = None, **_: Any) -> Any:
        return self.apply_transform_keypoint(input, params, {_BACK: True})

    def inverse_boxes(self, input: Any, params: Params, flags: Flags, transform: Any = None, **_: Any) -> Boxes:
        return self.apply_transform_box(input, params, {_BACK: True})

    @input_metadata_only
    def compute_transformation(self, input: Tensor, params: Params, flags: Flags) -> Tensor:
        """Return (B, 3, 3): the homographies by which pixels move, and NaN for moves that are none."""
        still = torch.eye(3, device=input.device, dtype=input.dtype).expand(len(input), 3, 3)
        return self._move(still, params, {}, lambda change, rows: change.each(rows, _homographies))[0]

    def compute_inverse_transformation(self, transform: Tensor) -> Tensor:
        return narrow(torch.linalg.inv_ex(widen(transform))[0], transform.dtype)  # NaN stays, without an error

    def __getstate__(self) -> dict[str, Any]:
        # params of a graph could be neither copied nor pickled
        return cast("dict[str, Any]", detached(self.__dict__.copy()))

    def __repr__(self) -> str:
        ranges = "".join(f"{name}={interval}, " for name, interval in self.augmentation.ranges.items())
        return super().__repr__().replace("(", f"({ranges}", 1)


def _state_key(augmentation: Augmentation) -> tuple[Any, ...]:
    """Return what, but for tensors, changes follow from: another key if anything of it or of its parts was set."""
    if torch.compiler.is_compiling():  # nothing is kept then, and compilers know no `str` of a list
        return ()
    states = [vars(part) for part in augmentation.modules()]
    revisions = [getattr(state.get("_calls"), "revision", None) for state in states]  # with public attributes
    return *revisions, str([[state.get(name) for name in ("options", "ranges", "image_size")] for state in states])


def _homographies(part: Part, rows: Tensor) -> Tensor:
    """Return the homographies (n, 3, 3) from pixels to new pixels, as many as `rows`; NaN for moves that are none."""
    motion = part.motion
    if isinstance(motion, AffineWarp):
        last = motion.matrix.new_tensor([0.0, 0.0, 1.0]).expand(*motion.matrix.shape[:-2], 1, 3)
        return torch.cat((motion.matrix, last), -2).expand_as(rows)
    before, after, turn = part.camera, part.target, part.rotation
    plain = motion is not None and motion.moves_by_cameras  # others move by depth or by row
    if not plain or kind(before)[:2] != kind(after)[:2] or not (turn is None or isinstance(after, Pinhole)):
        return torch.full_like(rows, torch.nan)
    turned = torch.linalg.inv_ex(precise(before.K))[0]
    turned = turned if turn is None else turn.to(turned) @ turned
    lens = (after.distortion == before.distortion).all(-1)[..., None, None]
    return torch.where(lens, precise(after.K) @ turned, torch.nan).expand_as(rows)


class _Random(CameraAugmentation):
    """An augmentation of camtorch under its own name, made from its own arguments."""

    _wraps: Callable[..., Augmentation]

    def __init__(self, *given: Any, camera: Camera | float | None = None, **options: Any):
        name = type(self).__name__
        is_guess = isinstance(camera, (int, float)) and not isinstance(camera, bool)  # by its name alone
        if camera is None and given:
            camera, given = given[0], given[1:]
        if not isinstance(camera, Camera) and not is_guess:
            preset, got = (f", {camera!r}", repr(camera)) if isinstance(camera, str) else ("", type(camera).__name__)
            raise TypeError(
                f"{name}: camera must be the Camera of the images and comes first: {name}(camera{preset}); got {got}"
            )
        of_kornia = {key: options.pop(key) for key in ("p", "p_batch", "same_on_batch", "keepdim") if key in options}
        super().__init__(self._wraps(*given, **options), camera, **of_kornia)


def _named(wraps: type[Augmentation]) -> type[_Random]:
    """Return a class for kornia, with the name of an augmentation."""
    name, first = wraps.__name__, (wraps.__doc__ or "").partition("\n")[0]
    text = f"""`camtorch.augment.{name}` for kornia. {first}

    Args:
        camera: the camera of the images.
        given, options: those of `camtorch.augment.{name}`, after the camera, or by name.
        p, p_batch, same_on_batch, keepdim: see `CameraAugmentation`.

    Convention:
        see `CameraAugmentation`; yaw, pitch and roll are degrees by which the camera turns, not the image.
    """
    return type(name, (_Random,), {"_wraps": wraps, "__doc__": text, "__module__": __name__})


RandomMount: type[_Random] = _named(random_camera.RandomMount)
RandomLens: type[_Random] = _named(random_camera.RandomLens)
RandomCamera: type[_Random] = _named(random_camera.RandomCamera)
BoxCrop: type[_Random] = _named(box_crop.BoxCrop)
Compose: type[_Random] = _named(compose.Compose)
RandomResizedCrop: type[_Random] = _named(edits.RandomResizedCrop)
RandomCrop: type[_Random] = _named(edits.RandomCrop)
CenterCrop: type[_Random] = _named(edits.CenterCrop)
Resize: type[_Random] = _named(edits.Resize)
Pad: type[_Random] = _named(edits.Pad)
Rotate90: type[_Random] = _named(edits.Rotate90)
HorizontalFlip: type[_Random] = _named(edits.HorizontalFlip)
VerticalFlip: type[_Random] = _named(edits.VerticalFlip)
wrap_containers()
__all__ = ["CameraAugmentation", "with_boxes", "with_cameras", *(one.__name__ for one in _Random.__subclasses__())]
