"""Lenses like a given one: coefficients move by their effect on the image, if the lens stays invertible."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.cameras.operators import CameraNumbers, opaque
from camtorch.evaluate.door import in_transform, outside_transforms, without_derivatives
from camtorch.lenses.drawing import covering
from camtorch.native.structs import AMOUNTS, JITTER_PARTS, RIM
from camtorch.rays.lattices import defined_or, movement, polar_rays, reach
from camtorch.values.module import remade
from camtorch.warp.boxes import along_edges

_LOPSIDED_SHARE = 0.1  # decentering, prism and tilt move images by less than radial terms, as in real lenses
_MOST_MEASURED = 64  # lenses whose measures are kept


def jittered(camera: Camera, amounts: Tensor, nominal: Tensor) -> Tensor:
    """Return distortion coefficients (*B, n) of lenses like that of `camera`, moved by amounts (*B, 16).

    Every coefficient moves until it has moved the image's rim by its amount, a share of the distance from the centre to
    the corner of a lens of `nominal` intrinsics; together at most by the largest amount. If the new lens could not be
    inverted on the rim of the old one's image, coefficients move as far the other way, or half as far and so on, or not
    at all.
    """
    with torch.no_grad():
        return _jittered(camera, amounts, nominal)[0]


def _shapes(camera: CameraNumbers, amounts: Tensor, nominal: Tensor) -> tuple[Tensor]:
    return (amounts.new_empty(*amounts.shape[:-1], camera.distortion.shape[-1]),)


@opaque(_shapes)
def _jittered(camera: Camera, amounts: Tensor, nominal: Tensor) -> tuple[Tensor]:
    if in_transform():
        with outside_transforms():
            camera, amounts = camera.each(without_derivatives), without_derivatives(amounts)
            return (jittered(camera, amounts, without_derivatives(nominal)),)
    count = camera.distortion.shape[-1]
    measured = measured_once(sensitivity, camera, camera.distortion, nominal).to(amounts).reshape(-1, count)
    steps = amounts.reshape(-1, AMOUNTS).repeat(1, -(-count // AMOUNTS))[:, :count] * measured
    lens = remade(camera, intrinsics=camera.intrinsics.reshape(-1, 4), distortion=camera.distortion.reshape(-1, count))
    rim, given = _rim(lens), lens.distortion.expand_as(steps)
    if len(rim) < len(steps):
        rim = rim.expand(len(steps), -1, -1)
    result, done = given, None
    for part in JITTER_PARTS:
        candidate, defined = defined_or(camera, given + part * steps, given)
        tried = remade(lens, intrinsics=lens.intrinsics.expand(len(candidate), 4), distortion=candidate)
        fits = tried.unproject(rim)[1].all(-1)
        fits = fits if defined is None else fits & defined
        if done is None and bool(fits.all()):  # usually the first step fits
            return (candidate.view(*amounts.shape[:-1], count),)
        done = torch.zeros_like(fits) if done is None else done
        result = torch.where((fits & ~done).unsqueeze(-1), candidate, result)
        done |= fits
        if bool(done.all()):
            break
    return (result.view(*amounts.shape[:-1], count).clone(),)


_measured: dict[tuple[object, ...], Tensor] = {}


def measured_once(measure: Callable[..., Tensor], camera: Camera, *inputs: Tensor) -> Tensor:
    """Return `measure(camera, *inputs)`, kept by the inputs and the image size, on which alone it depends."""
    # by values on every device: a lens is in other memory each time
    values = [(t.dtype, t.shape, t.device, t.detach().cpu().numpy().tobytes()) for t in inputs]
    key = measure, type(camera), camera.image_size, *values
    found = _measured.pop(key, None)
    if found is None:
        with torch.inference_mode(False), torch.no_grad():  # a tensor of inference mode could not be used in a graph
            found = measure(camera, *[t.detach().clone() for t in inputs])
    _measured[key] = found  # move it to the end
    while len(_measured) > _MOST_MEASURED:
        _measured.pop(next(iter(_measured)), None)
    return found


def sensitivity(camera: Camera, distortion: Tensor, nominal: Tensor) -> Tensor:
    """Return how much to change each coefficient, (*B, n), so that the rim moves from centre to corner."""
    most = movement(camera, distortion, nominal).numpy()
    odd = camera.odd_in_x | camera.odd_in_y
    lopsided = np.array([name in odd for name in camera.distortion_names], bool)
    share = np.where(lopsided, np.float32(_LOPSIDED_SHARE), np.float32(1)) / np.float32(max((~lopsided).sum(), 1))
    corner = math.hypot(*camera.size_for("the effect of its coefficients")) / 2
    return torch.from_numpy(share * np.where(most > 0, corner / most.clip(min=1e-30), 0.0)).to(distortion.device)


def _rim(camera: Camera) -> Tensor:
    """Return pixels (C, N, 2) on the outline of the image that lenses map; the principal point for others.

    A lens that is invertible on the image's edges, and where it ends on the image, is invertible inside.
    """
    edges = border(camera.size_for("its rim"), camera.intrinsics.dtype).to(camera.intrinsics.device)
    rim = edges.expand(*camera.batch_shape, *edges.shape)
    if len(camera.distortion) == 1:  # less work on other devices than a check of all rays
        ends = measured_once(lens_ends, camera, camera.distortion)
        least = (ends * ends).sum(-1).amin(-1).sqrt()
        if bool((covering(camera.intrinsics, least, camera.size_for("its rim")) == 1).all()):
            return rim
    if not bool(camera.unproject(rim)[1].all()):
        focal, centre = camera.intrinsics[:, None, :2], camera.intrinsics[:, None, 2:]
        # edited images have different intrinsics, but few different coefficients
        lenses, which = camera.distortion.detach().unique(dim=0, return_inverse=True)
        ends = measured_once(lens_ends, camera, lenses).to(focal)[which] * focal + centre
        ends = torch.where(camera.contains(ends).unsqueeze(-1), ends, rim[:, :1])
        rim = torch.cat((rim, ends.expand(len(rim), -1, -1)), 1)
        rim = torch.where(camera.unproject(rim)[1].unsqueeze(-1), rim, centre)
    return rim


@lru_cache(maxsize=16)
def border(size: tuple[int, int], dtype: torch.dtype) -> Tensor:
    """Return pixels (N, 2) along the outer edges of images of a size."""
    height, width = size
    with torch.inference_mode(False):
        corners = torch.tensor([[0, 0], [width, 0], [width, height], [0, height]], dtype=torch.float64) - 0.5
        return along_edges(corners, RIM // 4).to(dtype)


def lens_ends(camera: Camera, distortion: Tensor) -> Tensor:
    """Return the last point (*B, K, 2), in focal lengths, along every azimuth that lenses map."""
    ones = distortion.new_tensor([1.0, 1.0, 0.0, 0.0]).double()
    plane = remade(camera, intrinsics=ones, distortion=distortion.detach().double())
    azimuths = torch.linspace(0, 2 * math.pi, RIM + 1, dtype=torch.float64, device=ones.device)[:-1]

    def seen(rays: Tensor) -> tuple[Tensor, Tensor]:
        return plane.project(rays.expand(*plane.batch_shape, *rays.shape[-3:]))

    ends = reach(lambda rays: seen(rays)[1], azimuths, steps=64, rounds=2)
    return seen(polar_rays(ends, azimuths).unsqueeze(-2))[0].squeeze(-2)
