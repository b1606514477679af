"""Moving a sample: all of its fields, checked at the door, by one change of cameras."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from camtorch.augment import fields as field_kinds
from camtorch.augment.cameras import alone, on_device, singles
from camtorch.augment.change import Change
from camtorch.augment.fields import KEEP, KINDS
from camtorch.camera import Camera

Sample = dict[str, object]


def without_graph_in_workers(method: Callable) -> Callable:
    """A method that records no graph in a worker of a DataLoader, which tensors of a graph cannot leave."""

    @functools.wraps(method)
    def wrapped(*args, **kwargs):
        if torch.compiler.is_compiling() or get_worker_info() is None:
            return method(*args, **kwargs)
        with torch.no_grad():
            return method(*args, **kwargs)

    return wrapped


class SampleTransform(nn.Module):
    """Moves all fields of a sample by one change of cameras. See `Augmentation` and `FaceNormalizer`."""

    def __init__(self, camera: Camera | None, fields: Mapping[str, str] | None, mask_fill: float, valid_mask: bool):
        super().__init__()
        self._name = type(self).__name__
        if camera is not None and not isinstance(camera, Camera):
            raise TypeError(f"{self._name}: camera must be a Camera; got {type(camera).__name__}")
        self.camera = camera
        self.fields = dict(fields or {})
        wrong = {k: v for k, v in self.fields.items() if v not in (*KINDS, KEEP)}
        if wrong:
            raise ValueError(f"{self._name}: fields maps names to {', '.join(KINDS)} or {KEEP}; got {wrong}")
        self.mask_fill, self.valid_mask = float(mask_fill), bool(valid_mask)

    # -- moving

    def _given(self, sample: Mapping[str, object] | None, fields: Mapping[str, object]) -> Sample:
        """The sample and the keyword arguments as one dict."""
        if sample is not None and not isinstance(sample, Mapping):
            got = type(sample).__name__
            raise TypeError(f"{self._name} takes a dict of fields, or keywords, as in image=...; got {got}")
        return {**(sample or {}), **fields}

    def _sorted(self, sample: Sample) -> dict[str, tuple[str, object]]:
        """Name -> (kind, value) of the fields that move."""
        named = {}
        for name, value in sample.items():
            if name in field_kinds.OWN or value is None:
                continue
            found = field_kinds.kind_of(name, value, self.fields, self._name)
            if found is not None:
                if not isinstance(value, (list, tuple)):
                    value = field_kinds.as_tensor(value, name, found, self._name)
                named[name] = (found, value)
        return named

    def _batch(self, sample: Sample) -> tuple[dict, bool, int, Camera | list[Camera]]:
        """The fields that move, all with a batch dim; whether the sample had one; its size, and its cameras."""
        camera = sample.get("camera")
        camera = self.camera if camera is None else camera
        if camera is None:
            raise ValueError(f"{self._name}: no camera; give one as sample['camera'] or {self._name}(camera=...)")
        named = self._sorted(sample)
        if not named:
            raise ValueError(f"{self._name}: the sample has no field that moves; known are {', '.join(KINDS)}")
        batched = field_kinds.is_batch(named, camera)
        count = None
        for name, (found, value) in named.items():
            if isinstance(value, (list, tuple)):
                items = [field_kinds.as_tensor(v, f"{name}[{i}]", found, self._name) for i, v in enumerate(value)]
                for i, item in enumerate(items):
                    field_kinds.check(found, f"{name}[{i}]", item, False, self._name)
                value, n = items, len(items)
            else:
                field_kinds.check(found, name, value, batched, self._name)
                value = value if batched else value.unsqueeze(0)
                n = len(value)
            named[name] = (found, value)
            if count is not None and n != count:
                raise ValueError(f"{self._name}: {name} is of {n} samples, other fields are of {count}")
            count = n
        self._check_cameras(camera, count, named)
        values = [v for _, value in named.values() for v in (value if isinstance(value, list) else [value])]
        device = values[0].device if values else torch.device("cpu")
        many = isinstance(camera, (list, tuple))
        camera = [on_device(one, device) for one in camera] if many else on_device(alone(camera), device)
        return named, batched, count, camera

    def _check_cameras(self, camera, count: int, named: Mapping) -> None:
        cameras = list(camera) if isinstance(camera, (list, tuple)) else [camera]
        if not cameras:
            raise ValueError(f"{self._name}: an empty list of cameras; no samples have one camera, too")
        if isinstance(camera, (list, tuple)) and len(cameras) != count:
            raise ValueError(f"{self._name}: {len(cameras)} cameras for {count} samples")
        for i, one in enumerate(cameras):
            name = f"camera[{i}]" if isinstance(camera, (list, tuple)) else "camera"
            if not isinstance(one, Camera):
                raise TypeError(f"{self._name}: {name} must be a Camera; got {type(one).__name__}")
            if one.image_size is None:
                raise ValueError(f"{self._name}: {name} needs an image_size=(height, width)")
            shape = tuple(one.batch_shape)
            if shape not in ((), (1,), (count,)) or (shape and len(cameras) > 1):
                raise ValueError(f"{self._name}: {name} has batch dims {shape}, the samples are {count}")
            for field, (found, value) in named.items():
                # one for each sample where there are as many cameras
                images = value if isinstance(value, list) else [value]
                images = images[i : i + 1] if isinstance(value, list) and len(cameras) > 1 else images
                for size in {tuple(image.shape[-2:]) for image in images if found in field_kinds.PICTURES}:
                    if size != one.image_size:
                        raise ValueError(
                            f"{self._name}: {field} is {size} (height, width), but the image_size of {name} is "
                            f"{one.image_size}. camera.resize, .crop and .pad give the camera of an edited image"
                        )

    def _moved(self, sample: Sample, named: Mapping, batched: bool, change: Change) -> Sample:
        """The sample after a change; `named` holds its fields as a batch."""
        moved = dict(sample)
        options = {"mask_fill": self.mask_fill}

        def put(name: str, value) -> None:
            moved[name] = value if batched or isinstance(value, list) else value.squeeze(0)

        for name, (found, value) in named.items():
            if isinstance(value, list):
                results = [self._one(change.row(i), found, v.unsqueeze(0), options) for i, v in enumerate(value)]
                result, valid = ([r[j] for r in results] for j in (0, 1))
                put(name, [r.squeeze(0) for r in result])
                valid = None if not valid or valid[0] is None else [v.squeeze(0) for v in valid]
            else:
                result, valid = self._one(change, found, value, options)
                put(name, result)
            if valid is not None:
                self._put_valid(put, sample, f"{name}_valid", valid, batched)
        before = sample.get("image_valid")
        if before is not None:
            before = torch.as_tensor(before) != 0
            before = before if batched else before.unsqueeze(0)
            if before.ndim != 4 or len(before) != change.count:
                raise ValueError(f"{self._name}: image_valid must be (B, 1, H, W); got shape {tuple(before.shape)}")
            before = change.labels(before)
        if self.valid_mask and any(found == "image" for found, _ in named.values()):
            before = change.valid_mask() if before is None else before & change.valid_mask()
        if before is not None:
            put("image_valid", before)
        if "rotation" not in named:
            put("rotation", change.rotation)
        target = change.target
        if isinstance(target, Camera) and not batched:
            target = singles(target)[0]
        moved["camera"] = target
        return moved

    @staticmethod
    def _one(change: Change, found: str, value: Tensor, options: Mapping) -> tuple[Tensor, Tensor | None]:
        result = field_kinds.moves(found, value)(change, value, options)
        result, valid = result if isinstance(result, tuple) else (result, None)
        # geometry is computed in float32 at least; what came in half precision goes out in it
        return result.to(value.dtype) if value.is_floating_point() else result, valid

    def _put_valid(self, put: Callable, sample: Sample, name: str, valid, batched: bool) -> None:
        """Put the validity of a field, which stays invalid where it was; any number but zero is valid, as in COCO."""
        before = sample.get(name)
        if before is not None:
            many = isinstance(valid, list)
            before = [torch.as_tensor(b) != 0 for b in (before if many else [before])]
            now = valid if many else [valid if batched else valid.squeeze(0)]
            if [b.shape for b in before] != [v.shape for v in now]:
                shapes = ", ".join(str(tuple(v.shape)) for v in now)
                raise ValueError(f"{self._name}: {name} must be {shapes}; got {[tuple(b.shape) for b in before]}")
            now = [v & b.to(v.device) for v, b in zip(now, before, strict=True)]
            valid = now if many else now[0] if batched else now[0].unsqueeze(0)
        put(name, valid)
