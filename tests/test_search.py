"""A search as a person runs it: gone on with, watched by several, interrupted, and of sizes that cannot be."""

import importlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import ehsvjax
from ehsvjax import checks, search
from ehsvjax.genetic import Operators
from tests.compilations import compilations

ROOT = Path(__file__).parents[1]
CENTRE = jnp.array([0.3, 0.7])


def _sphere(centre, individuals):
    return jnp.sum((individuals - centre[None, :]) ** 2, axis=1)


def _bowl(centre, individuals):
    return jnp.sum((individuals - centre[None, :]) ** 4, axis=1)


def _searched(cost=_sphere, **changes):
    options = {"unknowns": 2, "population": 8, "generations": 6, "operators": Operators(), "tolerance": 0.0} | changes
    return search.search(Partial(cost, CENTRE), jax.random.key(0), **options)


def _assert_same(one, other):
    (state, history), (others, other_history) = one, other
    for a, b in zip(jax.tree.leaves(search._raw(state)), jax.tree.leaves(search._raw(others)), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(history, other_history, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_checkpoint_of_another_cost_under_the_same_name_is_refused(tmp_path):
    other = _bowl
    other.__name__, other.__qualname__ = _sphere.__name__, _sphere.__qualname__
    _searched(checkpoint=tmp_path / "run")
    with pytest.raises(ValueError, match="expected .* to be the checkpoint of this search, got one of another"):
        _searched(other, checkpoint=tmp_path / "run")


def test_a_checkpoint_that_was_altered_or_is_of_an_older_version_is_refused(tmp_path):
    path = tmp_path / "run"
    _searched(checkpoint=path)
    with np.load(path) as file:
        everything = dict(file.items())
    with open(path, "wb") as file:
        np.savez(file, **everything | {"array/state/cost": np.zeros(8, np.float32)})
    with pytest.raises(ValueError, match="run cannot be read as a checkpoint of a search .* altered .*: remove it"):
        _searched(checkpoint=path)
    with open(path, "wb") as file:
        np.savez(file, fingerprint=np.array("1b2c"), leaf_0=np.zeros(2, np.uint32))
    with pytest.raises(ValueError, match="of an older version of ehsvjax, or another file: .*: remove it or name"):
        _searched(checkpoint=path)


def test_several_that_share_a_checkpoint_all_end_with_the_same_result(tmp_path):
    whole, found = _searched(), []
    threads = [
        threading.Thread(target=lambda: found.append(_searched(checkpoint=tmp_path / "run"))) for _ in range(4)
    ]  # fmt: skip
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    for one in found:
        _assert_same(one, whole)
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_long_run_is_the_same_in_pieces_of_any_length(monkeypatch, tmp_path):
    whole = _searched(generations=40)
    # Shorter than the run on the device, and called one generation at a time.
    monkeypatch.setattr(search, "_REMEMBERED", 7)
    _assert_same(_searched(generations=40), whole)
    monkeypatch.setattr(search, "_PATIENCE", 0.0)
    _assert_same(_searched(generations=40), whole)
    _assert_same(_searched(generations=40, checkpoint=tmp_path / "run"), whole)
    assert len(whole[1].best_cost) == 40
    assert np.isfinite(whole[1].best_cost).all()


def _failing_beyond_the_middle(centre, individuals):
    return jnp.where(individuals[:, 0] > 0.5, jnp.nan, _sphere(centre, individuals))


@pytest.mark.parametrize("count", [1, 8, 21])
def test_costs_of_any_number_of_individuals_are_those_of_each(count):
    individuals = np.random.default_rng(2).uniform(size=(count, 2))
    found = search.costs_of(Partial(_failing_beyond_the_middle, CENTRE), individuals, 8, Operators(elites=2))
    expected = np.sum((individuals - np.array([0.3, 0.7])) ** 2, axis=1)
    np.testing.assert_allclose(found, np.where(individuals[:, 0] > 0.5, np.inf, expected), rtol=1e-5)


def test_runs_of_any_number_of_generations_and_costs_share_one_program():
    def searched(generations):
        search.search(
            cost, jax.random.key(1), unknowns=2, population=12, generations=generations, operators=Operators(),
            tolerance=0.0,
        )  # fmt: skip

    cost = Partial(_sphere, CENTRE)
    with compilations() as compiled:
        search.costs_of(cost, np.full((3, 2), 0.2), 12, Operators())
        searched(3)
        searched(7)
    assert compiled.count("jit(run)") == 1


def test_islands_remember_their_history_piece_by_piece(monkeypatch):
    monkeypatch.setattr(search, "_REMEMBERED", 5)
    state, history = _searched(generations=12, islands=2)
    assert [len(leaf) for leaf in history] == [12] * 5
    assert np.all(np.diff(history.best_cost) <= 0)
    assert history.best_cost[-1] == state.elite_cost[0]
    np.testing.assert_allclose(_sphere(CENTRE, jnp.asarray(history.best)), history.best_cost, rtol=1e-5)


def test_history_is_as_long_as_what_was_run():
    state, history = _searched(generations=10**8, tolerance=1e-3)
    done = int(state.generation)
    assert done < 1000
    assert [len(leaf) for leaf in history] == [done] * 5


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ({"population": 10**12}, r"got population=1000000000000 on islands=1 for 2 unknowns, which takes 4e\+04 GB"),
        ({"islands": 10**11}, "got population=8 on islands=100000000000 for 2 unknowns, which takes"),
        (
            {"generations": 10**13},
            r"got generations=10000000000000 for 2 unknowns, which takes 2\.4e\+05 GB: take fewer",
        ),
    ],
)
def test_sizes_that_no_memory_holds_are_refused(sizes, said):
    with pytest.raises(ValueError, match=f"expected a search that fits into this machine's memory of .*{said}"):
        _searched(**sizes)


def test_more_generations_than_are_counted_are_refused(monkeypatch):
    monkeypatch.setattr(checks, "_memory", lambda: np.inf)
    with pytest.raises(ValueError, match="expected at most 2147483647 generations, got 2147483648"):
        _searched(generations=2**31)


def test_sizes_are_refused_before_anything_is_traced(monkeypatch):
    room = importlib.import_module("ehsvjax.identify")
    monkeypatch.setattr(room, "compile_refinement", lambda *_: pytest.fail("traced"))
    time_stamps = np.arange(40) * 0.05
    record = ehsvjax.Record(time_stamps, {"command": np.ones(40)}, {"position": np.sin(time_stamps)})
    with pytest.raises(ValueError, match="population=1000000000000 on islands=1"):
        ehsvjax.identify(ehsvjax.van_der_pol(), record, key=jax.random.key(0), population=10**12)


INTERRUPTED = """
import signal
# A shell's background jobs ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)
import jax, numpy as np, ehsvjax
from ehsvjax import search
gather = search._since
def gather_and_say(recent, first, done):
    if done > 1:
        print("running", flush=True)
    return gather(recent, first, done)
search._since = gather_and_say
time = np.arange(400) * 0.05
record = ehsvjax.Record(time, {"command": np.ones(400)}, {"position": np.sin(time)})
ehsvjax.identify(ehsvjax.van_der_pol(), record, key=jax.random.key(0), generations=10**7, tolerance=0.0, refine=False)
"""


def test_an_interrupt_ends_a_long_search_within_seconds():
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout.readline() == "running\n"
        time.sleep(0.7)
        process.send_signal(signal.SIGINT)
        began = time.monotonic()
        _, said = process.communicate(timeout=60)
        assert time.monotonic() - began < 3.0
    assert re.search(r"^KeyboardInterrupt$", said, re.MULTILINE)
