"""Gaps in the time stamps: nothing is invented where nothing was measured."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ehsvjax import Record

PERIOD = 0.001


def with_gap(first=200, last=300, count=500, **changes):
    """Return a record at 1 kHz that lacks the rows from `first` up to `last`."""
    kept = np.delete(np.arange(count), np.s_[first:last])
    signals = {"inputs": {"command": np.sin(0.05 * kept)}, "outputs": {"position": np.cos(0.05 * kept)}}
    return Record(PERIOD * kept, **{**signals, **changes}, uniform=False, name="run 7")


def test_outputs_are_missing_in_a_gap():
    even = with_gap(inputs={}).resample(PERIOD)
    assert len(even) == 500
    missing = np.isnan(even.outputs["position"])
    assert np.flatnonzero(missing).tolist() == list(range(200, 300))
    np.testing.assert_allclose(even.outputs["position"][~missing], np.cos(0.05 * np.flatnonzero(~missing)), atol=1e-9)


def test_inputs_that_nobody_knows_are_refused_with_the_place_and_what_to_do():
    with pytest.raises(ValueError) as refusal:
        with_gap().resample(PERIOD)
    assert str(refusal.value) == (
        "the inputs of 'run 7' are unknown from 0.199 to 0.3 s, a gap where 0.001 s from row to row is usual: slice it "
        "there and resample each part (identify takes a list of records), or say "
        "resample(..., inputs_known_in_gaps=True) if they kept to their hold, as a command does that is logged when it "
        "changes"
    )
    before, after = with_gap().slice(stop=0.2), with_gap().slice(start=0.2)
    assert (len(before.resample(PERIOD)), len(after.resample(PERIOD))) == (200, 200)


def test_the_first_of_several_gaps_is_told():
    record = Record(np.array([0.0, 1, 2, 5, 6, 7, 10, 11, 12]), {"command": np.ones(9)}, uniform=False)
    with pytest.raises(ValueError, match=r"from 2 to 5 s, a gap \(one of 2 gaps\) where 1 s"):
        record.resample(1.0)


@pytest.mark.parametrize(("hold", "inside"), [("zero", [2.0, 2.0]), ("linear", [3.0, 4.0])])
def test_inputs_that_are_known_keep_to_their_hold(hold, inside):
    time, command = np.array([0.0, 1, 2, 5, 6, 7]), np.array([0.0, 1, 2, 5, 6, 7])
    record = Record(time, {"command": command}, {"position": command}, hold=hold, uniform=False)
    even = record.resample(1.0, inputs_known_in_gaps=True)
    np.testing.assert_allclose(even.inputs["command"], [0, 1, 2, *inside, 5, 6, 7], atol=1e-5)
    np.testing.assert_array_equal(even.outputs["position"], [0, 1, 2, np.nan, np.nan, 5, 6, 7])


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 3), st.floats(-0.009, 0.009), st.integers(1, 4))
def test_one_lost_row_is_interpolated_and_two_are_a_gap(lost, jitter, finer):
    count = 40
    time = np.delete(np.arange(count) + jitter * np.cos(np.arange(count)), np.s_[20 : 20 + lost])
    record = Record(time, {}, {"position": time}, uniform=False)
    even = record.resample(1.0 / finer)
    missing = np.isnan(even.outputs["position"])
    inside = (even.time > time[19] + 2e-6) & (even.time < time[20] - 2e-6)
    # A place is known to a millionth of a step, and the step is up to four periods: there either is right.
    edge = np.min(np.abs(even.time[:, None] - time[[19, 20]]), axis=1)
    outside = ~inside & ((edge > 2e-6) | (edge == 0.0))
    assert missing[inside].all() == (lost > 1) and not missing[outside].any()
    grid = np.minimum(even.time, time[-1])
    np.testing.assert_allclose(even.outputs["position"][~missing], grid[~missing], atol=1e-5)


def test_a_record_without_gaps_may_be_resampled_finer_and_coarser():
    record = Record(PERIOD * np.arange(100), {"command": np.ones(100)}, {"position": np.arange(100.0)})
    for period in (PERIOD / 7, PERIOD, 5.5 * PERIOD):
        assert not np.isnan(record.resample(period).outputs["position"]).any()


def test_a_grid_that_nobody_can_mean_is_refused():
    with pytest.raises(ValueError, match="more than 1e8 samples, is the period in s"):
        with_gap(inputs={}).resample(1e-9)
