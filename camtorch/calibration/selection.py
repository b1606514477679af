"""The choice of a model for a lens, by cross-validation over views."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camtorch.calibration.calibrate import calibrate
from camtorch.calibration.model import Model
from camtorch.calibration.observations import Points, as_observations
from camtorch.calibration.verdict import Calibration
from camtorch.cameras.camera import MODELS, Camera

CANDIDATES: tuple[tuple[str, int], ...] = (  # models that are tried, with their numbers of coefficients
    ("pinhole", 0),
    ("brown_conrady", 5),
    ("brown_conrady", 8),
    ("kannala_brandt", 4),
    ("eucm", 2),
    ("double_sphere", 2),
    ("mei", 5),
    ("fisheye62", 8),
    ("fisheye624", 12),
)
_FOLDS = 5
_NOTHING = 1e-6  # px: errors up to here are rounding
_WORSE = 0.01  # the part by which an error may be larger before more coefficients are taken
_MUCH_WORSE = 0.05  # the part above which they are taken, however much views differ


@dataclass
class Trial:
    """The errors of a model with a number of coefficients."""

    model: str
    count: int
    rms: float  # px per point of all views together, NaN if it failed
    held_out: float  # px per point of held-out views, to which only poses were fitted; NaN if it failed
    errors: NDArray[Any]  # (V,) mean squared of each view, held out
    reason: str = ""  # why it failed, or empty


@dataclass
class Selection:
    """The chosen model, all trials, and the reason in words."""

    trials: list[Trial]
    best: Trial
    why: str

    def lines(self) -> list[str]:
        """Return a table, and the reason below it."""
        lines = [f"  {'model':<14}  coefficients  rms fitted  rms held out"]
        for trial in self.trials:
            note = "  taken" if trial is self.best else f"  failed: {trial.reason:.60}" if trial.reason else ""
            lines.append(f"  {trial.model:<14}  {trial.count:>12}  {trial.rms:>10.4f}  {trial.held_out:>12.4f}{note}")
        return [*lines, self.why]


def select(
    object_points: Points,
    image_points: Points,
    *,
    image_size: Sequence[int],
    candidates: Iterable[tuple[str, int]] = CANDIDATES,
    loss: str | None = None,
    loss_scale: float = 1.0,
    fixed: Sequence[str] = (),
    progress: Callable[[float], None] | None = None,
) -> Selection:
    """Find the model that predicts held-out views best, the simplest if several are about equal.

    Each of five parts of the views is held out once: a camera is fitted to the others, and only the poses to that part.
    The model with the smallest error is chosen, or one with fewer coefficients if it is worse by at most 1 %, or by at
    most 5 % and at most the standard error of the views' difference.

    Arguments are those of `calibrate`; `fixed` may name parameters that a model does not have, and `progress` is called
    with the part that is done. candidates: models and their numbers of coefficients.
    """
    seen, layout = as_observations(object_points, image_points, image_size, "select")
    points = seen.points.cpu().numpy()
    pixels = np.where(seen.seen[..., None].cpu(), seen.pixels.cpu(), np.nan)

    def calibrated(rows: NDArray[Any], model: str | Camera, **options: Any) -> Calibration:
        return calibrate(model, points[rows], pixels[rows], image_size=layout.image_size, **options)

    corners = np.isfinite(pixels[..., 0]).sum(1)  # of each view
    numbers = np.arange(len(corners))

    def tried(model: str, count: int) -> Trial:
        names = [name for name in fixed if name in Model(MODELS[model], count).names]
        options = {"fixed": names, "loss": loss, "loss_scale": loss_scale}
        errors = np.full(len(numbers), np.nan)
        try:
            whole = calibrated(numbers, model, count=count, **options)
            if not whole.converged:
                raise ValueError("no optimum was found")
            folds = min(_FOLDS, len(numbers))
            for fold in range(folds):
                out = numbers % folds == fold
                part = calibrated(np.flatnonzero(~out), whole.camera, **options)
                posed = calibrated(np.flatnonzero(out), part.camera, fixed="all", loss=None)
                errors[out] = np.nanmean(np.square(np.asarray(posed.residuals)).sum(-1), axis=1)
            held_out = math.sqrt(float((corners * errors).sum() / corners.sum()))
            if not math.isfinite(held_out):
                raise ValueError("held-out views have corners without a pixel")
        except ValueError as error:
            return Trial(model, count, math.nan, math.nan, errors, str(error))
        return Trial(model, count, whole.rms, held_out, errors)

    models, trials = list(candidates), []
    for number, (model, count) in enumerate(models, 1):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the numbers of a trial show what is wrong
            trials.append(tried(model, count))
        if progress is not None:
            progress(number / len(models))
    fitted = [trial for trial in trials if not trial.reason]
    if not fitted:
        raise ValueError(f"select: one of candidates must fit; got none. {trials[0].model}: {trials[0].reason}")
    least = min(fitted, key=lambda trial: trial.held_out)

    def as_good(trial: Trial) -> bool:
        more, worse = trial.errors - least.errors, trial.held_out / max(least.held_out, _NOTHING) - 1
        noise = float(more.std()) / math.sqrt(len(more))
        return worse <= _WORSE or (worse <= _MUCH_WORSE and float(more.mean()) <= noise)

    best = min(filter(as_good, fitted), key=lambda trial: trial.count)  # the first of as many, which is better known
    named = f"{best.model} with {best.count} coefficients" if best.count else best.model
    why = "the smallest error"
    if best is not least:
        share = f"{100 * (1 - least.held_out / best.held_out):.1f} %"
        why = f"{least.model} with {least.count} has {share} less, which is no more than chance"
    why = f"{named}: {best.held_out:.4g} px on views that it was not fitted to; {why}"
    return Selection(trials, best, why)
