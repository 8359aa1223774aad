"""One trajectory: what goes in, what comes out, its gradient, and what is refused; the physics is tested elsewhere."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ehsvjax.integrators import runge_kutta_4
from ehsvjax.models import Model, Parameter, Signal, identity, servovalve, van_der_pol
from ehsvjax.record import Record
from ehsvjax.simulate import grid_of, input_array, scan_model, simulate
from tests.plants import held_levels

# --- An integrator of two inputs, whose motion is known by hand: x' = k*push - pull ---


def _start(parameters, initial, inputs):
    return {"x": initial["x0"]}


def _derivative(parameters, state, inputs, signal):
    return {"x": signal("rate", parameters["k"] * inputs["push"] - inputs["pull"])}


def _measure(parameters, state, inputs, signal):
    return {"x": signal("x", state["x"]), "push_seen": signal("push_seen", inputs["push"])}


INTEGRATOR = Model(
    name="integrator",
    parameters=(Parameter("k", "k", "", 2.0, 1.0, 3.0),),
    initial=(Parameter("x0", "x(0)", "", 0.0, -9.0, 9.0),),
    signals=(
        Signal("push", "input", ""),
        Signal("pull", "input", ""),
        Signal("rate", "flow", ""),
        Signal("x", "sensor", ""),
        Signal("push_seen", "sensor", ""),
    ),
    start=_start,
    stepper=runge_kutta_4(_derivative),
    measure=_measure,
    max_step=0.1,
)


def record_of(push, pull=None, hold="zero", period=0.1):
    push = np.asarray(push, dtype=float)
    pull = np.zeros_like(push) if pull is None else np.asarray(pull, dtype=float)
    # In another order than the model's, beside a signal that it does not know.
    return Record(period * np.arange(len(push)), {"pull": pull, "spare": push, "push": push}, hold=hold)


def test_sample_k_is_taken_before_input_k_acts():
    outputs = simulate(INTEGRATOR, record_of([1.0, 3.0, 0.0, 50.0]), initial={"x0": 5.0})
    # Slopes 2, 6, 0 over 0.1 s each; the last input acts after the last sample.
    np.testing.assert_allclose(outputs["x"], [5.0, 5.2, 5.8, 5.8], rtol=1e-14)
    np.testing.assert_array_equal(outputs["push_seen"], [1.0, 3.0, 0.0, 50.0])


@pytest.mark.parametrize("substeps", [1, 3, 10])
def test_a_linear_hold_draws_straight_lines_between_samples(substeps):
    outputs = simulate(INTEGRATOR, record_of([1.0, 3.0, 0.0, 50.0], hold="linear"), substeps=substeps)
    # Trapezia: 2*(1 + 3)/2*0.1, then 2*(3 + 0)/2*0.1, then 2*(0 + 50)/2*0.1.
    np.testing.assert_allclose(outputs["x"], [0.0, 0.4, 0.7, 5.7], rtol=1e-14)


def test_inputs_are_taken_by_name_whatever_their_order():
    outputs = simulate(INTEGRATOR, record_of([0.0, 0.0], [1.0, 0.0]))
    np.testing.assert_allclose(outputs["x"], [0.0, -0.1], rtol=1e-14)
    np.testing.assert_array_equal(input_array(INTEGRATOR, record_of([1.0, 2.0], [3.0, 4.0])), [[1.0, 3.0], [2.0, 4.0]])


def test_time_may_start_anywhere():
    record = Record(100.0 + 0.1 * np.arange(3), {"push": np.ones(3), "pull": np.zeros(3)})
    np.testing.assert_allclose(simulate(INTEGRATOR, record)["x"], [0.0, 0.2, 0.4], rtol=1e-9)


def test_parameters_and_initial_conditions_that_are_given_replace_the_nominal_ones():
    outputs = simulate(INTEGRATOR, record_of([1.0, 1.0]), {"k": 7.0}, {"x0": -1.0})
    np.testing.assert_allclose(outputs["x"], [-1.0, -0.3], rtol=1e-14)
    fixed = INTEGRATOR.with_bounds(fixed={"k": 7.0, "x0": -1.0})
    np.testing.assert_array_equal(simulate(fixed, record_of([1.0, 1.0]))["x"], outputs["x"])


def test_outputs_are_float64_numpy_whatever_the_users_precision_and_leave_it_alone():
    assert not jax.config.jax_enable_x64
    for precision in (False, True):
        with jax.enable_x64(precision):
            outputs = simulate(INTEGRATOR, record_of([1.0, 1.0, 1.0]))
            assert jax.config.jax_enable_x64 == precision
        assert tuple(outputs) == INTEGRATOR.outputs
        for output in outputs.values():
            assert isinstance(output, np.ndarray)
            assert output.dtype == np.float64
    assert not jax.config.jax_enable_x64


def test_a_signal_can_be_disturbed():
    def disturbance(name, value, **context):
        return value + {"rate": 10.0, "x": 100.0}.get(name, 0.0)

    outputs = simulate(INTEGRATOR, record_of([0.0, 0.0, 0.0]), signal=disturbance)
    np.testing.assert_allclose(outputs["x"], [100.0, 101.0, 102.0], rtol=1e-14)


def test_what_stands_in_the_outputs_of_a_record_is_not_looked_at():
    time, inputs = 0.1 * np.arange(3), {"push": np.ones(3), "pull": np.zeros(3)}
    measured = Record(time, inputs, {"x": np.array([5.0, np.nan, 7.0])})
    np.testing.assert_array_equal(simulate(INTEGRATOR, measured)["x"], simulate(INTEGRATOR, Record(time, inputs))["x"])


def test_a_trajectory_that_blows_up_is_returned_as_it_is():
    record = Record(0.1 * np.arange(200), {"command": np.full(200, 1e3)})
    assert not np.isfinite(simulate(van_der_pol(), record)["position"]).all()


# --- Steps ---


@pytest.mark.parametrize(
    ("period", "substeps"), [(0.1, 1), (0.1 * (1 + 1e-9), 1), (0.05, 1), (0.11, 2), (0.3, 3), (1.0, 10)]
)
def test_no_step_is_longer_than_the_models(period, substeps):
    assert grid_of(INTEGRATOR, record_of(np.zeros(50), period=period)).substeps == substeps


@pytest.mark.parametrize(("period", "substeps"), [(1e-3, 4), (0.5e-3, 2), (0.25e-3, 1), (1e-4, 1), (0.9e-3, 4)])
def test_default_steps_of_the_servovalve(period, substeps):
    record = Record(period * np.arange(1001), {"command": np.zeros(1001)})
    assert grid_of(servovalve(), record) == (substeps, "zero")


def test_the_hold_is_the_records():
    assert grid_of(INTEGRATOR, record_of([0.0, 1.0], hold="linear"), 7) == (7, "linear")


@pytest.mark.parametrize("substeps", [1, 2, 8])
def test_substeps_refine_the_same_motion(substeps):
    time = 0.1 * np.arange(100)
    record = Record(time, {"command": np.zeros(100)})
    # Without damping: x1 = cos(sqrt(alpha) t), at alpha = 1, which an RK4 step gives to h^5/120.
    outputs = simulate(
        van_der_pol(), record, {"alpha": 1.0, "gamma": 0.0}, {"initial_position": 1.0}, substeps=substeps
    )
    np.testing.assert_allclose(
        outputs["position"], np.cos(time), rtol=0, atol=1.1 * 100 * (0.1 / substeps) ** 5 * substeps / 120
    )


# --- Compiling ---


def test_other_values_on_a_record_of_the_same_length_are_not_traced_again():
    traces = []

    def counting(name, value, **context):
        if name == "push_seen":
            traces.append(name)
        return value

    for k, x0, push, hold in ((1.0, 0.0, 1.0, "zero"), (2.5, 3.0, -4.0, "zero"), (2.5, 3.0, -4.0, "linear")):
        simulate(INTEGRATOR, record_of(np.full(9, push), hold=hold), {"k": k}, {"x0": x0}, signal=counting)
    assert len(traces) == 2  # once for each hold
    simulate(INTEGRATOR, record_of(np.ones(9), period=0.08), signal=counting)
    assert len(traces) == 2  # another sample period, no more substeps
    simulate(INTEGRATOR, record_of(np.ones(9), period=0.18), signal=counting)
    assert len(traces) == 3  # two substeps


# --- The traced part, for other rooms ---


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_the_scan_visits_outputs_and_samples_in_the_precision_of_its_inputs(precision):
    record = record_of([1.0, 3.0, 0.0])

    def visit(total, outputs, weight):
        return total + weight * outputs["x"], outputs["x"]

    with jax.enable_x64(precision == np.float64):
        total, frames = scan_model(
            INTEGRATOR.equations,
            grid_of(INTEGRATOR, record),
            identity,
            {"k": jnp.asarray(2.0, precision)},
            {"x0": jnp.asarray(5.0, precision)},
            jnp.asarray(input_array(INTEGRATOR, record), precision),
            jnp.asarray(record.sample_period, precision),
            visit,
            jnp.zeros((), precision),
            jnp.asarray([1.0, 10.0, 100.0], precision),
        )
        assert frames.dtype == total.dtype == precision
        np.testing.assert_allclose(frames, [5.0, 5.2, 5.8], rtol=1e-6)
        np.testing.assert_allclose(total, 5.0 + 52.0 + 580.0, rtol=1e-6)


# --- Gradients, through the servovalve with its dead zone, saturation and lock ---


def valve_record(command):
    return Record(1e-3 * np.arange(len(command)), {"command": command})


@functools.partial(jax.jit, static_argnums=(0, 1))
def positions(equations, grid, parameters, initial, inputs):
    def keep(carry, outputs, sample):
        return carry, outputs["position"]

    return scan_model(equations, grid, identity, parameters, initial, inputs, jnp.asarray(1e-3), keep, None, None)[1]


def jacobian(record, initial):
    """Derivatives of the position [time] by every free parameter and initial condition, by name."""
    model = servovalve()
    start = {p.name: p.value for p in model.initial} | initial
    constants = {p.name: p.value for p in model.parameters if p.fixed}
    with jax.enable_x64(True):
        inputs, grid = jnp.asarray(input_array(model, record)), grid_of(model, record)

        def run(unknown):
            return positions(model.equations, grid, constants | unknown, unknown, inputs)

        unknown = {name: model.nominal[name] for name in model.free} | start
        return {name: np.asarray(column) for name, column in jax.jacfwd(run)(unknown).items()}


def test_gradients_against_central_differences():
    model, record = servovalve(), valve_record(held_levels(3, 6e-3, 2, 150))
    initial = {"initial_position": 0.01, "initial_filtered": 1e-4, "initial_filtered_rate": 0.1}
    steps = {name: 1e-6 * value for name, value in (model.nominal | initial).items() if name in (*model.free, *initial)}
    columns = jacobian(record, initial)
    assert set(columns) == set(steps)
    for name, step in steps.items():
        ahead, behind = (
            simulate(
                model,
                record,
                {name: model.nominal[name] + way * step} if name in model.nominal else {},
                initial | ({name: initial[name] + way * step} if name in initial else {}),
            )["position"]
            for way in (1, -1)
        )
        expected = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(columns[name], expected, rtol=0, atol=1e-4 * np.abs(expected).max(), err_msg=name)


@pytest.mark.parametrize(
    ("command", "initial"),
    [
        (np.zeros(300), {}),  # at rest
        (np.full(300, 0.09 * 0.05 + 0.5e-4), {"initial_position": 0.05, "initial_filtered": 0.5e-4}),  # lock
        (np.full(300, 0.0045 + 1e-4), {"initial_position": 0.05, "initial_filtered": 1e-4}),  # opens just now
        (np.full(300, 0.0045 + 3.1e-3), {"initial_position": 0.05, "initial_filtered": 3.1e-3}),  # saturates just now
    ],
)
def test_gradients_are_finite_where_the_valve_has_a_corner(command, initial):
    for name, column in jacobian(valve_record(command), initial).items():
        assert np.isfinite(column).all(), name


def test_in_lock_only_the_initial_position_moves_the_position():
    initial = {"initial_position": 0.05, "initial_filtered": 0.5e-4}
    columns = jacobian(valve_record(np.full(300, 0.09 * 0.05 + 0.5e-4)), initial)
    np.testing.assert_array_equal(columns.pop("initial_position"), 1.0)
    for name, column in columns.items():
        np.testing.assert_array_equal(column, 0.0, err_msg=name)


# --- Bad input ---


def refused(sentence):
    return pytest.raises(ValueError, match=re.escape(sentence))


@pytest.mark.parametrize("given", [{"parameters": {"c": 1.0}}, {"initial": {"c": 1.0}}])
def test_an_unknown_name(given):
    with refused("expected a parameter of integrator, got 'c'; it has k, x0"):
        simulate(INTEGRATOR, record_of([0.0, 1.0]), **given)


@pytest.mark.parametrize("given", [{"parameters": {"x0": 1.0}}, {"initial": {"k": 1.0}}])
def test_a_name_in_the_wrong_place_is_not_ignored(given):
    with pytest.raises(ValueError, match="expected"):
        simulate(INTEGRATOR, record_of([0.0, 1.0]), **given)


def test_a_record_without_the_models_inputs():
    record = Record(np.arange(3.0), {"push": np.ones(3), "volts": np.ones(3)})
    with refused(
        "expected record to hold the inputs of integrator, push, pull; it lacks pull and has push, volts: "
        "name its columns accordingly"
    ):
        simulate(INTEGRATOR, record)


def test_a_record_without_inputs():
    with refused("it lacks command and has none"):
        simulate(servovalve(), Record(np.arange(3.0), {}))


@pytest.mark.parametrize("substeps", [0, -1])
def test_substeps_below_one(substeps):
    with refused(f"expected substeps to be a whole number of at least 1, got {substeps}"):
        simulate(INTEGRATOR, record_of([0.0, 1.0]), substeps=substeps)


def test_substeps_that_are_no_whole_number():
    with refused("expected substeps to be a whole number of at least 1, got 2.5"):
        # As users call it, without the type checks that the tests put around it.
        grid_of.__wrapped__(INTEGRATOR, record_of([0.0, 1.0]), 2.5)


def test_a_record_of_uneven_time_is_refused():
    record = Record(np.array([0.0, 0.1, 0.3]), {"push": np.ones(3), "pull": np.ones(3)}, uniform=False)
    with refused("time is not uniform"):
        simulate(INTEGRATOR, record)
