"""What is known of a lens before it is calibrated: that it is like a camera, or one of a family."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch._arguments import no_camera, shown
from camtorch.calibration.bundle import Prior
from camtorch.camera import Camera, fixed_camera
from camtorch.least_squares.equations import padded
from camtorch.least_squares.jacobians import sensor_jacobians
from camtorch.lenses import Lens
from camtorch.projection.rays import image_lattice

# Standard deviations, about as calibrations of one lens differ in half of the 175 lenses of `camtorch.lenses` that have
# three or more: of the focal length, of its ratio fx / fy, and, in parts of the image's longer side, of the principal
# point and of how far a coefficient moves pixels, root mean square over the image
_FOCAL, _RATIO, _CENTRE, _DISTORTION = 0.01, 5e-4, 2e-3, 1e-3
_LATTICE = 24  # points along the side of the image, at which distortion is compared
_ASPECT = 0.01  # the part by which aspect ratios may differ, as sizes are rounded
_TAILS, _ROUNDS = 4.0, 20  # degrees of freedom of a family, of which some are calibrated badly


class Known(NamedTuple):
    """The camera that a prior expects, (P,) parameters, and root (P, P): root @ (p - centre) has the variance 1."""

    camera: Camera
    centre: Tensor
    root: Tensor

    def prior(self, sigma: Tensor | float) -> Prior:
        """Beside residuals in px of that standard deviation."""
        return Prior(self.centre, self.root * sigma)


@torch.no_grad()
def as_known(
    prior: Camera | Lens | Sequence[Camera | Lens],
    model: type[Camera],
    count: int,
    size: tuple[int, int],
    owner: str,
    like: Tensor,
) -> Known:
    """What users pass: each camera brought to the image's size and to the model.

    Of one camera the spread is the usual one of calibrations of the same lens, see `_FOCAL`. A family has its own, of a
    t distribution, in which the usual one counts as one member more, and as many as there are parameters in its shape.

    Raises:
        TypeError: no cameras. ValueError: none of this aspect ratio, batches, lenses that are not as seen.
    """
    members = list(prior) if isinstance(prior, (list, tuple)) else [prior]
    cameras = []
    for member in members:
        if not isinstance(member, (Camera, Lens)) or (isinstance(member, Camera) and member.batch_shape.numel() != 1):
            got = shown(member) if isinstance(member, Camera) else no_camera(member)
            raise TypeError(f"{owner}: prior must be a camera, a lens of ct.lenses, or a list; got {got}")
        if isinstance(member, Lens) and not member.is_optical:
            continue
        camera = member.camera() if isinstance(member, Lens) else member[0] if member.batch_shape else member
        height, width = camera.image_size or size
        if abs(width * size[0] / (height * size[1]) - 1) < _ASPECT:
            cameras.append(camera.detach().double().resize(*size) if camera.image_size not in (None, size) else camera)
    if not cameras:
        raise ValueError(
            f"{owner}: prior has no lens that images of {size} (height, width) are seen by: of another aspect ratio, "
            "which camera.crop changes, stretched or reprojected; ct.lenses.search(words, image_size=...) finds others"
            f"; got {shown(prior)}"
        )
    rows = []
    for camera in cameras:
        if type(camera) is not model or camera.distortion.shape[-1] != count:
            camera = camera.convert(model, count=count, image_size=size).camera
        rows.append(torch.cat((camera.intrinsics, camera.distortion), -1).detach().double().cpu())
    values = torch.stack(rows)
    centre = values[values.sub(values.median(0).values)[:, :2].abs().sum(-1).argmin()]
    root = _usual(model, centre, size)
    if len(values) > 1:
        offsets = (values - centre) @ root.mT
        total, number = offsets.shape[-1], len(offsets)
        middle, eye = offsets.median(0).values, torch.eye(offsets.shape[-1]).to(offsets)
        shape = eye  # at first: those that are far from most are no reason to find them near
        for _ in range(_ROUNDS):
            distance = ((offsets - middle) @ torch.linalg.inv(shape) * (offsets - middle)).sum(-1)
            weights = (_TAILS + total) / (_TAILS + distance)
            middle = (weights @ offsets) / weights.sum()
            scatter = (weights[:, None] * (offsets - middle)).mT @ (offsets - middle)
            scale = (1 + scatter.trace() / total) / number
            shape = (total * scale * eye + scatter) / (total + number - 1)
        centre = centre + torch.linalg.lstsq(root, middle[:, None], driver="gelsd").solution[:, 0]
        root = torch.linalg.cholesky(torch.linalg.inv((1 + 1 / number) * shape)).mT @ root
    centre, root = centre.to(like), root.to(like)
    camera = fixed_camera(model, centre[:4], centre[4:], size)
    return Known(camera, centre, root)


def _usual(model: type[Camera], centre: Tensor, size: tuple[int, int]) -> Tensor:
    """(P, P) the root of a single camera."""
    focal, side = centre[:2], max(size)
    root = torch.diag(centre.new_tensor([1.0, 1.0, *[1 / (_CENTRE * side)] * (len(centre) - 2)]))
    root[0, :2], root[1, :2] = 1 / (2 * _FOCAL * focal), centre.new_tensor([1.0, -1.0]) / (_RATIO * focal)
    if len(centre) > 4:
        camera = fixed_camera(model, centre[:4], centre[4:], size)
        lattice = image_lattice(camera, _LATTICE, _LATTICE).reshape(-1, 2)
        rays, valid = camera.unproject(lattice)
        by_k = sensor_jacobians(model, centre[None, 4:], rays[valid][None]).by_k[0]
        moves = (by_k * focal[:, None, None]).transpose(-1, -2).flatten(0, 1)
        moves = moves / (len(moves) / 2) ** 0.5 / (_DISTORTION * side)
        root[4:, 4:] = torch.linalg.qr(padded(moves), mode="r").R
    return root
