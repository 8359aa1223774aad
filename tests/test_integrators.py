"""Integrators against closed forms and SciPy's matrix exponential."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from ehsvjax.integrators import SDIRK_GAMMA, repeated, runge_kutta_4, scan_samples, second_order_filter
from ehsvjax.models import identity

# --- Runge-Kutta ---


def linear(parameters, state, inputs, signal):
    return {"x": signal("rate", parameters["rate"] * state["x"] + inputs["u"])}


def test_one_runge_kutta_step_is_the_exponential_to_fourth_order():
    step = runge_kutta_4(linear)({"rate": -2.0}, 0.25, identity)
    z = -0.5
    expected = 3.0 * (1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24)
    with jax.enable_x64(True):
        assert step({"x": 3.0}, lambda fraction: {"u": 0.0})["x"] == pytest.approx(expected, rel=1e-14)


def test_runge_kutta_is_exact_for_a_cubic_input():
    step = runge_kutta_4(linear)({"rate": 0.0}, 2.0, identity)
    # The integral of (2 f)^3 over the step of 2 s, f from 0 to 1, is 2^4/4.
    assert step({"x": 1.0}, lambda fraction: {"u": (2.0 * fraction) ** 3})["x"] == pytest.approx(5.0, rel=1e-14)


def test_runge_kutta_has_order_4():
    def error(count):
        step = runge_kutta_4(linear)({"rate": -1.0}, 1.0 / count, identity)
        state = {"x": 1.0}
        for k in range(count):
            state = step(state, lambda fraction, k=k: {"u": math.sin((k + fraction) / count)})
        # x' = -x + sin t, x(0) = 1
        return abs(state["x"] - (1.5 * math.exp(-1.0) + 0.5 * (math.sin(1.0) - math.cos(1.0))))

    assert error(8) < 2e-6
    assert error(16) / error(32) == pytest.approx(16.0, rel=0.1)


def test_the_same_derivative_gives_the_same_stepper():
    assert runge_kutta_4(linear) is runge_kutta_4(linear)


# --- The exact second-order lag ---


def by_matrix_exponential(damping_ratio, omega, duration, y, rate, e, e_rate):
    """y'' + 2 xi w y' + w^2 y = w^2 e with e' constant, as one linear system of y, y', e, e'."""
    system = np.array(
        [[0, 1, 0, 0], [-(omega**2), -2 * damping_ratio * omega, omega**2, 0], [0, 0, 0, 1], [0, 0, 0, 0]]
    )
    return (scipy.linalg.expm(system * duration) @ [y, rate, e, e_rate])[:2]


@settings(max_examples=60, deadline=None)
@given(
    damping_ratio=st.one_of(st.sampled_from([0.0, 0.72, 1.0]), st.floats(0.0, 1.4)),
    angle=st.floats(1e-3, 3.0),
    state=st.tuples(*[st.floats(-1.0, 1.0)] * 4),
)
def test_the_second_order_lag_is_exact(damping_ratio, angle, state):
    omega = 300.0
    y, rate, e, e_rate = np.array(state) * [1.0, omega, 1.0, omega]
    with jax.enable_x64(True):
        transition = second_order_filter(jnp.asarray(damping_ratio), jnp.asarray(omega), angle / omega)
        found = transition(y, rate, e, e_rate)
    expected = by_matrix_exponential(damping_ratio, omega, angle / omega, y, rate, e, e_rate)
    np.testing.assert_allclose(np.array(found) / [1.0, omega], expected / [1.0, omega], rtol=0, atol=1e-11)


def test_the_second_order_lag_far_above_critical_damping():
    # The widest search: a tenfold damping ratio and natural frequency, over a quarter of a millisecond.
    with jax.enable_x64(True):
        found = second_order_filter(jnp.asarray(7.2), jnp.asarray(3000.0), 0.25e-3)(1.0, 500.0, -0.5, 200.0)
    expected = by_matrix_exponential(7.2, 3000.0, 0.25e-3, 1.0, 500.0, -0.5, 200.0)
    np.testing.assert_allclose(np.array(found) / [1.0, 3000.0], expected / [1.0, 3000.0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("damping_ratio", [0.5, 1.0, 2.0])
def test_two_halves_of_the_lag_make_a_whole(damping_ratio):
    with jax.enable_x64(True):
        half, whole = (second_order_filter(jnp.asarray(damping_ratio), 10.0, duration) for duration in (0.05, 0.1))
        y, rate = half(*half(1.0, -3.0, 0.2, 0.7), 0.2 + 0.05 * 0.7, 0.7)
        np.testing.assert_allclose([y, rate], whole(1.0, -3.0, 0.2, 0.7), rtol=1e-13)


@pytest.mark.parametrize("value", [3e-3, -1.7e-3, 0.0])
def test_a_steady_state_is_kept_exactly_in_single_precision(value):
    transition = second_order_filter(jnp.float32(0.72), jnp.float32(300.0), jnp.float32(0.25e-3))
    y, rate = transition(jnp.float32(value), jnp.float32(0.0), jnp.float32(value), jnp.float32(0.0))
    assert y.dtype == jnp.float32
    assert y == jnp.float32(value)
    assert rate == 0.0


@pytest.mark.parametrize("damping_ratio", [0.0, 0.72, 1.0, 1.3])
def test_the_lag_is_differentiable_through_critical_damping(damping_ratio):
    def end(damping_ratio, omega):
        return jnp.stack(second_order_filter(damping_ratio, omega, 0.2)(1.0, 0.5, 0.3, 0.1))

    with jax.enable_x64(True):
        found = np.stack(jax.jacfwd(end, argnums=(0, 1))(jnp.asarray(damping_ratio), jnp.asarray(5.0)))
    step = 1e-5
    expected = [
        by_matrix_exponential(damping_ratio + step * by_damping, 5.0 + step * by_omega, 0.2, 1.0, 0.5, 0.3, 0.1)
        - by_matrix_exponential(damping_ratio - step * by_damping, 5.0 - step * by_omega, 0.2, 1.0, 0.5, 0.3, 0.1)
        for by_damping, by_omega in ((1, 0), (0, 1))
    ]
    np.testing.assert_allclose(found, np.array(expected) / (2 * step), rtol=1e-7, atol=1e-8)


def test_the_stages_of_the_implicit_method_satisfy_its_order_conditions():
    # Tableau: c = (g, 1), A = ((g, 0), (1-g, g)), b = (1-g, g). Order 2: sum b c = 1/2; L-stable: R(inf) = 0.
    g = SDIRK_GAMMA
    tableau, weights, nodes = np.array([[g, 0.0], [1 - g, g]]), np.array([1 - g, g]), np.array([g, 1.0])
    np.testing.assert_allclose(tableau.sum(axis=1), nodes)
    assert weights @ nodes == pytest.approx(0.5, abs=1e-15)
    assert 1.0 - weights @ np.linalg.solve(tableau, np.ones(2)) == pytest.approx(0.0, abs=1e-14)


# --- The two combinators ---


def written_down(state, inputs):
    """A step that appends to the state the input at its beginning, as a digit."""
    return 10.0 * state + inputs(0.0)


def test_substeps_run_in_order_over_equal_parts_of_the_period():
    with jax.enable_x64(True):
        digits = repeated(written_down, 4)(jnp.asarray(0.0), lambda fraction: 8.0 * fraction)
        ends = repeated(lambda state, inputs: state + inputs(1.0), 4)(jnp.asarray(0.0), lambda fraction: 8.0 * fraction)
        assert digits == 246.0  # 0, 2, 4, 6
        assert ends == 2.0 + 4.0 + 6.0 + 8.0


def test_one_substep_is_the_step_itself():
    assert repeated(written_down, 1) is written_down


def test_samples_are_visited_before_the_step():
    def visit(carry, state, sample):
        return carry + sample, (state, sample)

    total, (frames, samples) = scan_samples(
        lambda state, inputs: state + inputs(0.5),
        jnp.asarray(7.0),
        visit,
        jnp.asarray(0.0),
        jnp.asarray([1.0, 2.0, 3.0, 4.0]),
        lambda sample: lambda fraction: 2.0 * fraction * sample,
    )
    np.testing.assert_array_equal(frames, [7.0, 8.0, 10.0, 13.0])
    np.testing.assert_array_equal(samples, [1.0, 2.0, 3.0, 4.0])
    assert total == 10.0
