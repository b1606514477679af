"""The command `camtorch calibrate`: from photographs of a board to the file of a camera, or of a rig."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camtorch.boards.boards import Board, board_of
from camtorch.boards.corners import image_points
from camtorch.boards.finding import gather
from camtorch.calibration import selection
from camtorch.calibration.calibrate import Calibration, calibrate
from camtorch.calibration.rig import RigCalibration, calibrate_rig
from camtorch.camera import MODELS, as_model
from camtorch.cli import searching, targets
from camtorch.cli.searching import Found, Views
from camtorch.cli.terminal import note, progress
from camtorch.io import CameraFileError, formats
from camtorch.report.report import require_packages, write_report

_WORST = 3  # views that are named
_OUTLYING = 2.0  # times the rms of all views, from where a view is named as bad


def run(arguments: argparse.Namespace) -> None:
    """Carry it out."""
    cameras = _cameras(arguments)
    given = tuple(path for paths in cameras.values() for path in paths)
    files = [path for path in (arguments.output, arguments.report, arguments.corners) if path is not None]
    if len({path.absolute() for path in files}) < len(files):
        raise ValueError("-o, --report and --corners must be different files")
    for path in files:
        if path != arguments.corners or not path.exists():
            targets.check(path, force=arguments.force, inputs=given)
    if arguments.report is not None:
        require_packages()
    if {"fx", "fy"} & set((arguments.fixed or "").split(",")):
        raise ValueError("--fixed: no focal length is known to be held; in Python ct.calibrate(start=camera) has one")
    candidates = _candidates(arguments)
    kept: Path | None = arguments.corners
    board = _read_board(arguments, 1.0) if arguments.board is not None else None
    known = None
    if kept is not None and kept.exists():
        known = searching.known_corners(kept, board, measured=arguments.square is not None)
        board = known.board or board
    names = set(cameras) or {image.camera for image in (known.images if known else ())}
    if board is not None and board.is_symmetric and len(names) > 1:
        note(
            "this board looks the same after a turn: the corner nearest to the top left of an image is taken for its "
            "first one, so hold the cameras alike. An even and an odd number of corners, as 9x6, leave no doubt"
        )
    if cameras:
        found = searching.found_corners(cameras, board or _read_board(arguments, 1.0), known)
        if kept is not None:
            searching.write_found(found.corners, known, kept)
    else:
        assert known is not None
        found = Found(known, {})
    board = found.corners.board
    unit = "" if board is None or board.square == 1 else "m"
    if board is not None and not unit and arguments.square is None:
        note("no --square is given: distances are in sides of a square")
    views, size_of = searching.usable_views(found.corners)
    words = "its points" if board is None else board.words(unit)
    for name, (height, width) in size_of.items():
        seen = [of_view[name] for of_view in views.values() if name in of_view]
        total, count = sum(image.camera == name for image in found.corners.images), sum(image.seen for image in seen)
        print(f"{_head(name)}{words}: in {len(seen)} of {total} images of {width}x{height}, {count} corners")
    result = _calibrated(arguments, found.corners.points, views, size_of, candidates)
    if isinstance(result, RigCalibration):
        _tell_mounts(result, unit)
    if arguments.bend:
        across, down = (f"{1000 * bend:.3g} mm" if unit == "m" else f"{bend:.3g}" for bend in result.bend)
        print(f"board: its middle lies {across} off its left and right, {down} off its top and bottom")
    _write(arguments, result, views, found)


def _read_board(arguments: argparse.Namespace, square: float) -> Board:
    """The board that the options of `_board_options` say, with squares of `square` if they do not say that.

    Raises:
        ValueError: no --board, options of another type of board, numbers that no board has.
    """
    if arguments.board is None:
        raise ValueError("which board? --board COLUMNSxROWS says so, as in 9x6")
    own = ("marker", "legacy", "spacing", "border", "dictionary")
    options = {name: value for name in own if (value := getattr(arguments, name)) not in (None, False)}
    options |= {"type": arguments.type or "chessboard", "square": arguments.square or square}
    options["columns"], options["rows"] = arguments.board
    if arguments.type == "charuco":
        options.setdefault("marker", 0.75 * options["square"])
    return board_of(options)


def _head(name: str) -> str:
    """How lines about a camera begin; nothing where there is one only."""
    return f"{name}: " if name else ""


def _cameras(arguments: argparse.Namespace) -> dict[str, list[Path]]:
    """The images by the names of cameras, "" for a single one; nothing where a file of corners shall say."""
    pair = {name: words for name in ("left", "right") if (words := getattr(arguments, name))}
    ways = [bool(arguments.images), bool(pair), bool(arguments.rig)]
    if sum(ways) > 1:
        raise ValueError("images of one camera, --left and --right, or --rig: one of these says what to calibrate")
    if len(pair) == 1:
        raise ValueError(f"--{next(iter(pair))} is one of a pair: --left and --right are both needed")
    if arguments.rig:
        named: dict[str, list[str]] = {}
        for word in arguments.rig:
            name, equals, images = word.partition("=")
            if not (name and equals and images):
                raise ValueError(f"--rig takes NAME=IMAGE, as in cam0=folder or cam1='right*.png'; got {word!r}")
            named.setdefault(name, []).append(images)
        if len(named) < 2:
            raise ValueError("--rig takes several cameras; one is calibrated without it")
        return {name: gather(words) for name, words in named.items()}
    if pair:
        return {name: gather(words) for name, words in pair.items()}
    if arguments.images:
        return {"": gather(arguments.images)}
    if arguments.corners is None or not arguments.corners.exists():
        raise ValueError("which images? Files, quoted patterns or folders; or --corners, a file that holds corners")
    return {}


def _candidates(arguments: argparse.Namespace) -> list[tuple[str, int]]:
    """The models to try, with numbers of coefficients, that the file to be written can hold, seen before the work.

    Raises:
        ValueError: the name does not say the format; it holds no camera of the model.
    """
    path, model, count = arguments.output, arguments.model, arguments.count
    if arguments.format is None and path.suffix.lower() in (".yml", ".yaml"):  # which is written by several
        arguments.format = "opencv"
    if model is None and count is not None:
        raise ValueError("--count is for a --model")
    tried: Sequence[tuple[str, int]] = selection.CANDIDATES
    if model is not None:
        kind = as_model(model, "--model")
        tried = [(model, kind.default_count if count is None else count)]
        if kind.names_of(tried[0][1]) is None:
            raise ValueError(f"--count: {model} takes {kind.counts_text()}; got {count}")
        if kind.smoothness() is not None:
            raise ValueError(
                f"--model: {model} learns a surface over a lens that is known. In Python: fitted = ct.calibrate(...) "
                f"of another model, then ct.calibrate({model!r}, ..., start=fitted.camera)"
            )
    held = []
    for key, number in tried:
        kind = MODELS[key]
        camera = kind([500.0, 500.0, 320.0, 240.0], *([kind.ideal(number)] if number else []), image_size=(480, 640))
        try:
            formats.rendered(camera, path, arguments.format)
            held.append((key, number))
        except CameraFileError as error:
            failure = error
    if not held:
        raise ValueError(f"{failure}; -o camera.json holds every model")
    return held


def _calibrated(
    arguments: argparse.Namespace,
    points: NDArray[Any],
    views: Views,
    size_of: Mapping[str, tuple[int, int]],
    candidates: list[tuple[str, int]],
) -> Calibration | RigCalibration:
    """The camera, or the rig where there are several; its numbers are printed."""
    fixed = tuple(filter(None, (arguments.fixed or "").split(",")))
    options = {"fixed": fixed, "loss": arguments.loss, "loss_scale": arguments.loss_scale}
    pixels = {name: image_points([of_view.get(name) for of_view in views.values()], len(points)) for name in size_of}
    models, counts = {}, {}
    for name, size in size_of.items():
        models[name], counts[name] = candidates[0]
        if len(candidates) > 1:
            seen = pixels[name][[name in of_view for of_view in views.values()]]
            with progress("trying models") as show:
                chosen = selection.select(
                    points, seen, image_size=size, candidates=candidates, progress=show, **options
                )
            models[name], counts[name] = chosen.best.model, chosen.best.count
            print(f"{_head(name)}models by cross-validation, px per point:", *chosen.lines(), sep="\n")
            left_out = [
                f"{key} with {n}" if n else key for key, n in selection.CANDIDATES if (key, n) not in candidates
            ]
            if left_out:
                note(f"{arguments.output.name} cannot hold {', '.join(left_out)}, which were not tried; a .json can")
    found: Calibration | RigCalibration
    if list(size_of) == [""]:
        size, count = size_of[""], counts[""]
        found = calibrate(models[""], points, pixels[""], image_size=size, count=count, bend=arguments.bend, **options)
    else:
        found = calibrate_rig(models, points, pixels, image_sizes=size_of, count=counts, bend=arguments.bend, **options)
    if not found.converged:
        raise ValueError(
            f"no optimum was found (rms {found.rms:.4g} px), so nothing is written: are --board and the images right? "
            "Another --model, or --loss huber where some corners are wrong, may help"
        )
    for name, camera in _each(found).items():
        _tell(camera, [of_view[name].path.name if name in of_view else "" for of_view in views.values()], _head(name))
    return found


def _each(found: Calibration | RigCalibration) -> Mapping[str, Calibration]:
    return found.cameras if isinstance(found, RigCalibration) else {"": found}


def _tell(found: Calibration, names: Sequence[str], head: str) -> None:
    """The numbers of a camera, the views that fit badly, and what is to be said of it."""
    corners = int(found.observations.seen.sum())
    print(
        f"{head}{found.camera.key}: rms {found.rms:.4g} px per point, sigma {found.sigma:.4g} px per coordinate, "
        f"{len(found.views)} views, {corners} corners"
    )
    values = [*found.camera.intrinsics.tolist(), *found.camera.distortion.tolist()]
    for name, value, std in zip(found.parameter_names, values, found.std.tolist(), strict=True):
        print(f"  {name:<6} {_with_spread(value, std) if std else f'{value:11.6g}  held'}")
    squares = np.square(np.stack([np.asarray(one) for one in found.residuals])).sum(-1)
    shown = np.isfinite(squares).any(1)
    errors = {
        name: float(np.sqrt(np.nanmean(row))) for name, row, one in zip(names, squares, shown, strict=True) if one
    }
    worst = sorted(errors, key=lambda name: -errors[name])[:_WORST]
    bad = [f"{name} {errors[name]:.3g} px" for name in worst if errors[name] > _OUTLYING * found.rms]
    if bad:
        print(f"{head}views that fit badly: {', '.join(bad)}")
    for warning in found.warnings:
        note(f"{head}{_with_options(_named(warning, names))}")
    print(f"{head}{_named(found.verdict, names)}")


def _named(text: str, names: Sequence[str]) -> str:
    """A text in which the views that it numbers have their names."""
    numbered = r"\b([Vv]iews? )(\d+(?:, \d+)*)"
    return re.sub(numbered, lambda m: m[1] + re.sub(r"\d+", lambda n: names[int(n[0])], m[2]), text)


def _with_options(text: str) -> str:
    """A text in which arguments of `ct.calibrate` are the options of the command."""
    text = re.sub(r'fixed=\("(.*?)",?\)', lambda m: f"--fixed {m[1].replace(chr(34), '').replace(' ', '')}", text)
    return re.sub(r"count=(\d+)", r"--count \1", text.replace("bend=True", "--bend"))


def _with_spread(value: float, std: float, width: int = 11) -> str:
    """A number to the second digit of its standard deviation."""
    if not (math.isfinite(value) and math.isfinite(std)):
        return f"{value:{width}.6g} +- {std:.2g}"
    digits = min(max(1 - math.floor(math.log10(std)), 0), 12) if std else 6
    return f"{value:{width}.{digits}f} +- {std:.{digits}f}"


def _tell_mounts(found: RigCalibration, unit: str) -> None:
    first, *others = found.cameras
    scale, words = (1000, " mm") if unit == "m" else (1, "")
    for name in others:
        pose, spread = found.rig.extrinsics[name], found.mount_std[name].tolist()
        shift, turn = (float(t.detach().norm()) for t in (pose.translation, pose.rotation))
        print(
            f"{name}: {_with_spread(scale * shift, scale * math.hypot(*spread[3:]), 0)}{words} from {first}, turned by "
            f"{_with_spread(math.degrees(turn), math.degrees(math.hypot(*spread[:3])), 0)} degrees"
        )
    print(f"rig: rms {found.rms:.4g} px per point, sigma {found.sigma:.4g} px per coordinate, {len(found.views)} views")


def _write(arguments: argparse.Namespace, result: Calibration | RigCalibration, views: Views, found: Found) -> None:
    path, report = arguments.output, arguments.report
    is_rig = isinstance(result, RigCalibration)
    path.parent.mkdir(parents=True, exist_ok=True)
    formats.save(result.rig if isinstance(result, RigCalibration) else result.camera, path, arguments.format)
    print(f"{path}: {f'{len(result.rig)} cameras' if isinstance(result, RigCalibration) else result.camera.key}")
    if report is None:
        return
    report.parent.mkdir(parents=True, exist_ok=True)
    images: dict[str, Any] = {}
    names: dict[str, Any] = {}
    for name in _each(result):
        seen = [(view, of_view.get(name)) for view, of_view in views.items()]
        paths = [None if image is None else image.path for _, image in seen]
        images[name] = [found.frames.get(p, p if p.exists() else None) if p else None for p in paths]
        names[name] = [view if image is None else image.path.name for view, image in seen]
    write_report(result, report, images=images if is_rig else images[""], names=names if is_rig else names[""])
    print(f"{report}: the report")
