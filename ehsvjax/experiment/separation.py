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

from ehsvjax import kernels
from ehsvjax.fit import Fit
from ehsvjax.population import Problem, cast, in_units, simulated, to_unit
from ehsvjax.precision.of_fit import prepared
from ehsvjax.record import Record
from ehsvjax.refine import refine
from ehsvjax.unknowns import problem_of


class Explained(NamedTuple):
    """One explanation, made ready to simulate many experiments with.

    Attributes:
        problem: of the records of experiments side by side, its unknowns counted in their own sizes.
        point: `[unknown]` of that problem.
        directions: `[direction, unknown]` each parameter, and each initial condition of each record of an experiment,
            in all experiments.
        root: `[direction, direction]` of the directions' covariance as the records so far leave it.

    """

    problem: Problem
    point: Float[Any, " unknown"]
    directions: Float[Any, "direction unknown"]
    root: Float[Any, "direction direction"]


def explained(fit: Fit, records: Sequence[Record], experiments: int, noise_variance: Mapping[str, float]) -> Explained:
    """Return an explanation made ready.

    Args:
        fit: of its model to the records so far.
        records: of one experiment, alike in length; inputs and constants are put in later.
        experiments: how many are simulated side by side.
        noise_variance: of each output of theirs; +inf for one that is watched and not measured.

    """
    before = prepared(fit, "white")
    found = before.first_order.found
    measurable = {name: variance if np.isfinite(variance) else 1.0 for name, variance in noise_variance.items()}
    known = known_initial(fit, 0, len(records) * experiments)
    problem = problem_of(fit.model, list(records) * experiments, initial=known, noise_variance=measurable)
    count, starts = len(problem.free), len(problem.free_initial) * len(records)
    reach = {
        n: fit.model.parameter(n).upper - fit.model.parameter(n).lower for n in (*problem.free, *problem.free_initial)
    }
    widths = np.array([reach[n] for n in problem.free_initial] * len(records))
    scale = np.concatenate([found.scale[:count], widths])
    start = [fit.initial[0][n] for n in problem.free_initial] * len(records)
    values = np.array([fit.parameters[n] for n in problem.free] + start)
    each = np.concatenate([np.arange(count), np.tile(np.arange(count, count + starts), experiments)])
    # What is known of the parameters: by the records so far, and no less than by their bounds.
    bounds = np.array([reach[n] for n in problem.free]) / scale[:count]
    information = _information(found.rows, count) / before.first_order.factor + np.diag(12.0 / bounds**2)
    covariance = np.zeros((count + starts, count + starts))
    covariance[:count, :count] = np.linalg.inv(information)
    covariance[count:, count:] = np.eye(starts)
    unknown = np.arange(count + starts)[:, None] == each
    problem = replace(
        problem,
        coordinates=in_units(scale[each]),
        noise_variance=np.array([noise_variance[name] for name in problem.observed]),
        substeps=_finer(problem, fit),
    )
    return Explained(problem, (values / scale)[each], unknown.astype(float), np.linalg.cholesky(covariance))


def known_initial(fit: Fit, so_far: int, new: int) -> list[dict[str, float]]:
    """Return the initial conditions that are known of the first so many records so far, and of so many new ones."""
    each = (*fit.initial[:so_far], *[fit.initial[0]] * new)
    return [{n: v for n, v in one.items() if n not in fit.estimated_initial} for one in each]


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
        outputs: `[experiment, time, signal]`, in their units, the records of an experiment one after the other.
        slopes: `[direction, experiment, time, signal]` by what the records so far leave open.

    """

    outputs: Float[Array, "experiment time signal"]
    slopes: Float[Array, "direction experiment time signal"]


def predicted(
    explanation: Explained,
    inputs: Float[Array, "experiment record time input"],
    constants: Mapping[str, Float[Array, "experiment record"]],
) -> Predicted:
    """Return what an explanation predicts for experiments."""
    problem, point, directions, root = explanation
    side_by_side = {name: values.reshape(-1) for name, values in constants.items()}
    samples = problem.samples._replace(inputs=inputs.reshape(-1, *inputs.shape[2:]), constants=side_by_side)
    problem = replace(problem, samples=samples)

    def shown(x):
        outputs = simulated(problem, x)
        return outputs.reshape(len(inputs), -1, outputs.shape[-1])

    outputs, slopes = jax.vmap(lambda along: jax.jvp(shown, (point,), (along,)), out_axes=(None, 0))(directions)
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


def as_said(fit: Fit, records: Sequence[Record], outputs: Sequence[str]) -> list[Record]:
    """Return new records with what an explanation says that they will show."""
    said = [fit.simulate(record, fit.initial[0]) for record in records]
    return [
        replace(record, outputs={name: one[name] for name in outputs})
        for record, one in zip(records, said, strict=True)
    ]


def as_said_so_far(fit: Fit) -> list[Record]:
    """Return the records that an explanation was fitted to with what it says of them, wherever they were measured."""
    said = [fit.simulate(record) for record in fit.records]
    return [
        replace(record, outputs={n: np.where(np.isfinite(y), one[n], np.nan) for n, y in record.outputs.items()})
        for record, one in zip(fit.records, said, strict=True)
    ]


def refitted_cost(
    fit: Fit, records: Sequence[Record], noise_variance: Mapping[str, float], of_new: Sequence[str] | None = None
) -> float:
    """Return the sum of squares, in noise variances, of an explanation that is refitted to its records and new ones.

    Where the records are as another explanation says (`as_said_so_far`, `as_said`), it is the separation of the two.

    Args:
        fit: from where it is refitted.
        records: those that it was fitted to, or others in their place, and the new ones.
        noise_variance: of each output.
        of_new: outputs of the new records that count; by default all that they hold.

    """
    so_far, new = len(fit.records), len(records) - len(fit.records)
    known = known_initial(fit, so_far, new)
    problem = problem_of(fit.model, records, initial=known, noise_variance=noise_variance)
    measured = problem.samples.measured.copy()
    if of_new is not None:  # one program serves whatever is measured
        measured[so_far:] &= np.array([name in of_new for name in problem.observed])
    values = [fit.parameters[n] for n in problem.free] + [
        one[n] for one in (*fit.initial, *[fit.initial[0]] * new) for n in problem.free_initial
    ]
    unit = np.clip(to_unit(problem.coordinates, np.array(values)), 0.0, 1.0)[None]
    problem = replace(problem, substeps=_finer(problem, fit), samples=problem.samples._replace(measured=measured))
    with kernels.double_precision():
        nothing = jnp.asarray(np.zeros(unit.shape, bool))
        return float(refine(cast(problem, jnp.float64), jnp.asarray(unit), held=nothing).cost[0])
