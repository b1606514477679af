"""The camera: everything that follows from a chart and a lens, written once for all models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from camtorch.charts import Chart
from camtorch.domain import Domain
from camtorch.lens import Lens
from camtorch.parameters import Memo, as_batch, as_image_size, as_planes, as_real, columns, is_concrete
from camtorch.picture import Picture
from camtorch.solve import attach, invert, rounding

if TYPE_CHECKING:
    from typing_extensions import Self

MODELS: dict[str, type[Camera]] = {}
"""Every camera model by its key; defining a model adds it."""

_INVALID_PIXEL = -1.0  # outside every picture, so that `contains` is False for it as well


class Camera(Picture):
    """A learnable camera: `pixel = focal * lens(chart(ray)) + principal_point`.

    A model states its `key`, its `distortion_names` and its `optics`; all else is done here.

    Convention: camera frame x right, y down, z forward. Pixels (u, v), u right, v down, the centre of the
    top-left pixel is (0, 0). Image sizes are (height, width). Angles are radians.

    Shapes: `*B` are the camera's batch dims, `*N` any number of point dims after them. A camera without
    batch dims takes any shape. Batch dims of size 1 broadcast.

    Args:
        intrinsics: (*B, 4) fx, fy, cx, cy in pixels.
        distortion: (*B, n) coefficients in the order of `distortion_names`; zeros if left out.
        image_size: (height, width) in pixels, shared by the batch; needed only where a picture is concerned.

    Plain values (lists, arrays, tensors) are copied into new `nn.Parameter`s of the shapes above. An `nn.Parameter`
    and a tensor that requires grad are kept as they are, so that gradients reach the network that predicted
    them, and a lens shared by a batch stays one.

    Raises:
        ValueError: a wrong shape or number of coefficients, NaN or infinite values, a focal length or an
            image size that is not positive.
        TypeError: parameters that are not numbers, an image size that is not two integers.
    """

    key: ClassVar[str]
    default_count: ClassVar[int] = 0
    """How many zero coefficients a camera has that is made without distortion."""

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
        if "key" in cls.__dict__:
            MODELS[cls.key] = cls

    def __init__(self, intrinsics, distortion=None, *, image_size: tuple[int, int] | None = None):
        super().__init__()
        owner = type(self).__name__
        intrinsics = as_real(intrinsics, "intrinsics", owner)
        if intrinsics.ndim == 0 or intrinsics.shape[-1] != 4:
            hint = f". For a matrix K use {owner}.from_matrix" if intrinsics.shape[-2:] == (3, 3) else ""
            raise ValueError(
                f"{owner}: intrinsics must be (*B, 4) = fx, fy, cx, cy; got shape {tuple(intrinsics.shape)}{hint}"
            )
        if is_concrete(intrinsics) and not bool((intrinsics[..., :2] > 0).all()):
            raise ValueError(f"{owner}: focal lengths must be positive; got fx, fy = {intrinsics[..., :2].tolist()}")
        if distortion is None:
            distortion = intrinsics.detach().new_zeros((*intrinsics.shape[:-1], self.default_count))
        distortion = as_real(distortion, "distortion", owner)
        names = self.names_of(distortion.shape[-1]) if distortion.ndim else None
        if names is None:
            raise ValueError(
                f"{owner}: distortion must be (*B, n) with {self.counts_text()}; got shape {tuple(distortion.shape)}"
            )
        batch = as_batch(owner, intrinsics=intrinsics.shape, distortion=distortion.shape)
        self.distortion_names = names
        self.image_size = as_image_size(image_size, owner)
        self._memo = Memo()
        self.hold("intrinsics", intrinsics, (*batch, 4))
        self.hold("distortion", distortion, (*batch, len(names)))

    # -- what a model states

    def optics(self, k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        """The chart and the lens made of the coefficients, each a tensor that broadcasts against planes of points."""
        raise NotImplementedError

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        """The names of that many coefficients, or None if the model does not take so many."""
        return tuple(cls.distortion_names) if count == len(cls.distortion_names) else None

    @classmethod
    def counts_text(cls) -> str:
        """How many coefficients the model takes, in words."""
        return f"n = {len(cls.distortion_names)} ({' '.join(cls.distortion_names) or 'none'})"

    # -- both directions

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The same as `project`."""
        return self.project(points)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points, or rays, of the camera frame to pixels.

        Args:
            points: (*B, *N, 3), in any unit of length; the distance does not matter.

        Returns:
            pixels (*B, *N, 2), and valid (*B, *N) bool: the point is finite, the chart covers its ray, and the ray
            lies before the fold of the lens. Whether the pixel is on the picture is another question: `contains`.
            An invalid point gets the pixel (-1, -1) and zero gradient.
        """
        planes, restore = as_planes(points, "points", 3, self.batch_shape, self._tensors, type(self).__name__)
        focal_x, focal_y, centre_x, centre_y, k, usable = self._coefficients()
        a, b, valid = self._see(planes, *self.optics(k), self._domain(k, like=planes[0]), usable)
        u = torch.where(valid, focal_x * a + centre_x, _INVALID_PIXEL)
        v = torch.where(valid, focal_y * b + centre_y, _INVALID_PIXEL)
        return restore(u, v), restore(valid)

    @staticmethod
    def _see(
        planes: Sequence[Tensor], chart: Chart, lens: Lens, domain: Domain | None, usable: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Where the lens sends points (three planes), (0, 0) if nowhere, and which of them it does send."""
        x, y, z = (plane.detach() for plane in planes)
        size = torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs())
        # NaN fails both comparisons; nearer to the origin the derivative leaves the floating-point range
        valid = (size > torch.finfo(size.dtype).tiny ** 0.5) & (size < torch.inf) & usable
        # a constant: the projection does not depend on the distance, so this has no part in its derivative
        shrink = torch.where(valid, size, 1.0).reciprocal()
        valid = valid & chart.covers(x * shrink, y * shrink, z * shrink)
        shrink = torch.where(valid, shrink, 1.0)
        a, b = chart.to_plane(
            *(torch.where(valid, plane, axis) * shrink for plane, axis in zip(planes, (0.0, 0.0, 1.0), strict=True))
        )
        if domain is not None:
            a_0, b_0 = a.detach(), b.detach()
            valid = valid & domain.contains(a_0, b_0, domain.lens.linearise(a_0, b_0)[2])
            a, b = lens(torch.where(valid, a, 0.0), torch.where(valid, b, 0.0))
        return a, b, valid

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """The ray through each pixel.

        Args:
            pixels: (*B, *N, 2).

        Returns:
            rays (*B, *N, 3) of unit length (a point at distance d is `rays * d`), and valid (*B, *N) bool: the
            ray projects to this pixel. An invalid pixel gets the optical axis (0, 0, 1) and zero gradient.
        """
        (u, v), restore = as_planes(pixels, "pixels", 2, self.batch_shape, self._tensors, type(self).__name__)
        focal_x, focal_y, centre_x, centre_y, k, usable = self._coefficients()
        chart, lens = self.optics(k)
        domain = self._domain(k, like=u)
        far = torch.maximum(((u - centre_x) / focal_x).detach().abs(), ((v - centre_y) / focal_y).detach().abs())
        valid = (far < torch.finfo(far.dtype).max ** 0.25) & usable  # NaN is not; nor may a square overflow
        p = (torch.where(valid, u, centre_x) - centre_x) / focal_x
        q = (torch.where(valid, v, centre_y) - centre_y) / focal_y
        if domain is None:
            valid = valid & chart.on_plane(p.detach(), q.detach())
            a, b = torch.where(valid, p, 0.0), torch.where(valid, q, 0.0)
        else:
            target = p.detach(), q.detach()
            start = invert(domain, *target)
            _, (ua, ub, va, vb), sense = domain.lens.linearise(*start)
            valid = valid & domain.contains(*start, sense) & chart.on_plane(*start)
            scale = torch.where(valid, ua * vb - ub * va, 1.0).reciprocal()
            inverse = [w * scale for w in (vb, -ub, -va, ua)]
            # next to a fold the polished solution may lie on its other side: what counts is where its ray is seen
            polished = chart.to_ray(*attach(domain.lens, start, inverse, target))
            seen_p, seen_q, seen = self._see([w.detach() for w in polished], chart, domain.lens, domain, usable)
            miss = torch.maximum((seen_p - target[0]).abs(), (seen_q - target[1]).abs())
            stretch = torch.maximum(ua.abs() + ub.abs(), va.abs() + vb.abs()) * torch.maximum(*(w.abs() for w in start))
            valid = valid & seen & (miss <= rounding(*target, stretch)).detach()
            start, inverse, target = ([torch.where(valid, w, 0.0) for w in ws] for ws in (start, inverse, (p, q)))
            a, b = attach(lens, start, inverse, target)
        rays = chart.to_ray(a, b)
        x, y, z = (torch.where(valid, w, axis) for w, axis in zip(rays, (0.0, 0.0, 1.0), strict=True))
        return restore(x, y, z), restore(valid)

    def _domain(self, k: Sequence[Tensor], like: Tensor) -> Domain | None:
        """The domain of the lens, if there is one: graph-free, in the dtype and on the device of `like`."""

        def tabulate() -> Domain | None:
            frozen = [c.detach() for c in k]
            return Domain(self.optics, frozen, like) if self.optics(frozen)[1].stages else None

        return self._memo(self._tensors, (like.dtype, like.device), tabulate)

    @property
    def _tensors(self) -> tuple[Tensor, Tensor]:
        return self.intrinsics, self.distortion

    def _coefficients(self):
        """fx, fy, cx, cy and the coefficients as columns, and which cameras can be used.

        A camera that learning drove to NaN or to a focal length that is not positive is replaced by
        an ideal one, and all its results are invalid.
        """
        intrinsics, distortion = self._tensors
        values = torch.cat([t.detach().expand(*self.batch_shape, -1) for t in self._tensors], -1)
        usable = torch.isfinite(values).all(-1, keepdim=True) & (values[..., :2] > 0).all(-1, keepdim=True)
        ideal = values.new_tensor([1.0, 1.0, 0.0, 0.0])
        fx, fy, cx, cy = columns(torch.where(usable, intrinsics, ideal))
        return fx, fy, cx, cy, columns(torch.where(usable, distortion, 0.0)), usable

    # -- the picture

    @property
    def batch_shape(self) -> torch.Size:
        """*B, the batch dims of the parameters."""
        return torch.broadcast_shapes(self.intrinsics.shape[:-1], self.distortion.shape[:-1])

    @property
    def K(self) -> Tensor:  # noqa: N802 (the field's name for it)
        """The (*B, 3, 3) camera matrix."""
        fx, fy, cx, cy = self.intrinsics.expand(*self.batch_shape, 4).unbind(-1)
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        return torch.stack((fx, zero, cx, zero, fy, cy, zero, zero, one), -1).unflatten(-1, (3, 3))

    @classmethod
    def from_matrix(cls, K, distortion=None, *, image_size=None, ignore_skew: bool = False) -> Self:  # noqa: N803
        """A camera from its (*B, 3, 3) matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].

        Raises:
            ValueError: not such a matrix, or a skew (its K[0, 1]) that is not zero and not to be ignored.
        """
        K = as_real(K, "K", cls.__name__)  # noqa: N806
        if K.shape[-2:] != (3, 3):
            raise ValueError(f"{cls.__name__}: K must be (*B, 3, 3); got shape {tuple(K.shape)}")
        if is_concrete(K):
            bottom = K[..., 2, :].detach()
            if bool((bottom != bottom.new_tensor([0, 0, 1])).any()) or bool((K[..., 1, 0] != 0).any()):
                raise ValueError(f"{cls.__name__}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; got {K.tolist()}")
            skew = K[..., 0, 1].detach()
            if not ignore_skew and bool((skew != 0).any()):
                raise ValueError(
                    f"{cls.__name__}: K has a skew K[0, 1] = {skew.tolist()}, which this model does not have; "
                    "ignore_skew=True drops it"
                )
        intrinsics = torch.stack((K[..., 0, 0], K[..., 1, 1], K[..., 0, 2], K[..., 1, 2]), -1)
        if distortion is None:
            return cls(intrinsics, image_size=image_size)
        return cls(intrinsics, distortion, image_size=image_size)

    def rays(self) -> tuple[Tensor, Tensor]:
        """The rays (*B, H, W, 3) of all pixels, and valid (*B, H, W)."""
        grid = self.pixel_grid()
        return self.unproject(grid.expand(*self.batch_shape, *grid.shape))

    def extra_repr(self) -> str:
        """Batch, size and, for a single camera, its numbers."""
        parts = [f"batch_shape={tuple(self.batch_shape)}"] if self.batch_shape else []
        if not self.batch_shape and is_concrete(self.intrinsics):
            named = zip(
                ("fx", "fy", "cx", "cy", *self.distortion_names), torch.cat(self._tensors, -1).tolist(), strict=True
            )
            parts += [f"{name}={value:.6g}" for name, value in named]
        elif self.distortion_names:
            parts.append(f"distortion=({' '.join(self.distortion_names)})")
        if self.image_size:
            parts.append(f"image_size={self.image_size}")
        return ", ".join(parts)
