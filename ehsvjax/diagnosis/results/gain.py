"""What an extended model gains on data that it was not fitted to."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.decision.prediction import HELD_BACK
from ehsvjax.diagnosis.decision.search import Selection
from ehsvjax.fit import Fit
from ehsvjax.record import Record

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
    """What is gained on data that were not used.

    Attributes:
        outputs: of each output, all records together.
        by_record: the same of each record, in their order.
        records: their names.
        on: says on which data.
        left_open: for each, whether the others leave open how large the causes are: it is not predicted but fitted, by
            both models, with them.
        predicted_by: of each cause, as they were found, the share of what can be removed of some output's error without
            it that is gone with it; 0 where that may be chance, or no output is predicted better with all than without
            any.

    """

    outputs: dict[str, OutputGain]
    by_record: tuple[dict[str, OutputGain], ...]
    records: tuple[str, ...]
    on: str
    left_open: tuple[bool, ...]
    predicted_by: tuple[float, ...]

    @property
    def worse(self) -> bool:
        """Whether some output is predicted worse with the causes than without any, and none better but by chance."""
        return not _removed(self.outputs) and any(g.rmse_after > g.rmse_before for g in self.outputs.values())


class _Judged(NamedTuple):
    """One record, or a part of it, that was not used, by output: residuals before and after, readings, the noise."""

    before: dict[str, Float[np.ndarray, " time"]]
    after: dict[str, Float[np.ndarray, " time"]]
    readings: dict[str, Float[np.ndarray, " time"]]
    noise_variance: dict[str, float]


def gain_of(
    selection: Selection,
    nominal: Fit,
    extended: Fit,
    validation: Sequence[Record],
    rng: np.random.Generator,
) -> Gain:
    """Return the gain on validation records; without any, on each record, predicted from the others or its own past."""
    records = validation or selection.bench.records
    names = tuple(record.name for record in records)
    if validation:
        left_open = (False,) * len(records)
        judged = [_validated(selection, nominal, extended, record) for record in validation]
        on = f"{', '.join(names)}, which {'was' if len(names) == 1 else 'were'} not used"
    else:
        left_open, judged = _without(selection, -1)
        on = "each record, predicted from the others"
        if len(records) == 1:
            on = f"the last {HELD_BACK:.0%} of the record, which was held back"
    by_record = _gains(judged, rng)
    outputs = by_record[0] if len(judged) == 1 else _gains([_together(judged)], rng)[0]
    by_all = _removed(outputs) > 0.0 and not all(left_open)
    predicted_by = tuple(
        _predicted_by(selection, 1 + k, rng) if by_all else 0.0 for k in range(len(selection.included))
    )
    return Gain(outputs, tuple(by_record), names, on, left_open, predicted_by)


def _removed(outputs: Mapping[str, OutputGain]) -> float:
    """Return the largest share of what can be removed of an output's error that is gone, if not by chance; else 0."""
    return max([min(gain.share_removed, 1.0) for gain in outputs.values() if gain.share_interval[0] > 0.0], default=0.0)


def _predicted_by(selection: Selection, without: int, rng) -> float:
    """Return the share of what one of the sets leaves of unused data that is gone with all, if not by chance."""
    left_open, judged = _without(selection, without)
    return 0.0 if all(left_open) else _removed(_gains([_together(judged)], rng)[0])


def _without(selection: Selection, without: int) -> tuple[tuple[bool, ...], list[_Judged]]:
    """Return which records are left open, and each as one of the sets of causes, and as all of them, predict it."""
    left_open = tuple(selection.unused.left_open(k, without) for k in range(len(selection.bench.records)))
    return left_open, [_of_record(selection, k, without, fitted) for k, fitted in enumerate(left_open)]


def _gains(judged: Sequence[_Judged], rng) -> list[dict[str, OutputGain]]:
    return [
        {n: _gain(one.before[n], one.after[n], one.readings[n], one.noise_variance[n], rng) for n in one.before}
        for one in judged
    ]


def _together(judged: Sequence[_Judged]) -> _Judged:
    """Return all that is judged, one after the other; of the noise the mean by readings."""
    names = dict.fromkeys(name for one in judged for name in one.before)

    def joined(field):
        return {n: np.concatenate([getattr(one, field)[n] for one in judged if n in one.before]) for n in names}

    def mean_variance(name):
        there = [one for one in judged if name in one.before]
        counts = [max(int(np.isfinite(one.readings[name]).sum()), 1) for one in there]
        return float(np.average([one.noise_variance[name] for one in there], weights=counts))

    return _Judged(joined("before"), joined("after"), joined("readings"), {n: mean_variance(n) for n in names})


def _validated(selection: Selection, nominal: Fit, extended: Fit, record: Record) -> _Judged:
    """Return what both models make of a record that they have not seen."""
    bench = selection.bench
    names = [n for n in bench.problem.observed if n in record.outputs]
    # What was not fitted has no noise by which its initial conditions could be weighed.
    judged = record.select(outputs=names)
    before, after = (fit.residuals(judged) for fit in (nominal, extended))
    # The noise of a record of which nothing is known: the mean of those that are.
    variances = {n: selection.noise.variance_of(bench.problem.observed.index(n)) for n in names}
    return _Judged(
        {n: before[n] for n in names}, {n: after[n] for n in names}, {n: record.outputs[n] for n in names}, variances
    )


def _of_record(selection: Selection, record: int, without: int, fitted: bool) -> _Judged:
    """Return one record, or the part of it that was not used: predicted, or fitted with all."""
    bench, noises, unused = selection.bench, selection.noise.of[record], selection.unused
    there = unused.noise.measured[record].any(axis=-1)
    kept = np.where(unused.noise.measured[record], 1.0, np.nan)[there]
    both = (unused.refitted if fitted else unused.residual)[[without, 0]]
    before, after = (residual[record, there] * kept for residual in both)
    readings = bench.problem.samples.outputs[record, there] * kept
    named = [(i, n) for i, n in enumerate(bench.problem.observed) if n in bench.records[record].outputs]
    return _Judged(
        {n: before[:, i] for i, n in named}, {n: after[:, i] for i, n in named}, {n: readings[:, i] for i, n in named},
        {n: noises[i].variance for i, n in named},
    )  # fmt: skip


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
