"""A sample: the kinds of fields that it may have, how each is checked, and how all move by one change of cameras."""

from __future__ import annotations

import contextlib
import copy
import difflib
import functools
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, ParamSpec, TypedDict, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import Unpack

from camtorch.augment.change import Change, View, alone, as_one
from camtorch.augment.clips import Clips
from camtorch.augment.landmarks import Mirroring, exchanged
from camtorch.cameras.camera import Camera
from camtorch.evaluate.known import are_numbers, in_worker, known_false, known_true
from camtorch.evaluate.private import pytree
from camtorch.models import Pinhole
from camtorch.poses.rotations import are_rotations, check_rotation, rotation_matrix, rotation_vector
from camtorch.values.arguments import (
    GUESS_CAMERA,
    LEFT,
    as_coordinates,
    as_flag,
    as_mapping,
    as_number,
    check_angles,
    check_boxes,
    check_devices,
    check_radians,
    hinting,
    no_camera,
    warn,
)
from camtorch.values.threads import on_one_thread
from camtorch.warp.at_once import at_once, batch_at_once
from camtorch.warp.boxes import edges_of, enclosing
from camtorch.warp.sampling import Options, Sampler, as_options

P = ParamSpec("P")
R = TypeVar("R")

Sample = dict[str, Any]
"""Name -> value; see `Augmentation`."""
Named = dict[str, tuple[str, Any]]
"""Name -> (kind, tensor or list of tensors)."""


class Single(dict[str, Any]):
    """A sample that is known to be a single one, without batch dims."""


class Frames(Single):
    """A single sample whose values may have leading dims, as those of clips have: all of them move by one change."""


KEEP = "keep"
IMAGES = ("image", "mask", "depth", "distance")


Move = Callable[[Change, Tensor, Mapping[str, float]], Any]


@dataclass(frozen=True)
class Field:
    """A kind of data."""

    dims: int  # the least number of dims of a single sample
    most_dims: int  # the most
    last: tuple[int, ...]  # what its last dim may be; empty: anything
    shape: str  # in words, of a batch
    move: Move  # (change, batch, options) -> batch, or (batch, valid)
    decides: bool = False  # whether its number of dims tells a batch from a single sample


def _planes(move: Move) -> Move:
    """Of masks and the like, which also come without channels, (B, H, W)."""

    def of(change: Change, value: Tensor, options: Mapping[str, float]) -> Tensor:
        moved: Tensor = move(change, value.unsqueeze(1) if value.ndim == 3 else value, options)
        return moved.squeeze(1) if value.ndim == 3 else moved

    return of


def _pose(change: Change, pose: Tensor, options: Mapping[str, float]) -> Tensor:
    turned = change.rays(pose[..., :3, :], _columns, _columns)
    turned = torch.cat((turned[..., :3], change.positions(pose[..., :3, 3]).to(turned)[..., None]), -1)
    top = _mirrored_head(change, turned, options)
    return torch.cat((top, pose[..., 3:, :].to(top)), -2)


def _mirrored_head(change: Change, matrix: Tensor, options: Mapping[str, float]) -> Tensor:
    """Columns (B, 3, n) of turned heads: in a mirror a head's left side is its right one, and its turn no mirror."""
    mirrored = change.mirrored
    if mirrored is None:
        return matrix
    lateral = torch.arange(matrix.shape[-1], device=matrix.device) == options.get("lateral", 0)
    return torch.where(mirrored.to(matrix.device)[:, None, None] & lateral, -matrix, matrix)


def _columns(matrix: Tensor) -> Tensor:
    return matrix.mT


def _rotation_vector(change: Change, rvec: Tensor, options: Mapping[str, float]) -> Tensor:
    if change.mirrored is None:
        return change.rays(rvec, lambda r: rotation_matrix(r).mT, lambda columns: rotation_vector(columns.mT))
    turned = _mirrored_head(change, change.rays(rotation_matrix(rvec), _columns, _columns), options)
    eye = torch.eye(3, dtype=change.rotation.dtype, device=change.rotation.device)
    still = (change.rotation == eye).all(-1).all(-1).to(rvec.device)
    return torch.where(still.unsqueeze(-1), rvec.to(turned), rotation_vector(turned))


_MANY = 16
_ROUNDING = 0.01
_MOST_FORMS = 16  # of samples that a transform remembers


def _positions(change: Change, points: Tensor, options: Mapping[str, float]) -> Tensor:
    return change.positions(points)


def _pixels(change: Change, pixels: Tensor, options: Mapping[str, float]) -> tuple[Tensor, Tensor]:
    return change.points(pixels)


_DIRECTIONS = Field(
    1, _MANY, (3,), "(B, *N, 3) directions of the camera frame", lambda change, rays, _: change.rays(rays)
)
_POSE = Field(2, 2, (4,), "(B, 4, 4) or (B, 3, 4), camera from head", _pose)
_MASKS = "(B, C, H, W) or (B, H, W)"
_DEPTHS = "(B, 1, H, W) or (B, H, W), along"
_PITCH_YAW = "(B, *N, 2) pitch and yaw of a gaze in radians"
KINDS = {
    "image": Field(3, 3, (), "(B, C, H, W)", lambda change, images, _: change.images(images), True),
    "mask": Field(2, 3, (), _MASKS, _planes(lambda change, masks, given: change.labels(masks, given["mask_fill"]))),
    "depth": Field(2, 3, (), f"{_DEPTHS} z", _planes(lambda change, depth, _: change.depth(depth))),
    "distance": Field(2, 3, (), f"{_DEPTHS} the ray", _planes(lambda change, distance, _: change.distance(distance))),
    "keypoints": Field(2, 3, (2,), "(B, N, 2) or (B, F, N, 2) pixels x, y", _pixels, True),
    "polygons": Field(3, 3, (2,), "(B, M, K, 2) corners x, y", _pixels, True),
    "boxes": Field(2, 2, (4,), "(B, M, 4) pixels x1, y1, x2, y2", lambda change, boxes, _: change.boxes(boxes), True),
    "landmarks": Field(2, 3, (2, 3), "(B, N, 2) pixels or (B, N, 3) points of the camera frame", _pixels, True),
    "points": Field(1, _MANY, (3,), "(B, *N, 3) points of the camera frame", _positions),
    "gaze": _DIRECTIONS,
    "directions": _DIRECTIONS,
    "pitch_yaw": Field(1, _MANY, (2,), _PITCH_YAW, lambda c, angles, _: c.rays(angles, from_pitch_yaw, to_pitch_yaw)),
    "head_pose": _POSE,
    "pose": _POSE,
    "rvec": Field(1, 1, (3,), "(B, 3), a rotation vector, camera from head", _rotation_vector),
    "tvec": Field(1, 1, (3,), "(B, 3), a point of the camera frame", _positions),
    "rotation": Field(2, 2, (3,), "(B, 3, 3), turned so far", lambda c, turn, _: c.rays(turn, _columns, _columns)),
}
_CHECKED = ("boxes", "rvec", "head_pose", "pose", "pitch_yaw")
"""Whose values are checked, not their shape alone."""
_ALIASES = {"images": "image", "masks": "mask", "bboxes": "boxes", "point": "points", "face_center": "points"}
OWN = ("camera", "source_camera", "source_rotation", "scale")  # these come with a change and do not move


_RANKS = {kind: (not field.decides, i) for i, (kind, field) in enumerate(KINDS.items())}


def kind_of(name: str, value: object, own: Mapping[str, str], owner: str, single: bool = False) -> str | None:
    """Return the key in `KINDS` of a field, None if it stays; numbers of an unknown name may be geometry: an error."""
    if not isinstance(name, str):
        raise TypeError(f"{owner}: a sample must have strings for names; got {name!r:.80}")
    if name in own:
        return None if own[name] == KEEP else own[name]
    if name.endswith("_valid"):
        return None
    base = name if name in KINDS else _ALIASES.get(name)
    # no image_path, mask_id, of one sample or of a batch
    if base is None and isinstance(value, (Tensor, np.ndarray, list, tuple)) and not is_text(value):
        begins = sorted((k for k in KINDS if name.startswith(k + "_")), key=len)  # compilers know no max by a key
        base = begins[-1] if begins else None
    if base is None and _may_be_geometry(name, value, single):
        if isinstance(value, Mapping):
            raise ValueError(
                f"{owner}: {name!r} holds real numbers in a dict, and fields move only at the top of samples. Put them "
                f"there, or leave the dict as it is by fields={{{name!r}: '{KEEP}'}}"
            )
        close = _close_to(name)
        meant = f"Did you mean {close[0]!r}? " if close else ""
        raise ValueError(
            f"{owner}: {name!r} holds real numbers, and whether they move with the camera is not known. {meant}"
            f"fields={{{name!r}: KIND}} says so, where KIND is {', '.join(KINDS)} or {KEEP}"
        )
    return base


def is_text(value: Any) -> bool:
    """Whether it holds strings, at least one and in lists of any depth, and nothing else."""
    texts = pytree.tree_leaves(value.tolist() if isinstance(value, np.ndarray) and value.dtype.kind in "OSU" else value)
    return len(texts) > 0 and all(isinstance(text, (str, bytes)) for text in texts)


@functools.lru_cache(64)
def _close_to(name: str) -> list[str]:
    return ["mask"] if name.startswith("seg") else difflib.get_close_matches(name, KINDS, 1)


def _may_be_geometry(name: str, value: Any, single: bool, above: int = 0) -> bool:
    """Whether it holds real numbers, or whole ones of more than a row a sample or with such a name; not one alone.

    above: the number of lists around it, which count as dims.
    """
    if isinstance(value, Mapping):
        return any(_may_be_geometry(str(key), item, single) for key, item in value.items())
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return any(_may_be_geometry(name, item, single, above + 1) for item in value)
    if isinstance(value, (np.ndarray, np.generic)):
        whole, known = value.dtype.kind in "iub", value.dtype.kind in "iubfcV"
    elif isinstance(value, Tensor):
        whole, known = not (value.is_floating_point() or value.is_complex()), True
    else:
        whole, known = not isinstance(value, float), isinstance(value, (int, float))
    dims, row = above + getattr(value, "ndim", 0), 1 if single else 2
    return known and (dims > (row if whole else 0) or (dims == row and bool(_close_to(name))))


def moves(kind: str, value: Tensor) -> Move:
    """How values of a kind move."""
    return _positions if kind == "landmarks" and value.shape[-1] == 3 else KINDS[kind].move


def as_tensor(value: object, name: str, kind: str, owner: str) -> Tensor:
    """Return the value of a field as a tensor of real numbers."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        value = torch.from_numpy(value)
    if not isinstance(value, Tensor) or value.dtype.is_complex:
        what = f"dtype {value.dtype}" if isinstance(value, (Tensor, np.ndarray)) else type(value).__name__
        plain = isinstance(value, (list, tuple, int, float))
        hint = ". Plain numbers go in as torch.tensor(numbers); a list has a tensor for each sample"
        raise TypeError(
            f"{owner}: {name} must be a tensor of real numbers, {KINDS[kind].shape}; got {what}"
            f"{hint if plain else _hint(name)}"
        )
    if kind not in IMAGES and not value.dtype.is_floating_point:
        value = value.to(torch.get_default_dtype())  # whole pixels do not stay whole
    return value


def _hint(name: str) -> str:
    return "" if name in KINDS else f". If it is something else, fields={{{name!r}: '{KEEP}'}} leaves it as it is"


def check(kind: str, name: str, value: Tensor, batched: bool, owner: str) -> None:
    """Raise a ValueError unless a kind takes this shape."""
    field = KINDS[kind]
    dims = value.ndim - batched
    least, most = field.dims, field.most_dims
    if not least <= dims <= most or (field.last and value.shape[-1] not in field.last):
        what = field.shape if batched else field.shape.replace("(B, ", "(")
        hint = _hint(name)
        if kind in ("rvec", "tvec") and value.shape[-2:] == (3, 1):
            hint = f". OpenCV's column goes in as {name}[..., 0]"
        if kind == "image" and value.ndim == 5:
            hint = f". The frames of clips go in as a batch, by {name}.flatten(0, 1)"
        if kind == "keypoints" and value.ndim and value.shape[-1] == 3:
            hint = f". Of x, y and visibility, [..., 2] goes in as {name}_valid=..., a flag for each"
        raise ValueError(f"{owner}: {name} must be {what}; got shape {tuple(value.shape)}{hint}")
    if kind in ("head_pose", "pose") and value.shape[-2] not in (3, 4):
        raise ValueError(f"{owner}: {name} must be {field.shape}; got shape {tuple(value.shape)}")


def check_values(kind: str, name: str, value: Tensor, owner: str) -> None:
    """Raise a ValueError for plain labels in another form than that of their kind; what is NaN is in none."""
    if kind == "boxes":
        form = getattr(getattr(value, "format", None), "value", "XYXY")  # of torchvision's BoundingBoxes
        if form != "XYXY":
            raise ValueError(
                f"{owner}: {name} must be x1, y1, x2, y2; got BoundingBoxes of the format {form}, which "
                "camtorch.augment.torchvision.Transform takes"
            )
        check_boxes(value, name, owner)
    elif kind == "rvec":
        check_radians(value, name, owner)
    elif kind in ("head_pose", "pose") and value.is_cpu and not value.requires_grad:
        rotations = value[..., :3, :3]
        wrong = ~are_rotations(rotations) & torch.isfinite(rotations).flatten(-2).all(-1)
        if known_false(~wrong):
            check_rotation(rotations[wrong][:1], name, owner)
    elif kind == "pitch_yaw" and value.is_cpu and not value.requires_grad:
        # with room for the rounding of half precision
        beyond = value.abs() > value.new_tensor([math.pi / 2, math.pi]) * (1 + _ROUNDING)
        if known_false(~beyond):
            pitch, yaw = value[beyond.any(-1)][0].tolist()
            raise ValueError(
                f"{owner}: {name} must be radians, pitch within pi / 2 and yaw within pi; got {pitch:.6g}, {yaw:.6g}. "
                "Degrees are converted by torch.deg2rad() or math.radians()"
            )


def _tell_of_parts(name: str, boxes: Tensor, owner: str) -> None:
    """Warn of boxes that all lie between the centres of the first pixels, as parts of an image's sides do."""
    if boxes.is_cpu and known_true((boxes == boxes.clamp(0, 1)).all() & (boxes % 1 != 0).any()):
        warn(
            f"{owner}: {name} must be pixels x1, y1, x2, y2, and all of these lie within [0, 1], as parts of an "
            "image's width and height do: times width and height, less 0.5, those are pixels"
        )


def is_batch(named: Named, camera: object) -> bool:
    """Whether name -> (kind, value) is a batch: the first image, pixels or boxes says, else cameras, else any field."""
    if isinstance(camera, (list, tuple)):
        return True
    for kind, value in sorted(named.values(), key=lambda pair: _RANKS[pair[0]]):
        if isinstance(value, (list, tuple)):
            return True
        if KINDS[kind].decides:
            return bool(value.ndim > KINDS[kind].dims)
    if isinstance(camera, Camera) and camera.batch_shape:
        return True
    return any(value.ndim > KINDS[kind].dims for kind, value in named.values())


class Unknown(Pinhole):
    """The camera of images of which only the size is known, while they are edited; no sample comes out with it."""

    @classmethod
    def of(cls, size: tuple[int, int]) -> Unknown:
        """For images of a size."""
        return cls(torch.tensor([1.0, 1.0, 0.0, 0.0]), image_size=size).requires_grad_(False)


class KeepsCamera:
    """Keeps a copy of a `camera`, and of one that is `like` others, whenever it is set; the copy does not learn."""

    _name: str = ""  # in errors; empty: that of the class

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "camera" and not (value is None or isinstance(value, Camera)):
            raise TypeError(f"{self._name or type(self).__name__}: camera must be a Camera; got {no_camera(value)}")
        if name in ("camera", "like") and isinstance(value, Camera):
            value = copy.deepcopy(value)
            for tensor in (*value.parameters(), *value.buffers()):
                tensor.requires_grad_(False)
        super().__setattr__(name, value)


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
        learns = isinstance(one, (Tensor, Camera)) and any(t.requires_grad for t in getattr(one, "_tensors", (one,)))
        return one.detach() if learns else one

    return pytree.tree_map(of, value)


class SampleOptions(TypedDict, total=False):
    """What every transform of samples takes; see `Augmentation`."""

    camera: Camera | None
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

    def __init__(
        self,
        *,
        camera: Camera | None = None,
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
        self.camera = camera
        self.fields: dict[str, str] = dict(as_mapping(fields, "fields", self._name, "{'lidar': 'points'}"))
        wrong = {k: v for k, v in self.fields.items() if v not in (*KINDS, KEEP)}
        if wrong:
            raise ValueError(f"{self._name}: fields maps names to {', '.join(KINDS)} or {KEEP}; got {wrong}")
        self.options: Options = as_options(self._name, mode, padding_mode, fill, antialias, tolerance)
        # None where each warp says
        self.antialias: bool | None = None if antialias is None else self.options["antialias"]
        self.mask_fill: float = as_number(mask_fill, "mask_fill", self._name)
        self.valid_mask: bool = as_flag(valid_mask, "valid_mask", self._name)
        self._forms: dict[tuple[Any, ...], tuple[list[tuple[str, str]], bool, int]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        own: Any = vars(cls).get("__init__")
        if (code := getattr(own, "__code__", None)) is None:
            return
        names = code.co_varnames[1 : code.co_argcount + code.co_kwonlyargcount]
        hinted = hinting(f"By name: {cls.__name__}({', '.join(f'{name}=...' for name in names)})")(own)

        @functools.wraps(own)
        def checked(self: SampleTransform, *args: Any, **kwargs: Any) -> None:
            for word in kwargs:
                if word not in _keywords(cls):  # type: ignore[arg-type]  # a class can be hashed
                    raise TypeError(f"{type(self).__name__}: unknown keyword {word!r}; {cls._meant(word)}. {LEFT}")
            hinted(self, *args, **kwargs)

        cls.__init__ = checked  # type: ignore[method-assign]

    @classmethod
    def _meant(cls, word: str) -> str:
        """Return the keyword that somebody may have meant, and all that are known."""
        known = [*_keywords(cls)]  # type: ignore[arg-type]  # a class can be hashed
        close = difflib.get_close_matches(word, [*known, *cls.other_words], 1)
        meant = f"did you mean {cls.other_words.get(close[0], close[0])!r}? Known" if close else "known"
        has = next((base.__name__ for base in cls.__mro__[1:-2] if word in _keywords(base)), None)
        return f"{meant} are {', '.join(known)}" + (f". {has} has it" if has else "")

    mirroring: Mirroring | None = None  # what changes places where an augmentation mirrors; None: it never does

    needs_camera: bool = True  # whether samples, or it, need a camera; edits do not

    def _camera_of(self, named: Named) -> Camera:
        """The camera of a sample that has none, nor the augmentation."""
        how = f"give one as sample['camera'] or {self._name}(camera=...)"
        if self.needs_camera:
            raise ValueError(f"{self._name}: no camera; {how}. {GUESS_CAMERA}")
        for name, (found, value) in named.items():
            first = value[0] if isinstance(value, list) and value else value
            if found == "image" and isinstance(first, Tensor) and first.shape[-1] <= 4 < first.shape[-3:][0]:
                raise ValueError(
                    f"{self._name}: {name} is {tuple(first.shape)}, which seems to have its channels last; they come "
                    f"first, (B, C, H, W), and camtorch.augment.numpy takes arrays as they are. A camera tells: {how}"
                )
            if found in IMAGES:
                items = value if isinstance(value, list) else [value]
                self._check_one_size(name, {(one.shape[-2], one.shape[-1]) for one in items})
                return Unknown.of((items[0].shape[-2], items[0].shape[-1]))
        raise ValueError(
            f"{self._name}: the sample holds neither an image nor a camera, and how large the image is decides where "
            f"labels go; {how}"
        )

    def _held(self, name: str) -> Camera | None:
        """A camera of its own, from the dict where it lies: `nn.Module` looks into all."""
        return cast("Camera | None", self._modules.get(name))

    def _given(self, sample: Mapping[str, object] | None, fields: Mapping[str, object]) -> Sample:
        """The sample and the keyword arguments as one dict."""
        if not (sample is None or hasattr(sample, "keys")):
            got = type(sample).__name__
            raise TypeError(f"{self._name}: a sample is a dict of fields, or keywords, as in image=...; got {got}")
        return sample if isinstance(sample, Single) and not fields else {**({} if sample is None else sample), **fields}

    def _clips(self, sample: Sample, kinds: Mapping[str, str] | None = None) -> Clips | None:
        """Return the clips of a sample, if an image has the dims (B, T, C, H, W)."""
        if isinstance(sample, Single) or all(getattr(value, "ndim", 0) != 5 for value in sample.values()):
            return None
        fields = {**self.fields, **(kinds or {})}
        given = {name: value for name, value in sample.items() if name not in OWN and value is not None}
        found = {name: kind_of(name, value, fields, self._name) for name, value in given.items()}
        images = [name for name, kind in found.items() if kind == "image" and getattr(given[name], "ndim", 0) == 5]
        if not images:
            return None
        own = {name for name, kind in found.items() if kind is not None and name != "rotation"}
        own |= {f"{name}_valid" for name in own} | {"image_valid", *(self.mirroring.by_name if self.mirroring else ())}
        shape = tuple(given[images[0]].shape[:2])
        return Clips(sample, [name for name in given if name in own], shape, images[0], self._name)

    def _sorted(self, sample: Sample, fields: Mapping[str, str], single: bool = False) -> Named:
        """The fields that move."""
        named: Named = {}
        for name, value in sample.items():
            if name in OWN or value is None:
                continue
            found = kind_of(name, value, fields, self._name, single)
            if found is not None:
                several = isinstance(value, (list, tuple))
                named[name] = found, value if several else as_tensor(value, name, found, self._name)
        return named

    def _batch(
        self, sample: Sample, camera: Any = None, predicted: bool = False, kinds: Mapping[str, str] | None = None
    ) -> tuple[Named, bool, int, Camera]:
        """Return the fields that move, as a batch; whether the sample was one; its size, and its cameras.

        What samples of one form have in common is found and checked once. camera: instead of the sample's. predicted:
        values may be bad. kinds: name -> kind, in addition to `fields`.
        """
        camera = sample.get("camera") if camera is None else camera
        camera = self._held("camera") if camera is None else camera
        fields = {**self.fields, **kinds} if kinds else self.fields
        form = self._form_of(sample, camera, fields)
        if form is None or (known := self._forms.get(form)) is None:
            result = self._checked_batch(sample, camera, fields, predicted)
            named, batched, count, _ = result
            if (
                form is not None
                and result[3] is camera
                and all(found in IMAGES or sample[name].dtype.is_floating_point for name, (found, _) in named.items())
            ):
                while len(self._forms) >= _MOST_FORMS:
                    self._forms.pop(next(iter(self._forms)), None)
                self._forms[form] = [(name, found) for name, (found, _) in named.items()], batched, count
            return result
        own, batched, count = known
        if not predicted:
            for name, found in own:
                if found in _CHECKED:
                    check_values(found, name, sample[name], self._name)
        named = {name: (found, sample[name] if batched else sample[name].unsqueeze(0)) for name, found in own}
        return named, batched, count, camera

    def _form_of(self, sample: Sample, camera: object, fields: Mapping[str, str]) -> tuple[Any, ...] | None:
        """All that the fields of a sample are checked for but their values; None where that is more than tensors."""
        if not isinstance(camera, Camera) or camera.is_mixed:
            return None
        intrinsics, distortion = camera._tensors
        parts: list[Any] = [type(sample), camera.image_size, intrinsics.shape, distortion.shape, intrinsics.device]
        for name, value in sample.items():
            if isinstance(value, Tensor):
                parts += name, value.shape, value.dtype, value.device
            elif value is None or isinstance(value, (str, int, float, Camera)):
                parts += name, type(value)
            else:
                return None
        return *parts, *fields.items()

    def _checked_batch(
        self, sample: Sample, camera: Any, fields: Mapping[str, str], predicted: bool
    ) -> tuple[Named, bool, int, Camera]:
        named = self._sorted(sample, fields)
        if not named:
            raise ValueError(f"{self._name}: the sample has no field that moves; known are {', '.join(KINDS)}")
        camera = self._camera_of(named) if camera is None else camera
        batched = not isinstance(sample, Single) and is_batch(named, camera)
        if not batched:
            self._sorted(sample, fields, single=True)  # raises for whole numbers of more than a row
        count = -1
        for name, (found, value) in named.items():
            several = isinstance(value, (list, tuple))
            items = (
                [as_tensor(v, f"{name}[{i}]", found, self._name) for i, v in enumerate(value)] if several else [value]
            )
            for i, item in enumerate(items):
                which, more = f"{name}[{i}]" if several else name, item.ndim - KINDS[found].most_dims
                frame = item.new_empty(item.shape[more:]) if more > 0 and isinstance(sample, Frames) else item
                check(found, which, frame, batched and not several, self._name)
                if not predicted:
                    check_values(found, which, item, self._name)
                    if found == "boxes" and "image" in named:
                        _tell_of_parts(which, item, self._name)
            value = items if several else value if batched else value.unsqueeze(0)
            own = len(items) if several else items[0].shape[0] if batched else 1
            named[name], count = (found, value), own if count < 0 else count
            if own != count:
                raise ValueError(f"{self._name}: {name} is of {own} samples, other fields are of {count}")
        self._check_cameras(camera, count, named, batched)
        held = {name: v for name, (_, value) in named.items() for v in (value if isinstance(value, list) else [value])}
        check_devices(self._name, **held)
        device, camera = next((v.device for v in held.values()), torch.device("cpu")), alone(as_one(camera))
        camera = camera if camera.intrinsics.device == device else camera.each(lambda t: t.to(device))
        return named, batched, count, camera

    def _check_cameras(self, camera: object, count: int, named: Named, batched: bool) -> None:
        several = isinstance(camera, (list, tuple))
        cameras: list[Any] = list(camera) if several else [camera]  # type: ignore[call-overload]
        if not cameras:
            raise ValueError(f"{self._name}: an empty list of cameras; no samples have one camera, too")
        if several and len(cameras) != count:
            raise ValueError(f"{self._name}: {len(cameras)} cameras for {count} samples")
        for i, one in enumerate(cameras):
            name = f"camera[{i}]" if several else "camera"
            if not isinstance(one, Camera):
                raise TypeError(f"{self._name}: {name} must be a Camera; got {no_camera(one)}")
            if one.image_size is None:
                raise ValueError(f"{self._name}: {name} needs an image_size=(height, width)")
            shape = tuple(one.batch_shape)
            if shape not in ((), (1,), (count,)) or (shape and len(cameras) > 1):
                raise ValueError(f"{self._name}: {name} has batch dims {shape}, the samples are {count}")
            for field, (found, value) in named.items():
                if found in IMAGES:
                    shapes = [v.shape for v in value] if isinstance(value, list) else [value.shape[not batched :]]
                    for shape in shapes[i : i + 1] if several and isinstance(value, list) else shapes:
                        self._check_size(field, tuple(shape), name, one.image_size)
        self._check_one_size("camera", {one.image_size for one in cameras})

    def _check_one_size(self, name: str, sizes: set[tuple[int, int]]) -> None:
        if len(sizes) > 1:
            raise ValueError(
                f"{self._name}: the images of a batch are of one size; got {name} of {sorted(sizes)} (height, width). "
                "Give the samples one by one, as a DataLoader's workers do, or resize them before"
            )

    def _check_size(self, field: str, shape: tuple[int, ...], name: str, size: tuple[int, int]) -> None:
        if shape[-2:] == size:
            return
        if shape[-3:-1] == size:
            to = "0, 3, 1, 2" if len(shape) == 4 else "2, 0, 1"
            raise ValueError(
                f"{self._name}: {field} is {shape}, with the channels last. A tensor goes in as {field}.permute({to}), "
                f"an array as {field}.transpose({to}); camtorch.augment.numpy takes arrays as they are"
            )
        raise ValueError(
            f"{self._name}: {field} is {shape[-2:]} (height, width), but the image_size of {name} is {size}. "
            "camera.resize, .crop and .pad give the camera of an edited image"
        )

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
        named, batched, count, _ = self._batch(sample, camera, predicted, kinds)
        if count != change.count:
            raise ValueError(f"{self._name}: the change is of {change.count} samples, here are {count}")
        return self._moved(sample, named, batched, change)

    def _moved(self, sample: Sample, named: Named, batched: bool, change: Change) -> Sample:
        """The sample after a change; `named` holds its fields as a batch."""
        moved = dict(sample)
        options: dict[str, float] = {"mask_fill": self.mask_fill}
        if self.mirroring is not None:
            options["lateral"] = self.mirroring.lateral

        known = {}
        if not self.valid_mask and sample.get("image_valid") is None:
            known = together(change, named, **options, batched=batched)
        for name, (found, value) in named.items():
            valid: Any
            if name in known:
                moved[name], valid = known[name]
            elif isinstance(value, list):
                pairs = [self._one(change.row(i), found, v.unsqueeze(0), options) for i, v in enumerate(value)]
                moved[name] = [result.squeeze(0) for result, _ in pairs]
                valid = [v.squeeze(0) for _, v in pairs if v is not None] or None
            else:
                result, valid = self._one(change, found, value, options)
                moved[name] = result if batched else result.squeeze(0)
                valid = valid if batched or valid is None else valid.squeeze(0)
            if valid is not None:
                moved[f"{name}_valid"] = self._still(f"{name}_valid", valid, sample.get(f"{name}_valid"))
        for key in dict.fromkeys(("image_valid", *(f"{n}_valid" for n, (k, _) in named.items() if k in IMAGES))):
            seen: Any = sample.get(key)
            if masked := getattr(seen, "ndim", 0) > 1 + batched:  # and no flag for each sample
                seen = torch.as_tensor(seen) != 0
                seen = seen if batched else seen[None]
                if len(seen) != change.count:
                    raise ValueError(f"{self._name}: {key} is of {len(seen)} samples, other fields of {change.count}")
                seen, _ = self._one(change, "mask", seen, {"mask_fill": 0.0})
            if key == "image_valid" and self.valid_mask and any(found == "image" for found, _ in named.values()):
                whole = change.valid_mask()
                seen = whole if not masked else seen & (whole if seen.ndim == 4 else whole[:, 0])
                masked = True
            if masked:
                moved[key] = seen.contiguous() if batched else seen[0].contiguous()
        if "rotation" not in named:
            moved["rotation"] = change.rotation.clone() if batched else change.single_rotation
        if self.mirroring is not None:
            self._mirror(moved, named, change.mirrored, batched)
        if not isinstance(change.parts[0].camera, Unknown):
            # the change keeps cameras of its own, to go back by
            target = change.target.clone() if batched else change.single
            moved["camera"] = list(target) if isinstance(sample.get("camera"), (list, tuple)) else target
        return moved

    def _mirror(self, moved: Sample, named: Named, mirrored: Tensor | None, batched: bool) -> None:
        """Let landmarks and fields of a moved sample change places where they are seen in a mirror."""
        mirroring = cast("Mirroring", self.mirroring)
        sides = mirroring.sides(named)  # that none lacks the other, whatever was drawn
        others = (name for name in moved if name.rpartition("/")[2] in mirroring.by_name and name not in named)
        kept = {name: (None, moved[name]) for name in others}
        for name, (_, value) in kept.items():  # what says something of each landmark, and does not move itself
            several = isinstance(value, (list, tuple)) and all(isinstance(v, (Tensor, np.ndarray)) for v in value)
            if not several and not isinstance(value, (Tensor, np.ndarray)):
                raise TypeError(
                    f"{self._name}: {name} has a table of landmarks, and must be a tensor of (B, N, ...); got "
                    f"{type(value).__name__}"
                )
            moved[name] = [torch.as_tensor(v) for v in value] if several else torch.as_tensor(value)
        pixels = [one for kind, value in named.values() for one in _items(value) if kind in ("keypoints", "landmarks")]
        faces = {tuple(one.shape[1:3]) for one in pixels if one.ndim == 4}  # (F, N)
        for name, (found, _) in {**named, **kept}.items():
            for key, flags in ((name, found is None), (f"{name}_valid", True)):
                if key not in moved:
                    continue
                now, single = moved[key], not (batched or isinstance(moved[key], list))
                items = _items(now[None] if single else now)
                rows = torch.zeros(sum(map(len, items)), dtype=torch.bool) if mirrored is None else mirrored
                each = rows.split(1) if isinstance(now, list) else [rows]
                pairs = zip(items, each, strict=False)
                swapped = [mirroring.swapped(name, found, value, row, flags, faces) for value, row in pairs]
                moved[key] = (
                    [v[0] for v in swapped] if isinstance(now, list) else swapped[0][0] if single else swapped[0]
                )
        for left, right in sides if mirrored is not None else ():
            for pair in ((left, right), (f"{left}_valid", f"{right}_valid")):
                if all(key in moved for key in pair):
                    single = not (batched or isinstance(moved[pair[0]], list))
                    one, other = (moved[key].unsqueeze(0) if single else moved[key] for key in pair)
                    for key, new in zip(pair, exchanged(one, other, cast("Tensor", mirrored)), strict=True):
                        moved[key] = new.squeeze(0) if single else new

    @staticmethod
    def _one(change: Change, found: str, value: Tensor, options: Mapping[str, float]) -> tuple[Tensor, Tensor | None]:
        lead = value.shape[1 : value.ndim - KINDS[found].most_dims]  # of frames
        if lead:
            frames = Change(math.prod(lead), [replace(part, rows=None) for part in change.parts])
            moved = SampleTransform._one(frames, found, value.flatten(0, len(lead)), options)
            result, valid = (None if v is None else v.reshape(1, *lead, *v.shape[1:]) for v in moved)
            return cast("Tensor", result), valid
        result = moves(found, value)(change, value, options)
        result, valid = result if isinstance(result, tuple) else (result, None)
        # geometry is computed in float32 at least; what came in half precision goes out in it
        return _in_range(result, value.dtype) if value.dtype.is_floating_point else result, valid

    def _still(self, name: str, valid: Any, given: Any) -> Any:
        """Flags that come out, invalid where those given were; any number but zero is valid, as in COCO."""
        if given is None:
            return valid
        many = isinstance(valid, list)
        now, before = valid if many else [valid], [torch.as_tensor(b) != 0 for b in (given if many else [given])]
        if [b.shape for b in before] != [v.shape for v in now]:
            shapes = ", ".join(str(tuple(v.shape)) for v in now)
            raise ValueError(f"{self._name}: {name} must be {shapes}; got {[tuple(b.shape) for b in before]}")
        now = [v & b.to(v.device) for v, b in zip(now, before, strict=True)]
        return now if many else now[0]


def _items(value: Any) -> list[Tensor]:
    """Return a list of tensors as batches of one, a batch as the only one."""
    return [one[None] for one in value] if isinstance(value, list) else [value]


def _in_range(values: Tensor, dtype: torch.dtype) -> Tensor:
    """In a dtype that may be narrower: finite values stay finite."""
    if dtype == torch.float16 != values.dtype:
        most = torch.finfo(dtype).max
        values = values.clamp(-most, most)
    return values.to(dtype)


def together(
    change: Change, named: Named, mask_fill: float = 0.0, lateral: float = 0, batched: bool = True
) -> dict[str, tuple[Tensor, Tensor | None]]:
    """What moves by one compiled call, and its validity: images and pixels of a batch of one, images of another.

    batched: whether the results have a batch dim, as `named` has; those of a batch of one may do without.
    """
    part, is_single = change.parts[0], change.count == 1
    if part.moves is None or part.rows is not None or change.gate is not None:
        return {}
    if not is_single and (part.shades is not None or part.light is not None):
        return {}
    options = part.moves.options
    mode, padding_mode, fill = options["mode"], options["padding_mode"], options["fill"]
    hows: dict[str, Sampler | None] = {}
    for name, (found, value) in named.items():
        if found in ("depth", "distance") or isinstance(value, list):  # which ask for positions again
            return {}
        if value.ndim - 1 > KINDS[found].most_dims:  # frames
            continue
        if found == "image" and len(fill) in (1, value.shape[1]):
            hows[name] = Sampler(mode, padding_mode, fill)
        elif found == "mask":
            hows[name] = Sampler("nearest", "zeros", (mask_fill,))
        elif is_single and found == "boxes" and isinstance(part.moves, View) and are_numbers(value):
            hows |= {name: None} if value.dtype == part.moves.distortion.dtype else {}
        elif is_single and found != "boxes" and moves(found, value) is _pixels:
            hows[name] = None
    fields = (named[name] for name in hows)
    values = [edges_of(value) if found == "boxes" else value for found, value in fields]
    if not is_single:
        wide = [value if value.ndim == 4 else value.unsqueeze(1) for value in values]
        pairs = [(value, how) for value, how in zip(wide, hows.values(), strict=True) if how is not None]
        images = batch_at_once(part.warp, pairs)
        found_images = zip(hows, values, images or (), strict=False)
        return {n: (image if value.ndim == 4 else image.squeeze(1), None) for n, value, image in found_images}
    between = part.between() if values else None
    if between is None:
        return {}
    sizes = part.camera._size_for("Warp"), part.image_size
    made = at_once(*between, sizes, options, values, list(hows.values()), batched)
    if made is None:
        return {}
    results: dict[str, tuple[Tensor, Tensor | None]] = {}
    for name, value, (result, valid) in zip(hows, values, made, strict=True):
        found, given = named[name]
        if found == "boxes":
            boxes = enclosing(given if batched else given[0], result, cast("Tensor", valid))
            results |= {} if boxes is None else {name: boxes}
        else:
            results[name] = result if result.dtype == value.dtype else _in_range(result, value.dtype), valid
    return results


def from_pitch_yaw(angles: Tensor) -> Tensor:
    """Unit gaze vectors (..., 3) of pitch and yaw (..., 2) in radians, as in MPIIGaze and ETH-XGaze.

    Zero looks into the camera, along -z. Source: Zhang et al., ETH-XGaze, 2020, and its code.

    Raises:
        ValueError: another shape, plain angles of more than a turn, which are degrees.
    """
    angles = as_coordinates(angles, "angles", 2, "from_pitch_yaw")
    check_angles(angles, "from_pitch_yaw")
    pitch, yaw = angles.unbind(-1)
    return torch.stack((-pitch.cos() * yaw.sin(), -pitch.sin(), -pitch.cos() * yaw.cos()), -1)


def to_pitch_yaw(gaze: Tensor) -> Tensor:
    """Pitch and yaw (..., 2) in radians of gaze vectors (..., 3): pitch = asin(-y), yaw = atan2(-x, -z)."""
    x, y, z = as_coordinates(gaze, "gaze", 3, "to_pitch_yaw").unbind(-1)
    return torch.stack((torch.atan2(-y, torch.hypot(x, z)), torch.atan2(-x, -z)), -1)
