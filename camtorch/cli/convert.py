"""The command `camtorch convert`: a calibration as another camera model, or in another format."""

import argparse
import contextlib
import math
from pathlib import Path

from camtorch.cameras.rig import Rig
from camtorch.cli import targets
from camtorch.cli.cameras import read_rig
from camtorch.cli.terminal import note
from camtorch.io import formats
from camtorch.io.record import CameraFileError


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    if (arguments.new is None) == (arguments.output is None):
        raise ValueError("the new file must be given. Write camtorch convert IN -o OUT")
    path = arguments.new or arguments.output
    if not path.is_dir():  # some formats are folders
        targets.check(path, force=arguments.force, inputs=_read(arguments.input))
    angle = arguments.max_angle
    if angle is not None and not 0 < angle <= 180:
        raise ValueError(f"--max-angle must be above 0 and at most 180 degrees; got {angle:g}")
    rig = read_rig(arguments.input, arguments.name, arguments.from_model, arguments.size, stated=True)
    alone = arguments.name is not None
    cameras, notes = {}, []
    for name, camera in rig.cameras.items():
        model = arguments.model or camera.key
        result = camera.convert(model, count=arguments.count, max_angle=None if angle is None else math.radians(angle))
        cameras[name] = result.camera
        part = "what the image has rays for" if camera.image_size else "its rays"
        # for a batch, the worst of its cameras
        error = f"rms {float(result.rms.max()):.3g} px, at most {float(result.max_error.max()):.3g} px"
        degrees, covered = math.degrees(float(result.max_angle.min())), 100 * float(result.valid_fraction.min())
        notes.append(
            f"{path}: {name}, {camera.key} to {result.camera.key}: {'exact' if bool(result.exact.all()) else error}, "
            f"up to {degrees:.1f} degrees from the axis, {covered:.4g} % of {part}"
        )
    # camtorch's own JSON holds every model; the rig's own format may not
    stays = rig.format if arguments.model is None or path.suffix != ".json" else None
    changed = Rig(cameras, None if alone else rig.extrinsics, images=rig.images, format=stays)
    contents = _rendered(changed, path, arguments.format)
    for name in contents:
        targets.check(Path(name), force=arguments.force, inputs=_read(arguments.input))
    path.parent.mkdir(parents=True, exist_ok=True)
    formats.write(contents, path)
    print("\n".join(notes))
    if alone and len(rig.extrinsics):
        note(f"{path}: {arguments.name} alone; its pose is left out")


def _rendered(rig: Rig, path: Path, format: str | None) -> dict[str, bytes]:
    """Return the files of a rig; raise a CameraFileError that names the formats which the path may mean as well."""
    try:
        return formats.rendered(rig, path, format)
    except CameraFileError as error:
        others = []
        for other in formats.WRITTEN.values() if format is None else ():
            with contextlib.suppress(ValueError):
                if path.name.lower().endswith(other.suffixes) and formats.rendered(rig, path, other.format):
                    others.append(other.format)
        hint = f". --format {' or '.join(others)} holds it" if others else ""
        raise ValueError(f"{error}{hint}") from None


def _read(path: Path) -> tuple[Path, ...]:
    """Return the files that loading a path may read: all of a folder's, and COLMAP's images next to its cameras."""
    if path.is_dir():
        return tuple(path.iterdir())
    return (path, *path.parent.glob("images.*")) if path.stem == "cameras" else (path,)
