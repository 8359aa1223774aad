"""What the speed benchmarks share: every core as a device, the paper's problems, medians, the machine in words."""

import datetime
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1]))

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def one_device_per_core() -> None:
    """Let JAX show every core of the CPU as a device; to be called before anything is computed."""
    jax.config.update("jax_num_cpu_devices", CORES)


class Case(NamedTuple):
    """One of the paper's identifications as a problem in single precision."""

    model: object
    record: object
    problem: object  # float32, on the device
    population: int
    generations: int
    steps: int  # integration steps of one simulation


def cases(duration_factor: float = 1.0) -> dict[str, Case]:
    """Return the paper's two problems, the noise of its first row, data from the independent plants."""
    import jax.numpy as jnp

    import ehsvjax
    from benchmarks import monte_carlo
    from ehsvjax.population import cast
    from ehsvjax.unknowns import problem_of

    found = {}
    for name, make in (("van_der_pol", monte_carlo.van_der_pol), ("servovalve", monte_carlo.servovalve)):
        experiment = make()
        variance = next(iter(experiment.paper))
        noise = np.random.default_rng(0).normal(0.0, variance**0.5, len(experiment.record))
        position = experiment.record.outputs["position"] + noise
        record = ehsvjax.Record(experiment.record.time, experiment.record.inputs, {"position": position})
        record = record.slice(0.0, record.time[-1] * duration_factor) if duration_factor < 1.0 else record
        problem = problem_of(experiment.model, [record])
        steps = len(record) * problem.grid.substeps
        problem = cast(problem, jnp.float32)
        found[name] = Case(experiment.model, record, problem, experiment.population, experiment.generations, steps)
    return found


def oscillator_record(folder: Path) -> Path:
    """Return a file with the paper's oscillator record, for processes of their own to read."""
    record, file = cases()["van_der_pol"].record, folder / "record.npz"
    np.savez(file, time=record.time, command=record.inputs["command"], position=record.outputs["position"])
    return file


def individuals(case: Case, count: int) -> jax.Array:
    """Return that many individuals in the inner half of the bounds, `[individual, parameter]`."""
    return 0.25 + 0.5 * jax.random.uniform(jax.random.key(count), (count, case.problem.unknowns))


def on_all(tree):
    """Return the arrays placed on every device, where a search has them from its first generation on."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("device",))
    return jax.device_put(tree, jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec()))


def seconds(function: Callable[[], object]) -> float:
    """Time one call, its result ready."""
    began = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - began


def medians(functions: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the median time of each function, measured as `times` does; s."""
    return {name: statistics.median(values) for name, values in times(functions, repeats).items()}


def times(functions: dict, repeats: int) -> dict:
    """Return the times of each function, measured in turn, so that what disturbs one disturbs all; s.

    A measurement is the mean of as many calls in a row as take 30 ms. It begins after a short sleep, in which the
    threads of the one before come to rest: OpenMP's wait actively for a while.
    """
    for function in functions.values():
        jax.block_until_ready(function())
    calls = {name: max(1, round(0.03 / seconds(function))) for name, function in functions.items()}
    taken_by: dict = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            time.sleep(0.02)
            jax.block_until_ready(function())
            began = time.perf_counter()
            for _ in range(calls[name]):
                jax.block_until_ready(function())
            taken = time.perf_counter() - began
            taken_by[name].append(taken / calls[name])
    return taken_by


def machine() -> str:
    """Return the processor, its cores, the devices, and the versions that were measured."""
    model = platform.processor() or platform.machine()
    path = Path("/proc/cpuinfo")
    if path.exists():
        names = [line.split(":", 1)[1].strip() for line in path.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    devices = jax.devices()
    kinds = f"{len(devices)} x {devices[0].device_kind}"
    today = datetime.date.today().isoformat()
    return (
        f"{model}, {CORES} cores; devices: {kinds}; jax {jax.__version__}, Python {platform.python_version()}; {today}"
    )


def report(rows: list[dict], out: Path, stem: str, what: str) -> pd.DataFrame:
    """Print the rows as a table, store them as JSON, and say what was measured where."""
    out.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame(rows)
    (out / f"{stem}.json").write_text(json.dumps({"what": what, "machine": machine(), "rows": rows}, indent=1))
    print(table.to_string(index=False, float_format=lambda v: f"{v:.3g}", na_rep="-"))
    print(f"{what}; measured on {machine()}.")
    return table
