"""Landmarks of faces and bodies: which change places in a mirror, and where those of a face are on a head."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.change import gated
from camtorch.augment.fields import Named
from camtorch.values.arguments import as_flag, as_whole, first_time, one_of, shown, warn


def _order(count: int, *runs: tuple[int, int, int]) -> tuple[int, ...]:
    """Return an order with runs (first, last, total), in which i of first ... last and total - i change places."""
    order = list(range(count))
    for first, last, total in runs:
        for i in range(first, last + 1):
            order[i], order[total - i] = total - i, i
    return tuple(order)


# runs (first, last, step): landmark i of first ... last changes places with i + step
_MESH = [
    *((3, 3, 245), (7, 7, 242), (20, 93, 230), (95, 150, 229), (153, 163, 227), (165, 167, 226)),
    *((169, 174, 225), (176, 194, 224), (196, 196, 223), (198, 198, 222), (201, 247, 220)),
]
_MESHES = [(i, i, 2 * i + step) for first, last, step in _MESH for i in range(first, last + 1)]

LANDMARKS: dict[str, tuple[int, ...]] = {
    "ibug68": _order(
        68,
        *((0, 7, 16), (17, 21, 43), (31, 32, 66)),  # jaw, brows, nostrils
        *((36, 39, 81), (40, 41, 87)),  # upper and lower lids
        *((48, 50, 102), (55, 56, 114), (60, 61, 124), (65, 65, 132)),  # outer and inner lips
    ),
    "wflw98": _order(
        98,
        *((0, 15, 32), (33, 37, 79), (38, 41, 88), (55, 56, 114)),
        *((60, 64, 132), (65, 67, 140), (96, 96, 193)),  # lids, pupils
        *((76, 78, 158), (83, 84, 170), (88, 89, 180), (93, 93, 188)),
    ),
    "lapa106": _order(
        106,
        *((0, 15, 32), (33, 37, 79), (38, 41, 88), (55, 59, 120)),
        *((66, 70, 145), (71, 73, 153), (74, 74, 157), (104, 104, 209)),  # lids, their middles, pupils
        *((84, 86, 174), (91, 92, 186), (96, 97, 196), (101, 101, 204)),
    ),
    "coco17": _order(17, *((i, i, 2 * i + 1) for i in range(1, 17, 2))),
    "mediapipe468": _order(468, *_MESHES),
    "mediapipe478": _order(478, *_MESHES, (468, 468, 941), (469, 471, 945), (472, 472, 949)),  # irises
}
"""Maps a name to the landmark that each landmark changes places with, or itself: the 68 of iBUG (300-W, dlib), the
98 of WFLW, the 106 of LaPa (JD-landmark), the same in InsightFace's order, the 17 keypoints of COCO, and MediaPipe's
face mesh of 468 points, or of 478 with both irises."""

INSIGHTFACE = (
    *(1, *range(9, 17), *range(2, 9), 0, *range(24, 17, -1), *range(32, 24, -1), 17),  # the outline
    *(43, 48, 49, 51, 50, 46, 47, 45, 44, 102, 103, 104, 105, 101, 100, 99, 98, 97),  # brows
    *(72, 73, 74, 86, 75, 76, 77, 78, 79, 80, 85, 84, 83, 82, 81),  # the nose
    *(35, 41, 40, 42, 39, 37, 33, 36, 34, 89, 95, 94, 96, 93, 91, 87, 90, 88),  # eyes
    *(52, 64, 63, 71, 67, 68, 61, 58, 59, 53, 56, 55, 65, 66, 62, 70, 69, 57, 60, 54, 38, 92),  # the mouth, pupils
)
"""The number in "insightface106" of each landmark of "lapa106"."""
_INDEX_IN_INSIGHTFACE = {number: i for i, number in enumerate(INSIGHTFACE)}
LANDMARKS["insightface106"] = tuple(INSIGHTFACE[LANDMARKS["lapa106"][_INDEX_IN_INSIGHTFACE[i]]] for i in range(106))

TableLike = str | Sequence[int] | Sequence[Sequence[int]]


@dataclass(frozen=True)
class Table:
    """A table of landmarks that change places; pickles hold it."""

    order: tuple[int, ...]
    exact: bool  # whether it is for exactly so many landmarks; pairs fit any number from that on


def as_table(value: TableLike, owner: str) -> Table:
    """Return the table that a name, an order, or a list of pairs stands for."""
    wanted = f"{owner}: landmarks must be one of {', '.join(LANDMARKS)}, an order or a list of pairs"
    if isinstance(value, str):
        if value not in LANDMARKS:
            raise ValueError(f"{wanted}; got {value!r}")
        return Table(LANDMARKS[value], True)
    try:
        items: list[Any] = list(value)
    except TypeError:
        raise TypeError(f"{wanted}; got {shown(value)}") from None
    pairs: list[tuple[int, ...]] = []
    if items and all(isinstance(item, Iterable) for item in items):
        pairs = [tuple(as_whole(i, "landmarks", owner) for i in pair) for pair in items]
        if any(len(pair) != 2 for pair in pairs):
            raise ValueError(f"{owner}: landmarks must be pairs (left, right); got {value!r}")
        used = [i for pair in pairs for i in pair]
        order = list(range(max(used) + 1))
        for one, other in pairs:
            order[one], order[other] = other, one
        fits = len(set(used)) == len(used) and min(used) >= 0
    else:
        order = [as_whole(i, "landmarks", owner) for i in items]
        fits = sorted(order) == list(range(len(order))) and all(order[i] == k for k, i in enumerate(order))
    if not fits or not order:
        raise ValueError(
            f"{owner}: landmarks must hold each landmark's partner, whose partner is the landmark itself, or "
            f"pairs that hold no index twice; got {value!r}"
        )
    return Table(tuple(order), not pairs)


# numbers of points that hardly anything else has
_FACES = {n: " or ".join(repr(k) for k, v in LANDMARKS.items() if len(v) == n) for n in (68, 98, 106, 468, 478)}
_SURELY_LANDMARKS = "keypoints", "landmarks"  # kinds of fields
_MAYBE_LANDMARKS = *_SURELY_LANDMARKS, "points"
_OTHER_SIDE = {"left": "right", "right": "left"}


class Mirroring:
    """Effects of a mirror on more than places and directions: on landmarks, names of fields, and sides of heads."""

    def __init__(
        self,
        landmarks: TableLike | Mapping[str, TableLike | None] | None,
        lateral_axis: str,
        swap_sides: bool,
        owner: str,
    ):
        if not isinstance(lateral_axis, str) or lateral_axis not in ("x", "y", "z"):
            raise ValueError(
                f"{owner}: lateral_axis must be 'x', 'y' or 'z', of the head's frame; got {shown(lateral_axis)}"
            )
        self.lateral = "xyz".index(lateral_axis)  # the number of the head's axis from side to side
        self.owner = owner
        self.swap_sides: bool = as_flag(swap_sides, "swap_sides", owner)
        self._named: dict[str, Table | None] | None = None
        self._one: Table | None = None
        if isinstance(landmarks, Mapping):
            self._named = {name: None if t is None else as_table(t, owner) for name, t in landmarks.items()}
        elif landmarks is not None:
            self._one = as_table(landmarks, owner)
        self.by_name = tuple(self._named or ())  # the fields whose tables are given by name
        self.key = self._named, self._one, self.lateral, self.swap_sides  # equal for equal effects

    def order(self, name: str, kind: str | None, count: int) -> tuple[int, ...] | None:
        """Return the order in which a field's `count` landmarks come out of a mirror, or None to keep theirs.

        The field's `name` may have a path of keys before it, divided by slashes.
        """
        table = self._named.get(name.rpartition("/")[2]) if self._named is not None else self._one
        if table is None or count == 0:
            meant = _FACES.get(count) if self._named is None and kind in _SURELY_LANDMARKS else None
            if meant is not None and first_time(("landmarks", count)):
                warn(
                    f"{self.owner}: {name} holds {count} points, and mirrored faces keep their order: point 0 is then "
                    f"on the other side. Pass landmarks={meant}, if that is their order, or "
                    "landmarks={} to keep it"
                )
            return None
        size = len(table.order)
        if count == size or (count > size and not table.exact):
            return table.order + tuple(range(size, count))
        if kind != "points" or self._named is not None:  # 3D points may be no landmarks
            others = [known for known, its in LANDMARKS.items() if len(its) == count]
            hint = f"landmarks={{{name!r}: {repr(others[0]) if others else '[(left, right), ...]'}}} gives it by field"
            if not others and count % size == 0:
                hint = f"Several faces go in as (B, F, {size}, 2): {name}.unflatten(-2, (-1, {size}))"
            raise ValueError(f"{self.owner}: {name} must have {size} points, as landmarks has; got {count}. {hint}")
        return None

    def swapped(
        self, name: str, kind: str | None, value: Tensor, mirrored: Tensor, flags: bool, faces: set[tuple[int, ...]]
    ) -> Tensor:
        """Return landmarks (B, *F, N, ...), mirrored rows in their new order; kind None: of fields that do not move."""
        if kind is None and value.ndim < 2:
            raise ValueError(
                f"{self.owner}: {name} must be (B, N, ...), as it has a table of landmarks; got {shown(value)}"
            )
        if (kind is not None and kind not in _MAYBE_LANDMARKS) or value.ndim < (2 if flags else 3) or not value.numel():
            return value  # an image without faces may come with another number of points
        axis = value.ndim - (1 if flags else 2)
        axis -= axis > 1 and value.shape[axis] == 1  # OpenCV's (B, N, 1, 2)
        if kind is None:
            axis = 2 if tuple(value.shape[1:3]) in faces else 1
        order = self.order(name, kind, value.shape[axis])
        if order is None:
            return value
        if len(mirrored) != len(value):  # nothing else has checked this field
            raise ValueError(f"{self.owner}: {name} must be of {len(mirrored)} samples, as others; got {len(value)}")
        other = value.index_select(axis, torch.tensor(order, device=value.device))
        return gated(mirrored, other, value)

    def sides(self, names: Iterable[str]) -> list[tuple[str, str]]:
        """Return the pairs of fields that change places."""
        found: list[tuple[str, str]] = []
        if not self.swap_sides:
            return found
        names = set(names)
        for name in sorted(names):
            beginning, mark, side = name.rpartition("_")
            if not mark or side not in _OTHER_SIDE:
                continue
            other = f"{beginning}_{_OTHER_SIDE[side]}"
            if other not in names:
                raise ValueError(
                    f"{self.owner}: {name} must have a {other}, with which it changes places in a mirror; got none. "
                    "swap_sides=False keeps the name"
                )
            if side == "left":
                found.append((name, other))
        return found

    def exchange(self, moved: dict[str, Any], named: Named, mirrored: Tensor | None, batched: bool, owner: str) -> None:
        """Let landmarks and fields of a moved sample change places where they are seen in a mirror, (B,) bool.

        named: the fields that move. Others may have a table of landmarks too, such as the visibility of each one.
        """
        sides = self.sides(named)  # raises if a side lacks the other one, whether or not this draw mirrors
        kinds: dict[str, str | None] = {name: kind for name, (kind, _) in named.items()}
        for name in moved:
            if name.rpartition("/")[2] in self.by_name and name not in named:
                kinds[name] = None
                moved[name] = _as_tensors(moved[name], name, owner)
        pixels = [one for kind, value in named.values() if kind in _SURELY_LANDMARKS for one in _batches(value)]
        faces = {tuple(one.shape[1:3]) for one in pixels if one.ndim == 4}  # (F, N)
        # key -> its field, and whether each landmark has a flag, or one number, instead of a dim of coordinates
        keys: dict[str, tuple[str, bool]] = {}
        for name, kind in kinds.items():
            for key in (name, f"{name}_valid"):
                if key in moved:
                    keys[key] = name, kind is None or key != name
        single = [key for key in keys if not (batched or isinstance(moved[key], list))]
        moved |= {key: moved[key][None] for key in single}
        for key, (name, flags) in keys.items():
            value = moved[key]
            rows = torch.zeros(len(value), dtype=torch.bool) if mirrored is None else mirrored
            if isinstance(value, list):
                each = zip(_batches(value), rows.split(1), strict=False)
                moved[key] = [self.swapped(name, kinds[name], one, row, flags, faces)[0] for one, row in each]
            else:
                moved[key] = self.swapped(name, kinds[name], value, rows, flags, faces)
        for left, right in sides:
            for one, other in ((left, right), (f"{left}_valid", f"{right}_valid")):
                if mirrored is not None and one in keys and other in keys:
                    moved[one], moved[other] = exchanged(moved[one], moved[other], mirrored)
        moved |= {key: moved[key][0] for key in single}


def _as_tensors(value: Any, name: str, owner: str) -> Tensor | list[Tensor]:
    """Return the values of landmarks that do not move as a tensor, or as one for each sample of a list."""
    if isinstance(value, (list, tuple)) and all(isinstance(one, (Tensor, np.ndarray)) for one in value):
        return [torch.as_tensor(one) for one in value]
    if not isinstance(value, (Tensor, np.ndarray)):
        raise TypeError(
            f"{owner}: {name} has a table of landmarks, and must be a tensor of (B, N, ...); got {type(value).__name__}"
        )
    return torch.as_tensor(value)


def _batches(value: Any) -> list[Tensor]:
    """Return a list of tensors as batches of one, a batch as the only one."""
    return [one[None] for one in value] if isinstance(value, list) else [value]


def exchanged(one: Any, other: Any, rows: Tensor) -> tuple[Any, Any]:
    """Exchange the chosen rows, (B,) bool, of two fields of a batch, tensors or lists, and return both."""
    if isinstance(one, Tensor) and isinstance(other, Tensor) and one.shape == other.shape:
        return gated(rows, other, one), gated(rows, one, other)
    pairs = [(b, a) if r else (a, b) for a, b, r in zip(one, other, rows.tolist(), strict=True)]
    return [a for a, _ in pairs], [b for _, b in pairs]


# points of MediaPipe's mesh
_OVAL = (127, 234, 93, 132, 58, 172, 136, 150, 149, 176, 148, 152)  # the outline from the right ear to the chin
_BROW = (70, 63, 105, 66, 107, 55, 65, 52, 53)  # the right one from outside: over it, and back below
_BRIDGE = (168, 197, 195, 4)
_WING = (244, 209, 129)  # the nose's right one, from the eye down
_NOSTRILS = (75, 97, 2)  # from the right one to the middle
_EYE = (33, 160, 159, 158, 133, 153, 145, 144)  # the right one from its outer corner: over it, and back below
_MOUTH = (61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181, 78, 82, 13, 312, 308, 317, 14, 87)  # outside, inside
_IRIS = (468,)
_JAW = {"ibug68": 17, "wflw98": 33, "lapa106": 33}  # the number of landmarks on the outline, which come first
_RUNS = {  # name -> the first landmark of a run -> its points; the others are mirror images
    "ibug68": {17: _BROW[:5], 27: _BRIDGE + _NOSTRILS, 36: (33, 160, 158, 133, 153, 144), 48: _MOUTH},
    "wflw98": {33: _BROW, 51: _BRIDGE + _NOSTRILS, 60: _EYE, 76: _MOUTH, 96: _IRIS},
    "lapa106": {33: _BROW, 51: _BRIDGE + _WING + _NOSTRILS, 66: _EYE + _IRIS, 84: _MOUTH, 104: _IRIS},
}
_WITH_POINTS = (*_RUNS, "insightface106", "mediapipe468", "mediapipe478")


def face_points(landmarks: str = "ibug68") -> Tensor:
    """Return the points (K, 3) of a generic face in metres, float64, in the order of a detector's landmarks.

    They are the points of MediaPipe's canonical face model (Apache-2.0), an average adult, the same on both sides. The
    head's frame is that of `ct.head_angles`: x to the image's right when the face looks into the camera (the person's
    left), y down, z away from the camera, the origin midway between the eyeballs' centres. For a person the points are
    off by some millimetres, and the distance of a pose by as many percent as the face is larger or smaller. The outline
    of the jaw comes first in 68, 98 and 106 landmarks. Detectors see it where the face ends in the image, which is no
    fixed line of the head: give it a tenth of the weight in `ct.solve_pnp`.

    Args:
        landmarks: "ibug68", "wflw98", "lapa106", "insightface106", "mediapipe468" or "mediapipe478".

    Raises:
        ValueError: If `landmarks` is another name.

    Example:
        >>> ct.augment.face_points("mediapipe478").shape
        torch.Size([478, 3])
    """
    name = one_of(landmarks, _WITH_POINTS, "landmarks", "face_points")
    if name == "insightface106":
        return face_points("lapa106")[torch.tensor(INSIGHTFACE).argsort()]
    mesh = np.loadtxt(Path(__file__).with_name("mediapipe_face.txt")) / 1e5
    order = LANDMARKS[name]
    if name not in _RUNS:
        return torch.from_numpy(mesh[: len(order)])
    points, jaw = np.empty((len(order), 3)), _JAW[name]
    mirror = np.array([-1, 1, 1])
    right = mesh[list(_OVAL)]
    outline = np.concatenate((right, (right * mirror)[-2::-1]))
    along = np.cumsum([0, *np.linalg.norm(np.diff(outline, axis=0), axis=1)])
    points[:jaw] = np.stack([np.interp(np.linspace(0, along[-1], jaw), along, axis) for axis in outline.T], -1)
    for first, run in _RUNS[name].items():
        for i, point in enumerate(run, first):
            points[order[i]], points[i] = mesh[point] * mirror, mesh[point]
    return torch.from_numpy(points)
