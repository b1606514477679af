"""The data normalisation of gaze estimation, for any lens."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Unpack

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.change import Change, one_or_batch
from camtorch.augment.fields import PLACE
from camtorch.augment.matrices import Guess
from camtorch.augment.part import Part
from camtorch.augment.sample import Sample, SampleOptions, SampleTransform, on_samples
from camtorch.cameras.camera import Camera
from camtorch.evaluate.tensors import known_false
from camtorch.poses.rotations import check_rotation, rotation_matrix
from camtorch.values.arguments import as_known_size, as_number, no_camera, shown
from camtorch.values.module import typed_as
from camtorch.warp.views import pinhole
from camtorch.warp.warp import Warp

_ODD_RATIO = 50.0  # times the distance: faces so much nearer or farther mean that units differ


class FaceNormalizer(SampleTransform):
    """A virtual pinhole camera that looks at the face, upright with it, as if from one distance.

    With c the face's centre and h the x axis of the head, both seen by the camera: z = c / |c|, y = z x h (unit),
    x = y x z, and R holds x, y, z as rows. The focal length is `focal` |c| / `distance`, so that the face is as large
    as if it were at `distance`; with S = diag(1, 1, distance / |c|) this is the published homography
    W = C S R K^-1, and it holds for every lens. Gaze and poses are turned by R and never scaled: that is the modified
    normalisation of Zhang, Sugano, Bulling: Revisiting Data Normalization for Appearance-Based Gaze Estimation, ETRA
    2018, as in ETH-XGaze. 3D points turn and keep their true distances; their z times `scale` is
    that of the published normalised space.

    Args:
        camera: for samples that hold none.
        focal: focal length of the virtual camera at `distance`, in pixels.
        distance: distance of the face in the normalised image, in the unit of the poses.
        image_size: (height, width) of the normalised image.
        axis: (x, y) pixel of the face's centre; default (width / 2, height / 2), as published.
        mode, padding_mode, fill, antialias, tolerance: see `Warp`.
        fields, mask_fill, valid_mask: see `Augmentation`.

    The defaults are those of ETH-XGaze, with distances in millimetres; poses in metres need `distance=0.6`.

    A sample has the fields of an `Augmentation`, among them `head_pose` (B, 4, 4), or `rvec` and `tvec`, camera from
    head, with the head's x axis from its right eye to its left, along the image's x axis if the face looks into the
    camera; a pose by another name has its kind in `fields`. The face's centre is `face_center` (B, 3) if the sample
    has it, else the origin of the head. The result also
    holds `scale` (B,), distance / |c|, `camera` and `rotation`.

        >>> normalize = ct.augment.FaceNormalizer(camera=ct.Pinhole([900.0, 900, 319.5, 239.5], image_size=(480, 640)))
        >>> pose = {"rvec": torch.zeros(3), "tvec": torch.tensor([0.0, 0.0, 600.0])}
        >>> normalize(image=torch.zeros(3, 480, 640), **pose)["image"].shape
        torch.Size([3, 224, 224])
    """

    _own_fields: ClassVar[Sequence[str]] = (*SampleTransform._own_fields, "scale", "source_camera", "source_rotation")
    focal: float
    distance: float
    image_size: tuple[int, int]
    axis: tuple[float, ...]

    def __init__(
        self,
        *,
        focal: float = 960.0,
        distance: float = 600.0,
        image_size: Sequence[int] = (224, 224),
        axis: tuple[float, float] | None = None,
        **options: Unpack[SampleOptions],
    ):
        super().__init__(**options)
        self.focal, self.distance = as_number(focal, "focal", self._name), as_number(distance, "distance", self._name)
        for name, value in (("focal", self.focal), ("distance", self.distance)):
            if not 0 < value < float("inf"):
                raise ValueError(f"{self._name}: {name} must be positive; got {value!r}")
        height, width = self.image_size = as_known_size(image_size, self._name)
        self.axis = (width / 2, height / 2)
        if axis is not None:
            given = tuple(axis) if isinstance(axis, (Sequence, Tensor, np.ndarray)) else ()
            if len(given) != 2:
                raise TypeError(f"{self._name}: axis must be a pixel (u, v); got {shown(axis)}")
            self.axis = as_number(given[0], "axis", self._name), as_number(given[1], "axis", self._name)

    def change(self, camera: Camera, head_rotation: Tensor, face_centre: Tensor) -> Change:
        """Return the change from `camera` to the virtual camera.

        Args:
            camera: without batch dims, or with (B,).
            head_rotation: (B, 3, 3), camera from head.
            face_centre: (B, 3), in the camera's frame.

        Raises:
            ValueError: If a face is at the camera, or seen along the head's x axis.
        """
        device = camera.intrinsics.device
        dtype = torch.promote_types(camera.intrinsics.dtype, torch.float32)
        check_rotation(head_rotation, "the head's rotation", self._name)
        camera = one_or_batch(camera)
        centre, across = face_centre.to(device, dtype), head_rotation[..., 0].to(device, dtype)
        distance = centre.norm(dim=-1, keepdim=True)
        forward = centre / distance
        down = torch.linalg.cross(forward, across)
        size = down.norm(dim=-1, keepdim=True)
        usable = torch.isfinite(size) & (size > 1e-6)
        if known_false(usable):
            row = int((~usable).flatten().nonzero()[0])
            raise ValueError(
                f"{self._name}: faces must be finite, off the camera and off the head's x axis; got sample {row} with "
                f"the centre {centre[row].tolist()}"
            )
        scale = self.distance / distance.detach()
        if known_false((scale < _ODD_RATIO) & (scale > 1 / _ODD_RATIO)):
            at = ", ".join(f"{d:.4g}" for d in distance.flatten().tolist())
            raise ValueError(
                f"{self._name}: distance must be in the unit of the poses; got {self.distance:g} for faces at {at}. "
                "Pass distance=0.6 for poses in metres, distance=600 for millimetres"
            )
        down = down / size
        rotation = torch.stack((torch.linalg.cross(down, forward), down, forward), -2)
        focal = (self.focal / self.distance * distance).expand(-1, 2)
        intrinsics = torch.cat((focal, focal.new_tensor(self.axis).expand(len(focal), 2)), -1)
        target = pinhole(intrinsics, self.image_size)
        return Change(len(centre), [Part(camera, Warp(camera, target, rotation, **self.options))])

    @on_samples
    def forward(self, sample: Mapping[str, Any] | None = None, **fields: Any) -> Sample:
        """Normalise a sample, a dict or keyword arguments.

        Raises:
            ValueError: If there is no head pose, and as `Augmentation`.
        """
        sample = self._given(sample, fields)
        batch = self._batch(sample)
        camera = batch.camera
        given = sample.get("camera")
        if not (given is None or isinstance(given, (Camera, Guess))):
            raise TypeError(f"{self._name}: camera must be a Camera; got {no_camera(given)}")
        named = batch.rows()
        values = {name: value for name, (_, value) in named.items()}
        found = self._head(values)
        if found is None:  # by another name: the first field of each kind
            found = self._head({**dict(reversed(named.values())), **values})
        if found is None:
            raise ValueError(f"{self._name}: a sample must have head_pose, or rvec and tvec; got {', '.join(sample)}")
        head, centre = found
        moved = self._moved(sample, batch, self.change(camera, head, centre))
        moved.pop(PLACE, None)
        scale = self.distance / centre.norm(dim=-1)
        moved["scale"] = scale if batch.plan.batched else scale.squeeze(0)
        moved["source_camera"] = camera.clone()
        if sample.get("rotation") is not None:  # by earlier augmentations
            moved["source_rotation"] = sample["rotation"].clone()
        return moved

    def _head(self, values: Mapping[str, Any]) -> tuple[Tensor, Tensor] | None:
        """Return the head's rotation (B, 3, 3) and the face's centre (B, 3) of values by name; None without a pose."""
        listed = [n for n in ("head_pose", "rvec", "tvec", "face_center") if isinstance(values.get(n), list)]
        if listed:
            raise TypeError(f"{self._name}: {', '.join(listed)} must be one tensor for all samples; got a list")
        if "head_pose" in values:
            pose = values["head_pose"]
            return pose[..., :3, :3], values.get("face_center", pose[..., :3, 3])
        if "rvec" in values and ("tvec" in values or "face_center" in values):
            return rotation_matrix(values["rvec"]), values.get("face_center", values.get("tvec"))
        return None

    @on_samples
    def inverse(self, sample: Mapping[str, Any] | None = None, **fields: Any) -> Sample:
        """Move predictions on a normalised sample back to the frame and the image of its source camera.

        The sample has `camera`, `rotation` and `source_camera` as returned (and `source_rotation`, after other
        augmentations), and any other fields: gaze, keypoints, 3D points, images.
        """
        sample = self._given(sample, fields)
        missing = [name for name in ("camera", "rotation", "source_camera") if sample.get(name) is None]
        if missing:
            raise ValueError(f"{self._name}: a sample to move back must have {', '.join(missing)}; got none")
        normal, source, rotation = (sample.pop(name) for name in ("camera", "source_camera", "rotation"))
        batch = self._batch(sample, normal, predicted=True)
        before = sample.get("source_rotation")
        rotation = rotation if before is None else rotation @ before.mT
        rotation = rotation if rotation.ndim == 3 else rotation.unsqueeze(0)
        warp = Warp(source, normal, rotation.to(normal.intrinsics), **self.options)
        moved = self._moved(sample, batch, Change(batch.plan.count, [Part(source, warp)]).inverse())
        del moved["rotation"]
        moved.pop(PLACE, None)
        if before is not None:
            moved["rotation"] = moved.pop("source_rotation")
        return moved

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def extra_repr(self) -> str:
        options = {"focal": self.focal, "distance": self.distance, "image_size": self.image_size, **self.options}
        return ", ".join(f"{name}={value!r}" for name, value in options.items())
