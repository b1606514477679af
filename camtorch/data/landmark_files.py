"""Landmarks of faces in text files: WFLW's lists, the .pts of 300W, and LaPa's folders."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from camtorch.augment.landmarks import TableLike
from camtorch.augment.sample import Sample
from camtorch.data.labelled import (
    FileSamples,
    Lines,
    Samples,
    image_at,
    image_beside,
    named_image,
    numbers_of,
    text_of,
)

_ATTRIBUTES = ("pose", "expression", "illumination", "make_up", "occlusion", "blur")


class Wflw(Samples):
    """WFLW: a line is a face: 98 points x y, the corners of a box, six attributes of 0 or 1, the image's name.

    The lists of its subsets, `list_98pt_test`, have the points and the name alone.
    """

    landmarks: TableLike | None = "wflw98"

    def __init__(self, path: Path):
        super().__init__(path)
        self._lines = Lines(path)
        self._count = len(self._lines)

    def _sample(self, number: int) -> Sample:
        line, place = self._lines[number]
        words = line.split(maxsplit=206)
        if len(words) != 207:
            words = line.split(maxsplit=196)
        is_short = len(words) == 197
        if len(words) != 207 and not (is_short and len(words[-1].split()) == 1):
            raise ValueError(
                f"{place}: 98 points, a box, six attributes and the name of an image are 207 words, or 197 without box "
                f"and attributes; got {len(line.split())}"
            )
        image = named_image(self, words[-1], ("", "WFLW_images", "images"), place)
        sample: Sample = {"keypoints": numbers_of(words[:196], place, "points").reshape(98, 2)}
        if not is_short:
            sample["boxes"] = numbers_of(words[196:200], place, "a box").reshape(1, 4)
            if not set(words[200:206]) <= {"0", "1"}:
                raise ValueError(f"{place}: attributes must be 0 or 1; got {' '.join(words[200:206])}")
            sample["attributes"] = dict(zip(_ATTRIBUTES, map(int, words[200:206]), strict=True))
        return {"image": image_at(image), **sample, "path": str(image)}


class Pts(FileSamples):
    """300W: 68 points in a .pts beside its image; the top-left pixel of the file is (1, 1), that of a sample (0, 0).

    That the files count from one, as Matlab, is what menpo takes them for too, a library of some of 300W's authors.
    """

    landmarks: TableLike | None = "ibug68"
    endings: tuple[str, ...] = (".pts",)

    def _sample(self, number: int) -> Sample:
        path = Path(self._files[number])
        lines = _lines(path)
        heads = [i for i, (line, _) in enumerate(lines) if line == "{"]
        if not heads or not all(":" in line for line, _ in lines[: heads[0]]):
            raise ValueError(f"{path}, line 1: version: 1, n_points: 68 and {{ were expected; got {lines[:1]!r:.80}")
        told = dict(line.split(":", 1) for line, _ in lines[: heads[0]])
        if told.get("n_points", "68").strip() != "68":
            raise ValueError(f"{path}, line {heads[0]}: 68 points were expected; got n_points:{told['n_points']}")
        if lines[-1][0] != "}":
            raise ValueError(f"{lines[-1][1]}: the file is cut short; }} was expected; got {lines[-1][0]!r:.60}")
        points = _points(path, lines[heads[0] + 1 : -1], 68) - 1
        image = image_beside(path)
        return {"image": image_at(image), "keypoints": points, "path": str(image)}


class Lapa(FileSamples):
    """LaPa: `landmarks/NAME.txt`, the number 106 and a line x y each; `images/NAME.jpg`, `labels/NAME.png`.

    The mask has 0 background, 1 skin, 2 and 3 left and right brow, 4 and 5 left and right eye, 6 nose, 7 upper lip,
    8 inside of the mouth, 9 lower lip, 10 hair. A mirror leaves these numbers.
    """

    landmarks: TableLike | None = "lapa106"
    endings: tuple[str, ...] = (".txt",)
    within: str | None = "landmarks"

    def _sample(self, number: int) -> Sample:
        path = Path(self._files[number])
        lines = _lines(path)
        if not lines or lines[0][0] != "106":
            raise ValueError(f"{path}, line 1: 106, the number of points, was expected; got {lines[:1]!r:.80}")
        points, root = _points(path, lines[1:], 106), path.parent.parent
        image = image_beside(path, root / "images")
        mask = image_at(root / "labels" / f"{path.stem}.png", is_mask=True)
        return {"image": image_at(image), "keypoints": points, "mask": mask[0], "path": str(image)}


def _lines(path: Path) -> list[tuple[str, str]]:
    """Those that are not empty, and where they are."""
    with path.open("rb") as file:
        content = text_of(file.read(1 << 16), str(path))  # of a hundred points
    lines = [(line.strip(), f"{path}, line {i}") for i, line in enumerate(content.splitlines(), 1)]
    return [(line, place) for line, place in lines if line]


def _points(path: Path, lines: list[tuple[str, str]], count: int) -> Tensor:
    for line, place in lines[:count]:
        if len(line.split()) != 2:
            raise ValueError(f"{place}: a point is x y; got {line!r:.60}")
    if len(lines) != count:
        place = lines[count][1] if len(lines) > count else lines[-1][1] if lines else f"{path}, line 1"
        raise ValueError(f"{place}: {count} points were expected; got {len(lines)}")
    return torch.stack([numbers_of(line.split(), place, "a point") for line, place in lines])
