"""The command `camtorch dewarp`: photographs and videos without their lens's distortion."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from camtorch import __version__
from camtorch.camera import Camera
from camtorch.cli import cameras, images, many, targets, videos
from camtorch.cli.commands import are_several
from camtorch.cli.terminal import bar
from camtorch.jobs import inputs, items
from camtorch.jobs.items import Item
from camtorch.jobs.run import Account, Report
from camtorch.warp.dewarp import Dewarp, Projection
from camtorch.warp.warp import Warp

_SLASHES = ("/", os.sep)
_CALIBRATIONS = (".yml", ".yaml", ".json", ".xml")
_TOLERANCE = 0.001  # pixels that nobody sees, for a lattice of positions also where a calibration is in float64
_MOST_KEPT = 4  # warps of images of different sizes
_MUCH = 0.6  # of a photograph: where a dewarped one shows less, it is said what shows more


@dataclass
class Dewarping:
    """Makes one item; a `camtorch.jobs.items.Work`. The map is computed once for each size of image."""

    camera: Camera
    """Of a known size."""
    path: Path
    """Of the file it is from."""
    rescale: bool
    projection: Projection
    fov: float | None
    """Degrees."""
    image_size: tuple[int, int] | None
    encoder: videos.Encoder
    _warps: dict[tuple[int, int], tuple[Dewarp, dict[str, Any]]] = field(default_factory=dict)

    def settings(self) -> dict[str, Any]:
        """All that outputs depend on; JSON."""
        names = ("rescale", "projection", "fov", "image_size")
        settings = {"camtorch": __version__, "camera": cameras.settings_of(self.camera), **vars(self.encoder)}
        return settings | {name: getattr(self, name) for name in names}

    def __call__(self, item: Item, **options: Any) -> dict[str, Any]:
        """What the new camera is; options are those of `videos.remake`."""
        (source,), (target,) = item.inputs, item.outputs
        if videos.is_video(source):
            return videos.remake(source, target, lambda size: self._warp(source, size), self.encoder, **options)
        image, orientation = images.read_stored(source)
        rows, columns = image.shape[-2:]
        warp, facts = self._warp(source, (rows, columns))
        with torch.no_grad():
            result = warp(image[None])[0]
        del image  # of hundreds of megabytes, perhaps
        images.write(target, images.from_tensor(result), orientation=orientation, synced=False)
        return facts

    def warp_of(self, camera: Camera) -> Dewarp:
        """That of images of a camera."""
        return Dewarp(
            camera, projection=self.projection, fov=self.fov, image_size=self.image_size, tolerance=_TOLERANCE
        )

    def _warp(self, source: Path, size: tuple[int, int]) -> tuple[Dewarp, dict[str, Any]]:
        if size not in self._warps:
            if len(self._warps) >= _MOST_KEPT:
                del self._warps[next(iter(self._warps))]
            warp = self.warp_of(cameras.fitting(self.camera, self.path, source, size, self.rescale))
            self._warps[size] = warp, _facts(warp)
        return self._warps[size]


@torch.no_grad()
def _facts(warp: Dewarp) -> dict[str, Any]:
    """What is to be known of new images: of 64 x 64 places in them how many show something, `filled`; and how many of
    as many in the old one they show, `shown`.
    """
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
    """Carry it out."""
    if are_several(arguments.image) or (arguments.output or "").endswith(_SLASHES):
        return _many(arguments)
    for name in ("resume", "shard", "suffix"):
        if getattr(arguments, name):
            raise ValueError(f"--{name} is for folders: -o OUT/, with a slash, puts the new one into one")
    _single(arguments, Path(arguments.image[0]))
    return 0


def _single(arguments: argparse.Namespace, source: Path) -> None:
    is_video = videos.is_video(source)
    output = Path(arguments.output or f"dewarped{videos.written_suffix(source) if is_video else '.png'}")
    targets.check(output, force=arguments.force, inputs=(source, arguments.camera))
    (videos if is_video else images).check_kind(output)
    if not source.exists():
        raise ValueError(f"{source}: no such file")
    work = _dewarping(arguments, [source])
    if arguments.dry_run:
        print(f"{source} -> {output}")
        return
    item = Item((source,), (output,))
    if is_video:
        with bar("dewarping", videos.count_of(source), "frames") as shown:
            facts = work(item, done=shown.update)
        end = f", {facts['frames']} frames"
    else:
        facts = work(item)
        end = f" and shows {100 * facts['shown']:.0f} % of the photograph"
        if facts["shown"] < _MUCH and arguments.projection == "perspective" and arguments.fov is None:
            end += "; --projection stereographic or cylindrical shows more, and --fov says how much"
    print(f"{output}: {_told(arguments, facts)}{end}")


def _many(arguments: argparse.Namespace) -> int:
    known = inputs.IMAGES | videos.FORMATS
    if any(Path(name).suffix.lower() in _CALIBRATIONS for name in arguments.image):
        raise ValueError(
            f"{' '.join(arguments.image)}: all of them are taken for images; --camera names the calibration, and -o "
            "the new image: camtorch dewarp photo.jpg --camera camera.yml -o straight.png"
        )
    output, shard = many.output_folder(arguments.output), many.shard_of(arguments)
    if not output.exists() and not arguments.output.endswith(_SLASHES) and output.suffix.lower() in known:
        raise ValueError(f"{output}: is the name of one file, but there may be several; -o OUT/ names a folder")
    found, suffix = inputs.find(arguments.image, known, output), arguments.suffix
    everything = list[Item]()
    for path, place in found:
        target, is_video = output / place, videos.is_video(path)
        if is_video:
            target = target.with_suffix(videos.written_suffix(path))
        if suffix is not None and is_video == videos.is_video(Path("any" + suffix)):
            target = target.with_suffix(suffix)
        (videos if is_video else images).check_kind(target)
        everything.append(Item((path,), (target,)))
    items.check(everything, [arguments.camera] if arguments.camera else [])
    work = _dewarping(arguments, [path for path, _ in found])

    def told(report: Report) -> str:
        facts = [{**result, "frames": 0} for result in report.results]
        return f", {_told(arguments, facts[0])}" if facts and all(one == facts[0] for one in facts) else ""

    return many.carry_out(
        shard.of(everything), work, Account(output, "dewarp", work.settings(), shard), arguments, told
    )


def _dewarping(arguments: argparse.Namespace, sources: list[Path]) -> Dewarping:
    """What is done to each; the camera is of the size of the first image where its file states none."""
    camera = cameras.read_for_many(
        sources, lambda one: (videos if videos.is_video(one) else images).size_of(one), arguments
    )
    if any(map(videos.is_video, sources)):
        videos.require()
    encoder = videos.Encoder(arguments.codec, arguments.crf)
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
