"""Generations per second of the whole genetic algorithm, against its peers on the same cost, and where each arrives.

    python benchmarks/generations_per_second.py [--quick] [--populations 50 1024] [--out out/benchmarks]

For every contender: the time of a generation (median), the cost above the minimum after the paper's number of
generations, and the time until the best individual is within one noise variance of the minimum (a median over three
seeds; "-" where that was not reached). Peers are in peers.py; install them with pip install -c constraints.txt -e
".[benchmark]". Compiling is not counted.
"""

import argparse
import functools
import importlib.util
import statistics
import time
from pathlib import Path

import common
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import peers
from jax.tree_util import Partial
from matplotlib.figure import Figure

from ehsvjax import genetic
from ehsvjax.population import cast, population_cost
from ehsvjax.refine import refine
from ehsvjax.unknowns import problem_of

matplotlib.use("Agg")

SEEDS = (0, 1, 2)
SWEEP = (50, 128, 1024, 8192, 65536)
LONGEST = 15.0  # seconds that one contender may take for one seed


def minimum(case: common.Case) -> float:
    """Return the least cost, by refinement in double precision from the truth."""
    problem = problem_of(case.model, [case.record])
    with jax.enable_x64(True):
        start = jnp.full((1, problem.unknowns), 0.5)
        return float(refine(cast(problem, jnp.float64), start).cost[0])


def ours(case: common.Case, population: int, generations: int, seed: int):
    """Return a function that runs the whole search in one call, and gives its history."""
    cost, operators = Partial(population_cost, case.problem), genetic.Operators()
    state, history = genetic.init(
        jax.random.key(seed), population, case.problem.unknowns, generations, operators.elites
    )
    return functools.partial(genetic.run, cost, operators, state, history, generations, 0.0)


def measure_ours(case: common.Case, least: float, population: int, repeats: int) -> dict:
    run = ours(case, population, case.generations, 0)
    taken = common.medians({"run": run}, repeats)["run"]
    longer = 4 * case.generations
    arrivals, reached = [], []
    for seed in SEEDS:
        _, history = jax.block_until_ready(ours(case, population, longer, seed)())
        best = np.asarray(history.best_cost, float)
        reached.append(best[case.generations - 1] - least)
        within = np.flatnonzero(best - least <= 1.0)
        arrivals.append((within[0] + 1) * taken / case.generations if len(within) else np.nan)
    return _row("ehsvjax", population, taken / case.generations, reached, arrivals)


def measure_peer(name: str, make, case: common.Case, least: float, population: int) -> dict:
    """Step a peer through at most four times the paper's generations, or as many as it has time for."""
    arrivals, reached, times = [], [], []
    for seed in SEEDS:
        step, best = make(case.problem.unknowns, population, seed)
        step()  # compiles
        began, arrived, after = time.perf_counter(), np.nan, np.nan
        for generation in range(2, 4 * case.generations + 1):
            before = time.perf_counter()
            step()
            now = time.perf_counter()
            times.append(now - before)
            if np.isnan(arrived) and best() - least <= 1.0:
                arrived = now - began
            if generation == case.generations:
                after = best() - least
            if now - began > LONGEST or (generation >= case.generations and not np.isnan(arrived)):
                break
        arrivals.append(arrived)
        reached.append(after)
        if times[-1] > 0.3 * LONGEST / case.generations:
            break  # one seed says enough of the slowest
    return _row(name, population, statistics.median(times), reached, arrivals)


def _row(name: str, population: int, generation: float, reached, arrivals) -> dict:
    # A median with misses counted as never.
    arrival = float(np.median([np.inf if np.isnan(a) else a for a in arrivals]))
    return {
        "contender": name,
        "individuals": population,
        "ms/generation": 1e3 * generation,
        "generations/s": 1.0 / generation,
        "cost above minimum": float(np.median(reached)),
        "s to 1 noise variance": arrival if np.isfinite(arrival) else None,
    }


def contenders(name: str, case: common.Case) -> dict:
    """Return what can be run here: name -> function of (unknowns, population, seed)."""
    compiled = jax.jit(functools.partial(population_cost, case.problem))

    def vectorised(individuals):
        return np.asarray(compiled(jnp.asarray(individuals, jnp.float32)), float)

    def by(module: str, label: str, make, cost):
        if importlib.util.find_spec(module) is None:
            print(f'{label}: not installed, pip install -c constraints.txt -e ".[benchmark]"')
            return {}
        return {label: functools.partial(make, cost)}

    traced = functools.partial(population_cost, case.problem)
    found = {
        **by("evosax", "evosax SimpleGA, our cost", peers.evosax_ga, traced),
        **by("scipy", "SciPy differential evolution, our cost", peers.differential_evolution, vectorised),
        **by("pymoo", "pymoo GA, our cost", peers.pymoo_ga, vectorised),
        **by("cma", "pycma, our cost", peers.pycma, vectorised),
    }
    if name == "van_der_pol":
        if importlib.util.find_spec("diffrax"):
            # Heun's method is of second order, of 2 stages where Runge-Kutta has 4; Tsit5 of fifth, of 6.
            for solver in ("Heun", "Tsit5"):
                cost = peers.diffrax_cost(case, solver)
                found |= by("evosax", f"evosax SimpleGA, diffrax {solver}", peers.evosax_ga, cost)
        found |= by("scipy", "SciPy DE, NumPy over population", peers.differential_evolution, peers.numpy_cost(case))
        found |= by("scipy", "SciPy DE, odeint in a loop", peers.differential_evolution, peers.odeint_cost(case))
    return found


def picture(table, sweep) -> Figure:
    """Draw this package's generations/s against the population, and every peer where it was measured."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    models = list(dict.fromkeys(table["model"]))
    for axes, model in zip(figure.subplots(1, len(models), squeeze=False)[0], models, strict=True):
        own = sweep[sweep["model"] == model]
        axes.plot(own["individuals"], own["generations/s"], "k-o", label="ehsvjax")
        for i, (name, rows) in enumerate(table[table["model"] == model].groupby("contender", sort=False)):
            if name != "ehsvjax":
                axes.plot(rows["individuals"], rows["generations/s"], "s", color=f"C{i}", label=name)
        axes.set(xscale="log", yscale="log", xlabel="individuals", ylabel="generations/s", title=model)
        axes.grid(alpha=0.3, which="both")
        axes.legend(frameon=False, fontsize=7)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=["van_der_pol", "servovalve"])
    parser.add_argument("--populations", type=int, nargs="+", default=list(SWEEP), help="of this package's sweep")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--quick", action="store_true", help="every contender, once, for a few seconds")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    if options.quick:
        globals().update(SEEDS=(0,), LONGEST=2.0)
        options.populations, options.repeats = [50, 256], 3
    rows, sweep = [], []
    for name in options.models:
        case = common.cases()[name]
        least = minimum(case)
        population = case.population
        own = measure_ours(case, least, population, options.repeats)
        print(f"{name}: {own['generations/s']:.0f} generations/s with {population} individuals", flush=True)
        rows.append({"model": name, **own, "times slower": 1.0})
        for peer, make in contenders(name, case).items():
            row = measure_peer(peer, make, case, least, population)
            slower = row["ms/generation"] / own["ms/generation"]
            rows.append({"model": name, **row, "times slower": slower})
            print(f"  {peer}: {row['generations/s']:.3g} generations/s", flush=True)
        for count in options.populations:
            # The largest populations take a second a generation: a few are enough.
            short = case._replace(generations=max(2, min(case.generations, 100_000 // count)))
            run = ours(short, count, short.generations, 0)
            taken = common.medians({"run": run}, options.repeats if count <= 1024 else 3)["run"] / short.generations
            sweep.append({"model": name, "individuals": count, "ms/generation": 1e3 * taken, "generations/s": 1 / taken,
                          "ns per individual and step": 1e9 * taken / count / case.steps})  # fmt: skip
    table_of_sweep = common.report(sweep, options.out, "generations_per_second_sweep", "ehsvjax, whole generations")
    print()
    what = "Whole generations at the paper's population, and the cost reached after the paper's generations"
    table = common.report(rows, options.out, "generations_per_second", what)
    picture(table, table_of_sweep).savefig(options.out / "generations_per_second.png", dpi=120)


if __name__ == "__main__":
    main()
