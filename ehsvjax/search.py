"""The genetic search as a person runs it: one compiled call, or generation by generation with a bar or a checkpoint."""

import functools
import hashlib
import os
import re
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jaxtyping import Array, Key

from ehsvjax import genetic
from ehsvjax import islands as archipelago
from ehsvjax.genetic import History, Operators, State


def search(
    cost: Callable,
    key: Key[Array, ""],
    *,
    unknowns: int,
    population: int,
    generations: int,
    operators: Operators,
    tolerance: float,
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
        islands: populations that evolve apart and exchange their best, each of `population` individuals.
        devices: those that share several islands; by default the first alone.
        progress: show a bar.
        checkpoint: file to write after every generation, and to go on from if it exists.

    Raises:
        ValueError: for sizes that cannot be, or a checkpoint of another search.

    """
    _check_sizes(population, generations, operators, islands)
    key = jax.random.wrap_key_data(key) if jnp.issubdtype(key.dtype, jnp.unsignedinteger) else key
    if islands == 1:
        state, history = genetic.init(key, population, unknowns, generations, operators.elites)
        return _run(genetic.run, cost, operators, state, history, tolerance, progress, checkpoint)
    state, history = archipelago.init(key, islands, population, unknowns, generations, operators.elites)
    run = functools.partial(archipelago.run, devices=tuple(devices or jax.devices()[:1]))
    state, history = _run(run, cost, operators, state, history, tolerance, progress, checkpoint)
    return archipelago.merged(state, operators.elites), history


def _run(
    run: Callable,
    cost: Callable,
    operators: Operators,
    state: State,
    history: History,
    tolerance: float,
    progress: bool,
    checkpoint: str | os.PathLike | None,
) -> tuple[State, History]:
    """Run to the end in one call, or generation by generation."""
    generations = len(history.best_cost)
    if checkpoint is None and not progress:
        return _at_home(run(cost, operators, state, history, generations, tolerance))

    mark = ""
    if checkpoint is not None:
        mark = _fingerprint(cost, operators, state, generations, tolerance)
        state, history = _restore(Path(checkpoint), mark, (state, history))
    # Every island has come to the same generation, and they stop together.
    done = int(np.ravel(state.generation)[0])
    with _bar(progress, generations, done) as bar:
        while done < generations and not np.ravel(state.converged)[0]:
            done += 1
            state, history = _at_home(run(cost, operators, state, history, done, tolerance))
            if checkpoint is not None:
                _store(Path(checkpoint), mark, (state, history))
            bar.set_postfix(cost=f"{float(history.best_cost[done - 1]):.6g}", refresh=False)
            bar.update()
    return state, history


def _at_home(both: tuple[State, History]) -> tuple[State, History]:
    """Return arrays that are alike on every device, those of other processes included, on the usual one."""
    if all(leaf.sharding.is_fully_addressable and len(leaf.devices()) == 1 for leaf in jax.tree.leaves(both)):
        return both

    def local(leaf):
        return jnp.asarray(np.asarray(leaf if leaf.is_fully_addressable else process_allgather(leaf, tiled=True)))

    return _with_key(jax.tree.map(local, _raw(both)), both[0].key)


def _with_key(raw: tuple[State, History], like: Key[Array, "*island"]) -> tuple[State, History]:
    """Return a state whose random key is plain numbers with the key made again."""
    state, history = raw
    return state._replace(key=jax.random.wrap_key_data(state.key, impl=jax.random.key_impl(like))), history


def _check_sizes(population: int, generations: int, operators: Operators, islands: int) -> None:
    sizes = (("population", population, 4), ("generations", generations, 1), ("islands", islands, 1))
    for name, value, least in sizes:
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
            raise ValueError(f"expected {name} to be a whole number of at least {least}, got {value!r}")
    if not 1 <= operators.elites < population:
        raise ValueError(f"expected 1 to {population - 1} elites (fewer than the population), got {operators.elites}")
    if not 0 <= operators.immigrants < 1:
        raise ValueError(f"expected immigrants to be a share of the population from 0 to 1, got {operators.immigrants}")


def _bar(shown: bool, generations: int, done: int):
    from tqdm.auto import tqdm

    return tqdm(total=generations, initial=done, desc="generations", unit="gen", disable=not shown)


def _fingerprint(cost: Callable, operators: Operators, state: State, generations: int, tolerance: float) -> str:
    """Return a digest of all that a search depends on, the same in every process."""
    digest = hashlib.sha256()
    leaves, structure = jax.tree.flatten((cost, _raw(state)))
    for leaf in leaves:
        array = np.asarray(leaf)
        digest.update(f"{array.shape}{array.dtype}".encode() + array.tobytes())
    digest.update(repr((_describe(operators), generations, tolerance, _no_addresses(str(structure)))).encode())
    return digest.hexdigest()


def _describe(value) -> str:
    """Return what a setting says, for functions their name and what they close over instead of their address."""
    if isinstance(value, tuple):
        return repr([_describe(v) for v in value])
    if callable(value):
        cells = [_describe(cell.cell_contents) for cell in getattr(value, "__closure__", None) or ()]
        return f"{value.__module__}.{value.__qualname__}{cells}"
    return repr(value)


def _no_addresses(text: str) -> str:
    return re.sub(r" at 0x[0-9a-f]+", "", text)


def _raw(tree):
    """Return the tree with random keys as plain numbers."""

    def plain(leaf):
        return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf

    return jax.tree.map(plain, tree)


def _store(path: Path, mark: str, both: tuple[State, History]) -> None:
    """Write beside the file and rename: a kill at any moment leaves a whole file, the old one or the new."""
    beside = path.with_name(path.name + ".writing")
    leaves = jax.tree.leaves(_raw(both))
    with open(beside, "wb") as file:
        arrays: dict[str, Any] = {f"leaf_{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
        np.savez(file, fingerprint=np.array(mark), **arrays)
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, path)


def _restore(path: Path, mark: str, fresh: tuple[State, History]) -> tuple[State, History]:
    """Return what the checkpoint holds, or the fresh start where there is none."""
    if not path.exists():
        return fresh
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = str(file["fingerprint"])
            leaves = [jnp.asarray(file[f"leaf_{i}"]) for i in range(len(file.files) - 1)]
    except (KeyError, ValueError, OSError, zipfile.BadZipFile) as error:
        raise ValueError(f"expected a checkpoint of a search at {path}, got another file: name a new one") from error
    if stored != mark:
        raise ValueError(
            f"expected {path} to be the checkpoint of this search, got one of another (other data, model, key, "
            "sizes or operators): remove it or name a new one"
        )
    return _with_key(jax.tree.unflatten(jax.tree.structure(_raw(fresh)), leaves), fresh[0].key)
