"""Views of boards for `camtorch calibrate`: the images that words mean, those of several cameras that belong together,
and the corners in them, found by all cores, or taken from a file of corners.

Of videos the sharpest frame of each moment is searched, and views that repeat are left out. A frame is called by its
time, as `board.mp4#t=12.345`, in seconds.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camtorch._photographs import ImageFileError
from camtorch.boards.boards import Board, Chessboard, opencv
from camtorch.boards.corners import Corners, ImageCorners, read_corners, write_corners
from camtorch.boards.detection import NOT_FOUND, detect, largest_chessboard
from camtorch.boards.finding import read_grey
from camtorch.cli import videos
from camtorch.cli.terminal import note, progress
from camtorch.jobs.inputs import hash_of, natural

_LEAST_VIEWS = 3
_TRIED_ANEW = 5  # images in which a board of another size is looked for
_MOMENT = 0.5  # seconds, at least, of which the sharpest frame is taken
_MOMENTS = 80  # at most
_SHARP = 0.6  # of the sharpness of the moments beside it, below which one was all motion
_APART = 0.01  # of the image's diagonal: views whose corners are nearer on average are the same
_MARK = "#t="

Views = dict[str, dict[str, ImageCorners]]
"""View -> camera -> what its image shows."""


# -- which images


def together(cameras: Mapping[str, Sequence[Path]], how: str | None) -> tuple[dict[str, dict[str, Path]], str]:
    """Which images of several cameras were taken together.

    `how` is "name", "order", or None for what fits: names that are the same, else the last number in them, else the
    order, for which there must be as many of each.

    Returns:
        Views, camera -> image of each, by a name of the view; and how they were found, in words.
    """
    for words, key in (("file name", lambda path: path.stem), ("number in the file name", _last_number)):
        keyed = {name: {key(path): path for path in paths} for name, paths in cameras.items()}
        whole = all(None not in of and len(of) == len(cameras[name]) for name, of in keyed.items())
        sets = [set(of) for of in keyed.values()]
        seen_twice = {view for i, one in enumerate(sets) for other in sets[:i] for view in one & other}
        if how != "order" and whole and 2 * len(seen_twice) >= min(map(len, sets)) and seen_twice:
            views: dict[str, dict[str, Path]] = {}
            for name, of in keyed.items():
                for view, path in of.items():
                    views.setdefault(str(view), {})[name] = path
            return dict(sorted(views.items(), key=lambda item: natural(Path(item[0])))), f"by the {words}"
    counts = {name: len(paths) for name, paths in cameras.items()}
    if how == "name":
        raise ValueError(f"the images of {', '.join(cameras)} have no names in common; --match order takes their order")
    if len(set(counts.values())) > 1:
        shown = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise ValueError(
            f"{shown}: images are matched by their order, so as many of each are needed; or names that are the same, "
            "or have the same number last, in images that were taken together"
        )
    rows = zip(*cameras.values(), strict=True)
    return {str(i): dict(zip(cameras, row, strict=True)) for i, row in enumerate(rows)}, "by their order"


def _last_number(path: Path) -> str | None:
    numbers = re.findall(r"\d+", path.stem)
    return numbers[-1].lstrip("0") or "0" if numbers else None


# -- corners in images


def found_corners(
    cameras: Mapping[str, Sequence[Path]],
    board: Board | None,
    path: Path | None,
    match: str | None,
    *,
    measured: bool,
    force: bool,
) -> Corners:
    """The corners in images of cameras, or all that a file of corners holds if no images are given.

    Args:
        cameras: images by the names of cameras, "" for a single one; empty for those of the file.
        board: what to look for, or None for that of the file.
        path: a file of corners, from which those of known images are taken, and which is written; or None.
        match: see `together`.
        measured: whether the board's size is known, or that in the file is taken.
        force: whether a file of corners of another board may be overwritten.
    """
    known = read_corners(path) if path is not None and path.exists() else None
    if known is not None and board is not None and (known.board is None or not known.board.looks_like(board)):
        if not force:
            of = "its own points" if known.board is None else known.board.words()
            raise ValueError(f"{path}: holds corners of {of}, not of {board.words()}; --force overwrites it")
        known = None
    if known is not None and not measured:
        board = known.board
    if not cameras:
        if known is None:
            raise ValueError(f"{path}: holds corners of another board, and no images are given to find this one in")
        return known if board is None else replace(known, board=board, points=board.points())
    board = board or (known.board if known else None)
    if board is None:
        raise ValueError("which board? --board COLUMNSxROWS says so, as in 9x6")
    films = [path for paths in cameras.values() for path in paths if videos.is_video(path)]
    if films and len(cameras) > 1:
        raise ValueError(f"{films[0]}: videos are for one camera: nothing tells which frames of two are of one moment")
    if len(cameras) == 1:
        places = [("", str(i), image) for i, image in enumerate(cameras[""]) if image not in films]
    else:
        views, how = together(cameras, match)
        places = [(camera, view, image) for view, of_view in views.items() for camera, image in of_view.items()]
        twice = [str(image) for image, count in Counter(image for *_, image in places).items() if count > 1]
        if twice:
            raise ValueError(f"{twice[0]}: is given as an image of two cameras")
        print(f"{len(views)} views of {', '.join(cameras)}, matched {how}")
    in_videos = [image for path in films for image in _searched_video(path, board, known)]
    found = Corners(board, board.points(), [*_searched(places, board, known), *in_videos])
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_corners(Corners(board, found.points, [*found.images, *_others(known, found.images)]), path)
    return found


def _others(known: Corners | None, images: Sequence[ImageCorners]) -> list[ImageCorners]:
    """What a file of corners has of images that are not asked for: it stays."""
    if known is None:
        return []
    hashes, paths = {image.hash for image in images}, {image.path.resolve() for image in images}
    return [one for one in known.images if not (one.hash and one.hash in hashes) and one.path.resolve() not in paths]


def _searched(places: Sequence[tuple[str, str, Path]], board: Board, known: Corners | None) -> list[ImageCorners]:
    """What images show, by camera, view and path; those that are known by what is in them are not searched again."""
    there: dict[str | Path, ImageCorners] = {}
    for image in known.images if known else ():
        there[image.path.resolve()] = image
        if image.hash:
            there[image.hash] = image
    show = progress("finding boards")
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            found = [pool.submit(_searched_one, path, board, there) for *_, path in places]
            for count, _ in enumerate(as_completed(found), 1):
                show(count / len(places))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [
        replace(future.result(), camera=camera, view=view)
        for future, (camera, view, _) in zip(found, places, strict=True)
    ]


def _searched_one(path: Path, board: Board, known: Mapping[str | Path, ImageCorners]) -> ImageCorners:
    """By the file's content; by its path where corners come from elsewhere, or the image is gone."""
    nothing, at_path = np.full((len(board.points()), 2), np.nan), known.get(path.resolve())
    if at_path is not None and not at_path.hash:
        return replace(at_path, path=path)
    try:
        digest = hash_of(path)
        if digest in known:
            return replace(known[digest], path=path)
        grey = read_grey(path, note)
    except (ImageFileError, OSError) as error:
        if isinstance(error, FileNotFoundError) and at_path is not None:
            return replace(at_path, path=path)
        reason = getattr(error, "strerror", None) or str(error).removeprefix(f"{path}: ")
        return ImageCorners(path, None, nothing, reason)
    found = detect(board, grey)
    return ImageCorners(path, grey.shape, found.pixels, found.reason, digest)


def usable_views(corners: Corners) -> tuple[Views, dict[str, tuple[int, int]]]:
    """The views that a calibration can use; notes say which images it cannot, and why.

    Returns:
        The views; and camera -> (height, width).

    Raises:
        ValueError: too few.
    """
    cameras = list(dict.fromkeys(image.camera for image in corners.images))
    sizes = {name: Counter(i.image_size for i in corners.images if i.camera == name and i.seen) for name in cameras}
    size_of = {name: count.most_common(1)[0][0] for name, count in sizes.items() if count}
    views: Views = {}
    for number, image in enumerate(corners.images):
        reason = image.reason or ("" if image.seen else NOT_FOUND)
        usual = size_of.get(image.camera)
        if not reason and image.image_size != usual:
            reason = f"{_shown(image.image_size)}, but most images are {_shown(usual)}"
        if reason:
            note(f"{image.path} is left out: {reason}")
        else:
            # of a single camera every image is a view
            views.setdefault(image.view if image.camera else str(number), {})[image.camera] = image
    for name in cameras:
        seen = sum(name in of_view for of_view in views.values())
        if seen < _LEAST_VIEWS:
            of, total = f" of {name}" if name else "", sum(image.camera == name for image in corners.images)
            raise ValueError(
                f"a board was found in {seen} of {total} images{of}, and {_LEAST_VIEWS} are needed, better 20"
                f"{_advice(corners)}"
            )
    return views, {name: size for name, size in size_of.items() if size is not None}


def _shown(size: tuple[int, int] | None) -> str:
    return "of no size" if size is None else f"{size[1]}x{size[0]}"


def _advice(corners: Corners) -> str:
    """What may be wrong, where hardly anything was found."""
    board, some = corners.board, any(image.seen for image in corners.images)
    if not isinstance(board, Chessboard):
        return ""
    unseen = [image for image in corners.images if image.image_size and not image.seen and image.path.exists()]
    greys = {image.path: read_grey(image.path, note) for image in unseen[:_TRIED_ANEW]}
    sizes = Counter(filter(None, map(largest_chessboard, greys.values())))
    # of one image that shows a part of the board, another one shows the whole
    for other, _ in sorted(sizes.items(), key=lambda size: (size[1], size[0].columns * size[0].rows), reverse=True):
        showing = [path for path, grey in greys.items() if not detect(other, grey).reason]
        if other.looks_like(board) or len(showing) < min(2, len(greys)):
            continue
        size = f"{other.columns}x{other.rows}"
        others = f" and {len(showing) - 1} more show" if len(showing) > 1 else " shows"
        return f"; {showing[0]}{others} one of {size} inner corners: --board {size}"
    return "" if some else f"; does it have {board.columns}x{board.rows} inner corners, where four squares meet?"


# -- corners in videos


class _Frame(NamedTuple):
    seconds: float
    sharpness: float
    grey: NDArray[np.uint8]

    @property
    def name(self) -> str:
        return f"{_MARK}{self.seconds:.3f}"


def _searched_video(path: Path, board: Board, known: Corners | None) -> list[ImageCorners]:
    """What frames of a video show of a board; those that are known by what is in the file are taken as they are.

    Returns:
        Sharp views that differ, each with the board; or the video itself, with the reason why there is none.
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


def read_frames(paths: Iterable[Path | None]) -> Mapping[Path, NDArray[np.uint8]]:
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
