"""Linear models against closed forms, derivatives worked out by hand, and what a simulated valve does when wiggled."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import StateSpace

import ehsvjax
from tests import small_models
from tests.small_models import MASS, STIFFNESS


def _carriage_matrices(mass, damping, stiffness):
    return np.array([[-damping / mass, -stiffness / mass], [1.0, 0.0]]), np.array([[1.0 / mass], [0.0]])


def test_the_oscillator_at_the_origin_is_its_closed_form():
    linear = ehsvjax.linearise(ehsvjax.van_der_pol(alpha=0.9, gamma=1.1))
    assert (linear.states, linear.inputs, linear.outputs) == (("x1", "x2"), ("command",), ("position",))
    np.testing.assert_allclose(linear.a, [[0.0, 0.9], [-1.0, 1.1]], atol=1e-10)
    np.testing.assert_allclose(linear.b, [[0.0], [1.0]], atol=1e-10)
    np.testing.assert_allclose(linear.c, [[1.0, 0.0]], atol=1e-10)
    np.testing.assert_allclose(linear.d, [[0.0]], atol=1e-10)
    assert linear.point == {"command": 0.0, "x1": 0.0, "x2": 0.0, "position": 0.0}
    # It is not stable there, so that nothing lasting comes of a lasting command.
    assert np.isnan(linear.lasting).all() and "does not settle" in str(linear)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.2, 90.0), st.floats(0.6, 9.0), st.floats(2.0, 900.0), st.floats(-20.0, 20.0))
def test_a_linear_model_is_itself_wherever_it_rests(mass, damping, stiffness, push):
    values = {"mass": mass, "damping": damping, "stiffness": stiffness}
    linear = ehsvjax.linearise(
        small_models.carriage(), {"push": push}, parameters=values, initial={"initial_position": push / stiffness},
        inputs=["push", "force"], outputs=["velocity", "position"],
    )  # fmt: skip
    assert linear.states == ("v", "x")
    a, b = _carriage_matrices(mass, damping, stiffness)
    np.testing.assert_allclose(linear.a, a, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(linear.b, np.hstack([b, b]), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(linear.c, np.eye(2), atol=1e-10)
    np.testing.assert_allclose(linear.lasting, [[0.0, 0.0], [1.0 / stiffness] * 2], rtol=1e-8, atol=1e-10)
    frequency = np.geomspace(0.1, 100.0, 7)
    _, response = StateSpace(a, b, [[1.0, 0.0]], [[0.0]]).freqresp(frequency)
    np.testing.assert_allclose(linear.response(frequency)[:, 0, 0], response, rtol=1e-7)
    assert isinstance(linear.system, StateSpace)
    np.testing.assert_allclose(linear.system.A, linear.a)


def test_a_valve_that_moves_steadily_is_linear_in_its_opening_and_its_load():
    """Without a spring the piston moves on: what the orifice does to the load is worked out here by hand."""
    model = ehsvjax.servovalve(open_loop=True, stiffness=0.0, mass=20.0, leakage_coefficient=2e-12)
    seen = ["load_pressure", "position", "opening"]
    linear = ehsvjax.linearise(model, {"command": 1e-3}, inputs=["command", "load_force"], outputs=seen)
    p = {**model.nominal, **linear.point}
    assert linear.states == ("position", "velocity", "filtered", "filtered_rate")
    flow = p["piston_area"] * p["velocity"] + p["leakage_coefficient"] * p["load_pressure"]
    root = (p["supply_pressure"] - p["load_pressure"]) ** 0.5
    assert flow == pytest.approx(p["flow_gain"] * p["opening"] * root)
    # H*xv*sqrt(Ps - PL) = A*v + Ct*PL, and M*v' = A*PL - F.
    by_pressure = p["leakage_coefficient"] + p["flow_gain"] * p["opening"] / (2.0 * root)
    pressure_by_velocity = -p["piston_area"] / by_pressure
    pressure_by_opening = p["flow_gain"] * root / by_pressure
    per_mass = p["piston_area"] / p["mass"]
    rate, damping = p["natural_frequency"], p["damping_ratio"]
    a = [
        [0.0, 1.0, 0.0, 0.0],
        [0.0, per_mass * pressure_by_velocity, per_mass * pressure_by_opening, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [0.0, 0.0, -(rate**2), -2.0 * damping * rate],
    ]
    np.testing.assert_allclose(linear.a, a, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(linear.b, [[0.0, 0.0], [0.0, -1.0 / p["mass"]], [0.0, 0.0], [rate**2, 0.0]],
                               rtol=1e-8, atol=1e-6)  # fmt: skip
    c = [[0.0, pressure_by_velocity, pressure_by_opening, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    np.testing.assert_allclose(linear.c, c, rtol=1e-8, atol=1e-3)
    assert np.sort(linear.poles.real)[0] == pytest.approx(per_mass * pressure_by_velocity)


def test_what_acts_and_what_is_seen_stand_in_the_order_in_which_they_were_asked_for():
    model = ehsvjax.servovalve(open_loop=True, stiffness=0.0)
    one = ehsvjax.linearise(model, {"command": 1e-3}, inputs=["load_force", "command"], outputs=["spool", "opening"])
    other = ehsvjax.linearise(model, {"command": 1e-3}, inputs=["command", "load_force"], outputs=["opening", "spool"])
    np.testing.assert_array_equal(one.b, other.b[:, ::-1])
    np.testing.assert_array_equal(one.c, other.c[::-1])
    assert one.b[1, 0] == pytest.approx(-1.0 / 20.0) and one.point["opening"] == other.point[
        "opening"
    ] == pytest.approx(9e-4)


@pytest.mark.parametrize("hertz", [3.0, 30.0])
def test_a_valve_that_is_wiggled_answers_as_its_linear_model_says(hertz):
    """In closed loop, open against its leakage; amplitude and phase of the simulation by a fit of sine and cosine."""
    model = ehsvjax.servovalve(leakage_coefficient=2e-11, stiffness=4e5)
    at, small = 2e-3, 1e-7
    linear = ehsvjax.linearise(model, {"command": at}, initial={"initial_position": 0.015})
    period, count = 2.5e-4, 8000
    time = period * np.arange(count)
    wiggle = small * np.sin(2 * np.pi * hertz * time)
    record = ehsvjax.Record(time, {"command": at + wiggle}, hold="linear")
    start = {
        "initial_position": linear.point["position"], "initial_filtered": linear.point["filtered"],
        "initial_filtered_rate": 0.0,
    }  # fmt: skip
    found = ehsvjax.simulate(model, record, initial=start, substeps=20)
    late = slice(count // 2, None)
    both = np.stack([np.sin(2 * np.pi * hertz * time), np.cos(2 * np.pi * hertz * time), np.ones(count)], axis=1)[late]
    (response,) = linear.response(np.array([2 * np.pi * hertz]))
    for i, name in enumerate(linear.outputs):
        (real, imaginary, _), *_ = np.linalg.lstsq(both, found[name][late], rcond=None)
        assert (real + 1j * imaginary) / small == pytest.approx(response[i, 0], rel=2e-3), name


def test_what_lags_behind_a_sensor_is_a_state():
    bounds = {"sensor_lag@position.time_constant": (0.0, 1.0)}
    model = ehsvjax.effects.attach(small_models.carriage(), bounds, 10.0, ehsvjax.effects.BANK)
    linear = ehsvjax.linearise(
        model, {"push": 1.0}, parameters={"sensor_lag@position.time_constant": 0.05}, outputs=["position"]
    )
    s = 1j * np.array([0.5, 5.0, 50.0])
    expected = 1.0 / (MASS * s**2 + model.nominal["damping"] * s + STIFFNESS) / (1.0 + 0.05 * s)
    np.testing.assert_allclose(linear.response(s.imag)[:, 0, 0], expected, rtol=1e-7)
    assert len(linear.poles) == 3


def test_the_band_of_a_fit_is_what_its_errors_do_to_the_response():
    rng = np.random.default_rng(5)
    push = rng.choice([-5.0, 5.0], 40).repeat(10)
    outputs = small_models.carriage_plant(push, 0.02).T + rng.normal(size=(2, 400)) * [[1e-2], [5e-2]]
    record = ehsvjax.Record(
        0.02 * np.arange(400), {"push": push}, dict(zip(("position", "velocity"), outputs, strict=True))
    )
    fit = ehsvjax.identify(small_models.carriage(), record, key=jax.random.key(0), population=20, generations=5)
    linear = fit.linearise()
    frequency = np.geomspace(0.5, 20.0, 5)
    damping, error = fit.parameters["damping"], fit.standard_errors["damping"]
    s = 1j * frequency
    np.testing.assert_allclose(linear.response(frequency)[:, 0, 0],
                               1.0 / (MASS * s**2 + damping * s + STIFFNESS), rtol=1e-7)  # fmt: skip
    by_damping = -s / (MASS * s**2 + damping * s + STIFFNESS) * error
    found = linear.deviation(frequency)[:, 0, 0]
    np.testing.assert_allclose(found.real, np.abs(by_damping.real), rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(found.imag, np.abs(by_damping.imag), rtol=1e-3, atol=1e-9)
    figure = linear.plot_bode()
    assert [axes.get_title(loc="left") for axes in figure.axes[::2]] == ["push to position", "push to velocity"]
    drawn = figure.axes[0].lines[0].get_ydata()
    at = 2 * np.pi * figure.axes[0].lines[0].get_xdata()
    np.testing.assert_allclose(drawn, 20 * np.log10(np.abs(linear.response(at)[:, 0, 0])))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"at": {"voltage": 1.0}}, "expected inputs of carriage, push; got 'voltage'"),
        ({"at": {"push": np.nan}}, "expected push to be a finite number"),
        ({"inputs": "push"}, "give them in a list"),
        ({"inputs": ["spring"]}, "expected a signal of carriage, got 'spring'"),
        ({"outputs": []}, "expected outputs to be names of signals"),
        ({"parameters": {"area": 1.0}}, "expected a parameter of carriage, got 'area'"),
        ({"initial": {"mass": 1.0}}, "expected one of the initial conditions of carriage here"),
    ],
)
def test_what_cannot_be_linearised_is_refused(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        ehsvjax.linearise(small_models.carriage(), **arguments)


def test_a_model_that_never_rests_is_refused_with_what_moves():
    with pytest.raises(ValueError, match=r"expected Van der Pol oscillator to come to rest.*x[12] still changes"):
        ehsvjax.linearise(ehsvjax.van_der_pol(), initial={"initial_position": 1.0})
    with pytest.raises(ValueError, match="got a simulation that is not finite"):
        ehsvjax.linearise(small_models.carriage(), parameters={"stiffness": 1e9}, initial={"initial_position": 0.1})


def _draining(parameters, state, inputs, signal):
    del parameters
    return {"x": signal("push", inputs["push"]) - jnp.sqrt(jnp.abs(state["x"])), "v": 0.0 * state["v"]}


def test_a_point_where_the_equations_have_no_slope_is_refused():
    model = replace(small_models.carriage(), stepper=ehsvjax.runge_kutta_4(_draining), signals=tuple(
        s for s in small_models.carriage().signals if s.name != "force"))  # fmt: skip
    assert ehsvjax.linearise(model, {"push": 2.0}).poles.real[-1] == pytest.approx(-0.25)
    with pytest.raises(ValueError, match="got none of x, as at"):
        ehsvjax.linearise(model)


def test_a_delay_of_an_input_is_no_state_space():
    bounds = {"transport_delay.delay": (0.0, 0.1)}
    model = ehsvjax.effects.attach(small_models.carriage(), bounds, 10.0, ehsvjax.effects.BANK)
    with pytest.raises(ValueError, match="linearise the model without that effect"):
        ehsvjax.linearise(model)


def test_what_does_not_answer_is_drawn_and_has_no_band():
    """In hydraulic lock, at the edge of the dead zone, no load moves the piston."""
    linear = ehsvjax.linearise(ehsvjax.servovalve(), {"command": 3e-3}, inputs=["load_force"], outputs=["position"])
    frequency = np.array([1.0, 100.0])
    assert not linear.response(frequency).any() and not linear.deviation(frequency).any()
    assert "does not answer" in linear.plot_bode().axes[0].get_title(loc="left")


def test_the_print_says_poles_and_what_lasts():
    text = str(ehsvjax.linearise(small_models.carriage(), {"push": 4.0}))
    assert "[[Poles]]" in text and f"{(STIFFNESS / MASS) ** 0.5:.6g}" in text
    assert "position  0.025" in text
