"""Writing files as a whole or not at all (`replacing`), exact numbers, and errors for values that would be lost."""

import contextlib
import errno
import json
import math
import os
import re
import secrets
import stat
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NoReturn

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.io.record import CameraFileError
from camtorch.poses.extrinsics import Extrinsics


@contextlib.contextmanager
def replacing(*paths: str | os.PathLike[str], synced: bool = True) -> Iterator[list[IO[bytes]]]:
    """Open files that replace `paths` at the end of the block, one after the other.

    If the block raises, no path changes. All data is on the disk before the first path changes; `synced=False` skips
    that, a hundredth of a second a file. If a path is a link, its target is replaced. Files keep their rights.
    """
    targets = [os.path.realpath(path) for path in paths]
    with contextlib.ExitStack() as stack:
        files = [_opened_beside(target, stack) for target in targets]
        yield files
        for file in files:
            file.flush()
            if synced:
                os.fsync(file.fileno())
            file.close()
        for file, target in zip(files, targets, strict=True):
            os.replace(file.name, target)


def _opened_beside(path: str, stack: contextlib.ExitStack) -> IO[bytes]:
    """Open an empty file in the folder of `path` with the same rights; `stack` closes and removes it."""
    folder, mode = os.path.dirname(path), os.stat(path).st_mode if os.path.exists(path) else None
    if not os.path.isdir(folder):
        raise FileNotFoundError(errno.ENOENT, "no such folder", folder)
    if mode is not None and not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "no ordinary file, so it cannot be replaced", path)
    name = os.path.join(folder, f".{secrets.token_hex(12)}.part")  # the longest name has no room for a suffix
    rights = 0o666 if mode is None else stat.S_IMODE(mode)  # the kernel takes the umask from both
    stack.callback(Path(name).unlink, missing_ok=True)
    file = open(name, "x+b", opener=lambda name, flags: os.open(name, flags, rights))  # noqa: SIM115
    if mode is not None:
        os.chmod(name, rights)
    return stack.enter_context(file)


def number(value: float) -> str:
    """Return a number exactly, in a form that every YAML reader accepts: PyYAML reads 1e-05 as text."""
    return re.sub(r"^(-?\d+)e", r"\1.0e", repr(float(value)))


def listed(values: Sequence[float]) -> str:
    """Return numbers as text, as in [1.0, 2.0]."""
    return f"[{', '.join(map(number, values))}]"


def as_json(value: object) -> str:
    """Return indented JSON with lists of numbers in one line."""
    text = json.dumps(value, indent=2, allow_nan=False)
    return re.sub(r"\[[^\[\]{}\"]*\]", lambda match: re.sub(r"\s*\n\s*", " ", match[0]), text) + "\n"


@dataclass(frozen=True)
class Lossy:
    """Values for the file `path` of a format; values that would be lost raise errors."""

    path: str
    format: str

    def fail(self, name: str, reason: str) -> NoReturn:
        """Raise the CameraFileError for a camera that the format cannot hold."""
        raise CameraFileError(self.path, name, reason)

    def size(self, name: str, camera: Camera) -> tuple[int, int]:
        """Return the (height, width) of a camera, which must have them."""
        if camera.image_size is None:
            self.fail(name, f"must have an image_size for {self.format}; got none")
        return camera.image_size

    def model(
        self, name: str, camera: Camera, known: Collection[str]
    ) -> tuple[str, tuple[float, float, float, float], list[float]]:
        """Return key, intrinsics and distortion of a single camera, whose model must be a known one."""
        (fx, fy, cx, cy), distortion = self._single(name, camera, "cameras")
        if camera.key not in known:
            others = f"must be one of {', '.join(sorted(known))} for {self.format}"
            self.fail(name, f"the model {others}; got {camera.key}. Write camera.convert(key).camera")
        return camera.key, (fx, fy, cx, cy), distortion

    def _single(self, name: str, owner: Camera | Extrinsics, what: str) -> list[list[float]]:
        """Return the numbers of a camera or a pose that is no batch."""
        if owner.batch_shape:
            self.fail(name, f"must be single for {self.format}; got a batch of {what} {tuple(owner.batch_shape)}")
        kind = "numbers" if what == "cameras" else what
        return [self.numbers(name, getattr(owner, key), kind) for key in owner.tensor_names]

    def numbers(self, name: str, tensor: Tensor, what: str = "numbers") -> Any:
        """Return the numbers of a tensor, which must be finite."""
        values = tensor.detach().double().tolist()
        if not all(map(math.isfinite, values if tensor.ndim == 1 else tensor.flatten().tolist())):
            self.fail(name, f"{what} must be finite; got NaN or infinity")
        return values

    def at_most(self, name: str, camera: Camera, distortion: list[float], counts: Sequence[int]) -> list[float]:
        """Return the coefficients, padded with zeros or without trailing zeros, so that their number is in `counts`."""
        if len(distortion) in counts:
            return distortion
        for count in sorted(counts):
            if not any(distortion[count:]):
                return (distortion + [0.0] * count)[:count]
        most, lost = max(counts), " ".join(camera.distortion_names[max(counts) :])
        has = f"must have at most {most} coefficients for {self.format} and {camera.key}"
        return self.fail(name, f"{has}; got {len(distortion)}, of which {lost} would be lost")

    def only_camera(self, rig: Rig) -> tuple[str, Camera]:
        """Return name and camera of a rig, which must have only one camera for this format."""
        if len(rig.cameras) != 1:
            count = f"must be one for {self.format}; got {len(rig.cameras)}"
            self.fail("cameras", f"{count}. On the command line choose one with --name")
        return next(iter(rig.cameras.items()))

    def numbered(self, rig: Rig) -> Rig:
        """Return the rig in the order in which the format numbers cameras; cam0, cam1, ... keep these names."""
        names = [f"cam{i}" for i in range(len(rig.cameras))]
        if {*names} != {*rig.cameras}:
            return rig
        return Rig({name: rig.cameras[name] for name in names}, rig.extrinsics, images=rig.images)

    def no_images(self, rig: Rig) -> None:
        """Refuse posed images if the format has only cameras."""
        if images := [name for name in rig.extrinsics if name in rig.images]:
            self.fail(images[0], f"must be a camera for {self.format}; got a posed image, whose pose would be lost")

    def no_pose(self, rig: Rig) -> None:
        """Refuse poses if the format has none."""
        self.no_images(rig)
        for name, extrinsics in rig.extrinsics.items():
            if self.pose(name, extrinsics) != ([0.0] * 3, [0.0] * 3):
                place = f"must have no extrinsics for {self.format}; got some, which would be lost"
                self.fail(name, f"{place}. Save the camera alone; on the command line add --name {name}")

    def pose(self, name: str, extrinsics: Extrinsics) -> tuple[list[float], list[float]]:
        """Return rotation vector and translation of a single pose."""
        rotation, translation = self._single(name, extrinsics, "extrinsics")
        return rotation, translation

    def all_posed(self, rig: Rig) -> dict[str, Extrinsics]:
        """Return a pose for each camera; a single camera without a pose is at the rig's origin."""
        self.no_images(rig)
        if len(rig.cameras) == 1 and not rig.extrinsics:
            return dict.fromkeys(rig.cameras, Extrinsics([0.0] * 3, [0.0] * 3).double())
        for name in rig.cameras:
            if name not in rig.extrinsics:
                self.fail(name, f"must have extrinsics for {self.format}; got none")
            self.pose(name, rig.extrinsics[name])
        return {name: rig.extrinsics[name] for name in rig.cameras}
