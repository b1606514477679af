"""Annotations in JSON: keypoints in the format of COCO; OpenLABEL, and VCD before it, as the DMD has them."""

from __future__ import annotations

import importlib
import json
import mmap
import re
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.landmarks import LANDMARKS, TableLike
from camtorch.augment.sample import KINDS, Sample
from camtorch.camera import Camera
from camtorch.data.columns import camera_of
from camtorch.data.labelled import Samples, image_at, named_image, numbers_of, text_of
from camtorch.models import BrownConrady, Pinhole

Json = dict[str, Any]
_TOKEN = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*"|[][{}]', re.DOTALL)
_COCO = ("keypoints", "bbox")


class Coco(Samples):
    """COCO's keypoints: a sample for each annotation: a person, a face. Images without any have none.

    `keypoints` (N, 2), of which `keypoints_valid` are labelled, and `boxes` (1, 4): COCO has them between the edges of
    pixels, so half a pixel is taken off. Outlines are left out. What `camtorch augment --dataset` adds is
    read too: an image's `camera`, and an annotation's `gaze`, `head_pose` and other fields of a sample. The file is
    known by where its entries begin, 16 bytes for each, and is not kept.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        self._spans = _entries(path)
        for name in ("images", "annotations"):
            if name not in self._spans:
                raise ValueError(f'{path}: a list "{name}" was expected, with objects in it')
        ids = [self._entry("images", i)[0].get("id") for i in range(len(self._spans["images"]))]
        if not all(isinstance(one, int) for one in ids) and not all(isinstance(one, str) for one in ids):
            raise ValueError(f"{path}: images: all need an id, a number; got {ids[:3]!r:.60}")
        self._order = np.argsort(np.asarray(ids), kind="stable")
        self._ids = np.asarray(ids)[self._order]
        self._count = len(self._spans["annotations"])
        names = [
            self._entry("categories", i)[0].get("keypoints") for i in range(len(self._spans.get("categories", ())))
        ]
        self.landmarks = next((_table(some) for some in names if isinstance(some, list)), None)

    def _entry(self, name: str, i: int) -> tuple[Json, str]:
        """An entry of a list, and where it is."""
        start, end = self._spans[name][i].tolist()
        with self.path.open("rb") as file:
            file.seek(start)
            content = file.read(end - start)
        try:
            return json.loads(text_of(content, "")), f"{self.path}, {name}[{i}]"
        except (ValueError, RecursionError) as error:
            line = getattr(error, "lineno", 1) + _lines_before(self.path, start)
            raise ValueError(f"{self.path}, line {line}, {name}[{i}]: no JSON: {error}") from None

    def _sample(self, number: int) -> Sample:
        one, place = self._entry("annotations", number)
        try:
            return self._read(one, place)
        except ValueError as error:
            line = _lines_before(self.path, int(self._spans["annotations"][number, 0])) + 1
            raise ValueError(str(error).replace(f"{self.path}, ", f"{self.path}, line {line}, ", 1)) from None

    def _read(self, one: Json, place: str) -> Sample:
        key: Any = one.get("image_id")
        is_like = isinstance(key, str if self._ids.dtype.kind == "U" else int)
        at = int(np.searchsorted(self._ids, key)) if is_like else len(self._ids)
        if at == len(self._ids) or self._ids[at] != key:
            raise ValueError(f"{place}: no image has the id {key!r:.60}")
        entry, where = self._entry("images", int(self._order[at]))
        stem = self.path.stem
        folders = ("", "images", stem, stem.rpartition("_")[2], f"images/{stem.rpartition('_')[2]}")
        path = named_image(self.path, entry.get("file_name"), folders, where)
        sample: Sample = {"image": image_at(path)}
        for name in _COCO:
            step = 3 if name == "keypoints" else 4
            if one.get(name):
                numbers = numbers_of(one[name], place, name)
                if numbers.ndim != 1 or len(numbers) % step or (name == "bbox" and len(numbers) != step):
                    raise ValueError(
                        f"{place}: {name} must be a list of numbers, {step} for each; got {one[name]!r:.80}"
                    )
                sample[name] = numbers.reshape(-1, step)
        if "keypoints" in sample:
            rows = sample["keypoints"]
            sample |= {"keypoints": rows[:, :2].clone(), "keypoints_valid": rows[:, 2] > 0}
        if "bbox" in sample:
            corner, size = sample.pop("bbox").split(2, 1)
            sample["boxes"] = torch.cat((corner, corner + size), 1) - 0.5
        for name, value in one.items():
            if name in KINDS and name not in sample and value:
                sample[name] = numbers_of(value, place, name)
        if entry.get("camera") is not None:
            sample["camera"] = _stated(entry["camera"], where)
        return {**sample, "path": str(path), "category_id": one.get("category_id", -1)}


def _stated(parts: Any, place: str) -> Camera:
    try:
        return camera_of(parts, "camera")
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{place}: camera: {error}") from None


def _entries(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Where the objects in the lists of a file's object begin and end: name -> (n, 2) bytes."""
    spans: dict[str, array[int]] = {}
    depth, key, name, start = 0, b"", "", 0
    with path.open("rb") as file:
        if not path.stat().st_size:
            raise ValueError(f"{path}, line 1: the file is empty")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            for match in _TOKEN.finditer(data):
                token = match.group()
                if token in (b"{", b"["):
                    depth += 1
                    if depth == 2:
                        name = key[1:-1].decode(errors="replace") if token == b"[" else ""
                    elif depth == 3:
                        start = match.start()
                elif token in (b"}", b"]"):
                    depth -= 1
                    if depth == 2 and name and token == b"}":
                        spans.setdefault(name, array("q")).extend((start, match.end()))
                elif depth == 1:
                    key = token
    if depth:
        line = _lines_before(path, path.stat().st_size) + 1
        raise ValueError(f"{path}, line {line}: the file is cut short: {depth} brackets are open at its end")
    return {name: np.frombuffer(found, np.int64).reshape(-1, 2) for name, found in spans.items()}


def _lines_before(path: Path, offset: int) -> int:
    count = 0
    with path.open("rb") as file:
        while offset > 0 and (block := file.read(min(offset, 1 << 20))):
            count, offset = count + block.count(b"\n"), offset - len(block)
    return count


def _table(names: list[Any]) -> TableLike | None:
    """Of the names of keypoints, those with left and right in them; else the table that is known of as many."""
    places = {str(name).lower(): i for i, name in enumerate(names)}
    pairs = [(i, places[other]) for name, i in places.items() if (other := name.replace("left", "right")) in places]
    pairs = [(i, j) for i, j in pairs if i != j]
    known = [name for name, table in LANDMARKS.items() if len(table) == len(names)]
    return known[0] if known and not (pairs and known != ["coco17"]) else pairs or None


# -- OpenLABEL


class Vcd(Samples):
    """OpenLABEL 1.0 and VCD 4, as the Driver Monitoring Dataset has them: a sample for each frame of each camera.

    `boxes` (M, 4) of all objects' `bbox`, which are x and y of the middle, width and height, with `box_names`;
    `keypoints` (N, 2) of their `point2d`, in the file's order, with `point_names`: those whose `coordinate_system` is
    the camera's stream, or is not said. `actions`: the types of those in this frame, as "gaze_zone/front". `camera`:
    of a stream's `intrinsics_pinhole`. `frame` is the number in the file, `stream` the name of the camera.

    `image` is the frame of the stream's video (by PyAV, `camtorch[video]`), where the file says which and it is there
    by its path or its name: the DMD's `frame_shift` counts from the first frame of the camera that began first. A
    picture as `uri` is taken for all frames. A stream without `uri` has no image. The file is read at once.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        try:
            content = json.loads(text_of(path.read_bytes(), str(path)))
        except (json.JSONDecodeError, RecursionError) as error:
            raise ValueError(f"{path}, line {getattr(error, 'lineno', 1)}: no whole JSON: {error}") from None
        root = _object(content, "openlabel", str(path)) or _object(content, "vcd", str(path))
        self._root, self._place = root, str(path)
        frames = _object(root, "frames", self._place)
        if not frames or not all(re.fullmatch("[0-9]{1,15}", number) for number in frames):
            raise ValueError(
                f"{path}: frames by their numbers were expected, as OpenLABEL has them; got {list(frames)[:3]}"
            )
        self._frames = sorted(frames, key=int)
        streams = _object(root, "streams", self._place)
        self._streams = [name for name in streams if streams[name].get("type", "camera") == "camera"] or [""]
        self._count = len(self._frames) * len(self._streams)
        shifts = [self._properties(name).get("sync", {}).get("frame_shift", 0) for name in self._streams]
        self._first = min(0, *shifts, 0)

    def _properties(self, stream: str) -> Json:
        one = _object(_object(self._root, "streams", self._place), stream, self._place)
        return _object(one, "stream_properties", f"{self._place}, streams.{stream}")

    def _sample(self, number: int) -> Sample:
        frame, stream = self._frames[number // len(self._streams)], self._streams[number % len(self._streams)]
        place = f"{self._place}, frames.{frame}"
        content = _object(self._root["frames"], frame, place)
        sample: Sample = {"frame": int(frame), "stream": stream}
        uri = _object(_object(self._root, "streams", place), stream, place).get("uri")
        if uri:
            sync = self._properties(stream).get("sync", {})
            at = int(frame) - sync.get("frame_shift", 0) + self._first
            sample["image"] = self._image(uri, at, place)
        for kind, field, count in (("bbox", "box", 4), ("point2d", "point", 2)):
            found = list(self._geometry(content, kind, stream, place))
            if found:
                values = torch.stack([numbers_of(value, where, kind) for _, value, where in found])
                if values.shape[1:] != (count,):
                    raise ValueError(f"{found[0][2]}: {kind} must be {count} numbers; got {found[0][1]!r:.60}")
                sample["boxes" if count == 4 else "keypoints"] = _corners(values) if count == 4 else values
                sample[f"{field}_names"] = [name for name, *_ in found]
        actions = _object(self._root, "actions", place)
        sample["actions"] = [str(actions.get(uid, {}).get("type", "")) for uid in _object(content, "actions", place)]
        pinhole = self._properties(stream).get("intrinsics_pinhole") if stream else None
        if pinhole is not None:
            sample["camera"] = _pinhole(pinhole, f"{self._place}, streams.{stream}.intrinsics_pinhole")
        return sample

    def _geometry(self, content: Json, kind: str, stream: str, place: str) -> Iterator[tuple[str, Any, str]]:
        """Name, value and place of the boxes or points of a frame, of all objects."""
        known = _object(self._root, "objects", place)
        for uid, one in _object(content, "objects", place).items():
            where = f"{place}.objects.{uid}"
            whose = _object(known, uid, where).get("type", uid)
            for item in _object(one, "object_data", where).get(kind, ()):
                if not isinstance(item, Mapping) or "val" not in item:
                    raise ValueError(f"{where}: {kind} must be an object with a val; got {item!r:.60}")
                if item.get("coordinate_system", stream) in (stream, ""):
                    yield f"{whose}/{item.get('name', '')}", item["val"], where

    def _image(self, uri: str, at: int, place: str) -> Tensor:
        name = uri if not Path(uri).is_absolute() and ".." not in Path(uri).parts else Path(uri).name
        try:
            path = named_image(self.path, name, ("",), place)
        except ValueError:
            path = named_image(self.path, Path(name).name, ("",), place)
        return image_at(path) if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".bmp") else _video_frame(path, at)


def _object(parent: Any, name: str, place: str) -> Json:
    """An entry that is an object, or {} if there is none."""
    value = parent.get(name, {}) if isinstance(parent, Mapping) else parent
    if not isinstance(value, dict):
        raise ValueError(f"{place}: {name} must be an object; got {value!r:.60}")
    return value


def _corners(values: Tensor) -> Tensor:
    middle, size = values.split(2, 1)
    return torch.cat((middle - size / 2, middle + size / 2), 1)


def _pinhole(told: Any, place: str) -> Camera:
    try:
        K = np.reshape(told.get("camera_matrix", told.get("camera_matrix_3x4")), (3, 4))[:, :3]  # noqa: N806
        lens = told.get("distortion_coeffs", told.get("distortion_coeffs_1xN")) or None
        size = told["height_px"], told["width_px"]
        camera = (BrownConrady if lens else Pinhole).from_matrix(K.astype(np.float64), lens, image_size=size)
        return camera.requires_grad_(False)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{place}: {error}") from None


def _video_frame(path: Path, number: int) -> Tensor:
    """A frame of a video of a constant rate, by its number from 0."""
    try:
        av = importlib.import_module("av")
    except ImportError:
        raise ImportError(f'{path}: videos need PyAV: pip install "camtorch[video]"') from None
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            seconds = number / stream.average_rate
            container.seek(int(seconds / stream.time_base) + (stream.start_time or 0), stream=stream)
            for frame in container.decode(stream):
                if (frame.pts - (stream.start_time or 0)) * stream.time_base > seconds - 1 / (2 * stream.average_rate):
                    return torch.from_numpy(frame.to_ndarray(format="rgb24").transpose(2, 0, 1).copy())
    except (av.error.FFmpegError, IndexError, TypeError, ZeroDivisionError) as error:
        raise ValueError(f"{path}: not a whole video: {error}") from None
    raise ValueError(f"{path}: the video ends before frame {number}")
