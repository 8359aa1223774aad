"""From records to a problem: noise guessed from a record, bounds of initial conditions, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import ehsvjax
from ehsvjax.unknowns import guess_noise_variance, problem_of, where_to_search

TIME = np.arange(2000) * 1e-3
SMOOTH = np.sin(40.0 * TIME) + 0.3 * np.cos(95.0 * TIME)


def _record(position=None, samples=300, name="bench 3"):
    rng = np.random.default_rng(1)
    position = rng.normal(size=samples) if position is None else position
    return ehsvjax.Record(np.arange(samples) * 0.02, {"command": np.ones(samples)}, {"position": position}, name=name)


@pytest.mark.parametrize("deviation", [1e-3, 1e-2, 1e-1])
def test_white_noise_is_guessed_from_a_smooth_signal(deviation):
    noise = np.random.default_rng(7).normal(0.0, deviation, len(TIME))
    # The median of 2,000 correlated differences knows a variance to about 8 %; the signal's own are 1e-4 at most.
    assert guess_noise_variance(SMOOTH + noise) == pytest.approx(deviation**2, rel=0.3)


def test_guess_is_not_moved_by_steps_spikes_and_gaps():
    noisy = SMOOTH + np.random.default_rng(7).normal(0.0, 0.01, len(TIME))
    noisy[700:] += 5.0
    noisy[::100] += 3.0
    noisy[300:320] = np.nan
    assert guess_noise_variance(noisy) == pytest.approx(1e-4, rel=0.4)


def test_a_record_without_noise_can_be_weighted_too():
    assert guess_noise_variance(np.ones(50) * 3.0 + np.arange(50)) == pytest.approx(1e-12 * np.var(np.arange(50)))
    assert guess_noise_variance(np.array([1.0, 2.0])) > 0  # too short for a third difference


@settings(max_examples=30, deadline=None)
@given(st.floats(-3, 3, exclude_min=True, exclude_max=True), st.floats(0.001, 0.3), st.integers(0, 10**6))
def test_bounds_of_an_initial_condition_hold_what_the_output_shows(start, deviation, seed):
    time = np.arange(300) * 0.02
    position = start * np.cos(time) + np.random.default_rng(seed).normal(0.0, deviation, 300)
    problem = problem_of(ehsvjax.van_der_pol(), [_record(position)])
    place = len(problem.free) + problem.free_initial.index("initial_position")
    assert problem.coordinates.lower[place] < start < problem.coordinates.upper[place]


@pytest.mark.parametrize(("start", "bounds"), [(3.0, (-3.0, 3.0)), (-3.0, (-3.0, 3.0))])
def test_a_start_on_its_bound_is_held_by_it(start, bounds):
    # All readings lie within the bounds: nothing speaks against them.
    problem = problem_of(ehsvjax.van_der_pol(), [_record(start * np.cos(np.arange(300) * 0.02))])
    place = len(problem.free) + problem.free_initial.index("initial_position")
    assert (problem.coordinates.lower[place], problem.coordinates.upper[place]) == bounds


def test_unknowns_stand_in_their_order():
    records = [_record(), _record(samples=200)]
    problem = problem_of(ehsvjax.van_der_pol(), records, initial={"initial_velocity": 0.5})
    assert problem.free == ("alpha", "gamma")
    assert problem.free_initial == ("initial_position",)
    assert problem.unknowns == 4
    np.testing.assert_array_equal(problem.known_initial["initial_velocity"], [0.5, 0.5])
    assert problem.samples.measured.sum() == 500


def test_bounds_given_for_an_initial_condition_stand():
    model = ehsvjax.van_der_pol().with_bounds({"initial_position": (-7.0, 9.0)})
    problem = problem_of(model, [_record()])
    assert (problem.coordinates.lower[2], problem.coordinates.upper[2]) == (-7.0, 9.0)


def _with_bounds_of_start(lower, upper):
    model = ehsvjax.van_der_pol()
    initial = tuple(p._replace(lower=lower, upper=upper) if p.output else p for p in model.initial)
    return replace(model, initial=initial)


def _bounds(coordinates):
    return coordinates.lower[2], coordinates.upper[2]


def test_bounds_of_a_users_model_stand_and_the_search_begins_where_the_output_does():
    # An oscillation that turns over within five samples: their median says nothing of the first.
    oscillating = 0.2 * np.cos(2.2 * np.arange(300))
    records = [_record(oscillating)]
    model = _with_bounds_of_start(-0.3, 0.3)
    problem = problem_of(model, records)
    assert _bounds(problem.coordinates) == (-0.3, 0.3)
    lower, upper = _bounds(where_to_search(model, records, problem))
    assert -0.3 <= lower < oscillating[0] < upper <= 0.3


def test_bounds_that_the_first_readings_contradict_are_wide_enough_for_them():
    records = [_record(5.0 + 0.2 * np.cos(0.1 * np.arange(300)))]
    model = _with_bounds_of_start(-0.3, 0.3)
    lower, upper = _bounds(problem_of(model, records).coordinates)
    assert lower == -0.3 and upper > 5.2
    lower, upper = _bounds(where_to_search(model, records, problem_of(model, records)))
    assert 4.5 < lower < 5.2 < upper < 6.0


@settings(max_examples=30, deadline=None)
@given(st.floats(0.05, 3.0), st.floats(0.0, 6.3), st.integers(0, 8), st.integers(0, 10**6))
@example(1.0, 1.0, 4, 0)  # the first readings turn, what is missing before them was steep
def test_the_search_begins_about_the_true_start_of_an_oscillation(speed, phase, missing, seed):
    # Up to some six samples a period, the first readings missing, one of them a spike.
    true = np.cos(speed * np.arange(300) / 3.0 + phase)
    position = true + np.random.default_rng(seed).normal(0.0, 0.01, 300)
    position[missing + seed % 5] += 3.0 * (seed % 2)
    position[:missing] = np.nan
    model, records = ehsvjax.van_der_pol(), [_record(position)]
    lower, upper = _bounds(where_to_search(model, records, problem_of(model, records)))
    assert lower < true[0] < upper


MODEL = ehsvjax.van_der_pol()


@pytest.mark.parametrize(
    ("model", "options", "sentence"),
    [
        (MODEL, {"initial": "zero"}, "to be 'estimate', 'nominal' or known values by name, got 'zero'"),
        (
            MODEL,
            {"initial": {"speed": 0.0}},
            "initial condition of Van der Pol oscillator, got 'speed'; it has initial",
        ),
        (MODEL, {"initial": {"initial_position": np.nan}}, "expected initial_position to be a finite number, got nan"),
        (MODEL, {"initial": [{}, {}]}, "expected initial conditions for each of 1 records, got 2"),
        (
            MODEL,
            {"noise_variance": {}},
            "expected the noise variance of each measured output of .*, position; got none",
        ),
        (
            MODEL,
            {"noise_variance": {"position": 0.0}},
            "noise_variance of position to be positive, got 0.0: give it in",
        ),
        (
            MODEL,
            {"noise_variance": {"position": np.inf}},
            "noise_variance of position to be a finite number, got inf: give it in",
        ),
        (MODEL, {"huber": 0.0}, "expected huber to be a positive number of standard deviations"),
        (MODEL, {"huber": float("nan")}, "expected huber to be a positive number"),
        (
            MODEL.with_bounds(fixed={"alpha": 1.0, "gamma": 1.0}),
            {"initial": "nominal"},
            "expected something to identify, got .* with every parameter fixed: free one by bounds=.*, of alpha",
        ),
    ],
)
def test_what_cannot_be_meant_is_answered(model, options, sentence):
    with pytest.raises(ValueError, match=sentence):
        problem_of(model, [_record()], **options)


def test_records_that_know_different_things_are_answered():
    with pytest.raises(ValueError, match="expected the same initial conditions to be known in every record"):
        problem_of(MODEL, [_record(), _record()], initial=[{"initial_position": 0.0}, {"initial_velocity": 0.0}])


def test_too_short_a_record_is_answered():
    with pytest.raises(ValueError, match="got 4 measured samples in bench 3 for 4 unknowns: fix parameters, give init"):
        problem_of(MODEL, [_record(samples=4)])
