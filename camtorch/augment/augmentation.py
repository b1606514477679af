"""The base of all random augmentations: ranges to draw from, and a change of cameras that moves a whole sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Unpack

import torch
from torch import Tensor

from camtorch.augment.cameras import known_camera
from camtorch.augment.change import Change, by_models, check_sizes, one_or_batch
from camtorch.augment.devices import change_on_host, twin_of
from camtorch.augment.fields import BOXES, FRONT_ENDS, PLACE, Named, as_corners
from camtorch.augment.filling import scaled, tell_of_narrow_images, warn_if_empty, warn_of_unfilled, zoom_to_fill
from camtorch.augment.matrices import Guess
from camtorch.augment.part import Part
from camtorch.augment.ranges import (
    Draw,
    Range,
    as_tensors,
    checked_draw,
    chosen_boxes,
    draw_numbers,
    rows_of,
    values_for,
    which_apply,
)
from camtorch.augment.sample import Sample, SampleOptions, SampleTransform, on_samples
from camtorch.cameras.camera import Camera
from camtorch.cameras.mixed import Mixed
from camtorch.evaluate.tensors import are_concrete, known_false
from camtorch.values.arguments import GUESS_CAMERA, as_flag, as_part, as_whole, hinting
from camtorch.values.module import typed_as
from camtorch.warp.views import place_of
from camtorch.warp.warp import Warp


class OptionsBesideP(SampleOptions, total=False):
    """Options of flips, which have a `p` of their own; see `Augmentation`."""

    same_on_batch: bool


class AugmentationOptions(OptionsBesideP, total=False):
    """The options that all augmentations have in common; see `Augmentation`."""

    p: float


class Augmentation(SampleTransform):
    """A random change of cameras, `sample -> sample`: every field moves by the same warps.

    A sample is a dict, or keyword arguments: a batch, or without the dim B a single sample. The guide "Labels that move
    with the image" (docs/guides/augment.md) has a table of all fields. `keypoints_valid` and so on, `camera`, and
    `rotation` (B, 3, 3) come out as well: `ray_after = R ray_before`, over all augmentations that the sample went
    through. Other fields stay, but an unknown name that holds numbers which might be geometry raises an error.
    `.eval()` changes nothing: call an augmentation in training only. Gradients go to images, labels and a sample's
    camera that learns; what a lens is jittered by, or zoomed by for `min_filled`, counts as given. A subclass that
    names ranges and writes `new_camera` is one's own augmentation (docs/contributing/augmentation.md).

    Args:
        ranges: name -> `Range`, in the order in which they are drawn.
        camera: of samples that do not bring one. The augmentation keeps a copy, which does not learn, nor follow later
            changes of the camera. A number is for photographs of unknown cameras, of any size: each is taken for that
            of a pinhole camera so many degrees wide, from edge to edge. Where there is no camera, a field `K` (or
            `intrinsics`, `camera_matrix`) of a sample is the pinhole camera of the image, and comes before the number.
        p, same_on_batch: how likely a sample is augmented at all; the same draw for the whole batch.
        fields: name -> kind, for fields of other names; "keep" leaves one as it is. A * in a name stands for any
            characters, as in "observation.images.*"; of several that fit, the first counts. `camera`, `rotation` and
            `crop_place` come out by themselves, and a field of another kind needs another name.
        mode, padding_mode, fill, antialias, tolerance: of images; see `Warp`.
        mask_fill: the value of masks where nothing is seen.
        valid_mask: whether `image_valid` (B, 1, H, W) comes out: where the image shows something.
        min_filled: the part of every new image, from 0 to 1, that has to show something of the old one. As far as it
            takes, the new camera zooms, and where four times are not enough it turns less far. This follows from the
            camera and the draw, and so does a replay. A warning tells once if a source cannot fill so much. None
            and 0 leave images as they are drawn; None warns once if more than a third of what the old ones show is
            going to be empty.

    Raises:
        ValueError: a p or a min_filled outside of [0, 1], an unknown kind of field or way to sample.
        TypeError: an unknown keyword, or a camera that is none.
    """

    ranges: dict[str, Range]
    beside_the_camera: ClassVar[frozenset[str]] = frozenset()
    """The names of ranges that change the colours or the light of new images, not their camera."""
    keeps_lens: ClassVar[bool] = False
    """Whether it may come after a lens with chromatic aberration or vignetting in a `Compose`."""
    _labels_in_draws: ClassVar[Sequence[str]] = ()
    """The names of labels of samples that a draw may hold besides ranges and `crops`."""
    _least_fov: float | None = None
    """Degrees that new images are to be wide at least: a warning tells if `min_filled` makes them narrower."""
    image_size: tuple[int, int] | None = None
    """(height, width) of new images; None: that of the images."""
    drawn_on_host: bool = False
    """Whether new cameras follow from numbers of cameras alone: the CPU then makes them for samples on any device."""
    place: bool = False
    """Whether `crop_place` comes out; see `BoxCrop`."""
    crops: Mapping[str, int] = MappingProxyType({})
    """Maps a name in draws, such as "box", to the index of the box of the sample that it holds."""
    p: float
    same_on_batch: bool
    min_filled: float | None

    def __init__(
        self,
        ranges: Mapping[str, Range] | None = None,
        *,
        p: float = 1.0,
        same_on_batch: bool = False,
        min_filled: float | None = None,
        **options: Unpack[SampleOptions],
    ):
        super().__init__(**options)
        self.p = p
        self.same_on_batch = same_on_batch
        self.ranges = dict(ranges or {})
        self.min_filled = min_filled

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "p":
            value = as_part(value, name, self._name, "probability")
        elif name == "same_on_batch":
            value = as_flag(value, name, self._name)
        elif name == "min_filled" and value is not None:
            value = as_part(value, name, self._name)
        super().__setattr__(name, value)

    @property
    def last(self) -> Change | None:
        """The change of the last call: its `source`, `target` and `rotation`."""
        return self._calls.last

    def new_camera(self, source: Camera, values: Mapping[str, Tensor]) -> tuple[Camera, Tensor | None]:
        """Return the camera after, with an image_size, and the rotation, `ray_after = R ray_before`, or None.

        Args:
            source: the camera before, with an image_size; without batch dims, or with those of the values.
            values: what was drawn from each range, (*B,) or (*B, size), of the source's dtype and on its device. *B is
                one dim, or none where one camera serves all samples.

        Returns:
            A camera without batch dims or of *B, made for example by `source.replace`, and (3, 3) or (*B, 3, 3).
        """
        raise NotImplementedError

    def draw(self, count: int, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Draw for `count` samples, without applying anything.

        Args:
            count: B.
            generator: by default torch's own, which DataLoader seeds differently in every worker.

        Returns:
            `apply` (B,) bool, and for each range a float64 tensor (B,) or (B, size) of that name and unit.
        """
        count = as_whole(count, "count", self._name)
        if count < 0:
            raise ValueError(f"{self._name}: count must not be negative; got {count}")
        return self.drawn(count, self.p, self.same_on_batch, generator)

    def drawn(
        self, count: int, p: float, same_on_batch: bool, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Draw as `draw` does, with another p and same_on_batch."""
        numbers = self._draw_numbers(count, p, same_on_batch, generator)
        return {
            name: torch.as_tensor(value, dtype=torch.bool if name == "apply" else torch.float64)
            for name, value in numbers.items()
        }

    # What kinds of camtorch state otherwise, or override, besides `new_camera` and `extra_repr`; methods in the order
    # of a call. `Compose` states attributes as properties, of all in it.
    #
    # needs_camera             Edit; Compose
    # makes_pinholes           lenses and mounts; Compose
    # mirroring, ranges        Compose; flips and others set them when they are made
    # crops, place             Compose; BoxCrop sets them when it is made
    # drawn_on_host            edits, lenses and mounts; Compose
    # beside_the_camera        lenses and mounts: colours and light
    # _least_fov                lenses and mounts
    # keeps_lens               RandomShutter
    # _labels_in_draws          RandomMount, for the depths of a shift
    # other_words              lenses and mounts
    # _chooses_antialias       edits; Compose
    # _draw_numbers            Compose, of all in it
    # _with_labels             RandomMount, for the depths of a shift; here boxes, for `crops`
    # _change                  Compose, step by step; Edit, by a matrix
    # _part                    lenses and mounts, by C; RandomMount with a shift; RandomShutter
    # _new_camera              lenses and mounts, whose formulas take float64
    # tell_of_empty_images     Compose, of all in it
    # _size_if_applied         edits; Compose, of all in it

    def _draw_numbers(self, count: int, p: float, same_on_batch: bool, generator: torch.Generator | None) -> Draw:
        """Return a draw as lists, arrays or tensors; see `ranges.py`."""
        return draw_numbers(self.ranges, count, p, same_on_batch, generator)

    def with_boxes(self, draw: Mapping[str, Any], boxes: Tensor | Sequence[Tensor] | None) -> Mapping[str, Any]:
        """Return the draw, completed by the box that each sample's crop follows.

        Args:
            draw: A draw; boxes that it already holds are kept.
            boxes: Boxes of the samples, (B, M, 4), or (M, 4) for each; None if samples have none.
        """
        missing = {name: index for name, index in self.crops.items() if name not in draw}
        return {**draw, **chosen_boxes(missing, boxes, self._name)} if missing else draw

    def size_after(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the (height, width) of new images, of images of a size."""
        return self._size_if_applied(size) if self.p else size

    def _size_if_applied(self, size: tuple[int, int]) -> tuple[int, int]:
        return self.image_size or size

    def change(self, camera: Camera | Sequence[Camera] | None, draw: Mapping[str, Tensor]) -> Change:
        """Return the change that a draw makes to images of `camera` (None: the augmentation's own)."""
        before = self.camera if camera is None else camera
        if before is None or isinstance(before, (int, float)):
            how = f"give one here, in the sample, or as {self._name}(camera=...)"
            raise ValueError(f"{self._name}: camera must be given; got {before}. Please {how}. {GUESS_CAMERA}")
        before = one_or_batch(before)
        checked = checked_draw(draw, self.ranges, self.crops, self._labels_in_draws, self._name)
        if before.batch_shape and len(before) != len(checked["apply"]):
            raise ValueError(
                f"{self._name}: draw must be for {len(before)} samples, as the cameras; got one for "
                f"{len(checked['apply'])}"
            )
        return change_on_host(before, checked, self._change, self.drawn_on_host)

    def _change(self, camera: Camera, draw: Draw) -> Change:
        """Return the change of a draw of any form."""
        if 0 < self.p < 1 and self.image_size not in (None, camera.image_size):
            raise ValueError(
                f"{self._name}: with p < 1 the image_size must be that of the images, so that all come out alike; "
                f"got image_size={self.image_size} for images of {camera.image_size}"
            )
        applied = draw["apply"]
        chosen = applied if isinstance(applied, list) else which_apply(applied)
        # if values may not be read, all rows are moved, and `gate` later keeps those that were not drawn
        gate = applied if chosen is None and self.p != 1 else None
        all_move = chosen is None or all(chosen)
        if all_move and not isinstance(camera, Mixed):
            return Change(len(applied), [self._part(camera, draw)], gate=gate)

        def part(rows: list[int] | None, source: Camera) -> Part:
            return self._part(source, rows_of(draw, rows))

        change = by_models(len(applied), camera, part, chosen, gate)
        if not all_move:
            check_sizes((part.image_size for part in change.parts), self._name)
        return change

    def _part(self, source: Camera, draw: Draw) -> Part:
        """Return how samples of cameras of one model move, all of them, by a draw for as many."""
        target, rotation = self._filled_camera(source, values_for(source, draw))
        return Part(source, Warp(source, target, rotation, **self.options))

    def _filled_camera(self, source: Camera, values: Mapping[str, Any]) -> tuple[Camera, Tensor | None]:
        """Return the camera of drawn values and its rotation, zoomed and turned less far for `min_filled`."""
        target, rotation = self._new_camera(source, values)
        if self.min_filled:
            factor, turned, found = zoom_to_fill(source, target, rotation, self.min_filled)
            target, rotation = scaled(target, factor), None if rotation is None else turned
            self._tell_of_unfilled(source, lambda: target, factor, found)
        return target, rotation

    def _new_camera(self, source: Camera, values: Mapping[str, Any]) -> tuple[Camera, Tensor | None]:
        """Call `new_camera` with values as drawn."""
        return self.new_camera(source, as_tensors(source, values))

    def _tell_of_unfilled(self, source: Camera, target: Callable[[], Camera], factor: Tensor, found: Tensor) -> None:
        """Warn, once, if `min_filled` is out of reach, or leaves less than a field of view that was asked for.

        target: returns the new cameras, zoomed by factors (*B,) and then filled to the parts `found` (*B,).
        """
        share = self.min_filled or 0.0
        if not self._calls.has_looked and known_false(found >= share):
            self._calls.has_looked = True
            warn_of_unfilled(self._name, share, found)
        if self._least_fov is not None:
            tell_of_narrow_images(self._name, self._least_fov, share, source, target, factor, found)

    def tell_of_empty_images(self, camera: Camera) -> None:
        """Warn, once, if new images of `camera` will be mostly empty; draws from a generator of its own show it."""
        if self.min_filled is not None or self._calls.has_looked or self.p == 0 or self.crops:
            return  # `crops` need boxes, which say what is intended
        camera = (twin_of(camera) if self.drawn_on_host else None) or camera
        camera = camera[0] if camera.is_mixed else camera
        if not are_concrete(camera.intrinsics):
            return
        self._calls.has_looked = True
        warn_if_empty(self._name, camera, self.ranges, self._new_camera)

    @on_samples
    @hinting(f"Name the fields, as in image=image. {FRONT_ENDS}")
    def forward(
        self,
        sample: Mapping[str, Any] | None = None,
        *,
        draw: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
        **fields: Any,
    ) -> Sample:
        """Augment a sample, a dict, or keyword arguments, or both.

        Args:
            sample: the fields; see the class.
            draw: of `draw`, to be applied again.
            generator: to draw from.
            fields: more fields.

        Returns:
            A new dict with all fields moved, and their validity, `camera` and `rotation`.

        Raises:
            ValueError: no camera, fields of wrong shapes, images that are not of the camera's image_size, an unknown
                field that might be geometry, a draw of another size. TypeError: a field that is no tensor.
        """
        sample = self._given(sample, fields)
        if clips := self._clips(sample):
            camera = known_camera(sample.get("camera"), self.camera)
            frames = clips.frames(one_or_batch(camera) if isinstance(camera, Camera) else camera)
            draw = self.draw(clips.shape[0], generator) if draw is None else draw
            draw = self._with_labels(draw, lambda: clips.first_frames(frames, self.fields))
            return clips.restored(self.forward(frames, draw=clips.for_frames(draw)))
        return self._augmented(sample, draw=draw, generator=generator)[0]

    def _augmented(
        self,
        sample: Sample,
        kinds: Mapping[str, str] | None = None,
        draw: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
    ) -> tuple[Sample, Change]:
        """Return a sample moved by one change, and the change; kinds: name -> kind, in addition to `fields`.

        `_batch` finds what moves and by which cameras, `_draw_numbers` draws, `_change` makes the new cameras, those of
        one model by a call of `_part`, and `_moved` moves the fields.
        """
        batch = self._batch(sample, kinds=kinds)
        plan, camera, count = batch.plan, batch.camera, batch.plan.count
        if draw is None:
            drawn = self._draw_numbers(count, self.p, self.same_on_batch, generator)
            drawn = self._with_labels(drawn, batch.rows)
            change = change_on_host(camera, drawn, self._change, self.drawn_on_host)
        else:
            change = self.change(camera, self._with_labels(draw, batch.rows))
        if change.count != count:
            one = f"{{name: value.expand({count}, *value.shape[1:]) for name, value in draw.items()}} uses it for all"
            raise ValueError(
                f"{self._name}: draw must be for {count} samples; got one for {change.count}. draw({count}) makes one "
                f"for each{f', {one}' if change.count == 1 else ''}"
            )
        if not torch.compiler.is_compiling():
            calls = self._calls
            calls.is_first, calls.last = "rotation" not in plan.fields, change
            if count and not calls.has_looked and "image" in plan.fields.values():
                self.tell_of_empty_images(camera)
        moved = self._moved(sample, batch, change)
        if self.place or sample.get(PLACE) is not None:
            put_crop_place(sample, moved, self._name)
        return moved, change

    @on_samples
    def inverse(
        self,
        sample: Mapping[str, Any] | None = None,
        *,
        draw: Mapping[str, Tensor] | None = None,
        camera: Camera | Sequence[Camera] | None = None,
        **fields: Any,
    ) -> Sample:
        """Move a sample back: by the last call's change, or by that of a `draw` and the `camera` before it.

        Without a draw, `camera` is a field of the sample, the camera that the change made. Pixels that left the image
        stay lost; enclosing boxes have grown; chromatic aberration and vignetting stay.

        Raises:
            ValueError: nothing was called, or the sample's camera is not the one that the change made.
        """
        if draw is None and camera is not None:  # a field of the sample, as in `inverse(**result)`
            fields["camera"], camera = camera, None
        sample = self._given(sample, fields)
        if clips := self._clips(sample):
            if draw is not None:
                draw = clips.for_frames(draw)
                camera = clips.repeated(self.camera if camera is None else camera, "camera")
            return clips.restored(self.inverse(clips.frames(sample.get("camera")), draw=draw, camera=camera))
        change = self.last if draw is None else self.change(camera, draw)
        if change is None:
            raise ValueError(
                f"{self._name}: inverse must have a change to invert; got none. Call it first, or give draw= and "
                "camera="
            )
        turned = sample.get("rotation") if draw is None and self._calls.is_first else None
        given = sample.get("camera")
        if given is not None and not change.leads_to(given, turned):
            raise ValueError(
                f"{self._name}: camera and rotation of the sample must be those that this change made; got "
                f"{given!r:.60}. If the sample is of another call, pass its draw= and the camera= before it"
            )
        moved = self.moved_by(change.inverse(), sample, predicted=True)
        moved.pop(PLACE, None)  # what comes back is no crop
        return moved

    def _with_labels(self, draw: Draw, rows: Callable[[], Named]) -> Draw:
        """Add to a draw the boxes that it needs of a sample: those named `boxes`, or the first of that kind."""
        if not self.crops:
            return draw
        found = {name: pair for name, pair in rows().items() if pair[0] in BOXES}
        kind, boxes = found.get("boxes", next(iter(found.values()), ("boxes", None)))
        if isinstance(boxes, Tensor) and boxes.ndim > 3:  # of the frames of one sample: those of the first frame decide
            boxes = boxes.flatten(0, -3)[:1]
        if boxes is not None:
            boxes = [as_corners(kind, of_sample) for of_sample in boxes]
        return self.with_boxes(draw, boxes)

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def extra_repr(self) -> str:
        parts = [f"camera={self.camera:g}"] if isinstance(self.camera, Guess) else []
        parts += [f"{name}={interval}" for name, interval in self.ranges.items()]
        said = {"p": self.p, "same_on_batch": self.same_on_batch, **self.options, "min_filled": self.min_filled}
        return ", ".join(parts + [f"{name}={value!r}" for name, value in said.items()])


def put_crop_place(sample: Mapping[str, Any], moved: dict[str, Any], owner: str) -> None:
    """Put `crop_place` into a moved sample, by its camera and by all that turned it; see `ct.views.crop_place`."""
    has_both = sample.get("rotation") is not None and moved.get("camera") is not None
    if sample.get(PLACE) is not None and not has_both:
        raise ValueError(
            f"{owner}: a sample with {PLACE} must have the rotation and the camera that came with it, as it follows "
            f"from them; got {', '.join(sample)}. Leave {PLACE} out, or keep them"
        )
    rotation = moved["rotation"]
    rotation = torch.stack(rotation) if isinstance(rotation, list) else rotation
    camera = one_or_batch(moved["camera"])
    moved[PLACE] = place_of(camera, rotation.to(camera.intrinsics))
