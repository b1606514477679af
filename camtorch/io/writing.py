"""What all writers share: what a format cannot hold is an error, numbers keep their last bit, files are whole."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import stat
import tempfile
from collections.abc import Collection, Sequence
from typing import NoReturn

from camtorch.camera import Camera
from camtorch.extrinsics import Extrinsics
from camtorch.io._errors import CameraFileError
from camtorch.rig import Rig


def write_atomically(path, content: bytes) -> None:
    """Write a file so that, whatever happens, the old or the new content stands there whole."""
    path = os.path.realpath(path)
    if os.path.exists(path) and not os.path.isfile(path):
        raise OSError(errno.EINVAL, "no ordinary file, which could be replaced", path)
    handle, temporary = tempfile.mkstemp(dir=os.path.dirname(path), prefix=f".{os.path.basename(path)[:100]}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, _mode(path))
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise


def _mode(path: str) -> int:
    try:
        return stat.S_IMODE(os.stat(path).st_mode)
    except FileNotFoundError:
        mask = os.umask(0)  # there is no way to read it without setting it
        os.umask(mask)
        return 0o666 & ~mask


# -- numbers and texts


def number(value: float) -> str:
    """A number that every YAML reader takes for one, to the last bit: PyYAML reads 1e-05 as text, 1.0e-05 not."""
    text = repr(float(value))
    return re.sub(r"^(-?\d+)e", r"\1.0e", text)


def listed(values: Sequence[float]) -> str:
    """[1.0, 2.0]"""
    return f"[{', '.join(map(number, values))}]"


def quoted(text: str) -> str:
    """A text as YAML, in quotes unless it is a plain word."""
    plain = re.fullmatch(r"[A-Za-z_/][\w./-]*", text) and text.lower() not in _YAML_WORDS
    return text if plain else _SURROGATES.sub(lambda pair: json.loads(f'"{pair[0]}"'), json.dumps(text))


_SURROGATES = re.compile(r"\\ud[89ab]..\\ud[c-f]..")  # which JSON writes, and YAML does not read
_YAML_WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}


def as_json(value) -> str:
    """Indented JSON, lists of numbers in one line."""
    text = json.dumps(value, indent=2, allow_nan=False)
    return re.sub(r"\[[^\[\]{}\"]*\]", lambda match: re.sub(r"\s*\n\s*", " ", match[0]), text) + "\n"


# -- what is to be written


class Lossy:
    """Where it is written, for the errors that say what would be lost.

    Args:
        path: the file.
        format: what the errors call the format.
    """

    def __init__(self, path, format: str):
        self.path, self.format = path, format

    def fail(self, name: str, reason: str) -> NoReturn:
        """Raise the CameraFileError for a camera that the format cannot hold."""
        raise CameraFileError(self.path, name, reason)

    def size(self, name: str, camera: Camera) -> tuple[int, int]:
        """(height, width) of a camera that must have them."""
        if camera.image_size is None:
            self.fail(name, f"no image_size, which {self.format} needs")
        return camera.image_size

    def numbers(self, name: str, camera: Camera) -> tuple[list[float], list[float]]:
        """Intrinsics and distortion of a single camera."""
        if camera.batch_shape:
            self.fail(name, f"a batch of cameras {tuple(camera.batch_shape)}; {self.format} holds single ones")
        values = [t.detach().double().tolist() for t in (camera.intrinsics, camera.distortion)]
        if not all(math.isfinite(v) for vector in values for v in vector):
            self.fail(name, "intrinsics or distortion that are not finite")
        return values[0], values[1]

    def single_focal(self, name: str, intrinsics: list[float]) -> list[float]:
        """f, cx, cy of fx, fy, cx, cy."""
        fx, fy, cx, cy = intrinsics
        if fx != fy:
            self.fail(name, f"fx = {fx!r} and fy = {fy!r}; the model has one focal length in {self.format}")
        return [fx, cx, cy]

    def model(self, name: str, camera: Camera, known: Collection[str]) -> str:
        """The key of the camera's model, which must be a known one."""
        if camera.key not in known:
            self.fail(name, f"{self.format} has no name for {camera.key}; it has for {', '.join(sorted(known))}")
        return camera.key

    def at_most(self, name: str, camera: Camera, distortion: list[float], counts: Sequence[int]) -> list[float]:
        """The coefficients, with zeros added or left out to make their number one of `counts`."""
        if len(distortion) in counts:
            return distortion
        for count in sorted(counts):
            if not any(distortion[count:]):
                return (distortion + [0.0] * count)[:count]
        lost = camera.distortion_names[max(counts) :]
        return self.fail(
            name,
            f"{len(distortion)} coefficients; {self.format} has {max(counts)} for {camera.key}, "
            f"so {' '.join(lost)} would be lost",
        )

    def only_camera(self, rig: Rig) -> tuple[str, Camera]:
        """The one camera of a format that holds no more."""
        if len(rig.cameras) != 1:
            self.fail("cameras", f"{len(rig.cameras)} cameras; {self.format} holds one")
        return next(iter(rig.cameras.items()))

    def no_images(self, rig: Rig) -> None:
        """Refuse the posed images of a format that has only cameras."""
        if images := [name for name in rig.extrinsics if name in rig.images]:
            self.fail(images[0], f"a posed image; {self.format} holds cameras only, so its pose would be lost")

    def no_pose(self, rig: Rig) -> None:
        """Refuse the pose of a format that has none."""
        self.no_images(rig)
        for name, extrinsics in rig.extrinsics.items():
            if self.pose(name, extrinsics) != ([0.0] * 3, [0.0] * 3):
                self.fail(
                    name, f"its extrinsics would be lost; {self.format} has no place for them. Save the camera alone"
                )

    def pose(self, name: str, extrinsics: Extrinsics) -> tuple[list[float], list[float]]:
        """Rotation vector and translation of a single pose."""
        if extrinsics.batch_shape:
            self.fail(name, f"a batch of extrinsics {tuple(extrinsics.batch_shape)}; {self.format} holds single ones")
        values = [t.detach().double().tolist() for t in (extrinsics.rotation, extrinsics.translation)]
        if not all(math.isfinite(v) for vector in values for v in vector):
            self.fail(name, "extrinsics that are not finite")
        return values[0], values[1]

    def all_posed(self, rig: Rig) -> dict[str, Extrinsics]:
        """A pose for each camera; a single camera without one is where the rig is."""
        self.no_images(rig)
        if len(rig.cameras) == 1 and not rig.extrinsics:
            (name,) = rig.cameras
            return {name: Extrinsics([0.0] * 3, [0.0] * 3).double()}
        for name in rig.cameras:
            if name not in rig.extrinsics:
                self.fail(name, f"no extrinsics, which {self.format} needs of each camera")
            self.pose(name, rig.extrinsics[name])
        return {name: rig.extrinsics[name] for name in rig.cameras}
