"""Landmarks of the face of the driver in `cabin`; positions are in the frame of the head, see `driver`."""

from collections.abc import Sequence

import torch
from torch import Tensor

from scenes import driver
from scenes.driver import Shape

LANDMARKS = (
    *("right_eye_outer", "right_eye_inner", "left_eye_inner", "left_eye_outer", "right_iris", "left_iris"),
    *("right_brow_outer", "right_brow_inner", "left_brow_inner", "left_brow_outer"),
    *("nose_tip", "right_nostril", "left_nostril", "mouth_right", "mouth_left", "mouth_top", "mouth_bottom"),
    *("chin", "right_jaw", "left_jaw", "right_ear", "left_ear"),
)
"""The order of `Drivers.landmarks`; right and left are the driver's."""
Place = tuple[float | Tensor, ...]
_ENDS = ((-1, 1), (-1, -1), (1, -1), (1, 1))  # side of the face, outer or inner end


def _on_skin(places: Sequence[Place], s: Shape) -> Tensor:
    """(B, N, 3): where the skin is met from outside along the last axis named; that axis's value is the side (+-1)."""
    origin, ray = torch.zeros(2, 3, len(places), len(s.width), dtype=s.width.dtype)
    for i, (*place, last) in enumerate(places):
        axis = int(last)
        for j, value in enumerate(place):
            origin[j, i] = value
        ray[axis, i], origin[axis, i] = -origin[axis, i], 0.25 * origin[axis, i]
    origin, ray = origin.flatten(1), ray.flatten(1)
    near = torch.zeros_like(origin[0])
    shape = Shape._make(c.repeat(len(places)) for c in s)
    # half steps: along a fixed line the surface is to be met, not just come near to
    way = driver.march(lambda p, s: 0.6 * driver.skin(p, s), tuple(origin), tuple(ray), near, near + 1, shape)
    points: Tensor = (origin + way * ray).unflatten(1, (len(places), -1)).permute(2, 1, 0)
    return points


def face_points(s: Shape, gaze: Tensor) -> tuple[Tensor, Tensor]:
    """Landmarks (B, N, 3) and points of the face's outline (B, M, 3), head frame; gaze (B, 3) too."""
    w = s.width
    ends = [driver.brow(torch.full_like(w, end), s) for end in (0.0, 1.0)]
    top, _, bottom, _ = driver.lips(torch.zeros_like(w), s)
    eyes = [(i * w * (driver.EYE + j * driver.EYE_WIDTH), -0.05 * j * driver.EYE_WIDTH, -1, 2) for i, j in _ENDS]
    brows = [(i * w * driver.BROW[j > 0], ends[j > 0], -1, 2) for i, j in _ENDS]
    nose: list[Place] = [(0.0, 0.0395 + s.nose, -1, 2), *((i * 0.0155 * w, 0.044 + s.nose, -1, 2) for i in (-1, 1))]
    mouth: list[Place] = [(i * driver.MOUTH * w, driver.MOUTH_Y - s.smile, -1, 2) for i in (-1, 1)]
    mouth += [(0.0, y, -1, 2) for y in (top, bottom)]
    chin = (0.0, 1, -0.004, 1)
    sides = [(i, y, z, 0) for y, z in ((0.07, 0.045), (0.012, 0.1)) for i in (-1, 1)]
    rim = [(i, y, 0.03, 0) for y in (-0.045, 0.0, 0.035, 0.07) for i in (-1, 1)]
    found = _on_skin([*eyes, *brows, *nose, *mouth, chin, *sides, *rim, (0.0, -0.062, -1, 2)], s)
    marks, outline = found[:, :20], torch.cat([found[:, 20:], found[:, [8, 15]]], 1)
    return torch.cat([marks[:, :4], driver.eyeballs(s) + driver.EYE_RADIUS * gaze[:, None], marks[:, 4:]], 1), outline
