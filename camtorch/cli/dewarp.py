"""The command `camtorch dewarp`: photographs and videos without their lens's distortion."""

from __future__ import annotations

import argparse
import glob
import os
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from camtorch.cli.options import (
    add_force,
    add_jobs,
    add_photograph,
    add_projection,
    parse_path,
    parse_suffix,
)
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
    words: list[str] = arguments.image
    several = len(words) > 1 or os.path.isdir(words[0]) or glob.has_magic(words[0])
    if several and arguments.jobs != 1 and not arguments.dry_run:
        pool.prepare("camtorch.cli.dewarping")


def run(arguments: argparse.Namespace) -> int:
    """Carry it out."""
    from camtorch.cli import videos

    words: list[str] = arguments.image
    output: str | None = arguments.output
    into_folder = output is not None and output.endswith(_SLASHES)
    is_pattern = glob.has_magic(words[0]) and not os.path.lexists(words[0])
    if len(words) > 1 or os.path.isdir(words[0]) or is_pattern or into_folder:
        return _many(arguments)
    for name in ("resume", "shard", "suffix"):
        if getattr(arguments, name):
            raise ValueError(f"--{name} is for folders: -o OUT/, with a slash, puts the new one into one")
    source = Path(words[0])
    if videos.is_video(source):
        _video(arguments, source)
    else:
        _image(arguments, source)
    return 0


# -- one file


def _image(arguments: argparse.Namespace, source: Path) -> None:
    import torch

    from camtorch.cli import cameras, images
    from camtorch.cli.dewarping import TOLERANCE
    from camtorch.cli.warping import warped
    from camtorch.warp.dewarp import Dewarp

    output = Path(arguments.output or _DEFAULT)
    images.check_target(output, force=arguments.force, inputs=(source, arguments.camera))
    image, orientation = images.read(source)
    rows, columns = image.shape[-2:]
    camera, _ = cameras.read_posed(source, (rows, columns), arguments)
    if arguments.dry_run:
        print(f"{source} -> {output}")
        return
    with torch.no_grad():
        warp = Dewarp(
            camera,
            projection=arguments.projection,
            fov=arguments.fov,
            image_size=arguments.size,
            tolerance=TOLERANCE,
        )
        result, filled = warped(warp, image, "dewarping")
        del image
        lattice = (camera.resize(64, 64).pixel_grid() + 0.5) * torch.tensor([columns / 64, rows / 64]) - 0.5
        shown = float(warp.transform_points(lattice)[1].double().mean())
    made = images.from_tensor(result)
    images.write(output, made, orientation=orientation, tell=lambda text: note(f"{source} {text}"))
    height, width = result.shape[-2:]
    fx, fy, cx, cy = warp.target.intrinsics.tolist()
    degrees = float(warp.target.fov[0])
    print(
        f"{output}: {camera.key} dewarped to {arguments.projection}, {degrees:.1f} degrees "
        f"wide, {width}x{height}, fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} cy {cy:.6g}; {100 * filled:.1f} % of it is "
        f"filled and shows {100 * shown:.0f} % of the photograph"
    )


def _video(arguments: argparse.Namespace, source: Path) -> None:
    from camtorch.cli import targets, videos
    from camtorch.jobs.items import Item, Listener

    output = Path(arguments.output or Path(_DEFAULT).with_suffix(source.suffix))
    targets.check(output, force=arguments.force, inputs=(source, arguments.camera))
    videos.check_kind(output)
    work = _dewarping(arguments, [source])
    item = videos.sized(Item((source,), (output,)))
    if arguments.dry_run:
        print(f"{source} -> {output}")
        return
    with bar("dewarping", int(item.size), "frames") as shown:
        told = work(item, Listener(note, lambda done: shown.update(int(done) - shown.n)))
    print(f"{output}: dewarped, {_told(arguments, told)}, {told['frames']} frames")


# -- many files


def _many(arguments: argparse.Namespace) -> int:
    from camtorch.cli import images, many, videos
    from camtorch.jobs import inputs, items
    from camtorch.jobs.manifest import Manifest

    known = inputs.IMAGES | set(videos.FORMATS)
    _check_no_calibration(arguments, known)
    output, shard = many.output_folder(arguments.output), many.shard_of(arguments)
    if not output.exists() and not arguments.output.endswith(_SLASHES) and output.suffix.lower() in known:
        raise ValueError(f"{output}: is the name of one file, but there may be several; -o OUT/ names a folder")
    found, faults = inputs.find(arguments.image, known, output)
    everything = [_item(one, output, arguments.suffix) for one in found]
    for item in everything:
        (videos if videos.is_video(item.inputs[0]) else images).check_kind(item.outputs[0])
    items.check(everything, [arguments.camera] if arguments.camera else [])
    work = _dewarping(arguments, [one.path for one in found])
    mine = [videos.sized(item) for item in shard.of(everything)]

    def told(report: Report) -> str:
        facts = many.same([{**result, "frames": None} for result in report.results.values()])
        return f", {_told(arguments, facts)}" if facts else ""

    return many.carry_out(
        mine,
        faults if shard.rank == 0 else [],
        work,
        Manifest(output, "dewarp", work.settings(), shard),
        arguments,
        doing="dewarping",
        units="frames" if any(item.size != 1 for item in mine) else "images",
        told=told,
    )[0]


def _check_no_calibration(arguments: argparse.Namespace, known: Collection[str]) -> None:
    """Who names a calibration without an option means it for --camera.

    Raises:
        ValueError: a file among the inputs is one.
    """
    from camtorch.io import CameraFileError, load

    for word in arguments.image:
        if not os.path.isfile(word) or Path(word).suffix.lower() in known:
            continue
        try:
            load(word)
        except (CameraFileError, OSError):
            continue
        raise ValueError(f"{word}: a calibration, not an image; --camera {word} names it")


def _item(found: Any, output: Path, suffix: str | None) -> Item:
    from camtorch.cli import videos
    from camtorch.jobs.items import Item

    place = found.place
    if suffix is not None and videos.is_video(place) == videos.is_video(Path("any" + suffix)):
        place = place.with_suffix(suffix)
    return Item((found.path,), (output / place,))


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


def _told(arguments: argparse.Namespace, told: dict[str, Any]) -> str:
    fx, fy, cx, cy = told["intrinsics"]
    return (
        f"{told['model']} to {arguments.projection}, {told['degrees']:.1f} degrees wide, "
        f"{told['width']}x{told['height']}, fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} cy {cy:.6g}; "
        f"{100 * told['filled']:.1f} % of it is filled"
    )
