"""A generic face: the places of 68 landmarks on a head, for poses from landmarks."""

from __future__ import annotations

import math

from torch import Tensor, tensor

# half a face in millimetres, the person's left one: x to the side, y down, z back from the plane of the eyeballs'
# centres. Plain proportions of an adult: pupils 63 mm apart, cheekbones 134 mm, chin 112 mm below the eyes
_BROW = ((11, -16, -17), (21, -22, -17), (33, -24, -13), (45, -22, -6), (55, -15, 4))  # from the middle outwards
_EYE = ((16, 1, -7), (25, -5, -11), (37, -5, -10), (46, 0, -1), (37, 4, -9), (26, 5, -10))  # inner corner, then over
_BRIDGE = ((0, 3, -18), (0, 14, -25), (0, 26, -34), (0, 37, -43))
_NOSTRILS = ((0, 50, -33), (7, 48, -31), (14, 45, -25))  # from the middle outwards
_UPPER = ((0, 65, -34), (8, 63, -33), (17, 67, -28), (26, 73, -19))
_LOWER = ((0, 86, -31), (10, 84, -30), (19, 80, -26))
_INNER = ((0, 72, -32), (9, 72, -30), (22, 73, -21))
_INNER_LOWER = ((0, 75, -31), (9, 75, -29))

_Points = tuple[tuple[float, float, float], ...]


def face_points() -> Tensor:
    """Return a generic face (68, 3) in float64 and metres, in the order of iBUG's 68 landmarks.

    It is in the head's frame of `ct.head_angles`: x to the image's right if the face looks into the camera (the
    person's left), y down, z away from the camera, the origin midway between the eyeballs' centres. It has plain
    proportions and is nobody's face: for a person it is off by some millimetres, and a distance from it by as many
    percent as the face is larger or smaller. Your own model in that order, or a part of it, is better.
    """
    jaw = []
    for i in range(17):  # from ear to ear under the chin
        turn = math.radians(-90 + 180 * i / 16)
        side, below = math.sin(turn), math.cos(turn)
        jaw.append((67 * side, 6 + 106 * below**0.8, -24 + 96 * side**2))
    eye_over, eye_under = _EYE[:4], _EYE[4:]
    right_eye = (*eye_over[::-1], *eye_under[::-1])
    points = (
        *jaw,
        *_mirrored(_BROW[::-1]),
        *_BROW,
        *_BRIDGE,
        *_across(_NOSTRILS),
        *_mirrored(right_eye),
        *_EYE,
        *_across(_UPPER),
        *reversed(_across(_LOWER)),
        *_across(_INNER),
        *reversed(_across(_INNER_LOWER)),
    )
    return tensor(points).double() / 1000


def _mirrored(points: _Points) -> _Points:
    return tuple((-x, y, z) for x, y, z in points)


def _across(half: _Points) -> _Points:
    """Return points from the person's right to the left, of a left half whose first point is the middle."""
    return (*_mirrored(half[:0:-1]), *half)
