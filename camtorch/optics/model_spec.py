"""What a camera model states: its coefficients and their formula, and what edits and fits have to know of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from torch import Tensor

from camtorch.optics.charts import Chart
from camtorch.optics.lens import Lens
from camtorch.values.arguments import LEFT

Optics = Callable[[Sequence[Tensor]], tuple[Chart, Lens]]
"""From coefficients, each a tensor that broadcasts against planes of points, to the chart and the lens."""


class ModelSpec:
    """What the author of a model states in a subclass of `Camera`: a `key`, `distortion_names` and `optics`.

    All else here has a default. `defined` and `ideal` are for formulas that do not exist for all coefficients,
    `odd_in_x` to `quarter_turn` for lenses that are not round, `special_cases` and `fit_...` for conversions and fits.
    """

    distortion_names: tuple[str, ...] = ()
    """The coefficients, in the order in which `distortion` has them."""
    key: ClassVar[str] = ""
    """Under which `ct.MODELS` and files know the model; without one of its own a class cannot be saved."""
    default_count: ClassVar[int] = 0
    """How many coefficients, those of `ideal`, a camera has that is made without distortion."""
    defined_text: ClassVar[str] = ""
    """In words, what `defined` asks for."""
    always_defined: ClassVar[bool] = False
    """Whether the formula exists for all coefficients, as it does where a model states no `defined`."""
    odd_in_x: ClassVar[frozenset[str]] = frozenset()
    """The coefficients that change sign when the scene is mirrored left to right."""
    odd_in_y: ClassVar[frozenset[str]] = frozenset()
    """Likewise top to bottom."""
    mirror_x: ClassVar[Mapping[str, str]] = {}
    """Where more than signs change then: the coefficients that others become, {"a": "-b"} is a = -b."""
    mirror_y: ClassVar[Mapping[str, str]] = {}
    """Likewise top to bottom."""
    quarter_turn: ClassVar[Mapping[str, str] | None] = {}
    """The coefficients that others become when the image is turned clockwise by a quarter: {"p2": "-p1"} is p2 = -p1.

    None: the model is not the same on its side.
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

    _model: ClassVar[str]  # under which operators find the class

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
    def variant(cls, text: str) -> type[Any]:
        """Return the class of the key `key:text`, such as another grid of `Splined`; a ValueError if there is none."""
        raise ValueError(f"{cls.__name__}: there is no variant {text!r:.60}. {LEFT}")

    @classmethod
    def smoothness(cls) -> Tensor | None:
        """(R, n) rows whose products with the coefficients are small in a smooth lens, float64.

        A model that states them has a lens that is linear in its coefficients, and coefficients enough to take the
        place of the intrinsics, which fits then hold, and of coefficients that are in no row.
        None: the coefficients are few.
        """
        return None

    @classmethod
    def model_for_search(cls) -> type[Any]:
        """Return the model used while a fit searches: its pixels may reach a little beyond the model's own."""
        return cls

    @classmethod
    def counts_text(cls) -> str:
        """How many coefficients the model takes, in words."""
        return f"n = {len(cls.distortion_names)} ({' '.join(cls.distortion_names) or 'none'})"

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
        starts = [[{**ideal, **values}[name] for name in names] for values in cls.fit_starts]
        return radii.new_tensor(starts).view(len(starts), 1, len(names)).expand(-1, len(radii), -1)
