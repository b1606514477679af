"""Label files of data sets as samples: COCO's keypoints, WFLW, 300W, 300W-LP, and OpenLABEL as the DMD has it."""

import functools
import json
import operator
import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import Dataset

from camtorch.augment.fields import KINDS
from camtorch.augment.landmarks import LANDMARKS, TableLike
from camtorch.augment.sample import Sample
from camtorch.cameras.camera import Camera
from camtorch.data.columns import camera_of
from camtorch.io.photographs import load_stored
from camtorch.models import BrownConrady, Pinhole
from camtorch.poses.rotations import rotation_matrix
from camtorch.values.arguments import LEFT, as_image_size, check_path, imported

Json = dict[str, Any]
Opened = tuple[Sequence[Any], TableLike | None]  # an entry for each sample, and the table of mirrored landmarks

_SUFFIXES = (".jpg", ".png", ".jpeg", ".bmp", ".JPG", ".PNG")
_UP = 3  # folders above the labels in which images are searched
_UNLIKE = TypeError, KeyError, AttributeError, IndexError  # errors of reading JSON of another kind


class Samples(Dataset[Sample]):
    """Samples of a file or a folder of labels, read on access, as returned by `ct.data.read`.

    `len(samples)`, `samples[i]` (from the end for negative i), and iteration; a data set of torch, so that
    `DataLoader`, `Subset` and `ConcatDataset` take it. No file stays open.
    """

    path: Path
    format: str
    images: Path | None
    """The folder of the images; None: it is searched, see `ct.data.read`."""
    landmarks: TableLike | None
    """The table of keypoints that change places in a mirror, for `landmarks=` of augmentations. None: unknown."""

    def __init__(self, path: Path, format: str, images: Path | None):
        self.path, self.format, self.images = path, format, images
        opened, self._sample = _FORMATS[format]
        self._entries, self.landmarks = opened(path)

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, index: int) -> Sample:
        sample = self._sample(self, self._entries[operator.index(index)])
        path = sample.get("path")
        if path:
            sample |= {"image": _image_at(path), "path": str(path)}
        return sample

    def __iter__(self) -> Iterator[Sample]:
        return map(self.__getitem__, range(len(self)))

    def __repr__(self) -> str:
        return f"<{len(self)} samples of {self.format} in {str(self.path)!r}>"


def _coco(path: Path) -> Opened:
    content = _json(path)
    with _failing_at(path, "not as COCO has it: ", *_UNLIKE):
        images = {one["id"]: one for one in content["images"]}
        entries = [
            (i, images.get(one.get("image_id")), {name: v for name, v in one.items() if name != "segmentation"})
            for i, one in enumerate(content["annotations"])
        ]
        names = next((one["keypoints"] for one in content.get("categories", ()) if one.get("keypoints")), ())
        known = [name for name, table in LANDMARKS.items() if len(table) == len(names)]
        mirrored = [name.replace("left", "right") for name in names]
        pairs = [(i, names.index(other)) for i, other in enumerate(mirrored) if other in names and other != names[i]]
        return entries, known[0] if known else pairs or None


def _coco_sample(samples: Samples, entry: tuple[int, Json | None, Json]) -> Sample:
    number, image, one = entry
    place = f"{samples.path}, annotations[{number}]"
    if image is None:
        raise ValueError(f"{place}: image_id must be that of an image; got {one.get('image_id')!r:.60}")
    with _failing_at(place, "not as COCO has it: ", *_UNLIKE):
        stem = samples.path.stem  # such as person_keypoints_train2017
        year = stem.rpartition("_")[2]
        path = _find(samples, place, image["file_name"], ("images", stem, year, f"images/{year}"))
        fields = [name for name in KINDS if name != "keypoints" and one.get(name)]
        sample: Sample = {name: _numbers(one[name], place, name) for name in fields}
        if one.get("keypoints"):
            rows = _numbers(one["keypoints"], place, "keypoints", -1, 3)
            sample |= {"keypoints": rows[:, :2].clone(), "keypoints_valid": rows[:, 2] > 0}
        if one.get("bbox"):
            corner, size = _numbers(one["bbox"], place, "bbox", 1, 4).split(2, 1)
            sample["boxes"] = torch.cat((corner, corner + size), 1) - 0.5
        if image.get("camera") is not None:
            with _failing_at(f"{place}, the image's camera", "", ValueError):
                sample["camera"] = camera_of(image["camera"], "camera")
        return {**sample, "path": path, "category_id": one.get("category_id", -1)}


def _wflw(path: Path) -> Opened:
    lines = enumerate(path.read_bytes().split(b"\n"), 1)
    return [(f"line {i}", line) for i, line in lines if line.strip()], "wflw98"


def _wflw_sample(samples: Samples, entry: tuple[str, bytes]) -> Sample:
    place = f"{samples.path}, {entry[0]}"
    words = _text(entry[1], place).strip().split(maxsplit=206)
    if len(words) not in (197, 207):
        what = "must be 207 words, 98 points, a box, six attributes and the name of an image"
        raise ValueError(f"{place}: {what}, or 197 without box and attributes; got {len(words)}")
    sample: Sample = {"keypoints": _numbers(words[:196], place, "points", 98, 2)}
    if len(words) == 207:
        if not set(words[200:206]) <= {"0", "1"}:
            raise ValueError(f"{place}: attributes must be 0 or 1; got {' '.join(words[200:206])}")
        sample["boxes"] = _numbers(words[196:200], place, "a box", 1, 4)
        names = "pose", "expression", "illumination", "make_up", "occlusion", "blur"
        sample["attributes"] = dict(zip(names, map(int, words[200:206]), strict=True))
    return {**sample, "path": _find(samples, place, words[-1], ("WFLW_images", "images"))}


def _files(suffix: str, path: Path) -> Opened:
    files = [path] if path.is_file() else sorted(one for one in path.rglob("*") if one.suffix.lower() == suffix)
    if not files:
        raise ValueError(f"{path}: the folder must hold a {suffix} file, at any depth; got none")
    return files, "ibug68"


def _pts_sample(samples: Samples, path: Path) -> Sample:
    head, begin, rest = _text(path.read_bytes(), path).partition("{")
    body, end, _ = rest.partition("}")
    if not begin or not all(":" in line for line in head.splitlines() if line.strip()):
        raise ValueError(f"{path}, line 1: must be version: 1, n_points: 68 and {{; got {head!r:.60}")
    lines = [(i, line) for i, line in enumerate(body.split("\n"), head.count("\n") + 1) if line.strip()]
    points = [_numbers(line.split(), f"{path}, line {i}", "a point", 2) for i, line in lines]
    if len(points) != 68 or not end:
        cut = "" if end else " and no }: the file is cut short"
        raise ValueError(f"{path}, line {lines[-1][0] if lines else 1}: must have 68 points; got {len(lines)}{cut}")
    return {"keypoints": torch.stack(points) - 1, "path": _find(samples, path, path.stem, (), _SUFFIXES)}


def _mat_sample(samples: Samples, path: Path) -> Sample:
    arrays = _matlab(path)
    shapes = {name: array.shape for name, array in arrays.items()}
    points = [arrays[name][:2].T for name in ("pt2d", "pt3d_68") if shapes.get(name, ())[1:] == (68,)]
    pose = arrays.get("Pose_Para", np.zeros(0)).ravel()
    if not points or pose.size != 7:
        raise ValueError(f"{path}: must hold pt2d (2, 68) or pt3d_68 (3, 68), and Pose_Para (1, 7); got {shapes}")
    # 3DDFA's matrix is Rx(-pitch) Ry(-yaw) Rz(-roll) in its own frame, y up and z out of the image
    pitch, yaw, roll = _numbers(pose[:3], path, "Pose_Para")
    x, y, z = torch.eye(3)
    head = torch.eye(4)
    head[:3, :3] = rotation_matrix(-pitch * x) @ rotation_matrix(yaw * y) @ rotation_matrix(roll * z)
    keypoints = _numbers(points[0], path, "points", 68, 2) - 1
    return {"keypoints": keypoints, "head_pose": head, "path": _find(samples, path, path.stem, (), _SUFFIXES)}


_MATRIX, _COMPRESSED, _LARGEST_FILE = 14, 15, 1 << 26  # bytes of a file; those of 300W-LP have some thousands
_TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}


def _matlab(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Return the arrays of numbers of a file of Matlab 5 to 7 by name. Source: MAT-File Format, The MathWorks.

    scipy is not used: its reader crashes the process for some damaged files.
    """
    with path.open("rb") as file:
        content = file.read(_LARGEST_FILE)
    if content[:6] != b"MATLAB" or content[126:128] != b"IM":
        raise ValueError(f"{path}: must be a file of Matlab 5 to 7, of save -v7; got {content[:20]!r}")
    found = {}
    with _failing_at(path, "not a whole file of Matlab: ", ValueError, struct.error, zlib.error):
        for kind, part in _elements(content[128:]):
            if kind == _COMPRESSED:
                kind, part = next(_elements(zlib.decompressobj().decompress(part, _LARGEST_FILE)), (0, b""))
            parts = list(_elements(part)) if kind == _MATRIX else []
            if len(parts) > 3 and parts[3][0] in _TYPES:  # flags, shape, name, numbers
                shape, numbers = np.frombuffer(parts[1][1], "<i4"), np.frombuffer(parts[3][1], _TYPES[parts[3][0]])
                found[parts[2][1].decode("latin-1")] = numbers.reshape(shape.tolist(), order="F")
    return found


def _elements(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the kind and the bytes of each element; small ones fit in eight bytes."""
    at = 0
    while at < len(content):
        kind, size = struct.unpack_from("<II", content, at)
        begin, after = at + 8, at + 8 + size + (0 if kind == _COMPRESSED else -size % 8)
        if kind >> 16:
            kind, size, begin, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if begin + size > len(content):
            raise ValueError(f"an element must have {size} bytes; got {len(content) - begin}")
        yield kind, content[begin : begin + size]
        at = after


def _vcd(path: Path) -> Opened:
    content = _json(path)
    with _failing_at(path, "not as OpenLABEL has it: ", ValueError, *_UNLIKE):
        root: Json = content.get("openlabel") or content["vcd"]
        cameras = {name: one for name, one in root.get("streams", {}).items() if one.get("type", "camera") == "camera"}
        properties = {name: one.get("stream_properties", {}) for name, one in cameras.items()}
        shifts = {name: one.get("sync", {}).get("frame_shift", 0) for name, one in properties.items()} or {"": 0}
        first = min(0, *shifts.values())
        return [
            (root, frame, name, cameras.get(name, {}).get("uri"), int(frame) - shift + first, properties.get(name, {}))
            for frame in sorted(root["frames"], key=int)
            for name, shift in shifts.items()
        ], None


def _vcd_sample(samples: Samples, entry: tuple[Json, str, str, str | None, int, Json]) -> Sample:
    root, frame, stream, uri, at, properties = entry
    place, sample = f"{samples.path}, frames.{frame}", Sample(frame=int(frame), stream=stream)
    with _failing_at(place, "not as OpenLABEL has it: ", *_UNLIKE):
        content = root["frames"][frame]
        if uri:
            away = Path(uri).anchor or ".." in Path(uri).parts
            path = _find(samples, place, Path(uri).name, ("" if away else str(Path(uri).parent),))
            image = _image_at(path) if path.suffix.lower() in _SUFFIXES else _video_frame(path, at)
            if image is not None:
                sample["image"] = image
        kinds = ("bbox", 4, "boxes", "box_names"), ("point2d", 2, "keypoints", "point_names")
        for kind, count, field, names in kinds:
            items = [
                (uid, item)
                for uid, one in content.get("objects", {}).items()
                for item in one.get("object_data", {}).get(kind, ())
                if item.get("coordinate_system", stream) == stream or not stream
            ]
            rows = [_numbers(item["val"], f"{place}.objects.{uid}", kind, 1, count) for uid, item in items]
            sample[field] = torch.cat([torch.zeros(0, count), *rows])
            sample[names] = [f"{root['objects'][uid]['type']}/{item.get('name', '')}" for uid, item in items]
        middle, size = sample["boxes"].split(2, 1)
        sample["boxes"] = torch.cat((middle - size / 2, middle + size / 2), 1)
        sample["actions"] = [root["actions"][uid]["type"] for uid in content.get("actions", {})]
    pinhole = properties.get("intrinsics_pinhole")
    if pinhole is not None:
        with _failing_at(f"{samples.path}, streams.{stream}.intrinsics_pinhole", "", ValueError, *_UNLIKE):
            sample["camera"] = _pinhole(**pinhole)
    return sample


def _pinhole(height_px: int, width_px: int, **lens: Any) -> Camera:
    """Return the camera of OpenLABEL's `intrinsics_pinhole`, or of VCD 4's, whose names include shapes."""
    matrix = lens["camera_matrix" if "camera_matrix" in lens else "camera_matrix_3x4"]
    distortion = lens.get("distortion_coeffs", lens.get("distortion_coeffs_1xN")) or None
    K = np.reshape(matrix, (3, 4))[:, :3].astype(np.float64)  # noqa: N806
    camera = (BrownConrady if distortion else Pinhole).from_matrix(K, distortion)
    camera.image_size = as_image_size((height_px, width_px), "intrinsics_pinhole")
    return camera.requires_grad_(False)


def _video_frame(path: Path, number: int) -> Tensor | None:
    """Return a frame of a video with a constant rate by its number from 0; None before the begin or after the end."""
    av = imported("av", f"{path}: videos need PyAV", "video")
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


def _find(
    samples: Samples, place: object, name: Any, folders: Sequence[str] = (), suffixes: Sequence[str] = ("",)
) -> Path:
    """Return the path of an image in `samples.images`, or next to its labels, also in `folders` there and higher up."""
    parts = PurePath(name if isinstance(name, str) and "\0" not in name else "")
    if parts.anchor or ".." in parts.parts or not parts.name:
        raise ValueError(f"{place}: file name must lie within the folder of images; got {name!r:.60}")
    labels = Path(place) if isinstance(place, Path) else samples.path
    roots = [labels.parent, *labels.resolve().parent.parents][: _UP + 1 if folders else 1]
    for root in [samples.images] if samples.images else roots:
        for folder in ("", *folders):
            for suffix in suffixes:
                file = f"{root / folder / parts}{suffix}"
                if os.path.isfile(file):  # False, too, for impossible names
                    return Path(file)
    where = f" or in {', '.join(map(repr, folders))} there or up to {_UP} folders above" if folders else ""
    ends = f" with one of {' '.join(suffixes[:4])}" if len(suffixes) > 1 else ""
    hint = "; got none there. Pass read(..., images=FOLDER)"
    raise ValueError(f"{place}: file {name!r:.200}{ends} must be in {samples.images or f'{roots[0]}{where}{hint}'}")


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


_FORMATS: dict[str, tuple[Callable[[Path], Opened], Callable[[Samples, Any], Sample]]] = {
    "coco": (_coco, _coco_sample),
    "wflw": (_wflw, _wflw_sample),
    "300w": (functools.partial(_files, ".pts"), _pts_sample),
    "300w_lp": (functools.partial(_files, ".mat"), _mat_sample),
    "vcd": (_vcd, _vcd_sample),
}
_OF_SUFFIX = {".pts": "300w", ".mat": "300w_lp", ".txt": "wflw"}


def read(
    path: str | os.PathLike[str], format: str | None = None, *, images: str | os.PathLike[str] | None = None
) -> Samples:
    """Return the samples of a data set's label files, each read on access.

        samples = ct.data.read("300W/01_Indoor")
        flip = ct.augment.HorizontalFlip(landmarks=samples.landmarks)
        sample = flip(samples[0])

    A sample is a dict as augmentations take it: `image` (3, H, W) uint8, or (1, H, W) if it is grey; float32 labels in
    pixels, the middle of the top-left one at (0, 0), in the format's own order; and the image's `path`. A sample is one
    face or one person; an image with two of them is in two samples.

    * `"coco"`, a .json of keypoints: `keypoints` (N, 2), of which `keypoints_valid` are labelled, and `boxes` (1, 4)
      x1, y1, x2, y2, half a pixel less than in COCO, which has them between the edges of pixels. Fields of a sample in
      an annotation, such as `gaze`, and an image's `camera`, as columns of `ct.data.to_columns`, are read too.
    * `"wflw"`, a list of WFLW, .txt: 98 `keypoints`, and `boxes` (1, 4) and `attributes` if the list has them.
    * `"300w"`, a .pts or a folder of such: 68 `keypoints`. The files count from (1, 1), as Matlab, as menpo takes them.
    * `"300w_lp"`, a .mat of 300W-LP or AFLW2000-3D, or a folder of such: 68 `keypoints`, of `pt2d` or else `pt3d_68`,
      which count from (1, 1), and `head_pose` (4, 4) from the pitch, yaw and roll of `Pose_Para`. It is 3DDFA's turn
      (Zhu et al., Face Alignment Across Large Poses, 2016) in the frame of a camera, Rx(-pitch) Ry(yaw) Rz(roll): the
      nose points along -z of it, up for a positive pitch, to the left of the image for a positive yaw. The fit has no
      distance: the translation is 0.
    * `"vcd"`, OpenLABEL 1.0 or VCD 4, .json, as in the Driver Monitoring Dataset, a sample for each `frame` and camera,
      `stream`: `boxes` (M, 4) and `box_names` of all objects' `bbox`; `keypoints` (N, 2) and `point_names` of their
      `point2d`, if their `coordinate_system` is this stream or is missing; `actions`, such as "gaze_zone/front";
      `camera`, from `intrinsics_pinhole`. `image` is the frame of the stream's video (by PyAV), by the DMD's
      `frame_shift`; there is none before the video begins, after its end, or without `uri`.

    Args:
        path: Path of a file or a folder.
        format: One of these. Default: chosen by the suffix, and for JSON by its beginning.
        images: Folder of the images. By default they are searched next to the labels, and those that labels name
            also in folders of the data set's names, there or up to three folders above.

    Returns:
        Samples: `len`, `[i]`, iteration; `samples.landmarks` is the table that a mirror needs.

    Raises:
        ValueError: If a format is unknown, or a file is not of it, cut short or in another encoding, also when a sample
            is read; the text names the file and the place. FileNotFoundError: If the path does not exist. ImportError:
            If PyAV is missing for videos, `pip install -e ".[video]"`.
    """
    check_path(path, "read")
    found, folder = Path(path), None if images is None else Path(images)
    if format is not None and format not in _FORMATS:
        raise ValueError(f"read: format must be one of {', '.join(_FORMATS)}; got {format!r}. {LEFT}")
    if not found.exists():
        raise FileNotFoundError(f"read: path must exist; got {str(found)!r}")
    if folder is not None and not folder.is_dir():
        raise FileNotFoundError(f"read: images must be a folder; got {str(images)!r}")
    name = _format_of(found) if format is None else format
    if found.is_dir() and name not in ("300w", "300w_lp"):
        raise ValueError(f"read: path must be a file for {name}; got the folder {str(found)!r}")
    return Samples(found, name, folder)


def _format_of(path: Path) -> str:
    """Return the only format that fits the suffixes, or the beginning of JSON."""
    suffixes = {one.suffix.lower() for one in path.rglob("*")} - {".txt"} if path.is_dir() else {path.suffix.lower()}
    names = sorted(_OF_SUFFIX[suffix] for suffix in suffixes & _OF_SUFFIX.keys())
    if path.is_file() and not names:
        with path.open("rb") as file:
            keys = re.findall(rb'"(openlabel|vcd|images|annotations)"\s*:', file.read(1 << 16))
        names = ["vcd" if keys[0] in (b"openlabel", b"vcd") else "coco"] if keys else []
    if len(names) != 1:
        seen = f"which seems to be of {' and '.join(names) or 'no known format'}"
        raise ValueError(f"read: format must be one of {', '.join(_FORMATS)} for {str(path)!r}, {seen}; got none")
    return names[0]
