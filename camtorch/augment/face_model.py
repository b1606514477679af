"""A generic face: the places of landmarks on a head, for poses from landmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from camtorch.augment.landmarks import INSIGHTFACE, LANDMARKS
from camtorch.values.arguments import one_of

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
_NAMES = (*_RUNS, "insightface106", "mediapipe468", "mediapipe478")


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
    name = one_of(landmarks, _NAMES, "landmarks", "face_points")
    if name == "insightface106":
        return face_points("lapa106")[torch.tensor(INSIGHTFACE).argsort()]
    mesh, order = np.loadtxt(Path(__file__).with_name("mediapipe_face.txt")) / 1e5, LANDMARKS[name]
    if name not in _RUNS:
        return torch.from_numpy(mesh[: len(order)])
    points, mirror, jaw = np.empty((len(order), 3)), np.array([-1, 1, 1]), _JAW[name]
    right = mesh[list(_OVAL)]
    outline = np.concatenate((right, (right * mirror)[-2::-1]))
    along = np.cumsum([0, *np.linalg.norm(np.diff(outline, axis=0), axis=1)])
    points[:jaw] = np.stack([np.interp(np.linspace(0, along[-1], jaw), along, axis) for axis in outline.T], -1)
    for first, run in _RUNS[name].items():
        for i, point in enumerate(run, first):
            points[order[i]], points[i] = mesh[point] * mirror, mesh[point]
    return torch.from_numpy(points)
