"""The camera that a `CameraHead` starts from, and the largest discs of the lens that its images show."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from camtorch.calibration.model import Model
from camtorch.cameras.camera import Camera
from camtorch.networks.limits import BEYOND
from camtorch.rays.lattices import focal_for
from camtorch.values.arguments import check_degrees, columns, shown

_FOV = 40.0, 120.0
_LONGER, _SHORTER = 1.5, (1.5, 1.25, 1.1, 1.05)  # times a given camera's; the first with rays for the corners
_RIM, _LOPSIDED = 0.1, 0.1  # of the rim's radius; real lenses have a tenth as much of lopsided terms
_TURNS = 0.0, math.pi / 4, math.pi / 2  # azimuths at which lopsided terms move most
_AZIMUTHS = 16


@dataclass
class Prior:
    """A lens, and the range of its focal length."""

    model: type[Camera]
    lens: Tensor  # (n,) coefficients, float64
    focal: float  # the geometric mean of fx and fy
    aspect: float  # log(fy / fx)
    middle: list[float]  # cx, cy
    discs: tuple[float, float, float]  # radii of the farthest corner, at the greatest focal length, `focal`, the least

    @property
    def names(self) -> tuple[str, ...]:
        return self.model.names_of(len(self.lens)) or ()

    def scales(self, discs: Tensor) -> Tensor:
        """Return the changes (K, n) of coefficients that move the rim of discs (K,) by `_RIM`; 0 if none does."""
        turn = discs.new_tensor(_TURNS)
        a, b = ((discs[:, None] * c).reshape(-1, 1) for c in (turn.cos(), turn.sin()))
        k = self.lens.expand(len(a), -1)
        rays = self.model.optics(columns(k))[0].to_ray(a, b, 1)

        def planes(k: Tensor) -> Tensor:
            chart, lens = self.model.optics(columns(k))
            on_plane = chart.to_plane(*rays, 1)
            return torch.stack(lens(*on_plane) if lens.stages else on_plane).squeeze(-1)

        with torch.enable_grad():
            moved = torch.autograd.functional.jacobian(lambda k: planes(k).sum(-1), k)
        most = torch.hypot(*moved) / torch.hypot(*planes(k))[:, None]
        most = most.unflatten(0, (len(discs), len(_TURNS))).amax(1)
        odd = self.model.odd_in_x | self.model.odd_in_y
        share = _RIM * torch.tensor([_LOPSIDED if name in odd else 1.0 for name in self.names], dtype=discs.dtype)
        return torch.where(most > 0, share / most.clamp(min=1e-300), 0.0)


def prior_of(
    asked: Model, image_size: tuple[int, int], centre: float, aspect: float, fov: Sequence[float] | None, owner: str
) -> Prior:
    """Return the prior of a `CameraHead`; `aspect` is the largest change of the logarithm of fy / fx."""
    degrees, start = _as_fov(fov, owner), asked.start
    given, ratio = None, 0.0
    middle = [(side - 1) / 2 for side in image_size[::-1]]
    if start is not None:
        fx, fy, *middle = start.intrinsics.detach().double().flatten().tolist()
        given, ratio = math.sqrt(fx * fy), math.log(fy / fx)
    sides = [max(c + 0.5, side - 0.5 - c) + centre * side for c, side in zip(middle, image_size[::-1], strict=True)]
    stretches = [math.exp((ratio + sign * aspect) / 2) for sign in (-1, 1)]
    far = max(math.hypot(sides[0] * stretch, sides[1] / stretch) for stretch in stretches)
    found = []
    for lens in _lenses(asked):
        if not asked.kind.optics(columns(lens))[0].has_scale:
            kind = asked.kind.__name__
            raise ValueError(f"{owner}: model must not be a panorama, or have an axis of its own; got {kind}")
        numbers = lens.new_tensor([1.0, 1.0, 0.0, 0.0]), *([lens] if len(lens) else [])
        plane = asked.kind(*numbers).requires_grad_(False)
        if given is not None and degrees is None:
            ranges = [(given * _LONGER, given, given / times) for times in _SHORTER]
        else:
            pair = torch.tensor(degrees or _FOV, dtype=lens.dtype).deg2rad()
            focal, reached = focal_for(plane, pair, image_size, "horizontal")
            longest, shortest = (focal * math.exp(ratio / 2)).tolist()
            ranges = [(longest, given or math.sqrt(longest * shortest), shortest)] if bool(reached.all()) else []
        for longest, focal_length, shortest in ranges:
            if not shortest * (1 - 1e-6) <= focal_length <= longest * (1 + 1e-6):
                raise ValueError(f"{owner}: fov must contain that of the given camera; got {tuple(fov or ())}")
            discs = _disc(plane, far / longest), _disc(plane, far / focal_length), _disc(plane, far / shortest)
            if all(discs):
                found.append(Prior(asked.kind, lens, focal_length, ratio, middle, discs))
                break

    def rank(prior: Prior) -> tuple[int, float]:
        """Prefer most effective coefficients (the omega of `FOV` has none at 0), then the first, then strong ones."""
        scales = prior.scales(torch.tensor(prior.discs, dtype=torch.float64))
        comes_first = prior is found[0] or not scales.numel()
        return -int((scales > 0).all(0).sum()), -1.0 if comes_first else float(scales.amax())

    if found:
        return min(found, key=rank)
    who = asked.kind.__name__ if start is None else "the camera"
    angles = f" with fov={degrees or _FOV}" if degrees or start is None else ""
    got = f"none{angles} and centre={centre}. Use a narrower fov, a smaller centre, or another model"
    raise ValueError(f"{owner}: {who} must have rays for the corners of images of {image_size}; got {got}")


def _as_fov(fov: Sequence[float] | None, owner: str) -> tuple[float, float] | None:
    if fov is None:
        return None
    try:
        low, high = (float(angle) for angle in fov)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{owner}: fov must be (least, greatest), such as (40, 120); got {shown(fov)}") from None
    if not 0 < low <= high <= 360:
        raise ValueError(f"{owner}: fov must be degrees, (least, greatest); got {fov!r}")
    check_degrees(low, fov, owner)
    return low, high


def _lenses(asked: Model) -> Iterator[Tensor]:
    """Yield the coefficients of the camera to start from; without one, an ideal lens and the model's `fit_starts`."""
    if asked.start is not None:
        yield asked.start.distortion.detach().double().reshape(-1).cpu()
        return
    names = asked.names[4:]
    ideal = dict(zip(names, asked.kind.ideal(asked.count), strict=True))
    for values in ({}, *asked.kind.fit_starts):
        yield torch.tensor([{**ideal, **values}[name] for name in names], dtype=torch.float64)


def _disc(plane: Camera, reach: float) -> float:
    """Return the radius on the chart's plane that is seen up to a distance `reach` from the centre, or 0."""
    turn = torch.arange(_AZIMUTHS, dtype=torch.float64) * (2 * math.pi / _AZIMUTHS)
    rim = BEYOND * reach * torch.stack((turn.cos(), turn.sin()), -1)
    if not bool(plane.unproject(rim)[1].all()):
        return 0.0
    x, y, z = plane.unproject(rim / BEYOND)[0].unbind(-1)
    chart, _ = plane.optics(columns(plane.distortion))
    return float(torch.hypot(*chart.to_plane(x, y, z, 1)).amax())
