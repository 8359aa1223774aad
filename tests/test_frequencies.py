"""Where harmonic effects are looked for, against forces on the independent plant."""

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.diagnosis.bench.noise import plain_noise
from ehsvjax.diagnosis.bench.refits import padded, refit
from ehsvjax.diagnosis.bench.setup import workbench
from ehsvjax.diagnosis.hypotheses.harmonics import _of_inputs, period_of, waves_of, with_frequencies
from ehsvjax.effects import BANK
from tests.hidden_plants import van_der_pol_with

# One process compiles; records are as long as those of test_diagnose.py.
pytestmark = pytest.mark.xdist_group("diagnoses of the oscillator")
PERIOD, SAMPLES, HELD = 0.05, 600, 20
COMMAND = np.repeat(np.random.default_rng(4).uniform(-1.0, 1.0, SAMPLES // HELD), HELD)
NOISE = 0.01


def position(**effects):
    return van_der_pol_with([effects], COMMAND[None], PERIOD, fine_step=5e-3)["position"][0]


@pytest.fixture(scope="module")
def fit():
    noise = NOISE * np.random.default_rng(5).standard_normal(SAMPLES)
    record = ehsvjax.Record(PERIOD * np.arange(SAMPLES), {"command": COMMAND}, {"position": position() + noise})
    model = ehsvjax.van_der_pol()
    return ehsvjax.identify(model, record, key=jax.random.key(0), population=100, generations=40)


def bench_of(fit, readings):
    record = ehsvjax.Record(PERIOD * np.arange(SAMPLES), {"command": COMMAND}, {"position": readings})
    return workbench(fit, [record], BANK)


def test_parts_of_a_force_add_up_to_what_a_sine_does_to_the_plant(fit):
    bench = bench_of(fit, position())
    parts = waves_of(bench)["harmonic_force"].parts
    amplitude, frequency, phase = 1e-4, 1.37, 0.4
    sine = {"force": amplitude, "frequency": frequency, "phase": phase}
    expected = position(harmonic_force=sine) - position()
    shares = parts.means(amplitude * np.cos(frequency * PERIOD * np.arange(SAMPLES) + phase)[None])
    found = shares @ parts.responses[:, 0, :, 0]
    # The parts hold a force for 0.15 s; the fit has an error of its own.
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.1 * np.sqrt(np.mean(expected**2))


@pytest.mark.parametrize(
    ("effect", "sizes"),
    [
        ("harmonic_force", {"force": 0.05, "frequency": 2.3, "phase": 1.0}),
        ("harmonic_force", {"force": 0.05, "frequency": 0.61, "phase": 1.0}),
        ("parametric_excitation", {"depth": 0.05, "frequency": 3.1, "phase": 2.0}),
    ],
)
def test_the_frequency_of_what_is_there_is_among_those_that_are_tried(fit, effect, sizes):
    noise = NOISE * np.random.default_rng(6).standard_normal(SAMPLES)
    bench = bench_of(fit, position(**{effect: sizes}) + noise)
    noise = plain_noise(bench.problem.noise_variance, bench.problem.samples.measured)
    current = refit(bench, bench.nominal[None], padded([bench.base_columns]), noise)
    tried = with_frequencies(bench, current, noise, waves_of(bench)).scales[effect]["frequencies"]
    resolution = 2.0 * np.pi / (SAMPLES * PERIOD)
    assert min(abs(frequency - sizes["frequency"]) for frequency in tried) < 0.5 * resolution


@pytest.mark.parametrize("period", [37, 100, 251])
def test_an_input_that_repeats_itself_is_known_by_its_period(period):
    once = np.repeat(np.random.default_rng(6).uniform(-1.0, 1.0, period // 5 + 1), 5)[:period]
    wave = np.sin(2.0 * np.pi * np.arange(1200) / period) + 0.01 * np.random.default_rng(7).standard_normal(1200)
    assert period_of(np.resize(once, 1200)) == period
    assert period_of(wave) in (period, 2 * period)


@pytest.mark.parametrize(
    "series",
    [COMMAND, np.linspace(0.0, 1.0, 600), np.zeros(600), np.repeat([0.0, 1.0], 300), np.resize(COMMAND[:200], 600)],
    ids=["random", "ramp", "nothing", "step", "three times"],
)
def test_an_input_that_does_not_or_hardly_repeats_itself_has_none(series):
    assert period_of(series) is None


def test_what_goes_by_an_input_is_no_disturbance_and_what_does_not_may_be_one():
    periods = [(2.0, 14.0)]
    for multiple in (1, 2, 5):
        assert _of_inputs(2.0 * np.pi * multiple / 2.0, periods)
    assert not _of_inputs(2.0 * np.pi * 1.3 / 2.0, periods) and not _of_inputs(0.1, periods)
    assert not _of_inputs(2.0 * np.pi / 2.0, [])
