"""A population's cost at equal accuracy of the trajectory, not at equal step: this package and diffrax's solvers.

    python benchmarks/equal_accuracy.py [--models van_der_pol servovalve] [--repeats 7] [--out out/benchmarks]

Every contender simulates the paper's records at the true parameters with more and more steps, until no reading is
further than 1e-6 (m for the servovalve) from the independent plant of tests/plants.py: this package in float32 and in
float64, diffrax, whose clock runs through the record in the precision of the states, in float64. Then each is timed on
one core with a population of the paper's size, the compiling not counted. Solvers of diffrax take equal steps within
every sample, and adaptive ones; no step of either lies over a jump of the command. Of the servovalve only the implicit
solver can follow the closed valve.
"""

import argparse
import functools
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

if hasattr(os, "sched_setaffinity"):
    # One core, before JAX makes its threads.
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common, monte_carlo
from benchmarks.peers import van_der_pol_motion
from ehsvjax import kernels
from ehsvjax.population import cast, population_cost, simulated, to_unit, to_values
from ehsvjax.unknowns import problem_of
from tests.plants import Valve

CLOSE = 1e-6
MOST_STEPS = 256
# Of a sample period, the time before a jump at which a step ends.
BEFORE = 1e-6
# Opening, m, that the plant's implicit orifice equation takes for a closed valve.
FLOOR = 1e-8
TOLERANCES = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11)
# Of the implicit stages where no tolerance of the steps tells one.
ROOTS = 1e-7


class Contender(NamedTuple):
    """One way to simulate, at some size of its steps.

    Attributes:
        steps: per sample, or a tolerance in words.
        trajectory: individual -> position `[time]`.
        cost: individuals -> cost of each.

    """

    steps: str
    trajectory: Callable[[jax.Array], jax.Array]
    cost: Callable[[jax.Array], jax.Array]


def ours(problem) -> Iterator[Contender]:
    """Yield this package, with more and more steps, compiled as a search is."""
    cost = kernels.jit(population_cost)
    for count in _counts():
        finer = replace(problem, substeps=jnp.int32(count))
        yield Contender(
            f"{count} a sample",
            lambda individual, finer=finer: simulated(finer, individual)[0, :, 0],
            functools.partial(cost, finer),
        )


def theirs(problem, record, field: Callable, solver, adaptive: bool) -> Iterator[Contender]:
    """Yield one of diffrax's solvers, with more and more steps."""
    period = record.sample_period
    dtype = problem.noise_variance.dtype
    times, readings = jnp.asarray(record.time, dtype), jnp.asarray(record.outputs["position"], dtype)
    command = record.inputs["command"]
    at = np.flatnonzero(np.diff(command, prepend=command[0]) != 0)
    jumps, levels = jnp.asarray(record.time[at], dtype), jnp.asarray(command[np.append(0, at)], dtype)
    implicit = issubclass(solver, diffrax.AbstractImplicitSolver) and not adaptive
    method = solver(root_finder=diffrax.VeryChord(rtol=ROOTS, atol=ROOTS)) if implicit else solver()
    for size in TOLERANCES if adaptive else _counts():
        if adaptive:
            controller: Any = diffrax.ClipStepSizeController(diffrax.PIDController(size, size), jump_ts=jumps)
            most = 100 * len(record)
        else:
            within = np.interp(np.arange((len(record) - 1) * size + 1) / size, np.arange(len(record)), record.time)
            # What is evaluated at the end of a step must not see the command behind its jump.
            nodes = np.sort(np.concatenate([within, record.time[at] - BEFORE * period]))
            controller, most = diffrax.StepTo(jnp.asarray(nodes, dtype)), len(nodes)

        def trajectory(individual, controller=controller, most=most):
            values = to_values(problem.coordinates, individual)
            start, motion = field(values, lambda t: levels[jnp.searchsorted(jumps, t, side="right")])
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(motion), method, times[0], times[-1], None, start,
                saveat=diffrax.SaveAt(ts=times), stepsize_controller=controller, max_steps=most, throw=False,
            )  # fmt: skip
            return solution.ys[:, 0]

        @jax.jit
        def cost(individuals, trajectory=trajectory):
            return jax.vmap(lambda x: jnp.sum((readings - trajectory(x)) ** 2) / problem.noise_variance[0])(individuals)

        yield Contender(f"tolerance {size:g}" if adaptive else f"{size} a sample", trajectory, cost)


def _counts() -> Iterator[int]:
    count = 1
    while count <= MOST_STEPS:
        yield count
        count *= 2


def van_der_pol(values, command):
    """Return the start of the Van der Pol oscillator, and its equation (10)."""
    return values[2:], van_der_pol_motion(values, command)


def servovalve(values, command):
    """Return the start of the servovalve, and its equations as the paper writes them: implicit in the load pressure."""
    dead_zone, saturation, flow_gain, feedback_gain, damping_ratio, frequency, x, p, r = values
    area, supply, mass, stiffness = Valve().piston_area, Valve().supply_pressure, Valve().mass, Valve().stiffness

    def motion(t, y, args):
        del args
        position, velocity, filtered, rate = y
        e = command(t) - feedback_gain * position
        opening = jnp.where(filtered < 0.0, -1.0, 1.0) * jnp.clip(jnp.abs(filtered) - dead_zone, FLOOR, saturation)
        speed = area * velocity / (flow_gain * opening)
        load_pressure = jnp.sign(opening) * (supply - speed * jnp.abs(speed))
        return jnp.stack([
            velocity,
            (area * load_pressure - stiffness * position) / mass,
            rate,
            frequency**2 * (e - filtered) - 2.0 * damping_ratio * frequency * rate,
        ])  # fmt: skip

    return jnp.stack([x, jnp.zeros_like(x), p, r]), motion


FIELDS = {"van_der_pol": van_der_pol, "servovalve": servovalve}
SOLVERS: dict[str, tuple[Any, ...]] = {
    "van_der_pol": (diffrax.Heun, diffrax.Tsit5, diffrax.Kvaerno3),
    "servovalve": (diffrax.Kvaerno3,),
}


def accurate(contenders: Iterator[Contender], truth: jax.Array, plant: np.ndarray) -> tuple[Contender | None, float]:
    """Return the contender with the fewest steps that is close to the plant at every reading, and how close it is.

    If none is, the closest: more steps add more rounding.
    """
    least = np.inf
    for one in contenders:
        error = float(np.max(np.abs(np.asarray(jax.jit(one.trajectory)(truth), float) - plant)))
        least = min(least, error if np.isfinite(error) else np.inf)
        if error < CLOSE:
            return one, error
    return None, least


def measured(name: str, repeats: int) -> list[dict]:
    """Return a row for each contender of one model."""
    rows = [row for precision in (jnp.float32, jnp.float64) for row in measured_in(precision, name, repeats)]
    own = min(row["ms/generation"] for row in rows if row["contender"] == "ehsvjax" and "ms/generation" in row)
    return [row | {"times ours": row["ms/generation"] / own if "ms/generation" in row else None} for row in rows]


def measured_in(precision, name: str, repeats: int) -> list[dict]:
    """Return a row for each contender of one model that computes in this precision."""
    experiment = getattr(monte_carlo, name)()
    record, given = experiment.record, len(experiment.truth)
    with jax.enable_x64(precision == jnp.float64):
        problem = cast(problem_of(experiment.model, [record]), precision)
        nominal = [experiment.truth.get(unknown, 0.0) for unknown in problem.names]
        truth = jnp.asarray(to_unit(problem.coordinates, np.asarray(nominal)), precision)
        some = 0.25 + 0.5 * jax.random.uniform(jax.random.key(0), (experiment.population, len(truth)), precision)
        # All start from rest, as the record.
        some = some.at[:, given:].set(truth[given:])
        contenders = {"ehsvjax": ours(problem)} | {
            f"diffrax {solver.__name__}, {'adaptive' if adaptive else 'constant'} steps":
            theirs(problem, record, FIELDS[name], solver, adaptive)
            for solver in (SOLVERS[name] if precision == jnp.float64 else ()) for adaptive in (False, True)
        }  # fmt: skip
        rows: dict[str, dict] = {}
        timed: dict[str, Callable] = {}
        for label, finer_and_finer in contenders.items():
            one, error = accurate(finer_and_finer, truth, record.outputs["position"])
            rows[label] = {"model": name, "precision": np.dtype(precision).name, "contender": label, "error": error,
                           "steps": one.steps if one else "never so close"}  # fmt: skip
            print(f"{name}, {rows[label]['precision']}, {label}: {rows[label]['steps']}, {error:.2g}", flush=True)
            if one is not None:
                timed[label] = functools.partial(one.cost, some)
        for label, taken in common.medians(timed, repeats).items():
            rows[label]["ms/generation"] = 1e3 * taken
    return list(rows.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=list(FIELDS), choices=list(FIELDS))
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    rows = [row for name in options.models for row in measured(name, options.repeats)]
    common.report(rows, options.out, "equal_accuracy", f"A population's cost, no reading off by more than {CLOSE:g}")


if __name__ == "__main__":
    main()
