"""What a simulation's own arithmetic knows: measured by finer steps, against plants that SciPy integrates."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lsim

import ehsvjax
from ehsvjax import Model, Parameter, Signal, runge_kutta_4
from ehsvjax.arithmetic import Arithmetic, arithmetic, arithmetic_at, finest, outputs_of, settled, settled_at
from ehsvjax.population import Problem, to_unit
from ehsvjax.unknowns import problem_of
from tests.plants import held_levels, servovalve_plant

PERIOD, SAMPLES = 1e-3, 2000
NOISE = {"position": 3e-4, "load_pressure": 5e4}
KEY = jax.random.key(0)

# --- A servovalve, whose load pressure all but jumps as the spool leaves its dead zone ---


class Measured:
    """A record of an independent plant, and what the plant does without noise, by output."""

    def __init__(self, seed):
        command = held_levels(seed, 6e-3, SAMPLES // 200, 200)
        motion = servovalve_plant(command, PERIOD)
        rng = np.random.default_rng(seed + 1000)
        self.clean = {name: getattr(motion, name) for name in NOISE}
        noisy = {name: self.clean[name] + NOISE[name] * rng.standard_normal(SAMPLES) for name in NOISE}
        self.record = ehsvjax.Record(PERIOD * np.arange(SAMPLES), {"command": command}, noisy)


def at_the_truth(model: Model, record, deviations) -> tuple[Problem, np.ndarray]:
    """Return the problem under the noise that is there, and the individual that the plant is."""
    problem = problem_of(model, [record], noise_variance={name: d**2 for name, d in deviations.items()})
    values = [model.parameter(name).value for name in (*problem.free, *problem.free_initial)]
    return problem, to_unit(problem.coordinates, np.array(values))


@pytest.fixture(scope="module", params=[1, 3])
def valve(request):
    return Measured(request.param)


@pytest.fixture(scope="module")
def settled_valve(valve):
    return settled_at(*at_the_truth(ehsvjax.servovalve(), valve.record, NOISE))


def errors_of(problem: Problem, individual, valve) -> np.ndarray:
    """Return simulated minus true, `[time, signal]`, in deviations of the noise."""
    found = outputs_of(problem, individual)[0]
    return np.stack([(found[:, i] - valve.clean[n]) / NOISE[n] for i, n in enumerate(problem.observed)], axis=-1)


def test_readings_that_are_kept_are_those_of_the_plant(valve, settled_valve):
    problem, truth = at_the_truth(ehsvjax.servovalve(), valve.record, NOISE)
    kept = settled_valve.samples.measured[0]
    every, of_kept = errors_of(problem, truth, valve), errors_of(settled_valve, truth, valve)[kept]
    assert np.sum(every**2) > 50.0, "a record whose arithmetic needs nothing shows nothing"
    assert np.max(np.abs(of_kept)) < 0.2
    assert np.sum(of_kept**2) < 1.0


def test_few_readings_are_left_out_and_none_of_the_position(settled_valve):
    left_out = ~settled_valve.samples.measured[0]
    assert settled_valve.observed == ("position", "load_pressure")
    assert 0 < left_out.sum() <= 0.03 * left_out.size
    assert not left_out[:, 0].any()


def test_a_position_alone_is_simulated_as_before(valve):
    alone = valve.record.select(outputs=["position"])
    problem, truth = at_the_truth(ehsvjax.servovalve(), alone, {"position": NOISE["position"]})
    assert settled_at(problem, truth) is problem
    fit = ehsvjax.identify(ehsvjax.servovalve(), alone, key=KEY, population=50, generations=20)
    assert fit.model.max_step == ehsvjax.servovalve().max_step == fit.effort.step_size
    assert fit.effort.left_out == 0 and fit.effort.arithmetic < 0.01


def test_a_fit_says_which_step_and_how_many_readings_are_left_out(valve):
    fit = ehsvjax.identify(ehsvjax.servovalve(), valve.record, key=KEY, population=50, generations=20)
    assert 0 < fit.effort.left_out <= 0.03 * 2 * SAMPLES
    assert fit.effort.arithmetic <= 0.05
    assert f"{fit.effort.left_out}" in str(fit) and f"{1e6 * fit.effort.step_size:.3g} µs" in str(fit)
    for name, deviation in NOISE.items():
        # Of 2,000 readings the standard deviation is known to 1.6%.
        assert fit.noise_variance[name] ** 0.5 == pytest.approx(deviation, rel=0.08), name


# --- A stiff model of one's own, by an explicit method ---

MASS, STIFF_DAMPING, STIFFNESS = 1.0, 5000.0, 2e5
STABLE = 2.785


def damper(max_step=1e-3) -> Model:
    """m*x'' = u - c*x' - k*x: the velocity settles in 0.2 ms."""
    return Model(
        name="damper",
        parameters=(
            Parameter("damping", "c", "N s/m", 2000.0, 300.0, 30000.0, "log"),
            Parameter("mass", "m", "kg", MASS, 0.1, 10.0, fixed=True),
            Parameter("stiffness", "k", "N/m", STIFFNESS, 1e4, 1e6, fixed=True),
        ),
        initial=(Parameter("initial_position", "x(0)", "m", 0.0, -1e-3, 1e-3, output="position"),),
        signals=(Signal("push", "input", "N"), Signal("position", "sensor", "m")),
        start=_damper_start,
        stepper=runge_kutta_4(_damper_rates),
        measure=_damper_outputs,
        max_step=max_step,
    )


def _damper_start(parameters, initial, inputs):
    del parameters, inputs
    return {"x": initial["initial_position"], "v": 0.0}


def _damper_outputs(parameters, state, inputs, signal):
    del parameters, inputs
    return {"position": signal("position", state["x"])}


def _damper_rates(parameters, state, inputs, signal):
    force = signal("push", inputs["push"]) - parameters["damping"] * state["v"] - parameters["stiffness"] * state["x"]
    return {"x": state["v"], "v": force / parameters["mass"]}


@pytest.fixture(scope="module")
def pushed():
    push = held_levels(4, 1000.0, 20, 50)
    system = [[0.0, 1.0], [-STIFFNESS / MASS, -STIFF_DAMPING / MASS]], [[0.0], [1.0 / MASS]], [[1.0, 0.0]], [[0.0]]
    time = PERIOD * np.arange(len(push))
    clean = lsim(system, push, time, interp=False)[1]
    noise = 2e-5 * np.random.default_rng(5).standard_normal(len(push))
    return ehsvjax.Record(time, {"push": push}, {"position": clean + noise})


def test_a_stiff_model_is_identified_and_not_the_stability_limit_of_its_step(pushed):
    model = damper()
    limit = STABLE * MASS / model.max_step
    assert limit < 0.6 * STIFF_DAMPING, "the step that was wished for is not stable at the truth"
    fit = ehsvjax.identify(model, pushed, key=KEY, population=50, generations=20)
    found, error = fit.parameters["damping"], fit.standard_errors["damping"]
    assert abs(found - STIFF_DAMPING) < 3.0 * error and error < 0.01 * STIFF_DAMPING, str(fit)
    assert fit.effort.step_size < STABLE * MASS / STIFF_DAMPING
    assert fit.effort.arithmetic <= 0.01 and fit.effort.left_out == 0
    # All that is simulated with the fit has its step.
    assert fit.model.max_step == fit.effort.step_size
    assert fit.rmse["position"] == pytest.approx(2e-5, rel=0.1)


# --- What `arithmetic` does with any simulation ---


def alone(substeps=1) -> Problem:
    """Return a problem of 40 readings of noise 1, of which nothing is simulated."""
    rng = np.random.default_rng(6)
    record = ehsvjax.Record(np.arange(40.0), {"push": np.ones(40)}, {"position": 10.0 * rng.standard_normal(40)})
    problem = problem_of(damper(max_step=1.0), [record], noise_variance={"position": 1.0})
    return replace(problem, substeps=np.int32(substeps))


ONE = np.ones(1)


def erring(errors: np.ndarray, order: float):
    """Return simulations of the same truth, off by errors that vanish with the step."""
    return lambda substeps: (np.sin(np.arange(40)) + errors / float(substeps) ** order)[None, None, :, None]


ERRORS = st.lists(st.floats(-30.0, 30.0), min_size=40, max_size=40).map(np.array)
ORDERS = st.sampled_from([0.25, 1.0, 2.0, 4.0])


@settings(max_examples=60, deadline=None)
@given(errors=ERRORS, order=ORDERS, factor=st.floats(1.0, 100.0))
def test_larger_errors_are_known_of_no_more_readings_at_the_same_step(errors, order, factor):
    problem = alone()
    some, more = (arithmetic(problem, erring(f * errors, order), ONE) for f in (1.0, factor))
    assert more.substeps >= some.substeps
    if more.substeps == some.substeps and not np.all(more.known):
        assert np.sum(more.known) <= np.sum(some.known)


@settings(max_examples=60, deadline=None)
@given(errors=ERRORS, order=ORDERS)
def test_what_is_known_is_off_by_less_than_it_is_said_to_be_worth(errors, order):
    found = arithmetic(alone(), erring(errors, order), ONE)
    here, finer = (erring(errors, order)(k * found.substeps)[0] for k in (1, 2))
    off = ((finer - here) ** 2)[found.known]
    assert off.sum() <= found.worth * (1.0 + 1e-9) + 1e-12
    # Readings that are left out are off by more than any that is kept.
    left_out = ((finer - here) ** 2)[~found.known]
    assert left_out.size <= 0.05 * 40 and not (off.size and left_out.size and left_out.min() < off.max() - 1e-12)


def test_a_long_record_is_stepped_finer_up_to_a_point_and_a_short_one_beyond():
    short = alone()
    long = replace(short, samples=short.samples._replace(inputs=np.zeros((1, 200_000, 1))))
    tried = {steps: [finest(replace(one, substeps=np.int32(steps))) for one in (short, long)] for steps in (32, 64)}
    assert tried == {32: [False, False], 64: [False, True]}


def test_what_no_step_settles_is_not_stepped_finer_by_the_next_who_tries():
    # A fit hands on the step at which it gave up, and a diagnosis begins there.
    errors = erring(np.full(40, 1e6), 0.25)
    once = settled(alone(), errors, ONE)
    again = replace(once, grid=once.grid._replace(substeps=int(once.substeps)))
    assert finest(once) and settled(again, errors, ONE).substeps == once.substeps


@settings(max_examples=60, deadline=None)
@given(errors=ERRORS, order=ORDERS)
def test_what_is_settled_stays_so(errors, order):
    problem = alone()
    once = settled(problem, erring(errors, order), ONE)
    assert settled(once, erring(errors, order), ONE) is once
    assert once.substeps >= problem.substeps
    assert not np.any(once.samples.measured & ~problem.samples.measured)


@settings(max_examples=60, deadline=None)
@given(errors=ERRORS, order=ORDERS, lost=st.sets(st.integers(0, 39), min_size=1, max_size=40))
@pytest.mark.parametrize("nothing", [np.nan, np.inf])
def test_what_is_not_finite_at_any_step_is_not_known(errors, order, lost, nothing):
    errors = errors.copy()
    errors[list(lost)] = nothing
    found: Arithmetic = arithmetic(alone(), erring(errors, order), ONE)
    assert np.isfinite(found.worth) or finest(replace(alone(), substeps=np.int32(found.substeps)))
    if not finest(replace(alone(), substeps=np.int32(found.substeps))):
        assert not found.known[0, list(lost), 0].any()
    else:
        # Too much is lost to hide it: nothing is left out, and what it is worth says so.
        assert found.worth == np.inf or not found.known[0, list(lost), 0].any()


def test_missing_readings_stay_missing_and_are_not_counted():
    problem = alone()
    problem.samples.measured[0, ::2] = False
    errors = np.where(np.arange(40) % 2 == 0, 1e6, 0.0)
    found = arithmetic(problem, erring(errors, 0.25), ONE)
    assert found.substeps == 1 and found.worth == 0.0
    np.testing.assert_array_equal(found.known, problem.samples.measured)


def test_an_individual_that_fails_is_worth_without_end(pushed):
    # At ten times the limit of the finest step.
    problem, truth = at_the_truth(damper(max_step=PERIOD), pushed, {"position": 2e-5})
    failing = replace(problem, known=problem.known | {"mass": np.array(1e-6)})
    assert arithmetic_at(failing, truth).worth == np.inf
