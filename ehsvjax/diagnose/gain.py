"""What an extended model gains on data that it was not fitted to."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnose.noise import Whitening
from ehsvjax.diagnose.refits import padded, refit
from ehsvjax.diagnose.selection import Selection
from ehsvjax.fit import Fit
from ehsvjax.record import Record

# Of a record that is held back where there is no other.
_HELD_BACK = 0.3
_BLOCKS = 20
_DRAWS = 2000


class OutputGain(NamedTuple):
    """Of one output, on data that were not used for fitting.

    Attributes:
        rmse_before, rmse_after: of the nominal and of the extended model, in the output's unit.
        fit_before, fit_after: 100*(1 - NRMSE), %.
        noise_floor: standard deviation of the noise, in the output's unit: no model can do better.
        share_removed: of the squared error above the noise, how much the extension removed; NaN if there was none.
        share_interval: 95% interval of that share, by blocks of time.

    """

    rmse_before: float
    rmse_after: float
    fit_before: float
    fit_after: float
    noise_floor: float
    share_removed: float
    share_interval: tuple[float, float]


class Gain(NamedTuple):
    """Of all outputs, by name; `on` says on which data."""

    outputs: dict[str, OutputGain]
    on: str


def gain_of(
    selection: Selection,
    nominal: Fit,
    extended: Fit,
    validation: Record | None,
    rng: np.random.Generator,
) -> Gain:
    """Return the gain on a validation record, or on the last part of the record, held back from both refits."""
    if validation is None:
        before, after, measured, on = _held_back(selection)
    else:
        names = [n for n in selection.bench.problem.observed if n in validation.outputs]
        # What was not fitted has no noise by which its initial conditions could be weighed.
        judged = validation.select(outputs=names)
        residuals = [fit.residuals(judged) for fit in (nominal, extended)]
        before, after = ({n: r[n] for n in names} for r in residuals)
        measured = {n: validation.outputs[n] for n in names}
        on = f"{validation.name}, which was not used"
    noises = dict(zip(selection.bench.problem.observed, selection.white.noises, strict=True))
    return Gain(
        {n: _gain(before[n], after[n], measured[n], noises[n].variance, rng) for n in before}, on
    )  # fmt: skip


def _held_back(selection: Selection):
    """Return residuals before and after, and readings, of the last part; both models refitted to the first alone."""
    bench = selection.bench
    samples = bench.problem.samples
    counted = np.cumsum(samples.measured[0].sum(axis=-1))
    cut = int(np.searchsorted(counted, (1.0 - _HELD_BACK) * counted[-1]))
    used = selection.white.used.copy()
    used[:, cut:] = False
    white = Whitening(selection.white.noises, used)
    width = selection.final.chosen.shape[1]
    sets = [bench.columns_with(()), bench.columns_with(selection.included)]
    starts = np.stack([selection.nominal.points[0], selection.final.points[0]])
    refitted = refit(bench, starts, padded(sets, width), white, race=False)
    kept = np.where(samples.measured, 1.0, np.nan)[0, cut:]
    before, after = (refitted.residual[k, 0, cut:] * kept for k in (0, 1))
    readings = samples.outputs[0, cut:] * kept
    names = bench.problem.observed
    return (
        {n: before[:, i] for i, n in enumerate(names)},
        {n: after[:, i] for i, n in enumerate(names)},
        {n: readings[:, i] for i, n in enumerate(names)},
        f"the last {_HELD_BACK:.0%} of the record, which was held back",
    )


def _gain(before, after, readings, noise_variance, rng) -> OutputGain:
    kept = np.isfinite(readings)
    # A simulation that is not finite is infinitely wrong, not missing.
    before, after = (np.where(np.isfinite(r), r, np.inf) for r in (before, after))
    if not kept.any():
        # Of several outputs one may not have been measured there.
        nothing = float("nan")
        return OutputGain(*(nothing,) * 4, noise_variance**0.5, nothing, (nothing, nothing))
    before, after, readings = before[kept], after[kept], readings[kept]
    about_mean = float(np.mean((readings - readings.mean()) ** 2))
    squares = np.stack([before**2, after**2], axis=1)
    mean = squares.mean(axis=0)
    removable = mean[0] - noise_variance
    share, low, high = (float("nan"),) * 3
    # A removable error within what noise does to a mean square is none.
    if np.isfinite(mean).all() and removable > 4.0 * noise_variance * np.sqrt(2.0 / len(before)):
        share = float((mean[0] - mean[1]) / removable)
        drawn = _redrawn(squares, rng)
        # What is removable is taken as it is, for a short misfit would be in few of the drawn blocks: what is left of
        # it is what is uncertain.
        shares = 1.0 - (drawn[:, 1] - noise_variance) / removable
        low, high = (float(q) for q in np.quantile(shares, [0.025, 0.975]))
    rmse, fits = np.sqrt(mean), 100.0 * (1.0 - np.sqrt(mean / about_mean))
    return OutputGain(
        rmse_before=float(rmse[0]),
        rmse_after=float(rmse[1]),
        fit_before=float(fits[0]),
        fit_after=float(fits[1]),
        noise_floor=noise_variance**0.5,
        share_removed=share,
        share_interval=(low, high),
    )


def _redrawn(squares: Float[np.ndarray, "sample model"], rng) -> Float[np.ndarray, "draw model"]:
    """Return mean squares of blocks of time drawn anew."""
    blocks = np.array([b.mean(axis=0) for b in np.array_split(squares, min(_BLOCKS, len(squares)))])
    return blocks[rng.integers(0, len(blocks), (_DRAWS, len(blocks)))].mean(axis=1)
