"""The camera: everything that follows from a chart and a lens, written once for all models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from camtorch.projection import formulas

from camtorch.projection import ops
from camtorch.projection.autograd import Cameras, Project, Unproject
from camtorch.optics.charts import Chart
from camtorch.convertible import Convertible
from camtorch.projection.domain import Domain
from camtorch.optics.lens import Lens
from camtorch.projection.ops import finish, positive, tables, to_planes, without_keeping
from camtorch.parameters import (
    Memo,
    as_batch,
    as_image_size,
    as_real,
    as_rows,
    columns,
    has_tangent,
    in_transform,
    is_concrete,
    may_look,
)
from camtorch.picture import Picture
from camtorch.projection.solve import invert

MODELS: dict[str, type[Camera]] = {}
"""Every camera model by its key; defining a model adds it."""


class Camera(Convertible, Picture):
    """A learnable camera: `pixel = focal * lens(chart(ray)) + principal_point`.

    A model states its `key`, its `distortion_names` and its `optics`; all else is done here.

    Convention: camera frame x right, y down, z forward. Pixels (u, v), u right, v down, the centre of the
    top-left pixel is (0, 0). Image sizes are (height, width). Angles are radians.

    Shapes: `*B` are the camera's batch dims, `*N` any number of point dims after them. A camera without
    batch dims takes any shape. Batch dims of size 1 broadcast.

    Args:
        intrinsics: (*B, 4) fx, fy, cx, cy in pixels.
        distortion: (*B, n) coefficients in the order of `distortion_names`; those of `ideal`, which are zeros unless
            the model says otherwise, if left out.
        image_size: (height, width) in pixels, shared by the batch; needed only where a picture is concerned.

    Plain values (lists, arrays, tensors) are copied into new `nn.Parameter`s of the shapes above. An `nn.Parameter`
    and a tensor that requires grad are kept as they are, so that gradients reach the network that predicted
    them, and a lens shared by a batch stays one.

    Raises:
        ValueError: a wrong shape or number of coefficients, NaN or infinite values, coefficients for which the
            formula does not exist, a focal length or an image size that is not positive.
        TypeError: parameters that are not numbers, an image size that is not two integers.
    """

    key: ClassVar[str]
    default_count: ClassVar[int] = 0
    """How many coefficients, those of `ideal`, a camera has that is made without distortion."""
    defined_text: ClassVar[str] = ""
    """In words, what `defined` asks for."""

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
        cls._model = ops.register(cls)
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
            ideal = intrinsics.new_tensor(self.ideal(self.default_count))
            distortion = ideal.expand(*intrinsics.shape[:-1], self.default_count)
        distortion = as_real(distortion, "distortion", owner)
        names = self.names_of(distortion.shape[-1]) if distortion.ndim else None
        if names is None:
            raise ValueError(
                f"{owner}: distortion must be (*B, n) with {self.counts_text()}; got shape {tuple(distortion.shape)}"
            )
        batch = as_batch(owner, intrinsics=intrinsics.shape, distortion=distortion.shape)
        defined = self.defined(distortion.unbind(-1))
        if defined is not None and is_concrete(distortion) and not bool((defined > 0).all()):
            raise ValueError(f"{owner}: the formula needs {self.defined_text}; got {distortion.tolist()}")
        self.distortion_names = names
        self.image_size = as_image_size(image_size, owner)
        self._memo = Memo()
        self.hold("intrinsics", intrinsics, (*batch, 4))
        self.hold("distortion", distortion, (*batch, len(names)))

    # -- what a model states

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        """The chart and the lens made of the coefficients, each a tensor that broadcasts against planes of points."""
        raise NotImplementedError

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        """The names of that many coefficients, or None if the model does not take so many."""
        return tuple(cls.distortion_names) if count == len(cls.distortion_names) else None

    @classmethod
    def ideal(cls, count: int) -> tuple[float, ...]:
        """That many coefficients of a camera that nothing is known of. They take the place of unusable ones too."""
        return (0.0,) * count

    @staticmethod
    def defined(k: Sequence[Tensor]) -> Tensor | None:
        """Positive where the formula exists for the coefficients, tensors of one shape; None where it always does."""
        return None

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
        rows, lead, restore = as_rows(points, "points", 3, self.batch_shape, self._tensors, type(self).__name__)
        return self._map(Project, self._project_by_formulas, rows, lead, restore)

    def _project_by_formulas(self, points: Tensor, intrinsics: Tensor, distortion: Tensor, order: int = 2):
        intrinsics, distortion, domain, usable = self._traced(points, intrinsics, distortion)

        def evaluate(x: Tensor, y: Tensor, z: Tensor, intrinsics: Tensor, distortion: Tensor) -> tuple[Tensor, Tensor]:
            ray = formulas.to_ray(domain.chart, x, y, z)
            a, b, mask = formulas.see(ray, *self.optics(columns(distortion)), domain, order)
            mask = formulas.both(mask, usable)
            focal_x, focal_y, centre_x, centre_y = columns(intrinsics)
            pixels = focal_x * a + centre_x, focal_y * b + centre_y
            pixels = torch.stack([formulas.replace(mask, w, formulas.INVALID_PIXEL) for w in pixels])
            return pixels, torch.ones_like(pixels[0]) if mask is None else mask.expand_as(pixels[0])

        pixels, mask = without_keeping(evaluate, *to_planes(points), intrinsics, distortion)
        return pixels, positive(mask)

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """The ray through each pixel.

        Args:
            pixels: (*B, *N, 2).

        Returns:
            rays (*B, *N, 3) of unit length (a point at distance d is `rays * d`), and valid (*B, *N) bool: the
            ray projects to this pixel. An invalid pixel gets the optical axis (0, 0, 1) and zero gradient.
        """
        rows, lead, restore = as_rows(pixels, "pixels", 2, self.batch_shape, self._tensors, type(self).__name__)
        return self._map(Unproject, self._unproject_by_formulas, rows, lead, restore)

    def _unproject_by_formulas(self, pixels: Tensor, intrinsics: Tensor, distortion: Tensor, order: int = 2):
        intrinsics, distortion, domain, usable = self._traced(pixels, intrinsics, distortion)
        u, v = to_planes(pixels)
        p, q, mask = formulas.to_target(u.detach(), v.detach(), columns(intrinsics.detach()))
        mask = formulas.both(mask, usable)
        p, q = formulas.replace(mask, p, 0.0), formulas.replace(mask, q, 0.0)
        if domain.lens.stages:
            found = finish(self._model, domain.k, p, q, invert(domain, p, q))
            solved = formulas.to_mask(found.solved)
            solution = formulas.clean(solved, found)
        else:
            solved = formulas.to_mask(domain.chart.on_plane(p, q))
            solution = formulas.replace(solved, p, 0.0), formulas.replace(solved, q, 0.0)
        mask = formulas.both(mask, solved)

        def evaluate(u: Tensor, v: Tensor, intrinsics: Tensor, distortion: Tensor) -> Tensor:
            target = formulas.to_target(u, v, columns(intrinsics))
            optics = self.optics(columns(distortion))
            return torch.stack(formulas.rays_of(solution, target[:2], mask, *optics, order))

        if torch.compiler.is_compiling() and not any(t.requires_grad for t in (pixels, intrinsics, distortion)):
            order = 0
        rays = without_keeping(evaluate, u, v, intrinsics, distortion)
        return rays, positive(torch.ones_like(p) if mask is None else mask.expand_as(p))

    # -- how both are evaluated

    def _map(self, blockwise, by_formulas, rows: Tensor, lead: torch.Size, restore) -> tuple[Tensor, Tensor]:
        """Rows (C, N, size) by blocks, or by formulas that are traced: compiled, or by a transform of torch.func."""
        intrinsics, distortion = (_per_row(t, lead, rows) for t in self._tensors)
        inputs = rows, intrinsics, distortion
        if not in_transform() and all(is_concrete(t) and not has_tangent(t) for t in inputs):
            keeps = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
            results = blockwise.apply(*inputs, self._cameras(intrinsics, distortion), by_formulas, keeps)
        else:
            # what is compiled has no derivatives of derivatives
            results = by_formulas(*inputs, order=1 if torch.compiler.is_compiling() else 2)
        return tuple(restore(result) for result in results)

    def _cameras(self, intrinsics: Tensor, distortion: Tensor) -> Cameras:
        """The rows' cameras, kept until a value changes."""

        def look() -> Cameras:
            with torch.no_grad():
                usable = self._usable(intrinsics, distortion)
                ideal = (intrinsics, 1.0), (distortion, self._ideal(distortion))
                values = [torch.where(usable, t.detach(), w).clone() for t, w in ideal]
                mask = None if may_look(usable) and bool(usable.all()) else usable.to(intrinsics.dtype)
                return Cameras(values[0], ops.domain_of(self._model, values[1], self.optics), mask)

        return self._memo((intrinsics, distortion), (intrinsics.dtype, intrinsics.device), look)

    def _traced(self, rows: Tensor, intrinsics: Tensor, distortion: Tensor):
        """The parameters that can be used, their domain, and the mask of the usable cameras, while values are traced.

        A camera that learning drove to NaN, to a focal length that is not positive or to coefficients without a
        formula is replaced by an ideal one, and all its results are invalid.
        """
        if all(is_concrete(t) and not has_tangent(t) for t in (intrinsics, distortion)):
            cameras = self._cameras(intrinsics, distortion)
            domain, usable = cameras.domain, cameras.usable
        else:
            able = self._usable(intrinsics.detach(), distortion.detach())
            usable = able.to(rows.dtype)
            k = torch.where(able, distortion.detach(), self._ideal(distortion))
            domain = Domain(self.optics, k)
            if domain.lens.stages:
                domain.with_tables(*tables(self._model, k))
        if usable is not None:
            ideal = (intrinsics, 1.0), (distortion, self._ideal(distortion))
            intrinsics, distortion = (torch.where(usable > 0, t, w) for t, w in ideal)
        return intrinsics, distortion, domain, usable

    def _ideal(self, like: Tensor) -> float | Tensor:
        ideal = self.ideal(like.shape[-1])
        return torch.tensor(ideal, dtype=like.dtype, device=like.device) if any(ideal) else 0.0

    def _usable(self, intrinsics: Tensor, distortion: Tensor) -> Tensor:
        """Bool (C, 1): finite, with focal lengths that are positive, and coefficients for which the formula exists."""
        finite = torch.isfinite(intrinsics).all(-1) & torch.isfinite(distortion).all(-1)
        usable = finite & (intrinsics[..., :2] > 0).all(-1)
        defined = self.defined(distortion.unbind(-1))
        return (usable if defined is None else usable & (defined > 0)).unsqueeze(-1)

    @property
    def _tensors(self) -> tuple[Tensor, Tensor]:
        return self.intrinsics, self.distortion

    # -- the picture

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


def _per_row(parameters: Tensor, lead: torch.Size, rows: Tensor) -> Tensor:
    """(*B, n) as (C, n), in the dtype of the rows (C, N, size)."""
    if parameters.dtype != rows.dtype:
        parameters = parameters.to(rows.dtype)
    if not lead:
        return parameters.unsqueeze(0)
    count = parameters.shape[-1]
    return parameters.expand(*lead, count).reshape(len(rows), count)
