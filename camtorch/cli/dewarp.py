"""The command `camtorch dewarp`: photographs and videos without their lens's distortion."""

from __future__ import annotations

import argparse
import glob
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from camtorch.cli.options import add_force, add_jobs, add_photograph, add_projection, parse_path, parse_suffix
from camtorch.cli.terminal import bar, note
from camtorch.jobs import pool

if TYPE_CHECKING:
    from camtorch.cli.dewarping import Dewarping
    from camtorch.cli.options import Commands
    from camtorch.jobs.items import Item
    from camtorch.jobs.run import Report

_DEFAULT = "dewarped.png"
_SLASHES = ("/", os.sep)


def add(commands: Commands) -> None:
    """Add the command to a command line."""
    command = commands.add_parser(
        "dewarp",
        help="undistort images and videos",
        description="Undistort an image: camtorch dewarp photo.jpg --camera camera.yml -o straight.png; or all of a "
        "folder: camtorch dewarp images/ --camera camera.yml -o straight/",
        allow_abbrev=False,
    )
    command.set_defaults(run=run, prepare=prepare)
    command.add_argument(
        "image", type=_word, nargs="+", metavar="IMAGE", help="the image; or images, videos, folders, quoted patterns"
    )
    add_projection(command)
    add_photograph(command)
    command.add_argument(
        "-o",
        "--output",
        type=_word,
        metavar="OUT",
        help=f"the new image, {_DEFAULT} by default; OUT/, a folder, where there are several",
    )
    add_force(command)
    many = add_jobs(command)
    many.add_argument(
        "--suffix", type=parse_suffix, metavar=".EXT", help="of new images or videos; by default those of the old ones"
    )
    video = command.add_argument_group("videos (pip install 'camtorch[video]')")
    video.add_argument(
        "--codec", metavar="NAME", help="an encoder of ffmpeg's; libx264 by default, in .webm libvpx-vp9"
    )
    video.add_argument("--crf", type=int, metavar="N", help="the encoder's quality, lower is better; 18 in libx264")


def _word(text: str) -> str:
    """A path as it was written: a slash at its end says that it is a folder."""
    parse_path(text)
    return text


def prepare(arguments: argparse.Namespace) -> None:
    """Before torch is imported: let processes begin to do so as well."""
    if _are_several(arguments.image) and arguments.jobs != 1 and not arguments.dry_run:
        pool.prepare("camtorch.cli.dewarping")


def _are_several(words: list[str]) -> bool:
    is_pattern = glob.has_magic(words[0]) and not os.path.lexists(words[0])
    return len(words) > 1 or os.path.isdir(words[0]) or is_pattern


def run(arguments: argparse.Namespace) -> int:
    """Carry it out."""
    if _are_several(arguments.image) or (arguments.output or "").endswith(_SLASHES):
        return _many(arguments)
    for name in ("resume", "shard", "suffix"):
        if getattr(arguments, name):
            raise ValueError(f"--{name} is for folders: -o OUT/, with a slash, puts the new one into one")
    _single(arguments, Path(arguments.image[0]))
    return 0


def _single(arguments: argparse.Namespace, source: Path) -> None:
    from camtorch.cli import images, targets, videos
    from camtorch.jobs.items import Item, Listener

    is_video = videos.is_video(source)
    output = Path(arguments.output or Path(_DEFAULT).with_suffix(source.suffix if is_video else ".png"))
    targets.check(output, force=arguments.force, inputs=(source, arguments.camera))
    (videos if is_video else images).check_kind(output)
    if not (is_video or source.exists()):
        raise ValueError(f"{source}: no such file")
    work = _dewarping(arguments, [source])
    item = videos.sized(Item((source,), (output,)))
    if arguments.dry_run:
        print(f"{source} -> {output}")
        return

    def tell(text: str) -> None:
        note(text if text.startswith(str(source)) else f"{source} {text}")

    with bar("dewarping", item.size, "frames" if is_video else "images") as shown:
        facts = work(item, Listener(tell, lambda done: shown.update(done - shown.n)))
    end = f", {facts['frames']} frames" if is_video else f" and shows {100 * facts['shown']:.0f} % of the photograph"
    print(f"{output}: {_told(arguments, facts)}{end}")


def _many(arguments: argparse.Namespace) -> int:
    from camtorch.cli import images, many, videos
    from camtorch.jobs import inputs, items
    from camtorch.jobs.manifest import Manifest

    known = inputs.IMAGES | set(videos.FORMATS)
    for word in arguments.image:
        if os.path.isfile(word) and Path(word).suffix.lower() not in known:
            _check_no_calibration(word)
    output, shard = many.output_folder(arguments.output), arguments.shard or items.Shard.of_environment()
    if not output.exists() and not arguments.output.endswith(_SLASHES) and output.suffix.lower() in known:
        raise ValueError(f"{output}: is the name of one file, but there may be several; -o OUT/ names a folder")
    found, faults = inputs.find(arguments.image, known, output)
    everything = [_item(one.path, output / one.place, arguments.suffix) for one in found]
    for item in everything:
        (videos if videos.is_video(item.inputs[0]) else images).check_kind(item.outputs[0])
    items.check(everything, [arguments.camera] if arguments.camera else [])
    work = _dewarping(arguments, [one.path for one in found])

    def told(report: Report) -> str:
        facts = [{**result, "frames": 0} for result in report.results]
        return f", {_told(arguments, facts[0])}" if facts and all(one == facts[0] for one in facts) else ""

    return many.carry_out(
        everything,
        faults,
        work,
        Manifest(output, "dewarp", work.settings(), shard),
        arguments,
        doing="dewarping",
        units="frames" if any(item.size != 1 for item in everything) else "images",
        told=told,
    )


def _check_no_calibration(word: str) -> None:
    """Who names a calibration without an option means it for --camera.

    Raises:
        ValueError: the file is one.
    """
    from camtorch.io import CameraFileError, load

    try:
        load(word)
    except (CameraFileError, OSError):
        return
    raise ValueError(f"{word}: a calibration, not an image; --camera {word} names it")


def _item(source: Path, target: Path, suffix: str | None) -> Item:
    from camtorch.cli import videos
    from camtorch.jobs.items import Item

    if suffix is not None and videos.is_video(target) == videos.is_video(Path("any" + suffix)):
        target = target.with_suffix(suffix)
    return videos.sized(Item((source,), (target,)))


def _dewarping(arguments: argparse.Namespace, sources: list[Path]) -> Dewarping:
    """What is done to each; the camera is of the size of the first image where its file states none."""
    from camtorch.cli import cameras, images, videos
    from camtorch.cli.dewarping import Dewarping

    camera = cameras.read_for_many(
        sources, lambda one: (videos if videos.is_video(one) else images).size_of(one), arguments
    )
    encoder = videos.Encoder(arguments.codec, arguments.crf)
    if any(map(videos.is_video, sources)):
        encoder.check()
    work = Dewarping(
        camera, arguments.camera, arguments.rescale, arguments.projection, arguments.fov, arguments.size, encoder
    )
    if camera.image_size is not None:
        work.warp_of(camera)  # what is wrong with it is so for all
    return work


def _told(arguments: argparse.Namespace, facts: dict[str, Any]) -> str:
    fx, fy, cx, cy = facts["intrinsics"]
    return (
        f"{facts['model']} dewarped to {arguments.projection}, {facts['degrees']:.1f} degrees wide, "
        f"{facts['width']}x{facts['height']}, fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} cy {cy:.6g}; "
        f"{100 * facts['filled']:.1f} % of it is filled"
    )
