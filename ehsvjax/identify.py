"""The recipe: search by the genetic algorithm, refine the best few by gradient, return the fit."""

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Key

from ehsvjax import doubts, genetic
from ehsvjax.arithmetic import arithmetic_at
from ehsvjax.checks import flag, instance, number, refused, whole
from ehsvjax.draws import check_key
from ehsvjax.failure import nothing_finite
from ehsvjax.files import place_to_write
from ehsvjax.fit import Effort, Fit, History
from ehsvjax.genetic import Operators
from ehsvjax.models.model import Model
from ehsvjax.population import Problem, cast, population_cost, shared_cost
from ehsvjax.record import Record, checked_records
from ehsvjax.search import check_sizes, search
from ehsvjax.solve import (
    Best,
    as_searched,
    best_of,
    candidates,
    compile_refinement,
    guessed,
    initial_by_record,
    nominal_initial,
    refine_and_reweigh,
    values_of,
    with_nominal_initial,
    within_bounds,
)
from ehsvjax.unknowns import Initial, problem_of, where_to_search

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
    start: Mapping[str, float] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    tied: Mapping[str, Callable[..., Any]] | None = None,
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
    until the residual sum of squares is as good as at its minimum; from where a parameter changes nothing, as a
    saturation that is never reached, it is looked for where it does. Records of different length share the parameters
    and keep their own initial conditions. Several outputs are weighted by their noise: first as guessed from the
    records' third differences, in the refinement by the variance of their own residuals (maximum likelihood).

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
        start: name -> value, SI, of a guess that joins the first population; parameters that it does not name are
            nominal.
        priors: name -> (mean, standard deviation), SI, of what is known of a parameter beforehand; it counts as one
            more reading, in the cost, in errors and in prints.
        tied: name -> function of all parameters by name, `{"b": lambda p: 2.0 * p["a"]}`, for those that follow others.
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
        OSError: if the checkpoint cannot be read or written.

    """
    records = checked_records(records)
    _check_call(model, key, operators, tolerance, checkpoint, refine=refine, progress=progress)
    whole("islands", islands, 1)
    devices = None if devices is None else _checked_devices(devices)
    cost = population_cost if devices is None or islands > 1 else shared_cost(devices)
    model = model.with_ties(tied).with_bounds(bounds, fixed).with_priors(priors)
    problem = problem_of(model, records, initial=initial, noise_variance=noise_variance, huber=huber)
    check_sizes(population, generations, operators, islands, problem.unknowns)
    whole("starts", starts, 1, population * islands, "at most as many as there are individuals")
    begin = replace(problem, coordinates=where_to_search(model, records, problem))
    first = None if start is None else guessed(begin, model, start)
    slow = doubts.about_steps(model, records)
    for doubt in slow:
        warnings.warn(doubt, RuntimeWarning, stacklevel=2)

    compiling = compile_refinement(problem, starts) if refine else None
    found, history = search(
        # A number of steps that is compiled in is a tenth faster.
        Partial(cost, cast(replace(begin, substeps=None), jnp.float32)),
        key,
        unknowns=problem.unknowns,
        population=population,
        generations=generations,
        operators=operators,
        tolerance=tolerance,
        first=first,
        islands=islands,
        devices=devices,
        progress=progress,
        checkpoint=checkpoint,
    )
    effort = _search_effort(found, generations)
    if not np.isfinite(np.asarray(found.elite_cost)[0]):
        # A finer step may mend what failed, but where to begin would be anywhere.
        raise _nothing_finite(begin, model, records, effort)
    reweigh = noise_variance is None
    if compiling is None:
        best = as_searched(begin, problem, found, effort, reweigh=reweigh)
    else:
        compiling.join()
        starting = within_bounds(begin, problem, candidates(begin, model, found, starts))
        best = best_of(*refine_and_reweigh(problem, starting, reweigh=reweigh), effort, reweighed=reweigh)
    if not np.isfinite(best.cost):
        raise _nothing_finite(begin, model, records, effort)
    fit = _fit(model, records, best, history, not reweigh)
    about = doubts.about_fit(fit, best.problem, best.individual, best.residual_variance, best.idle)
    return replace(fit, warnings=(*slow, *about))


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
    known = known.with_bounds(fixed=fit.parameters_of(record))
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
    starts = within_bounds(begin, problem, np.stack([middle, with_nominal_initial(begin, known, middle)]))
    refined, _, problem = refine_and_reweigh(problem, starts, reweigh=False)
    best = refined.individual[int(np.argmin(refined.cost))]
    return initial_by_record(known, problem, best)[0]


def _check_call(model, key, operators, tolerance, checkpoint, **flags):
    instance("model", model, Model, "take ehsvjax.servovalve(), or write your own")
    check_key(key)
    instance("operators", operators, Operators, "take ehsvjax.Operators(...)")
    number("tolerance", tolerance, "zero or more noise variances", lambda x: x >= 0.0, "0.01 is usual, 0 never stops")
    if checkpoint is not None:
        place_to_write("checkpoint", checkpoint)
    for name, value in flags.items():
        flag(name, value)


def _checked_devices(devices) -> tuple[jax.Device, ...]:
    listed = tuple(devices) if isinstance(devices, Sequence | np.ndarray) else (devices,)
    if not listed or not all(isinstance(device, jax.Device) for device in listed):
        raise refused("devices", "some of jax.devices()", devices, "pass jax.devices() itself for all of them")
    return listed


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


def _nothing_finite(begin: Problem, model: Model, records: Sequence[Record], effort: Effort) -> ValueError:
    return ValueError(nothing_finite(model, records, nominal_initial(begin, model), effort.simulations))


def _fit(model, records, best: Best, history: genetic.History, noise_variance_given: bool) -> Fit:
    problem, individual, effort = best.problem, best.individual, best.effort
    values = values_of(problem, individual)
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
        initial=tuple(initial_by_record(model, problem, individual)),
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


def _history_in_units(problem: Problem, history: genetic.History, generations: int) -> History:
    best_cost, median_cost, failed, spread, best = (np.asarray(leaf, np.float64)[:generations] for leaf in history)
    values = values_of(problem, best)
    by_name = {name: values[:, i] for i, name in enumerate(problem.free)}
    return History(best_cost, median_cost, failed, spread, by_name)
