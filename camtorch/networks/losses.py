"""Losses between cameras, for networks that predict them: on rays, and on pixels."""

import math
from collections.abc import Sequence
from typing import Literal, TypedDict, Unpack, overload

import torch
from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.values.arguments import (
    Numbers,
    as_batch,
    as_coordinates,
    as_number,
    as_values,
    as_whole,
    broadcast_shapes,
    no_camera,
    shown,
)

__all__ = ["angles", "rays", "reprojection"]


def angles(first: Tensor, second: Tensor) -> Tensor:
    """Return the angles (...) in radians between directions (..., 3), from 0 to pi, exact to rounding at both ends.

    The gradient has length 1, and is zero between equal or opposite directions, at which it does not exist. acos of the
    dot product is off by 3e-4 in float32, and its gradient is infinite there. Source: Kahan, "How futile are mindless
    assessments of roundoff in floating-point computation?", 2006, section 12.

    Args:
        first: Directions of any length except zero.
        second: Other directions; both broadcast.
    """
    first = as_coordinates(first, "first", 3, "angles")
    second = as_coordinates(second, "second", 3, "angles", first.device)
    as_batch("angles", first=first.shape, second=second.shape)
    a, b = (w / torch.linalg.vector_norm(w, dim=-1, keepdim=True) for w in (first, second))
    # the norm has a gradient of zero at zero
    return 2 * torch.atan2(torch.linalg.vector_norm(a - b, dim=-1), torch.linalg.vector_norm(a + b, dim=-1))


class _Points(TypedDict, total=False):
    samples: int | tuple[int, int]
    weights: Numbers | None


class _Pixels(_Points, total=False):
    pixels: Numbers | None


class _Seen(_Points, total=False):
    penalty: float | None


@overload
def rays(
    predicted: Camera, target: Camera, *, reduction: Literal["mean"] = "mean", **options: Unpack[_Pixels]
) -> Tensor: ...


@overload
def rays(
    predicted: Camera, target: Camera, *, reduction: Literal["none"], **options: Unpack[_Pixels]
) -> tuple[Tensor, Tensor]: ...


def rays(
    predicted: Camera,
    target: Camera,
    *,
    samples: int | tuple[int, int] = 16,
    pixels: Numbers | None = None,
    weights: Numbers | None = None,
    reduction: Literal["mean", "none"] = "mean",
) -> Tensor | tuple[Tensor, Tensor]:
    """Return the angles between the rays that two cameras have for the same pixels of their images.

    Cameras may be of any models. Errors of focal length, principal point and distortion count by their effect.

    Args:
        predicted: Cameras with any batch dims *B.
        target: Cameras with any batch dims; both broadcast.
        samples: Rows and columns of pixels to compare, the middles of equal parts of the image; a number for both.
        pixels: (*B, *N, 2), pixels to compare instead.
        weights: Weights of the angles, broadcast against them.
        reduction: "mean" over the angles that are valid in both, by weight; "none" for all of them.

    Returns:
        The mean in radians, 0 if nothing is valid; or angles (*B, rows, columns), or (*B, *N) for pixels, times the
        weights, 0 without a gradient if they are not valid, and valid in the same shape.

    Raises:
        ValueError: If images have different sizes or none, and there are no pixels; if the reduction is unknown.
        TypeError: If `predicted` or `target` is not a camera.
    """
    owner = "losses.rays"
    batch = _check(predicted, target, owner)
    if pixels is None:
        places = _places(predicted, target, samples, batch, owner)
    else:
        places = as_values(pixels, "pixels", owner, predicted.intrinsics.device)
    (a, ours), (b, theirs) = predicted.unproject(places), target.unproject(places)
    return _reduce(angles(a, b), ours & theirs, weights, reduction, owner)


@overload
def reprojection(
    predicted: Camera,
    target: Camera | Tensor,
    points: Tensor | None = None,
    *,
    reduction: Literal["mean"] = "mean",
    **options: Unpack[_Seen],
) -> Tensor: ...


@overload
def reprojection(
    predicted: Camera,
    target: Camera | Tensor,
    points: Tensor | None = None,
    *,
    reduction: Literal["none"],
    **options: Unpack[_Seen],
) -> tuple[Tensor, Tensor]: ...


def reprojection(
    predicted: Camera,
    target: Camera | Tensor,
    points: Tensor | None = None,
    *,
    samples: int | tuple[int, int] = 16,
    weights: Numbers | None = None,
    penalty: float | None = None,
    reduction: Literal["mean", "none"] = "mean",
) -> Tensor | tuple[Tensor, Tensor]:
    """Return the distances in pixels between the projections of points by the predicted camera and by the target.

    A point that the predicted camera does not see has zero gradient, and does not count by default: the loss falls if a
    lens folds over its points. Pass a `penalty` in training, so that each lost point shows.

    Args:
        predicted: Cameras with batch dims *B.
        target: The camera with the true projections, or their pixels (*B, *N, 2), NaN if unseen.
        points: (*B, *N, 3) in the camera's frame; the rays of the target's own image if left out, see `samples`.
        samples: See `rays`.
        weights: See `rays`.
        penalty: Distance in pixels of a point that the target sees and the predicted camera does not, like the diagonal
            of the image. The mean is then over the points that the target sees, and each lost one raises it unless it
            was farther off. None: the mean is over points that both see.
        reduction: See `rays`.

    Returns:
        The mean distance over points, or distances (*B, *N) and which of them count; see `rays`.

    Raises:
        ValueError: If there are pixels without points, the penalty is not positive, or `rays` would raise.
        TypeError: If `predicted` is no camera.
    """
    owner = "losses.reprojection"
    if isinstance(target, Camera):
        batch = _check(predicted, target, owner)
        if points is None:
            pixels = _places(predicted, target, samples, batch, owner)
            points, seen = target.unproject(pixels)
        else:
            pixels, seen = target.project(points)
    else:
        _check(predicted, predicted, owner)
        if points is None:
            raise ValueError(f"{owner}: points must be given if target is pixels; got None. Pass points (*B, *N, 3)")
        pixels = as_values(target, "target", owner, predicted.intrinsics.device)
        seen = torch.isfinite(pixels).all(-1)
        pixels = torch.where(seen.unsqueeze(-1), pixels, 0.0)
    found, valid = predicted.project(points)
    try:
        off = found - pixels
    except RuntimeError:
        got = f"{tuple(pixels.shape)} and {tuple(found.shape)}"
        raise ValueError(f"{owner}: pixels of target and of the points must broadcast; got {got}") from None
    distances = torch.linalg.vector_norm(off, dim=-1)  # without a gradient for a point that has no pixel
    if penalty is None:
        return _reduce(distances, valid & seen, weights, reduction, owner)
    if not 0 < as_number(penalty, "penalty", owner) < math.inf:
        raise ValueError(f"{owner}: penalty must be a positive number of pixels; got {shown(penalty)}")
    # no camera sees a point without a direction, such as the zeros that fill up a batch
    size = as_values(points, "points", owner, predicted.intrinsics.device).detach().abs().amax(-1)
    seen = (seen & size.isfinite() & (size > 0)).expand(distances.shape)
    return _reduce(torch.where(valid, distances, float(penalty)), seen, weights, reduction, owner)


def _check(predicted: Camera, target: Camera, owner: str) -> torch.Size:
    """Return the batch dims of two cameras after checking their types and shapes."""
    for camera, name in ((predicted, "predicted"), (target, "target")):
        if not isinstance(camera, Camera):
            raise TypeError(f"{owner}: {name} must be a Camera; got {no_camera(camera)}")
    shapes = predicted.batch_shape, target.batch_shape
    try:
        return broadcast_shapes(*shapes)
    except ValueError:
        got = " and ".join(str(tuple(shape)) for shape in shapes)
        raise ValueError(f"{owner}: batch dims of predicted and target must broadcast; got {got}") from None


def _places(
    predicted: Camera, target: Camera, samples: int | tuple[int, int], batch: Sequence[int], owner: str
) -> Tensor:
    """Return the middles (*B, rows, columns, 2) of equal parts of the image."""
    sizes = {camera.image_size for camera in (predicted, target) if camera.image_size is not None}
    if len(sizes) != 1:
        what = " and ".join(map(str, sorted(sizes))) if sizes else "none"
        raise ValueError(f"{owner}: image_size must be the same for both cameras; got {what}")
    height, width = sizes.pop()
    pair = samples if isinstance(samples, (tuple, list)) else (samples, samples)
    if len(pair) != 2 or any(as_whole(count, "samples", owner) < 1 for count in pair):
        raise ValueError(f"{owner}: samples must be rows and columns, or a number for both; got {samples!r}")
    dtype = torch.promote_types(predicted.intrinsics.dtype, torch.float32)
    v, u = (
        (torch.arange(count, dtype=dtype, device=predicted.intrinsics.device) + 0.5) * (side / count) - 0.5
        for count, side in zip(pair, (height, width), strict=True)
    )
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).expand(*batch, *pair, 2)


def _reduce(
    values: Tensor, valid: Tensor, weights: Numbers | None, reduction: str, owner: str
) -> Tensor | tuple[Tensor, Tensor]:
    values = torch.where(valid, values, 0.0)
    weighing = valid.to(values.dtype)
    if weights is not None:
        given = as_values(weights, "weights", owner, values.device).to(values.dtype)
        try:
            values, weighing = values * given, weighing * given
        except RuntimeError:
            wanted = f"weights must broadcast against {tuple(valid.shape)}"
            raise ValueError(f"{owner}: {wanted}; got {tuple(given.shape)}") from None
    if not isinstance(reduction, str) or reduction not in ("mean", "none"):
        raise ValueError(f'{owner}: reduction must be "mean" or "none"; got {shown(reduction)}')
    if reduction == "none":
        return values, valid
    return values.sum() / weighing.sum().clamp(min=torch.finfo(values.dtype).tiny)
