"""Where cameras sit in a cabin, what drivers look at, and whether they turn the head for it.

The car's frame is that of ISO 8855, in metres: x forward, y to the left, z up. Its origin is the usual place of the
driver's eyes, midway between them. All numbers are those of a left-hand drive; `right_hand_drive=True` mirrors them.

The numbers are typical, and of no car: fields of view by mount are those that a survey of suppliers names (anyverse.ai,
flexible camera positioning), positions and regions are this project's own estimates of a car of middle size. A mount
and regions of your own car go in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from camtorch._arguments import Numbers, as_coordinates, as_values
from camtorch.extrinsics import Extrinsics
from camtorch.warp.boxes import within

__all__ = ["MOUNTS", "REGIONS", "Mount", "Regions", "head_share", "mount"]

MOUNTS: dict[str, tuple[tuple[float, float, float], float, str]] = {
    "steering_column": ((0.55, 0.0, -0.33), 60.0, "between the wheel and the cluster, seen through the wheel's rim"),
    "cluster": ((0.78, 0.0, -0.22), 50.0, "on top of the instrument cluster"),
    "centre_stack": ((0.72, -0.38, -0.22), 130.0, "above the display in the middle, for driver and passenger"),
    "mirror": ((0.5, -0.38, 0.14), 140.0, "at the mirror, for the whole cabin"),
    "a_pillar": ((0.6, 0.5, 0.02), 60.0, "on the pillar beside the windscreen, on the driver's side"),
}
"""Name -> position in the car's frame, the horizontal field of view of a usual lens in degrees, and where it is."""

REGIONS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "windscreen": ((0.9, 0.55, -0.12), (0.9, -1.1, -0.12), (0.6, -1.05, 0.25), (0.6, 0.5, 0.25)),
    "cluster": ((0.72, 0.18, -0.28), (0.72, -0.18, -0.28), (0.72, -0.18, -0.15), (0.72, 0.18, -0.15)),
    "centre_stack": ((0.72, -0.25, -0.45), (0.72, -0.52, -0.45), (0.72, -0.52, -0.15), (0.72, -0.25, -0.15)),
    "mirror": ((0.5, -0.28, 0.1), (0.5, -0.52, 0.1), (0.5, -0.52, 0.18), (0.5, -0.28, 0.18)),
    "left_mirror": ((0.75, 0.85, -0.15), (0.75, 0.6, -0.15), (0.75, 0.6, 0.02), (0.75, 0.85, 0.02)),
    "right_mirror": ((0.85, -1.42, -0.15), (0.85, -1.7, -0.15), (0.85, -1.7, 0.02), (0.85, -1.42, 0.02)),
    "left_window": ((0.6, 0.65, -0.15), (-0.4, 0.65, -0.15), (-0.4, 0.65, 0.3), (0.6, 0.65, 0.3)),
    "passenger": ((-0.2, -0.6, -0.7), (0.4, -0.6, -0.7), (0.4, -0.6, -0.1), (-0.2, -0.6, -0.1)),
    "lap": ((0.05, 0.25, -0.6), (0.45, 0.25, -0.6), (0.45, -0.25, -0.6), (0.05, -0.25, -0.6)),
}
"""Name -> the corners of a region that drivers look at, in the car's frame."""

_FLAT = 0.01  # of its extent, by which the corners of a region may miss their plane


class Mount(NamedTuple):
    """Where a camera sits, and with which lens."""

    extrinsics: Extrinsics
    """Camera from car, without batch dims: it looks at the usual place of the driver's eyes, upright."""
    fov: float
    """Degrees, of a usual lens."""
    about: str
    """Where it is, in words."""


def mount(name: str, *, right_hand_drive: bool = False) -> Mount:
    """A usual mount by name, one of `MOUNTS`.

    Raises:
        ValueError: another name.
    """
    if name not in MOUNTS:
        close = get_close_matches(str(name), MOUNTS, 1)
        hint = f". Did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"mount: there are {', '.join(MOUNTS)}; got {name!r}{hint}")
    position, fov, about = MOUNTS[name]
    at = torch.tensor(position, dtype=torch.float64) * torch.tensor([1, -1 if right_hand_drive else 1, 1])
    ahead = -at / at.norm()
    right = normalize(torch.linalg.cross(ahead, torch.tensor([0.0, 0, 1], dtype=torch.float64)), dim=0)
    rotation = torch.stack((right, torch.linalg.cross(ahead, right), ahead))
    extrinsics = Extrinsics.from_matrix(rotation, -(rotation @ at)).requires_grad_(False)
    return Mount(extrinsics, fov, about)


class Regions:
    """What somebody looks at: plane polygons in a frame that does not move with the camera, as the car's.

    Args:
        polygons: name -> (K, 3) corners in their order, K >= 3; `REGIONS` if left out.
        right_hand_drive: mirrors `REGIONS`, whose names stay: "left_mirror" is then the one on the right.

    Raises:
        ValueError: corners that are no plane polygon.
    """

    names: tuple[str, ...]
    """Of the regions, in the order of their numbers, and at last "elsewhere", which is `names[-1]`."""

    def __init__(self, polygons: Mapping[str, Numbers] | None = None, *, right_hand_drive: bool = False):
        flipped = torch.tensor([1.0, -1.0 if right_hand_drive and polygons is None else 1.0, 1.0], dtype=torch.float64)
        self.names, self._planes = (*(REGIONS if polygons is None else polygons), "elsewhere"), []
        for name, given in (REGIONS if polygons is None else polygons).items():
            corners = as_coordinates(given, f"polygons[{name!r}]", 3, "Regions").detach().double() * flipped
            if corners.ndim != 2 or len(corners) < 3 or not bool(torch.isfinite(corners).all()):
                raise ValueError(f"Regions: {name!r} must be (K, 3) finite corners, K >= 3; got {given!r:.100}")
            middle = corners.mean(0)
            axes = torch.linalg.svd(corners - middle, full_matrices=True).Vh
            along = (corners - middle) @ axes.mT
            extent = along.abs().amax(0)
            if extent[2] > _FLAT * extent[0] or extent[1] < 1e-6 * extent[0]:
                raise ValueError(
                    f"Regions: the corners of {name!r} must lie on one plane, and not on a line; they are "
                    f"{float(extent[2]):.3g} off a plane, {float(2 * extent[0]):.3g} long and "
                    f"{float(2 * extent[1]):.3g} wide"
                )
            self._planes.append((middle, axes, along[:, :2]))

    def region_of(self, gaze: Numbers, eye: Numbers, pose: Mount | Extrinsics | Numbers | None = None) -> Tensor:
        """The number of the region that a gaze meets first.

        The answer does not depend on the camera: where an augmentation turns gaze, eye and pose together, as it does
        with the fields `gaze`, `points` and `pose` of a sample, it stays. A mirror makes another car of it.

        Args:
            gaze: (..., 3), of any length, in the camera's frame, or in the car's without a pose.
            eye: (..., 3) from where, in the same frame.
            pose: camera from car: an `Extrinsics`, a `Mount`, or (..., 4, 4). None: both are in the car's frame.

        Returns:
            (...) int64, the place in `names`; -1, "elsewhere", where it meets none, or is not finite.
        """
        ray, start = _in_car(gaze, eye, pose, "region_of")
        nearest = ray.new_full(ray.shape[:-1], torch.inf)
        found = torch.full_like(nearest, -1, dtype=torch.int64)
        for number, (middle, axes, corners) in enumerate(self._planes):
            middle, axes, corners = (t.to(ray.device) for t in (middle, axes, corners))
            from_start = (middle - start) @ axes[2]
            across = ray @ axes[2]
            distance = from_start / torch.where(across == 0, 1.0, across)
            hit = (start + distance[..., None] * ray - middle) @ axes[:2].mT
            inside = within(corners, hit.reshape(-1, 2)).view(distance.shape)
            nearer = inside & (across != 0) & (distance > 0) & (distance < nearest)
            nearest, found = torch.where(nearer, distance, nearest), torch.where(nearer, number, found)
        return found

    def __repr__(self) -> str:
        return f"Regions({', '.join(self.names[:-1])})"


def head_share(gaze: Numbers, head: Numbers, pose: Mount | Extrinsics | Numbers | None = None) -> Tensor:
    """Which part of a glance away from straight ahead the head makes: "owl" near 1, "lizard" near 0.

    Euro NCAP calls those who turn the head to look owls, and those who move the eyes alone lizards (Mulhall et al.,
    European NCAP driver state monitoring protocols, 2022). The angle of gaze from the car's x axis is compared with how
    far the nose went in the same direction; more than 1 is a head that goes further than the eyes, and below 0 one that
    goes the other way.

    Args:
        gaze: (..., 3) in the camera's frame, or in the car's without a pose.
        head: (..., 3, 3) or (..., 4, 4), camera (or car) from head, whose nose points along -z.
        pose: camera from car: an `Extrinsics`, or (..., 4, 4).

    Returns:
        (...), 0 where the gaze is straight ahead.
    """
    matrix = as_values(head, "head", "head_share")
    if matrix.ndim < 2 or matrix.shape[-2:] not in ((3, 3), (4, 4)):
        raise ValueError(f"head_share: head must be (..., 3, 3) or (..., 4, 4); got shape {tuple(matrix.shape)}")
    nose = -matrix[..., :3, 2]
    gaze = as_coordinates(gaze, "gaze", 3, "head_share")
    (eyes, _), (turned, _) = (_in_car(ray, torch.zeros_like(ray), pose, "head_share") for ray in (gaze, nose))
    a, b = (_from_ahead(ray) for ray in (eyes, turned))
    square = a.square().sum(-1)
    share: Tensor = torch.where(square > 1e-12, (a * b).sum(-1) / square.clamp(min=1e-12), 0.0)
    return share


def _from_ahead(rays: Tensor) -> Tensor:
    """(..., 2): angles to the left and up from the x axis, of the length of the angle between both."""
    side = rays[..., 1:]
    size = side.norm(dim=-1, keepdim=True)
    angles: Tensor = side * (torch.atan2(size, rays[..., :1]) / size.clamp(min=1e-30))
    return angles


def _in_car(
    gaze: Numbers, eye: Numbers, pose: Mount | Extrinsics | Numbers | None, owner: str
) -> tuple[Tensor, Tensor]:
    """Unit gaze and eye, float64, in the car's frame."""
    ray, start = (as_coordinates(v, n, 3, owner).detach().double() for v, n in ((gaze, "gaze"), (eye, "eye")))
    if pose is not None:
        pose = pose.extrinsics if isinstance(pose, Mount) else pose
        matrix = (pose.matrix() if isinstance(pose, Extrinsics) else as_values(pose, "pose", owner)).detach().double()
        if matrix.ndim < 2 or matrix.shape[-2:] != (4, 4):
            raise ValueError(f"{owner}: pose must be an Extrinsics or (..., 4, 4); got shape {tuple(matrix.shape)}")
        rotation, shift = matrix[..., :3, :3], matrix[..., :3, 3]
        ray, start = ((rotation.mT @ v[..., None])[..., 0] for v in (ray, start - shift))
    ray, start = torch.broadcast_tensors(normalize(ray, dim=-1), start)
    return ray, start
