"""Writing files: as a whole or not at all (`replacing`), numbers to the last bit, and what a format cannot hold."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import re
import secrets
import stat
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import IO, NoReturn

from torch import Tensor

from camtorch.camera import Camera
from camtorch.extrinsics import Extrinsics
from camtorch.io._errors import CameraFileError
from camtorch.rig import Rig


@contextlib.contextmanager
def replacing(*paths: str | os.PathLike[str], synced: bool = True) -> Iterator[list[IO[bytes]]]:
    """Open files to write that take the places of `paths` at the end of the block, one after the other.

    On any error in the block none does. All is on the disk before the first place changes, unless `synced` is false,
    for whoever finds out otherwise what a loss of power took: that saves a hundredth of a second a file. Where a path
    is a link, what it points to is replaced, and the link stays. Files keep their rights; new ones get those that the
    process gives to new files.

    Raises:
        OSError: no such folder, a place that is taken by anything but an ordinary file, a full disk.
    """
    targets = [os.path.realpath(path) for path in paths]
    with contextlib.ExitStack() as stack:
        files, names = [], []
        for target in targets:
            file, name = _opened_beside(target)
            stack.callback(_unlink, name)
            files.append(stack.enter_context(file))
            names.append(name)
        yield files
        for file in files:
            file.flush()
            if synced:
                os.fsync(file.fileno())
            file.close()
        for name, target in zip(names, targets, strict=True):
            os.replace(name, target)


def all_left_over(paths: Iterable[str]) -> list[str]:
    """Files that crashes within `replacing` left beside any of `paths`; folders that are not there have none."""
    marks = {(os.path.dirname(path), _mark_of(path)) for path in paths}
    found = []
    for folder in {folder for folder, _ in marks}:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            for name in os.listdir(folder or "."):
                part = _PART.fullmatch(name)
                if part and (folder, part[1]) in marks:
                    found.append(os.path.join(folder, name))
    return sorted(found)


_PART = re.compile(r"[.]([0-9a-f]{16})[0-9a-f]{8}[.]part")


def _mark_of(path: str) -> str:
    """What the names of files beside a path begin with: a hash, for a name may be as long as file systems allow."""
    return hashlib.blake2b(os.fsencode(os.path.basename(path)), digest_size=8).hexdigest()


def _opened_beside(path: str) -> tuple[IO[bytes], str]:
    """An empty file beside `path` with the rights of the file that it will replace, or of a new one; and its name."""
    folder = os.path.dirname(path)
    name = os.path.join(folder, f".{_mark_of(path)}{secrets.token_hex(4)}.part")
    if not os.path.isdir(folder):
        raise FileNotFoundError(errno.ENOENT, "no such folder", folder)
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        mode = None
    if mode is not None and not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "no ordinary file, which could be replaced", path)
    # 0o666 is what the kernel takes the umask from
    rights = 0o666 if mode is None else stat.S_IMODE(mode)
    handle = os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), rights)
    if mode is not None:
        os.chmod(name, rights)
    return os.fdopen(handle, "w+b"), name


def _unlink(path: str) -> None:
    with contextlib.suppress(OSError):
        os.unlink(path)


# -- numbers and texts


def number(value: float) -> str:
    """A number that every YAML reader takes for one, to the last bit: PyYAML reads 1e-05 as text, 1.0e-05 not."""
    return re.sub(r"^(-?\d+)e", r"\1.0e", repr(float(value)))


def listed(values: Sequence[float]) -> str:
    """[1.0, 2.0]"""
    return f"[{', '.join(map(number, values))}]"


def as_json(value: object) -> str:
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

    path: str
    format: str

    def __init__(self, path: str, format: str):
        self.path, self.format = path, format

    def fail(self, name: str, reason: str) -> NoReturn:
        """Raise the CameraFileError for a camera that the format cannot hold."""
        raise CameraFileError(self.path, name, reason)

    def size(self, name: str, camera: Camera) -> tuple[int, int]:
        """(height, width) of a camera that must have them."""
        if camera.image_size is None:
            self.fail(name, f"no image_size, which {self.format} needs")
        return camera.image_size

    def model(
        self, name: str, camera: Camera, known: Collection[str]
    ) -> tuple[str, tuple[float, float, float, float], list[float]]:
        """The key of a single camera's model, which must be a known one, its intrinsics and its distortion."""
        (fx, fy, cx, cy), distortion = self._single(name, camera, "cameras", camera.intrinsics, camera.distortion)
        if camera.key not in known:
            others = f"it has for {', '.join(sorted(known))}, which camera.convert(key).camera makes of it"
            self.fail(name, f"{self.format} has no name for {camera.key}; {others}")
        return camera.key, (fx, fy, cx, cy), distortion

    def _single(self, name: str, owner: Camera | Extrinsics, what: str, *tensors: Tensor) -> list[list[float]]:
        """The finite numbers of what is no batch."""
        if owner.batch_shape:
            self.fail(name, f"a batch of {what} {tuple(owner.batch_shape)}; {self.format} holds single ones")
        values: list[list[float]] = [t.detach().double().tolist() for t in tensors]
        if not all(math.isfinite(v) for vector in values for v in vector):
            self.fail(name, f"{'intrinsics or distortion' if what == 'cameras' else what} that are not finite")
        return values

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
            count = f"{len(rig.cameras)} cameras; {self.format} holds one"
            self.fail("cameras", f"{count}; on the command line --name says which")
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
                    name,
                    f"its extrinsics would be lost; {self.format} has no place for them. Save the camera alone; on "
                    f"the command line --name {name} does",
                )

    def pose(self, name: str, extrinsics: Extrinsics) -> tuple[list[float], list[float]]:
        """Rotation vector and translation of a single pose."""
        rotation, translation = self._single(
            name, extrinsics, "extrinsics", extrinsics.rotation, extrinsics.translation
        )
        return rotation, translation

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
