"""What readers of label files share: samples by their number, images beside labels, numbers and their places."""

from __future__ import annotations

import operator
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import Dataset

from camtorch._photographs import load_stored
from camtorch.augment.landmarks import TableLike
from camtorch.augment.sample import Sample

_IMAGES = (".jpg", ".png", ".jpeg", ".bmp", ".JPG", ".PNG")
_UP = 3  # folders above the labels in which images are looked for
_BLOCK = 1 << 24


class Samples(Dataset[Sample]):
    """The samples of a file or a folder of labels, each read when it is asked for; what `ct.data.read` returns.

    `len(samples)`, `samples[i]` (from the end for negative i), and iteration; a data set of torch, so that
    `DataLoader`, `Subset` and `ConcatDataset` take it. No file stays open, and workers take it as it is.
    """

    path: Path
    format: str
    images: Path | None = None
    """The folder of the images, where labels name them; None: it is looked for, see `ct.data.read`."""
    landmarks: TableLike | None = None
    """Of the keypoints, which change places in a mirror: for `landmarks=` of the augmentations. None: not known."""
    _count: int

    def __init__(self, path: Path):
        self.path = path

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Sample:
        number = operator.index(index)
        if not -len(self) <= number < len(self):
            raise IndexError(f"{self.path}: sample {number} of {len(self)}")
        return self._sample(number % len(self))

    def __iter__(self) -> Iterator[Sample]:
        return (self._sample(i) for i in range(len(self)))

    def __repr__(self) -> str:
        return f"<{len(self)} samples of {self.format} in {str(self.path)!r}>"

    def _sample(self, number: int) -> Sample:
        raise NotImplementedError


class FileSamples(Samples):
    """A sample for each file of some endings, in the order of their names."""

    endings: tuple[str, ...]
    within: str | None = None
    """What the folders are called that hold them; None: anything."""

    def __init__(self, path: Path):
        super().__init__(path)
        self._files = files_in(path, *self.endings, within=self.within)
        if not self._files:
            raise ValueError(f"{path}: no {' or '.join(self.endings)} in this folder, nor beneath it")
        self._count = len(self._files)


def files_in(path: Path, *endings: str, within: str | None = None) -> list[str]:
    """The file itself, or all of these endings in a folder and beneath it."""
    if path.is_file():
        return [str(path)]
    found = (one for one in path.rglob("*") if one.suffix.lower() in endings and within in (None, one.parent.name))
    return sorted(str(one) for one in found if one.is_file())


# -- images


def image_at(path: Path, *, is_mask: bool = False) -> Tensor:
    """An image as it is stored: uint8 (3, H, W) RGB; grey ones (1, H, W) uint8, or uint16 if they are that deep.

    Of a mask with a palette its numbers, and no colours.
    """
    kinds = OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError
    with failing_at(path, "", *kinds), Image.open(path) as opened:
        image = load_stored(opened)
        array = np.array(image if image.mode in ("L", "I;16", "P" if is_mask else "L") else image.convert("RGB"))
    return torch.from_numpy(array[None] if array.ndim == 2 else np.ascontiguousarray(array.transpose(2, 0, 1)))


def image_beside(path: Path, folder: Path | None = None) -> Path:
    """The image of the name of a file of labels, in its folder or another one."""
    named = [(folder or path.parent) / (path.stem + ending) for ending in _IMAGES]
    for image in named:
        if image.is_file():
            return image
    raise ValueError(f"{path}: no image beside it; it would be {named[0]}, or end with {', '.join(_IMAGES[1:4])}")


def named_image(samples: Samples, name: Any, folders: Iterable[str], place: object) -> Path:
    """The file that labels name, in the folder of images, or these beside the labels or up to three folders above."""
    parts = PurePosixPath(name if isinstance(name, str) and "\0" not in name else "")
    if parts.is_absolute() or ".." in parts.parts or not parts.name:
        raise ValueError(f"{place}: the name of a file within the folder of images was expected; got {name!r:.60}")
    labels = samples.path
    roots = [labels.parent, *labels.resolve().parent.parents][: _UP + 1] if samples.images is None else [samples.images]
    for root in roots:
        for folder in folders:
            if os.path.isfile(root / folder / parts):  # False, too, for names that no file can have
                return root / folder / parts
    where = ", ".join(repr(folder) for folder in folders if folder)
    there = "there" if samples.images else f"there or up to {_UP} folders above; read(..., images=FOLDER) says where"
    raise ValueError(f"{place}: no file {name!r:.200} in {roots[0]} or in {where} {there}")


# -- text and numbers


class Lines:
    """The lines of a text that are not empty, known by where they begin: 16 bytes a line, of files of any size."""

    def __init__(self, path: Path):
        self.path = path
        size = path.stat().st_size
        data = np.memmap(path, np.uint8, "r") if size else np.zeros(0, np.uint8)
        blocks = (np.flatnonzero(data[at : at + _BLOCK] == ord("\n")) + at + 1 for at in range(0, size, _BLOCK))
        bounds = np.concatenate([[0], *blocks, [size]])
        lengths = np.diff(bounds)
        short = np.flatnonzero(lengths == 2)  # of which those of Windows are empty
        lengths[short[data[bounds[short]] == ord("\r")]] = 0
        self._numbers = np.flatnonzero(lengths > 1)
        self._bounds = bounds

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, i: int) -> tuple[str, str]:
        """What a line says, and where: "FILE, line N"."""
        number = int(self._numbers[i])
        place = f"{self.path}, line {number + 1}"
        with self.path.open("rb") as file:
            file.seek(self._bounds[number])
            return text_of(file.read(int(self._bounds[number + 1] - self._bounds[number])), place).strip(), place


def text_of(content: bytes, place: object) -> str:
    """As UTF-8.

    Raises:
        ValueError: another encoding.
    """
    with failing_at(place, "not text in UTF-8: ", UnicodeDecodeError):
        return content.decode("utf-8-sig")


@contextmanager
def failing_at(place: object, what: str, *kinds: type[Exception]) -> Iterator[None]:
    """Errors of these kinds in the block are a ValueError that names the place."""
    try:
        yield
    except kinds as error:
        raise ValueError(f"{place}: {what}{error}") from None


def numbers_of(words: Sequence[Any], place: object, what: str) -> Tensor:
    """Finite numbers, of words or of JSON, as float32.

    Raises:
        ValueError: something else.
    """
    try:
        if any(isinstance(word, bool) for word in words):
            raise ValueError
        values = np.asarray(words, np.float64)
        if not (np.abs(values) <= np.finfo(np.float32).max).all():
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{place}: {what} must be finite numbers; got {words!s:.80}") from None
    return torch.from_numpy(values.astype(np.float32))
