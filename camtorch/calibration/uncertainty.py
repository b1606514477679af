"""The uncertainty of a calibration: the effect of the corners' noise on parameters and projections."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from camtorch.calibration.bundle import Adjusted, pixel_jacobians
from camtorch.cameras.camera import Camera
from camtorch.cameras.operators import fixed_camera
from camtorch.least_squares.equations import Equations
from camtorch.poses.rotations import skew_matrix
from camtorch.values.arguments import Numbers, as_coordinates, as_values

_PIXELS = 1 << 15  # at once
# Relative to the greatest singular value. Of a panorama neither the turn nor the principal point is determined, though
# its projections are: rounding divided by this is their error
_LEAST = 1e-9


class Spread(NamedTuple):
    """The effect of the corners' noise on a camera and its frame, for B problems.

    Independent numbers of variance 1 move the P = 4 + n parameters, the frame's turn (a rotation vector, radians) and
    its shift by the rows of `factor`. Both are means over the boards with their own poses, which compensate the lens.
    """

    model: type[Camera]
    parameters: Tensor  # (B, P)
    factor: Tensor  # (B, P + 6, K)

    @property
    def covariance(self) -> Tensor:
        """Covariance (B, P, P) of the parameters; zeros for fixed ones."""
        own = self.factor[:, : self.parameters.shape[-1]]
        return own @ own.mT

    @property
    def std(self) -> Tensor:
        """Standard deviations (B, P) of the parameters; zeros for fixed ones."""
        deviations: Tensor = torch.linalg.vector_norm(self.factor[:, : self.parameters.shape[-1]], dim=-1)
        return deviations

    def of_pixels(self, pixels: Tensor, distance: Tensor) -> Tensor:
        """Return covariances (B, M, 2, 2) in px^2 of the pixels at which points are seen; NaN if a pixel has no ray.

        Points move to each board's frame by its pose and back by its noisy pose, and the noisy camera projects their
        mean: mrcal's mean-pcam. distance: (B, M) from the camera, or infinite.
        """
        camera, found = fixed_camera(self.model, self.parameters[:, :4], self.parameters[:, 4:]), []
        for some, far in zip(pixels.split(_PIXELS, 1), distance.split(_PIXELS, 1), strict=True):
            rays, valid = camera.unproject(some)
            by_ray, by_parameters = pixel_jacobians(camera, rays)
            by_turn = torch.linalg.cross(rays[:, :, None].expand_as(by_ray), by_ray, dim=-1)
            moved = torch.cat((by_parameters, by_turn, by_ray / far[..., None, None]), -1) @ self.factor[:, None]
            known = valid & (by_parameters[..., 0, 2] > 0)  # the derivative by cx is 0 without a pixel
            found.append(torch.where(known[..., None, None], moved @ moved.mT, torch.nan))
        return torch.cat(found, 1)

    def scaled(self, noise: Tensor) -> Spread:
        """Return the spread for corner noise (B,), px per coordinate, from the spread for noise of 1."""
        return self._replace(factor=self.factor * noise[:, None, None])


def spread(adjusted: Adjusted, model: type[Camera], camera: int) -> Spread:
    """Return the spread of one camera, by its index, at an optimum, for corner noise of 1 px per coordinate."""
    equations, state = adjusted.equations, adjusted.state
    parameters, mounts = state.parameters[camera], state.mounts
    shared = shared_factor(equations)
    # (B, 6, G + 6): turn and shift, the mean of all boards, by `shared` and by their own noise
    view = equations.view
    corner, right = view[..., :6], view[..., 6:-1]
    diagonal = corner.diagonal(dim1=-2, dim2=-1).abs()
    # a view with too few corners has no usable pose
    seen = (diagonal > torch.finfo(view.dtype).eps * diagonal.amax(-1, keepdim=True)).all(-1)
    eye = torch.eye(6, dtype=view.dtype, device=view.device)
    corner = torch.where(seen[..., None, None], corner, eye)
    inverse = torch.linalg.solve_triangular(corner, eye.expand_as(corner), upper=True)
    share = seen.to(view.dtype) / seen.sum(-1, keepdim=True).clamp(min=1)
    inverse = inverse * share[..., None, None]
    twist = inverse[..., :3, :]
    # about the origin, not the board
    carried = torch.cat((twist, inverse[..., 3:, :] + skew_matrix(state.boards.translations) @ twist), -2)
    by_shared = -(carried @ right).sum(1)
    by_noise = carried.movedim(1, -2).flatten(-2)  # (B, 6, 6 V)
    frame = torch.cat((by_shared @ shared, torch.linalg.qr(by_noise.mT, mode="r").R.mT), -1)
    count = parameters.shape[-1]
    own = shared.new_zeros(len(shared), count + 6, shared.shape[-1])
    (places, indices), mounted = adjusted.problem.learnt[camera], adjusted.problem.mounted[camera]
    own[:, indices] = shared[:, places]
    if mounted:
        own[:, count:] = shared[:, mounted]
    turn, shift = own[:, count : count + 3], own[:, count + 3 :]
    # the first camera's frame, moved to this camera's
    rotation = mounts.rotations[:, camera]
    none = frame.new_zeros(len(frame), 3, frame.shape[-1] - shared.shape[-1])
    turn = torch.cat((turn, none), -1) + rotation @ frame[:, :3]
    shift = torch.cat((shift, none), -1) + rotation @ frame[:, 3:]
    shift = shift + skew_matrix(mounts.translations[:, camera]) @ turn
    own = torch.cat((own[:, :count], none[:, :1].expand(-1, count, -1)), -1)
    factor = torch.cat((own, turn, shift), 1)
    return Spread(model, parameters.expand(len(factor), -1), factor)


def shared_factor(equations: Equations) -> Tensor:
    """Return F (B, G, G): F F^T times the noise's variance is the shared unknowns' covariance, huge if undetermined."""
    triangle: Tensor = equations.shared[:, :-1, :-1]
    if not triangle.shape[-1]:
        return triangle
    # columns differ by many orders of magnitude, also before the part that poses compensate is removed
    own = equations.view[..., -triangle.shape[-1] - 1 : -1].square().sum((1, 2))
    scale = (own + triangle.square().sum(-2)).sqrt()
    scale = torch.where(scale > 0, scale, 1.0)
    _, sizes, axes = torch.linalg.svd(triangle / scale[:, None])
    least = _LEAST * sizes[:, :1].clamp(min=torch.finfo(sizes.dtype).tiny)
    factor: Tensor = axes.mT / torch.maximum(sizes, least)[:, None] / scale[..., None]
    return factor


def worst(covariances: Tensor) -> Tensor:
    """Return standard deviations (...) of covariances (..., 2, 2) in the direction in which they are largest."""
    a, b, c = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    return ((a + c) / 2 + torch.hypot((a - c) / 2, b)).clamp(min=0).sqrt()


@torch.no_grad()
def uncertainty(spread: Spread, pixels: Numbers, distance: Numbers = math.inf) -> Tensor:
    """Return the uncertainty of pixels for a single problem, see `Calibration.uncertainty`."""
    owner, like = "uncertainty", spread.parameters
    pixels = as_coordinates(pixels, "pixels", 2, owner, like.device).detach().to(like)
    distance = as_values(distance, "distance", owner, like.device).detach().to(like)
    shape = pixels.shape[:-1]
    if not bool((distance > 0).all()):
        got = distance.tolist()
        raise ValueError(f"{owner}: distance must be positive, in the unit of the board, or math.inf; got {got}")
    distance = distance.expand(shape)
    return worst(spread.of_pixels(pixels.reshape(1, -1, 2), distance.reshape(1, -1)))[0].view(shape)
