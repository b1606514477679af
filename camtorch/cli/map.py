"""The command `camtorch map`: a dewarping as a lookup table for another runtime, with its error."""

import argparse
from pathlib import Path

from camtorch.cli import targets
from camtorch.cli.cameras import read_camera
from camtorch.maps.formats import files_of, load_map, save_map
from camtorch.maps.lookup import Exact
from camtorch.maps.report import measure
from camtorch.warp.dewarp import Dewarp
from camtorch.warp.warp import Warp


def run(given: argparse.Namespace) -> None:
    """Run the command."""
    output: Path | None = given.output
    if (output is None) == (given.check is None):
        raise ValueError("one of -o OUT, which writes a map, or --check MAP, which measures one, must be given")
    if output is not None:
        for name in files_of(output, given.format):
            targets.check(Path(name), force=given.force, inputs=(given.camera, given.target))
    camera, target = read_camera(given.camera, given.name, given.from_model, given.camera_size), given.target
    if camera.image_size is None:
        raise ValueError(f"{given.camera}: must have an image size; got none. Add --camera-size WxH")
    if target is None:
        warp: Warp = Dewarp(camera, projection=given.projection, fov=given.fov, image_size=given.size, tolerance=0)
    elif other := [f"--{name}" for name in ("fov", "size") if getattr(given, name) is not None]:
        raise ValueError(f"{other[0]} must not be given with --target {target}, which has its own")
    else:
        warp = Warp(camera, read_camera(target), tolerance=0)
    if output is None:
        read = load_map(given.check, given.format)
        print(measure(str(given.check), read, Exact(warp, "--check"), (), read.facts))
    else:
        output.parent.mkdir(parents=True, exist_ok=True)
        print(save_map(warp, output, given.format, step=given.step, dtype=given.dtype, clip=given.clip))
