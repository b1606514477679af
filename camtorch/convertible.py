"""What a camera model may say of itself for conversion, and `convert`. Used through `Camera`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

if TYPE_CHECKING:
    from camtorch.camera import Camera
    from camtorch.convert.conversion import Conversion


class Convertible:
    """Conversion works for every model as it is; these hooks make it exact, or start it better.

    A chart that depends on coefficients wants `fit_starts` at which it covers many rays, and `fit_bounds` that keep
    its formulas defined.
    """

    special_cases: ClassVar[tuple[tuple[str, tuple[str, ...]], ...]] = ()
    """The models that this one generalises: the key of each, and the names here of its coefficients in its order.

    A special case is this model, at the same intrinsics, with all other coefficients as in `Camera.ideal`.
    """
    fit_bounds: ClassVar[Mapping[str, tuple[float, float] | None]] = {}
    """The least and the greatest value of coefficients that a fit tries, where there are such; None: as it starts."""
    fit_starts: ClassVar[tuple[Mapping[str, float], ...]] = ({},)
    """Alternatives to start a fit from: the values of some coefficients, while the others are as in `Camera.ideal`."""
    fit_counts: ClassVar[tuple[int, ...]] = ()
    """Ascending numbers of coefficients of which a fit takes the least one that is good enough; none: the default
    one. Where there are several, further coefficients that are zero change nothing."""

    @classmethod
    def fit_start(cls, names: tuple[str, ...], angles: Tensor, radii: Tensor) -> Tensor:
        """Coefficients to start a fit from, float64; by default those of `fit_starts`.

        Args:
            names: of the n coefficients.
            angles: (C, K) radians from the axis, evenly from above 0 to the last one that is to be fitted.
            radii: (C, K) the distance from the principal point at which the camera to be fitted sees them, in units of
                its focal length at the axis and averaged over the azimuths; ascending. Where it sees nothing the
                line goes on straight.

        Returns:
            (S, C, n): S alternatives, of which the one that ends best is kept.
        """
        ideal = dict(zip(names, cls.ideal(len(names)), strict=True))
        starts = [[(ideal | values)[name] for name in names] for values in cls.fit_starts]
        return radii.new_tensor(starts).view(len(starts), 1, len(names)).expand(-1, len(radii), -1)

    def convert(
        self,
        model: type[Camera] | str,
        *,
        count: int | None = None,
        image_size: tuple[int, int] | None = None,
        max_angle: float | None = None,
        tolerance: float = 0.1,
        **options,
    ) -> Conversion:
        """The camera of another model, or number of coefficients, that comes closest to this one.

        Where the models are related and the numbers allow, it is this camera exactly: its coefficients are taken over
        bit by bit. Otherwise the squared pixel errors are least over the rays of this camera's picture (without a size:
        over all its rays) that are within `max_angle` and that the new model can express; where the largest error then
        is above the tolerance, and their root mean square below, it is brought down at the expense of smaller ones. The
        result says how good that is; a bad conversion raises no error. Rows of a batch are converted independently.

        Args:
            model: a class of cameras, or its key in `ct.MODELS`.
            count: of coefficients, for models that leave a choice. By default the least number that holds what a
                related camera has, the model's own at least; where that does not keep the tolerance, those of
                `fit_counts` are tried, and taken if they keep it or halve the largest error. Rows of a batch that need
                less have zeros.
            image_size: (height, width) of the picture, for a camera that does not say or to look at another part.
            max_angle: radians from the optical axis up to which rays matter; by default all do.
            tolerance: the largest error in pixels that is good enough.
            options: passed on to the model.

        Returns:
            A `Conversion`: camera (float64, with parameters of its own, frozen if this camera is), rms and max_error in
            pixels, max_angle in radians, valid_fraction of the picture.

        Raises:
            TypeError: no camera model. ValueError: an unknown key, a count that the model does not take, a
                `max_angle` that is not positive or beyond pi, a `tolerance` that is not positive.
        """
        from camtorch.convert.conversion import convert

        return convert(
            self, model, count=count, image_size=image_size, max_angle=max_angle, tolerance=tolerance, **options
        )
