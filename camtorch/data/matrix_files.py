"""Faces and gazes in files of arrays: Matlab's of 300W-LP and AFLW2000, and the HDF5 of ETH-XGaze."""

from __future__ import annotations

import importlib
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from camtorch.augment.landmarks import TableLike
from camtorch.augment.sample import Sample, from_pitch_yaw
from camtorch.data.labelled import FileSamples, failing_at, image_at, image_beside, numbers_of
from camtorch.models import Pinhole
from camtorch.rotations import rotation_matrix

_FOCAL = 960.0  # pixels


class Mat(FileSamples):
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

    landmarks: TableLike | None = "ibug68"
    endings: tuple[str, ...] = (".mat",)

    def _sample(self, number: int) -> Sample:
        path = Path(self._files[number])
        arrays = _matlab(path, ("pt2d", "pt3d_68", "Pose_Para"))
        found = [a for name in ("pt2d", "pt3d_68") if (a := arrays.get(name)) is not None and a.shape in _SHAPES]
        if not found:
            shapes = {name: a.shape for name, a in arrays.items()}
            raise ValueError(f"{path}: pt2d (2, 68) or pt3d_68 (3, 68) was expected; got {shapes}")
        pose = arrays.get("Pose_Para")
        if pose is None or pose.size != 7:
            shape = None if pose is None else pose.shape
            raise ValueError(f"{path}: Pose_Para (1, 7) was expected, of pitch, yaw, roll and others; got {shape}")
        pitch, yaw, roll = numbers_of(pose.ravel()[:3].tolist(), str(path), "Pose_Para")
        axes = torch.eye(3)
        head = torch.eye(4)
        head[:3, :3] = (
            rotation_matrix(-pitch * axes[0]) @ rotation_matrix(yaw * axes[1]) @ rotation_matrix(roll * axes[2])
        )
        points, image = numbers_of(found[0][:2].T.tolist(), str(path), "points") - 1, image_beside(path)
        return {"image": image_at(image), "keypoints": points, "head_pose": head, "path": str(image)}


_SHAPES = ((2, 68), (3, 68))


def _matlab(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray[Any, Any]]:
    """Arrays of numbers by their names, of a file of Matlab 5 to 7.3, of which the last is HDF5.

    The older form is read here: scipy's reader ends the process at some damaged files. Source: MAT-File Format, The
    MathWorks; elements of a kind and a number of bytes, the matrices among them compressed or not.
    """
    with path.open("rb") as file:
        content = file.read(_LARGEST)
    if content[:10] == b"MATLAB 7.3":
        with _hdf(path) as arrays:
            return {name: np.asarray(arrays[name]).T for name in names if name in arrays}
    if content[:6] != b"MATLAB" or content[126:128] != b"IM":
        raise ValueError(f"{path}: not a file of Matlab, or of one older than version 5; it begins {content[:20]!r}")
    found = {}
    with failing_at(path, "not a whole file of Matlab: ", ValueError, KeyError, struct.error, zlib.error):
        for kind, part in _elements(content[128:]):
            if kind == _COMPRESSED:
                kind, part = next(_elements(zlib.decompressobj().decompress(part, _LARGEST)), (0, b""))
            parts = list(_elements(part)) if kind == _MATRIX else []
            if len(parts) > 3 and (name := parts[2][1].decode("latin-1")) in names:
                shape, numbers = np.frombuffer(parts[1][1], "<i4"), np.frombuffer(parts[3][1], _NUMBERS[parts[3][0]])
                found[name] = numbers.reshape(shape.tolist(), order="F")
    return found


def _elements(content: bytes) -> Iterator[tuple[int, bytes]]:
    """The kind and the bytes of each element, of which small ones lie within eight bytes."""
    at = 0
    while at < len(content):
        kind, size = struct.unpack_from("<II", content, at)
        if kind >> 16:
            kind, size, begin, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        else:
            begin = at + 8
            after = begin + size + (0 if kind == _COMPRESSED else -size % 8)
        if begin + size > len(content):
            raise ValueError(f"{size} bytes were expected, and {len(content) - begin} are left")
        yield kind, content[begin : begin + size]
        at = after


_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}
_LARGEST = 1 << 26  # bytes; those of 300W-LP have some thousands


class XGaze(FileSamples):
    """ETH-XGaze: the normalised faces of a .h5 for each subject; a row at a time is read of them.

    `face_patch` (N, H, W, 3) is blue, green, red; `face_gaze` (N, 2), which the test sets lack, pitch and yaw in
    radians, here the unit vector `gaze`, see `from_pitch_yaw`; `face_head_pose` (N, 2), of the head likewise,
    `pitch_yaw_head`; `face_mat_norm` (N, 3, 3), the turn from the camera that took the photograph, `rotation`.
    `camera` is the virtual one by which the authors' code normalises: focal length 960 pixels, at 0.6 m for faces of
    224 pixels and 0.3 m for those of 448, principal point in the middle, at (W / 2, H / 2).
    """

    endings: tuple[str, ...] = (".h5", ".hdf5")

    def __init__(self, path: Path):
        super().__init__(path)
        counts = []
        for one in map(Path, self._files):
            with _hdf(one) as arrays:
                shapes = {name: arrays[name].shape for name in ("face_patch", *_ROWS) if name in arrays}
            patch = shapes.get("face_patch", ())
            wrong = {name for name, row in _ROWS.items() if shapes.get(name, (*patch[:1], *row)) != (*patch[:1], *row)}
            if len(patch) != 4 or patch[-1] != 3 or wrong:
                rows = ", ".join(f"{name} {('N', *row)}".replace("'", "") for name, row in _ROWS.items())
                raise ValueError(f"{one}: face_patch (N, H, W, 3), {rows} were expected; got {shapes}")
            counts.append(patch[0])
        self._ends = np.cumsum(counts)
        self._count = int(self._ends[-1])

    def _sample(self, number: int) -> Sample:
        which = int(np.searchsorted(self._ends, number, "right"))
        path = Path(self._files[which])
        row = number - int(self._ends[which - 1] if which else 0)
        with _hdf(path) as arrays:
            patch = np.asarray(arrays["face_patch"][row])
            rows = {name: np.asarray(arrays[name][row]) for name in _ROWS if name in arrays}
        place = f"{path}, row {row}"
        told = {n: numbers_of(v.ravel().tolist(), place, n).reshape(v.shape) for n, v in rows.items()}
        height, width = patch.shape[:2]
        sample: Sample = {"image": torch.from_numpy(np.ascontiguousarray(patch[..., ::-1].transpose(2, 0, 1)))}
        if "face_gaze" in told:
            with failing_at(place, "face_gaze: ", ValueError):
                sample["gaze"] = from_pitch_yaw(told["face_gaze"])
        sample |= {new: told[name] for name, new in _FIELDS.items() if name in told}
        camera = Pinhole([_FOCAL, _FOCAL, width / 2, height / 2], image_size=(height, width))
        return {**sample, "camera": camera.requires_grad_(False), "path": str(path), "row": row}


_ROWS = {"face_gaze": (2,), "face_head_pose": (2,), "face_mat_norm": (3, 3)}
_FIELDS = {"face_head_pose": "pitch_yaw_head", "face_mat_norm": "rotation"}


@contextmanager
def _hdf(path: Path) -> Iterator[Any]:
    """A file of HDF5; what goes wrong with it in the block is a ValueError that names it."""
    try:
        open_file = importlib.import_module("h5py").File
    except ImportError:
        raise ImportError(f'{path}: to read it needs h5py: pip install "camtorch[datasets]"') from None
    errors = OSError, KeyError, RuntimeError, ValueError, AttributeError  # the last of what is no array
    with failing_at(path, "not a whole file of HDF5: ", *errors), open_file(path, "r") as file:
        yield file
