"""The command `camtorch map`: a dewarping as a lookup table for another runtime, with its error."""

from __future__ import annotations

import argparse
from pathlib import Path

from camtorch.cli import targets
from camtorch.cli.cameras import read_camera
from camtorch.maps.formats import files_of, load_map, save_map
from camtorch.maps.lookup import Exact
from camtorch.maps.report import measure
from camtorch.warp.dewarp import Dewarp
from camtorch.warp.warp import Warp

_OPTIONS = ("step", "dtype", "clip")


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    output: Path | None = arguments.output
    if (output is None) == (arguments.check is None):
        raise ValueError("one of -o OUT, which writes a map, or --check MAP, which measures one, must be given")
    if output is not None:
        for name in files_of(output, arguments.format):
            targets.check(Path(name), force=arguments.force, inputs=(arguments.camera, arguments.target))
    warp = _warp(arguments)
    if output is None:
        read = load_map(arguments.check, arguments.format)
        print(measure(str(arguments.check), read, Exact(warp, "--check"), (), read.facts))
    else:
        output.parent.mkdir(parents=True, exist_ok=True)
        print(save_map(warp, output, arguments.format, **{name: getattr(arguments, name) for name in _OPTIONS}))


def _warp(given: argparse.Namespace) -> Warp:
    camera = read_camera(given.camera, given.name, given.from_model, given.camera_size)
    if camera.image_size is None:
        raise ValueError(f"{given.camera}: must have an image size; got none. Add --camera-size WxH")
    if given.target is None:
        return Dewarp(camera, projection=given.projection, fov=given.fov, image_size=given.size, tolerance=0)
    for name in ("fov", "size"):
        if getattr(given, name) is not None:
            raise ValueError(f"--{name} must not be given with --target {given.target}, which has its own")
    return Warp(camera, read_camera(given.target), tolerance=0)
