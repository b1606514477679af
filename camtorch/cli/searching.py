"""Views of boards for `camtorch calibrate`: images of several cameras that belong together, and the corners in them.

Corners are found by all cores, or taken from a file of corners where that has those of the same images.

Of videos the sharpest frame of each moment is searched, and views that repeat are left out. A frame is called by its
time, as `board.mp4#t=12.345`, in seconds.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import Board, opencv
from camtorch.boards.corners import Corners, ImageCorners, read_corners, usual_sizes, write_corners
from camtorch.boards.detection import detect
from camtorch.boards.finding import corners_in, natural
from camtorch.cli import videos
from camtorch.cli.terminal import bar, note

_LEAST_VIEWS = 3
_MOMENT = 0.5  # seconds, at least, of which the sharpest frame is taken
_MOMENTS = 80  # at most
_SHARP = 0.6  # of the sharpness of the moments beside it, below which one was all motion
_APART = 0.01  # of the image's diagonal: views whose corners are nearer on average are the same
_MARK = "#t="

Views = dict[str, dict[str, ImageCorners]]
"""View -> camera -> what its image shows."""
T = TypeVar("T")
R = TypeVar("R")


@dataclass
class Found:
    """Corners in images."""

    corners: Corners
    frames: dict[Path, NDArray[np.uint8]]
    """Those of videos that were taken, by their names."""


def together(cameras: Mapping[str, Sequence[Path]]) -> dict[str, dict[str, Path]]:
    """Which images of several cameras were taken together: those of one name, else of the same last number in it, else
    of the same place in their order, for which there must be as many of each; by a name of the view.
    """
    keys: tuple[Callable[[Path], str | None], ...] = (lambda path: path.stem, _last_number)
    for key in keys:
        keyed = {name: {key(path): path for path in paths} for name, paths in cameras.items()}
        if all(None not in of and len(of) == len(cameras[name]) for name, of in keyed.items()):
            seen = Counter(view for of in keyed.values() for view in of)
            shared = [view for view, count in seen.items() if count > 1]
            if shared and 2 * len(shared) >= min(map(len, keyed.values())):
                ordered = sorted(seen, key=lambda view: natural(Path(str(view))))
                return {str(view): {name: of[view] for name, of in keyed.items() if view in of} for view in ordered}
    if len({len(paths) for paths in cameras.values()}) > 1:
        counts = ", ".join(f"{len(paths)} of {name}" for name, paths in cameras.items())
        raise ValueError(
            f"{counts}: images that were taken together have the same name, or the same number last in it; or there "
            "are as many of each, in their order"
        )
    rows = zip(*cameras.values(), strict=True)
    return {str(i): dict(zip(cameras, row, strict=True)) for i, row in enumerate(rows)}


def hash_of(path: Path) -> str:
    """BLAKE2b of what is in a file, 16 bytes, hexadecimal."""
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def _last_number(path: Path) -> str | None:
    numbers = re.findall(r"\d+", path.stem)
    return numbers[-1].lstrip("0") or "0" if numbers else None


# -- corners in images


def found_corners(cameras: Mapping[str, Sequence[Path]], board: Board, known: Corners | None = None) -> Found:
    """The corners of a board in images, by the names of cameras, "" for a single one; those of images that are known,
    by path and content, are not searched for again.
    """
    there = {image.path.resolve(): image for image in known.images} if known else {}
    films = [path for paths in cameras.values() for path in paths if videos.is_video(path)]
    if films and len(cameras) > 1:
        raise ValueError(f"{films[0]}: videos are for one camera: nothing tells which frames of two are of one moment")
    if len(cameras) == 1:
        places = [("", str(i), image) for i, image in enumerate(cameras[""]) if image not in films]
    else:
        views = together(cameras)
        places = [(camera, view, image) for view, of_view in views.items() for camera, image in of_view.items()]
        twice = [str(image) for image, count in Counter(image for *_, image in places).items() if count > 1]
        if twice:
            raise ValueError(f"{twice[0]}: is given as an image of two cameras")
        print(f"{len(views)} views of {', '.join(cameras)}")
    searched = _each(lambda place: _searched(place[2], board, there), places, "finding boards")
    images = [replace(one, camera=camera, view=view) for one, (camera, view, _) in zip(searched, places, strict=True)]
    frames: dict[Path, NDArray[np.uint8]] = {}
    for path in films:
        again = [one for place, one in there.items() if str(place).startswith(f"{path.resolve()}{_MARK}")]
        if again and all(one.hash == hash_of(path) for one in again):
            images += again
            continue
        found = _searched_video(path, board)
        images += [one for one, _ in found]
        frames |= {one.path: grey for one, grey in found}
        if not found:
            nothing = np.full((len(board.points()), 2), np.nan)
            images.append(ImageCorners(path, None, nothing, "no board found in its frames"))
    return Found(Corners(board, board.points(), images), frames)


def known_corners(path: Path, board: Board | None, *, measured: bool) -> Corners:
    """Those of a file, of its own board, or of one that looks like it, if the size of that was `measured`."""
    corners = read_corners(path)
    if board is None:
        return corners
    if corners.board is None or not corners.board.looks_like(board):
        of = "its own points" if corners.board is None else corners.board.words()
        raise ValueError(f"{path}: holds corners of {of}, not of {board.words()}; name another file")
    return replace(corners, board=board, points=board.points()) if measured else corners


def write_found(found: Corners, known: Corners | None, path: Path) -> None:
    """Keep corners in a file, with what it has of other images."""
    paths = {image.path.resolve() for image in found.images}
    others = [image for image in (known.images if known else ()) if image.path.resolve() not in paths]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_corners(replace(found, images=[*found.images, *others]), path)


def _each(work: Callable[[T], R], tasks: Sequence[T], what: str) -> list[R]:
    """By all cores, with a bar."""
    with ThreadPoolExecutor(os.cpu_count()) as pool, bar(what, len(tasks), "images") as shown:
        try:
            futures = [pool.submit(work, task) for task in tasks]
            for future in futures:
                future.add_done_callback(lambda _: shown.update())
            return [future.result() for future in futures]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _searched(path: Path, board: Board, known: Mapping[Path, ImageCorners]) -> ImageCorners:
    """What an image shows; what is known of one that is gone, or that another tool has searched, is believed."""
    one = known.get(path.resolve())
    digest = hash_of(path) if path.is_file() and os.access(path, os.R_OK) else ""
    if one is not None and (one.hash in ("", digest) or not path.exists()):
        return replace(one, path=path)
    return replace(corners_in(board, path), hash=digest)


def usable_views(corners: Corners) -> tuple[Views, dict[str, tuple[int, int]]]:
    """The views that a calibration can use; notes say which images it cannot, and why.

    Returns:
        The views; and camera -> (height, width).

    Raises:
        ValueError: too few.
    """
    size_of = usual_sizes(corners.images)
    views: Views = {}
    for number, image in enumerate(corners.images):
        if why := image.unusable(size_of.get(image.camera)):
            note(f"{image.path} is left out: {why}")
        else:
            # of a single camera every image is a view
            views.setdefault(image.view if image.camera else str(number), {})[image.camera] = image
    for name in dict.fromkeys(image.camera for image in corners.images):
        seen = sum(name in of_view for of_view in views.values())
        if seen < _LEAST_VIEWS:
            of, total = f" of {name}" if name else "", sum(image.camera == name for image in corners.images)
            raise ValueError(
                f"a board was found in {seen} of {total} images{of}, and {_LEAST_VIEWS} are needed, better 20; is it "
                f"{'this one' if corners.board is None else corners.board.words()}?"
            )
    return views, size_of


# -- corners in videos

_Frame = tuple[float, float, NDArray[np.uint8]]
"""When a frame is shown, in seconds; its sharpness; (H, W)."""


def _searched_video(path: Path, board: Board) -> list[tuple[ImageCorners, NDArray[np.uint8]]]:
    """Sharp frames that show a board in different places, the sharper of two that do in the same; in order of time."""
    moments = list(_sharpest(path))
    beside = [0.0, *(sharpness for _, sharpness, _ in moments), 0.0]
    sharp = [one for i, one in enumerate(moments) if one[1] >= _SHARP * max(beside[i], beside[i + 2])]
    found = _each(lambda frame: detect(board, frame[2]), sharp, f"finding boards in {path.name}")
    seen = [(*frame, one.pixels) for frame, one in zip(sharp, found, strict=True) if not one.reason]
    kept, digest = list[tuple[float, ImageCorners, NDArray[np.uint8]]](), hash_of(path)
    for seconds, _, grey, pixels in sorted(seen, key=lambda one: -one[1]):
        least = _APART * float(np.hypot(*grey.shape))
        apart = (np.linalg.norm(pixels - other.pixels, axis=1) for _, other, _ in kept)
        if all(np.isnan(distances).all() or np.nanmean(distances) > least for distances in apart):
            name, size = path.with_name(f"{path.name}{_MARK}{seconds:.3f}"), (grey.shape[0], grey.shape[1])
            kept.append((seconds, ImageCorners(name, size, pixels, hash=digest), grey))
    print(f"{path}: of {len(sharp)} sharp frames {len(seen)} show the board, and {len(kept)} of these differ")
    return [(image, grey) for _, image, grey in sorted(kept, key=lambda one: one[0])]


def _sharpest(path: Path) -> Iterator[_Frame]:
    """The sharpest frame of each moment."""
    cv2: Any = opencv("finding boards in images")
    moment, best = max(_MOMENT, videos.length_of(path) / _MOMENTS), None
    with bar(f"reading {path.name}", videos.count_of(path), "frames") as shown:
        for seconds, frame in videos.frames(path):
            shown.update()
            if seconds == 0 and frame.rotation:
                note(
                    f"{path}: is shown turned by {frame.rotation} degrees; the camera is that of the frames as they "
                    "are stored, which is how `camtorch dewarp` takes them"
                )
            grey = frame.to_ndarray(format="gray")
            small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            new = seconds, float(cv2.Laplacian(small, cv2.CV_32F).var()), grey
            if best is not None and int(seconds / moment) != int(best[0] / moment):
                yield best
                best = None
            best = new if best is None or new[1] > best[1] else best
    if best is not None:
        yield best
