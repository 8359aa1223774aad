"""Work shared out to devices, of one process or of two, changes nothing in the result."""

import functools
import os
import socket
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import ehsvjax
from ehsvjax import excitation, genetic, islands, kernels
from ehsvjax.genetic import Operators
from ehsvjax.population import cast, population_cost, shared_cost
from ehsvjax.unknowns import problem_of
from tests import plants

ROOT = Path(__file__).parents[1]
BOTH = tuple(jax.devices()[:2])
# Of costs: none with the kernels; without them XLA rounds a population of another size as it happens to.
ROUNDING = 3e-7 if kernels._PLAIN else 0.0


@functools.cache
def _record(samples=200, period=0.05):
    command = np.repeat(np.random.default_rng(4).uniform(-2, 2, samples // 20), 20)
    position = plants.van_der_pol_plant(command, period, 0.96, 1.23, (0.2, 0.1))[:, 0]
    noise = np.random.default_rng(5).normal(0.0, 0.2, samples)
    return ehsvjax.Record(np.arange(samples) * period, {"command": command}, {"position": position + noise})


@functools.cache
def _valve_record():
    command = excitation.pseudo_random_signal(
        jax.random.key(2), amplitude=6e-3, hold_time=0.1, duration=0.4, sample_period=1e-3
    )
    position = plants.servovalve_plant(command, 1e-3).position
    return ehsvjax.Record(np.arange(len(command)) * 1e-3, {"command": command}, {"position": position})


def _identified(record, model=None, **changes):
    options = {"key": jax.random.key(3), "population": 18, "generations": 8, "refine": False} | changes
    return ehsvjax.identify(model or ehsvjax.van_der_pol(), record, **options)


def _assert_same(a, b):
    assert a.parameters == b.parameters
    assert a.initial == b.initial
    for one, other in zip(jax.tree.leaves(a.history), jax.tree.leaves(b.history), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("make_model", "make_record"), [(ehsvjax.van_der_pol, _record), (ehsvjax.servovalve, _valve_record)]
)
@pytest.mark.parametrize("count", [2, 5, 16, 33, 70])
def test_cost_is_the_same_to_the_last_bit(make_model, make_record, count):
    problem = cast(problem_of(make_model(), [make_record()]), jnp.float32)
    individuals = jax.random.uniform(jax.random.key(1), (count, problem.unknowns))
    shared = jax.jit(shared_cost(BOTH))(problem, individuals)
    assert shared.sharding.device_set == set(BOTH)
    np.testing.assert_allclose(shared, jax.jit(population_cost)(problem, individuals), rtol=ROUNDING)


def test_population_shared_by_two_devices_gives_the_fit_of_one():
    _assert_same(_identified(_record(), devices=BOTH), _identified(_record()))


def test_islands_shared_by_two_devices_give_the_fit_of_one():
    shared, alone = _identified(_record(), islands=4, devices=BOTH), _identified(_record(), islands=4)
    _assert_same(shared, alone)
    assert shared.effort.population == 4 * 18
    assert shared.effort.simulations == 4 * 18 * 8


def test_a_run_of_islands_is_gone_on_with_from_its_checkpoint(tmp_path):
    options = {"islands": 2, "tolerance": 0.0}
    whole = _identified(_record(), **options)
    watched = _identified(_record(), **options, checkpoint=tmp_path / "run")
    _assert_same(watched, whole)
    _assert_same(_identified(_record(), **options, checkpoint=tmp_path / "run"), whole)


def _sphere(centre, individuals):
    return jnp.sum((individuals - centre[None, :]) ** 2, axis=1)


def _run(cost, count, generations=12, tolerance=0.0):
    operators = Operators()
    state, history = islands.init(jax.random.key(0), count, 16, 2, generations, operators.elites)
    return islands.run(cost, operators, state, history, generations, tolerance, devices=BOTH)


def test_elite_travels_round_the_ring():
    centre = jnp.array([0.3, 0.7])
    state, history = _run(Partial(_sphere, centre), 4, generations=islands.MIGRATION_INTERVAL)
    # The generation that follows a migration evaluates the elite of the island before.
    for island in range(4):
        np.testing.assert_array_equal(state.candidates[island, -2:], state.elites[island - 1])
    assert history.best_cost[-1] == np.min(state.elite_cost)


def test_islands_stop_together_and_are_merged_best_first():
    state, history = _run(Partial(_sphere, jnp.array([0.3, 0.7])), 2, generations=60, tolerance=1e-3)
    assert np.all(state.converged)
    assert len(set(np.asarray(state.generation))) == 1
    assert int(state.generation[0]) < 60
    assert np.isnan(history.best_cost[-1])
    merged = islands.merged(state, 2)
    assert merged.population.shape == (32, 2)
    assert np.all(np.diff(merged.elite_cost) >= 0)
    assert merged.elite_cost[0] == np.min(state.elite_cost)
    assert not np.array_equal(merged.elites[0], merged.elites[1])


def test_one_island_alone_is_the_plain_algorithm_with_its_own_key():
    cost, operators = Partial(_sphere, jnp.array([0.3, 0.7])), Operators()
    state, history = islands.init(jax.random.key(0), 1, 16, 2, 4, operators.elites)
    state, history = islands.run(cost, operators, state, history, 4, 0.0, devices=BOTH[:1])
    alone = genetic.init(jax.random.split(jax.random.key(0), 1)[0], 16, 2, 4, operators.elites)
    alone = genetic.run(cost, operators, *alone, 4, 0.0)
    np.testing.assert_array_equal(history.best_cost, alone[1].best_cost)


def test_islands_that_cannot_be():
    with pytest.raises(ValueError, match="expected as many islands on each of 2 devices, got 3 in all"):
        _identified(_record(), islands=3, devices=BOTH)
    with pytest.raises(ValueError, match="expected islands to be a whole number of at least 1, got 0"):
        _identified(_record(), islands=0)
    with pytest.raises(ValueError, match="expected devices to be some of jax.devices"):
        _identified(_record(), devices=())


PROCESS = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", 1)
address, count, index, data = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
jax.distributed.initialize(address, count, index)
import numpy as np
import ehsvjax
file = np.load(data)
record = ehsvjax.Record(file["time"], {"command": file["command"]}, {"position": file["position"]})
assert len(jax.devices()) == count and len(jax.local_devices()) == 1
for options in ({"islands": 4}, {}):
    fit = ehsvjax.identify(ehsvjax.van_der_pol(), record, key=jax.random.key(3), population=18, generations=8,
                           devices=jax.devices(), **options)
    print("result", [v.hex() for v in fit.parameters.values()], [float(c).hex() for c in fit.history.best_cost])
"""


def test_two_processes_give_the_answer_of_one(tmp_path):
    record = _record()
    data = tmp_path / "data.npz"
    np.savez(data, time=record.time, command=record.inputs["command"], position=record.outputs["position"])
    script = tmp_path / "process.py"
    script.write_text(textwrap.dedent(PROCESS))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    processes = [
        subprocess.Popen(
            [sys.executable, str(script), address, "2", str(index), str(data)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
        for index in range(2)
    ]  # fmt: skip
    outputs = [process.communicate(timeout=240) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs[0][1][-2000:] + outputs[1][1][-2000:]
    expected = [
        f"result {[v.hex() for v in fit.parameters.values()]} {[float(c).hex() for c in fit.history.best_cost]}"
        for fit in (_identified(record, refine=True, islands=4), _identified(record, refine=True))
    ]
    for printed, _ in outputs:
        assert [line for line in printed.splitlines() if line.startswith("result")] == expected
