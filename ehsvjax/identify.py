"""The recipe: search by the genetic algorithm, refine the best few by gradient, return the fit."""

import os
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float, Key

from ehsvjax import genetic
from ehsvjax.draws import check_key
from ehsvjax.fit import Effort, Fit, History, at_bound
from ehsvjax.genetic import Operators
from ehsvjax.models.model import Model
from ehsvjax.population import Problem, cast, population_cost, residuals, shared_cost, to_unit, to_values
from ehsvjax.record import Record
from ehsvjax.refine import Refined
from ehsvjax.refine import refine as refine_starts
from ehsvjax.search import check_sizes, search
from ehsvjax.unknowns import Initial, problem_of

DEFAULT_OPERATORS = Operators()


def identify(
    model: Model,
    records: Record | Sequence[Record],
    *,
    key: Key[Array, ""],
    population: int = 100,
    generations: int = 50,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fixed: Mapping[str, float] | None = None,
    initial: Initial = "estimate",
    refine: bool = True,
    noise_variance: Mapping[str, float] | None = None,
    huber: float | None = None,
    operators: Operators = DEFAULT_OPERATORS,
    tolerance: float = 0.01,
    starts: int = 4,
    islands: int = 1,
    devices: Sequence[jax.Device] | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike | None = None,
) -> Fit:
    """Identify a model's parameters from measured records (sections 3 and 4 of the paper).

    A genetic algorithm in float32 searches within the bounds; then the best few individuals are refined in float64
    until the residual sum of squares is as good as at its minimum. Records of different length share the parameters and
    keep their own initial conditions. Several outputs are weighted by their noise: first as guessed from the records'
    third differences, in the refinement by the variance of their own residuals (maximum likelihood).

    Args:
        model: what to identify; its free parameters are the unknowns.
        records: one or more, each with every input and at least one output of the model.
        key: random key, `jax.random.key(0)`; the same key gives the same fit.
        population: individuals of a generation, at least 4.
        generations: at most this many; population x generations individuals are simulated.
        bounds: name -> (lower, upper), SI; frees a constant that is fixed by default.
        fixed: name -> value, SI, for parameters that are not to be identified.
        initial: "estimate" the initial conditions of each record, take the model's "nominal" ones, or give those that
            are known by name (the others are estimated), one mapping for all records or one for each.
        refine: whether the gradient refinement follows the search.
        noise_variance: name of the output -> variance, unit squared, where it is known.
        huber: residuals beyond this many standard deviations weigh linearly (1.345 is usual), for records with spikes.
        operators: the genetic operators.
        tolerance: the search stops before the last generation once a quarter of the population lies within this many
            noise variances of the best; 0 never stops.
        starts: how many of the best individuals that lie apart are refined.
        islands: populations that evolve apart and now and then exchange their best, each of `population` individuals.
        devices: those that share the simulations of a population, or the islands, `jax.devices()` for all, those of
            other processes under `jax.distributed` included; by default one. They change no result.
        progress: show a bar over generations.
        checkpoint: file written after every generation, from which a killed run goes on to the same result.

    Returns:
        the fit: print it, plot it, simulate with it.

    Raises:
        ValueError: for anything that cannot be meant, before a simulation is run.

    """
    records = (records,) if isinstance(records, Record) else tuple(records)
    _check_call(records, key, starts, tolerance)
    devices = None if devices is None else _checked_devices(devices)
    cost = population_cost if devices is None or islands > 1 else shared_cost(devices)
    model = model.with_bounds(bounds, fixed)
    problem = problem_of(model, records, initial=initial, noise_variance=noise_variance, huber=huber)
    check_sizes(population, generations, operators, islands, problem.unknowns)

    compiling = _compile_refinement(problem, starts, population) if refine else None
    found, history = search(
        Partial(cost, cast(problem, jnp.float32)),
        key,
        unknowns=problem.unknowns,
        population=population,
        generations=generations,
        operators=operators,
        tolerance=tolerance,
        islands=islands,
        devices=devices,
        progress=progress,
        checkpoint=checkpoint,
    )
    effort = _search_effort(found, generations)
    individual = np.asarray(found.elites, np.float64)[0]
    if compiling is not None:
        compiling.join()
        candidates = _candidates(problem, model, found, starts)
        refined, agreeing, problem = _refine_and_reweigh(problem, candidates, reweigh=noise_variance is None)
        individual, effort = _best_of(refined, agreeing, effort)
    elif noise_variance is None:
        problem = replace(problem, noise_variance=_residual_variance(problem, _residuals_of(problem, individual)))
    return _fit(model, records, problem, individual, history, effort, noise_variance is not None)


_residuals = jax.jit(residuals)


def estimate_initial(fit: Fit, record: Record) -> dict[str, float]:
    """Return the initial conditions that fit a new record best, name -> value, with the fit's parameters held.

    Raises:
        ValueError: if the record has no output to estimate them from.

    """
    if not fit.model.initial:
        return {}
    if not record.outputs:
        raise ValueError(
            f"expected {record.name} to hold an output to estimate its initial conditions from, got none: pass "
            'initial="nominal" or their values by name'
        )
    known = replace(fit.model, parameters=tuple(p._replace(fixed=True) for p in fit.model.parameters))
    known = known.with_bounds(fixed=fit.parameters)
    variance = {name: v for name, v in fit.noise_variance.items() if name in record.outputs}
    first, *others = fit.initial
    given = {
        name: value
        for name, value in first.items()
        if name not in fit.estimated_initial and all(other[name] == value for other in others)
    }
    if len(given) == len(first):
        return given
    problem = problem_of(known, [record], initial=given, noise_variance=variance, huber=fit.huber)
    middle = np.full(problem.unknowns, 0.5)
    starts = np.stack([middle, _with_nominal_initial(problem, known, middle)])
    refined, _, problem = _refine_and_reweigh(problem, starts, reweigh=False)
    best = refined.individual[int(np.argmin(refined.cost))]
    return _initial_by_record(known, problem, best)[0]


def _check_call(records, key, starts, tolerance):
    if not records or not all(isinstance(record, Record) for record in records):
        kinds = ", ".join(sorted({type(r).__name__ for r in records})) or "none"
        raise ValueError(f"expected a Record or a sequence of Records, got {kinds}: make one with Record.from_csv")
    check_key(key)
    if isinstance(starts, bool) or not isinstance(starts, int) or starts < 1:
        raise ValueError(f"expected starts to be a whole number of at least 1, got {starts!r}")
    if not tolerance >= 0:
        raise ValueError(f"expected tolerance to be zero or more noise variances, got {tolerance!r}")


def _checked_devices(devices) -> tuple[jax.Device, ...]:
    devices = tuple(devices)
    if not devices or not all(isinstance(device, jax.Device) for device in devices):
        raise ValueError(f"expected devices such as jax.devices(), got {devices}")
    return devices


def _search_effort(found: genetic.State, generations: int) -> Effort:
    done = int(found.generation)
    return Effort(
        population=len(found.population),
        generations=done,
        stopped_early=done < generations,
        simulations=len(found.population) * done,
        refined=False,
        iterations=0,
        starts=0,
        starts_agreeing=0,
        converged=bool(found.converged),
        remaining=float("nan"),
    )


def _compile_refinement(problem: Problem, starts: int, population: int) -> threading.Thread:
    """Trace the refinement, and have it compiled while the search is traced and compiled, on another core."""
    count = min(starts, population) + bool(problem.free_initial)
    with jax.enable_x64(True):
        nowhere = np.zeros((count, problem.unknowns))
        traced = refine_starts.lower(cast(problem, jnp.float64), jnp.asarray(nowhere), held=jnp.asarray(nowhere > 0))
    # What is compiled is kept by the traced program itself, of which JAX keeps one for the same shapes.
    thread = threading.Thread(target=traced.compile)
    thread.start()
    return thread


def _candidates(
    problem: Problem, model: Model, found: genetic.State, starts: int
) -> Float[np.ndarray, "individual parameter"]:
    """Return where to refine from: the best few that lie apart, and the best with nominal initial conditions.

    The last is there because a record may hardly show its initial conditions: the search leaves them anywhere, and the
    way from there can be long.
    """
    population = np.asarray(found.population, np.float64)
    best = population[
        genetic.best_distinct(population[:, : len(problem.free)], np.asarray(found.cost), starts, distance=0.02)
    ]
    if not problem.free_initial:
        return best
    return np.vstack([best, _with_nominal_initial(problem, model, best[0])])


def _with_nominal_initial(problem: Problem, model: Model, individual) -> Float[np.ndarray, " parameter"]:
    """Return the individual with the initial conditions nominal, or in the middle where an output shows them."""
    values = np.asarray(_values(problem, individual))
    nominal = np.array(
        [np.nan if model.parameter(name).output in problem.observed else model.parameter(name).value
         for name in problem.free_initial]
    )  # fmt: skip
    count = len(problem.free)
    values[count:] = np.tile(nominal, len(problem.samples.inputs))
    unit = to_unit(problem.coordinates, values)
    changed = np.array(individual, float)
    changed[count:] = np.where(np.isnan(unit[count:]), 0.5, np.clip(unit[count:], 0.0, 1.0))
    return changed


def _refine_and_reweigh(problem: Problem, starts, *, reweigh: bool) -> tuple[Refined, int, Problem]:
    """Refine; then, while the weights of the outputs still change, weigh them by their residuals and refine again.

    With one output and squared residuals the weight does not move the minimum, and one round is enough. The number
    returned says how many starts came to within a tenth of a noise variance of the same minimum, in the first round.
    """
    with jax.enable_x64(True):
        # Nothing is held, but a profile, which does hold something, then finds this program compiled.
        nothing = jnp.zeros(np.shape(starts), bool)
        refined = _in_numpy(refine_starts(cast(problem, jnp.float64), jnp.asarray(starts, jnp.float64), held=nothing))
        least = np.min(refined.cost)
        agreeing = int(np.sum(refined.cost <= least * (1.0 + 0.1 / np.sum(problem.samples.measured))))
        if not reweigh:
            return refined, agreeing, problem
        several = len(problem.observed) > 1 or problem.huber is not None
        for _ in range(10 if several else 1):
            best = np.argmin(refined.cost)
            variance = _residual_variance(problem, refined.residuals[best])
            settled = np.allclose(variance, problem.noise_variance, rtol=0.01)
            problem = replace(problem, noise_variance=variance)
            if settled or not several:
                break
            # From the best alone, as often as there were starts: the same shape is not compiled again.
            again = np.broadcast_to(refined.individual[best], refined.individual.shape)
            refined = _in_numpy(refine_starts(cast(problem, jnp.float64), jnp.asarray(again), held=nothing))
        return refined, agreeing, problem


def _in_numpy(refined: Refined) -> Refined:
    return jax.tree.map(np.array, refined)


def _residuals_of(problem: Problem, individual) -> Float[np.ndarray, "record time signal"]:
    with jax.enable_x64(True):
        return np.asarray(_residuals(cast(problem, jnp.float64), np.asarray(individual, np.float64)))


def _residual_variance(
    problem: Problem, standardised: Float[np.ndarray, "record time signal"]
) -> Float[np.ndarray, " signal"]:
    """Return the mean square of each output's residuals; with a Huber cost from their median size, robust to spikes."""
    variances = []
    for i, variance in enumerate(problem.noise_variance):
        measured = standardised[..., i][problem.samples.measured[..., i]]
        if problem.huber is None:
            relative = np.mean(measured**2)
        else:
            relative = (np.median(np.abs(measured)) / 0.6744897501960817) ** 2
        # A fit without any residual (data without noise) leaves the weight as it was.
        variances.append(variance * relative if np.isfinite(relative) and relative > 0 else variance)
    return np.array(variances)


def _best_of(refined: Refined, agreeing: int, effort: Effort) -> tuple[Float[np.ndarray, " parameter"], Effort]:
    best = int(np.argmin(refined.cost))
    return np.asarray(refined.individual[best]), effort._replace(
        refined=True,
        iterations=int(refined.iterations[best]),
        starts=len(refined.cost),
        starts_agreeing=agreeing,
        converged=bool(refined.converged[best]),
        remaining=float(refined.remaining[best]),
    )


def _fit(
    model, records, problem: Problem, individual, history: genetic.History, effort: Effort, noise_variance_given: bool
) -> Fit:
    values = _values(problem, individual)
    parameters = {name: float(v) for name, v in zip(problem.free, values, strict=False)}
    return Fit(
        model=model,
        records=records,
        parameters=parameters,
        initial=tuple(_initial_by_record(model, problem, individual)),
        noise_variance={name: float(v) for name, v in zip(problem.observed, problem.noise_variance, strict=True)},
        history=_history_in_units(problem, history, effort.generations),
        effort=effort,
        warnings=_warnings(model, problem, individual, effort),
        huber=problem.huber,
        estimated_initial=problem.free_initial,
        noise_variance_given=noise_variance_given,
    )


def _values(problem: Problem, individual) -> Float[np.ndarray, " *batch parameter"]:
    return to_values(problem.coordinates, np.asarray(individual, np.float64))


def _initial_by_record(model: Model, problem: Problem, individual) -> list[dict[str, float]]:
    count = len(problem.samples.inputs)
    estimated = _values(problem, individual)[len(problem.free) :].reshape(count, len(problem.free_initial))
    by_name = dict(zip(problem.free_initial, estimated.T, strict=True)) | problem.known_initial
    return [{p.name: float(by_name[p.name][i]) for p in model.initial} for i in range(count)]


def _history_in_units(problem: Problem, history: genetic.History, generations: int) -> History:
    best_cost, median_cost, failed, spread, best = (np.asarray(leaf, np.float64)[:generations] for leaf in history)
    values = _values(problem, best)
    by_name = {name: values[:, i] for i, name in enumerate(problem.free)}
    return History(best_cost, median_cost, failed, spread, by_name)


def _warnings(model: Model, problem: Problem, individual, effort: Effort) -> tuple[str, ...]:
    """Return what a user should know before trusting the numbers, each with what to do."""
    found = []
    names = [*problem.free, *(n for _ in range(len(problem.samples.inputs)) for n in problem.free_initial)]
    for name, place in zip(names, individual, strict=True):
        if min(place, 1.0 - place) < 1e-6:
            side = "lower" if place < 0.5 else "upper"
            what = "" if name in problem.free else " (an initial condition, which this record may hardly show)"
            found.append(at_bound(name, side, what))
    if not effort.refined:
        found.append("not refined: the parameters are as good as the search left them; use refine=True")
    elif not effort.converged:
        found.append(
            "the refinement has not converged: a further step would lower the sum of squares by "
            f"{effort.remaining:.2g} noise variances; perhaps the record does not fix every parameter"
        )
    if effort.refined and effort.starts > 1 and effort.starts_agreeing == 1:
        found.append(
            f"only one of {effort.starts} starts led to this minimum, there may be a better one: use a larger "
            "population or more generations"
        )
    del model
    return tuple(found)
