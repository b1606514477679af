"""COLMAP's images.txt and images.bin: the poses of images. Their points are passed over."""

from __future__ import annotations

import os
import struct
from array import array
from collections.abc import Iterable, Iterator
from typing import BinaryIO, NamedTuple

import numpy as np
import torch

from camtorch.io import poses
from camtorch.io.parsing import check_ordinary
from camtorch.io.record import Record, repeated
from camtorch.io.writing import Lossy, number
from camtorch.rig import Rig
from camtorch.rotations import quaternion_vector

_HEAD = struct.Struct("<I7dI")
_POINT = 24  # x, y and the id of a 3D point
_MOST_COMMENTS = 10_000  # and blank lines, before the first image or between two
_MOST_IMAGES = 1 << 18  # each takes some 400 bytes
_LONGEST_NAME = 4096
_LONGEST_LINE = 1 << 26
_SAME = 1e-12  # of poses: what another format may have rounded
LARGEST_ID = (1 << 32) - 2  # of cameras; the one above means none


class Images(NamedTuple):
    """The images of a file.

    names and cameras: of each image, the latter by their ids.
    values: (N, 7), unit quaternions w, x, y, z and translations.
    has_points: whether any of them has points.
    unit, places: what numbers the place of an image in the file, and those numbers.
    """

    path: str
    names: list[str]
    cameras: list[str]
    values: np.ndarray
    has_points: bool
    unit: str
    places: array[int]

    def record(self, row: int) -> Record:
        """The place of an image."""
        return Record(self.path, None, f"{self.unit} {self.places[row]}")


def read(path: str) -> Images:
    """The images of an images.txt or images.bin.

    Raises:
        CameraFileError: it is none, or two images have one name.
    """
    check_ordinary(path)
    unit, entries = ("byte", _from_bytes) if path.endswith(".bin") else ("line", _from_text)
    names: list[str] = []
    cameras: list[str] = []
    values, places, has_points = array("d"), array("q"), False
    with open(path, "rb", buffering=1 << 16) as file:
        for place, pose, camera, name, with_points in entries(path, file):
            if len(names) >= _MOST_IMAGES:
                Record(path, None, f"{unit} {place}").fail(f"more than {_MOST_IMAGES} images")
            values.extend(pose)
            cameras.append(camera)
            names.append(name)
            places.append(place)
            has_points = has_points or with_points
    images = Images(path, names, cameras, np.array(values).reshape(-1, 7), has_points, unit, places)
    if (twice := repeated(names)) is not None:
        images.record(names.index(twice, names.index(twice) + 1)).fail(f"a second image is called {twice!r:.60}")
    finite = np.isfinite(images.values).all(1)
    if not finite.all():
        row = int(finite.argmin())
        images.record(row).fail(f"a pose that is no finite number: {images.values[row].tolist()}")
    return images


_Entry = tuple[int, Iterable[float], str, str, bool]
"""The place of an image, its pose, the id of its camera, its name, and whether it has points."""


def _from_text(path: str, file: BinaryIO) -> Iterator[_Entry]:
    number = passed = 0
    known: dict[bytes, str] = {}
    while line := file.readline(_LONGEST_LINE):
        number += 1
        record = Record(path, None, f"line {number}")
        words = line.split(None, 9)
        if not words or words[0].startswith(b"#"):
            passed += 1
            if passed > _MOST_COMMENTS:
                record.fail(f"more than {_MOST_COMMENTS} lines without an image")
            continue
        if len(words) < 10:
            _text(record, line)
            record.fail(f"less than IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME: {len(words)} words")
        try:
            pose = list(map(float, words[1:8]))
        except ValueError:
            pose = [Record(path, _text(record, word), record.place).number() for word in words[1:8]]
        if words[8] not in known:
            identity = Record(path, _text(record, words[8]), record.place).whole(0, LARGEST_ID, "camera id")
            known[words[8]] = str(identity)
        name = _text(record, words[9].strip())
        points = file.readline(_LONGEST_LINE)  # of the image; the line may be empty
        yield number, pose, known[words[8]], name, not (points.isspace() or not points)
        number += 1


def _text(record: Record, content: bytes) -> str:
    if len(content) > _LONGEST_NAME:
        record.fail(f"the name of the image has no end within {_LONGEST_NAME} bytes")
    try:
        return content.decode()
    except UnicodeDecodeError:
        record.fail("not text")


def _from_bytes(path: str, file: BinaryIO) -> Iterator[_Entry]:
    size = os.fstat(file.fileno()).st_size
    (count,) = struct.unpack("<Q", file.read(8).ljust(8, b"\0"))
    if size < 8 or count > (size - 8) // (_HEAD.size + 9):
        Record(path, None, "byte 0").fail(f"{count} images, for which the file is too small")
    position = 8
    for _ in range(count):
        record = Record(path, None, f"byte {position}")
        file.seek(position)
        block = file.read(_HEAD.size + _LONGEST_NAME + 9)
        end = block.find(b"\0", _HEAD.size)
        if end + 9 > len(block) or (end < 0 and len(block) < _HEAD.size + _LONGEST_NAME):
            record.fail("the file ends within this image")
        name = _text(record, block[_HEAD.size : end] if end > 0 else block)
        _, *pose, camera = _HEAD.unpack_from(block)
        (points,) = struct.unpack_from("<Q", block, end + 1)
        if position + end + 9 + points * _POINT > size:
            record.fail(f"{points} points, for which the file is too small")
        yield position, pose, str(camera), name, points > 0
        position += end + 9 + points * _POINT
    if position < size:
        Record(path, None, f"byte {position}").fail(f"{size - position} bytes after the last image")


# -- writing


def content(lossy: Lossy, rig: Rig, identities: dict[str, int], path: str, binary: bool) -> bytes | None:
    """The file of a rig's poses, or None if the file that is there says the same.

    Raises:
        CameraFileError: the file that is there has points, which would be lost.
    """
    entries = []
    posed = poses.all_of(rig, lossy)
    for name, values in zip(rig.extrinsics, poses.quaternions(posed).tolist(), strict=True):
        if not name or "\0" in name or (not binary and (name.split() != [name])):
            lossy.fail(
                repr(name), "an image name that COLMAP does not read" + " from text; .bin takes it" * (not binary)
            )
        entries.append((name, identities[rig.images.get(name, name)], values))
    if os.path.exists(path):
        there = read(path)
        if [entry[:2] for entry in entries] == list(zip(there.names, map(int, there.cameras), strict=True)):
            its = poses.as_float64(there.values)
            theirs = torch.cat((quaternion_vector(its[:, :4]), its[:, 4:]), -1)
            if torch.allclose(theirs, torch.cat((posed.rotation, posed.translation), -1), rtol=_SAME, atol=_SAME):
                return None
        if there.has_points:
            Record(path, None).fail("holds the points of images, which would be lost; write to another folder")
    folder, suffix = os.path.dirname(path), os.path.splitext(path)[1]
    for name in ("rigs", "frames"):
        if os.path.exists(os.path.join(folder, name + suffix)):
            lossy.fail("extrinsics", f"would contradict {name}{suffix} beside them; write to another folder")
    if binary:
        parts = [struct.pack("<Q", len(entries))]
        for i, (name, camera, values) in enumerate(entries, 1):
            parts += [_HEAD.pack(i, *values, camera), name.encode(), b"\0", struct.pack("<Q", 0)]
        return b"".join(parts)
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
        f"# Number of images: {len(entries)}, mean observations per image: 0",
    ]
    for i, (name, camera, values) in enumerate(entries, 1):
        lines += [f"{i} {' '.join(map(number, values))} {camera} {name}", ""]
    return ("\n".join(lines) + "\n").encode()
