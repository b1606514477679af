"""A change of cameras: from which to which the samples of a batch go, how far turned, and how all they hold moves."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from camtorch.augment.part import Part
from camtorch.cameras.camera import Camera
from camtorch.cameras.mixed import Mixed
from camtorch.evaluate.tensors import known_false, known_true
from camtorch.poses.rotations import turn
from camtorch.values.arguments import present, warn
from camtorch.values.dtypes import narrow, widen
from camtorch.values.module import remade
from camtorch.warp.boxes import corners_of, in_order
from camtorch.warp.options import Mode, Options, as_fill

_HALF = 5e-3  # absolute: rotations that were half precision on the way are the same ones
_ROUNDED, _ABSOLUTE = 1e-5, 1e-8  # relative and absolute: cameras that were float32 on the way are the same ones
TensorOrPair = TypeVar("TensorOrPair", Tensor, tuple[Tensor, Tensor])


def _same(value: Tensor) -> Tensor:
    return value


def as_is(camera: Camera, rows: Tensor) -> Tensor:
    """Return values of samples that nothing moves."""
    return rows


def _renamed(old: str, method: str, batched: bool) -> Any:
    """Return a property of a change by its name before 0.6: what a method returns."""

    def get(change: Change) -> Any:
        warn(f"Change.{old} is now Change.{method}({batched}); 0.7 removes the old name", FutureWarning)
        return getattr(change, method)(batched)

    return property(get, doc=f"The name of `{method}({batched})` before 0.6.")


class Change:
    """The effect of a draw on a batch of `count` samples; made by an augmentation's `change`.

    Args:
        count: how many samples.
        parts: every sample is in one of them.
        mixed: return a `Mixed`, as the cameras came, even if all cameras are of one model.
        gate: (count,) bool, where values may not be looked at: which of the samples in parts that move do so.
    """

    __slots__ = ("_inverse", "_order", "count", "gate", "mixed", "parts")
    count: int
    parts: list[Part]
    mixed: bool
    gate: Tensor | None

    def __init__(self, count: int, parts: Sequence[Part], *, mixed: bool = False, gate: Tensor | None = None):
        self.count, self.parts, self.mixed, self.gate = count, list(parts), mixed, gate
        self._inverse: Change | None = None
        self._order: list[int] | None = None
        if self.parts[0].rows is not None:
            rows = [row for part in self.parts for row in part.rows or ()]
            self._order = sorted(range(len(rows)), key=rows.__getitem__) if rows else None

    @property
    def source(self) -> Camera:
        """The cameras before, a batch of all samples."""
        return self._together([part.camera for part in self.parts])

    @property
    def target(self) -> Camera:
        """The cameras after."""
        return self._together([part.target if self.gate is None else self._gated(part) for part in self.parts])

    def _gated(self, part: Part) -> Camera:
        """Return the cameras of a part after the change, where the gate is open, and those before it elsewhere."""
        new, gate = part.target, present(self.gate, "a gate")
        gate = gate if part.rows is None else gate[part.rows]
        if type(new) is not type(part.camera):
            raise ValueError(
                "Change: with p < 1 the camera model must stay where draws may not be read, as in compiled code; got "
                f"{type(new).__name__} for {type(part.camera).__name__}"
            )
        gate = gate.to(new.intrinsics.device).unsqueeze(-1)
        intrinsics = torch.where(gate, new.intrinsics, part.camera.intrinsics)
        return remade(new, intrinsics=intrinsics, distortion=torch.where(gate, new.distortion, part.camera.distortion))

    def _together(self, cameras: list[Camera]) -> Camera:
        """Return cameras, given part by part, as a batch of all samples."""
        batches = [camera.expand(n) for camera, n in zip(cameras, self._counts, strict=True)]
        rows = [part.rows for part in self.parts if part.rows is not None]
        if not rows:
            return batches[0]
        check_sizes(camera.size_for("Change") for camera in cameras)
        together = Mixed.of_groups(list(zip(rows, batches, strict=True)))
        groups = together.groups
        return together if self.mixed or len(groups) > 1 else groups[0][1]

    def _in_order(self, pieces: Sequence[Tensor]) -> Tensor:
        """Return rows, given part by part, as a batch of all samples."""
        if pieces[0].ndim > 2:  # of images: the rest keeps its shape
            check_sizes((piece.shape[-2], piece.shape[-1]) for piece in pieces)
        return torch.cat(tuple(pieces))[self._order]

    @property
    def _counts(self) -> list[int]:
        return [self.count if part.rows is None else len(part.rows) for part in self.parts]

    def camera_for_sample(self, batched: bool) -> Camera:
        """Return a copy of the cameras after, or of the one of a change of one sample: a sample's, not the change's."""
        first = self.parts[0]
        if first.motion is not None and first.rows is None and self.gate is None:
            return first.motion.new_target((self.count,) if batched else ())
        return (self.target if batched else self.target[0]).clone()

    def rotation_for_sample(self, batched: bool) -> Tensor:
        """Return a copy of the rotations (count, 3, 3), or of the one (3, 3) of a change of one sample."""
        first = self.parts[0]
        rotation = None if first.motion is None else first.motion.rotation
        if self.gate is None and not batched:
            return _eye(first.camera.intrinsics) if rotation is None else rotation.reshape(3, 3).clone()
        if self.gate is None and first.rows is None and rotation is not None:
            return rotation.expand(self.count, 3, 3).clone()
        return (self.rotation if batched else self.rotation[0]).clone()

    several: Camera = _renamed("several", "camera_for_sample", batched=True)
    single: Camera = _renamed("single", "camera_for_sample", batched=False)
    single_rotation: Tensor = _renamed("single_rotation", "rotation_for_sample", batched=False)

    @property
    def rotation(self) -> Tensor:
        """(count, 3, 3): `ray_after = R ray_before`."""
        rotation = self._turns([part.rotation for part in self.parts])
        if self.gate is not None:
            rotation = torch.where(self.gate.to(rotation.device)[:, None, None], rotation, _eye(rotation))
        return rotation

    @property
    def mirrored(self) -> Tensor | None:
        """(count,) bool: which samples are seen in a mirror; None if none is."""
        turns = [part.rotation if part.motion is not None and part.motion.may_mirror else None for part in self.parts]
        if all(turn is None for turn in turns):
            return None
        x, y, z = self._turns(turns).unbind(-2)
        rows = (torch.linalg.cross(x, y) * z).sum(-1) < 0  # the determinant, of which torch's own takes many steps
        return None if known_true(~rows) else rows

    def _turns(self, rotations: Sequence[Tensor | None]) -> Tensor:
        """Return rotations, given part by part, as those of all samples, (count, 3, 3)."""
        turns = []
        for part, rotation, n in zip(self.parts, rotations, self._counts, strict=True):
            turns.append((_eye(part.camera.intrinsics) if rotation is None else rotation).expand(n, 3, 3))
        return turns[0] if self._order is None else self._in_order(turns)

    def leads_to(self, camera: Camera | Sequence[Camera], rotation: Tensor | None = None) -> bool:
        """Whether this change may end with `camera` and `rotation`: False if their values are known to differ."""
        target, given = self.target, one_or_batch(camera)
        pairs = [(target.intrinsics.reshape(-1, 4), given.intrinsics.reshape(-1, 4), _ABSOLUTE)]
        if rotation is not None:
            pairs.append((self.rotation, rotation.reshape(-1, 3, 3), _HALF))
        if not target.is_mixed and not given.is_mixed:
            pairs.append((_coefficients(target), _coefficients(given), _ABSOLUTE))
        elif len(pairs[0][0]) == len(pairs[0][1]):
            cameras = zip(target, given if given.batch_shape else [given], strict=True)
            pairs += [(_coefficients(ours), _coefficients(its), _ABSOLUTE) for ours, its in cameras]
        return all(
            ours.shape == its.shape
            and not known_false(torch.isclose(ours.double(), its.to(ours.device).double(), _ROUNDED, near))
            for ours, its, near in pairs
        )

    def then(self, second: Change) -> Change:
        """Return this change followed by one of the cameras that it ends with, by single warps.

        Points that the cameras in between do not see are seen if the first one and the last one see them.
        """
        if self.gate is not None or second.gate is not None:
            raise ValueError(
                "Compose: compiled code must have p=1 of all but edits, as it may not look at draws; got less"
            )
        mixed = self.mixed or second.mixed
        if all(part.rows is None for part in (*self.parts, *second.parts)):
            return Change(self.count, [self.parts[0].then(second.parts[0])], mixed=mixed)

        def places(change: Change) -> list[tuple[Part, dict[int, int]]]:
            """Return each part, with where each of its samples is among its rows."""
            rows = [range(self.count) if part.rows is None else part.rows for part in change.parts]
            return [(part, {row: i for i, row in enumerate(its)}) for part, its in zip(change.parts, rows, strict=True)]

        parts = []
        for pairs in itertools.product(places(self), places(second)):
            rows = [row for row in pairs[0][1] if row in pairs[1][1]]
            if rows:
                first, last = (
                    part if rows == list(place) else part.take([place[row] for row in rows]) for part, place in pairs
                )
                parts.append(replace(first.then(last), rows=rows))
        return Change(self.count, parts, mixed=mixed)

    def with_options(self, options: Options) -> Change:
        """Return the change with its warps made anew by other options."""
        return self._with_parts([part.with_options(options) for part in self.parts])

    def _with_parts(self, parts: Sequence[Part], samples: list[int] | None = None) -> Change:
        """Return a change like this one by other parts, of all its samples or of those named, which may repeat."""
        count = self.count if samples is None else len(samples)
        gate = self.gate if samples is None or self.gate is None else self.gate[samples]
        return Change(count, parts, mixed=self.mixed, gate=gate)

    def row(self, i: int) -> Change:
        """Return the change of one sample; -1 is the last one, as in a list."""
        row = i if i >= 0 else i + self.count
        for part in self.parts:
            rows = range(self.count) if part.rows is None else part.rows
            if row in rows:
                return self._with_parts([part.take([rows.index(row)])], [row])
        raise IndexError(f"Change: row must be one of {self.count} samples; got {i}")

    def inverse(self) -> Change:
        """Return the change back. Pixels that left the image stay lost, and the light of the lens stays as it is."""
        if self._inverse is not None:  # its warps hold the maps that they have made
            return self._inverse
        parts = [
            part if part.motion is None else Part(part.target, part.warp.inverse(), rows=part.rows)
            for part in self.parts
        ]
        self._inverse = self._with_parts(parts)
        return self._inverse

    def each(
        self, value: Tensor, move: Callable[[Part, Tensor], TensorOrPair], stay: Callable[[Camera, Tensor], Any] = as_is
    ) -> TensorOrPair:
        """Return `move(part, rows)` of every part's rows of `value`, and `stay(camera, rows)` if nothing moves.

        Both give a tensor, or a pair of tensors.
        """

        def of(part: Part) -> TensorOrPair:
            # results share no memory with values that the caller passed
            rows = value[part.rows] if part.rows is not None else value.clone() if part.motion is None else value
            return stay(part.camera, rows) if part.motion is None else move(part, rows)

        results = [of(part) for part in self.parts]
        gate = self.gate
        moved = results[0] if self._order is None else _both(self._in_order, *results)
        if gate is not None:
            moved = _both(lambda pair: gated(gate, *pair), moved, stay(self.parts[0].camera, value))
        return moved

    def images(self, images: Tensor, **options: Any) -> Tensor:
        """Move images (count, C, H, W), with the colours and the light of the lens; options as of `Warp.forward`."""

        def move(part: Part, rows: Tensor) -> Tensor:
            warp, fill = part.warp, options.get("fill")
            values = warp.fill if fill is None or part.shades is None else as_fill(fill, "Warp")
            if part.shades is not None and rows.shape[1] == 3 and len(values) in (1, 3):  # `forward` refuses others
                red, blue = part.shades
                fills = values if len(values) == 3 else [fill] * 3
                colours = enumerate(zip((red, warp, blue), fills, strict=True))
                moved = torch.cat([w.pin()(rows[:, i : i + 1], **{**options, "fill": f}) for i, (w, f) in colours], 1)
            else:
                moved = warp.pin().forward(rows, **options)
            return moved if part.light is None else narrow(widen(moved) * part.light.to(moved.device), rows.dtype)

        return self.each(images, move)

    def labels(self, masks: Tensor, fill: float = 0.0, mode: Mode = "nearest") -> Tensor:
        """Move masks (count, C, H, W) of any dtype by their nearest values; unseen pixels are `fill`."""

        def move(part: Part, rows: Tensor) -> Tensor:
            return part.warp.pin().forward(rows, mode=mode, padding_mode="zeros", fill=fill)

        return self.each(masks, move)

    def valid_mask(self) -> Tensor:
        """Return the pixels at which the images show something, (count, 1, H', W') bool."""
        camera = self.parts[0].camera
        shape = self.count, 1, camera.height, camera.width
        everywhere = torch.ones(shape, dtype=torch.bool, device=camera.intrinsics.device)
        return self.each(everywhere, lambda part, rows: part.warp.pin().valid_mask().expand(len(rows), -1, -1, -1))

    def points(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Move pixels (count, *N, 2), and return valid (count, *N): on the image."""

        def stay(camera: Camera, rows: Tensor) -> tuple[Tensor, Tensor]:
            return rows, camera.contains(rows)

        return self.each(pixels, lambda part, rows: part.warp.transform_points(rows), stay)

    def boxes(
        self, boxes: Tensor, read: Callable[[Tensor], Tensor] = _same, write: Callable[[Tensor], Tensor] = _same
    ) -> tuple[Tensor, Tensor]:
        """Move boxes (count, *N, 4) of x1, y1, x2, y2, or of a form that is read and written, and return valid."""

        def move(part: Part, rows: Tensor) -> tuple[Tensor, Tensor]:
            moved, valid = part.warp.transform_boxes(read(rows))
            return write(moved), valid

        def stay(camera: Camera, rows: Tensor) -> tuple[Tensor, Tensor]:
            corners = read(rows)
            limits = rows.new_tensor((camera.width, camera.height)) - 0.5
            on_image = (corners[..., :2] <= limits).all(-1) & (corners[..., 2:] >= -0.5).all(-1)
            return rows, on_image & in_order(corners) & torch.isfinite(corners).all(-1)

        return self.each(boxes, move, stay)

    def quadrilaterals(self, corners: Tensor) -> tuple[Tensor, Tensor]:
        """Move quadrilaterals (count, *N, 4, 2) to corners of enclosing boxes, and return valid (count, *N)."""

        def move(part: Part, rows: Tensor) -> tuple[Tensor, Tensor]:
            enclosing, valid = part.warp.enclose(rows)
            return corners_of(enclosing), valid

        def stay(camera: Camera, rows: Tensor) -> tuple[Tensor, Tensor]:
            return rows, torch.ones_like(rows[..., 0, 0], dtype=torch.bool)

        return self.each(corners, move, stay)

    def rays(
        self, rays: Tensor, read: Callable[[Tensor], Tensor] = _same, write: Callable[[Tensor], Tensor] = _same
    ) -> Tensor:
        """Turn directions and points (count, *N, 3) of the camera frame; their lengths stay.

        Values of another form are read as rays, and written in their form again.
        """

        def move(part: Part, rows: Tensor) -> Tensor:
            rotation = part.rotation
            if rotation is None:
                return rows.clone()
            moved = write(turn(rotation, read(rows), "rays"))
            if read is _same or rotation.ndim == 2:
                return moved
            # rows that do not turn keep their bits: reading and writing rounds
            still = (rotation == _eye(rotation)).all(-1).all(-1)
            return torch.where(still.reshape(-1, *[1] * (rows.ndim - 1)), rows.to(moved), moved)

        return self.each(rays, move)

    def positions(self, points: Tensor) -> Tensor:
        """Move points (count, *N, 3) of the camera frame: they turn, and shift if the camera moves."""

        def move(part: Part, rows: Tensor) -> Tensor:
            assert part.motion is not None
            moved = part.motion.transform_positions(rows)
            return moved.clone() if moved is rows else moved

        return self.each(points, move)

    def distance(self, distance: Tensor) -> Tensor:
        """Move distances from the camera (count, C, H, W); unknown ones are 0."""
        return self.each(distance, lambda part, rows: narrow(part.warp.moved_distance(widen(rows)), rows.dtype))

    def depth(self, depth: Tensor) -> Tensor:
        """Move depths along z (count, 1, H, W), positive in front; unknown ones are 0.

        Edits leave values as they are; another lens or mount sees the same distance at another depth.
        """
        return self.each(depth, lambda part, rows: part.warp.moved_depth(rows))


def by_models(
    count: int,
    camera: Camera,
    part: Callable[[list[int] | None, Camera], Part],
    chosen: Sequence[bool] | None = None,
    gate: Tensor | None = None,
) -> Change:
    """Return the change of `count` samples, with one part for each camera model of the batch.

    Args:
        count: how many samples.
        camera: of all samples, or a batch of theirs.
        part: (rows, cameras) -> part: which samples of a model move, None for all, and their cameras.
        chosen: (count,): which samples move; the others stay, in parts of their own. None: all move.
        gate: see `Change`.
    """
    camera = one_or_batch(camera)
    moves = [True] * count if chosen is None else chosen
    all_move = all(moves)
    if all_move and not isinstance(camera, Mixed):
        return Change(count, [part(None, camera)], gate=gate)
    parts = []
    for rows, group in camera.groups if isinstance(camera, Mixed) else [(list(range(count)), camera)]:
        for do_move in (True, False):
            here = [n for n, row in enumerate(rows) if moves[row] == do_move]
            if here:
                samples = [rows[n] for n in here]
                source = group[here] if group.batch_shape and len(here) < len(rows) else group
                parts.append(replace(part(samples, source) if do_move else Part(source), rows=samples))
    return Change(count, parts, mixed=isinstance(camera, Mixed), gate=gate)


def one_or_batch(camera: Camera | Sequence[Camera]) -> Camera:
    """Return the one camera of all samples, or the batch of theirs; a list becomes a batch."""
    camera = camera if isinstance(camera, Camera) else Mixed(camera)
    return camera[0] if camera.batch_shape == (1,) else camera


def _coefficients(camera: Camera) -> Tensor:
    """Return the coefficients (N, n) of cameras of one model."""
    batch, count = camera.batch_shape, camera.distortion.shape[-1]
    return camera.distortion.expand(*batch, count).reshape(batch.numel(), count)


def _eye(like: Tensor) -> Tensor:
    return torch.eye(3, dtype=like.dtype, device=like.device)


def check_sizes(sizes: Iterable[tuple[int, int]], owner: str = "Change") -> None:
    """Raise a ValueError unless the images of a batch come out in one size."""
    found = set(sizes)
    if len(found) > 1:
        raise ValueError(
            f"{owner}: samples of one batch must come out in one size; got {sorted(found)}. same_on_batch=True moves "
            "all alike, with p < 1 the size must stay, and single samples may be of any size"
        )


def gated(gate: Tensor, moved: Tensor, kept: Tensor) -> Tensor:
    """Return rows of `moved` where the gate (B,) is open, of `kept` elsewhere."""
    return torch.where(gate.to(moved.device).reshape(-1, *[1] * (moved.ndim - 1)), moved, kept.to(moved.dtype))


def _both(function: Callable[[tuple[Tensor, ...]], Tensor], *results: TensorOrPair) -> TensorOrPair:
    """Apply a function to the results, or to the first and to the second ones if they are pairs."""
    if isinstance(results[0], tuple):
        first, second = (function(pieces) for pieces in zip(*results, strict=True))
        return first, second
    return function(results)
