"""A batch of cameras of any models, which is evaluated model by model."""

import operator
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import accumulate, product
from typing import Any, NamedTuple, NoReturn, Self, cast

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.cameras.camera import Camera
from camtorch.cameras.numbers import as_numbers_of
from camtorch.evaluate.door import COLLATE_FUNCTIONS
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import in_worker
from camtorch.projection.evaluation import camera_rows, evaluate_rows, kept_cameras
from camtorch.projection.rows import CameraRows, Direction
from camtorch.values.arguments import Numbers, as_image_size, as_points, no_camera, shown, working_dtype
from camtorch.values.module import refused_index, remade


class _Group(NamedTuple):
    """Cameras of one model and number of coefficients, which are evaluated at once."""

    model: type[Camera]
    members: tuple[int, ...]  # the places in `Mixed.cameras` of the modules that hold them
    counts: tuple[int | None, ...]  # how many cameras each member has; None for a single one
    taken: tuple[int, ...] | None  # the group's among all cameras of the members, one after the other; None for all
    rows: tuple[int, ...]  # of the batch, which they fill, ascending
    memo: Kept

    @property
    def is_whole_member(self) -> bool:
        """Whether the group is all cameras of one member, in order."""
        return len(self.members) == 1 and self.taken is None

    def index_on(self, device: torch.device) -> slice | Tensor:
        """Return the index of its rows in the batch; a slice, of which nothing is copied, if they follow each other."""
        start, stop = self.rows[0], self.rows[-1] + 1
        return slice(start, stop) if stop - start == len(self.rows) else torch.tensor(self.rows, device=device)

    def stacked(self, tensors: Sequence[Tensor]) -> Tensor:
        """Return the numbers (C, n) of its cameras for tensors of the members; (n,) if a whole member shares them."""
        if self.is_whole_member:
            return tensors[0].unsqueeze(0) if self.counts[0] is None else tensors[0]
        if not any(self.counts):
            whole = torch.stack(list(tensors))
        else:
            pairs = zip(tensors, self.counts, strict=True)
            whole = torch.cat([t.expand(1 if count is None else count, t.shape[-1]) for t, count in pairs])
        taken = self.taken
        return whole if taken is None else whole.index_select(0, torch.tensor(taken, device=whole.device))


class Mixed(Camera):
    """A batch of cameras of any models, one for each image: it projects, is cropped, and is warped as one camera.

    Results have the same bits as those of each camera alone. Cameras of one model and number of coefficients are
    evaluated together: 64 cameras of 8 models take 8 calls, however they are ordered.

    Args:
        cameras: Single cameras, and batches of one dim, whose rows follow each other. They are not copied, as in an
            `nn.ModuleList`: their parameters go on learning here, and `camera[i]` is the i-th one.
        order: For each row of the batch, the number of its camera, counted one by one; each once, in turn by default.

    Its `intrinsics`, `K`, `fx` and so on are those of all cameras; there is no common `distortion`. Results have the
    widest dtype among the cameras and the points. `groups` are the batches of one model that it is made of.

    Raises:
        TypeError: If something is no camera. ValueError: If there are no cameras, more than one batch dim, images of
            different sizes, or different devices.

    Example:
        >>> camera = ct.Mixed([ct.Pinhole([300.0, 300, 319.5, 239.5]), ct.KannalaBrandt([300.0, 300, 319.5, 239.5])])
        >>> pixels, valid = camera.project(torch.rand(2, 100, 3))  # (2, 100, 2), (2, 100): a row for each camera
    """

    is_mixed = True
    has_native_form = False
    cameras: nn.ModuleList
    """The cameras that it was made of: single ones and batches."""

    def __init__(self, cameras: Iterable[Camera], *, order: Sequence[int] | None = None):
        members = _members(cameras, "Mixed")
        given = [(i, row) for i, camera in enumerate(members) for row in range(_count(camera))]
        super(Camera, self).__init__()  # a Mixed has no numbers of its own
        self.cameras = nn.ModuleList(members)
        self.image_size: tuple[int, int] | None = members[0].image_size
        # for each row of the batch the place of its member in `cameras`, and the row there
        self._places = tuple(given if order is None else [given[i] for i in _as_order(order, len(given))])
        self._rays, self._fields = Kept(), Kept()
        kinds: dict[tuple[object, ...], list[int]] = {}
        for row, (i, _) in enumerate(self._places):
            kinds.setdefault(kind(members[i]), []).append(row)
        self._groups = tuple(self._group(members, rows) for rows in kinds.values())
        # for each row of the batch its place among the rows of the groups, one after the other
        self._order = tuple(_inverse([row for group in self._groups for row in group.rows]))

    def _group(self, members: Sequence[Camera], rows: Sequence[int]) -> _Group:
        """Return the group of rows whose cameras are of one kind."""
        places = [self._places[row] for row in rows]
        used, index = _among_used(members, places)
        whole = index == tuple(range(sum(_count(members[i]) for i in used)))
        model: type[Camera] = type_before_parametrizations(members[used[0]])
        counts = tuple(len(members[i]) if members[i].batch_shape else None for i in used)
        return _Group(model, used, counts, None if whole else index, tuple(rows), Kept())

    @classmethod
    def of_groups(cls, groups: Sequence[tuple[Sequence[int], Camera]]) -> Self:
        """Return the batch whose rows the groups, (rows, cameras), fill together.

        Args:
            groups: The rows of the batch, and as many cameras, like the property `groups`.
        """
        try:
            rows = [int(row) for of_group, _ in groups for row in of_group]
        except (TypeError, ValueError):
            raise TypeError(f"Mixed: groups must be pairs (rows, cameras); got {shown(groups)}") from None
        if sorted(rows) != list(range(len(rows))):
            raise ValueError(f"Mixed: groups must fill every row once; got rows {rows}")
        return cls([camera for _, camera in groups], order=_inverse(rows))

    @property
    def groups(self) -> list[tuple[list[int], Camera]]:
        """The rows of each model and number of coefficients, and their cameras as a batch; gradients go to all."""
        made = []
        for group, (intrinsics, distortion) in zip(self._groups, self._pairs(self.tensors), strict=True):
            batch = self._member(group.members[0])
            if not (group.is_whole_member and batch.batch_shape):
                batch = remade(batch, intrinsics=intrinsics, distortion=distortion)
            made.append((list(group.rows), batch))
        return made

    def _member(self, i: int) -> Camera:
        return cast("Camera", self.cameras[i])

    @property
    def batch_shape(self) -> torch.Size:
        """(B,), the number of cameras."""
        return torch.Size((len(self._places),))

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """Intrinsics and distortion of each group."""
        tensors: list[Tensor] = []
        members = cast("list[Camera]", list(self.cameras._modules.values()))
        for group in self._groups:
            pairs = [members[i].tensors for i in group.members]
            tensors += [group.stacked(numbers) for numbers in zip(*pairs, strict=True)]
        if all(t.dtype == tensors[0].dtype for t in tensors):
            return tuple(tensors)
        wide = working_dtype(tensors[0], *tensors)
        return tuple(t.to(wide) for t in tensors)

    @staticmethod
    def _pairs(tensors: Sequence[Tensor]) -> Iterator[tuple[Tensor, Tensor]]:
        return zip(tensors[::2], tensors[1::2], strict=True)

    @property
    def form(self) -> tuple[object, ...]:
        return type(self), self.image_size, tuple((group.model, group.rows) for group in self._groups)

    @property
    def intrinsics(self) -> Tensor:  # type: ignore[override]
        """(B, 4) fx, fy, cx, cy of all."""
        parts = [t.expand(len(group.rows), 4) for group, t in zip(self._groups, self.tensors[::2], strict=True)]
        return parts[0] if len(parts) == 1 else self._in_order(torch.cat(parts))

    @property
    def distortion(self) -> NoReturn:  # type: ignore[override]
        """Not defined, as cameras of several models have none in common."""
        self._refuse("distortion", "Use camera[i].distortion, or camera.groups, batches of one model")

    @property
    def distortion_names(self) -> NoReturn:  # type: ignore[override]
        """Not defined; see `distortion`."""
        self._refuse("distortion", "Use camera[i], or camera.groups, batches of one model")

    @staticmethod
    def _refuse(what: str, instead: str) -> NoReturn:
        raise TypeError(f"Mixed: cameras must be of one model to have a {what}; got several models. {instead}")

    def _in_order(self, tensor: Tensor, dim: int = 0) -> Tensor:
        """Return rows of the groups, one after the other along a dim, in the order of the batch."""
        if self._order == tuple(range(len(self._order))):
            return tensor
        return tensor.index_select(dim, torch.tensor(self._order, device=tensor.device))

    def _evaluate(
        self, direction: Direction, rows: Tensor, lead: torch.Size, tensors: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor]:
        results = []
        for group, pair in zip(self._groups, self._pairs(tensors), strict=True):
            here, count = rows, lead
            if len(self._groups) > 1:
                here, count = rows[group.index_on(rows.device)], torch.Size((len(group.rows),))
            cameras_of = partial(self._kept_cameras, group)
            results.append(evaluate_rows(group.model, direction, here, count, pair, cameras_of, None))
        if len(results) == 1:
            return results[0]
        planes, valid = zip(*results, strict=True)
        return self._in_order(torch.cat(planes, 1), 1), self._in_order(torch.cat(valid))

    def _kept_cameras(self, group: _Group, intrinsics: Tensor, distortion: Tensor) -> CameraRows:
        """Return a group's cameras, kept until a value changes; unusable members warn."""
        found = kept_cameras(group.memo, group.model, intrinsics, distortion)
        if found.usable is not None:
            for member in map(self._member, group.members):
                if not (member._expects_unusable or member._told):
                    camera_rows(member, *(t.expand(*member.batch_shape, t.shape[-1]) for t in member.tensors))
        return found

    def explain(self, points: Numbers) -> list[str]:
        """Explain in words why points (B, *N, 3) have no pixel; see `Camera.explain`."""
        rows, _ = as_points(points, "points", 3, self.batch_shape, (self.intrinsics,), "Mixed")
        return [line for camera, mine in zip(self, rows, strict=True) for line in camera.explain(mine)]

    def of_members(self, members: Iterable[Camera]) -> Self:
        """Return the batch of others of the same kinds, each in the place of one of `cameras`."""
        return type(self)(members, order=_among_used(cast("list[Camera]", list(self.cameras)), self._places)[1])

    def by_groups(self, change: Callable[[Camera], Camera]) -> Self:
        """Return the batch of the cameras that `change` returns for the groups."""
        if not callable(change):
            raise TypeError(f"Mixed: change must be a function of a camera that returns a camera; got {shown(change)}")
        return type(self).of_groups([(rows, change(camera)) for rows, camera in self.groups])

    def each(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Return the batch with all tensors (C, n) of each group changed by the same function."""
        return self.by_groups(lambda group: group.each(change))

    def expand(self, *batch: int | Sequence[int]) -> Self:
        """Expand like `Camera.expand`: a batch of one becomes one of many, any other one keeps its dim."""
        sizes: Any = batch[0] if len(batch) == 1 and isinstance(batch[0], Sequence) else batch
        if tuple(sizes) in ((len(self),), (-1,)):
            return self
        if len(self) != 1 or len(sizes) != 1:
            raise ValueError(f"Mixed: batch must fit dims ({len(self)},); got {shown(tuple(sizes))}")
        return type(self)([self.groups[0][1].expand(sizes)])

    def replace(
        self,
        intrinsics: Numbers | None = None,
        distortion: Numbers | None = None,
        image_size: Sequence[int] | None = None,
    ) -> Self:
        """Return the batch with other intrinsics (B, 4), or another image size; see `Camera.replace`."""
        if distortion is not None:
            self._refuse("distortion", "Use camera.by_groups(lambda group: group.replace(distortion=...))")
        as_image_size(image_size, "Mixed")
        if intrinsics is None:
            return self.by_groups(lambda group: group.replace(image_size=image_size))
        given = as_numbers_of(self, intrinsics, "intrinsics")
        if given.shape not in ((4,), (1, 4), (len(self), 4)):
            raise ValueError(f"Mixed: intrinsics must be ({len(self)}, 4) or (4,); got shape {tuple(given.shape)}")
        given = given.expand(len(self), 4)
        learns = [self._member(i).intrinsics.requires_grad for i, _ in self._places]
        new = []
        for (rows, group), state in product(self.groups, (False, True)):
            here = [n for n, row in enumerate(rows) if learns[row] == state]
            if not here:
                continue
            part, places = group if len(here) == len(rows) else group[here], [rows[n] for n in here]
            made = part.replace(given[places], None, image_size)
            if isinstance(made.intrinsics, nn.Parameter):  # made of plain numbers
                made.intrinsics.requires_grad_(state)
            new.append((places, made))
        return type(self).of_groups(new)

    def __getitem__(self, index: Any) -> Camera:  # type: ignore[override]
        """Return one camera for an int, itself if it was given alone; otherwise the `Mixed` of a part of the batch.

        Raises:
            IndexError: If the index is beyond the batch, or of more than one dim.
        """
        try:
            taken = torch.arange(len(self._places))[index]
        except (IndexError, TypeError, ValueError, RuntimeError) as error:
            raise refused_index(self, index, error) from None
        if taken.ndim == 0:
            i, row = self._places[int(taken)]
            camera = self._member(i)
            return camera[row] if camera.batch_shape else camera
        if taken.ndim > 1:
            raise IndexError(f"Mixed: index must leave at most one batch dim; got {index!r}")
        places = [self._places[row] for row in taken.tolist()]
        if not places:
            raise IndexError(f"Mixed: index must leave a camera of ({len(self._places)},); got {index!r}")
        members = cast("list[Camera]", list(self.cameras))
        used, order = _among_used(members, places)
        return type(self)([members[i] for i in used], order=order)

    def convert(self, *_: Any, **__: Any) -> NoReturn:
        """Raise a TypeError: use `camera.by_groups(lambda group: group.convert(model).camera)`."""
        self._refuse("conversion", "Use camera.by_groups(lambda group: group.convert(model).camera)")

    @classmethod
    def from_matrix(cls, *_: Any, **__: Any) -> NoReturn:
        """Raise a TypeError: only cameras of a model are made of numbers."""
        cls._refuse("constructor from numbers", "Make each camera by its model, and ct.Mixed([...]) of them")

    from_fov = from_matrix

    def __repr__(self) -> str:
        counts = Counter(
            f"{group.model.__name__}({' '.join(self._member(group.members[0]).distortion_names)})"
            for group in self._groups
            for _ in group.rows
        )
        named = ", ".join(f"{count} {name}" for name, count in counts.items())
        return f"Mixed({named}, image_size={self.image_size})"


def cat(cameras: Iterable[Camera], *_more: object) -> Camera:
    """Concatenate cameras to one batch, as `torch.cat` does tensors; a single camera is one row.

    `torch.cat` of cameras, `torch.stack` of single ones and torch's `default_collate` give the same. Cameras of one
    model and number of coefficients become a batch of that model, others a `Mixed`. Fixed numbers stay fixed, and
    gradients go to every camera that learns.

    Args:
        cameras: single cameras, batches of one dim, and `Mixed` ones, whose images are of one size.

    Raises:
        TypeError: If something is no camera. ValueError: If there are no cameras, more than one batch dim, images of
            different sizes, or different devices.
    """
    if _more:
        raise TypeError(f"cat: cameras must be one list, as in cat([a, b]); got {1 + len(_more)} arguments")
    groups = Mixed(_members(cameras, "cat")).groups
    return groups[0][1] if len(groups) == 1 else Mixed.of_groups(groups)


def _count(camera: Camera) -> int:
    return len(camera) if camera.batch_shape else 1


def _inverse(order: Sequence[int]) -> list[int]:
    """Return the place of each number from 0 in an order that has each once."""
    return sorted(range(len(order)), key=order.__getitem__)


def _among_used(
    members: Sequence[Camera], places: Sequence[tuple[int, int]]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the members that hold the cameras at (member, row), and the cameras' places among all that these hold."""
    used = tuple(dict.fromkeys(i for i, _ in places))
    starts = accumulate((_count(members[i]) for i in used), initial=0)
    first = dict(zip(used, starts, strict=False))
    return used, tuple(first[i] + row for i, row in places)


def _members(cameras: Any, owner: str) -> list[Camera]:
    """Return the single cameras and batches in a list as users pass it."""
    if isinstance(cameras, Camera):
        cameras = [cameras]
    if isinstance(cameras, Mapping):
        raise TypeError(f"{owner}: cameras must be a list of cameras; got a dict. Pass list(d.values()) for a dict d")
    try:
        given = list(cameras)
    except TypeError:
        raise TypeError(f"{owner}: cameras must be a list of cameras; got {type(cameras).__name__}") from None
    for i, camera in enumerate(given):
        if not isinstance(camera, Camera):
            raise TypeError(f"{owner}: cameras[{i}] must be a Camera; got {no_camera(camera)}")
    members = [one for camera in given for one in (camera if isinstance(camera, Mixed) else (camera,))]
    if not any(map(_count, members)):
        raise ValueError(f"{owner}: cameras must hold at least one; got an empty list")
    for i, camera in enumerate(members):
        if len(camera.batch_shape) > 1:
            shape = tuple(camera.batch_shape)
            raise ValueError(f"{owner}: cameras[{i}] must be single, or a batch of one dim; got batch dims {shape}")
    devices = list(dict.fromkeys(str(camera.intrinsics.device) for camera in members))
    if len(devices) > 1:
        raise ValueError(f"{owner}: cameras must be on one device; got {devices}. Move them with .to(device)")
    sizes = list(dict.fromkeys(camera.image_size for camera in members))
    if len(sizes) > 1:
        raise ValueError(
            f"{owner}: the images of a batch must have one size; got {', '.join(map(str, sizes))} (height, "
            "width). Use camera.resize, .crop and .pad as for the images"
        )
    return members


def _as_order(order: Sequence[int], count: int) -> list[int]:
    try:
        places = [operator.index(place) for place in order]
    except TypeError:
        raise TypeError(f"Mixed: order must be places among {count} cameras, from 0; got {shown(order)}") from None
    if not places or min(places) < 0 or max(places) >= count:
        raise ValueError(f"Mixed: order must be places among {count} cameras, from 0; got {places}")
    return places


def kind(camera: Camera) -> tuple[type[Camera], int, tuple[int, int] | None]:
    """Return the properties that cameras must have in common to be rows of one batch of one model."""
    return type_before_parametrizations(camera), camera.distortion.shape[-1], camera.image_size


def collate_cameras(batch: Sequence[Camera], *, collate_fn_map: Any = None) -> Camera | list[Camera]:
    """Return single cameras as one batch, of several models if need be; others as a list."""
    if in_worker():  # no graph can leave it
        batch = [camera.detach() for camera in batch]
    return list(batch) if any(camera.batch_shape for camera in batch) else cat(batch)


def _joined(cls: type[Camera], function: Any, _: Any, given: Any = (), options: Any = None) -> Camera:
    """Return the result of `torch.stack` and `torch.cat` of cameras, that of `cat`; raise for other functions."""
    options = dict(options or {})
    cameras = given[0] if given else options.pop("tensors", None)
    if function not in (torch.stack, torch.cat, torch.concat, torch.concatenate):
        name = getattr(function, "__name__", function)
        raise TypeError(
            f"{cls.__name__}: a function of cameras must be torch.stack or torch.cat; got {name}. Pass a tensor, like "
            "camera.intrinsics or camera.K"
        )
    other = {*given[1:], *options.values()} - {0, -1, None}
    if other:
        raise ValueError(f"{cls.__name__}: cameras must be joined along dim 0, without out; got {shown(other.pop())}")
    for i, camera in enumerate(cameras if function is torch.stack else ()):
        if isinstance(camera, Camera) and camera.batch_shape:
            shape = tuple(camera.batch_shape)
            raise ValueError(f"stack: cameras[{i}] must be single; got batch dims {shape}. torch.cat joins batches")
    return cat(cameras)


# Samples that hold cameras then go through a DataLoader as they are. torch documents this map for the purpose.
COLLATE_FUNCTIONS[Camera] = collate_cameras
# set from here, because a batch of several models is a `Mixed`, which is a camera itself
Camera.__torch_function__ = classmethod(_joined)  # type: ignore[attr-defined]
