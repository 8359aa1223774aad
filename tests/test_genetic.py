"""The genetic algorithm on costs with a known minimum: elite, failures, stop test, pieces of a run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from ehsvjax import operators
from ehsvjax.genetic import Operators, best_distinct, init, run

GENERATIONS, POPULATION, UNKNOWNS = 20, 24, 3


def _sphere(centre, individuals):
    return jnp.sum((individuals - centre[None, :]) ** 2, axis=1)


def _mostly_failing(centre, individuals):
    cost = _sphere(centre, individuals)
    return jnp.where(individuals[:, 0] > 0.4, jnp.nan, cost)


CENTRE = jnp.array([0.3, 0.6, 0.45])


def _run(cost=_sphere, chosen=Operators(), tolerance=0.0, pieces=(GENERATIONS,), key=0):  # noqa: B008
    state, history = init(jax.random.key(key), POPULATION, UNKNOWNS, GENERATIONS, chosen.elites)
    for until in pieces:
        state, history = run(Partial(cost, CENTRE), chosen, state, history, until, tolerance)
    return state, history


def test_first_candidates_are_a_latin_hypercube():
    state, _ = init(jax.random.key(3), POPULATION, UNKNOWNS, GENERATIONS, 2)
    slices = np.floor(np.asarray(state.candidates) * POPULATION)
    for column in slices.T:
        assert sorted(column) == list(range(POPULATION))


def test_minimum_is_found_and_the_elite_is_never_lost():
    state, history = _run()
    np.testing.assert_allclose(state.elites[0], CENTRE, atol=0.02)
    assert np.all(np.diff(history.best_cost) <= 0)
    assert state.elite_cost[0] == history.best_cost[-1]
    for elite in np.asarray(state.elites):
        assert np.any(np.all(np.asarray(state.population) == elite, axis=1))


def test_a_run_in_pieces_is_the_run_in_one_go():
    whole, in_pieces = _run(), _run(pieces=(1, 7, 8, GENERATIONS))
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(in_pieces), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


def test_failed_simulations_never_win():
    state, history = _run(_mostly_failing)
    assert np.isfinite(state.elite_cost).all()
    assert np.all(np.asarray(state.elites)[:, 0] <= 0.4)
    assert history.failed[0] == pytest.approx(0.6, abs=0.05)
    assert history.failed[-1] < 0.3


def test_a_population_that_failed_altogether_recovers():
    def narrow(centre, individuals):
        return jnp.where(jnp.abs(individuals[:, 0] - 0.95) < 0.05, _sphere(centre, individuals), jnp.nan)

    chosen = Operators(immigrants=0.5)
    state, history = init(jax.random.key(0), POPULATION, UNKNOWNS, GENERATIONS, chosen.elites)
    state = state._replace(candidates=jnp.full_like(state.candidates, 0.5))
    # 12 immigrants in 19 generations, of which one in ten succeeds: all fail once in 1e10 runs.
    state, history = run(Partial(narrow, CENTRE), chosen, state, history, GENERATIONS, 0.0)
    assert history.best_cost[0] == np.inf
    assert history.failed[0] == 1.0
    assert np.isfinite(state.elite_cost[0])
    assert abs(state.elites[0, 0] - 0.95) < 0.05


def test_stop_test_ends_the_run():
    state, history = _run(tolerance=1e-2)
    done = int(state.generation)
    assert bool(state.converged)
    assert done < GENERATIONS
    assert np.isfinite(history.best_cost[:done]).all()
    assert np.isnan(history.best_cost[done:]).all()


@pytest.mark.parametrize(
    "chosen",
    [
        Operators(selection=operators.rank_selection()),
        Operators(selection=operators.roulette_selection()),
        Operators(crossover=operators.blend_crossover()),
        Operators(crossover=operators.line_crossover()),
        Operators(crossover=operators.simulated_binary_crossover()),
        Operators(mutation=operators.polynomial_mutation()),
    ],
    ids=["rank", "roulette", "blend", "line", "binary", "polynomial"],
)
def test_every_operator_beats_random_search(chosen):
    state, history = _run(chosen=chosen)
    assert np.all((state.candidates >= 0) & (state.candidates <= 1))
    assert np.all(np.diff(history.best_cost) <= 0)
    assert np.min(state.cost) == state.elite_cost[0]
    random = np.random.default_rng(0).random((POPULATION * GENERATIONS, UNKNOWNS))
    assert history.best_cost[-1] < np.min(_sphere(CENTRE, random))


def test_best_few_lie_apart():
    population = np.array([[0.5, 0.5], [0.501, 0.5], [0.9, 0.1], [0.1, 0.1]])
    cost = np.array([1.0, 0.5, 2.0, np.inf])
    assert best_distinct(population, cost, 2, distance=0.02) == [1, 2]
    assert best_distinct(population, cost, 4, distance=0.02) == [1, 2, 3, 0]
