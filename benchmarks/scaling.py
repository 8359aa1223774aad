"""How time and memory grow: population x steps x devices, and a million steps.

    python benchmarks/scaling.py [--repeats 15] [--out out/benchmarks]

The time of the population's cost against the population and against the length of the record, with the deviation from
proportional growth; on one device and on all; the Jacobian and the gradient in multiples of one simulation; the most
memory that a process needs for the cost of 4,096 individuals over a million integration steps.
"""

import argparse
import functools
import json
import statistics
import subprocess
import sys
from pathlib import Path

import common
import jax
import jax.numpy as jnp
import matplotlib
from matplotlib.figure import Figure

from ehsvjax.population import population_cost, residuals, shared_cost
from ehsvjax.refine import cost_gradient_information

matplotlib.use("Agg")

POPULATIONS = (64, 256, 1024, 4096, 8192)
LENGTHS = (0.25, 0.5, 1.0)


def growth(names, repeats: int) -> list[dict]:
    """Return the time of the cost for every population, part of the record, and one or all devices."""
    rows = []
    everywhere = jax.jit(shared_cost(tuple(jax.devices())))
    for part in LENGTHS:
        for name, case in common.cases(part).items():
            if name not in names:
                continue
            for population in POPULATIONS:
                individuals = common.individuals(case, population)
                calls = {1: functools.partial(jax.jit(population_cost), case.problem, individuals)}
                if len(jax.devices()) > 1:
                    calls[len(jax.devices())] = functools.partial(
                        everywhere, *common.on_all((case.problem, individuals))
                    )
                for devices, taken in common.times(calls, repeats).items():
                    median, least = statistics.median(taken), min(taken)
                    rows.append(
                        {
                            "model": name,
                            "devices": devices,
                            "individuals": population,
                            "steps": case.steps,
                            "ms": 1e3 * median,
                            "ns/step": 1e9 * median / population / case.steps,
                            "least ns/step": 1e9 * least / population / case.steps,
                        }
                    )
                    print(
                        f"{name} {rows[-1]['steps']} steps x {population} on {devices}: {rows[-1]['ms']:.3g} ms",
                        flush=True,
                    )
    return rows


def derivatives(names, repeats: int) -> list[dict]:
    """Return the Jacobian of all residuals and the gradient of the cost, in multiples of one simulation."""
    rows = []
    for name, case in common.cases().items():
        if name not in names:
            continue
        problem, count = case.problem, len(case.problem.free)
        point = common.individuals(case, 1)[0]

        def of_parameters(problem, parameters, point=point, count=count):
            return residuals(problem, jnp.concatenate([parameters, point[count:]]))

        simulation = functools.partial(jax.jit(residuals), problem, point)
        jacobian = functools.partial(jax.jit(jax.jacfwd(of_parameters, argnums=1)), problem, point[:count])
        cost = functools.partial(jax.jit(lambda p, x: population_cost(p, x[None])[0]), problem, point)
        forward = functools.partial(jax.jit(cost_gradient_information), problem, point[None])
        gradient = functools.partial(jax.jit(jax.grad(lambda x, p: population_cost(p, x[None])[0])), point, problem)
        calls = {"simulation": simulation, "jacobian": jacobian, "cost": cost, "forward": forward, "gradient": gradient}
        times = common.medians(calls, repeats)
        rows.append(
            {
                "model": name,
                "simulation ms": 1e3 * times["simulation"],
                "Jacobian by the parameters, simulations": times["jacobian"] / times["simulation"],
                "gradient and information, costs": times["forward"] / times["cost"],
                "gradient by jax.grad, costs": times["gradient"] / times["cost"],
            }
        )
    return rows


MILLION = """
import re, sys
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/benchmarks"]
import common, jax
import jax.numpy as jnp
from dataclasses import replace
from ehsvjax.population import population_cost
case = common.cases()["van_der_pol"]
problem = case.problem
count = 1_000_000 // problem.grid.substeps
repeats = -(-count // problem.samples.inputs.shape[1])
long = lambda leaf: jnp.tile(leaf, (1, repeats, 1))[:, :count]
s = problem.samples
longer = s._replace(inputs=long(s.inputs), outputs=long(s.outputs), measured=long(s.measured))
problem = replace(problem, samples=longer)
compiled = jax.jit(population_cost).lower(problem, common.individuals(case, 4096)).compile()

def most():
    # Not getrusage, in which a child starts from its parent's size.
    return re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read()).group(1)

before = most()
cost = compiled(problem, common.individuals(case, 4096))
assert bool(jnp.all(jnp.isfinite(cost)))
print(before, most())
"""


def memory() -> tuple[float, float]:
    """Return the memory of a process, MiB, before and after it costs 4,096 individuals over 1,000,000 steps.

    Before: the interpreter, JAX, the record and the compiled program. After: the most that there ever was.
    """
    root = str(Path(__file__).parents[1])
    printed = subprocess.run([sys.executable, "-c", MILLION, root], capture_output=True, text=True, check=True).stdout
    before, most = (int(kibibytes) / 1024 for kibibytes in printed.split()[-2:])
    return before, most


def picture(table) -> Figure:
    """Draw the time of an individual and step against the population, a line for each length and number of devices."""
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    names = list(table["model"].unique())
    for axes, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        for (devices, steps), rows in table[table["model"] == name].groupby(["devices", "steps"]):
            style = "-" if devices == 1 else "--"
            axes.plot(
                rows["individuals"], rows["ns/step"], style, marker="o", label=f"{steps} steps, {devices} devices"
            )
        axes.set(xscale="log", xlabel="individuals", ylabel="ns per individual and step", title=name, ylim=(0, None))
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=7)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=["van_der_pol", "servovalve"])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    common.one_device_per_core()
    table = common.report(growth(options.models, options.repeats), options.out, "scaling", "Growth of the cost")
    full = table[(table["individuals"] >= 1024)]
    for (name, devices), rows in full.groupby(["model", "devices"]):
        # What else the machine does only adds to a time: the least of them is the program's own.
        within = [100 * (rows[which].max() / rows[which].min() - 1) for which in ("least ns/step", "ns/step")]
        print(
            f"{name}, {devices} devices, 1,024 individuals and more: ns/step within {within[0]:.0f}% "
            f"by the least times, within {within[1]:.0f}% by the medians"
        )
    if len(jax.devices()) > 1:
        pivot = full.pivot_table(index=["model", "steps", "individuals"], columns="devices", values="ms")
        gain = pivot[1] / pivot[len(jax.devices())]
        print(
            f"{len(jax.devices())} devices, 1,024 individuals and more: {gain.min():.2f} to {gain.max():.2f} times "
            f"one, median {gain.median():.2f}"
        )
    rows = derivatives(options.models, options.repeats)
    common.report(rows, options.out, "derivatives", "Derivatives in multiples of what they are of, float32")
    before, most = memory()
    print(f"4,096 individuals over 1,000,000 steps: {before:.0f} MiB before, {most:.0f} MiB at most")
    (options.out / "memory.json").write_text(json.dumps({"before, MiB": before, "at most, MiB": most}))
    picture(table).savefig(options.out / "scaling.png", dpi=120)


if __name__ == "__main__":
    main()
