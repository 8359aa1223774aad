"""The recipe: search by the genetic algorithm, refine the best few by gradient, return the fit."""

import os
import threading
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Key

from ehsvjax import doubts, genetic
from ehsvjax.arguments import file_path, flag, instance, not_negative, several, whole_number
from ehsvjax.arithmetic import arithmetic_at, settled_at
from ehsvjax.draws import check_key
from ehsvjax.failure import nothing_finite
from ehsvjax.fit import Effort, Fit, History
from ehsvjax.genetic import Operators
from ehsvjax.models.model import Model
from ehsvjax.population import Problem, cast, population_cost, shared_cost, to_unit, to_values
from ehsvjax.record import Record
from ehsvjax.refine import Refined
from ehsvjax.refine import refine as refine_starts
from ehsvjax.search import check_sizes, search
from ehsvjax.unknowns import Initial, problem_of, where_to_search

DEFAULT_OPERATORS = Operators()
# Of refinement, at most, until the weights of the outputs, the step and the readings that are known no longer change.
_ROUNDS = 10


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
        ValueError: for anything that cannot be meant, before a simulation is run; and if every simulation fails, with
            what fails first and what to look at.

    """
    records = several("records", records, Record, "make one with Record.from_csv")
    _check_call(model, key, operators, tolerance, checkpoint, refine=refine, progress=progress)
    _check_sizes(population=(population, 4), generations=(generations, 1), starts=(starts, 1), islands=(islands, 1))
    devices = None if devices is None else _checked_devices(devices)
    cost = population_cost if devices is None or islands > 1 else shared_cost(devices)
    model = model.with_bounds(bounds, fixed)
    problem = problem_of(model, records, initial=initial, noise_variance=noise_variance, huber=huber)
    check_sizes(population, generations, operators, islands, problem.unknowns)
    begin = replace(problem, coordinates=where_to_search(model, records, problem))
    slow = doubts.about_steps(model, records)
    for doubt in slow:
        warnings.warn(doubt, RuntimeWarning, stacklevel=2)

    compiling = _compile_refinement(problem, starts, population) if refine else None
    found, history = search(
        # A number of steps that is compiled in is a tenth faster.
        Partial(cost, cast(replace(begin, substeps=None), jnp.float32)),
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
    reweigh = noise_variance is None
    if compiling is None:
        best = _as_searched(begin, problem, found, effort, reweigh=reweigh)
    else:
        compiling.join()
        starting = _within_bounds(begin, problem, _candidates(begin, model, found, starts))
        best = _best_of(*_refine_and_reweigh(problem, starting, reweigh=reweigh), effort, reweighed=reweigh)
    if not np.isfinite(best.cost):
        raise ValueError(nothing_finite(model, records, _nominal_initial(begin, model), effort.simulations))
    fit = _fit(model, records, best, history, not reweigh)
    about = doubts.about_fit(fit, best.problem, best.individual, best.residual_variance, best.idle)
    return replace(fit, warnings=(*slow, *about))


class _Best(NamedTuple):
    """Where search and refinement ended.

    Attributes:
        problem: with the outputs weighted as in the end.
        individual: in the unit cube.
        cost: of it; +inf where nothing could be simulated.
        residual_variance: `[signal]` mean square of each output's residuals, unit squared.
        idle: `[parameter]` which unknowns change nothing near it, as far as is known.
        effort: what was done.

    """

    problem: Problem
    individual: Float[np.ndarray, " parameter"]
    cost: float
    residual_variance: Float[np.ndarray, " signal"]
    idle: Bool[np.ndarray, " parameter"]
    effort: Effort


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
    if not variance:
        raise ValueError(
            f"expected {record.name} to hold an output that was fitted, {', '.join(fit.outputs)}, to estimate its "
            f'initial conditions from; it has {", ".join(record.outputs)}: pass initial="nominal" or their values by '
            "name"
        )
    record = record.select(outputs=list(variance))
    problem = problem_of(known, [record], initial=given, noise_variance=variance, huber=fit.huber)
    begin = replace(problem, coordinates=where_to_search(known, [record], problem))
    middle = np.full(problem.unknowns, 0.5)
    starts = _within_bounds(begin, problem, np.stack([middle, _with_nominal_initial(begin, known, middle)]))
    refined, _, problem = _refine_and_reweigh(problem, starts, reweigh=False)
    best = refined.individual[int(np.argmin(refined.cost))]
    return _initial_by_record(known, problem, best)[0]


def _check_call(model, key, operators, tolerance, checkpoint, **flags):
    instance("model", model, Model, "take ehsvjax.servovalve(), or write your own")
    check_key(key)
    instance("operators", operators, Operators, "take ehsvjax.Operators(...)")
    not_negative("tolerance to be zero or more noise variances", tolerance)
    if checkpoint is not None:
        file_path("checkpoint", checkpoint)
    for name, value in flags.items():
        flag(name, value)


def _check_sizes(**sizes):
    for name, (value, least) in sizes.items():
        whole_number(name, value, least)


def _checked_devices(devices) -> tuple[jax.Device, ...]:
    devices = tuple(devices) if isinstance(devices, Sequence | np.ndarray) else (devices,)
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
    """Refine; then, while weights, step or readings that are known change, refine again with those found there.

    With one output and squared residuals its weight does not move the minimum. The number returned says how many starts
    came to within a tenth of a noise variance of the same minimum, in the first round.
    """
    every = problem.samples
    problem = settled_at(problem, np.asarray(starts[0]))
    with jax.enable_x64(True):
        # Nothing is held, but a profile, which does hold something, then finds this program compiled.
        nothing = jnp.zeros(np.shape(starts), bool)
        refined = _in_numpy(refine_starts(cast(problem, jnp.float64), jnp.asarray(starts, jnp.float64), held=nothing))
        least = np.min(refined.cost)
        agreeing = int(np.sum(refined.cost <= least * (1.0 + 0.1 / np.sum(problem.samples.measured))))
        several = len(problem.observed) > 1 or problem.huber is not None
        for _ in range(_ROUNDS):
            best = np.argmin(refined.cost)
            before = problem
            if reweigh:
                problem = replace(problem, noise_variance=_residual_variance(problem, refined.residuals[best]))
            # Of all readings: what a longer step did not know, or elsewhere, may be known here.
            known = settled_at(replace(problem, samples=every), np.asarray(refined.individual[best]))
            same = known.substeps == problem.substeps and np.array_equal(
                known.samples.measured, before.samples.measured
            )
            if same and (not several or np.allclose(problem.noise_variance, before.noise_variance, rtol=0.01)):
                break
            problem = known
            # From the best alone, as often as there were starts: the same shape is not compiled again.
            again = np.broadcast_to(refined.individual[best], refined.individual.shape)
            refined = _in_numpy(refine_starts(cast(problem, jnp.float64), jnp.asarray(again), held=nothing))
        return refined, agreeing, problem


def _in_numpy(refined: Refined) -> Refined:
    return jax.tree.map(np.array, refined)


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


def _as_searched(begin: Problem, problem: Problem, found: genetic.State, effort: Effort, *, reweigh: bool) -> _Best:
    """Return the best individual of the search as it is."""
    individual = _within_bounds(begin, problem, np.asarray(found.elites, np.float64)[0])
    standardised = doubts.residuals_at(problem, individual)
    variance = _residual_variance(problem, standardised)
    cost = float(np.sum(standardised**2))
    problem = settled_at(replace(problem, noise_variance=variance) if reweigh else problem, individual)
    return _Best(problem, individual, cost, variance, np.ones(problem.unknowns, bool), effort)


def _best_of(refined: Refined, agreeing: int, problem: Problem, effort: Effort, *, reweighed: bool) -> _Best:
    best = int(np.argmin(refined.cost))
    effort = effort._replace(
        refined=True,
        iterations=int(refined.iterations[best]),
        starts=len(refined.cost),
        starts_agreeing=agreeing,
        converged=bool(refined.converged[best]),
        remaining=float(refined.remaining[best]),
    )
    # Outputs that were weighed by their residuals have the variance of these already.
    variance = problem.noise_variance if reweighed else _residual_variance(problem, refined.residuals[best])
    idle = np.diagonal(refined.information[best]) < doubts.NO_CHANGE
    return _Best(problem, np.asarray(refined.individual[best]), float(refined.cost[best]), variance, idle, effort)


def _fit(model, records, best: _Best, history: genetic.History, noise_variance_given: bool) -> Fit:
    problem, individual, effort = best.problem, best.individual, best.effort
    values = _values(problem, individual)
    step = float(np.min(problem.samples.sample_period)) / int(problem.substeps)
    effort = effort._replace(
        step_size=step,
        left_out=_readings(records) - int(problem.samples.measured.sum()),
        arithmetic=arithmetic_at(problem, individual).worth,
    )
    parameters = {name: float(v) for name, v in zip(problem.free, values, strict=False)}
    return Fit(
        # The step is that which was needed: all that is simulated with the fit is as exact as the fit itself.
        model=replace(model, max_step=step) if problem.substeps > problem.grid.substeps else model,
        records=records,
        parameters=parameters,
        initial=tuple(_initial_by_record(model, problem, individual)),
        noise_variance={name: float(v) for name, v in zip(problem.observed, problem.noise_variance, strict=True)},
        history=_history_in_units(problem, history, effort.generations),
        effort=effort,
        warnings=(),
        huber=problem.huber,
        estimated_initial=problem.free_initial,
        noise_variance_given=noise_variance_given,
    )


def _readings(records: Sequence[Record]) -> int:
    return sum(int(np.isfinite(series).sum()) for record in records for series in record.outputs.values())


def _within_bounds(begin: Problem, problem: Problem, individuals) -> Float[np.ndarray, "*batch parameter"]:
    """Return individuals of where the search began as ones between the problem's own bounds."""
    return np.clip(to_unit(problem.coordinates, _values(begin, individuals)), 0.0, 1.0)


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


def _nominal_initial(problem: Problem, model: Model) -> list[dict[str, float]]:
    """Return for each record the initial conditions that are known, shown by an output, or nominal."""
    return _initial_by_record(model, problem, _with_nominal_initial(problem, model, np.full(problem.unknowns, 0.5)))
