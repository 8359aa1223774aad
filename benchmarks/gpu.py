"""A population's cost and a whole generation on a GPU: in one kernel, as XLA loops by itself, and on the CPU beside it.

    python benchmarks/gpu.py [--populations 128 1024 16384 131072 1000000] [--repeats 5] [--out out/benchmarks]

The costs of the GPU are compared with the CPU's, individual by individual. The Lorenz equations, 1,000 steps of the
classical Runge-Kutta method for each trajectory with nothing read or kept, are what ensembles of trajectories are
timed with elsewhere: DiffEqGPU (Utkarsh et al. 2024) has published 3.4e7 trajectories/s.
"""

import argparse
import functools
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import common
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from ehsvjax import genetic, kernels
from ehsvjax.integrators import runge_kutta_4
from ehsvjax.models.model import identity
from ehsvjax.population import population_cost, shared_cost

POPULATIONS = (128, 1024, 16_384, 131_072, 1_000_000)
COMPARED = 1024  # individuals whose costs are compared between the devices
PUBLISHED = 3.4e7  # trajectories/s of DiffEqGPU
# Of each way its environment, and the least and greatest population: a loop that XLA launches step by step takes as
# long for few as for many, and a CPU takes long for many.
WAYS = {
    "GPU": ({}, 0, POPULATIONS[-1]),
    "GPU, loops of XLA": ({"EHSVJAX_PLAIN_KERNELS": "1"}, 1024, 131_072),
    "CPU": ({"JAX_PLATFORMS": "cpu"}, 0, 131_072),
}


def measure(populations, repeats: int) -> dict:
    """Return the time of a cost and of a generation for every model and population, and some costs."""
    rows, costs = [], {}
    devices = tuple(jax.devices())
    for name, case in common.cases().items():
        cost = population_cost if len(devices) == 1 else shared_cost(devices)
        costs[name] = np.asarray(jax.jit(cost)(case.problem, common.individuals(case, COMPARED)), float).tolist()
        for population in populations:
            rows.append({"model": name, "individuals": population, "steps": case.steps})
            placed = common.on_all((case.problem, common.individuals(case, population)))
            generations = max(2, min(20, 200_000 // population)) if repeats > 1 else 1
            operators = genetic.Operators()
            state, history = genetic.init(
                jax.random.key(0), population, case.problem.unknowns, generations, operators.elites
            )
            once = {
                "cost": functools.partial(jax.jit(cost), *placed),
                "run": functools.partial(
                    genetic.run, Partial(cost, placed[0]), operators, state, history, generations, 0.0
                ),
            }
            taken = common.medians(once, repeats)
            rows[-1] |= {"cost ms": 1e3 * taken["cost"], "generation ms": 1e3 * taken["run"] / generations}
            print(json.dumps(rows[-1]), flush=True)
    return {"rows": rows, "costs": costs, "machine": common.machine()}


def lorenz(count: int, steps: int, repeats: int) -> float:
    """Return trajectories per second of an ensemble of Lorenz's equations (1963) with another rho in each."""

    def rates(parameters, state, inputs, signal):
        x, y, z = state
        return [10.0 * (y - x), x * (parameters["rho"] - z) - y, x * y - 8.0 / 3.0 * z]

    def last(rho):
        step = runge_kutta_4(rates)({"rho": rho}, 1e-3, identity)
        one = jnp.float32(1.0)
        start = [one, jnp.float32(0.0), jnp.float32(0.0)]
        return kernels.scan(lambda state, _: (step(state, lambda fraction: {}), None), start, jnp.zeros(steps))[0]

    rho = jnp.linspace(0.0, 21.0, count, dtype=jnp.float32)
    return count / common.medians({"all": functools.partial(jax.jit(jax.vmap(last)), rho)}, repeats)["all"]


def measured_apart(way: str, options) -> dict:
    """Measure one way in a process of its own: what JAX runs on is settled once in each."""
    environment, least, most = WAYS[way]
    populations = [str(p) for p in options.populations if least <= p <= most]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "measured.json"
        # What takes a second each time is as well known from one.
        repeats = 1 if way == "GPU, loops of XLA" else options.repeats
        command = [sys.executable, __file__, "--alone", str(target), "--repeats", str(repeats)]
        subprocess.run([*command, "--populations", *populations], check=True, env=os.environ | environment)
        return json.loads(target.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--populations", type=int, nargs="+", default=list(POPULATIONS))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--alone", type=Path, help="measure here, into this file: for the processes of this script")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    if options.alone:
        common.one_device_per_core()
        found = measure(options.populations, options.repeats)
        if kernels.in_registers():
            found["lorenz"] = lorenz(2**22, 1000, options.repeats)
        options.alone.write_text(json.dumps(found))
        return
    by_way = {}
    for way in WAYS:
        by_way[way] = measured_apart(way, options)
        if "lorenz" not in by_way["GPU"]:
            raise SystemExit(f"expected a GPU that JAX can use, got {by_way['GPU']['machine']}: see docs.jax.dev")
    rows = []
    for way, found in by_way.items():
        for row in found["rows"]:
            per_step = 1e6 * row["cost ms"] / row["individuals"] / row["steps"]
            rows.append({"on": way, **row, "ns/step": per_step, "generations/s": 1e3 / row["generation ms"]})
    rows.sort(key=lambda row: (row["model"], row["individuals"]))
    common.report(rows, options.out, "gpu", f"Cost and generations, float32; CPU: {by_way['CPU']['machine']}; GPU")
    for name, costs in by_way["GPU"]["costs"].items():
        difference = np.max(np.abs(np.asarray(costs) / np.asarray(by_way["CPU"]["costs"][name]) - 1.0))
        print(f"{name}: the costs of {COMPARED} individuals differ by {difference:.1e} of the CPU's at most")
    speed = by_way["GPU"]["lorenz"]
    print(f"Lorenz, 1,000 Runge-Kutta steps: {speed:.3g} trajectories/s, {speed / PUBLISHED:.1f} times {PUBLISHED:.2g}")


if __name__ == "__main__":
    main()
