"""Annotations in JSON: keypoints in the format of COCO; OpenLABEL, and VCD before it, as the DMD has them."""

from __future__ import annotations

import importlib
import json
import mmap
import re
from array import array
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.landmarks import LANDMARKS, TableLike
from camtorch.augment.sample import KINDS, Sample
from camtorch.camera import Camera
from camtorch.data.columns import camera_of
from camtorch.data.labelled import Samples, failing_at, image_at, named_image, numbers_of, text_of
from camtorch.models import BrownConrady, Pinhole

Json = dict[str, Any]
_STRING = rb'"[^"\\]*(?:\\.[^"\\]*)*"'
# a whole object without others in it, as most entries are; a string; a bracket
_TOKEN = re.compile(rb'\{[^{}"]*(?:%b[^{}"]*)*\}|%b|[][{}]' % (_STRING, _STRING), re.DOTALL)


class Coco(Samples):
    """COCO's keypoints: a sample for each annotation: a person, a face. Images without any have none.

    `keypoints` (N, 2), of which `keypoints_valid` are labelled, and `boxes` (1, 4): COCO has them between the edges of
    pixels, so half a pixel is taken off. Outlines are left out. What `camtorch augment --dataset` adds is read too: an
    image's `camera`, and an annotation's `gaze`, `head_pose` and other fields of a sample. The file is known by where
    its entries begin and end, 16 bytes for each, and is not kept.
    """

    landmarks: TableLike | None

    def __init__(self, path: Path):
        super().__init__(path)
        self._spans = _entries(path)
        for name in ("images", "annotations"):
            if name not in self._spans:
                raise ValueError(f'{path}: a list "{name}" was expected, with objects in it')
        with path.open("rb") as file:
            ids = [self._entry(file, "images", i)[0].get("id") for i in range(len(self._spans["images"]))]
            groups = [self._entry(file, "categories", i)[0] for i in range(len(self._spans.get("categories", ())))]
        if len({type(one) for one in ids}) > 1 or not isinstance(ids[0], (int, str)):
            raise ValueError(f"{path}: images: all need an id, a number; got {ids[:3]!r:.60}")
        self._order = np.argsort(np.asarray(ids), kind="stable")
        self._ids, self._kind = np.asarray(ids)[self._order], type(ids[0])
        self._count = len(self._spans["annotations"])
        self.landmarks = next((_table(one["keypoints"]) for one in groups if one.get("keypoints")), None)

    def _entry(self, file: BinaryIO, name: str, i: int) -> tuple[Json, _Place]:
        """An entry of a list, and where it is."""
        start, end = self._spans[name][i].tolist()
        place = _Place(self.path, f"{name}[{i}]", start)
        file.seek(start)
        content = text_of(file.read(end - start), place)
        with failing_at(place, "no JSON: ", ValueError, RecursionError):
            return json.loads(content), place

    def _sample(self, number: int) -> Sample:
        with self.path.open("rb") as file:
            return self._read(file, *self._entry(file, "annotations", number))

    def _read(self, file: BinaryIO, one: Json, place: _Place) -> Sample:
        key: Any = one.get("image_id")
        at = int(np.searchsorted(self._ids, key)) if type(key) is self._kind else len(self._ids)
        if at == len(self._ids) or self._ids[at] != key:
            raise ValueError(f"{place}: no image has the id {key!r:.60}")
        entry, where = self._entry(file, "images", int(self._order[at]))
        year = self.path.stem.rpartition("_")[2]  # of person_keypoints_train2017
        folders = ("", "images", self.path.stem, year, f"images/{year}")
        path = named_image(self, entry.get("file_name"), folders, where)
        sample: Sample = {"image": image_at(path)}
        for name, value in one.items():
            step = {"keypoints": 3, "bbox": 4}.get(name)
            if value and (step or name in KINDS):
                numbers = numbers_of(value, place, name)
                if step and (numbers.ndim != 1 or len(numbers) % step or (step == 4 and len(numbers) != 4)):
                    raise ValueError(f"{place}: {name} must be a list of numbers, {step} for each; got {value!r:.80}")
                sample[name] = numbers.reshape(-1, step) if step else numbers
        if "keypoints" in sample:
            rows = sample["keypoints"]
            sample |= {"keypoints": rows[:, :2].clone(), "keypoints_valid": rows[:, 2] > 0}
        if "bbox" in sample:
            corner, size = sample.pop("bbox").split(2, 1)
            sample["boxes"] = torch.cat((corner, corner + size), 1) - 0.5
        if entry.get("camera") is not None:
            with failing_at(where, "camera: ", ValueError, TypeError, KeyError, AttributeError):
                sample["camera"] = camera_of(entry["camera"], "camera")
        return {**sample, "path": str(path), "category_id": one.get("category_id", -1)}


class _Place:
    """Where in a file an entry is; its line is counted when an error names it."""

    def __init__(self, path: Path, name: str, offset: int):
        self._path, self._name, self._offset = path, name, offset

    def __str__(self) -> str:
        line, left = 1, self._offset
        with self._path.open("rb") as file:
            while left > 0 and (block := file.read(min(left, 1 << 20))):
                line, left = line + block.count(b"\n"), left - len(block)
        return f"{self._path}, line {line}{self._name and ', '}{self._name}"


def _entries(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Where the objects in the lists of a file's object begin and end: name -> (n, 2) bytes."""
    spans: dict[str, array[int]] = {}
    depth, key, name, start, size = 0, b"", "", 0, path.stat().st_size
    if not size:
        raise ValueError(f"{path}, line 1: the file is empty")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for match in _TOKEN.finditer(data):
            token = match.group()
            if token in (b"{", b"["):
                depth += 1
                if depth == 2:
                    name = key[1:-1].decode(errors="replace") if token == b"[" else ""
                elif depth == 3:
                    start = match.start()
            elif token[:1] == b'"':
                key = token if depth == 1 else key
            else:
                whole = token[:1] == b"{"
                depth -= not whole
                if depth == 2 and name and token[-1:] == b"}":
                    spans.setdefault(name, array("q")).extend((match.start() if whole else start, match.end()))
    if depth:
        raise ValueError(f"{_Place(path, '', size)}: the file is cut short: {depth} brackets are open at its end")
    return {name: np.frombuffer(found, np.int64).reshape(-1, 2) for name, found in spans.items()}


def _table(names: list[Any]) -> TableLike | None:
    """The table that is known of so many keypoints; else pairs of left and right in their names."""
    known = [name for name, table in LANDMARKS.items() if len(table) == len(names)]
    places = {str(name): i for i, name in enumerate(names)}
    sides = [(i, places.get(name.replace("left", "right"), i)) for name, i in places.items()]
    return known[0] if known else [(i, other) for i, other in sides if i != other] or None


# -- OpenLABEL


class Vcd(Samples):
    """OpenLABEL 1.0 and VCD 4, as the Driver Monitoring Dataset has them: a sample for each frame of each camera.

    `boxes` (M, 4) of all objects' `bbox`, which are x and y of the middle, width and height, with `box_names`;
    `keypoints` (N, 2) of their `point2d`, in the file's order, with `point_names`: those whose `coordinate_system` is
    the camera's stream, or is not said. `actions`: the types of those in this frame, as "gaze_zone/front". `camera`:
    of a stream's `intrinsics_pinhole`. `frame` is the number in the file, `stream` the name of the camera.

    `image` is the frame of the stream's video (by PyAV, `camtorch[video]`), which lies by its path or its name beside
    the file: the DMD's `frame_shift` counts from the first frame of the camera that began first. A sample has none
    where a video has not begun or has ended, and of a stream without `uri`. An image as `uri` is taken for all frames.
    The file is read at once.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        with failing_at(path, "no whole JSON: ", json.JSONDecodeError, RecursionError):
            content = json.loads(text_of(path.read_bytes(), path))
        with failing_at(path, "not as OpenLABEL has it: ", ValueError, TypeError, KeyError, AttributeError):
            self._root: Json = content.get("openlabel") or content["vcd"]
            self._frames = sorted(self._root["frames"], key=int)
            streams = self._root.get("streams", {})
            self._streams = [name for name, one in streams.items() if one.get("type", "camera") == "camera"] or [""]
            self._shifts = {
                name: self._properties(name).get("sync", {}).get("frame_shift", 0) for name in self._streams
            }
            self._first = min(0, *self._shifts.values(), 0)
        self._count = len(self._frames) * len(self._streams)

    def _properties(self, stream: str) -> Json:
        properties: Json = self._root.get("streams", {}).get(stream, {}).get("stream_properties", {})
        return properties

    def _sample(self, number: int) -> Sample:
        frame, stream = self._frames[number // len(self._streams)], self._streams[number % len(self._streams)]
        place = f"{self.path}, frames.{frame}"
        with failing_at(place, "not as OpenLABEL has it: ", TypeError, KeyError, AttributeError):
            return self._read(frame, stream, place)

    def _read(self, frame: str, stream: str, place: str) -> Sample:
        content, sample = self._root["frames"][frame], Sample(frame=int(frame), stream=stream)
        uri = self._root.get("streams", {}).get(stream, {}).get("uri")
        if uri:
            image = self._image(uri, int(frame) - self._shifts[stream] + self._first, place)
            sample |= {} if image is None else {"image": image}
        for kind, count in (("bbox", 4), ("point2d", 2)):
            names, values = [], []
            for uid, one in content.get("objects", {}).items():
                whose = self._root["objects"][uid]["type"]
                for item in one.get("object_data", {}).get(kind, ()):
                    if item.get("coordinate_system", stream) == stream or not stream:
                        names.append(f"{whose}/{item.get('name', '')}")
                        values.append(numbers_of(item["val"], f"{place}.objects.{uid}", kind))
                        if values[-1].shape != (count,):
                            raise ValueError(
                                f"{place}.objects.{uid}: {kind} must be {count} numbers; got {item['val']}"
                            )
            found = torch.stack(values) if values else torch.zeros(0, count)
            if kind == "bbox":
                middle, size = found.split(2, 1)
                sample |= {"boxes": torch.cat((middle - size / 2, middle + size / 2), 1), "box_names": names}
            else:
                sample |= {"keypoints": found, "point_names": names}
        sample["actions"] = [self._root["actions"][uid]["type"] for uid in content.get("actions", {})]
        pinhole = self._properties(stream).get("intrinsics_pinhole")
        if pinhole is not None:
            with failing_at(f"{self.path}, streams.{stream}.intrinsics_pinhole", "", ValueError, TypeError, KeyError):
                sample["camera"] = _pinhole(pinhole)
        return sample

    def _image(self, uri: str, at: int, place: str) -> Tensor | None:
        folder = "" if Path(uri).is_absolute() or ".." in Path(uri).parts else str(Path(uri).parent)
        path = named_image(self, Path(uri).name, ("", folder), place)
        return image_at(path) if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".bmp") else _video_frame(path, at)


def _pinhole(told: Json) -> Camera:
    K = np.reshape(told["camera_matrix" if "camera_matrix" in told else "camera_matrix_3x4"], (3, 4))[:, :3]  # noqa: N806
    lens = told.get("distortion_coeffs", told.get("distortion_coeffs_1xN")) or None
    size = told["height_px"], told["width_px"]
    camera = (BrownConrady if lens else Pinhole).from_matrix(K.astype(np.float64), lens, image_size=size)
    return camera.requires_grad_(False)


def _video_frame(path: Path, number: int) -> Tensor | None:
    """A frame of a video of a constant rate, by its number from 0; None if it has not begun, or has ended."""
    try:
        av = importlib.import_module("av")
    except ImportError:
        raise ImportError(f'{path}: videos need PyAV: pip install "camtorch[video]"') from None
    errors = av.error.FFmpegError, IndexError, TypeError, ZeroDivisionError
    with failing_at(path, "not a whole video: ", *errors), av.open(str(path)) as container:
        stream = container.streams.video[0]
        seconds, begin = number / stream.average_rate, stream.start_time or 0
        if number >= 0 and not (stream.frames and number >= stream.frames):
            container.seek(int(seconds / stream.time_base) + begin, stream=stream)
            for frame in container.decode(stream):
                if (frame.pts - begin) * stream.time_base > seconds - 1 / (2 * stream.average_rate):
                    return torch.from_numpy(frame.to_ndarray(format="rgb24").transpose(2, 0, 1).copy())
    return None
