"""Test signals against their definitions: levels, holds, spectra, frequencies, and refusals."""

import math

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal, stats

from ehsvjax import excitation as ex

KEY = jax.random.key(7)
TIMING = {"duration": 4.0, "sample_period": 1e-3}
HELD = {"amplitude": 6e-3, "hold_time": 0.2, **TIMING}
RANDOM_SIGNALS = {
    "prs": lambda key: ex.pseudo_random_signal(key, **HELD),
    "prs_random_holds": lambda key: ex.pseudo_random_signal(key, **{**HELD, "hold_time": (0.1, 0.3)}),
    "prbs": lambda key: ex.pseudo_random_binary_signal(key, **HELD),
    "multisine": lambda key: ex.multisine(key, amplitude=1.0, frequencies_hz=[1.0, 2.0, 5.0], **TIMING),
}
random_signals = pytest.mark.parametrize("draw", RANDOM_SIGNALS.values(), ids=RANDOM_SIGNALS.keys())


def _run_lengths(values):
    edges = np.flatnonzero(np.diff(values)) + 1
    return np.diff([0, *edges, len(values)]).tolist()


# --- Keys, shapes ---


@random_signals
def test_the_key_alone_decides(draw):
    first, again, other = draw(KEY), draw(KEY), draw(jax.random.key(8))
    assert first.dtype == np.float64 and first.shape == (4000,)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@random_signals
def test_signals_do_not_depend_on_jax_precision(draw):
    single = draw(KEY)
    with jax.enable_x64(True):
        np.testing.assert_array_equal(draw(jax.random.key(7)), single)


def test_sample_times():
    np.testing.assert_allclose(ex.sample_times(0.5, 0.1), [0.0, 0.1, 0.2, 0.3, 0.4], rtol=1e-15)
    # 0.3/0.1 is 2.9999999999999996 in floating point: still three samples.
    assert len(ex.sample_times(0.3, 0.1)) == 3
    # 0.36 s hold 3.6 periods, which is rounded.
    assert len(ex.sample_times(0.36, 0.1)) == 4


# --- Held levels ---


@pytest.mark.parametrize("generate", [ex.pseudo_random_signal, ex.pseudo_random_binary_signal])
def test_levels_are_held_for_exactly_the_hold_time(generate):
    held = generate(KEY, **HELD).reshape(20, 200)
    np.testing.assert_array_equal(held, np.broadcast_to(held[:, :1], held.shape))


def test_levels_of_the_pseudo_random_signal_are_all_different():
    assert len(set(ex.pseudo_random_signal(KEY, **HELD).tolist())) == 20


def test_levels_of_the_pseudo_random_signal_are_uniform():
    # One sample each of 20000 levels. A fair generator fails this threshold for one key in a thousand.
    levels = ex.pseudo_random_signal(KEY, amplitude=2.0, hold_time=0.1, duration=2000.0, sample_period=0.1, offset=5.0)
    assert levels.shape == (20_000,)
    assert levels.min() >= 3.0 and levels.max() <= 7.0
    assert stats.kstest(levels, stats.uniform(3.0, 4.0).cdf).pvalue > 1e-3
    # Independent from one to the next: the correlation has a standard deviation of 1/sqrt(20000) = 0.007.
    assert abs(np.corrcoef(levels[1:], levels[:-1])[0, 1]) < 0.03


def test_binary_signal_has_two_levels_equally_often():
    levels = ex.pseudo_random_binary_signal(
        KEY, amplitude=2.0, hold_time=0.1, duration=2000.0, sample_period=0.1, offset=5.0
    )
    assert set(levels.tolist()) == {3.0, 7.0}
    # The share of one of them has a standard deviation of 0.5/sqrt(20000) = 0.0035.
    assert abs(np.mean(levels == 7.0) - 0.5) < 0.015


def test_random_hold_times_lie_between_their_limits_and_are_uniform():
    held = ex.pseudo_random_signal(KEY, amplitude=1.0, hold_time=(0.1, 0.3), duration=1000.0, sample_period=1e-3)
    lengths = np.asarray(_run_lengths(held)[:-1])
    assert lengths.min() >= 100 and lengths.max() <= 300
    # About 5000 holds with a standard deviation of 200/sqrt(12) samples: their mean is within 0.8 of 200.
    assert lengths.mean() == pytest.approx(200.0, abs=4.0)
    assert stats.kstest(lengths * 1e-3, stats.uniform(0.1, 0.2).cdf).pvalue > 1e-3


@settings(max_examples=12, deadline=None)
@given(st.floats(0.05, 0.7), st.floats(1.0, 2.0), st.integers(2, 5), st.integers(0, 1000))
def test_sampling_faster_shows_the_same_signal(shortest, ratio, factor, seed):
    hold_time = (shortest, ratio * shortest)
    coarse, fine = (
        ex.pseudo_random_signal(
            jax.random.key(seed), amplitude=1.0, hold_time=hold_time, duration=3.0, sample_period=period
        )
        for period in (0.01, 0.01 / factor)
    )
    np.testing.assert_array_equal(fine[::factor], coarse)


def test_a_hold_that_is_no_multiple_of_the_period_keeps_its_mean_length():
    # Levels begin at 0, 2.5, 5, 7.5, ... periods, that is at samples 0, 3, 5, 8, ...
    held = ex.pseudo_random_signal(KEY, amplitude=1.0, hold_time=0.025, duration=0.2, sample_period=0.01)
    assert _run_lengths(held) == [3, 2, 3, 2, 3, 2, 3, 2]


def test_no_rounding_accumulates_over_a_long_record():
    held = ex.pseudo_random_signal(KEY, amplitude=1.0, hold_time=0.02, duration=6e3, sample_period=0.01)
    assert set(_run_lengths(held)) == {2}


def test_staircase_visits_each_level_up_and_down():
    stairs = ex.staircase(amplitude=2.0, levels=5, hold_time=0.3, sample_period=0.1)
    expected = np.repeat([-2.0, -1.0, 0.0, 1.0, 2.0, 1.0, 0.0, -1.0, -2.0], 3)
    np.testing.assert_array_equal(stairs, expected)


@pytest.mark.parametrize("levels", [2, 3, 8])
def test_staircase_is_its_own_mirror_image(levels):
    stairs = ex.staircase(amplitude=6e-3, levels=levels, hold_time=0.2, sample_period=1e-3)
    assert len(set(stairs.tolist())) == levels
    assert len(stairs) == (2 * levels - 1) * 200
    np.testing.assert_array_equal(stairs, stairs[::-1])


# --- Multisine ---


@pytest.mark.parametrize(("key", "phases"), [(KEY, "random"), (None, "schroeder")])
def test_multisine_has_the_asked_lines_only_and_the_asked_peak(key, phases):
    lines = [1.0, 2.5, 7.0, 40.0, 499.0]
    wave = ex.multisine(key, amplitude=3e-3, frequencies_hz=lines, phases=phases, **TIMING)
    assert np.abs(wave).max() == 3e-3
    size = np.abs(np.fft.rfft(wave)) / len(wave)
    asked = np.isin(np.fft.rfftfreq(len(wave), 1e-3).round(9), lines)
    assert asked.sum() == len(lines)
    assert size[~asked].max() < 1e-12 * size[asked].min()
    np.testing.assert_allclose(size[asked], size[asked].mean(), rtol=1e-9)


def test_schroeder_phases_keep_the_crest_factor_low():
    # 31 lines in phase have the crest factor sqrt(2 * 31) = 7.9; Schroeder's about 1.7 (a sine: 1.41).
    wave = ex.multisine(None, amplitude=1.0, frequencies_hz=np.arange(1, 32), phases="schroeder", **TIMING)
    assert 1.0 / np.sqrt(np.mean(wave**2)) < 1.8


# --- Chirp ---


@pytest.mark.parametrize(("start", "stop"), [(1.0, 40.0), (40.0, 1.0), (5.0, 5.0)])
@pytest.mark.parametrize("method", ["linear", "logarithmic"])
def test_chirp_sweeps_the_instantaneous_frequency(start, stop, method):
    wave = ex.chirp(
        amplitude=2.0,
        start_frequency=start,
        stop_frequency=stop,
        duration=20.0,
        sample_period=1e-3,
        method=method,
    )
    assert abs(wave[0]) < 1e-12 and np.abs(wave).max() == pytest.approx(2.0, rel=1e-3)
    fraction = np.arange(20_000) / 20_000
    expected = start * (stop / start) ** fraction if method == "logarithmic" else start + (stop - start) * fraction
    frequency = np.gradient(np.unwrap(np.angle(signal.hilbert(wave))), 1e-3) / (2 * math.pi)
    # The analytic signal is poor near the ends and near 1 Hz, where few periods are seen.
    inner = slice(4000, -4000)
    np.testing.assert_allclose(frequency[inner], expected[inner], rtol=0.05)


def test_linear_chirp_by_hand():
    # Turns made by time t: 1 t + (3 - 1) t^2/(2 * 4), so 1.25 after 1 s (sine 1), 3 after 2 s (sine 0) and
    # 5.25 after 3 s (sine 1).
    wave = ex.chirp(amplitude=0.5, start_frequency=1.0, stop_frequency=3.0, duration=4.0, sample_period=0.125)
    np.testing.assert_allclose(wave[[0, 8, 16, 24]], [0.0, 0.5, 0.0, 0.5], atol=1e-12)


# --- Refusals ---


def _prs(**changes):
    return ex.pseudo_random_signal(KEY, **{**HELD, **changes})


def _multisine(key=KEY, **changes):
    return ex.multisine(key, **{"amplitude": 1.0, "frequencies_hz": [1.0], **TIMING, **changes})


def _stairs(**changes):
    return ex.staircase(**{"amplitude": 1.0, "levels": 3, "hold_time": 0.1, "sample_period": 1e-3, **changes})


def _chirp(**changes):
    return ex.chirp(**{"amplitude": 1.0, "start_frequency": 1.0, "stop_frequency": 9.0, **TIMING, **changes})


def _prbs(**changes):
    return ex.pseudo_random_binary_signal(KEY, **{**HELD, **changes})


@pytest.mark.parametrize("generate", [_prs, _prbs, _multisine, _stairs, _chirp])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_amplitude_and_sample_period_must_be_positive(generate, value):
    for name in ("amplitude", "sample_period"):
        with pytest.raises(ValueError, match=rf"expected {name} to be (positive|a finite number), got {value}: give"):
            generate(**{name: value})


@pytest.mark.parametrize("generate", [_prs, _prbs, _multisine, _chirp])
def test_duration_must_be_positive_and_hold_a_sample(generate):
    with pytest.raises(ValueError, match=r"expected duration to be positive, got -4\.0: give a number above 0"):
        generate(duration=-4.0)
    with pytest.raises(
        ValueError, match=r"expected duration to be at least the sample period of 0\.001 s, got 0\.0005 s"
    ):
        generate(duration=5e-4)


@pytest.mark.parametrize("generate", [_prs, _prbs, _stairs])
def test_hold_time_must_be_at_least_a_sample_period(generate):
    with pytest.raises(ValueError, match=r"expected hold_time to be positive, got 0\.0"):
        generate(hold_time=0.0)
    with pytest.raises(
        ValueError, match=r"expected hold_time to be at least the sample period of 0\.001 s, got 0\.0005 s"
    ):
        generate(hold_time=5e-4)
    generate(hold_time=1e-3)


@pytest.mark.parametrize("generate", [_prs, _prbs])
def test_a_pair_of_hold_times_must_be_in_order(generate):
    with pytest.raises(ValueError, match=r"expected hold_time as \(shortest, longest\), got \(0\.3, 0\.1\); swap"):
        generate(hold_time=(0.3, 0.1))
    with pytest.raises(ValueError, match=r"expected hold_time to be a number or a pair .*, got 3 numbers"):
        generate(hold_time=(0.1, 0.2, 0.3))
    with pytest.raises(ValueError, match=r"expected hold_time to be at least the sample period"):
        generate(hold_time=(1e-4, 0.1))
    with pytest.raises(ValueError, match=r"expected hold_time to be a finite number, got inf"):
        generate(hold_time=(0.1, math.inf))


@pytest.mark.parametrize("generate", [_prs, _prbs])
def test_offset_must_be_finite(generate):
    with pytest.raises(ValueError, match=r"expected offset to be a finite number, got nan"):
        generate(offset=math.nan)


def test_lines_must_be_resolved_and_distinct():
    with pytest.raises(
        ValueError,
        match=r"frequencies_hz to be below 500\.0 Hz, half the sampling rate, got 500\.0 Hz; lower",
    ):
        _multisine(frequencies_hz=[1.0, 500.0])
    with pytest.raises(ValueError, match=r"expected every one of frequencies_hz to be positive, got 0\.0"):
        _multisine(frequencies_hz=[0.0, 1.0])
    with pytest.raises(ValueError, match=r"expected frequencies_hz to differ from each other, got \[1\.0, 1\.0\]"):
        _multisine(frequencies_hz=[1.0, 1.0])
    with pytest.raises(ValueError, match=r"expected frequencies_hz to be a list of at least one frequency"):
        _multisine(frequencies_hz=[])


def test_phases_and_key_must_go_together():
    with pytest.raises(ValueError, match=r"expected phases to be 'random' or 'schroeder', got 'white'"):
        _multisine(phases="white")
    with pytest.raises(ValueError, match=r"expected a key for random phases, got None; pass jax\.random\.key"):
        _multisine(key=None)
    with pytest.raises(ValueError, match=r"expected no key for Schroeder phases.*pass None"):
        _multisine(phases="schroeder")


def test_staircase_needs_two_levels():
    with pytest.raises(ValueError, match=r"expected levels to be a whole number from 2 to 1e\+08, got 1"):
        _stairs(levels=1)


def test_chirp_must_be_resolved():
    for name in ("start_frequency", "stop_frequency"):
        with pytest.raises(ValueError, match=rf"expected {name} to be below 500\.0 Hz, half the sampling rate"):
            _chirp(**{name: 500.0})
        with pytest.raises(ValueError, match=rf"expected {name} to be positive, got 0\.0"):
            _chirp(**{name: 0.0})
    with pytest.raises(ValueError, match=r"expected method to be 'linear' or 'logarithmic', got 'quadratic'"):
        _chirp(method="quadratic")
