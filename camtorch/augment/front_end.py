"""The base of front ends, which pass the samples of other libraries to an augmentation."""

from typing import Any

from camtorch.augment.augmentation import Augmentation
from camtorch.augment.change import Change
from camtorch.augment.sample import KeepsCamera, SampleTransform


class FrontEnd(KeepsCamera):
    """The base of front ends, which pass the samples of a library to an augmentation.

    Its method `_read` returns a sample as the augmentation takes it, that of torchvision also the kinds of its fields,
    and a function that writes the moved one in the form of the given one. kornia's calls a method for each kind of
    value instead.
    """

    augmentation: Any
    camera: Any  # of samples that bring none: a Camera, or degrees; None: that of the augmentation

    @property
    def last(self) -> Change | None:
        """The change of the last call: its `source`, `target` and `rotation`."""
        return getattr(self.augmentation, "last", None)


def check_front_end(owner: str, augmentation: object, *kinds: type[SampleTransform]) -> None:
    """Raise a TypeError unless `augmentation` is of one of the `kinds`; without any, an `Augmentation`."""
    kinds = kinds or (Augmentation,)
    if not isinstance(augmentation, kinds):
        named = " or a ".join(kind.__name__ for kind in kinds)
        raise TypeError(f"{owner}: augmentation must be an {named}; got {type(augmentation).__name__}")
