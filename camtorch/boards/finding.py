"""Finding boards in photographs for `ct.calibrate`: `find_board`."""

import glob
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import Board, as_board, opencv
from camtorch.boards.detection import detect
from camtorch.io.photographs import read_stored
from camtorch.values.arguments import as_number, shown, warn

_OWNER = "find_board"
IMAGES = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"})  # read, and written
_NAMED = 6  # images left out that a warning names, at most
_RGB = 0.299, 0.587, 0.114
_EITHER_WAY = 0.2065, 0.587, 0.2065  # for RGB and BGR, as boards are black and white


class BoardObservations(NamedTuple):
    """The result of `find_board`: a view for each image that shows the board."""

    object_points: list[NDArray[np.float64]]
    """(N, 3) each: the board's points, in units of `square`."""
    image_points: list[NDArray[np.float64]]
    """(N, 2) pixels each, NaN for unseen points."""
    names: list[str]
    """Paths of the images, or "image 3" for an array."""
    image_size: tuple[int, int]
    """(height, width) of the images."""

    def __repr__(self) -> str:
        seen = sum(int(np.isfinite(pixels[:, 0]).sum()) for pixels in self.image_points)
        height, width = self.image_size
        return f"BoardObservations({len(self.names)} images of {width} x {height}, {seen} points)"


def find_board(images: Any, board: Any, *, square: float = 1.0, **options: Any) -> BoardObservations:
    """Find a board in images, as `camtorch calibrate` does, to calibrate in Python.

        found = ct.find_board("photos/*.jpg", "9x6", square=0.024)
        points = found.object_points, found.image_points
        size = found.image_size
        calibration = ct.calibrate("kannala_brandt", *points, image_size=size)

    Files are read as stored, without their Exif orientation, since a camera describes stored pixels. Images without the
    board, unreadable ones, and those of a rarer size are left out; one warning names them. It needs OpenCV.

    Args:
        images: A path, a folder, a pattern such as "photos/*.jpg", or a list of these; an array (H, W) or (H, W, C),
            uint8 or uint16, a stack or a list of them; Pillow images.
        board: "9x6" or (9, 6), inner corners of a chessboard; "charuco 5x7", squares; "aprilgrid 6x6", tags.
        square: The side of a square, or of a tag, in the unit of the poses.
        options: `marker`, `dictionary`, `legacy` of ChArUco; `spacing`, `border`, `dictionary` of an AprilGrid.

    Raises:
        ValueError: If there is no such board or option, there are no images, or no image shows the board.
        TypeError: If an image is not an image. ImportError: If OpenCV is not installed.
    """
    opencv(_OWNER)
    wanted = as_board(board, as_number(square, "square", _OWNER), options, _OWNER)
    found = search(wanted, _as_images(images))
    used, left_out = usable(found)
    if not used:
        reasons = "; ".join(f"{path}: {why}" for path, why in left_out)
        raise ValueError(f"{_OWNER}: images must show {wanted.words()}; got {len(found)} without. {reasons:.500}")
    if left_out:
        named = ", ".join(f"{path} ({why})" for path, why in left_out[:_NAMED])
        more = f" and {len(left_out) - _NAMED} more" if len(left_out) > _NAMED else ""
        warn(f"{_OWNER}: {len(left_out)} of {len(found)} images are left out: {named}{more}")
    pixels, names = [one.pixels for one in used], [str(one.path) for one in used]
    return BoardObservations([wanted.points()] * len(used), pixels, names, used[0].image_size)


class ImageCorners(NamedTuple):
    """The points of a board in one image."""

    path: Path
    image_size: tuple[int, int]  # (height, width)
    pixels: NDArray[np.float64]  # (N, 2) of the board's points, NaN if unseen
    reason: str  # why no point was found, or empty


Image = tuple[Path, "NDArray[Any] | None"]  # the path of an image, or a name for it and its grey values (H, W)


def search(board: Board, images: Sequence[Image], done: Callable[[], object] = lambda: None) -> list[ImageCorners]:
    """Search images for a board on all cores, and call `done` after each."""
    found = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for one in pool.map(lambda image: _search(board, *image), images):
            found.append(one)
            done()
    return found


def _search(board: Board, path: Path, grey: NDArray[Any] | None) -> ImageCorners:
    try:
        grey = _grey_of(read_stored(path)[0].permute(1, 2, 0).numpy(), _RGB) if grey is None else grey
    except (ValueError, OSError) as error:
        why = " ".join((getattr(error, "strerror", None) or str(error)).removeprefix(f"{path}: ").split())
        return ImageCorners(path, (0, 0), np.full((len(board.points()), 2), np.nan), why)
    return ImageCorners(path, (grey.shape[0], grey.shape[1]), *detect(board, grey))


def usable(found: Sequence[ImageCorners]) -> tuple[list[ImageCorners], list[tuple[Path, str]]]:
    """Return the images that show the board at the most frequent size, and the paths of the others with the reasons."""
    sizes = Counter(one.image_size for one in found if not one.reason)
    usual = sizes.most_common(1)[0][0] if sizes else (0, 0)
    used, left_out = [], []
    for one in found:
        if not one.reason and one.image_size == usual:
            used.append(one)
        else:
            other = "{1}x{0}, but most images are {3}x{2}".format(*one.image_size, *usual)
            left_out.append((one.path, one.reason or other))
    return used, left_out


def gather(words: Iterable[str]) -> list[Path]:
    """Return the paths of images, each once, in natural order, for files, folders (without subfolders) and patterns."""
    found: dict[str, Path] = {}
    for word in words:
        path = Path(word)
        if path.is_dir():
            paths = [p for p in path.iterdir() if p.suffix.lower() in IMAGES and p.is_file()]
            if not paths:
                raise ValueError(f"{word}: the folder must hold images; got none")
        elif os.path.lexists(word) or not glob.has_magic(word):
            paths = [path]
        else:
            paths = [p for p in map(Path, glob.glob(word, recursive=True)) if p.is_file()]
            if not paths:
                raise ValueError(f"{word}: the pattern must match files; got none")
        found |= {os.path.abspath(p): p for p in paths}
    return sorted(found.values(), key=natural)


def natural(path: Path) -> list[tuple[int, int, str]]:
    """Return a key that sorts 2 before 10."""
    parts = re.split(r"(\d+)", str(path))
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in parts]


def _as_images(images: Any) -> list[Image]:
    is_one = isinstance(images, np.ndarray) and (images.ndim == 2 or (images.ndim == 3 and _has_channels(images)))
    if isinstance(images, (str, os.PathLike)) or is_one:
        images = [images]
    if not isinstance(images, (Sequence, np.ndarray)):
        raise TypeError(f"{_OWNER}: images must be paths or arrays; got {shown(images)}")
    if not len(images):
        raise ValueError(f"{_OWNER}: images must not be empty; got none")
    given: list[Image] = []
    for i, one in enumerate(images):
        if isinstance(one, (str, os.PathLike)):
            given += [(path, None) for path in gather([os.fspath(one)])]
        elif hasattr(one, "__array_interface__"):  # like Pillow's images
            given.append((Path(f"image {i}"), _grey_of(np.asarray(one), _EITHER_WAY, f"images[{i}]")))
        else:
            raise TypeError(f"{_OWNER}: images[{i}] must be a path or an array (H, W, C); got {shown(one)}")
    return given


def _has_channels(image: NDArray[Any]) -> bool:
    return image.shape[-1] in (1, 2, 3, 4)


def _grey_of(array: NDArray[Any], weights: Sequence[float], name: str = "image") -> NDArray[Any]:
    """Return the grey values (H, W) of an array (H, W) or (H, W, C), colours by their weights."""
    is_image = array.ndim == 2 or (array.ndim == 3 and _has_channels(array))
    if not is_image or not array.size or array.dtype not in (np.uint8, np.uint16):
        got = f"{array.dtype} of shape {array.shape}"
        raise ValueError(f"{_OWNER}: {name} must be uint8 or uint16, (H, W) or (H, W, C); got {got}")
    if array.ndim == 3 and array.shape[-1] > 2:
        array = np.rint(array[..., :3].astype(np.float32) @ np.array(weights, np.float32)).astype(array.dtype)
    return np.ascontiguousarray(array if array.ndim == 2 else array[..., 0])
