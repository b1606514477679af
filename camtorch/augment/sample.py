"""The base of what moves samples: it reads one, keeps a plan for its form, and moves all fields by one change."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, ParamSpec, Self, TypedDict, TypeVar, cast

import torch
from torch import Tensor, nn

from camtorch.augment.cameras import Unknown, camera_of_images, known_camera
from camtorch.augment.change import Change, one_or_batch
from camtorch.augment.clips import Clips
from camtorch.augment.devices import remember_camera
from camtorch.augment.fields import FRONT_ENDS, IMAGES, PLACE
from camtorch.augment.landmarks import Mirroring
from camtorch.augment.matrices import Guess, check_agrees, check_targets, refuse
from camtorch.augment.names import check_kinds, refuse_unknown
from camtorch.augment.plan import Batch, SamplePlan, form_of, form_together, move
from camtorch.augment.reading import check_cameras, check_shapes, check_values, is_batch, moving
from camtorch.cameras.camera import Camera
from camtorch.evaluate.door import pytree
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import are_free, in_worker, is_unknown
from camtorch.native.library import warn_if_missing
from camtorch.values.arguments import as_flag, as_mapping, as_number, check_devices, no_camera, shown
from camtorch.values.keywords import check_arguments
from camtorch.values.module import GeometryModule
from camtorch.values.threads import on_one_thread
from camtorch.warp.options import Options, as_options

P = ParamSpec("P")
R = TypeVar("R")

Sample = dict[str, Any]
"""Name -> value; see `Augmentation`."""


class Single(dict[str, Any]):
    """A sample that is known to have no dim B, whatever the dims of its fields; other dicts are asked for theirs."""


class Frames(Single):
    """A single sample whose fields may have leading dims, as those of frames: one change moves all of them."""


class KeepsCamera:
    """The base of what keeps a copy of each `camera`, or `like`, that is set on it; the copy does not learn."""

    _name: str = ""  # in errors; empty: that of the class

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "camera":
            owner = self._name or type(self).__name__
            value = Guess.instead(value, owner)
            if isinstance(value, Guess):  # a module takes no other value for the name of one of its parts
                self.__dict__.get("_modules", {}).pop(name, None)
            elif not (value is None or isinstance(value, Camera)):
                raise TypeError(f"{owner}: camera must be a Camera; got {no_camera(value)}")
        if name in ("camera", "like") and isinstance(value, Camera):
            value = copy.deepcopy(value)
            for tensor in (*value.parameters(), *value.buffers()):
                tensor.requires_grad_(False)
            for part in value.modules():
                if not isinstance(part, GeometryModule):
                    continue
                # as buffers, which network.requires_grad_(True) leaves alone
                for key in [key for key, tensor in part._parameters.items() if tensor is not None]:
                    part.put(key, cast("Tensor", part._parameters.pop(key)).detach(), persistent=True)
        super().__setattr__(name, value)


class Calls:
    """What the calls of a transform leave for later ones. Copies and pickles are those of a transform without calls."""

    last: Change | None = None  # which `inverse` undoes
    is_first: bool = False  # whether the last sample came without a rotation
    has_looked: bool = False  # whether new images were found to be filled or not: calls warn once

    def __init__(self) -> None:
        self.revision = object()  # key of kept plans; replaced whenever a public attribute is set
        self.plans = Kept(16)  # of the last forms of samples

    def __reduce__(self) -> tuple[type[Calls], tuple[()]]:
        return Calls, ()


def on_samples(method: Callable[P, R]) -> Callable[P, R]:
    """Return a method that moves samples on one thread, and in a DataLoader's worker without a graph."""

    @on_one_thread
    @functools.wraps(method)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> Any:
        if not in_worker():
            return method(*args, **kwargs)
        with torch.no_grad():
            return detached(method(*args, **kwargs))

    return wrapped


def detached(value: Any) -> Any:
    """Return a value, also a dict or a list of them, in which no tensor and no camera has a graph."""

    def of(one: Any) -> Any:
        learns = isinstance(one, (Tensor, Camera)) and any(t.requires_grad for t in getattr(one, "tensors", (one,)))
        return one.detach() if learns else one

    return pytree.tree_map(of, value)


class SampleOptions(TypedDict, total=False):
    """The options of every transform of samples; see `Augmentation`."""

    camera: Camera | float | None
    fields: Mapping[str, str] | None
    mode: str
    padding_mode: str
    fill: float | Sequence[float]
    mask_fill: float
    valid_mask: bool
    antialias: bool | None
    tolerance: float


_SET_ON_TRANSFORMS = SampleOptions.__annotations__.keys() - {"camera"} | {"p", "same_on_batch", "min_filled"}
"""Names of options, which are set when a transform is made, or on it, and are no fields of a sample."""


def refuse_options(fields: Mapping[str, object], owner: str) -> None:
    """Raise a TypeError if an option of a transform is among the keyword arguments of a call, which are fields."""
    if not _SET_ON_TRANSFORMS.isdisjoint(fields):
        name = next(name for name in fields if name in _SET_ON_TRANSFORMS)
        how = f"Pass it to {owner}(...), or set augment.{name} = ...; a field of that name goes in a dict"
        raise TypeError(f"{owner}: {name} is an option and no field; got {name}={shown(fields[name])}. {how}")


def _option(name: str) -> Any:
    """Return the property of one of the `options`."""

    def get(transform: SampleTransform) -> Any:
        return transform.options[name]

    def put(transform: SampleTransform, value: Any) -> None:
        transform.options = transform._as_options(**{**transform.options, name: value})

    return property(get, put, doc="The option of that name.")


class SampleTransform(KeepsCamera, nn.Module):
    """The base of what moves all fields of a sample by one change of cameras, as `Augmentation` does."""

    other_words: ClassVar[Mapping[str, str]] = {}
    """Words that people try as keywords -> the keyword, for the hint of an error."""
    needs_camera: bool = True
    """Whether samples, or it, need a camera; edits do not."""
    makes_pinholes: bool = True
    """Whether pinhole cameras become pinhole cameras, as far as that is known before a draw."""
    mirroring: Mirroring | None = None
    """What changes places in a mirror; None if it never mirrors."""
    _chooses_antialias: ClassVar[bool] = False
    """Whether its warps choose what to antialias if `antialias` is None, which is False for others."""
    _own_fields: ClassVar[Sequence[str]] = ("camera", "rotation", PLACE)
    """The names of fields that come out by themselves, and to which `fields` gives no kind."""

    def __new__(cls, *args: Any, **options: Any) -> Self:
        """Check the names of arguments, which Python would only call unexpected."""
        check_arguments(cls, len(args), options)
        return super().__new__(cls)

    def __init__(
        self,
        *,
        camera: Camera | float | None = None,
        fields: Mapping[str, str] | None = None,
        mode: str = "bilinear",
        padding_mode: str = "zeros",
        fill: float | Sequence[float] = 0.0,
        mask_fill: float = 0.0,
        valid_mask: bool = False,
        antialias: bool | None = False,
        tolerance: float = 0.001,
    ):
        super().__init__()
        self._name = type(self).__name__
        self._calls = Calls()
        self.camera = camera
        self.fields: dict[str, str] = dict(as_mapping(fields, "fields", self._name, "{'lidar': 'points'}"))
        check_kinds(self.fields, self._own_fields, self._name)
        self.options: Any = self._as_options(
            mode=mode, padding_mode=padding_mode, fill=fill, antialias=antialias, tolerance=tolerance
        )
        self.mask_fill = mask_fill
        self.valid_mask = valid_mask

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "mask_fill":
            value = as_number(value, name, self._name)
        elif name == "valid_mask":
            value = as_flag(value, name, self._name)
        state = self.__dict__
        if name[:1] != "_" and "_calls" in state and state.get(name, self) is not value:
            self._calls.revision = object()
        super().__setattr__(name, value)

    def __setstate__(self, state: dict[str, Any]) -> None:
        state = dict(state)
        # before 0.5 it was one of these attributes that said to choose what to antialias
        chosen, decides = state.pop("antialias", False), state.pop("_warps_decide", False)
        options = dict(state["options"])
        if chosen is None or decides:
            options["antialias"] = None
        super().__setstate__({**state, "options": options})  # type: ignore[no-untyped-call]
        self._calls = Calls()  # which states before 0.5 lack
        self.options = self._as_options(**options)

    mode: str = _option("mode")
    padding_mode: str = _option("padding_mode")
    fill: tuple[float, ...] = _option("fill")
    antialias: bool | None = _option("antialias")
    tolerance: float = _option("tolerance")

    def _as_options(self, **options: Any) -> Options:
        """Return checked options of the warps; antialias is None only for those that choose by themselves."""
        checked = as_options(self._name, **options)
        if checked["antialias"] is None and not self._chooses_antialias:
            checked["antialias"] = False
        return checked

    def _given(self, sample: Mapping[str, object] | None, fields: Mapping[str, object]) -> Sample:
        """Return the sample and the keyword arguments as one new dict, which is a `Single` if the sample is."""
        if not (sample is None or hasattr(sample, "keys")):
            must = f"a sample must be a dict of fields, or keywords, as in image=...; got {type(sample).__name__}"
            raise TypeError(f"{self._name}: {must}. {FRONT_ENDS}")
        refuse_options(fields, self._name)
        kind = type(sample) if isinstance(sample, Single) else dict
        return kind({} if sample is None else sample, **fields)

    def _clips(self, sample: Sample, kinds: Mapping[str, str] | None = None) -> Clips | None:
        """Return the clips of a sample, if an image has the dims (B, T, C, H, W)."""
        if not isinstance(sample, Single):
            for value in sample.values():
                if getattr(value, "ndim", 0) == 5:
                    tables = self.mirroring.by_name if self.mirroring else ()
                    return Clips.of(sample, {**self.fields, **(kinds or {})}, tables, self._name)
        return None

    def _batch(
        self, sample: Sample, camera: Any = None, predicted: bool = False, kinds: Mapping[str, str] | None = None
    ) -> Batch:
        """Return what moves of a sample; the plan of its form is kept.

        camera: instead of the sample's. predicted: values come from a network, and are not checked.
        kinds: name -> kind, in addition to `fields`.
        """
        camera = known_camera(sample.get("camera") if camera is None else camera, self.camera)
        fields = {**self.fields, **kinds} if kinds else self.fields
        if camera is None or isinstance(camera, Guess):
            camera = camera_of_images(moving(sample, fields, self._name), camera, self.needs_camera, self._name)
        form = form_of(sample, camera, fields, self._calls.revision)
        plan = None if form is None else self._calls.plans.get((), form)
        if plan is not None:
            camera = one_or_batch(camera) if camera.intrinsics.ndim > 1 else camera
            batch = Batch(plan, sample, camera, checked=predicted)
        else:
            batch = self._new_batch(sample, camera, fields, predicted)
            if form is not None:
                converted = [name for name, value in batch.values.items() if value is not sample[name]]
                is_sent = batch.camera.intrinsics.device != camera.intrinsics.device
                if not converted and not is_sent:  # a plan does neither for the next sample
                    self._calls.plans((), form, lambda: batch.plan)
        if batch.plan.matrices:
            self._check_matrices(batch, sample)
        return batch

    def _new_batch(self, sample: Sample, camera: Any, fields: Mapping[str, str], predicted: bool) -> Batch:
        """Return what moves of a sample of a new form, checked."""
        named, owner = moving(sample, fields, self._name), self._name
        batched = not isinstance(sample, Single) and is_batch(named, camera)
        if not batched:
            refuse_unknown(sample, fields, owner, single=True)
        count = check_shapes(named, batched, isinstance(sample, Frames), owner)
        if not predicted:
            check_values(sample, named, self.options["mode"], owner)
        check_cameras(camera, count, named, owner)
        tensors: dict[str, Tensor] = {}
        for name, (_, value) in named.items():
            tensors |= {f"{name}[{i}]": t for i, t in enumerate(value)} if isinstance(value, list) else {name: value}
        check_devices(owner, **tensors)
        camera = one_or_batch(camera)
        device = next((t.device for t in tensors.values()), torch.device("cpu"))
        if device.type == "cpu" and are_free():
            warn_if_missing()
        if camera.intrinsics.device != device:
            given, camera = camera, camera.each(lambda t: t.to(device))
            if given.intrinsics.is_cpu and not is_unknown(given.intrinsics):
                remember_camera(camera, given)
        kinds = {name: kind for name, (kind, _) in named.items()}
        flags = dict.fromkeys(["image_valid", *(f"{name}_valid" for name, kind in kinds.items() if kind in IMAGES)])
        masks = [key for key in flags if sample.get(key) is not None or (self.valid_mask and key == "image_valid")]
        form = form_together(named, batched, masks, self.mask_fill)
        matrices = [name for name, kind in kinds.items() if kind == "K"]
        plan = SamplePlan(kinds, batched, count, matrices, masks, self.mask_fill, form)
        return Batch(plan, {name: value for name, (_, value) in named.items()}, camera, checked=True)

    def _check_matrices(self, batch: Batch, sample: Sample) -> None:
        """Raise a ValueError if fields K are not the camera of a batch, or cannot be the new one's."""
        matrices = batch.plan.matrices
        if not isinstance(sample.get("camera"), (Guess, type(None))):
            of = "the camera of the sample"
        elif isinstance(self.camera, Camera):
            of = "that of the augmentation"
        else:
            of = f"that of {matrices[0]}"
        for name in matrices:
            check_agrees(name, batch.plan.rows(batch.values[name]), batch.camera, of, self._name)
            if not self.makes_pinholes:
                refuse(name, self._name)

    @on_samples
    def moved_by(
        self, change: Change, sample: Mapping[str, Any], kinds: Mapping[str, str] | None = None, predicted: bool = False
    ) -> Sample:
        """Move a sample by a change that exists, as `forward` does after its draw.

        Args:
            change: of as many samples; its `source` are their cameras.
            sample: the fields; a `Single` is one sample, whatever their dims.
            kinds: name -> kind, in addition to `fields`.
            predicted: whether values come from a network, and are not checked.
        """
        sample = self._given(sample, {})
        clips = self._clips(sample, kinds)
        if clips:
            return clips.restored(self.moved_by(change, clips.frames(None), kinds, predicted))
        if change.count == 1:
            named = moving(sample, {**self.fields, **(kinds or {})}, self._name).values()
            rows = {len(value) if isinstance(value, (list, tuple)) else value.shape[:1].numel() for _, value in named}
            if rows != {1} and all(kind != "image" for kind, _ in named):
                # one sample: its labels have as many rows as faces, and no image shows that there is no dim B
                sample = Single(sample)
        first = change.parts[0]
        camera = first.camera if first.rows is None else change.source
        batch = self._batch(sample, camera, predicted, kinds)
        if batch.plan.count != change.count:
            raise ValueError(
                f"{self._name}: the sample must be of {change.count}, as the change; got {batch.plan.count}"
            )
        return self._moved(sample, batch, change)

    def _moved(self, sample: Sample, batch: Batch, change: Change) -> Sample:
        """Return the sample with all that moves by a change, what is valid of it, the rotation and the camera."""
        plan, batched, mirroring = batch.plan, batch.plan.batched, self.mirroring
        if plan.matrices:
            check_targets(plan.fields, change, self._name)
        moved = dict(sample)
        together = batch.together(change)
        for name in plan.fields:
            pair = together.get(name)
            if pair is None:
                options = {"mask_fill": self.mask_fill, "lateral": mirroring.lateral if mirroring else 0}
                pair = batch.alone(name, change, options, self._name)
            moved[name], valid = pair
            if valid is not None:
                key = f"{name}_valid"
                given = sample.get(key)
                moved[key] = valid if given is None else still_valid(key, valid, given, self._name)
        for key in plan.masks:
            seen = self._seen(key, sample.get(key), plan, change)
            if seen is not None:
                moved[key] = (seen if batched else seen[0]).contiguous()
        if "rotation" not in plan.fields:
            moved["rotation"] = change.rotation_for_sample(batched)
        if mirroring is not None:
            mirroring.exchange(moved, batch.rows(), change.mirrored, batched, self._name)
        if not isinstance(change.parts[0].camera, Unknown):
            target = change.camera_for_sample(batched)
            moved["camera"] = list(target) if isinstance(sample.get("camera"), (list, tuple)) else target
        return moved

    def _seen(self, key: str, given: Any, plan: SamplePlan, change: Change) -> Tensor | None:
        """Return a mask of validity with a dim B, from the one that was given; None if neither is wanted."""
        seen = None
        if getattr(given, "ndim", 0) > 1 + plan.batched:  # a mask, not one flag for each sample
            seen = plan.rows(torch.as_tensor(given) != 0)
            if len(seen) != change.count:
                raise ValueError(
                    f"{self._name}: {key} must be of {change.count} samples, as other fields; got {len(seen)}"
                )
            seen, _ = move(change, "mask", seen, {"mask_fill": 0.0})
        if key != "image_valid" or not self.valid_mask or "image" not in plan.fields.values():
            return seen
        whole = change.valid_mask()
        return whole if seen is None else seen & (whole if seen.ndim == 4 else whole[:, 0])


def still_valid(name: str, valid: Any, given: Any, owner: str) -> Any:
    """Return the flags that come out, invalid if those given are; any number but zero is valid, as in COCO."""
    many = isinstance(valid, list)
    now = valid if many else [valid]
    before = [torch.as_tensor(b) != 0 for b in (given if many else [given])]
    if [b.shape for b in before] != [v.shape for v in now]:
        shapes = ", ".join(str(tuple(v.shape)) for v in now)
        raise ValueError(f"{owner}: {name} must be {shapes}; got {[tuple(b.shape) for b in before]}")
    now = [v & b.to(v.device) for v, b in zip(now, before, strict=True)]
    return now if many else now[0]
