"""From a problem to the best of its individuals: what the search found, refined, and the outputs weighed anew."""

import threading
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ehsvjax import genetic, kernels
from ehsvjax.arithmetic import ROUGHLY, settled_at
from ehsvjax.checks import by_name, number
from ehsvjax.doubts import NO_CHANGE, residuals_at
from ehsvjax.fit import Effort
from ehsvjax.models.model import Model
from ehsvjax.population import Problem, cast, to_unit, to_values
from ehsvjax.refine import Refined, refine

# Of refinement, at most, until the weights of the outputs, the step and the readings that are known no longer change.
_ROUNDS = 10
# Where an unknown that changes nothing at a minimum may act, over its bounds.
_PLACES = np.linspace(0.0, 1.0, 33)


class Best(NamedTuple):
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


def guessed(problem: Problem, model: Model, start: Any) -> Float[np.ndarray, " parameter"]:
    """Return the individual of a guess, name -> value, SI; what it does not name is nominal.

    Raises:
        ValueError: for what is no such mapping, a name that is no unknown parameter, or a value beyond its bounds.

    """
    named = {name: model.parameter(name).value for name in problem.free}
    for name, value in by_name("start", start, "{'flow_gain': 1e-4}").items():
        if name not in named:
            known = ", ".join(named) or "none"
            raise ValueError(f"expected start to name parameters that are to be identified, {known}; got {name!r}")
        p = model.parameter(name)
        named[name] = number(f"start of {name}", value, remedy=f"give its value, {p.unit or 'without a unit'}")
        if not p.lower <= named[name] <= p.upper:
            raise ValueError(f"expected start of {name} within its bounds, {p.lower:g} to {p.upper:g}, got {value}")
    values = values_of(problem, np.full(problem.unknowns, 0.5))
    values[: len(named)] = list(named.values())
    return with_nominal_initial(problem, model, np.clip(to_unit(problem.coordinates, values), 0.0, 1.0))


def compile_refinement(problem: Problem, starts: int) -> threading.Thread:
    """Trace the refinement, and have it compiled while the search is traced and compiled, on another core."""
    count = starts + bool(problem.free_initial)
    with kernels.double_precision():
        nowhere = np.zeros((count, problem.unknowns))
        traced = refine.lower(cast(problem, jnp.float64), jnp.asarray(nowhere), held=jnp.asarray(nowhere > 0))
    # What is compiled is kept by the traced program itself, of which JAX keeps one for the same shapes.
    thread = threading.Thread(target=traced.compile)
    thread.start()
    return thread


def candidates(
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
    return np.vstack([best, with_nominal_initial(problem, model, best[0])])


def with_nominal_initial(problem: Problem, model: Model, individual) -> Float[np.ndarray, " parameter"]:
    """Return the individual with the initial conditions nominal, or in the middle where an output shows them."""
    values = np.asarray(values_of(problem, individual))
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


def refine_and_reweigh(problem: Problem, starts, *, reweigh: bool) -> tuple[Refined, int, Problem]:
    """Refine; then, while weights, step or readings that are known change, refine again with those found there.

    With one output, squared residuals and no priors its weight does not move the minimum. The last of the starts has
    nominal initial conditions if any are free, as `candidates` gives them. The number returned says how many starts
    came to the same minimum.
    """
    # A longer step may not know what a shorter one does, so that all readings are asked again. At one and the same step
    # what was left out stays out, lest readings come and go.
    asked = problem.samples
    own, nominal_initial = len(problem.free), np.asarray(starts)[-1, len(problem.free) :]
    problem = settled_at(problem, np.asarray(starts[0]), ROUGHLY)
    with kernels.double_precision():
        refined = _off_plateaus(problem, _refined(problem, starts))
        agreeing = _agreeing(problem, refined)
        weighed = len(problem.observed) > 1 or problem.huber is not None or problem.priors is not None
        for _ in range(_ROUNDS):
            best = np.argmin(refined.cost)
            before = problem
            if reweigh:
                problem = replace(problem, noise_variance=_residual_variance(problem, refined.residuals[best]))
            known = settled_at(replace(problem, samples=asked), np.asarray(refined.individual[best]))
            starts = np.asarray(refined.individual)
            if known.substeps == before.substeps:
                asked = known.samples
                # Their weights alone are others: the best of the starts goes on.
                starts = np.broadcast_to(starts[best], starts.shape)
            if problem.free_initial:
                # Where the first readings were left out, the initial conditions have gone anywhere: once these are
                # asked again, there may be no way back.
                starts = np.vstack([starts[:-1], np.concatenate([starts[best, :own], nominal_initial])])
            same = known.substeps == before.substeps and np.array_equal(known.samples.measured, before.samples.measured)
            if same and (not weighed or np.allclose(problem.noise_variance, before.noise_variance, rtol=0.01)):
                break
            problem = known
            # From where each start has led: what kept them apart may have been the arithmetic.
            refined = _refined(problem, starts)
            if known.substeps != before.substeps:
                agreeing = _agreeing(problem, refined)
        return refined, agreeing, problem


def _off_plateaus(problem: Problem, refined: Refined) -> Refined:
    """Return where refinement leads from where idle unknowns act, if that is lower; else what it gave.

    A saturation beyond all that a valve moves changes nothing: no derivative leads away from there, however many starts
    agree, and what a lower one would do passes for something that the model lacks.
    """
    best = int(np.argmin(refined.cost))
    here = np.asarray(refined.individual[best])
    idle = np.flatnonzero(np.diagonal(refined.information[best])[: len(problem.free)] < NO_CHANGE)
    if not len(idle):
        return refined
    rows = np.repeat(here[None], len(idle) * len(_PLACES), axis=0)
    rows[np.arange(len(rows)), np.repeat(idle, len(_PLACES))] = np.tile(_PLACES, len(idle))
    off = np.stack([residuals_at(problem, row) for row in rows])
    acts = np.sum((off - residuals_at(problem, here)) ** 2, axis=(1, 2, 3)) > NO_CHANGE
    cost = np.where(acts, np.sum(off**2, axis=(1, 2, 3)), np.inf)
    acting = rows[np.argsort(cost)[: np.isfinite(cost).sum()]]
    if not len(acting):
        return refined
    # As many as there were: nothing is compiled anew.
    starts = acting[np.arange(len(refined.cost)) % len(acting)]
    elsewhere = _refined(problem, starts)
    return elsewhere if np.min(elsewhere.cost) < refined.cost[best] else refined


def _agreeing(problem: Problem, refined: Refined) -> int:
    """Return how many starts came to within a tenth of a noise variance of the best."""
    least = np.min(refined.cost)
    return int(np.sum(refined.cost <= least * (1.0 + 0.1 / np.sum(problem.samples.measured))))


def _refined(problem: Problem, starts) -> Refined:
    """Return where refinement leads from each start, in NumPy; where double precision is enabled."""
    # Nothing is held, but a profile, which does hold something, then finds this program compiled.
    nothing = jnp.asarray(np.zeros(np.shape(starts), bool))
    found = refine(cast(problem, jnp.float64), jnp.asarray(starts, jnp.float64), held=nothing)
    return jax.tree.map(np.array, found)


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


def as_searched(begin: Problem, problem: Problem, found: genetic.State, effort: Effort, *, reweigh: bool) -> Best:
    """Return the best individual of the search as it is."""
    individual = within_bounds(begin, problem, np.asarray(found.elites, np.float64)[0])
    standardised = residuals_at(problem, individual)
    variance = _residual_variance(problem, standardised)
    cost = float(np.sum(standardised**2))
    problem = settled_at(replace(problem, noise_variance=variance) if reweigh else problem, individual)
    return Best(problem, individual, cost, variance, np.ones(problem.unknowns, bool), effort)


def best_of(refined: Refined, agreeing: int, problem: Problem, effort: Effort, *, reweighed: bool) -> Best:
    """Return the best of what `refine_and_reweigh` gave; `effort` is what was done before."""
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
    idle = np.diagonal(refined.information[best]) < NO_CHANGE
    return Best(problem, np.asarray(refined.individual[best]), float(refined.cost[best]), variance, idle, effort)


def within_bounds(begin: Problem, problem: Problem, individuals) -> Float[np.ndarray, "*batch parameter"]:
    """Return individuals of where the search began as ones between the problem's own bounds."""
    return np.clip(to_unit(problem.coordinates, values_of(begin, individuals)), 0.0, 1.0)


def values_of(problem: Problem, individual) -> Float[np.ndarray, " *batch parameter"]:
    """Return the values of unknowns, SI, of points of the unit cube."""
    return to_values(problem.coordinates, np.asarray(individual, np.float64))


def initial_by_record(model: Model, problem: Problem, individual) -> list[dict[str, float]]:
    """Return for each record name -> value of all initial conditions, SI."""
    count = len(problem.samples.inputs)
    estimated = values_of(problem, individual)[len(problem.free) :].reshape(count, len(problem.free_initial))
    by_name = dict(zip(problem.free_initial, estimated.T, strict=True)) | problem.known_initial
    return [{p.name: float(by_name[p.name][i]) for p in model.initial} for i in range(count)]


def nominal_initial(problem: Problem, model: Model) -> list[dict[str, float]]:
    """Return for each record the initial conditions that are known, shown by an output, or nominal."""
    return initial_by_record(model, problem, with_nominal_initial(problem, model, np.full(problem.unknowns, 0.5)))
