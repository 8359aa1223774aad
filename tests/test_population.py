"""Cost of a population against the simulation of each individual by itself, and what must not matter."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ehsvjax
from ehsvjax.population import Coordinates, cast, population_cost, to_unit, to_values
from ehsvjax.refine import refine
from ehsvjax.unknowns import guess_noise_variance, problem_of


def _derivative(parameters, state, inputs, signal):
    # Blows up in finite time where growth*x(0) > 1/duration.
    return {"x": parameters["growth"] * state["x"] ** 2 + signal("push", inputs["push"])}


def _explosive():
    return ehsvjax.Model(
        name="explosive",
        parameters=(ehsvjax.Parameter("growth", "g", "1/s", 0.1, -5.0, 5.0),),
        initial=(ehsvjax.Parameter("start", "x0", "", 1.0, 0.5, 1.5),),
        signals=(ehsvjax.Signal("push", "input", "1/s"), ehsvjax.Signal("level", "sensor", "")),
        start=_start,
        stepper=ehsvjax.runge_kutta_4(_derivative),
        measure=_measure,
        max_step=0.05,
    )


def _start(parameters, initial, inputs):
    return {"x": initial["start"]}


def _measure(parameters, state, inputs, signal):
    return {"level": signal("level", state["x"])}


TIME = np.arange(60) * 0.05
RECORD = ehsvjax.Record(TIME, {"push": np.sin(TIME)}, {"level": 1.0 + 0.1 * np.cos(3 * TIME)})
INDIVIDUALS = np.array([[0.5, 0.5], [0.2, 0.1], [0.99, 0.9], [0.45, 0.7]])


def _problem(*records, **options):
    return problem_of(_explosive(), records or [RECORD], noise_variance={"level": 0.01}, **options)


def _cost(problem, individuals=INDIVIDUALS, dtype=jnp.float32):
    return np.asarray(population_cost(cast(problem, dtype), jnp.asarray(individuals, dtype)))


def _by_hand(record, individual, huber=None):
    growth, start = -5.0 + 10.0 * individual[0], 0.5 + individual[1]
    simulated = ehsvjax.simulate(_explosive(), record, {"growth": growth}, {"start": start})["level"]
    size = np.abs((record.outputs["level"] - simulated) / 0.1)
    size = size[np.isfinite(record.outputs["level"])]
    return np.sum(size**2 if huber is None else np.where(size > huber, 2 * huber * size - huber**2, size**2))


@pytest.mark.parametrize("huber", [None, 1.345])
def test_cost_is_the_sum_over_each_simulation(huber):
    costs = _cost(_problem(huber=huber))
    assert costs[2] == np.inf
    for i in (0, 1, 3):
        assert costs[i] == pytest.approx(_by_hand(RECORD, INDIVIDUALS[i], huber), rel=1e-4)


def test_one_that_blows_up_does_not_spoil_the_others():
    tame = INDIVIDUALS.copy()
    tame[2] = tame[0]
    np.testing.assert_array_equal(_cost(_problem())[[0, 1, 3]], _cost(_problem(), tame)[[0, 1, 3]])


def test_order_of_individuals_does_not_matter():
    order = [2, 0, 3, 1]
    np.testing.assert_array_equal(_cost(_problem())[order], _cost(_problem(), INDIVIDUALS[order]))


@pytest.mark.parametrize("huber", [None, 1.345])
@pytest.mark.parametrize("count", [1, 3, 40])
def test_gradient_is_that_of_finite_differences(count, huber):
    individuals = np.random.default_rng(count).uniform(0.2, 0.5, (count, 3))
    with jax.enable_x64(True):
        problem = cast(_problem(RECORD, RECORD.slice(0.0, 1.5), huber=huber), jnp.float64)
        gradient = jax.jit(jax.grad(lambda rows: jnp.sum(population_cost(problem, rows))))(jnp.asarray(individuals))
        for i in range(3):
            step = 1e-6 * np.eye(3)[i]
            above, below = (_cost(problem, individuals + sign * step, jnp.float64) for sign in (1, -1))
            np.testing.assert_allclose(gradient[:, i], (above - below) / 2e-6, rtol=1e-5, atol=1e-4)


def test_cost_is_not_differentiated_by_its_data():
    problem = cast(_problem(), jnp.float32)
    individuals = jnp.asarray(INDIVIDUALS[:1], jnp.float32)

    def by_variance(variance):
        return population_cost(dataclasses.replace(problem, noise_variance=variance), individuals)[0]

    with pytest.raises(jax.errors.UnexpectedTracerError):
        jax.grad(by_variance)(problem.noise_variance)


def test_missing_samples_and_padding_weigh_nothing():
    gappy = np.array(RECORD.outputs["level"])
    gappy[20:30] = np.nan
    gappy = dataclasses.replace(RECORD, outputs={"level": gappy})
    assert _cost(_problem(gappy))[0] == pytest.approx(_by_hand(gappy, INDIVIDUALS[0]), rel=1e-4)
    short = RECORD.slice(0.0, 1.5)
    both = _cost(_problem(RECORD, short), np.column_stack([INDIVIDUALS, INDIVIDUALS[:, 1]]))
    expected = _by_hand(RECORD, INDIVIDUALS[0]) + _by_hand(short, INDIVIDUALS[0])
    assert both[0] == pytest.approx(expected, rel=1e-4)


@settings(max_examples=50, deadline=None)
@given(
    st.floats(-1e3, 1e3),
    st.floats(1e-3, 1e3),
    st.floats(1e-6, 1e3),
    st.floats(1.01, 1e4),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_unit_cube_and_values_are_inverse(lower, width, positive, ratio, first, second):
    # The last is a share by which something is off: from 0 to a share, by the logarithm of one and it.
    coordinates = Coordinates(
        np.array([lower, positive, 0.0]),
        np.array([lower + width, positive * ratio, ratio - 1.0]),
        np.array([False, True, True]),
        np.array([0.0, 0.0, 1.0]),
    )
    with jax.enable_x64(True):
        values = np.asarray(to_values(coordinates, jnp.array([first, second, second])))
        assert values[0] == pytest.approx(lower + first * width, rel=1e-9, abs=1e-9)
        assert values[1] == pytest.approx(positive * ratio**second, rel=1e-9)
        assert values[2] == pytest.approx(ratio**second - 1.0, rel=1e-9, abs=1e-12)
        np.testing.assert_allclose(to_unit(coordinates, jnp.asarray(values)), [first, second, second], atol=1e-6)


@pytest.mark.parametrize("optimizer", [None, optax.lbfgs(), optax.adam(0.02)], ids=["lm", "lbfgs", "adam"])
def test_any_optax_optimizer_refines(optimizer):
    with jax.enable_x64(True):
        problem = cast(_problem(), jnp.float64)
        start = jnp.array([[0.5, 0.5]])
        refined = refine(problem, start, optimizer=optimizer, iterations=200)
        best = refine(problem, jnp.array([[0.48, 0.55]]), iterations=200)
        assert bool(best.converged[0])
        assert refined.cost[0] < population_cost(problem, start)[0]
        assert float(refined.cost[0]) == pytest.approx(float(best.cost[0]), rel=2e-2 if optimizer else 1e-4)


def test_refinement_that_starts_in_a_failed_simulation_says_so():
    with jax.enable_x64(True):
        refined = refine(cast(_problem(), jnp.float64), jnp.array([[0.99, 0.9]]), iterations=5)
        assert not bool(refined.converged[0])
        assert refined.cost[0] == np.inf


def test_noise_is_guessed_in_spite_of_steps_and_spikes():
    rng = np.random.default_rng(0)
    time = np.arange(4000) * 1e-3
    signal = np.sin(2 * np.pi * time) + (time > 1.5) + rng.normal(0, 0.01, 4000)
    signal[::100] += 5.0
    # 5 % is three standard deviations of a robust estimate from 4,000 samples.
    assert guess_noise_variance(signal) == pytest.approx(1e-4, rel=0.15)
    assert 0.0 < guess_noise_variance(time) < 1e-10


def test_bound_of_a_linear_model_is_that_of_least_squares():
    # With no growth the level is x0 + the integral of the push, and d level/d growth = integral of level^2.
    bound = ehsvjax.cramer_rao_bound(
        _explosive(), RECORD, noise_variance={"level": 0.01}, parameters={"growth": 0.0}, initial_values={"start": 1.0}
    )
    level = ehsvjax.simulate(_explosive(), RECORD, {"growth": 0.0}, {"start": 1.0})["level"]
    held = np.concatenate([[0.0], np.cumsum(np.sin(TIME[:-1])) * 0.05]) + 1.0
    np.testing.assert_allclose(level, held, atol=1e-12)
    # Exact integral of the square of a polygon through the held levels.
    square = np.concatenate([[0.0], np.cumsum(0.05 / 3 * (held[1:] ** 2 + held[1:] * held[:-1] + held[:-1] ** 2))])
    covariance = 0.01 * np.linalg.inv(np.array([[square @ square, square.sum()], [square.sum(), len(TIME)]]))
    assert bound["growth"] == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-6)


def test_what_the_position_cannot_fix_has_no_bound():
    model = ehsvjax.servovalve(transfer_function="forward")
    time = np.arange(400) * 1e-3
    record = ehsvjax.Record(time, {"command": 0.05 * np.sin(20 * time)}, {"position": np.sin(time)})
    bound = ehsvjax.cramer_rao_bound(model, record, noise_variance={"position": 1e-8})
    tied = {"dead_zone", "saturation", "flow_gain", "feedback_gain"}
    assert {name for name, deviation in bound.items() if np.isinf(deviation)} == tied
