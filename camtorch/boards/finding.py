"""Boards in photographs, as `ct.calibrate` takes them: `find_board`."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from camtorch._arguments import as_number, shown, warn
from camtorch._photographs import read_stored
from camtorch.boards.boards import Board, board_of, opencv
from camtorch.boards.corners import ImageCorners, usual_sizes
from camtorch.boards.detection import detect

_OWNER = "find_board"
_IMAGES = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"})
"""Suffixes, in lower case, of the files that are taken from a folder."""
_NAMED = 6  # images left out, in the warning
_RED, _GREEN, _BLUE = 0.299, 0.587, 0.114


class BoardObservations(NamedTuple):
    """What `find_board` found: a view for each image that shows the board."""

    object_points: list[NDArray[np.float64]]
    """(N, 3) each: the board's points, in units of `square`."""
    image_points: list[NDArray[np.float64]]
    """(N, 2) pixels each, NaN where a point was not seen."""
    names: list[str]
    """Of the images: their paths, or "image 3" of an array."""
    image_size: tuple[int, int]
    """(height, width)."""

    def __repr__(self) -> str:
        seen = sum(int(np.isfinite(pixels[:, 0]).sum()) for pixels in self.image_points)
        height, width = self.image_size
        return f"BoardObservations({len(self.names)} images of {width} x {height}, {seen} points)"


def find_board(images: Any, board: Any, *, square: float = 1.0, **options: Any) -> BoardObservations:
    """Find a board in images: the finder of `camtorch calibrate`, for calibrations in Python.

        found = ct.find_board("photos/*.jpg", "9x6", square=0.024)
        calibration = ct.calibrate(
            "kannala_brandt", found.object_points, found.image_points, image_size=found.image_size
        )

    Files are taken as they are stored, and not turned by their Exif orientation, since a camera is that of stored
    pixels. Images without the board, that cannot be read, or of another size than most are left out, and one warning
    names them. It needs OpenCV: `pip install "camtorch[calibrate]"`.

    Args:
        images: a path, a folder, a pattern as "photos/*.jpg", or a list of these; or arrays (H, W), (H, W, C), tensors
            (C, H, W), one, a list, or a stack of them, uint8 or uint16 (floating point is taken as 0 to 1); or a list
            of PIL's images.
        board: "9x6", the inner corners of a chessboard across and down, or (9, 6); "charuco 5x7", squares; "aprilgrid
            6x6", tags.
        square: the side of a square, or of a tag, in the unit that poses shall have.
        options: `marker`, `dictionary` and `legacy` of a ChArUco board, `spacing`, `border` and `dictionary` of a grid
            of tags; see `camtorch calibrate --help`.

    Raises:
        ValueError: no such board or option, no images, or no image that shows the board; with what to try.
        TypeError: something that is no image. ImportError: there is no OpenCV.
    """
    opencv(_OWNER)
    wanted = as_board(board, as_number(square, "square", _OWNER), options)
    given = _given(images)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = list(pool.map(lambda one: corners_in(wanted, *one), given))
    usual = usual_sizes(found).get("")
    if usual is None:
        reasons = "; ".join(f"{one.path}: {one.reason}" for one in found)
        raise ValueError(f"{_OWNER}: {wanted.words()} is in none of {len(given)} images: {reasons:.500}")
    left_out = [f"{one.path} ({why})" for one in found if (why := one.unusable(usual))]
    used = [one for one in found if not one.unusable(usual)]
    if left_out:
        more = f" and {len(left_out) - _NAMED} more" if len(left_out) > _NAMED else ""
        warn(
            f"{_OWNER}: {len(left_out)} of {len(given)} images are left out: {', '.join(left_out[:_NAMED])}{more}",
        )
    points, pixels = [wanted.points()] * len(used), [one.pixels for one in used]
    return BoardObservations(points, pixels, [str(one.path) for one in used], usual)


def as_board(board: Any, square: float, options: dict[str, Any]) -> Board:
    """The board of words as "charuco 5x7", or of OpenCV's (9, 6)."""
    if isinstance(board, (tuple, list)) and len(board) == 2:
        board = f"{board[0]}x{board[1]}"
    match = (
        re.fullmatch(r"\s*(?:([a-z]+)\s+)?(\d+)\s*[x,]\s*(\d+)\s*", board.lower()) if isinstance(board, str) else None
    )
    if match is None:
        raise ValueError(
            f'{_OWNER}: board must be "9x6" (inner corners of a chessboard), "charuco 5x7" or "aprilgrid 6x6"; got '
            f"{shown(board)}"
        )
    kind = match[1] or "chessboard"
    own = {"type": kind, "columns": int(match[2]), "rows": int(match[3]), "square": square, **options}
    if kind == "charuco":
        own.setdefault("marker", 0.75 * square)
    return board_of(own)


def _given(images: Any) -> list[tuple[Path, NDArray[Any] | None]]:
    """The path of each image, or a name and the array of one that is in memory."""
    if isinstance(images, (str, os.PathLike)):
        images = [images]
    if isinstance(images, (np.ndarray, torch.Tensor)):
        images = [images] if images.ndim == 2 or (images.ndim == 3 and _is_colour(images)) else list(images)
    if not isinstance(images, Sequence):
        raise TypeError(f"{_OWNER}: images must be paths or arrays; got {shown(images)}")
    if not images:
        raise ValueError(f"{_OWNER}: no images")
    given: list[tuple[Path, NDArray[Any] | None]] = []
    for i, one in enumerate(images):
        if isinstance(one, (str, os.PathLike)):
            given += [(path, None) for path in gather([os.fspath(one)])]
        elif isinstance(one, torch.Tensor) or hasattr(one, "__array_interface__"):  # as images of PIL have it
            array = one if isinstance(one, torch.Tensor) else np.asarray(one)
            given.append((Path(f"image {i}"), _grey_of(array, f"images[{i}]")))
        else:
            raise TypeError(f"{_OWNER}: images[{i}] must be a path or an array; got {shown(one)}")
    return given


def _is_colour(image: Any) -> bool:
    first, last = (3, 4, 1), (3, 4, 1)
    return image.shape[0] in first if isinstance(image, torch.Tensor) else image.shape[-1] in last


def _grey_of(image: Any, name: str) -> NDArray[Any]:
    """(H, W) of grey values."""
    array = image.detach().cpu().numpy() if isinstance(image, torch.Tensor) else image
    if array.ndim == 3 and _is_colour(image):
        array = np.moveaxis(array, 0, -1) if isinstance(image, torch.Tensor) else array
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[-1] not in (1, 3, 4)) or not array.size:
        raise ValueError(
            f"{_OWNER}: {name} must be an array (H, W) or (H, W, C), or a tensor (C, H, W); got {tuple(image.shape)}"
        )
    if array.dtype.kind == "f":
        if float(array.max()) > 1:
            raise ValueError(f"{_OWNER}: {name} is of floating point, from 0 to 1; got up to {float(array.max()):g}")
        array = np.rint(255 * array).astype(np.uint8)
    if array.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{_OWNER}: {name} must be uint8 or uint16; got {array.dtype}")
    if array.ndim == 2 or array.shape[-1] == 1:
        return np.ascontiguousarray(array.reshape(array.shape[:2]))
    # red and blue may have changed places: of black and white they are the same
    weights = (_RED + _BLUE) / 2, _GREEN, (_RED + _BLUE) / 2
    return np.rint(array[..., :3].astype(np.float32) @ np.array(weights, np.float32)).astype(array.dtype)


def corners_in(board: Board, path: Path, grey: NDArray[Any] | None = None) -> ImageCorners:
    """What an image shows, which is read unless its grey values (H, W) are given."""
    try:
        grey = read_grey(path) if grey is None else grey
    except (ValueError, OSError) as error:
        nothing = np.full((len(board.points()), 2), np.nan)
        why = getattr(error, "strerror", None) or str(error)
        return ImageCorners(path, None, nothing, " ".join(why.removeprefix(f"{path}: ").split()))
    found = detect(board, grey)
    return ImageCorners(path, (grey.shape[0], grey.shape[1]), found.pixels, found.reason)


def gather(words: Iterable[str]) -> list[Path]:
    """Images, each once, in natural order, of files, folders (not those in them), and patterns.

    Raises:
        ValueError: a word that means no image.
    """
    found: dict[str, Path] = {}
    for word in words:
        path = Path(word)
        if path.is_dir():
            paths = [p for p in path.iterdir() if p.suffix.lower() in _IMAGES and p.is_file()]
            if not paths:
                raise ValueError(f"{word}: a folder without images")
        elif os.path.lexists(word) or not glob.has_magic(word):
            paths = [path]
        else:
            paths = [p for p in map(Path, glob.glob(word, recursive=True)) if p.is_file()]
            if not paths:
                raise ValueError(f"{word}: no file has such a name")
        found |= {os.path.abspath(p): p for p in paths}
    return sorted(found.values(), key=natural)


def natural(path: Path) -> list[tuple[int, int, str]]:
    """Return a key that sorts 2 before 10."""
    parts = re.split(r"(\d+)", str(path))
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in parts]


def read_grey(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """(H, W) of an image file, as stored; see `read_stored`."""
    pixels = read_stored(path)[0].numpy()
    if len(pixels) < 3:
        return np.ascontiguousarray(pixels[0])
    red, green, blue = pixels[:3].astype(np.float32)
    grey: np.ndarray = np.rint(_RED * red + _GREEN * green + _BLUE * blue).astype(np.uint8)
    return grey
