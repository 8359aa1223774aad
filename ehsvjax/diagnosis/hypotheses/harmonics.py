"""The frequencies at which harmonic effects are tried: those at which they would explain most of a residual.

What an effect does at some frequency is the sum of what it does in short parts of the record, which need to be
simulated once only. Frequencies too high for the parts are looked for in the residual itself. Where the inputs repeat
themselves, their own frequency and its multiples are left out: what goes by them a nonlinear model makes of its inputs.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ehsvjax import kernels
from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.parts import Parts, parts_at
from ehsvjax.diagnosis.bench.refits import Refits, unexplained
from ehsvjax.diagnosis.bench.workbench import AT_ONCE, Workbench, duration_of
from ehsvjax.effects.effect import Candidate, Scales

# Frequencies of each effect that are tried.
_TRIED = 3
# Two frequencies differ if they drift apart by this many periods along the record; the search looks closer.
_APART, _CLOSE = 2.0, 0.2
# Periods of the highest frequency whose share over a part is known well enough.
_PERIODS_PER_PART = 0.35
# Periods of an input that repeats itself, at least, and how alike they are, as a correlation.
_LEAST_PERIODS, _ALIKE = 4, 0.99


class Waves(NamedTuple):
    """What a harmonic effect adds to its signal at each frequency that parts of the record are short enough for.

    Attributes:
        parts: of the record, and what a disturbance of the signal over each of them does.
        edge: the frequency from which on the parts are too long, rad/s.
        frequencies: below it, rad/s.
        shares: what each of the effect's amplitudes adds to the signal in each part.

    """

    parts: Parts
    edge: float
    frequencies: Float[np.ndarray, " frequency"]
    shares: Float[np.ndarray, "frequency amplitude part"]


def waves_of(bench: Workbench) -> dict[str, Waves]:
    """Return the waves of every harmonic effect whose sum of parts is known, by the candidate's name."""
    some = [c for c in bench.candidates if _by_parts(bench, c)]
    parts = {place: parts_at(bench, bench.nominal, place) for place in dict.fromkeys(c.signal for c in some)}
    found = {}
    for candidate in some:
        there = parts[candidate.signal]
        lowest, highest = _range_of(bench, candidate)
        edge = min(highest, 2.0 * np.pi * _PERIODS_PER_PART / there.length)
        frequencies = np.arange(lowest, edge, 2.0 * np.pi * _CLOSE / duration_of(bench.records))
        found[candidate.name] = Waves(there, edge, frequencies, _shares(bench, candidate, frequencies, there))
    return found


def with_frequencies(bench: Workbench, current: Refits, noise: Noise, waves: Mapping[str, Waves]) -> Workbench:
    """Return the bench with the frequencies at which each harmonic effect is to be tried."""
    duration = duration_of(bench.records)
    known, r = unexplained(current, noise.innovations)
    of_inputs = _periods_of_inputs(bench)
    scales: dict[str, Scales] = {}
    for candidate in bench.candidates:
        if not candidate.effect.harmonic:
            continue
        own = bench.scales[candidate.name]
        lowest, highest = _range_of(bench, candidate)
        peaks: list[tuple[float, float]] = []
        if candidate.name in waves:
            there = waves[candidate.name]
            peaks += _peaks(there.frequencies, _explained(there, noise, known, r))
            lowest = there.edge
        # What is added to a reading shows there, whatever else in the first; where a record holds it.
        names = bench.problem.observed
        output = names.index(candidate.signal) if candidate.signal in names else 0
        for k in np.flatnonzero(bench.problem.samples.measured[..., output].any(axis=1)).tolist():
            peaks += _peaks(*_periodogram(bench, current, k, output, lowest, highest))
        peaks = [(strength, frequency) for strength, frequency in peaks if not _of_inputs(frequency, of_inputs)]
        scales[candidate.name] = {**own, "frequencies": _strongest(peaks, duration) or own["frequencies"]}
    return replace(bench, scales={**bench.scales, **scales})


def _periods_of_inputs(bench: Workbench) -> list[tuple[float, float]]:
    """Return the period, s, of each input that repeats itself in a record, and for how long the record goes on, s."""
    found = []
    for k, there in enumerate(bench.present):
        period = float(bench.problem.samples.sample_period[k])
        for name in bench.fit.model.inputs:
            lag = period_of(bench.records[k].inputs[name])
            if lag is not None:
                found.append((lag * period, int(there.sum()) * period))
    return found


def period_of(series: Float[np.ndarray, " time"]) -> int | None:
    """Return after how many samples a series repeats itself; None if it does not, or too few times to tell."""
    from scipy.signal import correlate

    centred = series - np.mean(series)
    size = len(centred)
    most = size // _LEAST_PERIODS
    if most < 2 or not centred.any():
        return None
    squares = np.concatenate([[0.0], np.cumsum(centred**2)])
    lags = np.arange(most + 1)
    # Of what both parts hold: the one without its end, and the one without its beginning.
    both = squares[size - lags] * (squares[-1] - squares[lags])
    alike = correlate(centred, centred, "full", "fft")[size - 1 : size + most] / np.sqrt(np.maximum(both, 1e-300))
    unlike = np.flatnonzero(alike < 0.5)
    again = np.flatnonzero(alike[unlike[0] :] > _ALIKE) + unlike[0] if len(unlike) else unlike
    if not len(again):
        return None
    # The best of the first that are alike.
    first = again[: np.flatnonzero(np.diff(again, append=size) > 1)[0] + 1]
    return int(first[np.argmax(alike[first])])


def _of_inputs(frequency: float, periods: Sequence[tuple[float, float]]) -> bool:
    """Whether a frequency, rad/s, is a multiple of that of an input, as far as a record tells."""
    for period, duration in periods:
        turns = frequency * period / (2.0 * np.pi)
        if np.round(turns) >= 1.0 and abs(turns - np.round(turns)) < 0.5 * period / duration:
            return True
    return False


def _by_parts(bench: Workbench, candidate: Candidate) -> bool:
    """Whether what a harmonic effect does is the sum of what it does in parts of the record."""
    return candidate.effect.harmonic and candidate.signal in bench.places and not candidate.effect.memory


def _range_of(bench: Workbench, candidate: Candidate) -> tuple[float, float]:
    """Return the lowest and the highest frequency of a harmonic effect, rad/s."""
    scales = bench.scales[candidate.name]
    (frequency,) = (p for p in candidate.effect.parameters if p.name == "frequency")
    return frequency.lower(scales), frequency.upper(scales)


def _explained(waves: Waves, noise: Noise, known, r) -> Float[np.ndarray, " frequency"]:
    """Return the noise variances of the residual that an effect would take at each frequency, to first order."""
    changes = noise.innovations(waves.parts.responses)
    changes -= (changes @ known) @ known.T
    along = waves.shares @ (changes @ r)
    information = np.einsum("fap,pq,fbq->fab", waves.shares, changes @ changes.T, waves.shares, optimize=True)
    # An amplitude that does not show takes nothing.
    return np.einsum("fa,fab,fb->f", along, np.linalg.pinv(information, rcond=1e-9, hermitian=True), along)


def _shares(bench: Workbench, candidate: Candidate, frequencies, parts: Parts):
    """Return what each of an effect's amplitudes adds to its signal in each part, `[frequency, amplitude, part]`."""
    numbers = candidate.effect.parameters
    scales = bench.scales[candidate.name]
    amplitudes = [n for n in numbers if n.absent is not None]
    absent = {n.name: n.absent if n.absent is not None else n.tries(scales)[0] for n in numbers}
    internal = bench.internal
    always = {"step_size": float(np.min(bench.problem.samples.sample_period)), "duration": scales["duration"]}
    every = _every(candidate.effect.apply)
    # Some at a time: of a long record all of them take more memory than all else. The last are filled up.
    blocks = np.resize(frequencies, (max(1, -(-len(frequencies) // AT_ONCE)), AT_ONCE))
    with kernels.double_precision():
        value = jnp.asarray(internal.values[candidate.signal])
        context = {**internal.contexts[candidate.signal], "time": bench.clock}
        along = {name: jnp.asarray(series) for name, series in context.items()}

        def means_of(amplitude):
            own = {**absent, amplitude.name: amplitude.tries(scales)[0]}
            return np.concatenate([parts.means(np.asarray(every(own, some, value, along, always))) for some in blocks])

        means = [means_of(n)[: len(frequencies)] for n in amplitudes]
    # Each record has amplitudes of its own.
    own = parts.of_record == np.arange(len(bench.records))[:, None]
    return np.stack([mean * inside for mean in means for inside in own], axis=1)


@functools.lru_cache(maxsize=64)
def _every(apply: Callable) -> Callable:
    """Return what an effect adds to a signal at each frequency, `[frequency, record, time]`; compiled once for it."""

    def added(own, frequency, value, along, always):
        return apply({**own, "frequency": frequency}, value, along | always) - value

    at_every_time = jax.vmap(jax.vmap(added, (None, None, 0, 0, None)), (None, None, 0, 0, None))
    return kernels.jit(jax.vmap(at_every_time, (None, 0, None, None, None)))


def _periodogram(bench: Workbench, current: Refits, record: int, output: int, lowest: float, highest: float):
    """Return frequencies between two, rad/s, and how strong a record's residual of an output is there."""
    present = bench.present[record]
    measured = bench.problem.samples.measured[record, present, output]
    residual = np.where(measured, current.residual[0, record, present, output], 0.0)
    size = 8 * len(residual)
    power = np.abs(np.fft.rfft((residual - residual.mean()) * np.hanning(len(residual)), size)) ** 2
    frequency = 2.0 * np.pi * np.fft.rfftfreq(size, float(bench.problem.samples.sample_period[record]))
    inside = (frequency > lowest) & (frequency < highest)
    # Of a sine in white noise this is the score of its two amplitudes.
    deviation = np.sqrt(max(float(np.var(residual[measured])), 1e-300))
    return frequency[inside], power[inside] / (0.1875 * len(residual) * deviation**2)


def _peaks(frequencies, strength) -> list[tuple[float, float]]:
    """Return the maxima of a strength, each with its frequency."""
    padded = np.concatenate([[-np.inf], strength, [-np.inf]])
    peak = (strength > padded[:-2]) & (strength >= padded[2:])
    return list(zip(strength[peak].tolist(), frequencies[peak].tolist(), strict=True))


def _strongest(peaks: Sequence[tuple[float, float]], duration: float) -> tuple[float, ...]:
    """Return the frequencies of the strongest peaks that are apart: side lobes of a stronger one are no peaks."""
    found: list[float] = []
    for _, frequency in sorted(peaks, reverse=True):
        if all(abs(frequency - other) > 2.0 * np.pi * _APART / duration for other in found):
            found.append(frequency)
        if len(found) == _TRIED:
            break
    return tuple(found)
