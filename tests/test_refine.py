"""Refinement against SciPy's least squares, with SciPy's own simulation of the plant."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import least_squares

import ehsvjax
from ehsvjax.population import cast, to_values
from ehsvjax.refine import cost_gradient_information, gauss_newton_step, refine
from ehsvjax.unknowns import problem_of
from tests import plants

PERIOD, SAMPLES, VARIANCE = 0.05, 200, 0.04
TRUTH = (0.96, 1.23, 0.4, -0.3)


@functools.cache
def _record(spikes=False):
    command = np.repeat(np.random.default_rng(8).uniform(-2, 2, SAMPLES // 20), 20)
    position = plants.van_der_pol_plant(command, PERIOD, *TRUTH[:2], TRUTH[2:])[:, 0]
    position = position + np.random.default_rng(9).normal(0.0, VARIANCE**0.5, SAMPLES)
    if spikes:
        position[::13] += 4.0
    return ehsvjax.Record(np.arange(SAMPLES) * PERIOD, {"command": command}, {"position": position})


def _problem(spikes=False, huber=None, bounds=None):
    model = ehsvjax.van_der_pol().with_bounds(bounds)
    return problem_of(model, [_record(spikes)], noise_variance={"position": VARIANCE}, huber=huber)


def _refined(problem, starts, **options):
    with jax.enable_x64(True):
        result = refine(cast(problem, jnp.float64), jnp.asarray(starts, jnp.float64), **options)
        values = to_values(cast(problem, jnp.float64).coordinates, result.individual)
        return jax.tree.map(np.asarray, result), np.asarray(values)


def _scipy(record, **options):
    """Least cost as `population_cost` counts it, and where, by SciPy's optimiser over SciPy's simulation."""

    def residual(values):
        simulated = plants.van_der_pol_plant(record.inputs["command"], PERIOD, *values[:2], values[2:])
        return (record.outputs["position"] - simulated[:, 0]) / VARIANCE**0.5

    result = least_squares(residual, TRUTH, xtol=1e-10, ftol=1e-10, gtol=1e-10, **options)
    return 2.0 * result.cost, result.x


def test_minimum_is_that_of_scipy():
    problem = _problem()
    result, values = _refined(problem, [[0.3, 0.6, 0.5, 0.5], [0.7, 0.3, 0.4, 0.6]])
    cost, best = _scipy(_record())
    assert np.all(result.converged)
    np.testing.assert_allclose(result.cost, cost, atol=0.01)
    np.testing.assert_allclose(values, np.broadcast_to(best, (2, 4)), atol=2e-3)
    # What a further step would gain is told honestly.
    assert np.all(result.cost - cost <= result.remaining + 1e-3)


def test_minimum_within_bounds_is_that_of_scipy():
    bounds = {"alpha": (1.0, 1.4)}
    result, values = _refined(_problem(bounds=bounds), [[0.5, 0.5, 0.5, 0.5]])
    cost, best = _scipy_within((1.0, 1.4))
    assert result.converged[0]
    assert values[0, 0] == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(result.cost[0], cost, rtol=1e-5, atol=0.02)
    np.testing.assert_allclose(values[0, 1:], best[1:], atol=5e-3)


def _scipy_within(alpha):
    record = _record()

    def residual(values):
        simulated = plants.van_der_pol_plant(record.inputs["command"], PERIOD, *values[:2], values[2:])
        return (record.outputs["position"] - simulated[:, 0]) / VARIANCE**0.5

    lower, upper = [alpha[0], 0.615, -5.0, -5.0], [alpha[1], 1.845, 5.0, 5.0]
    result = least_squares(residual, [1.1, *TRUTH[1:]], bounds=(lower, upper), xtol=1e-10, ftol=1e-10, gtol=1e-10)
    return 2.0 * result.cost, result.x


def test_minimum_of_hubers_cost_is_that_of_scipy():
    huber = 1.345
    result, values = _refined(_problem(spikes=True, huber=huber), [[0.45, 0.55, 0.5, 0.5]])
    # SciPy's rho(z) of squared residuals over f_scale^2 is Huber's function over huber^2.
    cost, best = _scipy(_record(spikes=True), loss="huber", f_scale=huber)
    assert result.converged[0]
    np.testing.assert_allclose(result.cost[0], cost, rtol=1e-5, atol=0.02)
    np.testing.assert_allclose(values[0], best, atol=5e-3)


def test_gradient_and_information_are_those_of_finite_differences():
    problem = _problem(spikes=True, huber=1.345)
    with jax.enable_x64(True):
        problem = cast(problem, jnp.float64)
        point = jnp.array([0.45, 0.6, 0.5, 0.48])
        measure = jax.jit(functools.partial(cost_gradient_information, problem))
        (cost,), (gradient,), (information,), _ = measure(point[None])
        for i in range(4):
            step = 1e-6 * jnp.eye(4)[i]
            above, below = measure((point + step)[None])[0][0], measure((point - step)[None])[0][0]
            assert (above - below) / 2e-6 == pytest.approx(2.0 * float(gradient[i]), rel=1e-4, abs=1e-3)
    assert np.isfinite(cost)
    assert np.all(np.linalg.eigvalsh(information) > 0)


@pytest.mark.parametrize("optimizer", [optax.adam(0.02), optax.lbfgs()], ids=["adam", "lbfgs"])
def test_any_optax_optimizer_goes_downhill(optimizer):
    problem, start = _problem(), [[0.4, 0.6, 0.5, 0.5]]
    least, _ = _scipy(_record())
    before, _ = _refined(problem, start, iterations=1)
    after, _ = _refined(problem, start, optimizer=optimizer, iterations=40)
    assert after.cost[0] - least < 0.2 * (before.cost[0] - least)
    assert np.all((after.individual >= 0) & (after.individual <= 1))


def test_a_start_from_which_every_simulation_fails_is_never_converged():
    record = _record()
    output = np.array(record.outputs["position"])
    output[0] = 1e150  # overflows once divided by the noise and squared
    problem = problem_of(
        ehsvjax.van_der_pol(),
        [ehsvjax.Record(record.time, record.inputs, {"position": output})],
        noise_variance={"position": 1e-200},
    )
    result, _ = _refined(problem, [[0.5, 0.5, 0.5, 0.5]], iterations=5)
    assert not result.converged[0]
    assert np.isinf(result.cost[0])


def test_what_shows_in_rounding_alone_is_not_moved():
    """It would go from bound to bound at any damping: a refinement took its start for the minimum."""
    slopes = np.array([[3.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1e-17]])
    information, gradient = slopes.T @ slopes, slopes.T @ np.array([0.3, -0.2, 5.0])
    with jax.enable_x64(True):
        for damping in (0.0, 1e-4, 1e3):
            step = gauss_newton_step(jnp.full(3, 0.5), jnp.asarray(gradient), jnp.asarray(information), damping)
            rest = np.diag(information)[:2]
            expected = -np.linalg.solve(information[:2, :2] + damping * np.diag(rest), gradient[:2])
            np.testing.assert_allclose(step, [*expected, 0.0], rtol=1e-9, atol=0.0)
