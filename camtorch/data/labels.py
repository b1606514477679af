"""Label files of data sets as samples: COCO's keypoints, WFLW, 300W, 300W-LP, and OpenLABEL as the DMD has it."""

from __future__ import annotations

import importlib
import json
import operator
import os
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import Dataset

from camtorch._arguments import check_path
from camtorch._photographs import load_stored
from camtorch.augment.landmarks import LANDMARKS, TableLike
from camtorch.augment.sample import KINDS, Sample
from camtorch.camera import Camera
from camtorch.data.columns import camera_of
from camtorch.io.record import LEFT
from camtorch.models import BrownConrady, Pinhole
from camtorch.rotations import rotation_matrix

Json = dict[str, Any]
_SUFFIXES = (".jpg", ".png", ".jpeg", ".bmp", ".JPG", ".PNG")
_UP = 3  # folders above the labels in which images are looked for
_UNLIKE = TypeError, KeyError, AttributeError, IndexError  # what reading JSON of another kind raises


class Samples(Dataset[Sample]):
    """The samples of a file or a folder of labels, each made when it is asked for; what `ct.data.read` returns.

    `len(samples)`, `samples[i]` (from the end for negative i), and iteration; a data set of torch, so that
    `DataLoader`, `Subset` and `ConcatDataset` take it. No file stays open.
    """

    format: str
    path: Path
    images: Path | None
    """The folder of the images; None: it is looked for, see `ct.data.read`."""
    landmarks: TableLike | None = None
    """Of the keypoints, which change places in a mirror: for `landmarks=` of the augmentations. None: not known."""

    def __init__(self, path: Path, images: Path | None = None):
        self.path, self.images = path, images
        self._entries = self._open()

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, index: int) -> Sample:
        number = operator.index(index)
        if not -len(self) <= number < len(self):
            raise IndexError(f"{self.path}: sample {number} of {len(self)}")
        sample = self._sample(number % len(self))
        if (path := sample.get("path")) is not None:
            sample = {"image": _image_at(path), **sample, "path": str(path)}
        return sample

    def __iter__(self) -> Iterator[Sample]:
        return (self[i] for i in range(len(self)))

    def __repr__(self) -> str:
        return f"<{len(self)} samples of {self.format} in {str(self.path)!r}>"

    def _open(self) -> Sequence[Any]:
        """Return an entry for each sample."""
        raise NotImplementedError

    def _sample(self, number: int) -> Sample:
        """Return the labels of a sample, and the `path` of its image."""
        raise NotImplementedError

    def _beside(self, labels: Path) -> Path:
        """Return the image of the name of a file of labels."""
        named = [(self.images or labels.parent) / (labels.stem + suffix) for suffix in _SUFFIXES]
        if found := next(filter(Path.is_file, named), None):
            return found
        raise ValueError(
            f"{labels}: no image beside it; it would be {named[0]}, or end with {', '.join(_SUFFIXES[1:4])}"
        )

    def _named(self, name: Any, folders: Sequence[str], place: object) -> Path:
        """Return the file that labels name, in the folder of images, or these beside the labels or `_UP` above."""
        parts = PurePosixPath(name if isinstance(name, str) and "\0" not in name else "")
        if parts.is_absolute() or ".." in parts.parts or not parts.name:
            raise ValueError(f"{place}: the name of a file within the folder of images was expected; got {name!r:.60}")
        above = [self.path.parent, *self.path.resolve().parent.parents][: _UP + 1]
        for file in (root / folder / parts for root in ([self.images] if self.images else above) for folder in folders):
            if os.path.isfile(file):  # False, too, for names that no file can have
                return file
        where = f"in {self.images}" if self.images else f"beside the labels or up to {_UP} folders above, nor in "
        hint = "" if self.images else f"{', '.join(filter(None, folders))} there; read(..., images=FOLDER) says where"
        raise ValueError(f"{place}: no file {name!r:.200} {where}{hint}")


class Coco(Samples):
    """COCO's keypoints: a sample for each annotation: a person, a face. Images without any have none.

    `keypoints` (N, 2), of which `keypoints_valid` are labelled, and `boxes` (1, 4): COCO has them between the edges of
    pixels, so half a pixel is taken off. Outlines are left out. Fields of a sample in an annotation, as `gaze`, and a
    `camera` in an image, an object of `model`, `intrinsics`, `distortion` and `image_size`, are read if they are there.
    """

    format = "coco"

    def _open(self) -> list[Json]:
        content = _json(self.path)
        with _failing_at(self.path, "not as COCO has it: ", *_UNLIKE):
            self._images = {one["id"]: one for one in content["images"]}
            names = next((one["keypoints"] for one in content.get("categories", ()) if one.get("keypoints")), ())
            self.landmarks = _table([str(name) for name in names])
            return [{name: v for name, v in one.items() if name != "segmentation"} for one in content["annotations"]]

    def _sample(self, number: int) -> Sample:
        place, one = f"{self.path}, annotations[{number}]", self._entries[number]
        with _failing_at(place, "not as COCO has it: ", *_UNLIKE):
            image = self._images.get(one["image_id"])
            if image is None:
                raise ValueError(f"{place}: no image has the id {one['image_id']!r:.60}")
            year = self.path.stem.rpartition("_")[2]  # of person_keypoints_train2017
            path = self._named(image["file_name"], ("", "images", self.path.stem, year, f"images/{year}"), place)
            sample: Sample = {"path": path, "category_id": one.get("category_id", -1)}
            fields = [name for name in KINDS if name != "keypoints" and one.get(name)]
            sample |= {name: _numbers(one[name], place, name) for name in fields}
            if one.get("keypoints"):
                rows = _numbers(one["keypoints"], place, "keypoints", -1, 3)
                sample |= {"keypoints": rows[:, :2].clone(), "keypoints_valid": rows[:, 2] > 0}
            if one.get("bbox"):
                corner, size = _numbers(one["bbox"], place, "bbox", 1, 4).split(2, 1)
                sample["boxes"] = torch.cat((corner, corner + size), 1) - 0.5
            if image.get("camera") is not None:
                with _failing_at(f"{place}, the image's camera", "", ValueError):
                    sample["camera"] = camera_of(image["camera"], "camera")
            return sample


def _table(names: list[str]) -> TableLike | None:
    """Return the table that is known of so many keypoints; else pairs of left and right in their names."""
    known = [name for name, table in LANDMARKS.items() if len(table) == len(names)]
    pairs = [(names.index(one), i) for i, name in enumerate(names) if (one := name.replace("left", "right")) in names]
    return known[0] if known else [(i, other) for i, other in pairs if i != other] or None


_ATTRIBUTES = ("pose", "expression", "illumination", "make_up", "occlusion", "blur")


class Wflw(Samples):
    """WFLW: a line is a face: 98 points x y, the corners of a box, six attributes of 0 or 1, the image's name.

    The lists of its subsets, `list_98pt_test`, have the points and the name alone.
    """

    format, landmarks = "wflw", "wflw98"

    def _open(self) -> list[tuple[int, bytes]]:
        lines = enumerate(self.path.read_bytes().split(b"\n"), 1)
        return [(i, line) for i, line in lines if line.strip()]

    def _sample(self, number: int) -> Sample:
        i, line = self._entries[number]
        place = f"{self.path}, line {i}"
        words = _text(line, place).strip().split(maxsplit=206)
        if len(words) not in (197, 207):
            what = "98 points, a box, six attributes and the name of an image are 207 words"
            raise ValueError(f"{place}: {what}, or 197 without box and attributes; got {len(words)}")
        sample: Sample = {"keypoints": _numbers(words[:196], place, "points", 98, 2)}
        if len(words) == 207:
            if not set(words[200:206]) <= {"0", "1"}:
                raise ValueError(f"{place}: attributes must be 0 or 1; got {' '.join(words[200:206])}")
            sample["boxes"] = _numbers(words[196:200], place, "a box", 1, 4)
            sample["attributes"] = dict(zip(_ATTRIBUTES, map(int, words[200:206]), strict=True))
        return {**sample, "path": self._named(words[-1], ("", "WFLW_images", "images"), place)}


class Pts(Samples):
    """300W: 68 points in a .pts beside its image; the top-left pixel of the file is (1, 1), that of a sample (0, 0).

    That the files count from one, as Matlab, is what menpo takes them for too, a library of some of 300W's authors.
    """

    format, landmarks = "300w", "ibug68"

    def _open(self) -> list[Path]:
        return _files(self.path, ".pts")

    def _sample(self, number: int) -> Sample:
        path = self._entries[number]
        head, begin, rest = _text(path.read_bytes(), path).partition("{")
        body, end, _ = rest.partition("}")
        if not begin or not all(":" in line for line in head.splitlines() if line.strip()):
            raise ValueError(f"{path}, line 1: version: 1, n_points: 68 and {{ were expected; got {head!r:.60}")
        lines = [(i, line) for i, line in enumerate(body.split("\n"), head.count("\n") + 1) if line.strip()]
        points = [_numbers(line.split(), f"{path}, line {i}", "a point", 2) for i, line in lines]
        if len(points) != 68 or not end:
            cut = "" if end else " and no }: the file is cut short"
            raise ValueError(
                f"{path}, line {lines[-1][0] if lines else 1}: 68 points were expected; got {len(lines)}{cut}"
            )
        return {"keypoints": torch.stack(points) - 1, "path": self._beside(path)}


class Mat(Samples):
    """300W-LP and AFLW2000-3D: a .mat beside its image, with 68 points and the pose of the head.

    The points are `pt2d`, or `pt3d_68` where that holds no 68, as AFLW2000's, whose `pt2d` are 21 others. They count
    pixels from (1, 1), as Matlab; those of a sample from (0, 0).

    `Pose_Para` begins with pitch, yaw and roll in radians: R = Rx(-pitch) Ry(-yaw) Rz(-roll), by right-handed turns
    in 3DDFA's frame, x right, y up, z out of the image (Zhu et al., Face Alignment Across Large Poses, 2016; the order
    and the signs are those of the code of 3DDFA). `head_pose` (4, 4) is the same turn in the frame of a camera, and of
    a head that faces it, x right, y down, z away: Rx(-pitch) Ry(yaw) Rz(roll), so that the nose points along -z of
    it: up for a positive pitch, to the left of the image for a positive yaw. Angles of another order,
    Ry(yaw) Rx(-pitch) Rz(roll), differ where two of them are large. The fit is a scaled orthographic one, which knows
    no distance: the translation is 0, and there is no camera.
    """

    format, landmarks = "300w_lp", "ibug68"

    def _open(self) -> list[Path]:
        return _files(self.path, ".mat")

    def _sample(self, number: int) -> Sample:
        path = self._entries[number]
        arrays = _matlab(path)
        points = [array[:2].T for name in ("pt2d", "pt3d_68") if (array := arrays.get(name, _NONE)).shape[1:] == (68,)]
        pose, shapes = arrays.get("Pose_Para", _NONE).ravel(), {name: array.shape for name, array in arrays.items()}
        if not points or pose.size != 7:
            raise ValueError(
                f"{path}: pt2d (2, 68) or pt3d_68 (3, 68), and Pose_Para (1, 7) were expected; got {shapes}"
            )
        (pitch, yaw, roll), (x, y, z) = _numbers(pose[:3], path, "Pose_Para"), torch.eye(3)
        head = torch.eye(4)
        head[:3, :3] = rotation_matrix(-pitch * x) @ rotation_matrix(yaw * y) @ rotation_matrix(roll * z)
        keypoints = _numbers(points[0], path, "points", 68, 2) - 1
        return {"keypoints": keypoints, "head_pose": head, "path": self._beside(path)}


_NONE = np.zeros(0)
_MATRIX, _COMPRESSED, _LARGEST = 14, 15, 1 << 26  # bytes of a file; those of 300W-LP have some thousands
_TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}


def _matlab(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Return the arrays of numbers of a file of Matlab 5 to 7 by their names.

    Not by scipy, whose reader ends the process at some damaged files. Source: MAT-File Format, The MathWorks; elements
    of a kind and a number of bytes, the matrices among them compressed or not.
    """
    with path.open("rb") as file:
        content = file.read(_LARGEST)
    if content[:6] != b"MATLAB" or content[126:128] != b"IM":
        raise ValueError(f"{path}: a file of Matlab 5 to 7 was expected, of save -v7; it begins {content[:20]!r}")
    found = {}
    with _failing_at(path, "not a whole file of Matlab: ", ValueError, struct.error, zlib.error):
        for kind, part in _elements(content[128:]):
            if kind == _COMPRESSED:
                kind, part = next(_elements(zlib.decompressobj().decompress(part, _LARGEST)), (0, b""))
            parts = list(_elements(part)) if kind == _MATRIX else []
            if len(parts) > 3 and parts[3][0] in _TYPES:  # flags, shape, name, numbers
                shape, numbers = np.frombuffer(parts[1][1], "<i4"), np.frombuffer(parts[3][1], _TYPES[parts[3][0]])
                found[parts[2][1].decode("latin-1")] = numbers.reshape(shape.tolist(), order="F")
    return found


def _elements(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the kind and the bytes of each element, of which small ones lie within eight bytes."""
    at = 0
    while at < len(content):
        kind, size = struct.unpack_from("<II", content, at)
        begin, after = at + 8, at + 8 + size + (0 if kind == _COMPRESSED else -size % 8)
        if kind >> 16:
            kind, size, begin, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if begin + size > len(content):
            raise ValueError(f"{size} bytes were expected, and {len(content) - begin} are left")
        yield kind, content[begin : begin + size]
        at = after


class Vcd(Samples):
    """OpenLABEL 1.0 and VCD 4, as the Driver Monitoring Dataset has them: a sample for each frame of each camera.

    `boxes` (M, 4) of all objects' `bbox`, which are x and y of the middle, width and height, with `box_names`;
    `keypoints` (N, 2) of their `point2d`, in the file's order, with `point_names`: those whose `coordinate_system` is
    the camera's stream, or is not said. `actions`: the types of those in this frame, as "gaze_zone/front". `camera`:
    of a stream's `intrinsics_pinhole`. `frame` is the number in the file, `stream` the name of the camera.

    `image` is the frame of the stream's video (by PyAV, `camtorch[video]`), which lies by its path or its name beside
    the file: the DMD's `frame_shift` counts from the first frame of the camera that began first. A sample has none
    where a video has not begun or has ended, and of a stream without `uri`. An image as `uri` is taken for all frames.
    """

    format = "vcd"

    def _open(self) -> list[tuple[str, str]]:
        content = _json(self.path)
        with _failing_at(self.path, "not as OpenLABEL has it: ", ValueError, *_UNLIKE):
            self._root: Json = content.get("openlabel") or content["vcd"]
            self._streams: Json = self._root.get("streams", {})
            cameras = [name for name, one in self._streams.items() if one.get("type", "camera") == "camera"] or [""]
            self._shifts = {name: self._properties(name).get("sync", {}).get("frame_shift", 0) for name in cameras}
            return [(frame, name) for frame in sorted(self._root["frames"], key=int) for name in cameras]

    def _properties(self, stream: str) -> Json:
        properties: Json = self._streams.get(stream, {}).get("stream_properties", {})
        return properties

    def _sample(self, number: int) -> Sample:
        frame, stream = self._entries[number]
        place = f"{self.path}, frames.{frame}"
        with _failing_at(place, "not as OpenLABEL has it: ", *_UNLIKE):
            content, sample = self._root["frames"][frame], Sample(frame=int(frame), stream=stream)
            at = int(frame) - self._shifts[stream] + min(0, *self._shifts.values(), 0)
            if uri := self._streams.get(stream, {}).get("uri"):
                sample |= self._image(uri, at, place)
            found = {
                kind: self._numbers_of(kind, n, content, stream, place) for kind, n in (("bbox", 4), ("point2d", 2))
            }
            middle, size = found["bbox"][0].split(2, 1)
            sample |= {"boxes": torch.cat((middle - size / 2, middle + size / 2), 1), "box_names": found["bbox"][1]}
            sample["keypoints"], sample["point_names"] = found["point2d"]
            sample["actions"] = [self._root["actions"][uid]["type"] for uid in content.get("actions", {})]
        if (pinhole := self._properties(stream).get("intrinsics_pinhole")) is not None:
            with _failing_at(f"{self.path}, streams.{stream}.intrinsics_pinhole", "", ValueError, *_UNLIKE):
                sample["camera"] = _pinhole(**pinhole)
        return sample

    def _numbers_of(self, kind: str, n: int, frame: Json, stream: str, place: str) -> tuple[Tensor, list[str]]:
        """Return the numbers (N, n) and names of one kind of a frame's objects, as a camera sees them."""
        names, rows = [], [torch.zeros(0, n)]
        for uid, one in frame.get("objects", {}).items():
            for item in one.get("object_data", {}).get(kind, ()):
                if item.get("coordinate_system", stream) == stream or not stream:
                    names.append(f"{self._root['objects'][uid]['type']}/{item.get('name', '')}")
                    rows.append(_numbers(item["val"], f"{place}.objects.{uid}", kind, 1, n))
        return torch.cat(rows), names

    def _image(self, uri: str, at: int, place: str) -> Sample:
        folder = "" if Path(uri).is_absolute() or ".." in Path(uri).parts else str(Path(uri).parent)
        path = self._named(Path(uri).name, ("", folder), place)
        image = _image_at(path) if path.suffix.lower() in _SUFFIXES else _video_frame(path, at)
        return {} if image is None else {"image": image}


def _pinhole(height_px: int, width_px: int, **lens: Any) -> Camera:
    """Return the camera of OpenLABEL's `intrinsics_pinhole`, or of VCD 4's, which says the shapes in its names."""
    matrix = lens["camera_matrix" if "camera_matrix" in lens else "camera_matrix_3x4"]
    distortion = lens.get("distortion_coeffs", lens.get("distortion_coeffs_1xN")) or None
    K = np.reshape(matrix, (3, 4))[:, :3].astype(np.float64)  # noqa: N806
    camera = (BrownConrady if distortion else Pinhole).from_matrix(K, distortion, image_size=(height_px, width_px))
    return camera.requires_grad_(False)


def _video_frame(path: Path, number: int) -> Tensor | None:
    """Return a frame of a video of a constant rate, by its number from 0; None if it has not begun, or has ended."""
    try:
        av = importlib.import_module("av")
    except ImportError:
        raise ImportError(f'{path}: videos need PyAV: pip install "camtorch[video]"') from None
    errors = av.error.FFmpegError, IndexError, TypeError, ZeroDivisionError
    with _failing_at(path, "not a whole video: ", *errors), av.open(str(path)) as container:
        stream = container.streams.video[0]
        seconds, begin = number / stream.average_rate, stream.start_time or 0
        if number >= 0 and not (stream.frames and number >= stream.frames):
            container.seek(int(seconds / stream.time_base) + begin, stream=stream)
            for frame in container.decode(stream):
                if (frame.pts - begin) * stream.time_base > seconds - 1 / (2 * stream.average_rate):
                    return torch.from_numpy(frame.to_ndarray(format="rgb24").transpose(2, 0, 1).copy())
    return None


# -- what formats share


def _files(path: Path, suffix: str) -> list[Path]:
    """Return the file itself, or those of a suffix in a folder and beneath it."""
    files = [path] if path.is_file() else sorted(one for one in path.rglob("*") if one.suffix.lower() == suffix)
    if not files:
        raise ValueError(f"{path}: no {suffix} in this folder, nor beneath it")
    return files


def _image_at(path: Path) -> Tensor:
    """Return an image as it is stored: uint8 (3, H, W) RGB; grey ones (1, H, W) uint8, or uint16 if they are deep."""
    kinds = OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError
    with _failing_at(path, "", *kinds), Image.open(path) as opened:
        image = load_stored(opened)
        array = np.array(image if image.mode in ("L", "I;16") else image.convert("RGB"))
    return torch.from_numpy(array[None] if array.ndim == 2 else np.ascontiguousarray(array.transpose(2, 0, 1)))


def _json(path: Path) -> Any:
    with _failing_at(path, "no whole JSON: ", json.JSONDecodeError, RecursionError):
        return json.loads(_text(path.read_bytes(), path))


def _text(content: bytes, place: object) -> str:
    with _failing_at(place, "not text in UTF-8: ", UnicodeDecodeError):
        return content.decode("utf-8-sig")


@contextmanager
def _failing_at(place: object, what: str, *kinds: type[Exception]) -> Iterator[None]:
    """Raise a ValueError that names the place for errors of these kinds in the block."""
    try:
        yield
    except kinds as error:
        raise ValueError(f"{place}: {what}{error}") from None


def _numbers(values: Any, place: object, what: str, *shape: int) -> Tensor:
    """Return finite numbers as float32, of words or of JSON, in a shape if one is given."""
    try:
        array = np.asarray(values, np.float64)
        if any(isinstance(value, bool) for value in values) or not (np.abs(array) <= np.finfo(np.float32).max).all():
            raise ValueError
        return torch.from_numpy(array.reshape(shape or array.shape).astype(np.float32))
    except (TypeError, ValueError, OverflowError):
        wanted = "".join(f"{'N' if n < 0 else n} x " for n in shape).removesuffix("x ")
        raise ValueError(f"{place}: {what} must be {wanted}finite numbers; got {values!s:.80}") from None


_FORMATS: dict[str, type[Samples]] = {kind.format: kind for kind in (Coco, Wflw, Pts, Mat, Vcd)}
_OF_SUFFIX = {".pts": "300w", ".mat": "300w_lp"}


def read(
    path: str | os.PathLike[str], format: str | None = None, *, images: str | os.PathLike[str] | None = None
) -> Samples:
    """The samples of a data set's label files, each made as it is asked for.

        samples = ct.data.read("300W/01_Indoor")
        flip = ct.augment.HorizontalFlip(landmarks=samples.landmarks)
        sample = flip(samples[0])

    A sample is a dict as augmentations take it: `image` (3, H, W) uint8, or (1, H, W) if it is grey; float32 labels in
    pixels with the middle of the top-left one at (0, 0), in the format's own order; and `path`, of the image. A
    sample is one face or one person; an image with two of them is in two samples. In pixels are `keypoints` (N, 2) and
    `boxes` (M, 4) x1, y1, x2, y2.

    | format | path | fields |
    |---|---|---|
    | `"coco"` | .json of keypoints | keypoints, boxes, see `Coco` |
    | `"wflw"` | list of WFLW, .txt | 98 keypoints, boxes, attributes, see `Wflw` |
    | `"300w"` | .pts, or a folder of such | 68 keypoints, see `Pts` |
    | `"300w_lp"` | .mat of 300W-LP or AFLW2000-3D, or a folder | 68 keypoints, head_pose, see `Mat` |
    | `"vcd"` | OpenLABEL or VCD, .json, as the DMD | boxes, keypoints, actions, camera, see `Vcd` |

    Args:
        path: of a file or a folder.
        format: one of these; by default it is seen from suffixes and the first lines.
        images: the folder of the images. By default they are looked for beside the labels, and for `"coco"`, `"wflw"`
            and `"vcd"`, whose labels name them, in folders of the data set's names there or up to three folders above.

    Returns:
        Samples: `len`, `[i]`, iteration; `samples.landmarks` is the table that a mirror needs.

    Raises:
        ValueError: a file that is not of the format, cut short, or in another encoding, here or when a sample is asked
            for; the text names the file and the place. A format that is not known or not seen. FileNotFoundError: no
            such path. ImportError: videos need PyAV, `pip install "camtorch[video]"`.
    """
    check_path(path, "read")
    found, folder = Path(path), None if images is None else Path(images)
    if format is not None and format not in _FORMATS:
        raise ValueError(f"read: format must be one of {', '.join(_FORMATS)}; got {format!r}. {LEFT}")
    if not found.exists():
        raise FileNotFoundError(f"read: no file or folder {str(found)!r}")
    if folder is not None and not folder.is_dir():
        raise FileNotFoundError(f"read: no folder of images {str(images)!r}")
    name = _format_of(found) if format is None else format
    if found.is_dir() and name not in _OF_SUFFIX.values():
        raise ValueError(f"read: the labels of {name} are a file; {str(found)!r} is a folder")
    return _FORMATS[name](found, folder)


def _format_of(path: Path) -> str:
    """Return the one format that suffixes, or the beginning of a text, say."""
    files = path.rglob("*") if path.is_dir() else [path]
    names = sorted({_OF_SUFFIX[suffix] for one in files if (suffix := one.suffix.lower()) in _OF_SUFFIX})
    if path.is_file() and not names:
        with path.open("rb") as file:
            begin = file.read(1 << 16).removeprefix(b"\xef\xbb\xbf").lstrip()
        keys = re.findall(rb'"(openlabel|vcd|images|annotations)"\s*:', begin) if begin[:1] == b"{" else []
        names = ["vcd" if keys[0] in (b"openlabel", b"vcd") else "coco"] if keys else []
        names += ["wflw"] if len(begin.partition(b"\n")[0].split()) in (197, 207) else []
    if len(names) != 1:
        seen = f"seems to be of {' and '.join(names) or 'no known format'}"
        raise ValueError(f"read: {str(path)!r} {seen}; format= one of {', '.join(_FORMATS)} says which")
    return names[0]
