"""Chains of augmentations, which sample images once."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, TypeVar, Unpack, cast

import numpy as np
import torch
from torch import Tensor, nn

from camtorch.augment.augmentation import Augmentation, AugmentationOptions
from camtorch.augment.change import Change, check_sizes
from camtorch.augment.edits import Edit, change_by
from camtorch.augment.landmarks import Mirroring
from camtorch.augment.random_camera import RandomMount
from camtorch.augment.ranges import Draw, Range, draw_numbers
from camtorch.augment.shutter import RandomShutter
from camtorch.cameras.camera import Camera
from camtorch.evaluate.tensors import known_false
from camtorch.values.arguments import as_mapping, present, warn

T = TypeVar("T")


def _of_parts(join: Callable[[Iterable[bool]], bool], name: str, meaning: str) -> Any:
    """Return a property that joins an attribute of all parts."""
    return property(lambda chain: join(getattr(part, name) for part in chain.parts), doc=meaning)


class Compose(Augmentation):
    """A chain of augmentations, each drawn for the camera that the one before returns, applied all at once.

    Images are sampled once, by the warp from the first camera to the last, and labels move exactly. `nn.Sequential` of
    the same augmentations, with the same seed, moves labels alike, but samples images at every step and cuts off pixels
    that a later step might see again; a `Compose` shows them. If all parts are edits, no camera is needed.

        >>> augment = ct.augment.Compose(
        ...     [ct.augment.HorizontalFlip(landmarks="ibug68"), ct.augment.RandomLens("dms130", fov="source")],
        ...     camera=ct.Pinhole([80.0, 80.0, 63.5, 47.5], image_size=(96, 128)),
        ... )
        >>> augment(image=torch.zeros(3, 96, 128), keypoints=torch.ones(68, 2))["image"].shape
        torch.Size([3, 96, 128])

    Args:
        augmentations: in the order in which they apply; may hold a `Compose`.
        camera: for samples that hold none; default: that of the first augmentation that has one.
        antialias: as in `Edit`: None antialiases if more than one and a half pixels come to one.
        options: p, same_on_batch, fields, mode, padding_mode, fill, mask_fill, valid_mask, tolerance, of the whole
            chain; see `Augmentation`. The parts keep their own p, same_on_batch, fields and ranges.

    Raises:
        TypeError: If a part is no augmentation. ValueError: If there is no part; if two tables of landmarks differ; if
            a part needs other images than the whole; if chromatic aberration or vignetting come before another lens, or
            a `RandomShutter` before the last part.
    """

    augmentations: nn.ModuleList
    _chooses_antialias = True

    def __init__(self, augmentations: Iterable[Augmentation], **options: Unpack[AugmentationOptions]):
        name = type(self).__name__
        parts = list(augmentations) if isinstance(augmentations, Iterable) else [augmentations]
        for part in parts:
            if not isinstance(part, Augmentation):
                raise TypeError(
                    f"{name}: augmentations must be a list of augmentations of camtorch; got {type(part).__name__}"
                )
        if not parts:
            raise ValueError(f"{name}: augmentations must hold at least one; got an empty list")
        if options.get("camera") is None:
            options["camera"] = next((part.camera for part in parts if part.camera is not None), None)
        options["fields"] = {key: value for part in parts for key, value in part.fields.items()} | dict(
            as_mapping(options.get("fields"), "fields", name, "{'lidar': 'points'}")
        )
        options.setdefault("antialias", None)
        if any(part.valid_mask for part in parts):
            options.setdefault("valid_mask", True)
        super().__init__(**options)
        self.augmentations = nn.ModuleList(parts)
        self._check_parts()
        unused = [type(part).__name__ for part in parts if _is_other(part.camera, self.camera)]
        if unused:
            warn(
                f"{name}: samples that bring no camera are of one camera, {type(self.camera).__name__}; that of "
                f"{', '.join(unused)} is another one, and is not used. Pass one camera, to {name} itself"
            )
        if len({repr(part.mirroring.key) for part in parts if part.mirroring is not None}) > 1:
            raise ValueError(f"{name}: flips must have equal landmarks, lateral_axis and swap_sides; got others")

    def _check_parts(self) -> None:
        parts = self.parts
        usual = {**Augmentation().options, "mask_fill": 0.0}
        wanted = {**self.options, "mask_fill": self.mask_fill}
        for i, part in enumerate(parts):
            kind, given = type(part).__name__, {**part.options, "mask_fill": part.mask_fill}
            for key in ("mode", "padding_mode", "fill", "tolerance", "mask_fill"):
                if given[key] not in (usual[key], wanted[key]):
                    raise ValueError(
                        f"{self._name}: images are sampled once, so parts must have one {key}; got {given[key]!r} of "
                        f"{kind}. Pass it to {self._name} itself"
                    )
            errors = (_order_error(leaf, parts[i + 1 :], kind) for leaf in reversed(_leaves(part)))
            error = next(filter(None, errors), None)
            if error is not None:
                raise ValueError(f"{self._name}: parts must {error}; got {kind} at place {i}")

    @property  # type: ignore[override]
    def ranges(self) -> Mapping[str, Range]:
        """The ranges of all parts, by the part's index and the name in it, as "0.yaw"; change those of a part."""
        return _by_index({"apply": Range(0, 1), **part.ranges} for part in self.parts)

    @ranges.setter
    def ranges(self, value: Mapping[str, Range]) -> None:
        if value:
            raise AttributeError(f"{self._name}: ranges must be those of the parts; got others. Set those of a part")

    @property
    def crops(self) -> Mapping[str, int]:  # type: ignore[override]
        """The boxes that draws of all parts need; see `Augmentation`."""
        return _by_index(part.crops for part in self.parts)

    @property
    def mirroring(self) -> Mirroring | None:
        """The `Mirroring` of the parts that mirror."""
        return next((part.mirroring for part in self.parts if part.mirroring is not None), None)

    @mirroring.setter
    def mirroring(self, value: Mirroring | None) -> None:
        for part in self.parts:
            if part.mirroring is not None:
                part.mirroring = value

    needs_camera: bool = _of_parts(any, "needs_camera", "Whether a part does.")
    place: bool = _of_parts(
        any, "place", "Whether a part adds `crop_place`: of the new image, seen from the first camera."
    )
    drawn_on_host: bool = _of_parts(all, "drawn_on_host", "See `Augmentation`; whether all parts are.")

    @property
    def makes_pinholes(self) -> bool:  # type: ignore[override]
        """Whether all parts from the last `BoxCrop` of p=1 on make pinhole cameras; see `SampleTransform`."""
        last = max((i for i, part in enumerate(self.parts) if part.crops and part.p == 1), default=0)
        return all(part.makes_pinholes for part in self.parts[last:])

    @property
    def parts(self) -> list[Augmentation]:
        """The augmentations in their order."""
        return cast("list[Augmentation]", list(self.augmentations))

    def _draw_numbers(self, count: int, p: float, same_on_batch: bool, generator: torch.Generator | None) -> Draw:
        values = {**draw_numbers({}, count, p, same_on_batch, generator)}
        for i, part in enumerate(self.parts):
            drawn = part._draw_numbers(count, part.p, same_on_batch or part.same_on_batch, generator)
            values |= {f"{i}.{name}": value for name, value in drawn.items()}
        return {name: value if isinstance(value, Tensor) else np.asarray(value) for name, value in values.items()}

    def _size_if_applied(self, size: tuple[int, int]) -> tuple[int, int]:
        for part in self.parts:
            size = part.size_after(size)
        return size

    def tell_of_empty_images(self, camera: Camera) -> None:
        # a chain shows what the first camera sees, also where a later one, as of a crop, sees less
        for part in self.parts:
            part.tell_of_empty_images(camera)

    def _change(self, camera: Camera, draw: Draw) -> Change:
        parts = self.parts
        total: Change | None = None  # of the parts so far; camera: that after them
        edits: list[tuple[Edit, Draw]] = []
        for i, part in enumerate(parts):
            part_draw = {name: draw[f"{i}.{name}"] for name in ("apply", *part.ranges, *part.crops)}
            part_draw["apply"] = (part_draw["apply"] > 0.5) & draw["apply"]
            if isinstance(part, Edit):
                edits.append((part, part_draw))
                if i + 1 < len(parts) and isinstance(parts[i + 1], Edit):
                    continue  # consecutive edits are one
                step, edits = change_by(edits, camera, self.options), []
            else:
                if total is not None:
                    part_draw |= {name: _boxes_after(total, part_draw[name], camera) for name in part.crops}
                step = part._change(camera, part_draw)
            total = step if total is None else total.then(step)
            (first, *others) = step.parts  # a camera of all samples stays single
            camera = step.target if others or first.rows is not None else first.target
        total = present(total, "a part")
        check_sizes((part.image_size for part in total.parts), self._name)
        return total.with_options(self.options)

    def extra_repr(self) -> str:
        options = {"p": self.p, "same_on_batch": self.same_on_batch, **self.options}
        return ", ".join(f"{name}={value!r}" for name, value in options.items())


def _is_other(given: Any, camera: Any) -> bool:
    """Whether a camera was given that is not `camera`: of another model, size or other numbers."""
    if not (isinstance(given, Camera) and isinstance(camera, Camera)):
        return False
    if given.form != camera.form or [t.shape for t in given.tensors] != [t.shape for t in camera.tensors]:
        return True
    return any(known_false(a == b.to(a)) for a, b in zip(given.tensors, camera.tensors, strict=True))


def _leaves(part: Augmentation) -> list[Augmentation]:
    """Return an augmentation, or all that a `Compose` holds."""
    return [leaf for each in part.parts for leaf in _leaves(each)] if isinstance(part, Compose) else [part]


def _order_error(part: Augmentation, later: Sequence[Augmentation], name: str) -> str | None:
    """Return what parts must do if one, in the part called `name`, cannot precede `later` ones; or None."""
    if isinstance(part, RandomShutter) and later:
        return f"move no rows of a rolling shutter: {name} goes last"
    if isinstance(part, RandomMount) and part.shifts:
        return f"have no shift, which needs depth: {name} goes before"
    colours = part.beside_the_camera.intersection(part.ranges)
    if colours and any(other.needs_camera and not other.keeps_lens for other in later):
        return f"be edits after {' and '.join(sorted(colours))}, which another lens would show"
    return None


def _by_index(parts: Iterable[Mapping[str, T]]) -> Mapping[str, T]:
    """Return what parts have by name as one mapping, by the index of the part and the name, as "0.yaw"."""
    return MappingProxyType({f"{i}.{name}": value for i, part in enumerate(parts) for name, value in part.items()})


def _boxes_after(change: Change, boxes: Any, camera: Camera) -> Tensor:
    """Return boxes (B, 4) after a change; a box that left the image becomes the middle of it."""
    moved, valid = (t[:, 0] for t in change.boxes(torch.as_tensor(boxes)[:, None]))
    width, height = camera.width, camera.height
    middle = moved.new_tensor([0.25 * width, 0.25 * height, 0.75 * width, 0.75 * height])
    return torch.where(valid[:, None], moved, middle)
