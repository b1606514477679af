"""COLMAP's images.txt and images.bin: the poses of images. Their points are passed over."""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

from camtorch.extrinsics import Extrinsics
from camtorch.io import poses
from camtorch.io.parsing import check_ordinary
from camtorch.io.record import Record
from camtorch.io.writing import Lossy, number
from camtorch.rig import Rig

_HEAD = struct.Struct("<I7dI")
_POINT = 24  # x, y and the id of a 3D point
_MOST_IMAGES = 200_000  # a pose takes some 5 kB
_LONGEST_NAME = 4096
_LONGEST_LINE = 1 << 26


class Image(NamedTuple):
    """An image of a file: its name, the id of its camera, its pose, whether it has points; and its place."""

    name: str
    camera: str
    extrinsics: Extrinsics
    has_points: bool
    record: Record


def read(path) -> Iterator[Image]:
    """The images of an images.txt or images.bin.

    Raises:
        CameraFileError: it is none.
    """
    check_ordinary(path)
    with open(path, "rb") as file:
        images = (_from_bytes if os.fspath(path).endswith(".bin") else _from_text)(path, file)
        for i, image in enumerate(images):
            if i >= _MOST_IMAGES:
                image.record.fail(f"more than {_MOST_IMAGES} images")
            yield image


def _from_text(path, file: BinaryIO) -> Iterator[Image]:
    i = 0
    while line := file.readline(_LONGEST_LINE):
        i += 1
        record = Record(path, None, f"line {i}")
        try:
            words = line.decode().split(maxsplit=9)
        except UnicodeDecodeError:
            record.fail("not text")
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 10:
            record.fail("less than IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME")
        camera = str(Record(path, words[8], record.place).whole(0, (1 << 32) - 2, "camera id"))
        values = [Record(path, word, record.place).number() for word in words[1:8]]
        # the next line holds the points, be it empty
        points = file.readline(_LONGEST_LINE)
        i += 1
        yield _image(record, words[9].strip(), camera, values, bool(points.strip()))


def _from_bytes(path, file: BinaryIO) -> Iterator[Image]:
    size = os.fstat(file.fileno()).st_size

    def take(length: int) -> bytes:
        record = Record(path, None, f"byte {file.tell()}")
        content = file.read(length)
        if len(content) < length:
            record.fail(f"the file ends here, {length - len(content)} bytes too early")
        return content

    (count,) = struct.unpack("<Q", take(8))
    if count > size // (_HEAD.size + 9):
        Record(path, None, "byte 0").fail(f"{count} images, for which the file is too small")
    for _ in range(count):
        record = Record(path, None, f"byte {file.tell()}")
        _, *values, camera = _HEAD.unpack(take(_HEAD.size))
        if not all(map(math.isfinite, values)):
            record.fail(f"a pose that is not finite: {values}")
        name = bytearray()
        while (byte := take(1)) != b"\0":
            name += byte
            if len(name) > _LONGEST_NAME:
                record.fail("the name of the image has no end")
        try:
            text = name.decode()
        except UnicodeDecodeError:
            record.fail("the name of the image is no text")
        (points,) = struct.unpack("<Q", take(8))
        if points * _POINT > size - file.tell():
            record.fail(f"{points} points, for which the file is too small")
        file.seek(points * _POINT, os.SEEK_CUR)
        yield _image(record, text, str(camera), values, points > 0)
    if file.tell() < size:
        Record(path, None, f"byte {file.tell()}").fail(f"{size - file.tell()} bytes after the last image")


def _image(record: Record, name: str, camera: str, values: list[float], has_points: bool) -> Image:
    extrinsics = poses.from_quaternion(record, values[:4], values[4:])
    return Image(name, camera, extrinsics, has_points, record)


# -- writing


def content(lossy: Lossy, rig: Rig, identities: dict[str, int], path: str, binary: bool) -> bytes | None:
    """The file of a rig's poses, or None if the file that is there says the same.

    Raises:
        CameraFileError: the file that is there has points, which would be lost.
    """
    entries = []
    for name, extrinsics in rig.extrinsics.items():
        lossy.pose(name, extrinsics)
        if not name or "\0" in name or (not binary and (name.split() != [name])):
            lossy.fail(
                repr(name), "an image name that COLMAP does not read" + " from text; .bin takes it" * (not binary)
            )
        quaternion, translation = poses.to_quaternion(extrinsics)
        entries.append((name, identities[rig.images.get(name, name)], [*quaternion, *translation]))
    if os.path.exists(path):
        there = list(read(path))
        kept = [(i.name, int(i.camera), [v for vs in poses.to_quaternion(i.extrinsics) for v in vs]) for i in there]
        if kept == entries:
            return None
        if any(image.has_points for image in there):
            Record(path, None).fail("holds the points of images, which would be lost; write to another folder")
    folder, suffix = os.path.dirname(path), os.path.splitext(path)[1]
    for name in ("rigs", "frames"):
        if os.path.exists(os.path.join(folder, name + suffix)):
            lossy.fail("extrinsics", f"would contradict {name}{suffix} beside them; write to another folder")
    return _as_bytes(entries) if binary else _as_text(entries)


def _as_text(entries: list[tuple]) -> bytes:
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
        f"# Number of images: {len(entries)}, mean observations per image: 0",
    ]
    for i, (name, camera, values) in enumerate(entries, 1):
        lines += [f"{i} {' '.join(map(number, values))} {camera} {name}", ""]
    return ("\n".join(lines) + "\n").encode()


def _as_bytes(entries: list[tuple]) -> bytes:
    parts = [struct.pack("<Q", len(entries))]
    for i, (name, camera, values) in enumerate(entries, 1):
        parts += [_HEAD.pack(i, *values, camera), name.encode(), b"\0", struct.pack("<Q", 0)]
    return b"".join(parts)
