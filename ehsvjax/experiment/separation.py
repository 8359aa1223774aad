"""How far a record would drive explanations apart: by how many noise variances one cannot follow another.

If the one is true, the other is refitted to the records so far and to the new one together; what its sum of squares is
then larger by is the separation (Atkinson & Fedorov 1975, "The design of experiments for discriminating between two
rival models", T-optimality, with the records so far as what is known beforehand).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ehsvjax.fit import Fit
from ehsvjax.population import Coordinates, Problem, cast, simulated, to_unit
from ehsvjax.precision.of_fit import prepared
from ehsvjax.record import Record
from ehsvjax.refine import refine
from ehsvjax.unknowns import problem_of


class Explained(NamedTuple):
    """One explanation, made ready to simulate many experiments with.

    Attributes:
        problem: of the experiments side by side, its unknowns counted in their own sizes.
        point: `[unknown]` of that problem.
        directions: `[direction, unknown]` each parameter, and each initial condition in all experiments.
        root: `[direction, direction]` of the directions' covariance as the records so far leave it.

    """

    problem: Problem
    point: Float[Any, " unknown"]
    directions: Float[Any, "direction unknown"]
    root: Float[Any, "direction direction"]


def explained(fit: Fit, experiments: Sequence[Record], noise_variance: Mapping[str, float]) -> Explained:
    """Return an explanation made ready.

    Args:
        fit: of its model to the records so far.
        experiments: as many as are simulated side by side, alike in length; inputs and constants are put in later.
        noise_variance: of each output of theirs; +inf for one that is watched and not measured.

    """
    before = prepared(fit, "white")
    found = before.first_order.found
    known = {n: v for n, v in fit.initial[0].items() if n not in fit.estimated_initial}
    measurable = {name: variance if np.isfinite(variance) else 1.0 for name, variance in noise_variance.items()}
    problem = problem_of(fit.model, experiments, initial=known, noise_variance=measurable)
    count, starts = len(problem.free), len(problem.free_initial)
    widths = np.array([fit.model.parameter(n).upper - fit.model.parameter(n).lower for n in problem.free_initial])
    scale = np.concatenate([found.scale[:count], widths])
    values = np.array([fit.parameters[n] for n in problem.free] + [fit.initial[0][n] for n in problem.free_initial])
    each = np.concatenate([np.arange(count), np.tile(np.arange(count, count + starts), len(experiments))])
    # What is known of the parameters: by the records so far, and no less than by their bounds.
    reach = (
        np.array([fit.model.parameter(n).upper - fit.model.parameter(n).lower for n in problem.free]) / scale[:count]
    )
    information = _information(found.rows, count) / before.first_order.factor + np.diag(12.0 / reach**2)
    covariance = np.zeros((count + starts, count + starts))
    covariance[:count, :count] = np.linalg.inv(information)
    covariance[count:, count:] = np.eye(starts)
    unknown = np.arange(count + starts)[:, None] == each
    problem = replace(
        problem,
        coordinates=Coordinates(np.zeros(len(each)), scale[each], np.zeros(len(each), bool)),
        noise_variance=np.array([noise_variance[name] for name in problem.observed]),
        substeps=_finer(problem, fit),
    )
    return Explained(problem, (values / scale)[each], unknown.astype(float), np.linalg.cholesky(covariance))


def _finer(problem: Problem, fit: Fit) -> np.int32:
    """Return the integration steps per sample of a problem that are no longer than those of a fit."""
    step_size = fit.effort.step_size or float("inf")
    needed = int(np.ceil(float(np.max(problem.samples.sample_period)) / step_size * (1.0 - 1e-3)))
    return np.int32(max(int(problem.substeps), needed))


def _information(rows: Float[np.ndarray, "sample unknown"], count: int) -> Float[np.ndarray, "parameter parameter"]:
    """Return what records tell of the first so many unknowns, whatever the others are."""
    shared, own = rows[:, :count], rows[:, count:]
    if own.shape[1]:
        shared = shared - own @ np.linalg.lstsq(own, shared, rcond=None)[0]
    return shared.T @ shared


class Predicted(NamedTuple):
    """What an explanation says that experiments will show.

    Attributes:
        outputs: `[experiment, time, signal]`, in their units.
        slopes: `[direction, experiment, time, signal]` by what the records so far leave open.

    """

    outputs: Float[Array, "experiment time signal"]
    slopes: Float[Array, "direction experiment time signal"]


def predicted(
    explanation: Explained, inputs: Float[Array, "experiment time input"], constants: Mapping[str, Array]
) -> Predicted:
    """Return what an explanation predicts for experiments."""
    problem, point, directions, root = explanation
    samples = problem.samples._replace(inputs=inputs, constants=dict(constants))
    problem = replace(problem, samples=samples)

    def along(direction):
        return jax.jvp(lambda x: simulated(problem, x), (point,), (direction,))

    outputs, slopes = jax.vmap(along, out_axes=(None, 0))(directions)
    return Predicted(outputs, jnp.einsum("petn,pq->qetn", slopes, root))


def separations(
    true: Predicted, other: Predicted, noise_variance: Float[Array, " signal"]
) -> Float[Array, " experiment"]:
    """Return the separation of experiments to first order: by what the other explains worse where one is true."""
    weights = 1.0 / jnp.sqrt(noise_variance)
    difference = jnp.einsum("ets,s->ets", true.outputs - other.outputs, weights)
    slopes = jnp.einsum("pets,s->pets", other.slopes, weights)
    followed = jnp.einsum("petn,etn->ep", slopes, difference)
    gram = jnp.eye(len(slopes))[None] + jnp.einsum("petn,qetn->epq", slopes, slopes)
    taken = jnp.einsum("ep,ep->e", followed, jnp.linalg.solve(gram, followed[..., None])[..., 0])
    return jnp.einsum("etn,etn->e", difference, difference) - taken


def refitted_separation(
    true: Fit, other: Fit, new: Record, outputs: Sequence[str], noise_variance: Mapping[str, float]
) -> float:
    """Return the separation that the records so far and a new one have together, the other explanation refitted.

    Args:
        true, other: fits to the same records.
        new: the new record: inputs and constants.
        outputs: names of those that are measured in it; none for what separates them by the records so far.
        noise_variance: of each output that is measured, or was.

    """
    said = [true.simulate(record) for record in true.records]
    records = [
        replace(own, outputs={n: np.where(np.isfinite(y), one[n], np.nan) for n, y in own.outputs.items()})
        for own, one in zip(other.records, said, strict=True)
    ]
    future = true.simulate(new, true.initial[0])
    records.append(replace(new, outputs={name: future[name] for name in noise_variance}))
    return refitted_cost(other, records, noise_variance, outputs)


def refitted_cost(
    fit: Fit, records: Sequence[Record], noise_variance: Mapping[str, float], of_last: Sequence[str] | None = None
) -> float:
    """Return the sum of squares, in noise variances, of an explanation that is refitted to its records and a new one.

    Args:
        fit: from where it is refitted.
        records: those that it was fitted to, or others in their place, and the new one.
        noise_variance: of each output.
        of_last: outputs of the new record that count; by default all that it holds.

    """
    start = [*fit.initial, fit.initial[0]]
    known = [{n: v for n, v in one.items() if n not in fit.estimated_initial} for one in start]
    problem = problem_of(fit.model, records, initial=known, noise_variance=noise_variance)
    measured = problem.samples.measured.copy()
    if of_last is not None:  # one program serves whatever is measured
        measured[-1] &= np.array([name in of_last for name in problem.observed])
    values = [fit.parameters[n] for n in problem.free] + [one[n] for one in start for n in problem.free_initial]
    unit = np.clip(to_unit(problem.coordinates, np.array(values)), 0.0, 1.0)[None]
    problem = replace(problem, substeps=_finer(problem, fit), samples=problem.samples._replace(measured=measured))
    with jax.enable_x64(True):
        nothing = jnp.asarray(np.zeros(unit.shape, bool))
        return float(refine(cast(problem, jnp.float64), jnp.asarray(unit), held=nothing).cost[0])
