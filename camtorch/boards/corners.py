"""Files of corners: what was found of a board in images, so that it is found once, by whatever tool.

JSON: `{"camtorch_corners": 1, "board": {...}, "points": [[x, y, z], ...], "images": [...]}`.

* `board`: the options of a board, as `Board.options` says them; null or left out for a board of another kind.
* `points`: of the board, in its frame, in metres or the caller's unit; may be left out where `board` is given.
* `images`: each `{"path": ..., "width": ..., "height": ..., "corners": [[index, u, v], ...]}`: the number of a point,
  from 0, and the pixel where it is seen, an integer being a pixel's centre. Also, if there is something to say,
  `camera` and `view`: names of the camera of a rig and of the moment, the same in images that were taken together;
  `reason`: why there are no corners; `hash`: of the file (BLAKE2b, 16 bytes, hexadecimal), by which it is known again
  wherever it lies. Paths are relative to the folder of the file of corners.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import Board, board_of
from camtorch.boards.detection import NOT_FOUND
from camtorch.io.writing import as_json, replacing

_FORMAT = "camtorch_corners"
_VERSION = 1


class CornersFileError(ValueError):
    """A file of corners that cannot be used. The text names the file, the place and the reason."""


@dataclass(eq=False)
class ImageCorners:
    """What was found in one image."""

    path: Path
    image_size: tuple[int, int] | None
    """(height, width), or None where it could not be read."""
    pixels: NDArray[np.float64]
    """(N, 2) of the board's points, NaN where unseen."""
    reason: str = ""
    """Why nothing was found."""
    hash: str = ""
    camera: str = ""
    view: str = ""

    @property
    def seen(self) -> int:
        """How many points."""
        return int(np.isfinite(self.pixels[:, 0]).sum())

    def unusable(self, usual: tuple[int, int] | None) -> str:
        """Why it says nothing of a camera whose images have a size, (height, width), as a rule; empty where it does."""
        if self.reason or not self.seen:
            return self.reason or NOT_FOUND
        if self.image_size == usual:
            return ""
        own, most = (f"{size[1]}x{size[0]}" for size in (self.image_size, usual) if size)
        return f"{own}, but most images are {most}"


def usual_sizes(images: Sequence[ImageCorners]) -> dict[str, tuple[int, int]]:
    """(height, width) of most images that show the board, by the name of their camera."""
    sizes: dict[str, Counter[tuple[int, int]]] = {}
    for image in images:
        if image.seen and image.image_size:
            sizes.setdefault(image.camera, Counter())[image.image_size] += 1
    return {camera: counted.most_common(1)[0][0] for camera, counted in sizes.items()}


@dataclass(eq=False)
class Corners:
    """What was found of a board in images."""

    board: Board | None
    points: NDArray[np.float64]
    """(N, 3)."""
    images: list[ImageCorners] = field(default_factory=list)


def read_corners(path: str | os.PathLike[str]) -> Corners:
    """A file of corners.

    Raises:
        CornersFileError: it is none. OSError: it cannot be opened.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise CornersFileError(f"{path}: no JSON: {error}") from None
    if not isinstance(content, dict) or content.get(_FORMAT) != _VERSION:
        raise CornersFileError(f'{path}: no file of corners, which begin with {{"{_FORMAT}": {_VERSION}}}')
    where = "board"
    try:
        board = None if content.get("board") is None else board_of(content["board"])
        where = "points"
        points = board.points() if board and "points" not in content else _numbers(content["points"], 3)
        where = "images"
        found = Corners(board, points)
        for number, image in enumerate(content["images"]):
            where = f"images[{number}]"
            found.images.append(_image(image, len(points), Path(path).parent))
    except KeyError as error:
        raise CornersFileError(f"{path}: {where}: {error} is missing") from None
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise CornersFileError(f"{path}: {where}: {error}") from None
    return found


def _numbers(values: Any, width: int) -> NDArray[np.float64]:
    """(N, width) of finite numbers."""
    array = np.asarray(values if values else np.zeros((0, width)), dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != width or not np.isfinite(array).all():
        raise ValueError(f"must be rows of {width} finite numbers; got {values!s:.60}")
    return array


def _image(record: dict[str, Any], count: int, folder: Path) -> ImageCorners:
    pixels, rows = np.full((count, 2), np.nan), _numbers(record["corners"], 3)
    numbers = rows[:, 0].tolist()
    if not set(numbers) <= set(range(count)):
        raise ValueError(f"corners must begin with the number of a point, 0 to {count - 1}; got {numbers!s:.60}")
    if len(set(numbers)) < len(numbers):
        raise ValueError(f"a point appears twice: {next(int(n) for n in numbers if numbers.count(n) > 1)}")
    pixels[rows[:, 0].astype(int)] = rows[:, 1:]
    size = None
    if record.get("width") is not None:
        size = int(record["height"]), int(record["width"])
        if min(size) <= 0:
            raise ValueError(f"width and height must be positive; got {size[1]} and {size[0]}")
    elif len(rows):
        raise ValueError("width and height of the image are missing")
    texts = {name: str(record.get(name, "")) for name in ("reason", "hash", "camera", "view")}
    return ImageCorners(folder / str(record["path"]), size, pixels, **texts)


def write_corners(corners: Corners, path: str | os.PathLike[str]) -> None:
    """Write a file of corners, whole or not at all."""
    folder = Path(path).resolve().parent
    content = {
        _FORMAT: _VERSION,
        "board": None if corners.board is None else corners.board.options(),
        "points": corners.points.tolist(),
        "images": [_record(image, folder) for image in corners.images],
    }
    with replacing(path) as (file,):
        file.write(as_json(content).encode())


def _record(image: ImageCorners, folder: Path) -> dict[str, Any]:
    try:
        path = Path(os.path.relpath(image.path.resolve(), folder))
    except ValueError:  # on another drive
        path = image.path.resolve()
    record: dict[str, Any] = {"path": path.as_posix()}
    record |= {name: text for name in ("camera", "view", "hash", "reason") if (text := getattr(image, name))}
    if image.image_size is not None:
        record |= {"width": image.image_size[1], "height": image.image_size[0]}
    seen = np.flatnonzero(np.isfinite(image.pixels[:, 0])).tolist()
    return record | {"corners": [[i, *image.pixels[i].tolist()] for i in seen]}


def image_points(images: Sequence[ImageCorners | None], count: int) -> NDArray[np.float64]:
    """(V, N, 2) of views, NaN where unseen; None is a view without an image."""
    nothing = np.full((count, 2), np.nan)
    return np.stack([nothing if image is None else image.pixels for image in images])
