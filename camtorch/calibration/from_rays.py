"""A camera from pixels and their rays, whatever predicted them: `fit`."""

import math
from collections.abc import Collection, Sequence

import torch
from torch import Tensor

from camtorch.calibration.model import Model, asked_model
from camtorch.cameras.camera import Camera
from camtorch.cameras.operators import fixed_camera
from camtorch.convert import fitting, views
from camtorch.convert.result import Conversion
from camtorch.models import UCM
from camtorch.values.arguments import Numbers, as_image_size, as_values, hinting
from camtorch.values.threads import on_one_thread

# of unified lenses to try first: 0 is perspective, 1/2 stereographic, 0.65 nearly equidistant
_ALPHAS = (0.0, 0.35, 0.5, 0.6, 0.65, 0.75)
_NEAREST = 0.05  # the least divisor of a unified lens, for unit rays, of points that count in the first fit
_FEWEST_RAYS = 4


@on_one_thread
@torch.no_grad()
@hinting("It takes fit(model, pixels, rays, image_size=(height, width))")
def fit(
    model: type[Camera] | str | Camera,
    pixels: Numbers,
    rays: Numbers,
    *,
    weights: Numbers | None = None,
    image_size: Sequence[int] | None = None,
    count: int | None = None,
    fixed: Collection[str] | str = (),
) -> Conversion[Camera]:
    """Fit a camera of a model to rays at pixels, by least squares of the distances in px.

    The rays may come from a network, a table or a lens designer's program; give unknown rays a weight of 0, or NaN.
    `Conversion.rms` and `max_error` are the distances of the result from them, in px.

    Args:
        model: Class of cameras, its key, or a camera to start from, whose frozen parameters keep their values.
        pixels: (*N, 2).
        rays: (*N, 3) for one camera, or (*B, *N, 3) for a batch of them, of any length, in the camera's frame.
        weights: Weights of the squared errors, broadcast against the rays' (*B, *N); 1 if left out.
        image_size: (height, width) of the camera that is made; by default that of a camera to start from.
        count: Number of coefficients; the model's default if left out.
        fixed: Names of parameters to hold ("cx", "k3", ...) at the values of the camera to start from; without one
            distortion as in `ideal`, at zero, and the principal point in the middle of the image.

    Returns:
        The camera, float64, and the distances of its pixels from those of the rays with a weight.

    Raises:
        ValueError: If shapes do not fit, there are fewer than four rays, no lens looking along z makes these rays and
            pixels, a name is unknown, a focal length is fixed without a start, or cx or cy without an image_size.
        TypeError: If `model` is not a model, or values are not numeric.

    Example:
        >>> lens = ct.KannalaBrandt([300.0, 300.0, 319.5, 239.5], [0.1, 0.0, 0.0, 0.0], image_size=(480, 640))
        >>> pixels = lens.pixel_grid()[::40, ::40]
        >>> ct.fit("double_sphere", pixels, lens.unproject(pixels)[0], image_size=(480, 640))
        Conversion(rays -> DoubleSphere: rms 0.237 px, max 1.34 px, up to 67.1 degrees, 100 % of the image)
    """
    owner = "fit"
    asked = asked_model(model, count, None, fixed, as_image_size(image_size, owner), owner)
    start = asked.start
    kept = _kept_values(asked, owner)
    seen, batch = _as_seen(pixels, rays, weights, owner)
    counts = seen.valid
    lens = _fit_unified(seen, owner)
    slopes = views.focal_at_axis(lens)
    reach = torch.where(counts, seen.angles, 0.0).amax(-1)
    starts = asked.kind.fit_start(asked.names[4:], *views.radii(lens, slopes, reach.clamp(max=math.pi)))
    if start is not None:
        own = start.distortion.detach().to(starts).reshape(1, 1, -1).expand(1, *starts.shape[1:])
        starts = torch.cat((own, starts))
    ideal = slopes.new_tensor(asked.kind.ideal(asked.count)).expand(len(slopes), -1)
    template = fixed_camera(asked.kind, slopes, ideal)
    kept = kept.to(starts)
    starts = torch.where(kept[4:].isnan(), starts, kept[4:])
    parameters = fitting.fit(template, seen, starts, slopes, fixed=kept)
    camera = asked.camera(parameters.reshape(*batch, -1))
    found, valid = fixed_camera(asked.kind, parameters[:, :4], parameters[:, 4:]).project(seen.rays)
    shown = valid & counts
    errors = torch.where(shown, torch.linalg.vector_norm(found - seen.pixels, dim=-1), 0.0)
    numbers = {
        "rms": (errors.square().sum(-1) / shown.sum(-1).clamp(min=1)).sqrt(),
        "max_error": errors.amax(-1),
        "max_angle": torch.where(shown, seen.angles, 0.0).amax(-1),
        "valid_fraction": shown.sum(-1) / counts.sum(-1),
        "exact": torch.zeros_like(counts[:, 0]),
    }
    return Conversion(camera, **{name: t.reshape(batch) for name, t in numbers.items()}, source_name="rays")


def _kept_values(asked: Model, owner: str) -> Tensor:
    """Return the values (4 + n,) that parameters keep, NaN for those to find."""
    if asked.start is not None:
        values = torch.cat([t.detach().double().reshape(-1).cpu() for t in asked.start.tensors])
    elif asked.image_size is None and not bool(asked.free[2:4].all()):
        raise ValueError(f"{owner}: image_size must be given if cx or cy is fixed; got None. Pass (height, width)")
    else:
        height, width = asked.image_size or (1, 1)
        intrinsics = [torch.nan, torch.nan, (width - 1) / 2, (height - 1) / 2]
        values = torch.tensor([*intrinsics, *asked.kind.ideal(asked.count)], dtype=torch.float64, device="cpu")
    return torch.where(asked.free, torch.nan, values)


def _as_seen(
    pixels: Numbers, rays: Numbers, weights: Numbers | None, owner: str
) -> tuple[fitting.RayPixels, torch.Size]:
    """Return rows of unit rays (C, N, 3) with their pixels and weights, and the batch dims of the cameras.

    Rays that are not finite, or have no length, get no weight.
    """
    rays = as_values(rays, "rays", owner).detach().double()
    pixels = as_values(pixels, "pixels", owner, rays.device).detach().double()
    dims = pixels.ndim - 1
    form = pixels.shape[-1:], rays.shape[-1:], rays.shape[-1 - dims : -1]
    if dims < 1 or form != ((2,), (3,), pixels.shape[:-1]):
        raise ValueError(
            f"{owner}: pixels must be (*N, 2) and rays (*N, 3), or (*B, *N, 3); got pixels "
            f"{tuple(pixels.shape)} and rays {tuple(rays.shape)}"
        )
    shape = rays.shape[:-1]
    batch = shape[:-dims]
    rows = rays.reshape(batch.numel(), math.prod(shape[-dims:]), 3)
    places = pixels.expand(*shape, 2).reshape(*rows.shape[:2], 2)
    lengths = torch.linalg.vector_norm(rows, dim=-1)
    good = torch.isfinite(rows).all(-1) & torch.isfinite(places).all(-1) & (lengths > 0)
    counted = good.double()
    if weights is not None:
        given = as_values(weights, "weights", owner, rays.device).detach().to(rays)
        try:
            given = given.expand(shape).reshape(good.shape)
        except RuntimeError:
            wanted = f"weights must broadcast against the rays {tuple(shape)}"
            raise ValueError(f"{owner}: {wanted}; got {tuple(given.shape)}") from None
        if not bool(((given >= 0) & (given < math.inf)).all()):
            raise ValueError(f"{owner}: weights must be finite, and not negative; got down to {float(given.min()):.4g}")
        counted = counted * given.sqrt()  # of squares: the fit weighs errors
    axis = rows.new_tensor([0.0, 0.0, 1.0])
    unit = torch.where(good[..., None], rows / torch.where(good, lengths, 1.0)[..., None], axis)
    seen = fitting.RayPixels(unit, torch.where(good[..., None], places, 0.0), counted)
    numbers = seen.valid.sum(-1)
    if not seen.valid.numel() or not bool((numbers >= _FEWEST_RAYS).all()):
        raise ValueError(
            f"{owner}: rays must have at least {_FEWEST_RAYS} finite rows a camera; got {numbers.tolist()} "
            f"of rays {tuple(rays.shape)}"
        )
    return seen, batch


def _fit_unified(seen: fitting.RayPixels, owner: str) -> Camera:
    """Return the best of a few unified lenses (C,): their focal lengths and axis are linear in the pixels."""
    lenses, costs = [], []
    x, y, z = seen.rays.unbind(-1)
    for alpha in _ALPHAS:
        depth = alpha + (1 - alpha) * z
        inside = depth > _NEAREST
        weights, depth = torch.where(inside, seen.weights, 0.0), torch.where(inside, depth, 1.0)
        across, down = (_fit_line(w / depth, p, weights) for w, p in zip((x, y), seen.pixels.unbind(-1), strict=True))
        focal, centre = (torch.stack(pair, -1) for pair in zip(across[:2], down[:2], strict=True))
        # points that it does not see must not improve its score
        share = weights.square().sum(-1) / seen.weights.square().sum(-1)
        costs.append(torch.where((focal > 0).all(-1), across[2] + down[2], torch.inf) / share.square())
        lenses.append(torch.cat((focal, centre, torch.full_like(focal[:, :1], alpha)), -1))
    every = torch.stack(costs)
    least, best = torch.where(torch.isnan(every), torch.inf, every).min(0)
    if not bool(torch.isfinite(least).all()):
        raise ValueError(
            f"{owner}: rays must be those of a camera that looks along z, with x right and y down; got rays that none "
            "sees at these pixels. Negate y and z of OpenGL's rays (along -z, y up); pixels are (column, row)"
        )
    lens = torch.stack(lenses)[best, torch.arange(len(best), device=best.device)]
    return fixed_camera(UCM, lens[:, :4], lens[:, 4:])


def _fit_line(m: Tensor, p: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return slope, offset and mean square (C,) of the line p = slope m + offset."""
    w = weights.square()
    total = w.sum(-1, keepdim=True).clamp(min=torch.finfo(w.dtype).tiny)
    middle, at = (w * m).sum(-1, keepdim=True) / total, (w * p).sum(-1, keepdim=True) / total
    spread = (w * (m - middle).square()).sum(-1, keepdim=True)
    slope = (w * (m - middle) * (p - at)).sum(-1, keepdim=True) / spread.clamp(min=torch.finfo(w.dtype).tiny)
    offset = at - slope * middle
    square = (w * (p - slope * m - offset).square()).sum(-1, keepdim=True) / total
    return slope[:, 0], offset[:, 0], square[:, 0]
