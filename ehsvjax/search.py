"""The genetic search as a person runs it: in calls of half a second, or by generations with a bar or a checkpoint."""

import contextlib
import functools
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jaxtyping import Array, Float, Key

from ehsvjax import genetic
from ehsvjax import islands as archipelago
from ehsvjax.bars import progress_bar
from ehsvjax.checks import fits_memory, whole
from ehsvjax.fingerprint import fingerprint
from ehsvjax.genetic import History, Operators, State, check_operators
from ehsvjax.sealed import read_sealed, write_sealed

# Of one compiled call, s: an interrupt is heard between two.
_PATIENCE = 0.5
# Generations whose history is on the device, so that one program serves runs of any length; longer ones bring it home
# piece by piece.
_REMEMBERED = 1024
# What a generation holds of each individual at least: coordinates of candidates, population, parents and children.
_COPIES = 5


def search(
    cost: Callable,
    key: Key[Array, ""],
    *,
    unknowns: int,
    population: int,
    generations: int,
    operators: Operators,
    tolerance: float,
    first: Float[np.ndarray, " parameter"] | None = None,
    islands: int = 1,
    devices: Sequence[jax.Device] | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike | None = None,
) -> tuple[State, History]:
    """Run the genetic algorithm from a fresh population, or from a checkpoint that an earlier run left.

    Args:
        cost: `jax.tree_util.Partial` of a module-level function, `[individual, parameter] -> [individual]`.
        key: random key; the same key gives the same result, with or without bar and checkpoint.
        unknowns: coordinates of an individual.
        population: individuals, at least 4.
        generations: at most this many.
        operators: the operators.
        tolerance: of the stop test; 0 runs all generations.
        first: in the unit cube, an individual of the first population, of every island.
        islands: populations that evolve apart and exchange their best, each of `population` individuals.
        devices: those that share several islands; by default the first alone.
        progress: show a bar.
        checkpoint: file to write after every generation, and to go on from if it exists.

    Raises:
        ValueError: for sizes that cannot be, or a checkpoint of another search.
        OSError: if the checkpoint cannot be read or written.

    """
    check_sizes(population, generations, operators, islands, unknowns)
    key = jax.random.wrap_key_data(key) if jnp.issubdtype(key.dtype, jnp.unsignedinteger) else key
    if islands == 1:
        run: Callable = genetic.run
        state, recent = genetic.init(key, population, unknowns, _REMEMBERED, operators.elites)
    else:
        run = functools.partial(archipelago.run, devices=tuple(devices or jax.devices()[:1]))
        state, recent = archipelago.init(key, islands, population, unknowns, _REMEMBERED, operators.elites)
    if first is not None:
        state = state._replace(candidates=state.candidates.at[..., 0, :].set(jnp.asarray(first, jnp.float32)))
    state, history = _run(run, cost, operators, state, recent, generations, tolerance, progress, checkpoint)
    return (state if islands == 1 else archipelago.merged(state, operators.elites)), history


def costs_of(
    cost: Callable, individuals: Float[np.ndarray, "individual parameter"], population: int, operators: Operators
) -> Float[np.ndarray, " individual"]:
    """Return the costs of any number of individuals, by the program that `search` runs: it is compiled once for both.

    Each population of them is taken for a first generation, of which nothing else is kept; the last is filled up.

    Args:
        cost, population, operators: as for `search`, on one island.
        individuals: in the unit cube.

    """
    filled = np.concatenate([individuals, np.repeat(individuals[-1:], -len(individuals) % population, axis=0)])
    state, recent = genetic.init(jax.random.key(0), population, individuals.shape[1], _REMEMBERED, operators.elites)
    found = [
        genetic.run(cost, operators, state._replace(candidates=part), recent, 1, 0.0, 1)[0].cost
        for part in np.split(filled.astype(np.float32), len(filled) // population)
    ]
    return np.concatenate(found)[: len(individuals)]


def _run(
    run: Callable,
    cost: Callable,
    operators: Operators,
    state: State,
    recent: History,
    generations: int,
    tolerance: float,
    progress: bool,
    checkpoint: str | os.PathLike | None,
) -> tuple[State, History]:
    """Run to the end, in calls of some generations; with a bar or a checkpoint one by one.

    The history of the generations that were run is gathered here, so that its size is theirs.
    """
    mark, pieces, done = "", list[History](), 0
    if checkpoint is not None:
        mark = _fingerprint(cost, operators, state, generations, tolerance)
        if Path(checkpoint).exists():
            state, history = _restore(Path(checkpoint), mark, state)
            pieces, done = [history], _generation(state)
    watched = progress or checkpoint is not None
    # Processes that share a search have to make the same calls, whatever their clocks say.
    timed = not watched and jax.process_count() == 1
    stride = 1 if watched or timed else len(recent.best_cost)
    bar = _bar(generations, done) if progress else None
    with bar or contextlib.nullcontext():
        while done < generations and not np.ravel(state.converged)[0]:
            began, before = time.monotonic(), done
            until = min(done + stride, generations)
            state, recent = _at_home(run(cost, operators, state, recent, until, tolerance, generations))
            done = _generation(state)
            pieces.append(_since(recent, before, done))
            if checkpoint is not None:
                pieces = [_joined(pieces)]
                _store(Path(checkpoint), mark, (state, pieces[0]))
            if bar is not None:
                bar.set_postfix(cost=f"{float(pieces[-1].best_cost[-1]):.6g}", refresh=False)
                bar.update(done - before)
            if timed:
                rate = (done - before) / max(time.monotonic() - began, 1e-9)
                stride = min(max(int(_PATIENCE * rate), 1), len(recent.best_cost))
    return state, _joined(pieces)


def _generation(state: State) -> int:
    """Return how many generations were evaluated: every island has come to the same one."""
    return int(np.ravel(state.generation)[0])


def _since(recent: History, first: int, done: int) -> History:
    """Return the history from one generation up to another, of those that are remembered."""
    places = np.arange(first, done) % len(recent.best_cost)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[places], recent)


def _joined(pieces: Sequence[History]) -> History:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)


def _at_home(both: tuple[State, History]) -> tuple[State, History]:
    """Return arrays that are alike on every device, those of other processes included, on the usual one."""
    if all(leaf.sharding.is_fully_addressable and len(leaf.devices()) == 1 for leaf in jax.tree.leaves(both)):
        return both

    def local(leaf):
        return jnp.asarray(np.asarray(leaf if leaf.is_fully_addressable else process_allgather(leaf, tiled=True)))

    state, history = both
    raw, history = jax.tree.map(local, (_raw(state), history))
    return _with_key(raw, state.key), history


def _raw(state: State) -> State:
    """Return the state with its random key as plain numbers."""
    return state._replace(key=jax.random.key_data(state.key))


def _with_key(raw: State, like: Key[Array, "*island"]) -> State:
    """Return a state whose random key is plain numbers with the key made again."""
    return raw._replace(key=jax.random.wrap_key_data(raw.key, impl=jax.random.key_impl(like)))


def check_sizes(population: int, generations: int, operators: Operators, islands: int, unknowns: int) -> None:
    """Refuse sizes of a search that cannot be; arguments as for `search`.

    Raises:
        ValueError: if one is no whole number or too small, for operators that are none, and if the machine's memory
            could not hold what would be in it at once.

    """
    whole("population", population, 4)
    whole("generations", generations, 1)
    whole("islands", islands, 1)
    check_operators(operators, population)
    number, together = np.dtype(np.float32).itemsize, int(population) * int(islands)
    sizes = f"population={population} on islands={islands} for {unknowns} unknowns"
    fits_memory("a search", sizes, number * together * unknowns * _COPIES)
    remembered = number * int(generations) * (len(History._fields) - 1 + unknowns)
    fits_memory("a search", f"generations={generations} for {unknowns} unknowns", remembered)
    if generations > np.iinfo(np.int32).max:
        raise ValueError(f"expected at most {np.iinfo(np.int32).max} generations, got {generations}")


def _bar(generations: int, done: int):
    return progress_bar(total=generations, initial=done, desc="generations", unit="gen")


def _fingerprint(cost: Callable, operators: Operators, state: State, generations: int, tolerance: float) -> str:
    """Return a digest of all that a search depends on, the same in every process: of what a generation computes."""

    def one_generation(cost, state, generations, tolerance):
        one = jax.tree.map(lambda leaf: leaf[0], state) if state.generation.ndim else state
        return genetic.generation(cost, operators, one, generations, tolerance)

    return fingerprint(one_generation, cost, state, int(generations), float(tolerance))


def _store(path: Path, mark: str, both: tuple[State, History]) -> None:
    """Write what has been done so far: a kill at any moment leaves a whole file, the old one or the new."""
    state, history = both
    arrays = {f"state/{name}": np.asarray(leaf) for name, leaf in _raw(state)._asdict().items()}
    arrays |= {f"history/{name}": leaf for name, leaf in history._asdict().items()}
    write_sealed(path, "checkpoint", {"fingerprint": mark}, arrays, compressed=False)


def _restore(path: Path, mark: str, fresh: State) -> tuple[State, History]:
    """Return what the checkpoint holds."""
    sealed = read_sealed(path, "checkpoint", "a checkpoint of a search", "remove it or name a new one")
    if sealed.facts["fingerprint"] != mark:
        raise ValueError(
            f"expected {path} to be the checkpoint of this search, got one of another (other data, model, key, sizes, "
            "operators or devices, or another version of ehsvjax or JAX): remove it or name a new one"
        )
    raw: dict[str, Any] = {name: jnp.asarray(sealed.arrays[f"state/{name}"]) for name in State._fields}
    history: dict[str, Any] = {name: sealed.arrays[f"history/{name}"] for name in History._fields}
    return _with_key(State(**raw), fresh.key), History(**history)
