"""The population's cost against the same methods written by hand in C, on the same cores, in the same precision.

    python benchmarks/against_c.py [--populations 50 100 128 1024] [--repeats 15] [--out out/benchmarks]

The C kernel (population_cost.c) is compiled here with gcc -O3 -march=native -ffast-math and OpenMP, for several numbers
of individuals side by side, of which the fastest counts. Costs are compared individual by individual. On several cores
C's costs lie in one array at the end; here they lie on the devices that computed them, and "gathered" on each.
"""

import argparse
import ctypes
import functools
import subprocess
import tempfile
from pathlib import Path

import common
import jax
import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ehsvjax import kernels
from ehsvjax.population import population_cost, shared_cost, to_values

matplotlib.use("Agg")

POPULATIONS = (50, 100, 128, 256, 1024, 4096, 16384)
LANES = (16, 32, 64)
# Floating-point operations of one integration step, counted in the C source; a root and a division count as one each.
OPERATIONS = {"van_der_pol": 52, "servovalve": 115}


def compiled(folder: Path) -> dict[int, ctypes.CDLL]:
    """Return the kernel as a library for each number of lanes."""
    source = Path(__file__).with_name("population_cost.c")
    libraries = {}
    for lanes in LANES:
        target = folder / f"population_cost_{lanes}.so"
        flags = ["-O3", "-march=native", "-ffast-math", "-fopenmp", f"-DLANES={lanes}", "-shared", "-fPIC"]
        subprocess.run(["gcc", *flags, str(source), "-o", str(target), "-lm"], check=True)
        libraries[lanes] = ctypes.CDLL(str(target))
        libraries[lanes].multiply_adds.restype = ctypes.c_double
    return libraries


def by_c(library: ctypes.CDLL, name: str, case: common.Case, individuals: jax.Array):
    """Return a function that costs the individuals in C, `[individual]`."""
    record, problem = case.record, case.problem
    parameters = np.ascontiguousarray(np.asarray(to_values(problem.coordinates, individuals), np.float32).T)
    command, measured = (
        np.asarray(values, np.float32) for values in (record.inputs["command"], record.outputs["position"])
    )
    names = ("piston_area", "supply_pressure", "mass", "stiffness", "hydraulic_capacitance", "leakage_coefficient")
    constants = np.array([case.model.nominal[n] for n in names], np.float32) if name == "servovalve" else None
    cost = np.empty(len(individuals), np.float32)
    arrays = [array for array in (parameters, constants, command, measured, cost) if array is not None]
    pointers = [array.ctypes.data_as(ctypes.POINTER(ctypes.c_float)) for array in arrays]
    period, scale = ctypes.c_float(record.sample_period), ctypes.c_float(float(problem.noise_variance[0]) ** -0.5)
    function = getattr(library, name)

    def call():
        function(len(cost), len(command), problem.grid.substeps, period, scale, *pointers)
        return cost

    call.arrays = arrays  # kept alive with the pointers
    return call


def by_jax(case: common.Case, individuals: jax.Array, cores: int) -> dict:
    """Return what costs the individuals here: on several cores as it is, and with every core given all costs."""
    if cores == 1:
        return {"ehsvjax": functools.partial(kernels.jit(population_cost), case.problem, individuals)}
    devices = tuple(jax.devices()[:cores])
    placed = common.on_all((case.problem, individuals))
    return {
        "ehsvjax": functools.partial(kernels.jit(shared_cost(devices, gathered=False)), *placed),
        "gathered": functools.partial(kernels.jit(shared_cost(devices)), *placed),
    }


def peak(library: ctypes.CDLL) -> float:
    """Return the floating-point operations per second that the library's threads reach at best."""
    sink = (ctypes.c_float * 1)()
    best = 0.0
    for _ in range(5):
        operations = []
        taken = common.seconds(
            lambda operations=operations: operations.append(library.multiply_adds(ctypes.c_long(3_000_000), sink))
        )
        best = max(best, operations[0] / taken)
    return best


def measure(libraries, names, populations, repeats) -> list[dict]:
    rows = []
    for name, case in common.cases().items():
        if name not in names:
            continue
        for cores in sorted({1, common.CORES}):
            for library in libraries.values():
                library.omp_set_num_threads(cores)
            best = peak(libraries[LANES[0]])
            for population in populations:
                individuals = common.individuals(case, population)
                kernels = {f"C, {n} lanes": by_c(library, name, case, individuals) for n, library in libraries.items()}
                ours = by_jax(case, individuals, cores)
                times = common.medians(ours | kernels, repeats)
                fastest = min(kernels, key=times.__getitem__)
                steps = population * case.steps
                difference = np.max(np.abs(kernels[fastest]() / np.asarray(ours["ehsvjax"]()) - 1.0))
                rows.append(
                    {
                        "model": name,
                        "cores": cores,
                        "individuals": population,
                        "ehsvjax ns/step": 1e9 * times["ehsvjax"] / steps,
                        "C ns/step": 1e9 * times[fastest] / steps,
                        "ehsvjax/C": times["ehsvjax"] / times[fastest],
                        "gathered/C": times.get("gathered", times["ehsvjax"]) / times[fastest],
                        "ehsvjax generations/s": 1.0 / times["ehsvjax"],
                        "C generations/s": 1.0 / times[fastest],
                        "fastest": fastest,
                        "GFLOP/s": 1e-9 * OPERATIONS[name] * steps / times["ehsvjax"],
                        "% of peak": 100.0 * OPERATIONS[name] * steps / times["ehsvjax"] / best,
                        "largest relative difference": float(difference),
                    }
                )
                print(f"{name}, {cores} cores, {population}: {rows[-1]['ehsvjax/C']:.2f}", flush=True)
    return rows


def picture(table) -> Figure:
    """Draw the ratio of the two against the population; below 1 ehsvjax is the faster."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for (name, cores), rows in table.groupby(["model", "cores"]):
        style = "-" if cores == 1 else "--"
        axes.plot(rows["individuals"], rows["ehsvjax/C"], style, marker="o", label=f"{name}, {cores} cores")
    axes.axhline(1.0, color="k", lw=0.8)
    axes.set(xscale="log", xlabel="individuals", ylabel="time of ehsvjax over time of C", ylim=(0, None))
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--populations", type=int, nargs="+", default=POPULATIONS)
    parser.add_argument("--models", nargs="+", default=list(OPERATIONS), choices=list(OPERATIONS))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    common.one_device_per_core()
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(compiled(Path(folder)), options.models, options.populations, options.repeats)
    what = f"Cost of a population, float32, medians of {options.repeats} calls in turn"
    table = common.report(rows, options.out, "against_c", what)
    picture(table).savefig(options.out / "against_c.png", dpi=120)


if __name__ == "__main__":
    main()
