"""Boards in videos for the command line: of each moment the sharpest frame is searched, and views that repeat are left
out.

A frame is called by its time, as `board.mp4#t=12.345`, in seconds.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import Board, opencv
from camtorch.boards.corners import Corners, ImageCorners
from camtorch.boards.detection import detect
from camtorch.cli import videos
from camtorch.cli.terminal import note, progress
from camtorch.io.hashing import hash_of

_MOMENT = 0.5  # seconds, at least, of which the sharpest frame is taken
_MOMENTS = 80  # at most
_SHARP = 0.6  # of the sharpness of the moments beside it, below which one was all motion
_APART = 0.01  # of the image's diagonal: views whose corners are nearer on average are the same
_MARK = "#t="


class _Frame(NamedTuple):
    seconds: float
    sharpness: float
    grey: NDArray[np.uint8]

    @property
    def name(self) -> str:
        return f"{_MARK}{self.seconds:.3f}"


def searched(path: Path, board: Board, known: Corners | None) -> list[ImageCorners]:
    """What frames of a video show of a board; those that are known by what is in the file are taken as they are.

    Returns:
        Sharp views that differ, each with the board; or the video itself, with the reason why there is none.

    Raises:
        VideoFileError: it cannot be read. ImportError: PyAV or OpenCV is missing. OSError: there is no such file.
    """
    digest = hash_of(path)
    again = [image for image in known.images if image.hash.startswith(digest + _MARK)] if known else []
    if again:
        return [ImageCorners(_called(path, i.hash), i.image_size, i.pixels, i.reason, i.hash) for i in again]
    cv2 = opencv("finding boards in images")
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            found = [(frame, pool.submit(detect, board, frame.grey)) for frame in _sharp(_sharpest(cv2, path))]
            seen = [(frame, future.result().pixels) for frame, future in found if not future.result().reason]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    views = _different(seen)
    print(f"{path}: of {len(found)} sharp frames {len(seen)} show the board, and {len(views)} of these differ")
    if not views:
        return [ImageCorners(path, None, np.full((len(board.points()), 2), np.nan), "no board found in its frames")]
    return [
        ImageCorners(_called(path, frame.name), (*frame.grey.shape,), pixels, "", digest + frame.name)
        for frame, pixels in views
    ]


def _called(path: Path, name: str) -> Path:
    """The path of a frame, whose name ends as this one."""
    return path.with_name(path.name + _MARK + name.rpartition(_MARK)[2])


def read(paths: Iterable[Path | None]) -> Mapping[Path, NDArray[np.uint8]]:
    """(H, W) of those of the paths that are frames of videos that are there."""
    wanted: dict[Path, set[Path]] = {}
    for path in paths:
        if path is not None and _MARK in path.name and not path.exists():
            wanted.setdefault(path.with_name(path.name.rpartition(_MARK)[0]), set()).add(path)
    images = {}
    for video, frames in wanted.items():
        if video.exists():
            for seconds, _, frame in videos.frames(video):
                name = _called(video, f"{_MARK}{seconds:.3f}")
                if name in frames:
                    images[name] = frame.to_ndarray(format="gray")
    return images


def _sharpest(cv2: Any, path: Path) -> Iterator[_Frame]:
    """The sharpest frame of each moment."""
    moment = max(_MOMENT, videos.length_of(path) / _MOMENTS)
    best, number, show = None, 0, progress(f"reading {path.name}")
    for seconds, part, frame in videos.frames(path):
        show(part)
        if best is None and frame.rotation:
            note(
                f"{path}: is shown turned by {frame.rotation} degrees; the camera is that of the frames as they are "
                "stored, which is how `camtorch dewarp` takes them"
            )
        if best is not None and int(seconds / moment) != number:
            yield best
            best = None
        grey = frame.to_ndarray(format="gray")
        small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        sharpness = float(cv2.Laplacian(small, cv2.CV_32F).var())
        if best is None or sharpness > best.sharpness:
            best, number = _Frame(seconds, sharpness, grey), int(seconds / moment)
    show(1)
    if best is not None:
        yield best


def _sharp(frames: Iterable[_Frame]) -> Iterator[_Frame]:
    """Those that are not much less sharp than the ones before and after."""
    before, frame = 0.0, None
    for after in chain(frames, [None]):
        if frame is not None:
            if frame.sharpness >= _SHARP * max(before, after.sharpness if after else 0.0):
                yield frame
            before = frame.sharpness
        frame = after


def _different(seen: list[tuple[_Frame, NDArray[np.float64]]]) -> list[tuple[_Frame, NDArray[np.float64]]]:
    """The sharpest of those that show the board in the same place; in the order of time."""
    kept: list[tuple[_Frame, NDArray[np.float64]]] = []
    for frame, pixels in sorted(seen, key=lambda one: -one[0].sharpness):
        least = _APART * float(np.hypot(*frame.grey.shape))
        apart = (np.linalg.norm(pixels - other, axis=1) for _, other in kept)
        if all(np.isnan(distances).all() or np.nanmean(distances) > least for distances in apart):
            kept.append((frame, pixels))
    return sorted(kept, key=lambda one: one[0].seconds)
