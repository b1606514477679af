"""Agisoft Metashape's XML: a calibration, or sensors and posed cameras; pixel centres at 0.5, p1 and p2 exchanged."""

import re
from collections import Counter
from typing import Any
from xml.etree import ElementTree

import numpy as np

from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.io import poses
from camtorch.io.parsing import decoded, parse_xml
from camtorch.io.record import Names, Record, one_of

NAMES = Names("metashape", "Metashape")

_KIND = re.compile(rb"(?:<\?xml[^>]*>\s*)?<(?:calibration>|document\b.{,400}?<chunk\b)", re.S)
# type of a sensor, or projection of a calibration -> key, Metashape's names of its coefficients
_MODELS = {
    "frame": ("brown_conrady", ("k1", "k2", "p2", "p1", "k3")),
    "fisheye": ("thin_prism_fisheye", ("k1", "k2", "p2", "p1", "k3", "k4", "", "")),  # Metashape has no thin prism
}
_MODELS["equidistant_fisheye"] = _MODELS["fisheye"]  # its name from version 2.3 on
_UNKNOWN = ("b2", "k4", "p3", "p4")


def matches(path: str, content: bytes) -> bool:
    """Whether a content is that of a Metashape file."""
    return _KIND.match(content.lstrip()) is not None


def read(path: str, content: bytes) -> Rig:
    """Return the camera of a calibration; or the calibrated sensors by their labels, and the poses of their images."""
    root = parse_xml(path, decoded(path, content))
    if root.tag == "calibration":
        return Rig({"camera": _camera(Record(path, _values(root), "calibration"))})
    chunks = root.findall("chunk")
    if len(chunks) != 1:
        Record(path, None, "document").fail(f"must have one chunk; got {len(chunks)}. Export each to a file of its own")
    sensors = [sensor for sensor in chunks[0].iterfind("sensors/sensor") if sensor.find("calibration") is not None]
    Record(path, None, "sensors").few(len(sensors))
    names = _names(path, sensors)
    cameras = {}
    for sensor, name in zip(sensors, names, strict=True):
        if sensor.find("corrections/*") is not None:
            reason = "must have no corrections, as no model here has them; got some. Optimise without them"
            Record(path, None, f"sensor {name:.60}").fail(reason)
        found = sensor.findall("calibration")
        best = next((one for one in reversed(found) if one.get("class") == "adjusted"), found[-1])
        cameras[name] = _camera(Record(path, {"type": sensor.get("type"), **_members(best)}, f"sensor {name:.60}"))
    return _posed(path, chunks[0], cameras, dict(zip((sensor.get("id") for sensor in sensors), names, strict=True)))


def _values(element: ElementTree.Element) -> Any:
    """Return the text of an element, or its attributes and children by their names."""
    return (element.text or "").strip() or _members(element)


def _members(element: ElementTree.Element) -> dict[str, Any]:
    return {**element.attrib, **{child.tag: _values(child) for child in element}}


def _names(path: str, elements: list[ElementTree.Element]) -> list[str]:
    """Return the labels, with ids added to labels that are empty or not unique."""
    labels = Counter(element.get("label", "") for element in elements)
    names = []
    for element in elements:
        label, identity = element.get("label", ""), element.get("id", "")
        names.append(label if label and labels[label] == 1 else f"{label} {identity}".strip() or element.tag)
    if len(set(names)) < len(names):
        Record(path, None, elements[0].tag).fail("ids must be unique; got one twice")
    return names


def _camera(record: Record) -> Camera:
    key, names = _MODELS[one_of(record["type" if "type" in record else "projection"], _MODELS)]
    resolution = record.get("resolution")
    sides = record if resolution is None else resolution
    height, width = sides["height"].side(), sides["width"].side()
    value = {name: record[name].number() for name in record.keys() if re.fullmatch(r"c[xy]|[bkp]\d", name)}  # noqa: SIM118
    for name in _UNKNOWN:
        if value.get(name) and name not in names:
            record[name].fail(f"must be 0, as no model here has it; got {value[name]:g}. Optimise without it")
    f = record["f"].number()
    cx, cy = ((side - 1) / 2 + value.get(c, 0.0) for c, side in (("cx", width), ("cy", height)))
    distortion = [value.get(name, 0.0) for name in names]
    return record.camera(key, [f + value.get("b1", 0.0), f, cx, cy], distortion, (height, width))


def _numbers(record: Record, count: int) -> list[float]:
    return Record(record.path, record.text().split(), record.place).numbers(count)


def _world(path: str, owner: ElementTree.Element) -> tuple[Any, float, Any]:
    """Return rotation, scale and translation to the world of a chunk or a component."""
    transform = owner.find("transform")
    record = Record(path, {} if transform is None else _values(transform), f"{owner.tag}.transform")
    rotation = np.array(_numbers(record["rotation"], 9)).reshape(3, 3) if "rotation" in record else np.eye(3)
    scale = record["scale"].number() if "scale" in record else 1.0
    translation = np.array(_numbers(record["translation"], 3)) if "translation" in record else np.zeros(3)
    poses.check_near(record, [*translation, scale])
    return rotation, scale, translation


def _posed(path: str, chunk: ElementTree.Element, cameras: dict[str, Camera], sensors: dict[str | None, str]) -> Rig:
    """Return the rig of a chunk, without images that are not aligned or whose sensors are not calibrated."""
    whole = _world(path, chunk)
    parts = {part.get("id"): _world(path, part) for part in chunk.iterfind("components/component")}
    elements = [one for one in chunk.iterfind("cameras//camera") if one.find("transform") is not None]
    elements = [one for one in elements if one.get("sensor_id") in sensors]
    names = _names(path, elements)
    places = [Record(path, _values(one), f"camera {name:.60}") for one, name in zip(elements, names, strict=True)]
    images, rows = {}, []
    for name, place in zip(names, places, strict=True):
        images[name] = sensors[place["sensor_id"].text()]
        if name in cameras and name != images[name]:
            place.fail("must have another name than sensors; got a sensor's")
        row = np.array(_numbers(place["transform"], 16)).reshape(4, 4)
        poses.check_near(place, row)
        rotation, scale, translation = parts.get(place.value.get("component_id"), whole)
        rows.append(np.c_[rotation @ row[:3, :3], scale * rotation @ row[:3, 3] + translation])
    if not rows:
        return Rig(cameras)
    batch = poses.from_matrices(lambda i: places[i], np.array(rows), undo=True)
    return Rig(cameras, (names, batch), images={name: own for name, own in images.items() if name != own})
