"""The layer that turns features into valid cameras."""

import functools
import math
from collections.abc import Collection, Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from camtorch.calibration.model import asked_model
from camtorch.cameras.camera import Camera
from camtorch.networks.limits import Limits
from camtorch.networks.prior import prior_of
from camtorch.optics.radial_inverse import precise
from camtorch.values.arguments import as_coordinates, as_flag, as_image_size, as_number, as_whole
from camtorch.values.module import GeometryModule, typed_as

_NEVER_FIXED = "fx", "fy", "all"
_ASPECT = 0.1
_LARGEST_NUMBER = 1e6  # its square is finite, and its gradient negligible
_NODES = 33


class CameraHead(GeometryModule):
    """A layer from features (*B, features) to cameras (*B), each of which has a ray for every point of its image.

    A linear layer turns features into numbers, named by `names`, and the camera is valid for any numbers:

    * The logarithm of the focal length, and the principal point, are mapped to their ranges by x / sqrt(1 + x^2).
    * The coefficients are k = given + d / sqrt(1 + g^2). d scales the numbers so that each 1 moves the rim of the image
      by a tenth of its distance from the axis, and lopsided terms by a hundredth; d / g is the limit in this direction,
      at which the lens would fold on the image or bend too much, see `Limits`.

    Both are nearly linear well within their limits, and can come arbitrarily close to them. Their gradients fade with
    the third power of the numbers, not exponentially. With any coefficients the corners of the image show the same
    rays as with the given ones at the predicted focal length, so `fov` always holds. For charts with coefficients
    (`UCM`, `DoubleSphere`, `Division`, ...) the focal length near the axis is the same instead.

    The layer starts with weights of zero: every camera is then `prior`.

    Args:
        features: Number of features.
        model: Class of cameras or its key in `ct.MODELS`; or a camera, which is then the prior.
        image_size: (height, width) of the images in pixels; that of a given camera if left out.
        fov: Least and greatest horizontal field of view in DEGREES, of the given lens; the prior has the geometric mean
            of both focal lengths. (40, 120) if left out; for a given camera 1.5 times its focal length, and down to as
            many times less if its lens shows the corners of such images.
        count: Number of coefficients, for models with a choice.
        centre: Largest move of the principal point from the prior's, as a part of the image's width and height.
        fixed: Names of numbers that remain as in the prior: "cx", "cy", "k3", ...
        shared_focal: Whether fx and fy are one number, in the ratio of the prior; else it may change by ten percent.

    Raises:
        ValueError: If the lens does not reach a field of view, or not with the corners of the image, or it seems to
            be in radians; if the model is a panorama, a name is unknown, or the model does not take the count.
        TypeError: If `model` is not a model, or `fov` is not a pair of numbers.

    Example:
        >>> head = ct.CameraHead(256, "kannala_brandt", image_size=(480, 640), fov=(60, 120))
        >>> cameras = head(torch.zeros(8, 256))
        >>> cameras.batch_shape, round(float(cameras.fov[0, 0]))
        (torch.Size([8]), 85)
    """

    model: type[Camera]
    image_size: tuple[int, int]
    centre: float
    shared_focal: bool
    names: tuple[str, ...]
    linear: nn.Linear

    def __init__(
        self,
        features: int,
        model: type[Camera] | str | Camera,
        *,
        image_size: Sequence[int] | None = None,
        fov: Sequence[float] | None = None,
        count: int | None = None,
        centre: float = 0.1,
        fixed: Collection[str] | str = (),
        shared_focal: bool = True,
    ):
        super().__init__()
        owner = type(self).__name__
        features = as_whole(features, "features", owner, least=1)
        names = (fixed,) if isinstance(fixed, str) else fixed
        if isinstance(names, Collection) and any(isinstance(name, str) and name in _NEVER_FIXED for name in names):
            raise ValueError(f"{owner}: fixed must not name fx, fy or all; got {fixed!r}. Use fov=(90, 90)")
        asked = asked_model(model, count, None, fixed, as_image_size(image_size, owner), owner)
        known, size = None if asked.start is None else asked.start.image_size, asked.image_size
        if size is None:
            raise ValueError(f"{owner}: image_size must be given; got None. Pass image_size=(height, width)")
        if known not in (None, size):
            raise ValueError(f"{owner}: image_size must be that of the camera, {known}; got {size}")
        centre = as_number(centre, "centre", owner)
        shared_focal = as_flag(shared_focal, "shared_focal", owner)
        if not 0 <= centre < 0.5:
            raise ValueError(f"{owner}: centre must be a part of the image, from 0 to below 0.5; got {centre!r}")
        self.model, self.image_size, self.centre, self.shared_focal = asked.kind, size, centre, shared_focal
        prior = prior_of(asked, size, self.centre, 0.0 if shared_focal else _ASPECT, fov, owner)
        least, given, most = (math.log(disc) for disc in prior.discs)
        discs = torch.linspace(least, most, _NODES, dtype=torch.float64)
        scales = prior.scales(discs.exp())
        free = asked.free.tolist()
        # numbers without effect, like the angles of a table, cannot be learnt
        self._coefficients = [i for i, moves in enumerate((scales > 0).all(0).tolist()) if moves and free[4 + i]]
        self._centres = [i for i in range(2) if free[2 + i] and centre > 0]
        self.names = (
            "focal",
            *(() if shared_focal else ("aspect",)),
            *(("cx", "cy")[i] for i in self._centres),
            *(prior.names[i] for i in self._coefficients),
        )
        """Names of the numbers, in order: "focal", "aspect" if it is free, "cx", "cy", and those of coefficients."""
        share = (2 * given - least - most) / (most - least) if most > least else 0.0
        share = min(max(share, -1 + 1e-6), 1 - 1e-6)
        filled = Limits(asked.kind, prior.lens).filled(prior.lens[None], discs.new_full((1, 1), prior.discs[1]))
        constant = functools.partial(nn.Buffer, persistent=False)
        self._discs: Tensor = constant(discs)
        self._scales: Tensor = constant(scales[:, self._coefficients].log())
        self._start: Tensor = constant(discs.new_tensor(share / math.sqrt(1 - share * share)))
        self._far: Tensor = constant(prior.focal * filled[0, 0])
        self._ratio: Tensor = constant(discs.new_tensor(prior.aspect))
        self._middle: Tensor = constant(discs.new_tensor(prior.middle))
        self._lens: Tensor = constant(prior.lens)
        self.linear = nn.Linear(features, len(self.names))
        nn.init.zeros_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)

    @property
    def prior(self) -> Camera:
        """The camera for numbers that are all zero."""
        return self.camera(self._discs.new_zeros(len(self.names), dtype=self.linear.weight.dtype))

    def forward(self, features: Tensor) -> Camera:
        """Return cameras (*B) for features (*B, features)."""
        features = as_coordinates(features, "features", self.linear.in_features, type(self).__name__, form="*B")
        device = features.device.type
        with torch.autocast(device, enabled=False) if torch.amp.is_autocast_available(device) else nullcontext():
            return self.camera(self.linear(features.to(self.linear.weight.dtype)))

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def camera(self, numbers: Tensor) -> Camera:
        """Return cameras (*B) for numbers (*B, n) in the order of `names`, for use with your own layer.

        Numbers are clamped to +- a million; NaN makes a camera without valid points.
        """
        owner = f"{type(self).__name__}.camera"
        means = f", {', '.join(self.names)}"
        numbers = as_coordinates(numbers, "numbers", len(self.names), owner, form="*B", means=means)
        dtype = torch.promote_types(numbers.dtype, torch.float32)
        rows = precise(numbers.to(dtype).reshape(-1, len(self.names)).clamp(-_LARGEST_NUMBER, _LARGEST_NUMBER))
        first = len(self.names) - len(self._coefficients)
        given, free = rows[:, :first], rows[:, first:]
        least, most = self._discs[0].to(rows), self._discs[-1].to(rows)
        disc = least + (most - least) * (1 + _bound(given[:, :1] + self._start.to(rows))) / 2
        lens = self._lens.to(rows)
        limits = Limits(self.model, lens)
        k = lens + self._moves(limits, free, disc)
        disc = disc.exp()
        focal = self._far.to(rows) / limits.filled(k, limits.disc(k, disc))
        half = self._ratio.to(rows) / 2
        half = half if self.shared_focal else half + _ASPECT / 2 * _bound(given[:, 1:2])
        height, width = self.image_size
        centre = self._middle.to(rows).expand(rows.shape[0], 2)
        if self._centres:
            reach = rows.new_tensor([width, height])[self._centres] * self.centre
            moved = reach * _bound(given[:, first - len(self._centres) :])
            index = torch.tensor(self._centres, device=rows.device)
            centre = centre + torch.zeros_like(centre).index_copy(1, index, moved)
        intrinsics = torch.cat((focal * (-half).exp(), focal * half.exp(), centre), -1).to(dtype)
        lead = numbers.shape[:-1]
        distortion = k.to(dtype).reshape(*lead, len(lens)) if len(lens) else None
        camera = self.model(intrinsics.reshape(*lead, 4), distortion, image_size=self.image_size)
        return camera.requires_grad_(False) if isinstance(camera.intrinsics, nn.Parameter) else camera

    def _moves(self, limits: Limits, numbers: Tensor, disc: Tensor) -> Tensor:
        """Return offsets (R, n) from the given coefficients for numbers (R, free) and logarithms (R, 1) of discs."""
        # len(numbers) would be a constant in torch.export
        none = numbers.new_zeros(numbers.shape[0], len(limits.given))
        if not self._coefficients:
            return none
        if torch.onnx.is_in_onnx_export():  # which has no cummax
            raise RuntimeError(
                f"{type(self).__name__}: model must be 'pinhole' in torch.onnx.export; got {self._model_name()}. "
                "Export the network up to head.linear, and call head.camera(numbers) in Python; torch.export takes all"
            )
        step = (self._discs[-1] - self._discs[0]).to(numbers) / (_NODES - 1)
        place = ((disc - self._discs[0].to(numbers)) / step.clamp(min=1e-12)).clamp(0, _NODES - 1)
        before = place.detach().nan_to_num().long().clamp(max=_NODES - 2)
        table = self._scales.to(numbers)
        scale = torch.lerp(table[before[:, 0]], table[before[:, 0] + 1], place - before).exp()
        size = torch.linalg.vector_norm(numbers, dim=-1, keepdim=True)
        moves = none.index_copy(1, torch.tensor(self._coefficients, device=numbers.device), numbers * scale)
        gauge = size / limits.along(moves / size.clamp(min=1e-12), disc.exp())
        return moves * torch.rsqrt(1 + gauge * gauge)

    def _model_name(self) -> str:
        return self.model.__name__

    def extra_repr(self) -> str:
        return f"{self._model_name()}, image_size={self.image_size}, numbers=({' '.join(self.names)})"


def _bound(x: Tensor) -> Tensor:
    """Map x to -1 to 1: like x near zero, with gradients that fade with the third power."""
    return x * torch.rsqrt(1 + x * x)
