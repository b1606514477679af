"""Random lenses like a given one: coefficients moved by what they do to the image, as far as it stays invertible."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from camtorch._module import same
from camtorch.augment.change import camera_like, frozen
from camtorch.camera import Camera
from camtorch.projection.ops import CLASSES
from camtorch.projection.rays import image_lattice
from camtorch.warp.polygons import along_edges

DRAWN = 16
"""How many coefficients have a draw of their own; more take turns."""
_SMALL = 0.1  # decentering, prism and tilt, whose images are lopsided, move less than radial terms: as in real lenses
_STEP = 1e-4
_HALVINGS = 4
_SIDE = 9
_EDGE_SAMPLES = 32
_AZIMUTHS = 128
_ANGLES = 64


def jittered(camera: Camera, amounts: Tensor, nominal: Tensor) -> Tensor:
    """Distortion coefficients (*B, n) of lenses like that of `camera`.

    Every coefficient moves until it has moved the image's rim by its amount, together at most by the largest amount.
    Where the new lens could not be inverted on the rim of what the old one shows, its coefficients move as far the
    other way; or half as far, or a quarter, and so on; or stay.

    Args:
        camera: with image_size, and without batch dims or with those of the amounts.
        amounts: (*B, 16), shares of the distance from the image's centre to its corner, signed.
        nominal: (4,) or (*B, 4), intrinsics of the same lens before anything was drawn: what a coefficient does to the
            rim is measured there.
    """
    with torch.no_grad():
        if torch.compiler.is_compiling():
            numbers = camera.intrinsics, camera.distortion
            return _opaque_jittered(camera._model, *numbers, list(camera.image_size), amounts, nominal)
        return _jittered(camera, amounts, nominal)


def _jittered(camera: Camera, amounts: Tensor, nominal: Tensor) -> Tensor:
    base = camera.distortion.expand(*camera.batch_shape, -1)
    count = base.shape[-1]
    if count == 0:
        return base.expand(*amounts.shape[:-1], 0)
    columns = torch.arange(count, device=amounts.device) % DRAWN
    odd = camera.odd_in_x | camera.odd_in_y
    lopsided = torch.tensor([name in odd for name in camera.distortion_names], device=amounts.device)
    share = torch.where(lopsided, _SMALL, 1.0) / max(int((~lopsided).sum()), 1)
    usual = camera_like(camera, nominal.detach(), camera.distortion.detach(), camera.image_size)
    step = amounts[..., columns] * share * _kept(_sensitivity, usual, nominal, camera.distortion).to(amounts)
    rim = _rim(camera)
    unseen = ~camera.unproject(rim)[1]
    result = base.expand_as(step)
    left = torch.ones(step.shape[:-1], dtype=torch.bool, device=step.device)
    for part in (sign / 2**halving for halving in range(_HALVINGS) for sign in (1, -1)):
        candidate, defined = _defined(camera, base + part * step, base)
        numbers = (t.expand(*step.shape[:-1], -1) for t in (camera.intrinsics, candidate))
        lens = camera_like(camera, *numbers, camera.image_size)
        seen = lens.unproject(rim.expand(*lens.batch_shape, *rim.shape[-2:]))[1]
        invertible = (seen | unseen).all(-1) & defined
        result = torch.where((left & invertible).unsqueeze(-1), candidate, result)
        left = left & ~invertible
        if not bool(left.any()):
            break
    return result


@torch.library.custom_op("camtorch::jittered", mutates_args=())
def _opaque_jittered(
    model: str, intrinsics: Tensor, distortion: Tensor, size: Sequence[int], amounts: Tensor, nominal: Tensor
) -> Tensor:
    camera = frozen(CLASSES[model](intrinsics.detach(), distortion.detach()), tuple(size))
    return _jittered(camera, amounts, nominal).clone()


@_opaque_jittered.register_fake
def _(model, intrinsics, distortion, size, amounts, nominal):
    return amounts.new_empty(*amounts.shape[:-1], distortion.shape[-1])


_KEPT = 8
_known: list[tuple[tuple, tuple[Tensor, ...], Tensor]] = []


def _kept(measure: Callable[[Camera], Tensor], camera: Camera, *inputs: Tensor) -> Tensor:
    """`measure(camera)`, which depends on these tensors. The last results are kept: mostly the lens is the same one."""
    options = (measure, type(camera), camera.image_size)
    for known_options, known_inputs, result in _known:
        if known_options == options and all(map(same, known_inputs, inputs)):
            return result
    result = measure(camera)
    _known.insert(0, (options, tuple(t.detach().clone() for t in inputs), result))
    del _known[_KEPT:]
    return result


def _sensitivity(camera: Camera) -> Tensor:
    """(*B, n): by how much to change a coefficient to move the rim by the distance from the centre to the corner."""
    pixels = image_lattice(camera, _SIDE, _SIDE).flatten(0, 1)
    camera = camera_like(camera, camera.intrinsics.double(), camera.distortion.double(), camera.image_size)
    batch, count = camera.batch_shape, camera.distortion.shape[-1]
    rays, seen = camera.unproject(pixels.double().expand(*batch, *pixels.shape))
    rays = rays.unsqueeze(-3).expand(*batch, count, *pixels.shape[:-1], 3)
    ends = []
    for sign in (-1, 1):
        change = sign * _STEP * torch.eye(count, dtype=torch.float64, device=rays.device)
        given = camera.distortion.expand(*batch, count).unsqueeze(-2)
        distortion, _ = _defined(camera, given + change, given)
        intrinsics = camera.intrinsics.expand(*batch, 4).unsqueeze(-2).expand(*batch, count, 4)
        ends.append(camera_like(camera, intrinsics, distortion, camera.image_size).project(rays))
    (before, valid), (after, also) = ends
    moved = (after - before).norm(dim=-1) / (2 * _STEP)
    most = torch.where(valid & also & seen.unsqueeze(-2), moved, 0.0).amax(-1)
    height, width = camera.image_size
    corner = ((width / 2) ** 2 + (height / 2) ** 2) ** 0.5
    return torch.where(most > 0, corner / most.clamp(min=1e-30), 0.0)


def _defined(camera: Camera, distortion: Tensor, otherwise: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients (*B, n), others where the model's formula does not exist for them, and bool (*B,): it does."""
    sense = camera.defined(distortion.unbind(-1))
    if sense is None:
        return distortion, torch.ones_like(distortion[..., 0], dtype=torch.bool)
    return torch.where((sense > 0).unsqueeze(-1), distortion, otherwise), sense > 0


def _rim(camera: Camera) -> Tensor:
    """(*B, N, 2): the outline of what the lens shows of the image: of both, the image's edges and where the lens ends.

    What is mapped has no holes: a lens that is invertible on the outline is so inside.
    """
    height, width = camera.image_size
    corners = camera.intrinsics.new_tensor([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    edges = along_edges(corners, _EDGE_SAMPLES)
    ends = _kept(_ends, camera, camera.distortion)
    ends = ends.to(edges) * camera.intrinsics[..., None, :2] + camera.intrinsics[..., None, 2:]
    inside = camera.contains(ends)
    return torch.cat((edges.expand(*ends.shape[:-2], -1, -1), torch.where(inside.unsqueeze(-1), ends, edges[0])), -2)


def _ends(camera: Camera) -> Tensor:
    """(*B, K, 2): on the plane of unit focal length, the last point along every azimuth that the lens maps."""
    ones = camera.distortion.new_tensor([1.0, 1.0, 0.0, 0.0]).double()
    plane = camera_like(camera, ones, camera.distortion.detach().double(), None)
    azimuth = torch.linspace(0, 2 * math.pi, _AZIMUTHS + 1, dtype=torch.float64, device=ones.device)[:-1, None]
    share = torch.linspace(0, 1, _ANGLES + 1, dtype=torch.float64, device=ones.device)
    low, width = 0.0, math.pi
    for _ in range(2):  # the second time between the last angle that is mapped and the first that is not
        angle = low + width * share
        rays = torch.stack(
            torch.broadcast_tensors(angle.sin() * azimuth.cos(), angle.sin() * azimuth.sin(), angle.cos()), -1
        )
        pixels, valid = plane.project(rays.expand(*plane.batch_shape, *rays.shape[-3:]))
        last = (valid.long().cumprod(-1).sum(-1, keepdim=True) - 1).clamp(min=0)
        low, width = angle.expand(valid.shape).gather(-1, last), width / _ANGLES
    return pixels.gather(-2, last.unsqueeze(-1).expand(*last.shape, 2)).squeeze(-2)
