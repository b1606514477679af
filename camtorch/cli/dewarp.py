"""The command `camtorch dewarp`: remove the lens distortion of photographs and videos, one or many."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from camtorch.boards.finding import IMAGES
from camtorch.cameras.camera import Camera
from camtorch.cli import cameras, images, processes, targets, videos
from camtorch.cli.commands import are_several
from camtorch.cli.processes import Outcome, Pair
from camtorch.cli.terminal import bar, note, say
from camtorch.io import photographs as _photographs
from camtorch.warp.dewarp import Dewarp
from camtorch.warp.warp import Warp

_SLASHES = ("/", os.sep)
_TOLERANCE = 0.001  # invisible; allows a lattice of positions for float64 calibrations too
_MOST_KEPT = 4  # warps of images of different sizes
_MUCH = 0.6  # part of a photograph; if less is visible, a hint names wider projections


@dataclass
class Dewarping:
    """Conversion of one file to another. The map is computed once for each size of image."""

    camera: Camera
    arguments: argparse.Namespace
    _warps: dict[tuple[int, int], tuple[Dewarp, dict[str, Any]]] = field(default_factory=dict)

    def __call__(self, source: Path, target: Path, done: Callable[[], object] = lambda: None) -> dict[str, Any]:
        """Write the dewarped file and return facts about the new camera; `done` is called after each frame."""
        if videos.is_video(source):
            codec, crf = self.arguments.codec, self.arguments.crf
            return videos.remake(source, target, lambda size: self._warp(source, size), codec, crf, done)
        image, orientation, profile = _photographs.read_stored(source)
        rows, columns = image.shape[-2:]
        warp, facts = self._warp(source, (rows, columns))
        with torch.no_grad():
            result = warp(image[None])[0].permute(1, 2, 0).contiguous()
        del image  # frees hundreds of megabytes
        images.write(target, result.numpy(), orientation=orientation, profile=profile, synced=False)
        return facts

    def warp_of(self, camera: Camera) -> Dewarp:
        """Return the warp for images of a camera."""
        given = self.arguments
        return Dewarp(camera, projection=given.projection, fov=given.fov, image_size=given.size, tolerance=_TOLERANCE)

    def _warp(self, source: Path, size: tuple[int, int]) -> tuple[Dewarp, dict[str, Any]]:
        if size not in self._warps:
            if len(self._warps) >= _MOST_KEPT:
                del self._warps[next(iter(self._warps))]
            camera = cameras.fitting(self.camera, self.arguments.camera, source, size, self.arguments.rescale)
            warp = self.warp_of(camera)
            self._warps[size] = warp, _facts(warp)
        return self._warps[size]


@torch.no_grad()
def _facts(warp: Dewarp) -> dict[str, Any]:
    """Return facts about new images, as the filled part of the new image and the visible part of the old one."""
    source, target = warp.source, warp.target
    part = torch.tensor([source.width / 64, source.height / 64])
    lattice = (source.resize(64, 64).pixel_grid() + 0.5) * part - 0.5
    seen = Warp(source, target.resize(64, 64), warp.rotation).valid_mask()
    return {
        "model": source.key,
        "width": target.width,
        "height": target.height,
        "intrinsics": target.intrinsics.tolist(),
        "degrees": float(target.fov[0]),
        "filled": float(seen.double().mean()),
        "shown": float(warp.transform_points(lattice)[1].double().mean()),
    }


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    if are_several(arguments.image) or (arguments.output or "").endswith(_SLASHES):
        return _many(arguments)
    for name in ("resume", "suffix"):
        if getattr(arguments, name):
            raise ValueError(f"-o must be a folder for --{name}; got none. Write -o OUT/, with a slash")
    source = Path(arguments.image[0])
    is_video = videos.is_video(source)
    output = Path(arguments.output or f"dewarped{videos.written_suffix(source) if is_video else '.png'}")
    targets.check(output, force=arguments.force, inputs=(source, arguments.camera))
    images.check_kind(output, is_video=is_video)
    work = _dewarping(arguments, [source])
    if is_video:
        with bar("dewarping", videos.count_of(source), "frames") as shown:
            facts = work(source, output, shown.update)
        end = f", {facts['frames']} frames"
    else:
        facts = work(source, output)
        end = f" and shows {100 * facts['shown']:.0f} % of the photograph"
        if facts["shown"] < _MUCH and arguments.projection == "perspective" and arguments.fov is None:
            end += "; --projection stereographic or cylindrical shows more, and --fov sets how much"
    print(f"{output}: {_described(arguments, facts)}{end}")
    return 0


def _many(arguments: argparse.Namespace) -> int:
    """Dewarp all files, and print the results; return the exit status, 1 if any failed."""
    known = IMAGES | videos.FORMATS
    output = targets.folder(arguments.output, known)
    found = targets.find(arguments.image, known, output)
    pairs = [(path, _target(path, output / place, arguments.suffix)) for path, place in found]
    others = [arguments.camera] if arguments.camera else []
    todo = targets.to_make(pairs, others, resume=arguments.resume, force=arguments.force)
    work = _dewarping(arguments, [path for path, _ in found])
    notes, failed, facts = dict[str, list[Path]](), dict[Path, str](), list[dict[str, Any]]()
    for (source, _), outcome in zip(todo, _outcomes(work, todo, arguments.jobs), strict=True):
        for text in outcome.notes:
            notes.setdefault(text.removeprefix(str(source)).lstrip(": "), []).append(source)
        if outcome.failure:
            failed[source] = outcome.failure.removeprefix(str(source)).lstrip(": ")
        else:
            facts.append(outcome.facts | {"frames": 0})
    for text, sources in notes.items():
        note(f"{sources[0]} {text}" if len(sources) == 1 else f"{sources[0]} and {len(sources) - 1} more: {text}")
    for source, text in failed.items():
        say(f"error: {source}: {text}")
    alike = facts and all(one == facts[0] for one in facts)
    text = f"{len(facts)} of {len(pairs)} files made" + (f", {_described(arguments, facts[0])}" if alike else "")
    text += f"; {len(pairs) - len(todo)} were there already" if len(pairs) > len(todo) else ""
    print(f"{output}: {text}" + (f"; {len(failed)} failed" if failed else ""))
    return 1 if failed else 0


def _target(source: Path, target: Path, suffix: str | None) -> Path:
    """Return `target` with the suffix of the file that is made from `source`."""
    if is_video := videos.is_video(source):
        target = target.with_suffix(videos.written_suffix(source))
    if suffix is not None and is_video == videos.is_video(Path("any" + suffix)):
        target = target.with_suffix(suffix)
    images.check_kind(target, is_video=is_video)
    return target


def _outcomes(work: Dewarping, todo: Sequence[Pair], jobs: int | None) -> list[Outcome]:
    """Dewarp files by processes, and return the outcome of each."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        with bar("dewarp", len(todo), "files") as shown:
            return processes.each(work, todo, max(min(jobs or cores, len(todo)), 1), shown.update)
    except ChildProcessError as error:
        raise ValueError(f"{error}. --resume continues the run, --jobs 1 needs the least memory") from None


def _dewarping(arguments: argparse.Namespace, sources: Sequence[Path]) -> Dewarping:
    """Return the work for all files; the camera gets the size of the first image if its file has none."""

    def size_of(source: Path) -> tuple[int, int] | None:
        return videos.size_of(source) if videos.is_video(source) else _photographs.size_of(source)

    work = Dewarping(cameras.read_for_images(sources, size_of, arguments), arguments)
    if any(map(videos.is_video, sources)):
        videos.require()
    if work.camera.image_size is not None:
        work.warp_of(work.camera)  # raise errors of the options before all files
    return work


def _described(arguments: argparse.Namespace, facts: dict[str, Any]) -> str:
    fx, fy, cx, cy = facts["intrinsics"]
    return (
        f"{facts['model']} dewarped to {arguments.projection}, {facts['degrees']:.1f} degrees wide, "
        f"{facts['width']}x{facts['height']}, fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} cy {cy:.6g}; "
        f"{100 * facts['filled']:.1f} % of it is filled"
    )
