"""Band-limited inputs between samples, against sums of sines, which are known everywhere."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ehsvjax
from ehsvjax.holds import HOLDS, interpolated
from tests.small_models import DAMPING, carriage, carriage_plant

PERIOD, COUNT = 0.1, 200
TIME = np.arange(COUNT) * PERIOD
EDGE = 16  # samples from which a slope is taken, on each side


def multisine(time, highest=0.65, seed=0):
    """Return a sum of sines up to a share of half the sample rate."""
    rng = np.random.default_rng(seed)
    frequencies = np.pi / PERIOD * np.linspace(0.05, highest, 9)
    phases = rng.uniform(0.0, 2.0 * np.pi, 9)
    return np.sin(np.outer(time, frequencies) + phases).sum(axis=1)


def carried(push, time):
    """Return position and velocity [time, 2] of the carriage, exactly, of a push that is straight between times."""
    return carriage_plant(push, time[1], straight=True)


@settings(deadline=None)
@given(share=st.floats(0.02, 0.65), phase=st.floats(0.0, 6.3))
def test_a_sine_is_known_between_its_samples(share, phase):
    place = np.arange(EDGE, COUNT - EDGE, 0.37)
    found = interpolated(np.sin(np.pi * share * np.arange(COUNT) + phase), place)
    np.testing.assert_allclose(found, np.sin(np.pi * share * place + phase), atol=2e-3)


@settings(deadline=None)
@given(st.integers(2, 40), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_a_straight_line_is_one_to_its_ends(count, start, slope):
    place = np.linspace(0.0, count - 1, 50)
    found = interpolated(start + slope * np.arange(count), place)
    np.testing.assert_allclose(found, start + slope * place, atol=1e-9)


def test_what_passes_a_filter_drives_a_model_as_the_curve_itself_does():
    fine = np.linspace(0.0, TIME[-1], 50 * (COUNT - 1) + 1)
    truth = carried(multisine(fine), fine)[::50]
    found = {}
    for hold in HOLDS:
        record = ehsvjax.Record(TIME, {"push": multisine(TIME)}, hold=hold)
        simulated = ehsvjax.simulate(carriage(), record, {"damping": DAMPING}, substeps=10)
        # What is wrong at the beginning, where only one side of the curve is known, dies out.
        found[hold] = np.sqrt(np.mean((simulated["velocity"] - truth[:, 1])[EDGE:-EDGE] ** 2)) / truth[:, 1].std()
    assert found["band-limited"] < 2e-3
    assert found["linear"] > 0.02
    assert found["zero"] > 0.1


def test_an_input_keeps_its_own_hold_beside_one_that_is_band_limited():
    push = multisine(TIME)
    alone = ehsvjax.simulate(carriage(), ehsvjax.Record(TIME, {"push": push}, hold="linear"))
    both = ehsvjax.Record(TIME, {"push": push, "other": push}, hold={"push": "linear", "other": "band-limited"})
    held = ehsvjax.Record(TIME, {"push": push, "other": push}, hold={"push": "zero", "other": "band-limited"})
    np.testing.assert_allclose(ehsvjax.simulate(carriage(), both)["position"], alone["position"], atol=1e-12)
    np.testing.assert_allclose(
        ehsvjax.simulate(carriage(), held)["position"],
        ehsvjax.simulate(carriage(), ehsvjax.Record(TIME, {"push": push}))["position"],
        atol=1e-12,
    )


def test_a_fit_of_records_of_unlike_length_finds_what_each_has():
    """The shorter record's end is not where its inputs become zero."""
    records = []
    for seed, count in ((1, 200), (2, 120)):
        fine = np.linspace(0.0, TIME[count - 1], 50 * (count - 1) + 1)
        position = carried(multisine(fine, seed=seed), fine)[::50, 0]
        noise = np.random.default_rng(seed).normal(0.0, 2e-4, count)
        inputs, outputs = {"push": multisine(TIME[:count], seed=seed)}, {"position": position + noise}
        records.append(ehsvjax.Record(TIME[:count], inputs, outputs, hold="band-limited"))
    fit = ehsvjax.identify(carriage(max_step=0.02), records, key=jax.random.key(0), population=20, generations=10)
    assert fit.parameters["damping"] == pytest.approx(DAMPING, rel=0.01)
    for record in records:
        assert fit.score(record).rmse["position"] < 4e-4


def test_a_record_is_resampled_along_its_curve():
    record = ehsvjax.Record(TIME, {"push": multisine(TIME)}, hold="band-limited")
    finer = record.resample(PERIOD / 4)
    inner = slice(4 * EDGE, -4 * EDGE)
    np.testing.assert_allclose(finer.inputs["push"][inner], multisine(finer.time)[inner], atol=0.01)
    assert "band-limited hold" in repr(finer)


def test_a_curve_through_samples_that_are_not_uniform_is_refused():
    time = np.array([0.0, 0.1, 0.2, 0.35, 0.4])
    record = ehsvjax.Record(time, {"push": time}, hold="band-limited", uniform=False)
    with pytest.raises(ValueError, match="smooth curve of a band-limited input is known from uniform samples only"):
        record.resample(0.1)
