"""Records: what they refuse and with which sentence, and slice, split and resample."""

import copy
import itertools
import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.interpolate import interp1d

from ehsvjax.record import Record

PROPERTY = settings(deadline=None, max_examples=60)
SEED = st.integers(0, 2**32 - 1)
NAN, INF = np.nan, np.inf
TIME = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
COMMAND = np.array([0.0, 1.0, 1.0, -1.0, -1.0])
POSITION = np.array([0.0, 0.1, 0.3, 0.5, 0.2])


def floats(*values):
    return np.array(values, dtype=float)


def a_record(**changes):
    return Record(**{"time": TIME, "inputs": {"command": COMMAND}, "outputs": {"position": POSITION}, **changes})


def noise(seed, count):
    return np.random.default_rng(seed).standard_normal(count)


def time(*values):
    return {"time": values}


def command(*values):
    return {"inputs": {"command": values}}


def position(*values):
    return {"outputs": {"position": values}}


# what differs from a_record, the fault with its signal and sample, the remedy
# fmt: off
REFUSED = [
    (time(), "time is empty", "check the column"),
    ({**time(0.0), **command(1.0), "outputs": {}}, "time has 1 sample", "a record needs at least 2"),
    (time(0, 0.1, NAN, 0.3, 0.4), "time is nan at sample 2", "remove the row or fill in"),
    (time(0, 0.1, 0.2, 0.3, INF), "time is inf at sample 4", "remove the row or fill in"),
    (time(0, 0.1, 0.1, 0.2, 0.3), "time does not increase at sample 2 (0.1 s after 0.1 s)", "sort the rows"),
    (time(0, 0.1, 0.2, 0.1, 0.3), "time does not increase at sample 3 (0.1 s after 0.2 s)", "sort the rows"),
    ({**time(0, 1, 1, 2, 3), "uniform": False}, "time does not increase at sample 2", "sort the rows"),
    (time(0, 0.1, 0.2, 0.4, 0.5),
        "time is not uniform, it strays from a straight line by 0.4 periods: "
        "sample 3 comes 0.2 s after sample 2, where 0.1 s is usual",
        "use Record(..., uniform=False).resample(0.1)"),
    (time("0", "1", "2 s", "3", "4"), "time holds '2 s' at sample 2", "expected real numbers; use .astype"),
    ({"time": np.arange("2020-01-01", "2020-01-06", dtype="datetime64[D]")},
        "time holds '2020-01-01' at sample 0", "convert the dates to seconds"),
    ({"time": np.arange(5) * np.timedelta64(1, "s")},
        "time holds '0 seconds' at sample 0", "convert the time differences to seconds"),
    (command(), "input 'command' is empty", "check the column"),
    (command(*COMMAND[:4]), "input 'command' has 4 samples but time has 5: one of them ends before sample 4",
        "give both the same rows"),
    (command(0, 1, NAN, 0, 0), "input 'command' is nan at sample 2", "fill the gap or cut it out"),
    (command(0, 1, 0, -INF, 0), "input 'command' is -inf at sample 3", "fill the gap or cut it out"),
    (command(*[NAN] * 5), "input 'command' is empty, all 5 samples are NaN", "check the name"),
    (command(0, 1j, 2, 3, 4), "input 'command' holds '0j' at sample 0 (dtype complex128)", "its real part"),
    (command(True, False, True, True, False), "input 'command' holds 'True' at sample 0", "convert it with"),
    (command(0.0, 1.0, None, 2.0, 3.0), "input 'command' holds 'None' at sample 2 (dtype object)",
        "expected real numbers; use .astype(float)"),
    (command(*np.eye(5)), "input 'command' has shape (5, 5): expected 1-D", "pass one column"),
    ({"inputs": {"command": 1.0}}, "input 'command' has shape (): expected 1-D", "one number per sample"),
    (position(), "output 'position' is empty", "check the column"),
    (position(*POSITION, 1.0), "output 'position' has 6 samples but time has 5: one of them ends before "
        "sample 5", "give both the same rows"),
    (position(0, 1, NAN, 0, INF), "output 'position' is inf at sample 4", "set it to NaN if the sample is"),
    (position(*[NAN] * 5), "output 'position' is empty, all 5 samples are NaN", "leave it out"),
    (position(NAN, 0.25, 0.25, NAN, 0.25), "output 'position' never changes, it is 0.25 from sample 1 to 4",
        "leave it out, or take a longer part"),
    (position(NAN, 0.25, NAN, NAN, NAN), "output 'position' has a single measured sample of 5, 0.25 at sample 1",
        "or one with fewer gaps"),
    (position("0", "1", "n/a", "2", "3"), "output 'position' holds 'n/a' at sample 2", "expected real"),
    (position(*np.ones((5, 2))), "output 'position' has shape (5, 2): expected 1-D", "pass one column"),
    ({"outputs": {"position": np.ma.masked_equal(POSITION, 0.3)}}, "output 'position' is a masked array",
        "use .filled(numpy.nan)"),
    ({"inputs": {"position": COMMAND}}, "signal 'position' is both an input and an output", "rename one"),
    ({"inputs": {"time": COMMAND}}, "'time' cannot be one of the inputs", "rename the signal"),
    ({"hold": "first"}, "expected hold to be 'zero', 'linear' or 'band-limited'", "got 'first'"),
]
# fmt: on


@pytest.mark.parametrize(("changes", "fault", "remedy"), REFUSED, ids=[case[1] for case in REFUSED])
def test_refused_with_one_sentence(changes, fault, remedy, unchecked):
    with pytest.raises(ValueError) as refusal:
        a_record(**changes)
    sentence = str(refusal.value)
    assert sentence.startswith(fault)
    assert remedy in sentence
    assert "\n" not in sentence and ". " not in sentence.replace("..., ", "")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (dict(inputs={0: COMMAND}), "expected names of inputs that are strings and not empty, got 0"),
        (dict(outputs={"": POSITION}), "expected names of outputs that are strings and not empty, got ''"),
        (dict(inputs=[1.0, 2.0]), "expected inputs as a mapping from name to values, got list"),
        (dict(outputs=POSITION), "expected outputs as a mapping from name to values, got ndarray"),
    ],
)
def test_signals_need_names(changes, sentence, unchecked):
    with pytest.raises(TypeError, match=sentence):
        a_record(**changes)


def test_what_is_accepted(unchecked):
    record = Record(
        range(5),
        {"command": [1] * 5},
        {"position": np.array([NAN, 1, 2, NAN, 3], np.float32), "spool": np.arange(5)},
    )
    np.testing.assert_array_equal(record.time, [0.0, 1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(record.inputs["command"], [1.0] * 5)  # an input may be constant
    np.testing.assert_array_equal(record.outputs["position"], [NAN, 1.0, 2.0, NAN, 3.0])
    assert record.time.dtype == record.inputs["command"].dtype == record.outputs["spool"].dtype == np.float64
    assert len(a_record(outputs={}).outputs) == len(Record(TIME, {"command": COMMAND}).outputs) == 0


def test_a_record_cannot_be_changed():
    measured = POSITION.copy()
    record = a_record(outputs={"position": measured})
    measured[0] = 99.0
    np.testing.assert_array_equal(record.outputs["position"], POSITION)
    with pytest.raises(ValueError, match="read-only"):
        record.outputs["position"][0] = 99.0
    with pytest.raises(ValueError, match="read-only"):
        record.time[0] = 99.0
    with pytest.raises(TypeError):
        record.inputs["command"] = measured
    with pytest.raises(FrozenInstanceError):
        record.name = "other"


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda record: pickle.loads(pickle.dumps(record))])
def test_copies_and_pickles(duplicate):
    record = duplicate(a_record(hold="linear", name="run 7"))
    assert (record.name, record.hold, record.uniform) == ("run 7", "linear", True)
    np.testing.assert_array_equal(record.time, TIME)
    np.testing.assert_array_equal(record.inputs["command"], COMMAND)
    np.testing.assert_array_equal(record.outputs["position"], POSITION)
    assert not record.time.flags.writeable


def test_length_period_and_duration():
    record = a_record()
    assert len(record) == 5
    assert record.duration == pytest.approx(0.4, rel=1e-15)
    assert record.sample_period == pytest.approx(0.1, rel=1e-15)


def test_prints_its_signals():
    assert repr(a_record(name="run 7", outputs={"position": floats(NAN, 0.1, 0.3, NAN, 0.2)})).splitlines() == [
        "Record 'run 7': 5 samples every 0.1 s, 0 to 0.4 s, zero-order hold",
        "  input   command   -1 .. 1",
        "  output  position  0.1 .. 0.3, 2 missing",
    ]
    uneven = a_record(time=floats(0, 0.1, 0.2, 0.4, 0.5), uniform=False, hold="linear")
    assert str(uneven).startswith("Record 'record': 5 samples every 0.1 to 0.2 s, 0 to 0.5 s, linear hold\n")


# Time stamps


@PROPERTY
@given(st.integers(2, 400), st.floats(1e-5, 10.0), st.floats(-1e3, 1e3), SEED, st.sampled_from([1, -1, 0]))
def test_stamps_within_one_percent_of_a_line_are_uniform(count, period, start, seed, ends):
    jitter = np.random.default_rng(seed).uniform(-1, 1, count)
    jitter[[0, -1]] = ends if ends else (1, -1)  # also where the ends tilt or shift the line the most
    time = start + period * (np.arange(count) + 0.0099 * jitter)
    record = Record(time, {"command": np.ones(count)})
    np.testing.assert_array_equal(record.time, time)
    assert record.sample_period == pytest.approx(period, rel=0.02 / (count - 1) + 1e-7)


@PROPERTY
@given(st.integers(4, 400), st.data(), SEED)
def test_a_lost_sample_is_found_and_named(count, data, seed):
    lost = data.draw(st.integers(1, count - 1))
    jitter = np.random.default_rng(seed).uniform(-0.01, 0.01, count + 1)
    time = np.delete(0.002 * (np.arange(count + 1) + jitter), lost)
    with pytest.raises(ValueError, match=rf"sample {lost} comes 0\.00\d+ s after sample {lost - 1},"):
        Record(time, {"command": np.ones(count)})


def test_long_records_with_rounded_stamps_are_uniform():
    exact = 0.001 * np.arange(200_000)
    for rounded in (exact.astype(np.float32), np.round(exact, 5), exact + 1.7e9):
        assert Record(rounded, {"command": np.ones(200_000)}).sample_period == pytest.approx(0.001, rel=1e-7)
    with pytest.raises(ValueError, match="sample 123456 comes 0.002"):
        Record(np.delete(exact, 123_456), {"command": np.ones(199_999)})


def test_a_drifting_clock_is_not_uniform():
    # every step within 0.1 %, their sum 2.5 periods off
    time = 0.001 * np.cumsum(1 + 1e-3 * np.linspace(-1, 1, 10_001))
    with pytest.raises(ValueError, match=r"strays from a straight line by 2\.5 periods"):
        Record(time, {"command": np.ones(10_001)})


def test_non_uniform_time_has_no_sample_period_until_resampled():
    record = a_record(time=floats(0.0, 0.1, 0.2, 0.4, 0.5), uniform=False)
    with pytest.raises(ValueError, match=r"time is not uniform.* sample 3 .*resample\(0\.1\)"):
        _ = record.sample_period
    assert record.slice(0.0, 0.3).sample_period == pytest.approx(0.1)  # its first part is uniform
    even = record.resample(0.1)
    assert even.uniform and even.sample_period == pytest.approx(0.1)
    np.testing.assert_allclose(even.time, [0.0, 0.1, 0.2, 0.3, 0.4, 0.5], rtol=1e-15)
    np.testing.assert_allclose(even.outputs["position"], [0.0, 0.1, 0.3, 0.4, 0.5, 0.2], rtol=1e-12)
    np.testing.assert_array_equal(even.inputs["command"], [0.0, 1.0, 1.0, 1.0, -1.0, -1.0])


# Slice, split, select


def test_slice_keeps_time_and_is_half_open():
    part = a_record(name="run 7", hold="linear").slice(0.1, 0.3)
    np.testing.assert_array_equal(part.time, [0.1, 0.2])
    np.testing.assert_array_equal(part.inputs["command"], [1.0, 1.0])
    np.testing.assert_array_equal(part.outputs["position"], [0.1, 0.3])
    assert (part.name, part.hold) == ("run 7", "linear")
    assert len(a_record().slice()) == 5
    assert len(a_record().slice(start=0.2)) == 3
    assert len(a_record().slice(stop=0.2)) == 2


def test_slice_bounds_allow_for_rounded_stamps():
    time = np.arange(1000) * 0.001
    part = Record(time.astype(np.float32), {"command": time}).slice(0.123, 0.456)
    np.testing.assert_array_equal(part.inputs["command"], time[123:456])


@PROPERTY
@given(st.integers(6, 200), st.data())
def test_slice_is_the_mask_of_its_definition(count, data):
    time = -3.0 + 0.25 * np.arange(count)
    record = Record(time, {"command": noise(1, count)}, {"position": noise(2, count)})
    first = data.draw(st.integers(0, count - 2))
    last = data.draw(st.integers(first + 2, count))
    start, stop = -3.0 + 0.25 * (np.array([first, last]) - data.draw(st.floats(0.03, 0.97)))
    part = record.slice(float(start), float(stop))
    inside = (time >= start) & (time < stop)
    np.testing.assert_array_equal(part.time, time[inside])
    np.testing.assert_array_equal(part.inputs["command"], noise(1, count)[inside])
    np.testing.assert_array_equal(part.outputs["position"], noise(2, count)[inside])


@PROPERTY
@given(st.integers(4, 300), st.data(), st.booleans(), SEED)
def test_the_parts_of_a_split_make_the_record(count, data, by_time, seed):
    jitter = np.random.default_rng(seed).uniform(-0.01, 0.01, count)
    time = 5.0 + 0.01 * (np.arange(count) + jitter)
    record = Record(time, {"command": noise(seed, count)}, {"position": noise(seed + 1, count)})
    cut = data.draw(st.integers(2, count - 2))
    parts = record.split(5.0 + 0.01 * cut) if by_time else record.split(fraction=cut / count)
    assert [len(part) for part in parts] == [cut, count - cut]
    np.testing.assert_array_equal(np.concatenate([part.time for part in parts]), record.time)
    signals = [[part.inputs["command"], part.outputs["position"]] for part in parts]
    np.testing.assert_array_equal(np.hstack(signals), [noise(seed, count), noise(seed + 1, count)])


@pytest.mark.parametrize("bounds", [(0.35, 9.0), (1.0, 2.0), (0.3, 0.1), (NAN, 1.0)])
def test_slice_refuses_to_leave_less_than_two_samples(bounds):
    with pytest.raises(ValueError, match=r"leaves [01] of the 5 samples of 'record' \(0 to 0.4 s\).* least 2"):
        a_record().slice(*bounds)


def test_a_slice_in_which_an_output_rests_says_so():
    record = a_record(outputs={"position": floats(1, 1, 1, 2, 3)})
    with pytest.raises(ValueError, match="'position' never changes, it is 1 from sample 0 to 2.* longer part"):
        record.slice(0.0, 0.3)


@PROPERTY
@given(st.lists(st.booleans(), min_size=4, max_size=60), st.integers(0, 5), st.integers(0, 5))
def test_stretches_are_the_runs_of_their_condition(holds, bridged, shortest):
    """Against runs that are counted one by one."""
    period, wanted = 0.25, list(holds)
    runs = [(value, len(list(same))) for value, same in itertools.groupby(holds)]
    place = 0
    for i, (value, length) in enumerate(runs):
        if not value and 0 < i < len(runs) - 1 and length <= bridged:
            wanted[place : place + length] = [True] * length
        place += length
    expected, place = [], 0
    for value, same in itertools.groupby(wanted):
        length = len(list(same))
        expected += [(place, place + length)] if value and length >= max(shortest, 2) else []
        place += length
    count = len(holds)
    record = Record(5.0 + period * np.arange(count), {"command": noise(1, count)}, {"position": noise(2, count)})
    times = {"bridged": bridged * period, "shortest": shortest * period}
    if not expected:
        with pytest.raises(ValueError, match=rf"expected the condition to hold .* got {sum(holds)} of {count} samples"):
            record.stretches(holds, **times)
        return
    found = record.stretches(holds, **times)
    assert [(round((r.time[0] - 5.0) / period), round((r.time[-1] - 5.0) / period) + 1) for r in found] == expected
    assert len({r.name for r in found}) == len(found)


@pytest.mark.parametrize("condition", [[True] * 4, [1.0] * 5, None, "command > 0", True])
def test_a_condition_is_true_or_false_at_every_sample(condition):
    with pytest.raises(ValueError, match="expected condition to be true or false at each of the 5 samples, got"):
        a_record().stretches(condition)


@pytest.mark.parametrize(
    "where", [{}, {"at": 0.2, "fraction": 0.5}, {"fraction": 0.0}, {"fraction": 1.5}, {"fraction": NAN}]
)
def test_split_needs_one_place(where):
    with pytest.raises(ValueError, match=r"expected either a time \(s\) or a fraction between 0 and 1"):
        a_record().split(**where)


@pytest.mark.parametrize("where", [{"at": 0.1}, {"at": 7.0}, {"at": -7.0}, {"fraction": 0.9}])
def test_split_refuses_a_part_without_two_samples(where):
    with pytest.raises(ValueError, match=r"leaves [01] of the 5 samples"):
        a_record().split(**where)


def test_select_outputs():
    record = a_record(outputs={"position": POSITION, "spool": COMMAND, "load_pressure": TIME})
    chosen = record.select(outputs=["load_pressure", "position"])
    assert list(chosen.outputs) == ["load_pressure", "position"]
    assert list(chosen.inputs) == ["command"]
    np.testing.assert_array_equal(chosen.outputs["load_pressure"], TIME)
    assert dict(record.select(outputs=[]).outputs) == {}
    with pytest.raises(ValueError) as refusal:
        record.select(outputs=["positon"])
    assert str(refusal.value) == (
        "unknown output 'positon' in record 'record' (did you mean 'position'?); "
        "known: 'position', 'spool', 'load_pressure'"
    )
    with pytest.raises(TypeError, match=r"expected a list of output names.* write outputs=\['position'\]"):
        record.select(outputs="position")


# Resample


def test_zero_order_hold_makes_a_staircase():
    record = Record(floats(0, 1, 2, 3), {"command": floats(5, 7, -1, 2)}, {"position": floats(0, 4, 8, 0)})
    fine = record.resample(0.25)
    np.testing.assert_array_equal(fine.time, 0.25 * np.arange(13))
    np.testing.assert_array_equal(fine.inputs["command"], [5, 5, 5, 5, 7, 7, 7, 7, -1, -1, -1, -1, 2])
    np.testing.assert_allclose(fine.outputs["position"], [0, 1, 2, 3, 4, 5, 6, 7, 8, 6, 4, 2, 0], atol=1e-5)
    odd = record.resample(0.8)  # 0, 0.8, 1.6, 2.4
    np.testing.assert_array_equal(odd.inputs["command"], [5, 5, 7, -1])
    np.testing.assert_allclose(odd.outputs["position"], [0.0, 3.2, 6.4, 4.8], atol=1e-5)
    coarse = replace(record, hold="linear").resample(1.5)
    np.testing.assert_allclose(coarse.inputs["command"], [5.0, 3.0, 2.0], atol=1e-5)


def test_a_missing_neighbour_makes_a_missing_sample_and_a_sample_itself_stays():
    record = a_record(outputs={"position": floats(0, 1, NAN, 3, 4)})
    np.testing.assert_allclose(
        record.resample(0.05).outputs["position"], [0, 0.5, 1, NAN, NAN, NAN, 3, 3.5, 4], atol=1e-5
    )


@PROPERTY
@given(st.integers(4, 300), st.floats(1e-4, 10.0), st.sampled_from(["zero", "linear"]), SEED)
def test_resampling_to_its_own_period_changes_nothing(count, period, hold, seed):
    random = np.random.default_rng(seed)
    position = random.standard_normal(count)
    position[1:-1][random.random(count - 2) < 0.3] = NAN
    time = 7.0 + period * (np.arange(count) + random.uniform(-0.01, 0.01, count))
    record = Record(time, {"command": random.standard_normal(count)}, {"position": position}, hold=hold)
    again = record.resample(record.sample_period)
    np.testing.assert_allclose(again.time, time, rtol=0, atol=0.021 * period)
    np.testing.assert_array_equal(again.inputs["command"], record.inputs["command"])
    np.testing.assert_array_equal(again.outputs["position"], position)


@pytest.mark.parametrize("late", [5e-6, -5e-6])
def test_rounded_stamps_neither_delay_nor_lose_a_held_input(late):
    time = (0.001 * np.arange(5000)).astype(np.float32).astype(float)
    time[-1] += late  # half a per cent, so that the sample period is not quite 1 ms
    record = Record(time, {"command": noise(3, 5000)})
    np.testing.assert_array_equal(record.resample(0.001).inputs["command"], record.inputs["command"])


@PROPERTY
@example(4, 36179, 1.0)  # a gap leaves the first reading alone
@given(st.integers(3, 60), SEED, st.floats(0.05, 1.0))
def test_resampling_non_uniform_time_agrees_with_scipy(count, seed, period):
    random = np.random.default_rng(seed)
    time = -2.0 + np.cumsum(random.uniform(0.2, 2.0, count))
    command, position = random.standard_normal((2, count))
    period = min(period, (time[-1] - time[0]) * 0.99)
    record = Record(time, {"command": command}, {"position": position}, uniform=False)
    # A hair behind the end counts as at it.
    stamps = time[0] + period * np.arange(int((time[-1] - time[0]) / period + 0.02) + 1)
    grid = np.minimum(stamps, time[-1])
    steps = np.diff(time)
    in_gap = np.zeros(len(grid), dtype=bool)
    for row in np.flatnonzero(steps > 2.5 * np.median(steps)):
        in_gap |= (grid > time[row] + 1e-6) & (grid < time[row + 1] - 1e-6)
    if (~in_gap).sum() == 1:
        with pytest.raises(ValueError, match=f"single measured sample of {len(grid)}, .* at sample 0: .* fewer gaps"):
            record.resample(period, inputs_known_in_gaps=True)
        return
    even = record.resample(period, inputs_known_in_gaps=True)
    assert even.time[0] == time[0]
    assert even.time[-1] <= time[-1] + 0.021 * period and even.time[-1] + period > time[-1]
    np.testing.assert_allclose(even.time, stamps, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(
        even.outputs["position"], np.where(in_gap, NAN, interp1d(time, position)(grid)), atol=1e-5
    )
    to_next = np.min(np.where(time[:, None] > grid, time[:, None] - grid, INF), axis=0)
    clear = to_next > 0.021 * 2.0  # a hair before a sample counts as at it
    held = interp1d(time, command, kind="previous")(grid)
    np.testing.assert_array_equal(even.inputs["command"][clear], held[clear])


@pytest.mark.parametrize("period", [0.0, -0.1, NAN, INF, 0.5])
def test_resample_refuses_an_impossible_period(period):
    with pytest.raises(ValueError, match=r"cannot resample 'record' to a period of .* at most .* 0\.4 s"):
        a_record().resample(period)
