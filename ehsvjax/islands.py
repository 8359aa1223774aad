"""Islands: several populations that evolve apart, on as many devices as wanted, and now and then send on their best.

The islands stand in a ring. Every few generations each sends its elite to the next, where they take the place of the
last candidates (Cohoon, Hegde, Martin & Richards 1987). How the islands are shared out to devices, of one process or of
several under `jax.distributed`, changes nothing in the result.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int, Key

from ehsvjax import genetic, kernels
from ehsvjax.genetic import History, Operators, State

MIGRATION_INTERVAL = 5
"""Generations from one migration to the next."""


@kernels.jit(static_argnames=("islands", "population", "unknowns", "generations", "elites"))
def init(
    key: Key[Array, ""], islands: int, population: int, unknowns: int, generations: int, elites: int
) -> tuple[State, History]:
    """Return the state of every island before the first generation, `[island, ...]`, and one empty history for all."""
    states, histories = jax.vmap(lambda key: genetic.init(key, population, unknowns, generations, elites))(
        jax.random.split(key, islands)
    )
    return states, jax.tree.map(lambda leaf: leaf[0], histories)


@kernels.jit(static_argnames=("operators", "devices"))
def run(
    cost: Callable,
    operators: Operators,
    state: State,
    history: History,
    until: int | Int[Array, ""],
    tolerance: float | Float[Array, ""],
    generations: int | Int[Array, ""] | None = None,
    *,
    devices: tuple[jax.Device, ...],
) -> tuple[State, History]:
    """Run every island up to generation `until`, or until each has passed the stop test: one compiled call.

    Args:
        cost, operators, until, tolerance, generations: as for `genetic.run`.
        state: `[island, ...]`, from `init` or from an earlier call.
        history: of all islands together.
        devices: those that share the islands, as many for each.

    Raises:
        ValueError: if the number of islands is no multiple of the number of devices.

    """
    islands = len(state.generation)
    if islands % len(devices):
        raise ValueError(f"expected as many islands on each of {len(devices)} devices, got {islands} in all")
    most = len(history.best_cost) if generations is None else generations
    mesh, shared, alike = Mesh(np.array(devices), ("island",)), PartitionSpec("island"), PartitionSpec()
    state, history = jax.shard_map(
        functools.partial(_run_here, operators, len(devices)),
        mesh=mesh,
        in_specs=(alike, shared, alike, alike, alike, alike),
        out_specs=(shared, alike),
        check_vma=False,
    )(cost, state, history, jnp.asarray(until), jnp.asarray(tolerance), jnp.asarray(most))
    # Every process can then look at every island.
    return lax.with_sharding_constraint(state, NamedSharding(mesh, alike)), history


def merged(state: State, elites: int) -> State:
    """Return the islands as one population, its elite the best of all."""
    every, costs = state.elites.reshape(-1, state.elites.shape[-1]), state.elite_cost.reshape(-1)
    # Islands may share a migrant: it counts once.
    order = jnp.argsort(costs)
    repeated = jnp.concatenate([jnp.zeros(1, bool), jnp.all(every[order][1:] == every[order][:-1], axis=1)])
    best = order[jnp.argsort(repeated, stable=True)][:elites]
    return State(
        key=state.key[0],
        generation=state.generation[0],
        candidates=state.candidates.reshape(-1, every.shape[1]),
        elites=every[best],
        elite_cost=costs[best],
        population=state.population.reshape(-1, every.shape[1]),
        cost=state.cost.reshape(-1),
        converged=state.converged[0],
    )


def _run_here(
    operators: Operators, device_count: int, cost, state: State, history: History, until, tolerance, generations
):
    """Run the islands of one device; every device takes part in every generation."""

    def unfinished(both):
        state, _ = both
        return (state.generation[0] < jnp.minimum(until, generations)) & ~state.converged[0]

    def body(both):
        state, history = both
        k = state.generation[0]
        state = jax.vmap(lambda one: genetic.generation(cost, operators, one, generations, tolerance))(state)
        arriving = _from_the_previous(state.elites, device_count)
        settled = jnp.concatenate([state.candidates[:, : -operators.elites], arriving], axis=1)
        migration = (k + 1) % MIGRATION_INTERVAL == 0
        everywhere = lax.pmin(jnp.all(state.converged).astype(jnp.int32), "island") > 0
        state = state._replace(
            candidates=jnp.where(migration, settled, state.candidates),
            converged=jnp.full_like(state.converged, everywhere),
        )
        return state, _recorded(state, history, k % len(history.best_cost))

    return lax.while_loop(unfinished, body, (state, history))


def _from_the_previous(elites: Float[Array, "island elite parameter"], device_count: int):
    """Return for each island the elite of the one before it in the ring."""
    ring = [(i, (i + 1) % device_count) for i in range(device_count)]
    return jnp.concatenate([lax.ppermute(elites[-1:], "island", ring), elites[:-1]])


def _recorded(state: State, history: History, k: Int[Array, ""]) -> History:
    """Return the history with what all islands together have come to."""
    cost, best_cost, best = (
        lax.all_gather(leaf, "island", tiled=True) for leaf in (state.cost, state.elite_cost[:, 0], state.elites[:, 0])
    )
    spread = lax.pmax(jnp.max(jax.vmap(genetic.spread)(state.population, state.cost)), "island")
    winner = jnp.argmin(best_cost)
    return History(
        best_cost=history.best_cost.at[k].set(best_cost[winner]),
        median_cost=history.median_cost.at[k].set(genetic.median(cost.ravel())),
        failed=history.failed.at[k].set(jnp.mean(jnp.isinf(cost), dtype=cost.dtype)),
        spread=history.spread.at[k].set(spread),
        best=history.best.at[k].set(best[winner]),
    )
