"""Test signals: the paper's pseudo random signal, binary signals, multisines, staircases and chirps.

Each is a float64 NumPy array `[time]` in the unit of its amplitude, sampled at `sample_times`. Random signals
take a `jax.random` key first: the same key gives the same signal, whatever JAX's precision is set to. Levels
are drawn before they are sampled, so a held signal stays the same when only the sample period changes.
"""

import math
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float64, Num, PRNGKeyArray

from ehsvjax.checks import choice, number, positive, refused, whole
from ehsvjax.draws import check_key

Signal = Float64[np.ndarray, " time"]

# Of one signal: 0.8 GB, a day at 1 kHz.
_MOST_SAMPLES = 10**8


def pseudo_random_signal(
    key: PRNGKeyArray,
    *,
    amplitude: float,
    hold_time: float | Sequence[float],
    duration: float,
    sample_period: float,
    offset: float = 0.0,
) -> Signal:
    """Hold random levels, uniform within offset +- amplitude: the paper's PRS (section 3.2), `[time]`.

    Each level is held for `hold_time` seconds or, where a pair (shortest, longest) is given, for a time drawn
    uniformly between the two. A level begins at the first sample at or after its instant; the last one is cut
    at `duration`. Duration and sample period in s, offset in the unit of the amplitude.

    Raises ValueError unless all numbers are finite, all but the offset positive, and hold times and duration
    at least one sample period.
    """
    check_key(key)
    level_key, hold_key = jax.random.split(key)
    positive("amplitude", amplitude)
    starts, times = _hold_starts(hold_key, hold_time, duration, sample_period)
    levels = amplitude * (2.0 * _uniform(level_key, len(starts)) - 1.0)
    return number("offset", offset) + _held(levels, starts, times, sample_period)


def pseudo_random_binary_signal(
    key: PRNGKeyArray,
    *,
    amplitude: float,
    hold_time: float | Sequence[float],
    duration: float,
    sample_period: float,
    offset: float = 0.0,
) -> Signal:
    """Hold offset + amplitude or offset - amplitude, each with probability one half: a PRBS, `[time]`.

    Arguments, units and errors as for `pseudo_random_signal`.
    """
    check_key(key)
    level_key, hold_key = jax.random.split(key)
    positive("amplitude", amplitude)
    starts, times = _hold_starts(hold_key, hold_time, duration, sample_period)
    levels = np.where(_uniform(level_key, len(starts)) < 0.5, -amplitude, amplitude)
    return number("offset", offset) + _held(levels, starts, times, sample_period)


def multisine(
    key: PRNGKeyArray | None,
    *,
    amplitude: float,
    frequencies_hz: Sequence[float] | Num[np.ndarray, " line"],
    duration: float,
    sample_period: float,
    phases: str = "random",
) -> Signal:
    """Sum cosines of equal size, scaled so that the largest sample is `amplitude` in magnitude, `[time]`.

    Phases are "random" (uniform) or "schroeder": -pi k (k - 1)/K for line k of K, which keep the peak low
    when the lines are evenly spaced (Schroeder 1970, IEEE Trans. Information Theory 16, 85-89). Those are not
    random: pass None as the key. Duration and sample period in s. A multiple of 1/duration does not leak.

    Raises ValueError for numbers that are not positive and finite, no or repeated lines, a line at or above
    half the sampling rate, an unknown choice of phases, and a key that does not go with that choice.
    """
    positive("amplitude", amplitude)
    times = sample_times(duration, sample_period)
    frequencies = _lines(frequencies_hz, sample_period)
    total = np.zeros_like(times)
    for frequency, phase in zip(frequencies, _phases(key, phases, len(frequencies)), strict=True):
        total += np.cos(2.0 * math.pi * frequency * times + phase)
    return amplitude * (total / np.abs(total).max())


def staircase(*, amplitude: float, levels: int, hold_time: float, sample_period: float) -> Signal:
    """Climb from -amplitude to +amplitude through evenly spaced levels and come back down, `[time]`.

    Every level is held for `hold_time` seconds on the way up and again on the way down, the top one once: the
    duration is (2 levels - 1) hold_time. Sample period in s.

    Raises ValueError for fewer than two levels, numbers that are not positive and finite, and a hold time
    below the sample period.
    """
    positive("amplitude", amplitude)
    whole("levels", levels, 2, _MOST_SAMPLES)
    _require_hold_time(hold_time, sample_period)
    times = sample_times((2 * levels - 1) * hold_time, sample_period)
    # Mirrored halves, so that a level met on the way down equals the one met on the way up to the last bit.
    climb = amplitude * np.linspace(-1.0, 1.0, levels)
    values = np.concatenate([climb, climb[-2::-1]])
    starts = hold_time * np.arange(len(values))
    return _held(values, starts, times, sample_period)


def chirp(
    *,
    amplitude: float,
    start_frequency: float,
    stop_frequency: float,
    duration: float,
    sample_period: float,
    method: str = "linear",
) -> Signal:
    """Sweep a sine, zero at time 0, from the start frequency to the stop frequency at `duration`, `[time]`.

    Frequencies in Hz, either may be the higher; duration and sample period in s. The frequency changes by
    equal steps ("linear") or equal ratios ("logarithmic") in equal times, as in `scipy.signal.chirp`.

    Raises ValueError for numbers that are not positive and finite, frequencies at or above half the sampling
    rate, and an unknown method.
    """
    positive("amplitude", amplitude)
    times = sample_times(duration, sample_period)
    for name, frequency in (("start_frequency", start_frequency), ("stop_frequency", stop_frequency)):
        _require_resolved(name, frequency, sample_period)
    choice("method", method, ("linear", "logarithmic"))
    from scipy import signal  # half of this package's import time, if it were imported with it

    sweep = signal.chirp(times, start_frequency, duration, stop_frequency, method=method, phi=-90.0)
    return amplitude * sweep


def sample_times(duration: float, sample_period: float) -> Signal:
    """Return the sampling instants 0, T, 2 T, ... in s, `[time]`: round(duration/T) of them.

    Raises ValueError unless both are positive and finite, the duration is at least one sample period, and the samples
    are at most 1e8.
    """
    positive("duration", duration)
    positive("sample_period", sample_period)
    if duration < sample_period:
        raise ValueError(
            f"expected duration to be at least the sample period of {sample_period} s, got {duration} s; "
            "lengthen the one or shorten the other"
        )
    if duration / sample_period > _MOST_SAMPLES:
        raise ValueError(
            f"expected at most {_MOST_SAMPLES:g} samples, got {duration} s every {sample_period} s, "
            f"{duration / sample_period:.3g}: shorten the duration or lengthen the sample period (both in s)"
        )
    return sample_period * np.arange(round(duration / sample_period), dtype=np.float64)


def _hold_starts(
    key: PRNGKeyArray, hold_time: float | Sequence[float], duration: float, sample_period: float
) -> tuple[Float64[np.ndarray, " level"], Signal]:
    times = sample_times(duration, sample_period)
    if isinstance(hold_time, Sequence) and not isinstance(hold_time, str):
        pair = tuple(hold_time)
    else:
        pair = (hold_time, hold_time)
    if len(pair) != 2:
        raise ValueError(
            f"expected hold_time to be a number or a pair (shortest, longest), got {len(pair)} numbers; "
            "give one number or two"
        )
    for bound in pair:
        _require_hold_time(bound, sample_period)
    shortest, longest = pair
    if longest < shortest:
        raise ValueError(f"expected hold_time as (shortest, longest), got ({shortest}, {longest}); swap them")
    count = math.ceil(duration / shortest) + 1
    # Multiples of the shortest plus the sum of the random parts: no rounding accumulates in a constant hold.
    starts = shortest * np.arange(count, dtype=np.float64)
    starts[1:] += np.cumsum((longest - shortest) * _uniform(key, count - 1))
    return starts, times


def _held(
    levels: Float64[np.ndarray, " level"],
    starts: Float64[np.ndarray, " level"],
    times: Signal,
    sample_period: float,
) -> Signal:
    # k T and a start that is meant to coincide with it may differ in the last bits.
    return levels[np.searchsorted(starts, times + 1e-6 * sample_period, side="right") - 1]


def _uniform(key: PRNGKeyArray, count: int) -> Float64[np.ndarray, " draw"]:
    # jax.random.uniform draws other numbers when 64-bit mode is on; 32 random bits are the same in both.
    bits = np.asarray(jax.random.bits(key, (count,), dtype="uint32"))
    return (bits + 0.5) / 2.0**32


def _phases(key: PRNGKeyArray | None, phases: str, count: int) -> Float64[np.ndarray, " line"]:
    if choice("phases", phases, ("random", "schroeder")) == "random":
        if key is None:
            raise ValueError("expected a key for random phases, got None; pass jax.random.key(seed)")
        check_key(key)
        return 2.0 * math.pi * _uniform(key, count)
    if key is not None:
        raise ValueError("expected no key for Schroeder phases, which are not random, got one; pass None")
    line = np.arange(1, count + 1, dtype=np.float64)
    return -math.pi * line * (line - 1.0) / count


def _lines(
    frequencies_hz: Sequence[float] | Num[np.ndarray, " line"], sample_period: float
) -> Float64[np.ndarray, " line"]:
    if isinstance(frequencies_hz, str) or np.ndim(frequencies_hz) != 1 or not len(frequencies_hz):
        remedy = "give one number for each line"
        raise refused("frequencies_hz", "a list of at least one frequency", frequencies_hz, remedy)
    frequencies = np.array([number("every one of frequencies_hz", f, remedy="give it in Hz") for f in frequencies_hz])
    for frequency in frequencies.tolist():
        _require_resolved("every one of frequencies_hz", frequency, sample_period)
    if len(np.unique(frequencies)) < len(frequencies):
        raise ValueError(
            f"expected frequencies_hz to differ from each other, got {frequencies.tolist()}; remove the repeated ones"
        )
    return frequencies


def _require_hold_time(hold_time: float, sample_period: float) -> None:
    positive("hold_time", hold_time)
    positive("sample_period", sample_period)
    # A hold of one period, computed by the caller, may fall short of it in the last bits.
    if hold_time < sample_period * (1.0 - 1e-9):
        raise ValueError(
            f"expected hold_time to be at least the sample period of {sample_period} s, got {hold_time} s; "
            "lengthen the one or shorten the other"
        )


def _require_resolved(name: str, frequency: float, sample_period: float) -> None:
    positive(name, frequency)
    if frequency >= 0.5 / sample_period:
        raise ValueError(
            f"expected {name} to be below {0.5 / sample_period} Hz, half the sampling rate, "
            f"got {frequency} Hz; lower it or shorten the sample period"
        )
