"""The command `camtorch dewarp`: remove the lens distortion of photographs and videos, one or many."""

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from camtorch.boards.finding import IMAGES
from camtorch.cameras.camera import Camera
from camtorch.cli import cameras, images, processes, targets, videos
from camtorch.cli.commands import are_several
from camtorch.cli.terminal import bar, note, say
from camtorch.io import photographs
from camtorch.warp.dewarp import Dewarp
from camtorch.warp.warp import Warp

_TOLERANCE = 0.001  # invisible; allows a lattice of positions for float64 calibrations too
_MUCH = 0.6  # part of a photograph; if less is visible, a hint names wider projections


@dataclass
class Dewarping:
    """Conversion of one file to another. The map is computed once for each size of image."""

    camera: Camera
    arguments: argparse.Namespace
    _warps: dict[tuple[int, int], tuple[Dewarp, str, float]] = field(default_factory=dict)

    def __call__(self, source: Path, target: Path, done: Callable[[], object] = lambda: None) -> tuple[str, str]:
        """Write the dewarped file; return words about its camera and about it. `done` is called after each frame."""
        if videos.is_video(source):
            codec, crf = self.arguments.codec, self.arguments.crf
            size, count = videos.remake(source, target, lambda size: self._warp(source, size)[0], codec, crf, done)
            return self._warp(source, size)[1], f", {count} frames"
        image, orientation, profile = photographs.read_stored(source)
        rows, columns = image.shape[-2:]
        warp, camera, shown = self._warp(source, (rows, columns))
        with torch.no_grad():
            result = warp(image[None])[0].permute(1, 2, 0).contiguous()
        del image  # frees hundreds of megabytes
        images.write(target, result.numpy(), orientation=orientation, profile=profile)
        about = f" and shows {100 * shown:.0f} % of the photograph"
        if shown < _MUCH and self.arguments.projection == "perspective" and self.arguments.fov is None:
            about += "; --projection stereographic or cylindrical shows more, and --fov sets how much"
        return camera, about

    def warp_of(self, camera: Camera) -> Dewarp:
        """Return the warp for images of a camera."""
        given = self.arguments
        return Dewarp(camera, projection=given.projection, fov=given.fov, image_size=given.size, tolerance=_TOLERANCE)

    def _warp(self, source: Path, size: tuple[int, int]) -> tuple[Dewarp, str, float]:
        """Return the warp for images of a size, words about the new camera, and which part of an image it shows."""
        if size not in self._warps:
            if len(self._warps) >= 4:  # sizes that alternate
                del self._warps[next(iter(self._warps))]
            camera = cameras.fitting(self.camera, self.arguments.camera, source, size, self.arguments.rescale)
            warp = self.warp_of(camera)
            new = warp.target
            with torch.no_grad():
                filled = Warp(camera, new.resize(64, 64), warp.rotation).valid_mask()
                part = torch.tensor([camera.width / 64, camera.height / 64])
                _, shown = warp.transform_points((camera.resize(64, 64).pixel_grid() + 0.5) * part - 0.5)
                degrees, (fx, fy, cx, cy) = float(new.fov[0]), new.intrinsics.tolist()
            words = (
                f"{camera.key} dewarped to {self.arguments.projection}, {degrees:.1f} degrees wide, "
                f"{new.width}x{new.height}, fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} cy {cy:.6g}; "
                f"{100 * filled.double().mean():.1f} % of it is filled"
            )
            self._warps[size] = warp, words, float(shown.double().mean())
        return self._warps[size]


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    if are_several(arguments.image) or (arguments.output or "").endswith(("/", os.sep)):
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
            found = work(source, output, shown.update)
    else:
        found = work(source, output)
    print(f"{output}: {''.join(found)}")
    return 0


def _many(arguments: argparse.Namespace) -> int:
    """Dewarp all files, and print the results; return the exit status, 1 if any failed."""
    known = IMAGES | videos.FORMATS
    output = targets.folder(arguments.output, known)
    found = targets.find(arguments.image, known, output)
    pairs = []
    for path, place in found:
        target, is_video, suffix = output / place, videos.is_video(path), arguments.suffix
        if suffix is not None and is_video == videos.is_video(Path("any" + suffix)):
            target = target.with_suffix(suffix)
        elif is_video:
            target = target.with_suffix(videos.written_suffix(path))
        images.check_kind(target, is_video=is_video)
        pairs.append((path, target))
    others = [arguments.camera] if arguments.camera else []
    todo = targets.to_make(pairs, others, resume=arguments.resume, force=arguments.force)
    work = _dewarping(arguments, [path for path, _ in found])
    notes, failed, made = dict[str, list[Path]](), dict[Path, str](), list[str]()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        with bar("dewarp", len(todo), "files") as shown:
            jobs = max(min(arguments.jobs or cores, len(todo)), 1)
            outcomes = processes.each(work, todo, jobs, shown.update)
    except ChildProcessError as error:
        raise ValueError(f"{error}. --resume continues the run, --jobs 1 needs the least memory") from None
    for (source, _), outcome in zip(todo, outcomes, strict=True):
        for text in outcome.notes:
            notes.setdefault(text.removeprefix(str(source)).lstrip(": "), []).append(source)
        if outcome.failure:
            failed[source] = outcome.failure.removeprefix(str(source)).lstrip(": ")
        else:
            made.append(outcome.found[0])
    for text, sources in notes.items():
        note(f"{sources[0]} {text}" if len(sources) == 1 else f"{sources[0]} and {len(sources) - 1} more: {text}")
    for source, text in failed.items():
        say(f"error: {source}: {text}")
    text = f"{len(made)} of {len(pairs)} files made" + (f", {made[0]}" if len(set(made)) == 1 else "")
    text += f"; {len(pairs) - len(todo)} were there already" if len(pairs) > len(todo) else ""
    print(f"{output}: {text}" + (f"; {len(failed)} failed" if failed else ""))
    return 1 if failed else 0


def _dewarping(arguments: argparse.Namespace, sources: Sequence[Path]) -> Dewarping:
    """Return the work for all files; the camera gets the size of the first image if its file has none."""
    sizes = (videos.size_of(one) if videos.is_video(one) else photographs.size_of(one) for one in sources)
    work = Dewarping(cameras.read_for_images(sources, sizes, arguments), arguments)
    if any(map(videos.is_video, sources)):
        videos.require()
    if work.camera.image_size is not None:
        work.warp_of(work.camera)  # raise errors of the options before all files
    return work
