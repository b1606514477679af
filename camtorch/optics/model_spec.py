"""The statements of a camera model: its coefficients and their formula, and facts for edits and fits."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from torch import Tensor

from camtorch.optics.charts import Chart
from camtorch.optics.lens import Lens
from camtorch.values.arguments import LEFT

Optics = Callable[[Sequence[Tensor]], tuple[Chart, Lens]]
"""A function of coefficients, tensors that broadcast against planes of points, that returns the chart and the lens."""


class ModelSpec:
    """The statements of a model's author in a subclass of `Camera`: a `key`, `distortion_names` and `optics`.

    Everything else has a default. `defined` and `ideal` are for formulas that do not exist for all coefficients,
    `odd_in_x` to `quarter_turn` for lenses that are not round, `special_cases` and `fit_...` for conversions and fits.
    """

    distortion_names: tuple[str, ...] = ()
    """The names of the coefficients, in the order of `distortion`."""
    key: ClassVar[str] = ""
    """The name of the model in `ct.MODELS` and files; a class without a key of its own cannot be saved."""
    default_count: ClassVar[int] = 0
    """The number of coefficients, those of `ideal`, of a camera that is made without distortion."""
    defined_text: ClassVar[str] = ""
    """The condition of `defined` in words, like "xi > -1"."""
    always_defined: ClassVar[bool] = False
    """Whether the formula exists for all coefficients; set by camtorch: True if a model does not state `defined`."""
    odd_in_x: ClassVar[frozenset[str]] = frozenset()
    """The coefficients that change sign when the scene is mirrored left to right."""
    odd_in_y: ClassVar[frozenset[str]] = frozenset()
    """The coefficients that change sign when the scene is mirrored top to bottom."""
    mirror_x: ClassVar[Mapping[str, str]] = {}
    """Coefficients that become others, if more than signs change: {"a": "-b"} means a = -b, mirrored left to right."""
    mirror_y: ClassVar[Mapping[str, str]] = {}
    """The same mirrored top to bottom."""
    quarter_turn: ClassVar[Mapping[str, str] | None] = {}
    """The coefficients that others become when the image is turned clockwise by a quarter: {"p2": "-p1"} is p2 = -p1.

    None: the model is not the same on its side.
    """
    turn_axis: ClassVar[int | None] = None
    """Where images of a whole turn meet: 0, left and right; 1, top and bottom; None, such images have ends."""
    has_poles: ClassVar[bool] = False
    """Whether images of a whole turn end, along the other axis, in rows or columns that show one direction, a pole."""
    special_cases: ClassVar[tuple[tuple[str, tuple[str, ...]], ...]] = ()
    """The models that this one generalises: the key of each, and the names here of its coefficients in its order.

    A special case is this model, at the same intrinsics, with all other coefficients as in `Camera.ideal`.
    """
    fit_bounds: ClassVar[Mapping[str, tuple[float, float] | None]] = {}
    """The least and the greatest value of coefficients that a fit tries, if limited; None holds the first value."""
    fit_starts: ClassVar[tuple[Mapping[str, float], ...]] = ({},)
    """Alternatives to start a fit from: the values of some coefficients, while the others are as in `Camera.ideal`."""
    fit_counts: ClassVar[tuple[int, ...]] = ()
    """Ascending numbers of coefficients, of which a fit takes the least one that is good enough; by default the default
    one. If there are several, further coefficients that are zero change nothing."""

    operator_name: ClassVar[str] = ""  # by which operators find the class

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        """Return the chart and the lens for coefficients, tensors that broadcast against planes of points."""
        raise NotImplementedError

    @classmethod
    def names_of(cls, count: int) -> tuple[str, ...] | None:
        """Return the names of that many coefficients, or None if the model does not take so many."""
        return tuple(cls.distortion_names) if count == len(cls.distortion_names) else None

    @classmethod
    def ideal(cls, count: int) -> tuple[float, ...]:
        """Return the coefficients of a camera that nothing is known of. They also replace unusable ones."""
        return (0.0,) * count

    @staticmethod
    def defined(k: Sequence[Tensor]) -> Tensor | None:
        """Return a margin, positive if the formula exists for coefficients of one shape; None if it always does."""
        return None

    @classmethod
    def variant(cls, text: str) -> type[Any]:
        """Return the class of the key `key:text`, such as another grid of `Splined`; a ValueError if there is none."""
        raise ValueError(f"{cls.__name__}: key must be one of ct.MODELS; got the variant {text!r:.60}. {LEFT}")

    @classmethod
    def smoothness(cls) -> Tensor | None:
        """Return rows (R, n), float64, whose products with the coefficients are small in a smooth lens, or None.

        A model that states them has a lens that is linear in its coefficients, and enough coefficients to replace the
        intrinsics, which fits then hold, and coefficients that are in no row.
        """
        return None

    @classmethod
    def model_for_search(cls) -> type[Any]:
        """Return the model used while a fit searches: its pixels may reach a little beyond the model's own."""
        return cls

    @classmethod
    def counts_text(cls) -> str:
        """Return in words how many coefficients the model takes."""
        return f"n = {len(cls.distortion_names)} ({' '.join(cls.distortion_names) or 'none'})"

    @classmethod
    def fit_start(cls, names: tuple[str, ...], angles: Tensor, radii: Tensor) -> Tensor:
        """Return coefficients to start a fit from, float64; by default those of `fit_starts`.

        Args:
            names: The names of the n coefficients.
            angles: (C, K) radians from the axis, evenly from above 0 to the last one to fit.
            radii: (C, K) the distance from the principal point at which the camera to fit sees them, in focal lengths
                at the axis and averaged over the azimuths; ascending. Past the camera's view the line goes on straight.

        Returns:
            (S, C, n): S alternatives, of which the one that ends best is kept.
        """
        ideal = dict(zip(names, cls.ideal(len(names)), strict=True))
        starts = [[{**ideal, **values}[name] for name in names] for values in cls.fit_starts]
        return radii.new_tensor(starts).view(len(starts), 1, len(names)).expand(-1, len(radii), -1)
