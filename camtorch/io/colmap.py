"""COLMAP's cameras.txt and cameras.bin, and the poses of images.txt and images.bin in the same folder.

COLMAP puts pixel centres at 0.5. Its poses are camera from world, as in camtorch.
"""

import codecs
import os
import re
import struct
from array import array
from collections.abc import Callable, Iterable, Iterator
from typing import Any, BinaryIO

import numpy as np

from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.nerfstudio import panorama
from camtorch.io.parsing import check_ordinary, decoded
from camtorch.io.record import Names, Record
from camtorch.io.writing import Lossy, number

NAMES = Names("colmap", "COLMAP", (".txt", ".bin"), ("*.txt", "*.bin"), ("cameras.bin", "cameras.txt"))

# model -> id, key, number of focal lengths, number of coefficients; smaller models come first
_MODELS = {
    "SIMPLE_PINHOLE": (0, "pinhole", 1, 0),
    "PINHOLE": (1, "pinhole", 2, 0),
    "SIMPLE_RADIAL": (2, "brown_conrady", 1, 1),
    "RADIAL": (3, "brown_conrady", 1, 2),
    "OPENCV": (4, "brown_conrady", 2, 4),
    "FULL_OPENCV": (6, "brown_conrady", 2, 8),
    "FOV": (7, "fov", 2, 1),
    "SIMPLE_FISHEYE": (14, "kannala_brandt", 1, 0),
    "FISHEYE": (15, "kannala_brandt", 2, 0),
    "SIMPLE_RADIAL_FISHEYE": (8, "kannala_brandt", 1, 1),
    "RADIAL_FISHEYE": (9, "kannala_brandt", 1, 2),
    "OPENCV_FISHEYE": (5, "kannala_brandt", 2, 4),
    "THIN_PRISM_FISHEYE": (10, "thin_prism_fisheye", 2, 8),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, "fisheye624", 2, 12),
    "SIMPLE_DIVISION": (12, "division", 1, 1),
    "DIVISION": (13, "division", 2, 1),
    "EUCM": (16, "eucm", 2, 2),
    "EQUIRECTANGULAR": (17, "equirectangular", 0, 0),
}
# number of coefficients of the camera if a model leaves some of them out
_COUNTS = {"SIMPLE_RADIAL": 4, "RADIAL": 4, "SIMPLE_FISHEYE": 1, "FISHEYE": 1}
_IDS = {values[0]: name for name, values in _MODELS.items()}
_MOST_WORDS = 32
_LINE = re.compile(rb"^[^\S\n]*([^\s#][^\n]*)", re.MULTILINE)  # skips comments
_CAMERA = re.compile(rb"\d+\s+[A-Z][A-Z0-9_]*\s+\d+\s+\d+(?:\s|$)")

_CAMERAS = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: {}
"""
_IMAGES = """\
# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
# Number of images: {}, mean observations per image: 0
"""
_HEAD = struct.Struct("<I7dI")
_POINT = 24  # x, y and the id of a 3D point
_LONGEST_NAME = 4096
_LONGEST_LINE = 1 << 26
_LARGEST_ID = (1 << 32) - 2  # of cameras; the next integer means no camera


def matches(path: str, content: bytes) -> bool:
    """Whether a content is that of a cameras.bin, or of a cameras.txt, by its first line without #."""
    first = _LINE.search(content)
    return _is_binary(path, content) or (first is not None and _CAMERA.match(first[1]) is not None)


def _is_binary(path: str, content: bytes) -> bool:
    return path.endswith(".bin") or content[3:8] == bytes(5)  # as of a number of cameras in eight bytes


def read(path: str, content: bytes) -> Rig:
    """Return the cameras by their ids, and the poses of the images in the same folder by the names of the images."""
    cameras: dict[str, Camera] = {}
    entries = _from_bytes(path, content) if _is_binary(path, content) else _from_text(path, content)
    for record, identity, name, size, values in entries:
        _, key, focals, _ = _MODELS[name]
        if str(identity) in cameras:
            record.fail(f"camera ids must be unique; got {identity} twice")
        record.few(len(cameras))
        if len(values) != _parameters(name):
            record.fail(f"{name} must have {_parameters(name)} parameters; got {len(values)}")
        if key == "equirectangular":
            if values != [size[1], size[0]]:
                record.fail(f"a panorama must be as large as its image, {size[1]} x {size[0]}; got {values}")
            intrinsics, distortion = panorama(size), []
        else:
            cx, cy, *distortion = values[focals:]
            intrinsics = [values[0], values[focals - 1], cx - 0.5, cy - 0.5]
            distortion += [0.0] * (_COUNTS.get(name, 0) - len(distortion))
        cameras[str(identity)] = record.camera(key, intrinsics, distortion, size)
    beside = _images_beside(path)
    if beside is None or not os.path.exists(beside):
        return Rig(cameras)
    images, rows, _, place = _read_images(beside)
    for row, camera in enumerate(images.values()):
        if camera not in cameras:
            place(row).fail(f"its camera must be in {os.path.basename(path)}; got {camera}")
    if not images:
        return Rig(cameras)
    return Rig(cameras, (list(images), poses.from_quaternions(place, rows)), images=images)


def _images_beside(path: str) -> str | None:
    """Return the path of the poses that belong to a file named cameras.txt or cameras.bin; None for other names."""
    folder, name = os.path.split(path)
    stem, suffix = os.path.splitext(name)
    return os.path.join(folder, f"images{suffix}") if stem == "cameras" else None


_Entry = tuple[Record, int, str, tuple[int, int], list[float]]  # place, id, model, size and parameters of a camera


def _from_text(path: str, content: bytes) -> Iterator[_Entry]:
    number, position = 1, 0
    for line in _LINE.finditer(content):
        number, position = number + content.count(b"\n", position, line.start()), line.start()
        words = decoded(path, line[1]).split(maxsplit=_MOST_WORDS)
        record = Record(path, words, f"line {number}")
        if len(words) < 4:
            record.fail(f"must be an id, a model, a width, a height and numbers; got {len(words)} words")
        first, name, width, height, *values = record
        if name.value not in _MODELS:
            name.fail(f"the model must be one of {', '.join(_MODELS)}; got {name.value!r:.60}")
        size = height.side(), width.side()
        identity = first.whole(0, _LARGEST_ID, "camera id")
        yield record, identity, name.value, size, [value.number() for value in values]


def _from_bytes(path: str, content: bytes) -> Iterator[_Entry]:
    record, position = Record(path, None, "byte 0"), 0

    def take(layout: str) -> tuple[Any, ...]:
        nonlocal position
        record.place, position = f"byte {position}", position + struct.calcsize(layout)
        if position > len(content):
            record.fail(f"must have {position - len(content)} bytes more; got the end of the file")
        return struct.unpack_from(layout, content, position - struct.calcsize(layout))

    (count,) = take("<Q")
    if count > len(content) // 24:
        record.fail(f"must have as many cameras as the file has room for; got {count}")
    for _ in range(count):
        identity, model, width, height = take("<IiQQ")
        name = _IDS.get(model) or record.fail(f"the model must be one of {sorted(_IDS)}; got {model}")
        if identity > _LARGEST_ID:
            record.fail(f"must be a camera id; got {identity}")
        size = Record(path, [str(width), str(height)], record.place).size()
        parameters = list(take(f"<{_parameters(name)}d"))
        yield record, identity, name, size, Record(path, parameters, record.place).numbers()
    if position < len(content):
        rest = f"must end after the last camera; got {len(content) - position} bytes more"
        Record(path, None, f"byte {position}").fail(rest)


def _parameters(name: str) -> int:
    _, _, focals, count = _MODELS[name]
    return focals + 2 + count


def _read_images(path: str) -> tuple[dict[str, str], np.ndarray, bool, Callable[[int], Record]]:
    """Return camera ids by image name, poses (N, 7), whether images have points, and the function from row to place."""
    check_ordinary(path)
    unit, entries = ("byte", _images_from_bytes) if path.endswith(".bin") else ("line", _images_from_text)
    images: dict[str, str] = {}
    values, places, has_points = array("d"), array("q"), False

    def record(row: int) -> Record:
        return Record(path, None, f"{unit} {places[row]}")

    with open(path, "rb", buffering=1 << 16) as file:
        for place, pose, camera, name, with_points in entries(path, file):
            places.append(place)
            if name in images:
                record(-1).fail(f"names of images must be unique; got {name!r:.60} twice")
            images[name] = camera
            values.extend(pose)
            has_points = has_points or with_points
    return images, np.array(values).reshape(-1, 7), has_points, record


_ImageEntry = tuple[int, Iterable[float], str, str, bool]  # place, pose, id of the camera, name, whether it has points


def _images_from_text(path: str, file: BinaryIO) -> Iterator[_ImageEntry]:
    number = 0
    if file.read(len(codecs.BOM_UTF8)) != codecs.BOM_UTF8:  # some editors write this mark
        file.seek(0)
    while line := file.readline(_LONGEST_LINE):
        number += 1
        record = Record(path, None, f"line {number}")
        words = line.split(None, 9)
        if not words or words[0].startswith(b"#"):
            continue
        if len(words) < 10:
            _text(record, line)
            record.fail(f"must be IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; got {len(words)} words")
        try:
            pose, camera = list(map(float, words[1:8])), int(words[8])
        except ValueError:
            record.fail(f"an image must have seven numbers and a camera id; got {words[1:9]!r:.100}")
        name = _text(record, words[9].strip())
        points = file.readline(_LONGEST_LINE)  # of the image; the line may be empty
        yield number, pose, str(camera), name, not (points.isspace() or not points)
        number += 1


def _text(record: Record, content: bytes) -> str:
    if len(content) > _LONGEST_NAME:
        record.fail(f"the name of an image must be at most {_LONGEST_NAME} bytes; got more")
    try:
        return content.decode()
    except UnicodeDecodeError:
        record.fail("must be text; got other bytes")


def _images_from_bytes(path: str, file: BinaryIO) -> Iterator[_ImageEntry]:
    size = os.fstat(file.fileno()).st_size
    (count,) = struct.unpack("<Q", file.read(8).ljust(8, b"\0"))
    if size < 8 or count > (size - 8) // (_HEAD.size + 9):
        Record(path, None, "byte 0").fail(f"must have as many images as the file has room for; got {count}")
    position = 8
    for _ in range(count):
        record = Record(path, None, f"byte {position}")
        file.seek(position)
        block = file.read(_HEAD.size + _LONGEST_NAME + 9)
        end = block.find(b"\0", _HEAD.size)
        if end + 9 > len(block) or (end < 0 and len(block) < _HEAD.size + _LONGEST_NAME):
            record.fail("must be a whole image; got the end of the file")
        name = _text(record, block[_HEAD.size : end] if end > 0 else block)
        _, *pose, camera = _HEAD.unpack_from(block)
        (points,) = struct.unpack_from("<Q", block, end + 1)
        if position + end + 9 + points * _POINT > size:
            record.fail(f"must have as many points as the file has room for; got {points}")
        yield position, pose, str(camera), name, points > 0
        position += end + 9 + points * _POINT
    if position < size:
        Record(path, None, f"byte {position}").fail(f"must end after the last image; got {size - position} bytes more")


def render(rig: Rig, lossy: Lossy) -> dict[str, bytes]:
    """Return the files of a rig by path: cameras in the smallest models that hold them, and images if it has poses."""
    ids = [int(name) if re.fullmatch(r"0|[1-9]\d{0,9}", name) else -1 for name in rig.cameras]
    if not all(0 <= i <= _LARGEST_ID for i in ids):
        ids = list(range(1, len(ids) + 1))
    identities = dict(zip(rig.cameras, ids, strict=True))
    path = lossy.path
    if not path.endswith(NAMES.suffixes):  # a folder that does not exist yet
        path = os.path.join(path, "cameras.txt")
    binary = path.endswith(".bin")
    blocks = [struct.pack("<Q", len(ids)) if binary else _CAMERAS.format(len(ids)).encode()]
    for name, camera in rig.cameras.items():
        height, width = lossy.size(name, camera)
        model, values = _smallest(lossy, name, camera)
        if binary:
            layout = f"<IiQQ{len(values)}d"
            blocks.append(struct.pack(layout, identities[name], _MODELS[model][0], width, height, *values))
        else:
            line = f"{identities[name]} {model} {width} {height} {' '.join(map(number, values))}\n"
            blocks.append(line.encode())
    contents = {path: b"".join(blocks)}
    beside = _images_beside(path)
    suffix = os.path.splitext(path)[1]
    if rig.extrinsics:
        if beside is None:
            way = f"Call the file cameras{suffix}, or name a folder"
            lossy.fail("extrinsics", f"must be in images{suffix} next to cameras{suffix}; got another name. {way}")
        contents[beside] = _images_content(lossy, rig, identities, beside, binary)
        # COLMAP opens a folder only if it has a file of points
        points = os.path.join(os.path.dirname(path), f"points3D{suffix}")
        if not os.path.exists(points):
            contents[points] = struct.pack("<Q", 0) if binary else b"# Number of points: 0\n"
    elif beside is not None and os.path.exists(beside):
        lossy.fail("extrinsics", f"must be given, as {beside} has poses of images; got none")
    return contents


def _smallest(lossy: Lossy, name: str, camera: Camera) -> tuple[str, list[float]]:
    """Return the smallest model that holds a camera's values and number of coefficients, and its parameters."""
    key, (fx, fy, cx, cy), distortion = lossy.model(name, camera, {values[1] for values in _MODELS.values()})
    if key == "equirectangular":
        height, width = lossy.size(name, camera)
        if [fx, fy, cx, cy] != panorama((height, width)):
            lossy.fail(name, "must be a whole sphere for COLMAP; got a part of a panorama")
        return "EQUIRECTANGULAR", [float(width), float(height)]
    fitting = [
        (len(distortion) != _COUNTS.get(model, count), _parameters(model), model, count)
        for model, (_, k, focals, count) in _MODELS.items()
        if k == key and (focals == 2 or fx == fy) and not any(distortion[count:])
    ]
    if not fitting:
        lossy.at_most(name, camera, distortion, (max(count for _, k, _, count in _MODELS.values() if k == key),))
        lossy.fail(name, f"must have one focal length for COLMAP's model; got fx = {fx!r} and fy = {fy!r}")
    _, _, model, count = min(fitting)
    values = (distortion + [0.0] * count)[:count]
    return model, [*(fx, fy)[: _MODELS[model][2]], cx + 0.5, cy + 0.5, *values]


def _images_content(lossy: Lossy, rig: Rig, identities: dict[str, int], path: str, binary: bool) -> bytes:
    """Return the file of a rig's poses; refuse to overwrite a file with points."""
    count = len(rig.extrinsics)
    blocks = [struct.pack("<Q", count) if binary else _IMAGES.format(count).encode()]
    rows = poses.quaternions(poses.all_of(rig, lossy)).tolist()
    for i, (name, values) in enumerate(zip(rig.extrinsics, rows, strict=True), 1):
        if not name or "\0" in name or (not binary and (name.split() != [name])):
            hint = "" if binary else ". Write .bin, which holds it"
            lossy.fail(repr(name), f"must be a name that COLMAP reads; got another{hint}")
        camera = identities[rig.images.get(name, name)]
        if binary:  # names end with a zero byte, and the number of points is 0
            blocks.append(_HEAD.pack(i, *values, camera) + name.encode() + bytes(9))
        else:
            blocks.append(f"{i} {' '.join(map(number, values))} {camera} {name}\n\n".encode())
    if os.path.exists(path) and _read_images(path)[2]:
        Record(path, None).fail("must hold no points, which would be lost; got some. Write to another folder")
    folder, suffix = os.path.dirname(path), os.path.splitext(path)[1]
    for name in ("rigs", "frames"):
        if os.path.exists(os.path.join(folder, name + suffix)):
            lossy.fail("extrinsics", f"must agree with {name}{suffix} there; got others. Write to another folder")
    return b"".join(blocks)
