"""Views of a board for `camtorch calibrate`: images taken together, and sharp frames of a video."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import Board, opencv
from camtorch.boards.finding import Image, ImageCorners, natural, search, usable
from camtorch.cli import videos
from camtorch.cli.terminal import bar, note

_LEAST_VIEWS = 3
_MOMENT = 0.5  # seconds; the sharpest frame of each moment is used
_MOMENTS = 80  # twice as many are merged in pairs
_SHARP = 0.6  # of the neighbouring moments' sharpness; below it a moment is motion blur
_APART = 0.01  # of the image's diagonal: views with a smaller mean distance of corners are the same

Views = dict[str, dict[str, ImageCorners]]  # view -> camera -> corners in its image


def find_views(
    cameras: Mapping[str, Sequence[Path]], board: Board, unit: str
) -> tuple[Views, dict[str, tuple[int, int]]]:
    """Return the usable views of a board, and each camera's (height, width), "" for a single camera."""
    if len(cameras) == 1:
        ((name, paths),) = cameras.items()
        images = _search(board, [(path, None) for path in paths if not videos.is_video(path)])
        images += [image for path in paths if videos.is_video(path) for image in _search_video(path, board)]
        keys = [(name, str(i)) for i in range(len(images))]
    else:
        together = take_together(cameras)
        keys = [(name, view) for view, of_view in together.items() for name in of_view]
        taken = [path for of_view in together.values() for path in of_view.values()]
        if twice := [path for path, count in Counter(taken).items() if count > 1]:
            raise ValueError(f"{twice[0]}: must belong to one camera; got two")
        print(f"{len(together)} views of {', '.join(cameras)}")
        images = _search(board, [(path, None) for path in taken])
    views: Views = {view: {} for _, view in keys}
    sizes: dict[str, tuple[int, int]] = {}
    for name in cameras:
        seen = [(view, image) for (camera, view), image in zip(keys, images, strict=True) if camera == name]
        used, left_out = usable([image for _, image in seen])
        for path, why in left_out:
            note(f"{path} is left out: {why}")
        if len(used) < _LEAST_VIEWS:
            got = f"{len(used)} of {len(seen)}{f' of {name}' if name else ''}. Check that it is {board.words()}"
            raise ValueError(f"the board must be found in {_LEAST_VIEWS} images, better 20; got {got}")
        height, width = sizes[name] = used[0].image_size
        corners = sum(int(np.isfinite(image.pixels[:, 0]).sum()) for image in used)
        where = f"in {len(used)} of {len(seen)} images of {width}x{height}, {corners} corners"
        print(f"{f'{name}: ' if name else ''}{board.words(unit)}: {where}")
        good = {image.path for image in used}
        for view, image in seen:
            if image.path in good:
                views[view][name] = image
    return {view: of_view for view, of_view in views.items() if of_view}, sizes


def _search(board: Board, images: Sequence[Image]) -> list[ImageCorners]:
    with bar("finding boards", len(images), "images") as shown:
        return search(board, images, shown.update)


def take_together(cameras: Mapping[str, Sequence[Path]]) -> dict[str, dict[str, Path]]:
    """Return view -> camera -> image of images with the same name, else last number, else position."""
    if film := next((path for paths in cameras.values() for path in paths if videos.is_video(path)), None):
        raise ValueError(f"{film}: videos must be of one camera, as frames of two have no common time; got several")
    for key in (lambda path: path.stem, _last_number):
        keyed = {name: {key(path): path for path in paths} for name, paths in cameras.items()}
        if all(None not in of and len(of) == len(cameras[name]) for name, of in keyed.items()):
            seen = Counter(view for of in keyed.values() for view in of)
            shared = [view for view, count in seen.items() if count > 1]
            if shared and 2 * len(shared) >= min(map(len, keyed.values())):
                ordered = sorted(seen, key=lambda view: natural(Path(str(view))))
                return {str(view): {name: of[view] for name, of in keyed.items() if view in of} for view in ordered}
    if len({len(paths) for paths in cameras.values()}) > 1:
        counts = ", ".join(f"{len(paths)} of {name}" for name, paths in cameras.items())
        raise ValueError(f"images taken together must have the same name or last number, or be as many; got {counts}")
    rows = zip(*cameras.values(), strict=True)
    return {str(i): dict(zip(cameras, row, strict=True)) for i, row in enumerate(rows)}


def _last_number(path: Path) -> str | None:
    numbers = re.findall(r"\d+", path.stem)
    return numbers[-1].lstrip("0") or "0" if numbers else None


_Moment = tuple[float, float, NDArray[np.uint8]]  # time of a frame in seconds, its sharpness, pixels (H, W)


def _search_video(path: Path, board: Board) -> list[ImageCorners]:
    """Return sharp frames that show the board, by time; of two with it in the same place, only the sharper one."""
    moments = _sharpest(path)
    beside = [0.0, *(sharpness for _, sharpness, _ in moments), 0.0]
    sharp = [one for i, one in enumerate(moments) if one[1] >= _SHARP * max(beside[i], beside[i + 2])]
    names = [path.with_name(f"{path.name}#t={seconds:.3f}") for seconds, *_ in sharp]
    found = _search(board, [(name, grey) for name, (*_, grey) in zip(names, sharp, strict=True)])
    kept = list[tuple[float, ImageCorners]]()
    seen = [(one, image) for one, image in zip(sharp, found, strict=True) if not image.reason]
    for (seconds, _, grey), image in sorted(seen, key=lambda pair: -pair[0][1]):
        apart = [np.linalg.norm(image.pixels - other.pixels, axis=1) for _, other in kept]
        if all(np.isnan(d).all() or np.nanmean(d) > _APART * float(np.hypot(*grey.shape)) for d in apart):
            kept.append((seconds, image))
    print(f"{path}: of {len(sharp)} sharp frames {len(seen)} show the board, and {len(kept)} of these differ")
    nothing = ImageCorners(path, (0, 0), np.full((len(board.points()), 2), np.nan), "no board found in its frames")
    return [image for _, image in sorted(kept, key=lambda one: one[0])] or [nothing]


def _sharpest(path: Path) -> list[_Moment]:
    """Return the sharpest frame of each moment; moments are longer in long videos."""
    cv2: Any = opencv("finding boards in images")
    best, moment = dict[int, _Moment](), _MOMENT

    def keep(number: int, one: _Moment) -> None:
        best[number] = max(best.get(number, one), one, key=lambda of: of[1])

    with bar(f"reading {path.name}", None, "frames") as shown:
        for seconds, frame in videos.frames(path):
            shown.update()
            if seconds == 0 and frame.rotation:
                note(f"{path}: is shown turned by {frame.rotation} degrees; the camera is that of the stored frames")
            grey = frame.to_ndarray(format="gray")
            small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            keep(int(seconds / moment), (seconds, float(cv2.Laplacian(small, cv2.CV_32F).var()), grey))
            if len(best) >= 2 * _MOMENTS:
                moments, best, moment = best, {}, 2 * moment
                for old, other in moments.items():
                    keep(old // 2, other)
    return list(best.values())
