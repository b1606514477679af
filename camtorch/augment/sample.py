"""A sample: the kinds of fields that it may have, how each is checked, and how all move by one change of cameras."""

from __future__ import annotations

import contextlib
import copy
import difflib
import functools
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from threading import get_ident
from typing import Any, ClassVar, ParamSpec, TypedDict, TypeVar, cast, get_args, get_origin, get_type_hints

import torch
from torch import Tensor, nn
from typing_extensions import Self, Unpack

from camtorch.augment import matrices
from camtorch.augment.change import Change, alone, as_one
from camtorch.augment.clips import Clips
from camtorch.augment.devices import remember_camera
from camtorch.augment.fields import (
    FRONT_ENDS,
    IMAGES,
    KEEP,
    KINDS,
    OWN,
    Named,
    as_tensor,
    check,
    check_values,
    field_of,
    in_range,
    is_batch,
    kind_of,
    warn_of_numbers,
)
from camtorch.augment.landmarks import Mirroring
from camtorch.augment.matrices import Guess
from camtorch.augment.place import PLACE
from camtorch.augment.plan import Batch, Plan
from camtorch.augment.sizes import check_cameras, check_one_size
from camtorch.cameras.camera import Camera
from camtorch.evaluate.door import pytree
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import are_free, in_worker, is_unknown
from camtorch.models import Pinhole
from camtorch.native.library import warn_if_missing
from camtorch.values.arguments import (
    CLOSE,
    GUESS_CAMERA,
    LEFT,
    as_flag,
    as_mapping,
    as_number,
    check_devices,
    no_camera,
)
from camtorch.values.dtypes import check_averaged
from camtorch.values.module import GeometryModule
from camtorch.values.threads import on_one_thread
from camtorch.warp.sampling import Options, as_options

P = ParamSpec("P")
R = TypeVar("R")

Sample = dict[str, Any]
"""Name -> value; see `Augmentation`."""


class Single(dict[str, Any]):
    """A sample that is known to be a single one, without batch dims."""


class Frames(Single):
    """A single sample whose values may have leading dims, as those of clips have: all of them move by one change."""


class Unknown(Pinhole):
    """The camera of images of which only the size is known, while they are edited; no sample comes out with it."""

    @classmethod
    def of(cls, size: tuple[int, int]) -> Unknown:
        return cls(torch.tensor([1.0, 1.0, 0.0, 0.0]), image_size=size).requires_grad_(False)


class KeepsCamera:
    """Keeps a copy of a `camera`, and of one that is `like` others, whenever it is set; the copy does not learn."""

    _name: str = ""  # in errors; empty: that of the class

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "camera":
            value = Guess.instead(value, self._name or type(self).__name__)
            if isinstance(value, Guess):  # a module takes no other value for the name of one of its parts
                self.__dict__.get("_modules", {}).pop(name, None)
        if name == "camera" and not (value is None or isinstance(value, (Camera, Guess))):
            raise TypeError(f"{self._name or type(self).__name__}: camera must be a Camera; got {no_camera(value)}")
        if name in ("camera", "like") and isinstance(value, Camera):
            value = copy.deepcopy(value)
            for tensor in (*value.parameters(), *value.buffers()):
                tensor.requires_grad_(False)
            for part in value.modules():  # as buffers, which network.requires_grad_(True) leaves alone
                learns = [key for key, tensor in part._parameters.items() if tensor is not None]
                for key in learns if isinstance(part, GeometryModule) else ():
                    part.put(key, cast("Tensor", part._parameters.pop(key)).detach(), persistent=True)
        super().__setattr__(name, value)


class Calls:
    """What calls leave in a transform. Copies and pickles begin anew: caches know a used one by its bytes."""

    last: Change | None = None
    is_first: bool = False  # whether the last sample came without a rotation
    warned: bool = False

    def __init__(self) -> None:
        self.revision = object()  # another one whenever a public attribute is set: results are kept by it
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


@functools.cache
def _keywords(transform: type) -> dict[str, None]:
    """Return the keywords that a class of transforms takes, also by options: those of a TypedDict, or of its base."""
    names: dict[str, None] = {}
    for owner in transform.__mro__:
        if "__init__" in vars(owner):
            own, hints = vars(owner)["__init__"], {}
            _, *parameters = inspect.signature(own).parameters.values()
            names |= dict.fromkeys(p.name for p in parameters if p.kind is not p.VAR_KEYWORD)
            if not parameters or (rest := parameters[-1].name) in names:
                break
            with contextlib.suppress(NameError):  # of what is imported for checkers alone
                hints = get_type_hints(own)
            if get_origin(hints.get(rest)) is Unpack:
                return names | dict.fromkeys(get_type_hints(get_args(hints[rest])[0]))
    return names


class SampleTransform(KeepsCamera, nn.Module):
    """Moves all fields of a sample by one change of cameras. See `Augmentation` and `FaceNormalizer`."""

    other_words: ClassVar[Mapping[str, str]] = {}
    """Words that people try as keywords -> the keyword, for the hint of an error."""

    def __new__(cls, *args: Any, **options: Any) -> Self:
        """Check the names of arguments, which Python would only call unexpected."""
        if word := next((word for word in options if word not in _keywords(cls)), None):  # type: ignore[arg-type]
            raise TypeError(f"{cls.__name__}: unknown keyword {word!r}; {cls._meant(word)}. {LEFT}")
        if args:
            _, *own = (p for p in inspect.signature(cls.__init__).parameters.values() if p.kind is not p.VAR_KEYWORD)
            most = sum(p.kind is p.POSITIONAL_OR_KEYWORD for p in own)
            if len(args) > most and all(p.kind is not p.VAR_POSITIONAL for p in own):
                got = f"{len(args)} were given. By name: {cls.__name__}({', '.join(f'{p.name}=...' for p in own)})"
                raise TypeError(f"{cls.__name__}: at most {most} arguments may go without a name; {got}")
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
        if wrong := {k: v for k, v in self.fields.items() if v not in (*KINDS, KEEP)}:
            raise ValueError(f"{self._name}: fields must map names to {', '.join(KINDS)} or {KEEP}; got {wrong}")
        self.options: Options = as_options(self._name, mode, padding_mode, fill, antialias, tolerance)
        self.antialias = antialias
        self.mask_fill: float = as_number(mask_fill, "mask_fill", self._name)
        self.valid_mask: bool = as_flag(valid_mask, "valid_mask", self._name)

    @classmethod
    def _meant(cls, word: str) -> str:
        """Return the keyword that somebody may have meant, and all that are known."""
        known = [*_keywords(cls)]  # type: ignore[arg-type]  # a class can be hashed
        close = difflib.get_close_matches(word, [*known, *cls.other_words], 1, CLOSE)
        meant = f"did you mean {cls.other_words.get(close[0], close[0])!r}? Known" if close else "known"
        kin = (one for base in cls.__mro__[1:-2] for one in (base, *base.__subclasses__()))
        has = next((one.__name__ for one in kin if word in _keywords(one)), None)
        return f"{meant} are {', '.join(known)}" + (f". {has} has it" if has else "")

    def __setattr__(self, name: str, value: Any) -> None:
        state = self.__dict__
        if name[:1] != "_" and "_calls" in state and state.get(name, self) is not value:
            self._calls.revision = object()
        super().__setattr__(name, value)

    def __setstate__(self, state: dict[str, Any]) -> None:
        if "antialias" in state:  # an attribute before 0.5
            state["_warps_decide"] = state.pop("antialias") is None
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._calls = Calls()  # which states before 0.5 lack

    _warps_decide: bool = False  # whether `antialias` is None

    @property
    def antialias(self) -> bool | None:
        """The option of that name; None if each warp decides."""
        return None if self._warps_decide else self.options["antialias"]

    @antialias.setter
    def antialias(self, value: bool | None) -> None:
        self._warps_decide = value is None
        self.options["antialias"] = value is not None and as_flag(value, "antialias", self._name)

    mirroring: Mirroring | None = None  # what changes places where an augmentation mirrors; None: it never does
    needs_camera: bool = True  # whether samples, or it, need a camera; edits do not

    makes_pinholes: bool = True  # whether a pinhole camera becomes one, as far as that is known before a draw

    def _camera_of(self, named: Named, guess: Guess | None) -> Camera:
        """Return the camera of a sample that has none, nor the augmentation: by K, guessed, or unknown."""
        how = f"give one as sample['camera'] or {self._name}(camera=...)"
        guessed = f"camera=60, degrees across, takes pinholes for photographs of unknown cameras; {GUESS_CAMERA}"
        matrix = next(((name, value) for name, (kind, value) in named.items() if kind == "K"), None)
        if self.needs_camera and guess is None and matrix is None:
            raise ValueError(f"{self._name}: the sample must have a camera; got none. Please {how}. {guessed}")
        for name, (found, value) in named.items():
            first = value[0] if isinstance(value, list) and value else value
            if found == "image" and isinstance(first, Tensor) and first.shape[-1] <= 4 < first.shape[-3:][0]:
                raise ValueError(
                    f"{self._name}: {name} must have its channels first, (B, C, H, W); got {tuple(first.shape)}, which "
                    "seems to have them last. camtorch.augment.numpy takes arrays as they are; if they are first, "
                    f"{how}"
                )
            if found in IMAGES:
                items = value if isinstance(value, list) else [value]
                check_one_size(name, {(one.shape[-2], one.shape[-1]) for one in items}, self._name)
                size = items[0].shape[-2], items[0].shape[-1]
                if matrix is not None:
                    return matrices.camera_of(*matrix, size, self._name)
                return Unknown.of(size) if guess is None else guess.camera(size)
        raise ValueError(
            f"{self._name}: the sample must have an image or a camera, as labels move by the image's size; got "
            f"{', '.join(named)}. For a camera, {how}"
        )

    def _check_matrices(self, batch: Batch, sample: Sample) -> Batch:
        """Return a batch; raise a ValueError if its fields K are not its camera, or cannot be the new one's."""
        kinds = batch.plan.fields.items()
        if not isinstance(sample.get("camera"), (Guess, type(None))):
            of = "the camera of the sample"
        elif isinstance(self.camera, Camera):
            of = "that of the augmentation"
        else:  # the first matrix is the camera
            of = next((f"that of {name}" for name, kind in kinds if kind == "K"), "")
        for name, kind in kinds:
            if kind == "K":
                matrices.check_agrees(name, batch.plan.rows(batch.values[name]), batch.camera, of, self._name)
                if not self.makes_pinholes:
                    matrices.refuse(name, self._name)
        return batch

    def _given(self, sample: Mapping[str, object] | None, fields: Mapping[str, object]) -> Sample:
        """Return the sample and the keyword arguments as one dict."""
        if not (sample is None or hasattr(sample, "keys")):
            must = f"a sample must be a dict of fields, or keywords, as in image=...; got {type(sample).__name__}"
            raise TypeError(f"{self._name}: {must}. {FRONT_ENDS}")
        return sample if isinstance(sample, Single) and not fields else {**({} if sample is None else sample), **fields}

    def _clips(self, sample: Sample, kinds: Mapping[str, str] | None = None) -> Clips | None:
        """Return the clips of a sample, if an image has the dims (B, T, C, H, W)."""
        if isinstance(sample, Single):
            return None
        for value in sample.values():
            if getattr(value, "ndim", 0) == 5:
                break
        else:
            return None
        fields = {**self.fields, **(kinds or {})}
        given = {name: value for name, value in sample.items() if name not in (*OWN, PLACE) and value is not None}
        found = {name: kind_of(name, value, fields, self._name) for name, value in given.items()}
        images = [name for name, kind in found.items() if kind == "image" and getattr(given[name], "ndim", 0) == 5]
        if not images:
            return None
        own = {name for name, kind in found.items() if kind not in (None, "K") and name != "rotation"}
        whole = ["camera", "rotation", PLACE]
        for name in (name for name, kind in found.items() if kind == "K"):
            if getattr(given[name], "ndim", 3) == 4:  # of each frame
                matrices.check_alike(name, given[name], self._name)
                own.add(name)
            else:
                whole.append(name)
        own |= {f"{name}_valid" for name in own} | {"image_valid", *(self.mirroring.by_name if self.mirroring else ())}
        shape = tuple(given[images[0]].shape[:2])
        return Clips(sample, [name for name in given if name in own], whole, shape, images[0], self._name)

    def _moving(self, sample: Sample, fields: Mapping[str, str]) -> Named:
        """Return the fields that move, at least one."""
        if not (named := self._sorted(sample, fields)):
            raise ValueError(f"{self._name}: the sample must have a field that moves; got none of {', '.join(KINDS)}")
        return named

    def _sorted(self, sample: Sample, fields: Mapping[str, str], single: bool = False) -> Named:
        """Return the fields that move."""
        named: Named = {}
        for name, value in sample.items():
            if name in OWN or name == PLACE or value is None:
                continue
            found = kind_of(name, value, fields, self._name, single)
            if found is not None and isinstance(value, (list, tuple)):
                items = [as_tensor(v, f"{name}[{i}]", found, self._name) for i, v in enumerate(value)]
                named[name] = found, items
            elif found is not None:
                named[name] = found, as_tensor(value, name, found, self._name)
        return named

    def _batch(
        self, sample: Sample, camera: Any = None, predicted: bool = False, kinds: Mapping[str, str] | None = None
    ) -> Batch:
        """Return what moves of a sample; the plan of its form is kept.

        camera: instead of the sample's. predicted: values may be bad. kinds: name -> kind, in addition to `fields`.
        """
        camera = sample.get("camera") if camera is None else camera
        camera = self.camera if camera is None else camera
        fields = {**self.fields, **kinds} if kinds else self.fields
        if camera is None or isinstance(camera, Guess):
            own = self.camera if isinstance(self.camera, Camera) else None  # a front end may have brought the number
            camera = self._camera_of(self._moving(sample, fields), camera) if own is None else own
        form = self._form_of(sample, camera, fields)
        known = None if form is None else self._calls.plans.entry((), form)
        if known is not None:
            batch = Batch(known[2], sample, alone(camera), predicted)
            return self._check_matrices(batch, sample) if "K" in batch.plan.fields.values() else batch
        batch = self._check_matrices(self._new_batch(sample, camera, fields, predicted), sample)
        is_there = form is not None and batch.camera.intrinsics.device == camera.intrinsics.device
        if is_there and all(v is sample[n] for n, v in batch.values.items()):
            self._calls.plans((), form, lambda: batch.plan)
        return batch

    def _form_of(self, sample: Sample, camera: object, fields: Mapping[str, str]) -> tuple[Any, ...] | None:
        """Return all that a plan depends on; None if a field is no tensor or number, or of a `Mixed`."""
        if not isinstance(camera, Camera) or camera.is_mixed:
            return None
        is_free = are_free(*[value for value in sample.values() if isinstance(value, Tensor)])
        if not is_free and not are_free():
            return None
        intrinsics, distortion = camera.intrinsics, camera.distortion
        # each thread has calls of its own
        parts: list[Any] = [get_ident(), type(sample), type(camera), camera.image_size]
        parts += intrinsics.shape, intrinsics.dtype, intrinsics.device, distortion.shape
        for name, value in sample.items():
            if isinstance(value, Tensor):
                parts += name, type(value), value.shape, value.stride(), value.dtype, value.device
            elif value is None or isinstance(value, (str, int, float, Camera)):
                parts += name, type(value)
            else:
                return None
        return *parts, is_free, self._calls.revision, *fields.items()

    def _new_batch(self, sample: Sample, camera: Any, fields: Mapping[str, str], predicted: bool) -> Batch:
        named = self._moving(sample, fields)
        batched = not isinstance(sample, Single) and is_batch(named, camera)
        if not batched:
            self._sorted(sample, fields, single=True)  # raises for whole numbers of more than a row
        images = [value for kind, value in named.values() if kind == "image"]
        size = images[0][0].shape[-2:] if images and len(images[0]) else ()
        count = -1
        for name, (found, value) in named.items():
            several = isinstance(value, list)
            items = value if several else [value]
            for i, item in enumerate(items):
                which, more = f"{name}[{i}]" if several else name, item.ndim - KINDS[found].most_dims
                frame = item.new_empty(item.shape[more:]) if more > 0 and isinstance(sample, Frames) else item
                check(found, which, frame, batched and not several, self._name)
                if not predicted:
                    check_values(found, which, item, self._name)
                    if found == "image":
                        check_averaged(item, self.options["mode"], which, self._name)
                    if len(size) == 2:
                        flags = sample.get(f"{name}_valid")
                        if several and flags is not None:
                            flags = flags[i] if i < len(flags) else ()
                        warn_of_numbers(found, which, item, flags, size, self._name)
            own = len(value) if batched or several else 1
            count = own if count < 0 else count
            if own != count:
                raise ValueError(f"{self._name}: {name} must be of {count} samples, as other fields; got {own}")
        check_cameras(camera, count, named, self._name)
        held = {name: v for name, (_, value) in named.items() for v in (value if isinstance(value, list) else [value])}
        check_devices(self._name, **held)
        device, camera = next((v.device for v in held.values()), torch.device("cpu")), alone(as_one(camera))
        if device.type == "cpu" and are_free():
            warn_if_missing()
        if camera.intrinsics.device != device:
            own, camera = camera, camera.each(lambda t: t.to(device))
            if own.intrinsics.is_cpu and not is_unknown(own.intrinsics):
                remember_camera(camera, own)
        flags = dict.fromkeys(
            ["image_valid", *(f"{name}_valid" for name, (kind, _) in named.items() if kind in IMAGES)]
        )
        masks = [key for key in flags if sample.get(key) is not None or (self.valid_mask and key == "image_valid")]
        calls = Kept() if are_free(*held.values()) else None
        plan = Plan({name: kind for name, (kind, _) in named.items()}, batched, count, masks, calls)
        return Batch(plan, {name: value for name, (_, value) in named.items()}, camera, True)

    @on_samples
    def moved_by(
        self, change: Change, sample: Mapping[str, Any], kinds: Mapping[str, str] | None = None, predicted: bool = False
    ) -> Sample:
        """Move a sample by a change that exists, as `forward` does after its draw.

        Args:
            change: of as many samples; its `source` are their cameras.
            sample: the fields; a `Single` is one sample, whatever their dims.
            kinds: name -> kind, in addition to `fields`.
            predicted: whether values may be bad.
        """
        sample = self._given(sample, {})
        if clips := self._clips(sample, kinds):
            return clips.restored(self.moved_by(change, clips.frames(None), kinds, predicted))
        if change.count == 1:
            own = self._sorted(sample, {**self.fields, **(kinds or {})}).values()
            sizes = {len(value) if isinstance(value, (list, tuple)) else value.shape[:1].numel() for _, value in own}
            if sizes != {1} and all(kind != "image" for kind, _ in own):
                sample = Single(sample)  # labels of several faces, without the image that tells
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
        plan, values, _, checked = batch
        moved, batched = dict(sample), plan.batched
        if "K" in plan.fields.values():
            matrices.check_targets(plan.fields, change, self._name)
        options: dict[str, float] = {"mask_fill": self.mask_fill}
        if self.mirroring is not None:
            options["lateral"] = self.mirroring.lateral
        together = {} if "image_valid" in plan.masks else plan.together(change, values, self.mask_fill)
        for name, kind in plan.fields.items():
            value: Any = values[name]
            valid: Any = None
            if name in together:
                moved[name], valid = together[name]
            elif isinstance(value, list):
                pairs = [self._one(change.row(i), kind, v.unsqueeze(0), options) for i, v in enumerate(value)]
                moved[name] = [result.squeeze(0) for result, _ in pairs]
                valid = [v.squeeze(0) for _, v in pairs if v is not None] or None
            else:
                if not checked:
                    check_values(kind, name, value, self._name)
                result, valid = self._one(change, kind, plan.rows(value), options)
                moved[name] = result if batched else result.squeeze(0)
                valid = valid if batched or valid is None else valid.squeeze(0)
            if valid is not None:
                flags = sample.get(f"{name}_valid")
                moved[f"{name}_valid"] = valid if flags is None else self._still(f"{name}_valid", valid, flags)
        for key in plan.masks:
            if (seen := self._seen(key, sample.get(key), plan, change)) is not None:
                moved[key] = seen.contiguous() if batched else seen[0].contiguous()
        if "rotation" not in plan.fields:
            moved["rotation"] = change.rotation.clone() if batched else change.single_rotation
        if self.mirroring is not None:
            self.mirroring.exchange(moved, batch.rows(), change.mirrored, batched, self._name)
        if not isinstance(change.parts[0].camera, Unknown):
            # the change keeps cameras of its own, to go back by
            target = change.several if batched else change.single
            moved["camera"] = list(target) if isinstance(sample.get("camera"), (list, tuple)) else target
        return moved

    def _seen(self, key: str, given: Any, plan: Plan, change: Change) -> Tensor | None:
        """Return a mask of validity with a dim B, from the one that was given; None if neither is wanted."""
        seen = None
        if getattr(given, "ndim", 0) > 1 + plan.batched:  # and no flag for each sample
            seen = plan.rows(torch.as_tensor(given) != 0)
            if len(seen) != change.count:
                raise ValueError(
                    f"{self._name}: {key} must be of {change.count} samples, as other fields; got {len(seen)}"
                )
            seen, _ = self._one(change, "mask", seen, {"mask_fill": 0.0})
        if key != "image_valid" or not self.valid_mask or "image" not in plan.fields.values():
            return seen
        whole = change.valid_mask()
        return whole if seen is None else seen & (whole if seen.ndim == 4 else whole[:, 0])

    @staticmethod
    def _one(change: Change, found: str, value: Tensor, options: Mapping[str, float]) -> tuple[Tensor, Tensor | None]:
        lead = value.shape[1 : value.ndim - KINDS[found].most_dims]  # of frames
        if lead:
            frames = Change(math.prod(lead), [replace(part, rows=None) for part in change.parts])
            moved = SampleTransform._one(frames, found, value.flatten(0, len(lead)), options)
            result, valid = (None if v is None else v.reshape(1, *lead, *v.shape[1:]) for v in moved)
            return cast("Tensor", result), valid
        result = field_of(found, value).move(change, value, options)
        result, valid = result if isinstance(result, tuple) else (result, None)
        # geometry is computed in float32 at least; what came in half precision goes out in it
        return in_range(result, value.dtype) if value.dtype.is_floating_point else result, valid

    def _still(self, name: str, valid: Any, given: Any) -> Any:
        """Return the flags that come out, invalid if those given are; any number but zero is valid, as in COCO."""
        many = isinstance(valid, list)
        now, before = valid if many else [valid], [torch.as_tensor(b) != 0 for b in (given if many else [given])]
        if [b.shape for b in before] != [v.shape for v in now]:
            shapes = ", ".join(str(tuple(v.shape)) for v in now)
            raise ValueError(f"{self._name}: {name} must be {shapes}; got {[tuple(b.shape) for b in before]}")
        now = [v & b.to(v.device) for v, b in zip(now, before, strict=True)]
        return now if many else now[0]
