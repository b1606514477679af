"""The camera: everything that follows from a chart and a lens, written once for all models."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, cast

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from camtorch.cameras.catalogue import Catalogue
from camtorch.cameras.editing import Editable
from camtorch.cameras.freezing import INTRINSICS, PREFIX, Freezable, learning_words, with_frozen
from camtorch.cameras.kornia import to_kornia
from camtorch.cameras.learning import parameter_groups
from camtorch.cameras.numbers import camera_of_fov, check_fast, checked_numbers, numbers_of_matrix, replaced
from camtorch.convert.result import Conversion
from camtorch.evaluate.door import refuse_jit_trace
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import is_predicted, values_of
from camtorch.optics.model_spec import ModelSpec
from camtorch.poses.extrinsics import Extrinsics
from camtorch.projection.camera_like import CameraLike
from camtorch.projection.evaluation import camera_rows, evaluate_points, evaluate_rows
from camtorch.projection.project import PROJECT
from camtorch.projection.rows import Direction
from camtorch.projection.unproject import UNPROJECT
from camtorch.rays.depth import backproject
from camtorch.rays.explanation import explain
from camtorch.rays.fields import local_pinhole, on_image, over_image, patch_centres, perspective_field, plucker
from camtorch.rays.lattices import field_of_view
from camtorch.rays.polyline import project_polyline
from camtorch.values.arguments import Numbers, broadcast_shapes, hinting, warn
from camtorch.values.module import GeometryModule, typed_as

if TYPE_CHECKING:
    from typing_extensions import TypeVar  # which checkers of types bring

    Model = TypeVar("Model", bound="Camera", default="Camera")
else:
    from typing import TypeVar

    Model = TypeVar("Model", bound="Camera")  # of which only Python 3.13 knows a default


MODELS: Catalogue[type[Camera]] = Catalogue()
"""Every camera model by its key; defining a model adds it."""

_NO_BATCH = torch.Size()


def _intrinsic(index: int, doc: str) -> Any:
    def one(camera: Camera) -> Tensor:
        return camera.intrinsics[..., index].expand(camera.batch_shape)

    return property(one, doc=doc)


def _tensor_property(name: str, doc: str) -> Any:
    """Return the property of a module's tensor, found in a tenth of the time of `nn.Module.__getattr__`."""

    def tensor(camera: Camera) -> Tensor:
        found: Tensor | None = camera._parameters.get(name)
        buffers = camera._buffers
        if found is not None and not buffers:
            return found
        if found is None:
            found = buffers.get(name)
            if found is None:
                raise AttributeError(f"{type(camera).__name__} has no {name}")
        frozen = buffers.get(of_frozen)
        return found if frozen is None else with_frozen(found, frozen)

    of_frozen = PREFIX + name
    return property(tensor, doc=doc)


class Camera(Freezable, Editable):
    """A learnable camera: `pixel = focal * lens(chart(ray)) + principal_point`.

    A model states its `key`, its `distortion_names` and its `optics`; everything else is written here.

    Convention: camera frame x right, y down, z forward. Pixels (u, v), u right, v down, the centre of the top-left
    pixel is (0, 0). Image sizes are (height, width). Angles are radians, a `fov` is degrees.

    Shapes: `*B` are the camera's batch dims, `*N` any number of point dims after them. A camera without batch dims
    takes any shape. Batch dims of size 1 broadcast.

    Args:
        intrinsics: (*B, 4) fx, fy, cx, cy in pixels.
        distortion: (*B, n) coefficients in the order of `distortion_names`; by default `ideal` ones, mostly zeros.
        image_size: (height, width) in pixels, like `image.shape`, not OpenCV's (width, height); shared by the batch,
            needed only if an image is concerned.

    Plain values (lists, arrays, tensors) are copied into new `nn.Parameter`s of these shapes. An `nn.Parameter` and a
    tensor that requires grad are used without copying, so that gradients reach the network that predicted them.

    NaN, infinite values, focal lengths that are not positive and coefficients for which the formula does not exist
    raise, but not in a batch that a network predicted, in a graph or under `torch.no_grad`: such rows project no valid
    point, and the other rows are unaffected.

    Raises:
        ValueError: If a shape, the number of coefficients, a value or the image size is wrong.
        TypeError: If parameters or the image size are not numeric, or for `Camera` itself, which is no model.

    Example:
        >>> ct.KannalaBrandt([300.0, 300.0, 319.5, 239.5]).project([0.0, 0.0, 1.0])[0].tolist()
        [319.5, 239.5]
    """

    image_size: tuple[int, int] | None
    tensor_names: ClassVar[tuple[str, ...]] = ("intrinsics", "distortion")
    memo_names: ClassVar[tuple[str, ...]] = ("_memo", "_rays", "_fields")
    intrinsics: Tensor = _tensor_property("intrinsics", "(*B, 4) fx, fy, cx, cy in pixels.")
    distortion: Tensor = _tensor_property("distortion", "(*B, n) coefficients in the order of `distortion_names`.")

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if cls.__module__ != parametrize.__name__:  # the class of one parametrized camera is no model of its own
            MODELS.add(cls)

    @hinting(
        "Pass numbers as lists, the size by name: ct.Pinhole([fx, fy, cx, cy], image_size=(height, width)), "
        "ct.KannalaBrandt([fx, fy, cx, cy], [k1, k2, k3, k4]); a matrix by ct.BrownConrady.from_matrix(K, distortion)"
    )
    def __init__(
        self, intrinsics: Numbers, distortion: Numbers | None = None, *, image_size: Sequence[int] | None = None
    ):
        if type(self).optics is Camera.optics:
            raise TypeError(
                f"{type(self).__name__}: the class must be that of a model; got {type(self).__name__}. Use "
                "ct.KannalaBrandt(intrinsics, distortion), or from_matrix(K, distortion); ct.MODELS has all models"
            )
        given = type(self), intrinsics, distortion, image_size
        intrinsics, distortion, names, batch, size = check_fast(*given) or checked_numbers(*given)
        super().__init__(
            distortion_names=names,
            image_size=size,
            **{name: Kept() for name in self.memo_names},
            _expects_unusable=is_predicted(intrinsics) or is_predicted(distortion),
        )
        self.hold("intrinsics", intrinsics, (*batch, 4))
        self.hold("distortion", distortion, (*batch, distortion.shape[-1]))

    @classmethod
    @hinting("It takes from_matrix(K, distortion, image_size=(height, width))")
    def from_matrix(
        cls,
        K: Numbers,  # noqa: N803
        distortion: Numbers | None = None,
        *,
        image_size: Sequence[int] | None = None,
        ignore_skew: bool = False,
    ) -> Self:
        """Make a camera from its matrix, as OpenCV's calibrations give it.

        Args:
            K: (*B, 3, 3) [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, or (*B, 4, 4) with it at the top left, as
                kornia has it.
            distortion: (*B, n) coefficients; with a single matrix, OpenCV's (n, 1) and (1, n) are one camera's too.
            image_size: (height, width) in pixels; OpenCV has (width, height).
            ignore_skew: Drop the skew K[0, 1], which no model here has.

        Raises:
            ValueError: If K is not such a matrix, or has a skew that is not ignored; if a column (n, 1) of coefficients
                comes with a batch of matrices; or if a fisheye gets 5, 8, 12 or 14, as calibrateCamera gives them.
        """
        return cls(*numbers_of_matrix(cls, K, distortion, ignore_skew), image_size=image_size)

    @classmethod
    @hinting("It takes from_fov(degrees, image_size=(height, width)), and perhaps axis and distortion")
    def from_fov(
        cls,
        fov: Numbers,
        *,
        image_size: Sequence[int],
        axis: Literal["horizontal", "vertical", "diagonal"] = "horizontal",
        distortion: Numbers | None = None,
    ) -> Self:
        """Make a camera from a field of view in DEGREES, for images of which nothing more is known.

        The pixels are square, the principal point is the middle of the image, and the focal length gives this
        `field_of_view` with the distortion of the lens. All of it can learn.

        Args:
            fov: degrees, one or (*B,), between the outer edges of the image.
            image_size: (height, width) in pixels.
            axis: The meaning of `fov`: "horizontal", "vertical" or "diagonal".
            distortion: (*B, n) coefficients; by default those of `ideal`.

        Raises:
            ValueError: If the lens does not reach `fov`, `fov` seems to be radians (up to 2 pi), or `axis` is unknown.
        """
        return camera_of_fov(cls, fov, image_size, axis, distortion)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Camera:  # no Self, which jsonargparse takes for no class
        """Return the camera of a calibration file that has one camera, in float64 and frozen.

        In a configuration it names a camera by its file: `class_path: camtorch.Camera.load` of jsonargparse,
        `_target_: camtorch.Camera.load` of Hydra.

        Args:
            path: A file of any format that `ct.load` reads.

        Raises:
            ValueError: If the file cannot be used, has several cameras, or one of another model than this class.
        """
        import camtorch  # the public names: files are made of cameras, so that readers stand above this package

        return camtorch.io.load_camera(cls, path)

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Camera:
        """Return the frozen camera of a dict as `to_dict` makes it; of any model if called on `ct.Camera`.

        Args:
            d: model (a key of `ct.MODELS`) and intrinsics; if there are any, distortion, image_size and dtype.

        Raises:
            ValueError: If a key is missing, unknown or has a wrong value, or the model is another than this class.
        """
        import camtorch  # as in `load`

        return camtorch.io.made_of(cls, d)

    def to_kornia(self, extrinsics: Extrinsics | None = None) -> Any:
        """Return the camera as kornia has it; `ct.from_kornia` takes it back. Gradients reach this camera's tensors.

        Args:
            extrinsics: Camera from world. With a pose a `Pinhole` is a `kornia.geometry.PinholeCamera`. Default: a
                `PinholeModel`, `BrownConradyModel` or `KannalaBrandtK3` of `kornia.sensors.camera`.

        Raises:
            ValueError: If kornia has no such model, or one without a pose; without an image_size; with two batch dims.
        """
        return to_kornia(self, extrinsics)

    def replace(
        self,
        intrinsics: Numbers | None = None,
        distortion: Numbers | None = None,
        image_size: Sequence[int] | None = None,
    ) -> Self:
        """Return the camera with other numbers or another image size; it shares everything that is left out.

        Values are checked as by the constructor. Plain ones become Parameters that learn if those that they replace do;
        lists and arrays take the camera's dtype and device. An image size alone does not change the numbers: `resize`,
        `crop` and `pad` give the camera of an edited image.

        Args:
            intrinsics: (*B, 4).
            distortion: (*B, n), of any number of coefficients that the model takes.
            image_size: (height, width) in pixels.

        Raises:
            ValueError, TypeError: If the constructor would raise them.
        """
        return replaced(self, intrinsics, distortion, image_size)

    def parameter_groups(self, lr: float = 1.0) -> list[dict[str, Any]]:
        """Return groups of parameters for an optimizer: `torch.optim.Adam(camera.parameter_groups(lr=0.5))`.

        A step of Adam, AdamW or RMSprop then moves intrinsics by about `lr` pixels. The coefficient with the largest
        effect moves the image's rim by as much; the others, in the same tensor, move it less. A batch has the lr of its
        most sensitive camera. There is no weight decay, which pulls focal lengths and coefficients to zero. SGD
        multiplies lr by the gradient, which is large for coefficients, and folds the lens. Call it after `freeze`.

        Args:
            lr: Pixels.

        Raises:
            ValueError: If nothing learns, `lr` is not positive, or there are coefficients and no image_size.
            TypeError: If a network predicted the camera, or it was made from one that learns.
        """
        return parameter_groups(self, lr)

    @property
    def batch_shape(self) -> torch.Size:
        """*B, the batch dims of the parameters."""
        intrinsics, distortion = self.intrinsics, self.distortion
        if intrinsics.ndim == distortion.ndim == 1:
            return _NO_BATCH
        shape, other = intrinsics.shape[:-1], distortion.shape[:-1]
        return shape if shape == other else broadcast_shapes(shape, other)

    @property
    def K(self) -> Tensor:  # noqa: N802 (the field's name for it)
        """The (*B, 3, 3) camera matrix."""
        fx, fy, cx, cy = self.intrinsics.expand(*self.batch_shape, 4).unbind(-1)
        zero, one = torch.zeros_like(fx), torch.ones_like(fx)
        return torch.unflatten(torch.stack((fx, zero, cx, zero, fy, cy, zero, zero, one), -1), -1, (3, 3))

    fx: Tensor = _intrinsic(0, "(*B,) the horizontal focal length in pixels; gradients go to `intrinsics`.")
    fy: Tensor = _intrinsic(1, "(*B,) the vertical focal length in pixels.")
    cx: Tensor = _intrinsic(2, "(*B,) the principal point across in pixels; 0 is the middle of the leftmost ones.")
    cy: Tensor = _intrinsic(3, "(*B,) the principal point down in pixels.")

    @property
    def height(self) -> int:
        """The image's height in pixels; a ValueError if the camera has no image size."""
        return self.size_for("height")[0]

    @property
    def width(self) -> int:
        """The image's width in pixels; see `height`."""
        return self.size_for("width")[1]

    def _model_name(self) -> str:
        # a class that only adds methods has the model of its base
        return next(cls.__name__ for cls in type(self).__mro__ if "optics" in cls.__dict__)

    def _has_left(self, name: str) -> bool:
        return name not in {model.__name__ for model in MODELS.values()}

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if self.image_size is not None and hasattr(destination, "_metadata"):
            destination._metadata[prefix[:-1]]["image_size"] = self.image_size

    def _load_from_state_dict(self, *arguments: Any) -> None:
        super()._load_from_state_dict(*arguments)
        its = arguments[2].get("image_size")
        if None not in (its, self.image_size) and its != self.image_size:
            warn(
                f"{type(self).__name__}: the state is of a camera with image_size={its}, and this one's stays "
                f"{self.image_size}. Load it into a camera of its size, and then use camera.resize"
            )

    def forward(self, points: Numbers) -> tuple[Tensor, Tensor]:
        """Project points, as `project` does."""
        return self.project(points)

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def project(self, points: Numbers) -> tuple[Tensor, Tensor]:
        """Project points, or rays, of the camera frame to pixels.

        Args:
            points: (*B, *N, 3), in any unit of length; the distance does not matter.

        Returns:
            pixels (*B, *N, 2), and valid (*B, *N) bool: the point is finite, the chart covers its ray, and the ray
            lies before the fold of the lens. Whether the pixel is on the image is another question: `contains`.
            An invalid point gets the pixel (-1, -1) and zero gradient.
        """
        return evaluate_points(self, PROJECT, points)

    def unproject(self, pixels: Numbers) -> tuple[Tensor, Tensor]:
        """Return the ray through each pixel.

        Args:
            pixels: (*B, *N, 2).

        Returns:
            rays (*B, *N, 3) of unit length (a point at distance d is `rays * d`), and valid (*B, *N) bool: the
            ray projects to this pixel. An invalid pixel gets the optical axis (0, 0, 1) and zero gradient.
        """
        return evaluate_points(self, UNPROJECT, pixels)

    def project_polyline(self, points: Numbers, extrinsics: Extrinsics | None = None) -> list[Tensor]:
        """Return the curves that straight edges in space become: a 3D box in a fisheye's image, a lane, a horizon.

        Pieces are within 0.1 px of the curve and at most 20 px long. Edges are cut where `valid` ends (not at the
        border of the image), at the seam of a panorama, and 16 times the image's larger side from its middle.

        Args:
            points: (N, 3), finite, joined in order, or (E, N, 3), E such lines, like the twelve edges (12, 2, 3) of
                a box; in the camera's frame, or the world's.
            extrinsics: camera from world. The camera and its pose are single.

        Returns:
            Pixels (M, 2) of each curve; none if nothing is seen. Points at which an edge is cut have no gradient.
        """
        return project_polyline(self, points, extrinsics)

    def _evaluate(
        self, direction: Direction, rows: Tensor, lead: torch.Size, tensors: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor]:
        return evaluate_rows(type(self), direction, rows, lead, tensors, partial(camera_rows, self), self)

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All tensors that the camera learns, or could: what rooms ask, and users do not."""
        return self.intrinsics, self.distortion

    @property
    def form(self) -> tuple[object, ...]:
        """Everything but the tensors: cameras of one form and equal tensors are the same."""
        return type(self), self.image_size

    def size_for(self, what: str) -> tuple[int, int]:
        """Return the image_size; raise if it is None."""
        if self.image_size is None:
            refuse_jit_trace()
            raise ValueError(f"{type(self).__name__}: image_size must be (height, width) for {what}; got None")
        return self.image_size

    def contains(self, pixels: Numbers) -> Tensor:
        """Whether pixels (..., 2) lie on the image, its outer pixel edges included; bool (...)."""
        return on_image(pixels, self.size_for("contains"), type(self).__name__)

    def pixel_grid(self, stride: int = 1) -> Tensor:
        """Return (H, W, 2), the centre of every pixel, or (H / stride, W / stride, 2), that of every patch.

        Args:
            stride: Pixels along each side of a patch, as of a feature map. Patch i has its middle at
                `stride * i + (stride - 1) / 2`, the first one of stride 16 at 7.5.

        Raises:
            ValueError: If there is no image size, or it is no multiple of the stride: edit the camera like the image.
        """
        like = self.intrinsics.new_empty(0, dtype=torch.promote_types(self.intrinsics.dtype, torch.float32))
        return patch_centres(self.size_for("pixel_grid"), stride, like, type(self).__name__)

    def rays(self, stride: int = 1) -> tuple[Tensor, Tensor]:
        """Return the rays (*B, H, W, 3) of all pixels, and valid (*B, H, W); or of all patches, see `pixel_grid`.

        Up to half a million rays are kept while nothing that they depend on can learn or changes.
        """
        rays, valid = over_image(self, self._rays, self.tensors, stride, self.unproject)
        return rays, valid

    def plucker(self, extrinsics: Extrinsics | None = None, stride: int = 1) -> tuple[Tensor, Tensor]:
        """Return the line in the world that every pixel or patch sees, in Pluecker coordinates.

        Args:
            extrinsics: camera from world, of batch dims that broadcast with the camera's. None: the world is the
                camera's frame, in which all lines meet in the origin.
            stride: see `pixel_grid`.

        Returns:
            (*B, H, W, 6): the unit direction d and the moment m = position x d of the line, in the world's frame and
            unit of length; and valid (*B, H, W) bool, else both are zero. d1 . m2 + d2 . m1 is 0 for lines that meet.
        """
        return plucker(*self.rays(stride), extrinsics, f"{type(self).__name__}.plucker")

    def local_pinhole(self, pixels: Numbers) -> tuple[Tensor, Tensor]:
        """Return the pinhole camera that agrees with this one to first order around each pixel.

        A ray near that of the pixel is seen at K (R ray) / z, up to the square of its distance. So a network for
        pinhole images can take a patch as an ordinary image.

        Args:
            pixels: (*B, *N, 2).

        Returns:
            R (*B, *N, 3, 3), `ray_local = R ray_camera`: its z axis is the ray of the pixel, its x axis the way
            of the ray as the pixel goes right. And K (*B, *N, 3, 3), upper triangular, with the pixel as its principal
            point and a skew if the image has one there. Both are exact, and identities if `unproject` is not valid.
        """
        return local_pinhole(self, pixels)

    def perspective_field(self, gravity: Numbers, stride: int = 1) -> tuple[Tensor, Tensor, Tensor]:
        """Return the relation of every pixel or patch to the horizon, from which networks read a camera's pose.

        This is that of Jin et al., Perspective Fields for Single Image Camera Calibration, 2023, for any lens.

        Args:
            gravity: (3,) or (*B, 3), the direction in which things fall, in the camera's frame, of any length:
                (0, 1, 0) for a level camera. `R @ down`, where R is camera from world.
            stride: see `pixel_grid`.

        Returns:
            latitude (*B, H, W) in radians, of the ray above the horizon; up (*B, H, W, 2), the unit direction (u, v) in
            which things rise, (0, 0) straight above and below; and valid (*B, H, W) bool, else zeros. Kept like `rays`.

        Raises:
            ValueError: If gravity has another shape, or length zero.
        """
        return perspective_field(self, gravity, stride)

    def backproject(self, depth: Numbers, kind: Literal["z", "distance"] = "z") -> tuple[Tensor, Tensor]:
        """Return the points of the camera frame that the pixels of a depth map show.

        Args:
            depth: (B, 1, H, W) of the camera's image_size, or (H, W), in any unit of length; floating point.
            kind: "z", the coordinate along the optical axis, which depth cameras give, or "distance", that
                from the camera, which lenses past 90 degrees need.

        Returns:
            points (*B, H, W, 3) in that unit, and valid (*B, H, W) bool: the depth is finite and positive, the pixel
            has a ray, and for "z" the ray goes ahead. A camera without batch dims gives (B, H, W, 3) for B maps.
            Invalid points are (0, 0, 0) without a gradient.

        Raises:
            ValueError: If the shape is wrong, the depth is of integers, or the kind is unknown.
        """
        return backproject(self, depth, kind)

    @property
    def field_of_view(self) -> Tensor:
        """(*B, 3) radians: horizontal, vertical and diagonal; without a graph.

        The angle that a line of the image takes, from outer pixel edge to outer pixel edge: the row and the column
        through the principal point, and the wider of both diagonals. It is the sum of the angles from the optical axis
        to both sides, so that it goes up to a whole turn, beyond the half where angles between rays end. If a line is
        not seen to its ends, because the lens folds inside the image, it is the angle between the outermost points on
        it that have rays; 0 if none has.

        Raises:
            ValueError: If the camera has no image size.
        """
        return field_of_view(self)

    @property
    def fov(self) -> Tensor:
        """(*B, 3): `field_of_view` in degrees, the unit of every argument `fov`."""
        return self.field_of_view.rad2deg()

    def explain(self, points: Numbers) -> list[str]:
        """Explain in words why points have no pixel; for a person, and slow.

        Args:
            points: (*B, *N, 3) as for `project`.

        Returns:
            A line for each point, in the order of `points.flatten(0, -2)`: "valid", or why `project` is not valid:
            "the camera itself is unusable: ...", "not finite: ...", "no direction: ...", "the chart does not cover it:
            ...", "beyond the fold at ... degrees: ..." or "beyond the edge of the surface at ..."; angles from the
            optical axis, along the azimuth of the point.
        """
        return explain(self, points)

    def convert(
        self,
        model: type[Model] | str,
        *,
        count: int | None = None,
        image_size: Sequence[int] | None = None,
        max_angle: float | None = None,
        tolerance: float = 0.1,
        **options: Any,
    ) -> Conversion[Model]:
        """Return the camera of another model, or number of coefficients, that comes closest to this one.

        If the models are related and the numbers allow, it is this camera exactly, with the same bits. Otherwise it has
        the least squared pixel errors over the rays of this camera's image (without a size: over all its rays) that are
        within `max_angle` and that the new model can express; if the largest error is above the tolerance then, and
        their root mean square below, it is reduced at the expense of smaller ones. A bad conversion does not raise: the
        result has its errors. Rows of a batch are converted independently.

        Args:
            model: a class of cameras, or its key in `ct.MODELS`.
            count: The number of coefficients, if the model leaves a choice. By default the least that holds those of a
                related camera, at least the model's own; if it does not keep the tolerance, those of `fit_counts` are
                tried, and taken if they keep it or halve the largest error. Rows that need fewer have zeros.
            image_size: (height, width) of the image, for a camera without one, or to use another part.
            max_angle: radians from the optical axis up to which rays matter; by default all do.
            tolerance: the largest error in pixels that is good enough.
            options: passed on to the model.

        Returns:
            A `Conversion`: camera (float64, with parameters of its own, frozen if this camera is), rms and max_error in
            pixels, max_angle in radians, valid_fraction of the image.

        Raises:
            TypeError: If `model` is no model. ValueError: If a key is unknown, the model does not take `count`, or
                `max_angle` (up to pi) or `tolerance` is not positive.
        """
        from camtorch.convert.conversion import convert  # few calls need this package

        options |= {"count": count, "image_size": image_size, "max_angle": max_angle, "tolerance": tolerance}
        return convert(self, cast("type[Model]", as_model(model, f"{type(self).__name__}.convert")), MODELS, **options)

    def __dir__(self) -> list[str]:
        """Return the names that users call, without those that a model states or that modules are made of."""
        inside = {*vars(ModelSpec), *vars(CameraLike), *dir(GeometryModule)}
        inside |= {"each", "form", "learn_like", "memo_names", "size_for", "tensor_names", "tensors"}
        inside -= {"distortion_names", "is_mixed", *dir(nn.Module)}
        names: list[str] = super().__dir__()  # type: ignore[no-untyped-call]
        return [n for n in names if n not in inside and (n[:1] != "_" or n[:2] == "__")]

    def _repr_html_(self) -> str:
        from camtorch.cameras.notebook import as_html  # only notebooks need it

        return as_html(self)

    def extra_repr(self) -> str:
        parts = [f"batch_shape={tuple(self.batch_shape)}"] if self.batch_shape else []
        numbers = None if self.batch_shape else values_of(torch.cat(self.tensors, -1))
        if numbers is not None:
            names = *INTRINSICS, *self.distortion_names
            parts += [f"{name}={value:.6g}" for name, value in zip(names, numbers.tolist(), strict=True)]
        elif self.distortion_names:
            parts.append(f"distortion=({' '.join(self.distortion_names)})")
        if self.image_size:
            parts.append(f"image_size={self.image_size}")
        return ", ".join([*parts, *learning_words(self)])


def as_model(model: type[Camera] | str, owner: str) -> type[Camera]:
    """Return a camera model, or the one with that key in `MODELS`."""
    return MODELS.model_for(model, owner)


def __getattr__(name: str) -> type[Camera]:
    """Return the class of a variant by its key, under which it is pickled."""
    if ":" not in name:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return as_model(name, __name__)
