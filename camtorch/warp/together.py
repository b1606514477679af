"""Fields of samples that move together: by one call of C, or without the library pixels and boxes in torch."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from camtorch.evaluate.tensors import known_true
from camtorch.native import memory, structs
from camtorch.native.library import loaded
from camtorch.native.sampler import describe, is_quick, maker, takes, tiles_of
from camtorch.projection.native_cameras import Native
from camtorch.projection.native_moves import NativeLattices, NativeMove, follow, run_and_follow
from camtorch.values.dtypes import in_range
from camtorch.values.threads import spread, thread_count
from camtorch.warp.boxes import along_edges, around, corners_of, in_order
from camtorch.warp.lattice import FEWEST_CELLS, MOST_KEPT_NODES, coarse, probes
from camtorch.warp.options import Options, Sampler, serving_all
from camtorch.warp.sampling import SHRINKS, SURELY
from camtorch.warp.warp import Warp

Label = Literal["pixels", "boxes", "rays", "columns", "pose", "rotation vectors"]
"""What moves beside images: pixels, boxes, directions and points of the camera frame, or columns of such in a matrix,
of which those of a pose begin with a rotation; or rotation vectors."""
How = Sampler | Label
"""How images are sampled, or which label a value is."""
MovedField = tuple[Tensor, Tensor | None]
"""A value after a move, and which of it is valid, if it has validity."""
Reader = Callable[[Tensor], MovedField]
"""Has C read a value, and returns its results."""
Sizes = tuple[tuple[int, int], tuple[int, int]]  # (height, width) of the source's image, and of the target's

_FORMS: dict[How, int] = {"pose": structs.POSE, "rotation vectors": structs.ROTATION_VECTORS}  # others are rays
_TILES_FOR_ONE_THREAD = 2  # an image of no more is made by one
_SAMPLES_PER_THREAD = 4  # with as many, threads that idle at the end matter little


def call_for(
    sizes: Sizes,
    dtype: torch.dtype,
    options: Options,
    values: Mapping[str, Tensor],
    hows: Mapping[str, How],
    batched: bool,
) -> SampleCall | None:
    """Return the call of native code that moves all that samples of a form hold.

    None if no lattice serves, images shrink or have unusual strides, or threads would idle: each takes whole samples.

    Args:
        sizes: of both images.
        dtype: of the cameras' numbers.
        options: of the warp.
        values: on the CPU and without a graph, by name: images (B, C, H, W), masks (B, H, W) as well, and labels.
        hows: name -> what a value is. Labels are pixels (B, *N, 2) of the source's image; of a single sample boxes
            too, and, in the dtype of the cameras, rays and rotation vectors (*N, 3), columns (3 or 4, N) that turn,
            and poses (3 or 4, 4).
        batched: whether there is a dim B.
    """
    tolerance, antialias = options["tolerance"], options["antialias"]
    if not tolerance or antialias:
        return None
    count = _count_of(values, batched)
    threads = thread_count()
    if count > 1 and (dtype != torch.float32 or (count % threads and count < _SAMPLES_PER_THREAD * threads)):
        return None
    n, m = (math.ceil(side / structs.STEP) for side in sizes[1])
    # too small for a lattice, or too large to be kept
    if min(n, m) < FEWEST_CELLS or (n + 5) * (m + 5) > MOST_KEPT_NODES:
        return None
    for name, how in hows.items():
        value = values[name]
        if isinstance(how, Sampler):
            image = _as_images(value, batched)
            result = maker(image, count, sizes[1])()
            serves = 0 not in result.shape and takes(image.dtype, how.mode) and is_quick(image, result, how.mode)
        else:
            serves = torch.promote_types(value.dtype, dtype) == dtype
        if not serves:
            return None
    return SampleCall(sizes, dtype, options, values, hows, batched)


def _count_of(values: Mapping[str, Tensor], batched: bool) -> int:
    return len(next(iter(values.values()))) if batched else 1


@functools.lru_cache(maxsize=16)
def _coarse(size: tuple[int, int], dtype: torch.dtype) -> tuple[Tensor, tuple[int, int], int]:
    """Return pixels (1, N, 2) that show how far an image shrinks, their numbers down and across, and their step."""
    first, step = coarse(size)
    with torch.inference_mode(False):
        v, u = (torch.arange(first, side, step, dtype=dtype, device="cpu") for side in size)
        return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).view(1, -1, 2), (len(v), len(u)), step


def _surely_keeps_size(back: NativeMove, sizes: Sizes) -> bool:
    """Whether no image shrinks so far that a `HalvingWarp` would halve it; back: from the target to the source."""
    nodes, shape, step = _coarse(sizes[1], back.dtype)
    places = back.rows(nodes, structs.POSITIONS)[0].numpy().reshape(-1, *shape, 2)
    seen: np.ndarray[Any, Any] = np.all(abs(places) <= 1, axis=-1)
    places = places * np.array([sizes[0][1] / 2, sizes[0][0] / 2], places.dtype)
    down = places[:, 1:] - places[:, :-1], seen[:, 1:] & seen[:, :-1]
    across = places[:, :, 1:] - places[:, :, :-1], seen[:, :, 1:] & seen[:, :, :-1]
    total, count = 0.0, 0  # of the steps between neighbours that are both seen
    for steps, both in (down, across):
        total = total + (np.hypot(steps[..., 0], steps[..., 1]) * both).sum((1, 2))
        count = count + both.sum((1, 2))
    return bool((total < SURELY * SHRINKS * step * np.maximum(count, 1)).all())


def _as_images(value: Tensor, batched: bool) -> Tensor:
    """Return an image or a mask as (B, C, H, W)."""
    value = value if batched else value.unsqueeze(0)
    return value if value.ndim == 4 else value.unsqueeze(1)


def _image_maker(value: Tensor, batched: bool, make: Callable[[], Tensor]) -> Callable[[], Tensor]:
    """Return what makes an empty image or mask like `value`; make: what makes images (B, C, H, W)."""
    is_image = value.ndim == 3 + batched

    def made() -> Tensor:
        result = make() if is_image else make().squeeze(1)
        return result if batched else result.squeeze(0)

    like = made()
    if like.nbytes >= memory.LEAST:
        return made
    return functools.partial(torch.empty_strided, like.shape, like.stride(), dtype=like.dtype, device="cpu")


class SampleCall:
    """`Together` of geometry.h for samples of one form.

    What they have in common is written once, when the call is made, for as many threads as there are. Each run writes
    what a draw changes: both cameras, the rotation, and where values and results lie.
    """

    def __init__(
        self,
        sizes: Sizes,
        dtype: torch.dtype,
        options: Options,
        values: Mapping[str, Tensor],
        hows: Mapping[str, How],
        batched: bool,
    ):
        """Take the arguments of `call_for`."""
        self._sizes, self._dtype, self._batched = sizes, dtype, batched
        self._count, self._threads = _count_of(values, batched), thread_count()
        call = self._call = structs.Together()
        samplers = {name: how for name, how in hows.items() if isinstance(how, Sampler)}
        pixels = [name for name, how in hows.items() if how in ("pixels", "boxes")]
        self._lattices = self._lattices_of(samplers.values(), float(options["tolerance"] or 0))
        self._back = call.lattices.move  # from the target to the source, which images are sampled by
        jobs = self._jobs = (structs.Job * len(samplers))()
        moves = (structs.Move * len(pixels))()
        turns = (structs.Turned * (len(hows) - len(samplers) - len(pixels)))()
        call.jobs, call.job_count = call.keep(jobs), len(jobs)
        call.moves, call.move_count = call.keep(moves), len(moves)
        call.turned, call.turned_count = call.keep(turns), len(turns)
        if self._count > 1:  # C samples images as soon as their lattice is made
            call.lattices.jobs, call.lattices.job_count = call.jobs, call.job_count
        else:
            self._back.next = None  # one thread makes the lattice, and needs no counter of those made
        images, labels, vectors = iter(jobs), iter(moves), iter(turns)
        self._readers: dict[str, Reader] = {}
        for name, how in hows.items():
            if isinstance(how, Sampler):
                self._readers[name] = self._image_reader(next(images), values[name], how)
            elif name in pixels:
                self._readers[name] = self._pixel_reader(next(labels), values[name], how)
            else:
                self._readers[name] = self._vector_reader(next(vectors), values[name], how)
        self._copied = [name for name in pixels if values[name].dtype != dtype or not values[name].is_contiguous()]
        self._narrowed = {name: values[name].dtype for name in pixels if values[name].dtype != dtype}
        self._may_be_refused = [name for name, how in hows.items() if how in ("boxes", "pose", "rotation vectors")]
        # whether each run asks if images whose pixels are averaged shrink: these are halved elsewhere
        averaged = (how.mode != "nearest" and values[name].dtype != torch.bool for name, how in samplers.items())
        self._may_halve = options["antialias"] is None and any(averaged)
        self._images_of_call = len(samplers) if self._count == 1 else 0  # those of a batch are made with their lattices
        self._tiles = tiles_of(sizes[1])  # of an image, which threads share
        # whether one thread makes images and labels
        self._is_whole = self._tiles <= _TILES_FOR_ONE_THREAD or not self._images_of_call or self._threads == 1

    def _lattices_of(self, samplers: Iterable[Sampler], tolerance: float) -> NativeLattices:
        """Return the lattices by which all images are sampled, of which C has the struct."""
        padding = serving_all("zeros", *(how.padding_mode for how in samplers))
        back = structs.Move()
        back.turn_strides[:] = 0, 1, 3  # which transpose rotations
        with torch.inference_mode(False):
            nodes = probes(0, self._sizes[1], self._dtype)
            made = NativeLattices(back, nodes, self._sizes[1], self._sizes[0], tolerance, padding, self._count)
        self._call.lattices = made.struct
        return made

    def _image_reader(self, job: structs.Job, like: Tensor, how: Sampler) -> Reader:
        """Write into a job what all runs share; return what writes the rest in each run."""
        image = _as_images(like, self._batched)
        make_images = maker(image, self._count, self._sizes[1])
        fill = how.fill * image.shape[1] if len(how.fill) == 1 else how.fill
        describe(job, image, make_images(), how.mode, how.padding_mode, fill)
        self._lattices.lay(job)  # has the job sample by the positions of the lattice
        make = _image_maker(like, self._batched, make_images)

        def read(value: Tensor) -> MovedField:
            result = make()
            job.source, job.result = value.data_ptr(), result.data_ptr()
            return result, None

        return read

    def _pixel_reader(self, move: structs.Move, like: Tensor, how: How) -> Reader:
        """Write into a move what all runs share; return what writes the rest in each run."""
        dtype, back = self._dtype, self._back
        turn_strides: Any = back.turn_strides
        each, move.form = (2, structs.ON_IMAGE) if how == "pixels" else (4, structs.BOXES)
        many = like.numel() // (each * self._count) if self._count else 0
        move.turn_strides[:] = 0, 3, 1
        move.cameras = self._count
        move.height, move.width = self._sizes[1]
        move.count, move.tile = many, max(many, 1)
        move.row_strides[:] = move.result_strides[:] = each * many, each, 1

        def read(rows: Tensor) -> MovedField:
            result = torch.empty(rows.shape, dtype=dtype, device="cpu")
            valid = torch.empty(rows.shape[:-1], dtype=torch.bool, device="cpu")
            # the other way round than `back`, whose strides 1, 3 transpose the rotations
            move.from_, move.to, move.turns = back.to, back.from_, back.turns
            move.turn_strides[0] = turn_strides[0]
            move.rows, move.results, move.valid = rows.data_ptr(), result.data_ptr(), valid.data_ptr()
            return result, valid

        return read

    def _vector_reader(self, turned: structs.Turned, like: Tensor, how: How) -> Reader:
        """Write into what turns what all runs share; return what writes the rest in each run."""
        back, width = self._back, like.shape[-1]
        is_matrix = how in ("columns", "pose")
        turned.strides[:], turned.count = ((1, width), width) if is_matrix else ((3, 1), like.numel() // 3)
        turned.is_double = self._dtype == torch.float64
        turned.form = _FORMS.get(how, structs.RAYS)

        def read(value: Tensor) -> MovedField:
            result = value.clone()
            turned.turn, turned.rows, turned.results = back.turns, value.data_ptr(), result.data_ptr()
            return result, None

        return read

    def __call__(
        self, source: Native, target: Native, rotation: Tensor | None, values: Mapping[str, Tensor]
    ) -> dict[str, MovedField | None]:
        """Move `values` of the form from one camera to another; also return which pixels and boxes are valid.

        Nothing if the call does not serve. Boxes, poses and rotation vectors alone are None if some boxes take more
        than their outline, or some rotations are none.
        """
        call, back, dtype = self._call, self._back, self._dtype
        turn, step = None, 0  # the address of the rotations, and how many numbers further the next one lies
        if rotation is not None:
            if rotation.dtype != dtype or not rotation.is_contiguous():
                rotation = rotation.detach().to(dtype).contiguous()
            turn = rotation.data_ptr()
            step = 9 if rotation.ndim > 2 and len(rotation) > 1 else 0
        if self._may_halve:
            turns = None if rotation is None else rotation.mT
            if not _surely_keeps_size(NativeMove(target, source, turns, self._sizes[0], False), self._sizes):
                return {}
        # what a draw changes: cameras and rotation, and where values and results lie
        target.add_table()
        if call.move_count:
            source.add_table()
        back.from_, back.to = target.pointer, source.pointer
        back.turns, back.turn_strides[0] = turn, step
        if self._copied:
            values = {**values, **{name: values[name].to(dtype).contiguous() for name in self._copied}}
        results: dict[str, MovedField | None] = {}
        for name, read in self._readers.items():
            results[name] = read(values[name])
        # images of a batch, by the threads that make the lattices
        if self._count > 1 and len(self._jobs):
            run, counters = loaded().camtorch_lattices, self._lattices.counters
            if run_and_follow(run, call.lattices, self._count, counters, target, source):
                return {}
        refused = self._run(source, target)
        if refused is None:
            return {}
        for name in refused:
            results[name] = None
        if not self._is_whole:
            for job in self._jobs:  # threads share each image by its tiles
                job.next = 0
                spread(functools.partial(loaded().camtorch_sample, job), min(self._threads, self._tiles))
        for name, narrower in self._narrowed.items():
            pair = results[name]
            if pair is not None:
                results[name] = in_range(pair[0], narrower), pair[1]
        return results

    def _run(self, source: Native, target: Native) -> Sequence[str] | None:
        """Move the labels, and the image of one sample or its lattice alone; return the names of refused labels.

        None if the call does not serve. It is repeated if a limit of a camera was missing.
        """
        call, run = self._call, loaded().camtorch_together
        call.job_count, call.is_whole = self._images_of_call, self._is_whole
        while flags := run(call):
            if flags & structs.LEFT_MOST:
                return None
            of_labels = flags >> structs.LEFT_BITS
            if of_labels == 0:
                follow(flags, target, source)
                continue
            call.job_count = 0  # C came to the labels, so all images are made
            follow(of_labels, source, target)
            if of_labels == structs.LEFT_LABELS:  # nothing else is missing
                return self._may_be_refused
        return ()


def pixels_together(
    warp: Warp, values: Mapping[str, Tensor], hows: Mapping[str, How], batched: bool
) -> dict[str, MovedField]:
    """Move pixels and boxes by one evaluation of the cameras in torch, where each takes hundreds of operations.

    Nothing if less than two fields can. values, hows, batched: see `call_for`.
    """
    dtype = warp.source.intrinsics.dtype
    outlines: dict[str, Tensor] = {}  # name -> (B, *N, 2): pixels, or points along the edges of boxes
    for name, how in hows.items():
        rows = values[name] if batched else values[name].unsqueeze(0)
        if rows.dtype == dtype and how == "pixels":
            outlines[name] = rows
        elif rows.dtype == dtype and how == "boxes" and known_true(in_order(rows)):
            outlines[name] = along_edges(corners_of(rows), structs.EDGE_POINTS)
    if len(outlines) < 2 or not warp.moves_by_cameras:  # others move points by more than their cameras
        return {}
    moved, mapped = warp.move(torch.cat([outline.flatten(1, -2) for outline in outlines.values()], 1))
    counts = [outline.shape[1:-1].numel() for outline in outlines.values()]
    of_fields = zip(outlines.items(), moved.split(counts, 1), mapped.split(counts, 1), strict=True)
    results: dict[str, MovedField] = {}
    for (name, outline), places, seen in of_fields:
        rows, valid = places.reshape(outline.shape), seen.reshape(outline.shape[:-1])
        if hows[name] == "pixels":
            valid = valid & warp.target.contains(rows)
        else:
            boxes = values[name] if batched else values[name].unsqueeze(0)
            rows, valid = around(warp, corners_of(boxes), rows, valid)
        results[name] = (rows, valid) if batched else (rows.squeeze(0), valid.squeeze(0))
    return results
