"""The command line, `camtorch dewarp` and the others. Degrees and WIDTHxHEIGHT here, and only here."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NoReturn

from camtorch import __version__
from camtorch.cli import convert
from camtorch.cli.options import parse_size

_STRIP_PIXELS = 1 << 21
_MOST_TILES = 100


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} (see {self.prog} --help)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv`, by default the process's own.

    Returns:
        The exit status: 0, or 2 after an error, which is one line on stderr.
    """
    try:
        arguments = _parser().parse_args(argv)
        with _interrupts_end_the_process():
            import torch  # noqa: F401 (not before: it takes a second, and --help does without)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            arguments.run(arguments)
        for warning in caught:
            _note(warning.message)
    except KeyboardInterrupt:
        _say("interrupted")
        return 130
    except Exception as error:
        if not (isinstance(error, (ValueError, ImportError, OSError)) or _lacks_memory(error)):
            raise
        _say("error: " + " ".join(_reason(error).split()))
        return 2
    return 0


def _say(text: str) -> None:
    print("camtorch:", text, file=sys.stderr, flush=True)


def _note(text: object) -> None:
    _say(f"note: {text}")


def _reason(error: Exception) -> str:
    if _lacks_memory(error):
        return f"out of memory: {error}" if str(error) else "out of memory"
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _lacks_memory(error: Exception) -> bool:
    """Whether it is that: neither torch nor the loader of shared libraries has a type for it."""
    words = {RuntimeError: "allocate memory", ImportError: "failed to map segment", OSError: "allocate memory"}
    return isinstance(error, MemoryError) or any(isinstance(error, t) and w in str(error) for t, w in words.items())


@contextlib.contextmanager
def _interrupts_end_the_process() -> Iterator[None]:
    """For the import of torch, which loses a KeyboardInterrupt, or aborts by it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: object) -> NoReturn:
        _say("interrupted")
        os._exit(130)

    before = signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="camtorch", description="Cameras as layers for PyTorch.", allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"camtorch {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    dewarp = commands.add_parser("dewarp", help="undistort an image", allow_abbrev=False)
    dewarp.set_defaults(run=_dewarp)
    dewarp.add_argument("image", type=Path, metavar="IMAGE", help="the image")
    dewarp.add_argument(
        "--projection", choices=("perspective", "cylindrical", "equirectangular"), default="perspective"
    )
    dewarp.add_argument(
        "--fov",
        type=float,
        metavar="DEGREES",
        help="horizontal field of view of the new image; by default that of the old one, up to 120 in perspective",
    )
    dewarp.add_argument(
        "--size", type=parse_size, metavar="WxH", help="size of the new image; by default the old one's"
    )

    augment = commands.add_parser(
        "augment",
        help="a contact sheet of an image with its labels as other cameras see them",
        description="A contact sheet of an image with its labels as other cameras see them. Without IMAGE the image "
        "is a rendered driver. A RANGE is LOW,HIGH, as in --yaw=-5,20, or a number: so far to either side of doing "
        "nothing, or just that --fov.",
        allow_abbrev=False,
    )
    augment.set_defaults(run=_augment)
    augment.add_argument("image", type=Path, nargs="?", metavar="IMAGE", help="the image")
    augment.add_argument(
        "--labels", type=Path, metavar="FILE", help="of IMAGE: JSON of keypoints, boxes, gaze, gaze_from, in pixels"
    )
    augment.add_argument("--preset", default="none", metavar="NAME", help="whose lens the other cameras have")
    augment.add_argument("--list", action="store_true", help="print the presets, and nothing else")
    augment.add_argument("-n", type=int, default=8, metavar="COUNT", help="how many other cameras; 8 by default")
    augment.add_argument("--seed", type=int, default=0, help="of what is drawn; 0 by default")
    augment.add_argument("--size", type=parse_size, metavar="WxH", help="of the new images; by default the old one's")
    for name in ("yaw", "pitch", "roll", "zoom", "fov"):
        augment.add_argument(f"--{name}", type=_range, metavar="RANGE", help="see camtorch.augment.RandomCamera")

    convert.add(commands)

    demo = commands.add_parser("demo", help="render, and measure what camtorch makes of it", allow_abbrev=False)
    demo.set_defaults(run=_demo)
    demo.add_argument(
        "subject",
        nargs="?",
        choices=("room", "training"),
        default="room",
        help="room: dewarp a room seen by five lenses (the default); training: teach networks with augmentation",
    )
    for command in (dewarp, augment):
        needed = command is dewarp
        command.add_argument(
            "--camera", type=Path, required=needed, metavar="FILE", help="its calibration, of any format"
        )
        command.add_argument(
            "--model",
            metavar="KEY",
            help="the camera model where the file does not say it: kannala_brandt, brown_conrady ...",
        )
        command.add_argument("--name", help="which camera, in a file with several")
        command.add_argument("--rescale", action="store_true", help="scale the camera to the image's resolution")
    for command, output in ((dewarp, None), (augment, Path("augment.png")), (demo, Path("demo.png"))):
        command.add_argument("-o", "--output", type=Path, required=output is None, default=output, metavar="OUT")
        command.add_argument("--force", action="store_true", help="overwrite OUT if it exists")
    return parser


def _range(text: str) -> float | tuple[float, float]:
    """A number, or two."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 2):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor LOW,HIGH, as in -5,20")
    return numbers if len(numbers) == 2 else numbers[0]


def _photograph(arguments: argparse.Namespace):
    """The image, its Exif orientation, and its camera."""
    from camtorch.cli import images
    from camtorch.cli.cameras import read_camera

    image, orientation = images.read(arguments.image)
    camera = read_camera(arguments.camera, arguments.name, arguments.model)
    size = tuple(image.shape[-2:])
    if camera.image_size is None:
        camera.image_size = size
        _note(f"{arguments.camera} states no image size; taken to be for {size[1]}x{size[0]}, as {arguments.image} is")
    elif camera.image_size != size:
        if not arguments.rescale:
            raise ValueError(_resolutions(arguments, size, camera.image_size))
        camera = camera.resize(*size)
    return image, orientation, camera


def _dewarp(arguments: argparse.Namespace) -> None:
    import torch

    from camtorch import Dewarp
    from camtorch.cli import images

    fov = arguments.fov
    if fov is not None and not (0 < fov < 180 or (arguments.projection != "perspective" and 0 < fov <= 360)):
        wider = "; --projection cylindrical goes to 360" if arguments.projection == "perspective" and fov >= 180 else ""
        allowed = "below 180" if arguments.projection == "perspective" else "at most 360"
        raise ValueError(f"--fov must be above 0 and {allowed} degrees for {arguments.projection}; got {fov:g}{wider}")
    images.check_target(arguments.output, force=arguments.force)
    image, orientation, camera = _photograph(arguments)
    size = camera.image_size
    with torch.no_grad():
        warp = Dewarp(camera, projection=arguments.projection, fov=fov and math.radians(fov), image_size=arguments.size)
        result, filled = _in_strips(warp, image)
        lattice = (camera.resize(64, 64).pixel_grid() + 0.5) * torch.tensor([size[1] / 64, size[0] / 64]) - 0.5
        shown = float(warp.transform_points(lattice)[1].double().mean())
    images.write(arguments.output, images.from_tensor(result), orientation=orientation)
    height, width = result.shape[-2:]
    fx, fy, cx, cy = warp.target.intrinsics.tolist()
    print(
        f"{arguments.output}: {camera.key} dewarped to {arguments.projection}, {_degrees(warp.target):.1f} degrees "
        f"wide, {width}x{height}, fx {fx:.6g} fy {fy:.6g} cx {cx:.6g} cy {cy:.6g}; {100 * filled:.1f} % of it is "
        f"filled and shows {100 * shown:.0f} % of the photograph"
    )


def _in_strips(warp, image):
    """The warped image and the filled part of it, computed in strips that bound the memory of large targets."""
    import torch

    from camtorch import Warp

    height, width = warp.target.image_size
    rows = max(1, _STRIP_PIXELS // width)
    strips, filled = [], 0
    for top in range(0, height, rows):
        strip = Warp(warp.source, warp.target.crop(top, 0, min(rows, height - top), width))
        strips.append(strip(image[None])[0])
        filled += int(strip.valid_mask().sum())
        if rows < height and sys.stderr.isatty():
            print(f"\r{min(100, 100 * (top + rows) // height)} %", end="", file=sys.stderr, flush=True)
    if rows < height and sys.stderr.isatty():
        print("\r", end="", file=sys.stderr)
    return torch.cat(strips, -2), filled / (height * width)


def _resolutions(arguments: argparse.Namespace, image: tuple[int, int], camera: tuple[int, int]) -> str:
    (height, width), (camera_height, camera_width) = image, camera
    text = (
        f"{arguments.image} is {width}x{height}, but the camera in {arguments.camera} is for "
        f"{camera_width}x{camera_height}; --rescale scales the camera to the image"
    )
    if abs(width / camera_width - height / camera_height) * max(camera) > 1:
        text += ", but their shapes differ too, so the image may be cropped, which scaling does not undo"
    return text


def _degrees(target) -> float:
    """The horizontal field of view of a target, from outer edge to outer edge."""
    fx, _, cx, _ = target.intrinsics.tolist()
    left, right = (cx + 0.5) / fx, (target.image_size[1] - 0.5 - cx) / fx
    if target.key == "pinhole":
        left, right = math.atan(left), math.atan(right)
    return math.degrees(left + right)


def _augment(arguments: argparse.Namespace) -> None:
    from camtorch.cli import augment, images, labels, sheet
    from camtorch.cli.cameras import read_camera

    if arguments.list:
        print("\n".join(augment.presets()))
        return
    lens = augment.lens(arguments.preset)
    if not 1 <= arguments.n <= _MOST_TILES:
        raise ValueError(f"-n must be 1 to {_MOST_TILES}; got {arguments.n}")
    if not 0 <= arguments.seed < 1 << 63:
        raise ValueError(f"--seed must be 0 or more, and below 2 to the 63rd; got {arguments.seed}")
    needs = {"camera": ("model", "name"), "image": ("labels", "rescale")}
    for needed, names in needs.items():
        idle = [name for name in names if getattr(arguments, needed) is None and getattr(arguments, name)]
        if idle:
            raise ValueError(f"--{idle[0]} needs {'IMAGE' if needed == 'image' else '--camera FILE'}")
    if arguments.image is not None and arguments.camera is None:
        raise ValueError(f"{arguments.image}: which camera took it? --camera FILE, its OpenCV calibration, says so")
    images.check_target(arguments.output, force=arguments.force)
    if arguments.image is not None:
        image, orientation, camera = _photograph(arguments)
        if orientation not in (None, 1):
            _note(f"{arguments.image} is shown as stored, not turned by its Exif orientation: so labels know it")
        known = None if arguments.labels is None else labels.read(arguments.labels, camera)
        before = augment.photograph(image, camera, known, arguments.image.name)
    elif arguments.camera is not None:
        camera = read_camera(arguments.camera, arguments.name, arguments.model)
        if camera.image_size is None:
            raise ValueError(f"{arguments.camera} states no image size, which a rendered image needs")
        before = augment.scene(camera)
    else:
        before = augment.scene()
    ranges = {name: getattr(arguments, name) for name in ("yaw", "pitch", "roll", "zoom", "fov")}
    ranges = {name: value for name, value in ranges.items() if value is not None}
    shown = [before]
    for view in augment.augmented(before, lens, arguments.n, arguments.seed, arguments.size, **ranges):
        print(view.note, flush=True)
        shown.append(view)
    title = f"One image, {sheet.counted(arguments.n, 'other camera')}"
    images.write(arguments.output, sheet.drawing(shown, title, augment.origin(lens, before)))
    print(f"{arguments.output}: the image before, and as each of them sees it, with what became of the labels")


def _demo(arguments: argparse.Namespace) -> None:
    from camtorch.cli import images
    from camtorch.demo import dewarping, training

    shown, caption = dewarping, "the sources, what became of them, and what separates that from the truth"
    if arguments.subject == "training":
        shown, caption = training, "what each network learned from, and what it finds behind the fisheye"
    images.check_target(arguments.output, force=arguments.force)
    results = shown.run(lambda line: print(line, flush=True))
    images.write(arguments.output, shown.drawing(results))
    print(f"{arguments.output}: {caption}")


if __name__ == "__main__":
    sys.exit(main())
