"""What a fit gets wrong, before any cause is named: when, at which frequencies, and against which quantity."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ehsvjax.diagnosis.decision.examination import Examination
from ehsvjax.diagnosis.hypotheses.curves import knots_along
from ehsvjax.diagnosis.hypotheses.dependence import Dependence
from ehsvjax.precision.residual_noise import residual_noise
from ehsvjax.readings import lattice

_BINS = 12
_WINDOWS = 20


class Profile(NamedTuple):
    """Mean residual by a quantity: `[bin]` its middle, the mean, and the mean's deviation under noise alone.

    `mean_after` is that of the extended model, the same where nothing was added.
    """

    middle: Float[np.ndarray, " bin"]
    mean: Float[np.ndarray, " bin"]
    mean_after: Float[np.ndarray, " bin"]
    deviation: Float[np.ndarray, " bin"]


class Spectrum(NamedTuple):
    """Power by frequency, Hz, of the residual and of the noise that the diagnosis counts on, unit^2/Hz.

    `residual_after` is that of the extended model, the same where nothing was added.
    """

    frequency: Float[np.ndarray, " frequency"]
    residual: Float[np.ndarray, " frequency"]
    residual_after: Float[np.ndarray, " frequency"]
    noise: Float[np.ndarray, " frequency"]


class OutputMisfit(NamedTuple):
    """Of one output.

    Attributes:
        rmse: of the model refitted to the records, in its unit.
        rmse_predicted: of the fit with its parameters as they stood, in its unit.
        noise_floor: standard deviation of the noise, in its unit.
        above_noise: share of the residual's sum of squares that is not noise.
        residual: `[time]` measured minus simulated; NaN where nothing is measured.
        in_time: `[window]` of equal length, the residual's rms over the noise's.
        in_frequency: its spectrum and the noise's.
        against: quantity -> mean residual by it.
        whiteness: p-value of the residual being white (Ljung-Box); it cannot tell misfit from coloured noise.
        coloured: whether the noise is counted as correlated.
        outliers: `[time]` readings that stand alone and were left out.
        lattice: step of the lattice on which the readings lie, in its unit; None where none shows.

    """

    rmse: float
    rmse_predicted: float
    noise_floor: float
    above_noise: float
    residual: Float[np.ndarray, " time"]
    in_time: Float[np.ndarray, " window"]
    in_frequency: Spectrum
    against: dict[str, Profile]
    whiteness: float
    coloured: bool
    outliers: Bool[np.ndarray, " time"]
    lattice: float | None


class Misfit(NamedTuple):
    """What the nominal model gets wrong.

    Attributes:
        by_record: the outputs by name, of each record in turn.
        tests: whether the residual depends on something, the most significant first.
        tests_after: the same of what the extended model leaves.

    """

    by_record: tuple[dict[str, OutputMisfit], ...]
    tests: tuple[Dependence, ...]
    tests_after: tuple[Dependence, ...]

    @property
    def outputs(self) -> dict[str, OutputMisfit]:
        """Of the first record, by name."""
        return self.by_record[0]


def misfit_of(examined: Examination, outliers: Bool[np.ndarray, "record time signal"]) -> Misfit:
    """Return what the nominal model gets wrong, judged by the noise that the whole diagnosis counts on."""
    bench = examined.selection.bench
    predicted = bench.problem.samples.outputs - bench.simulated(bench.nominal[None])[0]
    return Misfit(
        tuple(_of_record(examined, predicted[k], outliers[k], k) for k in range(len(bench.records))),
        examined.before,
        examined.after,
    )


def _of_record(
    examined: Examination,
    predicted: Float[np.ndarray, "time signal"],
    outliers: Bool[np.ndarray, "time signal"],
    record: int,
) -> dict[str, OutputMisfit]:
    """Return what is wrong in one record; `predicted` is what the fit left of it as it stood."""
    selection = examined.selection
    bench = selection.bench
    samples, present = bench.problem.samples, bench.present[record]
    outputs = {}
    for i, name in enumerate(bench.problem.observed):
        if name not in bench.records[record].outputs:
            continue
        measured = samples.measured[record, present, i]
        residual, after = (
            np.where(measured, refits.residual[0, record, present, i], np.nan)
            for refits in (selection.nominal, selection.final)
        )
        noise = selection.noise.of[record][i]
        found = residual_noise(
            np.nan_to_num(residual)[None] / np.nanstd(residual), measured[None], "white"
        )  # fmt: skip
        square = float(np.nanmean(residual**2))
        outputs[name] = OutputMisfit(
            rmse=square**0.5,
            rmse_predicted=float(np.mean(predicted[present, i][measured] ** 2)) ** 0.5,
            noise_floor=noise.variance**0.5,
            above_noise=float(np.clip(1.0 - noise.variance / square, 0.0, 1.0)),
            residual=residual,
            in_time=_in_time(residual) / noise.variance**0.5,
            in_frequency=_in_frequency(residual, after, noise, float(samples.sample_period[record])),
            against={
                quantity: _against(residual, after, series[record, present], noise)
                for quantity, series in selection.seen.items()
                if np.ptp(series[record, present]) > 0
            },
            whiteness=found.p_value,
            coloured=bool(len(noise.coefficients)),
            outliers=outliers[present, i],
            lattice=lattice(samples.outputs[record, present, i][measured]),
        )
    return outputs


def _in_time(residual) -> Float[np.ndarray, " window"]:
    windows = np.array_split(residual, min(_WINDOWS, len(residual)))
    return np.array([np.sqrt(np.nanmean(w**2)) if np.isfinite(w).any() else np.nan for w in windows])


def _in_frequency(residual, after, noise, period) -> Spectrum:
    from scipy.signal import welch

    # A straight line across what is missing: a jump to zero and back would pass for noise at every frequency.
    at, kept = np.arange(len(residual)), np.isfinite(residual)
    whole = np.array([np.interp(at, at[kept], series[kept]) for series in (residual, after)])
    frequency, (power, power_after) = welch(whole, 1.0 / period, nperseg=min(len(residual), 1024))
    angle = np.exp(-2j * np.pi * frequency * period)
    response = 1.0 - sum(c * angle ** (k + 1) for k, c in enumerate(noise.coefficients))
    noise_power = 2.0 * period * noise.innovation_variance / np.abs(response) ** 2
    noise_power = np.broadcast_to(noise_power, frequency.shape)
    return Spectrum(frequency[1:], power[1:], power_after[1:], noise_power[1:])


def _against(residual, after, series, noise) -> Profile:
    edges = knots_along(series, _BINS + 1)
    which = np.clip(np.searchsorted(edges, series, side="right") - 1, 0, len(edges) - 2)
    kept = np.isfinite(residual)
    middle, mean, mean_after, deviation = [], [], [], []
    for b in range(len(edges) - 1):
        inside = kept & (which == b)
        count = int(inside.sum())
        if count:
            middle.append(float(np.mean(series[inside])))
            mean.append(float(np.mean(residual[inside])))
            mean_after.append(float(np.mean(after[inside])))
            # Correlated samples tell less of a mean.
            deviation.append(float(np.sqrt(noise.variance * min(noise.correlation_samples, count) / count)))
    return Profile(*map(np.array, (middle, mean, mean_after, deviation)))
