"""The command `camtorch calibrate`: from photographs or a video of a board to the file of a camera, or of a rig."""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from camtorch.boards.boards import as_board
from camtorch.boards.finding import gather
from camtorch.calibration import selection
from camtorch.calibration.calibrate import calibrate
from camtorch.calibration.rig import RigCalibration, calibrate_rig
from camtorch.calibration.verdict import Calibration
from camtorch.cameras.camera import MODELS, Camera, as_model
from camtorch.cameras.rig import Rig
from camtorch.cli import targets
from camtorch.cli.searching import find_views
from camtorch.cli.terminal import bar, note
from camtorch.io import CameraFileError, formats

_BOARD_OPTIONS = ("marker", "legacy", "spacing", "border", "dictionary")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    cameras = _cameras(arguments)
    path = arguments.output
    targets.check(path, force=arguments.force, inputs=tuple(one for paths in cameras.values() for one in paths))
    fixed = tuple(filter(None, (arguments.fixed or "").split(",")))
    if {"fx", "fy"} & set(fixed):
        raise ValueError("--fixed: must not name a focal length; got one. In Python write ct.calibrate(start=camera)")
    candidates = _candidates(arguments)
    if arguments.board is None:
        raise ValueError("--board must be given. Write --board COLUMNSxROWS, as in 9x6")
    given = {name: value for name in _BOARD_OPTIONS if (value := getattr(arguments, name)) not in (None, False)}
    words = "{} {}x{}".format(arguments.type or "chessboard", *arguments.board)
    board = as_board(words, arguments.square or 1.0, given, "--board")
    if board.is_symmetric and len(cameras) > 1:
        note("this board looks the same after a turn: hold the cameras alike, or use even and odd corners, as in 9x6")
    views, sizes = find_views(cameras, board, "" if arguments.square is None else "m")
    if arguments.square is None:
        note("no --square is given: distances are in sides of a square")
    options: dict[str, Any] = {"fixed": fixed, "loss": arguments.loss, "loss_scale": arguments.loss_scale}
    points = board.points()
    unseen = np.full((len(points), 2), np.nan)
    pixels, models, counts = {}, {}, {}
    for name, size in sizes.items():
        pixels[name] = np.stack([of_view[name].pixels if name in of_view else unseen for of_view in views.values()])
        models[name], counts[name] = candidates[0]
        if len(candidates) > 1:
            seen = pixels[name][[name in of_view for of_view in views.values()]]
            with bar("trying models", 1.0, bar_format="{desc}: {percentage:3.0f} %|{bar}| {remaining} left") as shown:
                own: dict[str, Any] = {"progress": lambda part, shown=shown: shown.update(part - shown.n)}
                chosen = selection.select(points, seen, image_size=size, candidates=candidates, **own, **options)
            models[name], counts[name] = chosen.best.model, chosen.best.count
            head = f"{name}: " if name else ""
            print(f"{head}models by cross-validation, px per point:", *chosen.lines(), sep="\n")
    left_out = [f"{key} with {n}" if n else key for key, n in selection.CANDIDATES if (key, n) not in candidates]
    if len(candidates) > 1 and left_out:
        note(f"{path.name} cannot hold {', '.join(left_out)}, which were not tried; a .json can")
    options["bend"] = arguments.bend
    result: Calibration | RigCalibration
    made: Camera | Rig
    if list(sizes) == [""]:
        result = calibrate(models[""], points, pixels[""], image_size=sizes[""], count=counts[""], **options)
        made, what, names = result.camera, result.camera.key, [of_view[""].path.name for of_view in views.values()]
    else:
        result = calibrate_rig(models, points, pixels, image_sizes=sizes, count=counts, **options)
        made, what, names = result.rig, f"{len(sizes)} cameras", list(views)
    if not result.converged:
        hint = "nothing is written. Check --board and the images, or try another --model, or --loss huber"
        raise ValueError(f"the calibration must converge; got rms {result.rms:.4g} px, {hint}")
    print(_told(result, names))
    if arguments.bend:
        across, down = (f"{bend:.3g}" for bend in result.bend)
        print(f"board: its middle lies {across} off its left and right, {down} off its top and bottom")
    path.parent.mkdir(parents=True, exist_ok=True)
    formats.save(made, path, arguments.format)
    print(f"{path}: {what}")


def _told(result: Calibration | RigCalibration, names: list[str]) -> str:
    """Return a result in words, with names of views instead of numbers, and options instead of arguments."""

    def named(numbers: re.Match[str]) -> str:
        return numbers[1] + re.sub(r"\d+", lambda number: names[int(number[0])], numbers[2])

    def option(fixed: re.Match[str]) -> str:
        return "--fixed " + re.sub('[ "]', "", fixed[1])

    text = re.sub(r"\b([Vv]iews? )(\d+(?:, \d+)*)", named, repr(result))
    text = re.sub(r'fixed=\("(.*?)",?\)', option, text)
    return re.sub(r"count=(\d+)", r"--count \1", text.replace("bend=True", "--bend"))


def _cameras(arguments: argparse.Namespace) -> dict[str, list[Path]]:
    """Return the images by the names of cameras, "" for a single one."""
    pair = {name: words for name in ("left", "right") if (words := getattr(arguments, name))}
    if sum(map(bool, (arguments.images, pair, arguments.rig))) > 1:
        raise ValueError("one of IMAGE, --left with --right, and --rig must be given; got several")
    for word in arguments.rig or ():
        name, _, images = word.partition("=")
        if not (name and images):
            raise ValueError(f"--rig must be NAME=IMAGE, as in cam0=folder or cam1='right*.png'; got {word!r}")
        pair.setdefault(name, []).append(images)
    if len(pair) == 1:
        raise ValueError("--left with --right, or --rig, must have several cameras; got one")
    if not (pair or arguments.images):
        raise ValueError("images must be given. Name files, quoted patterns, folders or a video")
    return {name: gather(words) for name, words in (pair or {"": arguments.images}).items()}


def _candidates(arguments: argparse.Namespace) -> list[tuple[str, int]]:
    """Return the models to try that the output file can hold, with numbers of coefficients; raise if none."""
    path, model, count = arguments.output, arguments.model, arguments.count
    if arguments.format is None and path.suffix.lower() in (".yml", ".yaml"):  # several formats have this suffix
        arguments.format = "opencv"
    if model is None and count is not None:
        raise ValueError("--model must be given with --count; got none")
    tried: Sequence[tuple[str, int]] = selection.CANDIDATES
    if model is not None:
        kind = as_model(model, "--model")
        tried = [(model, kind.default_count if count is None else count)]
        if kind.names_of(tried[0][1]) is None:
            raise ValueError(f"--count must be {kind.counts_text()} for {model}; got {count}")
        if kind.smoothness() is not None:
            way = f"In Python write ct.calibrate({model!r}, ..., start=camera)"
            raise ValueError(f"--model must need no known lens; got {model}. {way}")
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
        raise ValueError(f"{failure}. Write -o camera.json, which holds every model")
    return held
