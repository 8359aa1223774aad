"""What a record shows before any fit: records with one fault each, and one without."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ehsvjax
from tests.hidden_plants import held_levels, servovalve_with

PERIOD = 1e-3
RNG = np.random.default_rng(5)
COMMAND = held_levels(RNG, 4e-3, 20, 100)
TIME = PERIOD * np.arange(len(COMMAND))
POSITION = servovalve_with([{}], COMMAND[None], PERIOD)["position"][0] + RNG.normal(0.0, 1e-4, len(COMMAND))

FIFTH = np.arange(len(TIME)) % 5 == 0
NOISE = RNG.normal(0.0, 1e-3, len(TIME))


def record_of(position=POSITION, command=COMMAND, time=TIME, **settings):
    return ehsvjax.Record(time, {"command": command}, {"position": position}, name="bench", **settings)


def looked_at(record, model=None):
    return {finding.subject: finding for finding in record.check(model).findings if not finding.passed}


def test_nothing_is_wrong_with_a_record_of_a_valve():
    found = record_of().check(ehsvjax.servovalve())
    assert found.passed, str(found)
    assert str(found).splitlines()[0] == "bench: all in order"
    assert len(str(found).splitlines()) == 1 + len(found.findings)


def test_an_end_of_the_sensor_is_seen_and_marked():
    clipped = record_of(np.minimum(POSITION, 0.5 * POSITION.max()))
    end = looked_at(clipped)["position, ends"]
    assert "at its highest" in end.seen and "record.within(position=(low, high))" in end.remedy
    end = 0.5 * POSITION.max()
    marked = clipped.within(position=(-np.inf, end))
    assert not looked_at(marked).keys() & {"position, ends"}
    np.testing.assert_array_equal(np.isnan(marked.outputs["position"]), end <= POSITION)


@given(st.integers(0, 2**32 - 1), st.sampled_from([2e-4, 5e-4, 2e-3]))
@settings(max_examples=30, deadline=None)
def test_a_coarse_sensor_has_no_ends_and_does_not_stand_still(seed, step):
    """Rests of a coarse sensor are everywhere, its highest and lowest reading among them."""
    walk = np.cumsum(np.random.default_rng(seed).normal(0.0, 1e-3, len(TIME)))
    found = looked_at(record_of(step * np.round(walk / step)))
    assert "position, ends" not in found and "position, alive" not in found


@pytest.mark.parametrize(
    ("changes", "subject", "said"),
    [
        ({"position": np.where(TIME > 1.4, 1e-3, POSITION)}, "position, alive", "stands still for 600 samples"),
        ({"position": 2e-3 * np.round(POSITION / 2e-3)}, "position, steps", "a lattice of 0.002"),
        ({"position": POSITION + 0.02 * (np.arange(len(TIME)) % 41 == 7)}, "position, spikes", "stand alone"),
        ({"position": np.where(FIFTH, np.nan, POSITION)}, "position", "400 missing, 1 in a row"),
        ({"command": np.full(len(TIME), 1e-3)}, "command", "never changes"),
        ({"command": np.where(COMMAND > 0.0, 1e-3, -1e-3)}, "command", "2 values"),
        ({"command": NOISE, "hold": "linear"}, "command, between samples", "half the sample"),
        ({"time": TIME + 4e-4 * (np.arange(len(TIME)) % 2), "uniform": False}, "time", "not uniform"),
    ],
)  # fmt: skip
def test_each_fault_is_seen(changes, subject, said):
    found = looked_at(record_of(**changes))
    assert said in found[subject].seen and found[subject].remedy


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"position": -POSITION}, "the opposite sign of"),
        ({"command": 1e3 * COMMAND}, "0.001 times command"),
    ],
)
def test_a_model_says_which_sign_or_unit_it_would_understand(changes, said):
    found = looked_at(record_of(**changes), ehsvjax.servovalve())
    assert said in found["position, by servovalve"].remedy


def test_a_time_in_milliseconds_is_doubted():
    found = looked_at(record_of(time=1e3 * TIME), ehsvjax.servovalve())
    assert "is its time in ms?" in found["servovalve, time"].remedy


def test_a_record_that_a_model_cannot_take_is_told_so():
    found = looked_at(ehsvjax.Record(TIME, {"voltage": COMMAND}, {"position": POSITION}), ehsvjax.servovalve())
    assert "it lacks command" in found["servovalve"].remedy


def test_names_are_escaped_in_a_notebook():
    html = ehsvjax.Record(TIME, {"<u>": COMMAND}, {"y": POSITION}).check()._repr_html_()
    assert "&lt;u&gt;" in html and "<u>" not in html


def test_what_is_no_model_or_no_output_is_refused():
    with pytest.raises(ValueError, match="expected model to be a Model, got 'servovalve'"):
        record_of().check("servovalve")
    with pytest.raises(ValueError, match=r"expected outputs of 'bench' \(position\), got 'speed'"):
        record_of().within(speed=(0.0, 1.0))
    for ends in ((1.0, 0.0), (0.0,), "ab", 1.0, (np.nan, 1.0), (None, 1.0)):
        with pytest.raises(ValueError, match="expected the ends of position as a pair"):
            record_of().within(position=ends)


def test_a_record_is_drawn_with_what_is_missing():
    figure = record_of(np.where(TIME < 0.1, np.nan, POSITION)).plot()
    assert [axes.get_ylabel() for axes in figure.axes] == ["command", "position"]
    assert figure.axes[1].get_legend().get_texts()[0].get_text() == "100 missing"
    assert figure._repr_png_().startswith(b"\x89PNG")
