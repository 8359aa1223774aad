"""The genetic algorithm of the paper's section 3.1: state, `init`, `generation`, and `run`, one compiled call.

It searches the unit cube; what the coordinates and the cost mean is not known here.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ehsvjax import draws, kernels
from ehsvjax.checks import function, number, whole
from ehsvjax.operators import (
    Crossover,
    Mutation,
    Selection,
    differential_crossover,
    elitism,
    finite_or_inf,
    gaussian_mutation,
    immigrants,
    tournament_selection,
)


class Operators(NamedTuple):
    """The genetic operators and their shares of a generation; static, a part of what is compiled.

    Attributes:
        selection, crossover, mutation: functions made by `ehsvjax.operators`, or your own of the same form.
        elites: how many of the best so far are never lost.
        immigrants: share of each generation that is new random individuals.

    """

    selection: Selection = tournament_selection(5)
    crossover: Crossover = differential_crossover(0.55)
    mutation: Mutation = gaussian_mutation(0.05)
    elites: int = 2
    immigrants: float = 0.02


def check_operators(operators: Operators, population: int) -> None:
    """Refuse operators that cannot make a generation.

    Raises:
        ValueError: for what is no function or has no hash, and if elite or immigrants would fill the population.

    """
    for name in ("selection", "crossover", "mutation"):
        function(name, getattr(operators, name), f"such as one of ehsvjax.operators for {name}")
    whole("elites", operators.elites, 1, population - 1, "take fewer than the population")
    number("immigrants", operators.immigrants, "a share of the population from 0 to below 1", lambda x: 0.0 <= x < 1.0)


class State(NamedTuple):
    """What the next generation needs.

    Attributes:
        key: random key of the next generation.
        generation: how many have been evaluated.
        candidates: individuals that the next generation will evaluate.
        elites, elite_cost: the best so far, best first.
        population, cost: the last generation as evaluated, elites included.
        converged: whether the stop test has been passed.

    """

    key: Key[Array, ""]
    generation: Int[Array, ""]
    candidates: Float[Array, "individual parameter"]
    elites: Float[Array, "elite parameter"]
    elite_cost: Float[Array, " elite"]
    population: Float[Array, "individual parameter"]
    cost: Float[Array, " individual"]
    converged: Bool[Array, ""]


class History(NamedTuple):
    """What a person wants to see of each generation; NaN for those not reached.

    On the device it may be shorter than the run: generation k stands at k modulo its length.

    Attributes:
        best_cost: of the best so far.
        median_cost: of the generation, failed simulations counted as +inf.
        failed: share of the generation whose simulation failed.
        spread: the largest standard deviation over the unknowns, in the unit cube, of the generation's better half.
        best: the best so far, in the unit cube.

    """

    best_cost: Float[Array, " generation"]
    median_cost: Float[Array, " generation"]
    failed: Float[Array, " generation"]
    spread: Float[Array, " generation"]
    best: Float[Array, "generation parameter"]


@kernels.jit(static_argnames=("population", "unknowns", "generations", "elites", "dtype"))
def init(
    key: Key[Array, ""], population: int, unknowns: int, generations: int, elites: int, dtype=jnp.float32
) -> tuple[State, History]:
    """Return the state before the first generation, a Latin hypercube of candidates, and an empty history.

    A Latin hypercube puts one individual into each of `population` equal slices of every unknown's interval, so that a
    small population leaves no part of any interval unvisited (McKay, Beckman & Conover 1979).
    """
    key, place_key = draws.split(key, 2)
    shuffle, within = draws.uniform(place_key, (2, population, unknowns), dtype)
    slices = jnp.argsort(shuffle, axis=0).astype(dtype)
    state = State(
        key=key,
        generation=jnp.int32(0),
        candidates=(slices + within) / population,
        elites=jnp.full((elites, unknowns), 0.5, dtype),
        elite_cost=jnp.full(elites, jnp.inf, dtype),
        population=jnp.full((population, unknowns), 0.5, dtype),
        cost=jnp.full(population, jnp.inf, dtype),
        converged=jnp.bool_(False),
    )
    empty = jnp.full(generations, jnp.nan, dtype)
    return state, History(empty, empty, empty, empty, jnp.full((generations, unknowns), jnp.nan, dtype))


def generation(
    cost: Callable, operators: Operators, state: State, generations: int | Int[Array, ""], tolerance
) -> State:
    """Evaluate the candidates, keep the elite, apply the stop test, and breed the next candidates.

    Args:
        cost: `[individual, parameter] -> [individual]`, lower is better, NaN and +inf never win.
        operators: the operators.
        state: before this generation.
        generations: how many there will be at most, for mutations that grow finer.
        tolerance: stop when the lower quartile of the costs lies within this of the best; 0 never stops.

    """
    key, elitism_key, selection_key, crossover_key, mutation_key, immigrant_key = draws.split(state.key, 6)
    count = len(state.candidates)

    population, costs = state.candidates, finite_or_inf(cost(state.candidates))
    ever, ever_cost = jnp.concatenate([state.elites, population]), jnp.concatenate([state.elite_cost, costs])
    best = jnp.argsort(ever_cost)[: operators.elites]
    elites, elite_cost = ever[best], ever_cost[best]
    population, costs = elitism(elitism_key, population, costs, elites, elite_cost)

    parents = population[operators.selection(selection_key, costs, 2 * count)]
    children = operators.crossover(crossover_key, parents[:count], parents[count:])
    children = operators.mutation(mutation_key, children, (state.generation + 1) / generations)
    candidates = immigrants(immigrant_key, children, round(operators.immigrants * count))

    return State(
        key=key,
        generation=state.generation + 1,
        candidates=candidates,
        elites=elites,
        elite_cost=elite_cost,
        population=population,
        cost=costs,
        converged=jnp.sort(costs)[math.ceil(0.25 * (count - 1))] - elite_cost[0] < tolerance,
    )


@kernels.jit(static_argnames=("operators",))
def run(
    cost: Callable,
    operators: Operators,
    state: State,
    history: History,
    until: int | Int[Array, ""],
    tolerance: float | Float[Array, ""],
    generations: int | Int[Array, ""] | None = None,
) -> tuple[State, History]:
    """Run up to generation `until`, or until the stop test is passed: one compiled call, simulation included.

    A run that is stopped at some generation and called again goes on to the same result, bit for bit.

    Args:
        cost: as `generation` takes it, as a `jax.tree_util.Partial` of a module-level function, whose data may change
            without compiling again.
        operators: the operators, static.
        state: from `init`, or from an earlier call.
        history: likewise; of a shorter one than the run the last generations stay.
        until: the generation to stop at, at most the number of generations.
        tolerance: of the stop test, see `generation`.
        generations: how many there will be at most; by default the history's length.

    """
    length = len(history.best_cost)
    generations = length if generations is None else generations

    def unfinished(both):
        state, _ = both
        return (state.generation < jnp.minimum(until, generations)) & ~state.converged

    def body(both):
        state, history = both
        k = state.generation % length
        state = generation(cost, operators, state, generations, tolerance)
        return state, History(
            best_cost=history.best_cost.at[k].set(state.elite_cost[0]),
            median_cost=history.median_cost.at[k].set(median(state.cost)),
            failed=history.failed.at[k].set(jnp.mean(jnp.isinf(state.cost), dtype=state.cost.dtype)),
            spread=history.spread.at[k].set(spread(state.population, state.cost)),
            best=history.best.at[k].set(state.elites[0]),
        )

    return lax.while_loop(unfinished, body, (state, history))


def best_distinct(
    population: Float[np.ndarray, "individual parameter"],
    cost: Float[np.ndarray, " individual"],
    count: int,
    distance: float,
) -> list[int]:
    """Return the indices of the best few that lie apart: each the best of those beyond `distance` from the others.

    Distance is the largest difference over the unknowns. Where fewer lie apart, the best of the rest follow.
    """
    order = [int(i) for i in np.argsort(cost, kind="stable")]
    apart: list[int] = []
    for i in order:
        if all(np.max(np.abs(population[i] - population[j])) > distance for j in apart):
            apart.append(i)
    return (apart + [i for i in order if i not in apart])[:count]


def median(cost: Float[Array, " individual"]) -> Float[Array, ""]:
    """Return the median; unlike `jnp.median` it looks for no NaN, which takes as long to compile again."""
    ordered, count = jnp.sort(cost), len(cost)
    return 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])


def spread(population: Float[Array, "individual parameter"], cost: Float[Array, " individual"]) -> Float[Array, ""]:
    """Return the largest standard deviation over the unknowns of the better half; +inf for one individual alone."""
    half = len(cost) // 2
    if half < 2:
        return jnp.asarray(jnp.inf, cost.dtype)
    better = population[jnp.argsort(cost)[:half]]
    return jnp.max(jnp.std(better, axis=0))
