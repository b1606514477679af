"""Corners of boards for the command line: found in images by all cores, or taken from a file of corners."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import Board, Chessboard
from camtorch.boards.corners import Corners, ImageCorners, read_corners, write_corners
from camtorch.boards.detection import NOT_FOUND, detect, largest_chessboard
from camtorch.cli import frames, images, videos
from camtorch.cli.gathering import together
from camtorch.cli.terminal import note, progress
from camtorch.io.hashing import hash_of

_LEAST_VIEWS = 3
_TRIED_ANEW = 5  # images in which a board of another size is looked for


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
        match: how images of several cameras are put together, see `gathering.together`.
        measured: whether the board's size is known, or that in the file is taken.
        force: whether a file of corners of another board may be overwritten.

    Raises:
        ValueError: no board, a file of corners of another one, views that do not fit together.
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
        print(f"{len(views)} views of {', '.join(cameras)}, matched {how}")
        places = [(camera, view, image) for view, of_view in views.items() for camera, image in of_view.items()]
        twice = [str(image) for image, count in Counter(image for *_, image in places).items() if count > 1]
        if twice:
            raise ValueError(f"{twice[0]}: is given as an image of two cameras")
    in_videos = [image for path in films for image in frames.searched(path, board, known)]
    found = Corners(board, board.points(), [*_searched(places, board, known), *in_videos])
    if path is not None:
        kept = Corners(board, found.points, [*found.images, *_others(known, found.images)])
        if known is None or known.board != board or _told(known) != _told(kept):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_corners(kept, path)
    return found


def _told(corners: Corners) -> list[tuple[object, ...]]:
    """What a file says of images, but for the corners."""
    return [(i.path.resolve(), i.camera, i.view, i.hash, i.reason, i.image_size) for i in corners.images]


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
    found: dict[int, ImageCorners] = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        waiting: dict[Future[ImageCorners], int] = {}
        show = progress("finding boards")
        try:
            for number, (*_, path) in enumerate(places):
                waiting[pool.submit(_searched_one, path, board, there)] = number
            left = set(waiting)
            while left:
                done, left = wait(left, return_when=FIRST_COMPLETED)
                for future in done:
                    camera, view, _ = places[waiting[future]]
                    found[waiting[future]] = replace(future.result(), camera=camera, view=view)
                show(len(found) / len(places))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [found[number] for number in range(len(places))]


def _searched_one(path: Path, board: Board, known: Mapping[str | Path, ImageCorners]) -> ImageCorners:
    """By the file's content; by its path where corners come from elsewhere, or the image is gone."""
    nothing, at_path = np.full((len(board.points()), 2), np.nan), known.get(path.resolve())
    if at_path is not None and not at_path.hash:
        return replace(at_path, path=path)
    try:
        digest = hash_of(path)
        if digest in known:
            return replace(known[digest], path=path)
        grey = read_grey(path)
    except (images.ImageFileError, OSError) as error:
        if isinstance(error, FileNotFoundError) and at_path is not None:
            return replace(at_path, path=path)
        reason = getattr(error, "strerror", None) or str(error).removeprefix(f"{path}: ")
        return ImageCorners(path, None, nothing, reason)
    found = detect(board, grey)
    return ImageCorners(path, grey.shape, found.pixels, found.reason, digest)


def read_grey(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """(H, W) of an image file, as stored.

    Raises:
        ImageFileError: see `images.read`.
    """
    pixels = images.read(path)[0].numpy()
    if len(pixels) < 3:
        return np.ascontiguousarray(pixels[0])
    red, green, blue = pixels[:3].astype(np.float32)
    grey: np.ndarray = np.rint(0.299 * red + 0.587 * green + 0.114 * blue).astype(np.uint8)
    return grey


def usable_views(corners: Corners) -> tuple[dict[str, dict[str, ImageCorners]], dict[str, tuple[int, int]]]:
    """The views that a calibration can use; notes say which images it cannot, and why.

    Returns:
        View -> camera -> image; and camera -> (height, width).

    Raises:
        ValueError: too few.
    """
    cameras = list(dict.fromkeys(image.camera for image in corners.images))
    sizes = {name: Counter(i.image_size for i in corners.images if i.camera == name and i.seen) for name in cameras}
    size_of = {name: count.most_common(1)[0][0] for name, count in sizes.items() if count}
    views: dict[str, dict[str, ImageCorners]] = {}
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
    greys = {image.path: read_grey(image.path) for image in unseen[:_TRIED_ANEW]}
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
