"""The whole population at once: the only room that vmaps the simulation.

A `Problem` is everything that a simulation needs but the candidates: the records, the noise, what is known, and the
coordinates of what is not. Its arrays may change without compiling again.

An individual is a point of the unit cube, one coordinate per unknown: the free parameters first, then, of each record
in turn, those that are its own and its unknown initial conditions.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float

from ehsvjax import kernels
from ehsvjax.holds import HOLDS, continued
from ehsvjax.models.model import Equations, Model, Parameter, identity
from ehsvjax.record import Record
from ehsvjax.simulate import Grid, constants_of, grid_of, holds_of, input_array, scan_model

# Samples whose squares are added up plainly before the sum is added to the rest.
_SUMMED_TOGETHER = 64


class Samples(NamedTuple):
    """Records side by side, padded at the end to the longest; `measured` is False where there is no sample.

    `holds` are places in `holds.HOLDS`, of what each input does between samples. `constants` are the parameters that
    are known in some record, by name; NaN in the others.
    """

    inputs: Float[Any, "record time input"]
    outputs: Float[Any, "record time signal"]
    measured: Bool[Any, "record time signal"]
    sample_period: Float[Any, " record"]
    holds: Float[Any, "record input"]
    constants: dict[str, Float[Any, " record"]]


class Coordinates(NamedTuple):
    """How a point of the unit cube becomes values: between bounds, on a straight or on a logarithmic scale.

    The logarithm is that of the value plus an `offset`, between the bounds plus the same.
    """

    lower: Float[Any, " parameter"]
    upper: Float[Any, " parameter"]
    logarithmic: Bool[Any, " parameter"]
    offset: Float[Any, " parameter"]


class Priors(NamedTuple):
    """What is known of each unknown beforehand, as if it had been measured: an infinite deviation knows nothing."""

    mean: Float[Any, " parameter"]
    deviation: Float[Any, " parameter"]


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=["samples", "noise_variance", "coordinates", "known", "known_initial", "substeps", "priors"],
    meta_fields=["equations", "grid", "observed", "free", "free_initial", "huber", "free_by_record"],
)
@dataclass(frozen=True)
class Problem:
    """What a candidate is judged against.

    Attributes:
        samples: the records.
        noise_variance: `[signal]` of each observed output, in its unit squared.
        coordinates: of the unknowns.
        known: value of every parameter that is not free, by name.
        known_initial: `[record]` value of every initial condition that is not free, by name.
        equations, grid: the model's, static.
        observed: names of the outputs that some record holds, static; the others are never computed.
        free: names of the free parameters, static.
        free_initial: names of the initial conditions that are free, static.
        huber: residuals beyond this many standard deviations weigh linearly (Huber 1964); None: squares; static.
        substeps: integration steps per sample as data, for one program at any step; None: as many as the grid says.
        free_by_record: names of parameters that are free and may be another in every record, static.
        priors: of the unknowns; None where nothing is known of any.

    """

    samples: Samples
    noise_variance: Float[Any, " signal"]
    coordinates: Coordinates
    known: dict[str, Any]
    known_initial: dict[str, Any]
    equations: Equations
    grid: Grid
    observed: tuple[str, ...]
    free: tuple[str, ...]
    free_initial: tuple[str, ...]
    huber: float | None
    substeps: Any = None
    free_by_record: tuple[str, ...] = ()
    priors: Priors | None = None

    @property
    def names(self) -> list[str]:
        """Name of the unknown of each coordinate; of what each record has for itself, `name[record]`."""
        own = (*self.free_by_record, *self.free_initial)
        return [*self.free, *(f"{name}[{k}]" for k in range(len(self.samples.inputs)) for name in own)]

    @property
    def unknowns(self) -> int:
        """Number of coordinates of an individual."""
        return len(self.names)


def observed_outputs(model: Model, records: Sequence[Record]) -> tuple[str, ...]:
    """Return the names of the outputs that at least one record holds, in the model's order.

    Raises:
        ValueError: if a record holds none, or one that the model does not have.

    """
    for record in records:
        unknown = [name for name in record.outputs if name not in model.outputs]
        if unknown or not record.outputs:
            raise ValueError(
                f"expected the outputs of {record.name} to be among those of {model.name}, "
                f"{', '.join(model.outputs)}; got {', '.join(unknown) or 'none'}: name its columns accordingly, or "
                "drop them with .select"
            )
    return tuple(name for name in model.outputs if any(name in record.outputs for record in records))


def stack_records(model: Model, records: Sequence[Record]) -> tuple[Samples, Grid]:
    """Return the records as arrays `[record, time, ...]` in NumPy float64, with the grid that serves them all.

    The signals are those of `observed_outputs`; where a record does not hold one of them, nothing is measured.

    Raises:
        ValueError: if a record lacks an input, or holds outputs or constants that the model does not have.

    """
    longest = max(len(record) for record in records)

    def measured(record):
        absent = np.full(len(record), np.nan)
        outputs = np.stack([record.outputs.get(name, absent) for name in observed], axis=-1)
        return np.pad(outputs, ((0, longest - len(record)), (0, 0)), constant_values=np.nan)

    observed = observed_outputs(model, records)
    constants = [constants_of(model, record) for record in records]
    stacked = np.stack([measured(record) for record in records])
    samples = Samples(
        inputs=np.stack([continued(input_array(model, record), longest) for record in records]),
        outputs=np.nan_to_num(stacked, nan=0.0),
        measured=np.isfinite(stacked),
        sample_period=np.array([record.sample_period for record in records]),
        holds=np.array([holds_of(model, record) for record in records]),
        constants={
            name: np.array([c.get(name, np.nan) for c in constants]) for name in sorted(set().union(*constants))
        },
    )
    grids = [grid_of(model, record) for record in records]
    return samples, Grid(max(grid.substeps for grid in grids), max((grid.hold for grid in grids), key=HOLDS.index))


def coordinates_of(parameters: Sequence[Parameter]) -> Coordinates:
    """Return the coordinates of unknowns within their bounds, in NumPy float64."""
    return Coordinates(
        lower=np.array([p.lower for p in parameters], float),
        upper=np.array([p.upper for p in parameters], float),
        logarithmic=np.array([p.scale == "log" for p in parameters], bool),
        offset=np.zeros(len(parameters)),
    )


def in_units(units: Float[np.ndarray, " parameter"]) -> Coordinates:
    """Return the coordinates that count values in units, from zero."""
    nothing = np.zeros(len(units))
    return Coordinates(nothing, units, nothing.astype(bool), nothing)


def to_values(coordinates: Coordinates, individuals: Float[Any, "*batch parameter"]):
    """Return the values `[..., parameter]`, SI, of individuals in the unit cube; NumPy for NumPy."""
    xp = np if isinstance(individuals, np.ndarray) else jnp
    lower, upper, logarithmic, offset = (xp.broadcast_to(c, xp.shape(individuals)) for c in coordinates)
    # Both branches stay finite, so that neither spoils the derivative of the other.
    least = xp.where(logarithmic, lower + offset, 1.0)
    ratio = xp.where(logarithmic, upper + offset, 1.0) / least
    logarithmic_values = least * xp.exp(individuals * xp.log(ratio)) - offset
    return xp.where(logarithmic, logarithmic_values, lower + individuals * (upper - lower))


def to_unit(coordinates: Coordinates, values: Float[Any, "*batch parameter"]):
    """Return the individuals `[..., parameter]` in the unit cube that have these values, SI; NumPy for NumPy."""
    xp = np if isinstance(values, np.ndarray) else jnp
    lower, upper, logarithmic, offset = (xp.broadcast_to(c, xp.shape(values)) for c in coordinates)
    least = xp.where(logarithmic, lower + offset, 1.0)
    ratio = xp.where(logarithmic, upper + offset, 2.0) / least
    relative = xp.where(logarithmic, values + offset, 1.0) / least
    return xp.where(logarithmic, xp.log(relative) / xp.log(ratio), (values - lower) / (upper - lower))


def cast(problem: Problem, dtype) -> Problem:
    """Return the problem with its arrays on the device, floating-point ones in this precision."""

    def converted(leaf):
        leaf = np.asarray(leaf)
        return jnp.asarray(leaf, dtype if np.issubdtype(leaf.dtype, np.floating) else leaf.dtype)

    return jax.tree.map(converted, problem)


def population_cost(problem: Problem, individuals: Float[Array, "individual parameter"]) -> Float[Array, " individual"]:
    """Cost of every individual: the sum of squares of its standardised residuals, over records, time and outputs.

    What is known of unknowns beforehand counts as further readings.

    Standardised residuals are divided by the noise's standard deviation, so that the truth costs about the number of
    samples; beyond `huber` they weigh linearly. No trajectory is stored. A simulation that fails costs +inf.
    It can be differentiated by the individuals, once; not by the problem.
    """

    def costs_by_record(individual):
        parameters, own = _split(problem, individual)
        return jax.vmap(functools.partial(_record_cost, problem, parameters))(own, problem.samples)

    def gradients_by_record(rows):
        # The tangents' axis comes first and the individuals stay side by side, as in the cost.
        def along(direction):
            return jax.jvp(jax.vmap(costs_by_record), (rows,), (jnp.broadcast_to(direction, rows.shape),))[1]

        return jax.vmap(along, out_axes=2)(jnp.eye(problem.unknowns, dtype=rows.dtype))

    def by_record(rows):
        return kernels.in_blocks(jax.vmap(costs_by_record), rows)

    def differential(rows, tangents):
        # Forward, by every unknown in one pass: backward, as JAX would, takes ten times as long.
        gradients = kernels.in_blocks(gradients_by_record, rows[0])
        return by_record(*rows), jnp.einsum("irp,ip->ir", gradients, tangents[0])

    cost = jax.custom_jvp(by_record)
    cost.defjvp(differential)
    total = jnp.sum(cost(individuals), axis=1)
    if problem.priors is not None:
        total = total + jnp.sum(prior_residuals(problem, individuals) ** 2, axis=1)
    return jnp.where(jnp.isnan(total), jnp.inf, total)


def prior_residuals(
    problem: Problem, individuals: Float[Array, "individual parameter"]
) -> Float[Array, "individual parameter"]:
    """How far each unknown lies from what is known of it, in standard deviations; the problem has priors."""
    assert problem.priors is not None
    return (to_values(problem.coordinates, individuals) - problem.priors.mean[None]) / problem.priors.deviation[None]


@functools.cache
def shared_cost(devices: tuple[jax.Device, ...], gathered: bool = True) -> Callable:
    """Return `population_cost` with the individuals shared out to devices; the same function for the same devices.

    Args:
        devices: those that share the work.
        gathered: give every device all costs, as breeding from them needs; otherwise they stay where they were computed
            (gathering them takes 0.3 ms on two CPU devices).

    """
    mesh = Mesh(np.array(devices), ("individual",))
    rows, alike = PartitionSpec("individual"), PartitionSpec()
    # Only the cost is shared out: what is bred from it is the same work on every device, and cheaper than a message.
    everywhere = functools.partial(lax.with_sharding_constraint, shardings=NamedSharding(mesh, alike))

    def cost(problem: Problem, individuals):
        filled = everywhere(kernels.filled_up(individuals, len(devices) * kernels.VECTOR))
        here = jax.shard_map(population_cost, mesh=mesh, in_specs=(alike, rows), out_specs=rows, check_vma=False)
        costs = here(problem, filled)
        return everywhere(costs)[: len(individuals)] if gathered else costs[: len(individuals)]

    return cost


def residuals(problem: Problem, individual: Float[Array, " parameter"]) -> Float[Array, "record time signal"]:
    """Standardised residuals of one individual, measured minus simulated; zero where there is no sample."""
    samples = problem.samples
    difference = (samples.outputs - simulated(problem, individual)) / jnp.sqrt(problem.noise_variance)[None, None, :]
    return jnp.where(samples.measured, difference, 0.0)


def simulated(problem: Problem, individual: Float[Array, " parameter"]) -> Float[Array, "record time signal"]:
    """Observed outputs of one individual on every record, in their units."""

    def keep(carry, outputs, sample):
        return carry, [outputs[name] for name in problem.observed]

    def trajectory(own, samples):
        return jnp.stack(_scan(problem, parameters, own, samples, keep, None, None)[1], axis=-1)

    parameters, own = _split(problem, individual)
    return jax.vmap(trajectory)(own, problem.samples)


def _record_cost(problem: Problem, parameters, own, samples: Samples):
    scale = list(1.0 / jnp.sqrt(problem.noise_variance))

    def accumulate(total, outputs, sample):
        for name, per_deviation, (reading, measured) in zip(problem.observed, scale, sample, strict=True):
            square = robust_square(per_deviation * (reading - outputs[name]), problem.huber)
            total = total + jnp.where(measured, square, 0.0)
        return total, None

    zero = jnp.zeros((), samples.outputs.dtype)
    rest = [(samples.outputs[:, i], samples.measured[:, i]) for i in range(len(scale))]
    return _scan(problem, parameters, own, samples, accumulate, zero, rest, _scan_by_parts)[0]


def _scan_by_parts(body: Callable, carry: Any, samples: Any):
    """Scan with a state and a sum; the sum starts anew for every few samples, and the sums are added with compensation.

    In float32 a plain sum over a million samples would lose its last digits, and compensating each sample costs a tenth
    of the whole simulation on a CPU. The samples that fill up the last part are not measured.
    """
    count = len(jax.tree.leaves(samples)[0])
    parts = -(-count // _SUMMED_TOGETHER)
    length = -(-count // parts)

    def by_part(leaf):
        return jnp.pad(leaf, (0, parts * length - count)).reshape(parts, length)

    def whole_part(both, samples):
        return lax.scan(body, both, samples)[0], None

    def compensated(carry, samples):
        state, total, lost = carry
        (state, part), _ = one_part((state, jnp.zeros_like(total)), samples)
        # Kahan (1965): what the last addition lost is taken off the next term.
        term = part - lost
        following = total + term
        return (state, following, (following - total) - term), None

    one_part = body if kernels.in_registers() else whole_part
    samples = samples if kernels.in_registers() else jax.tree.map(by_part, samples)
    state, total = carry
    (state, total, _), _ = kernels.scan(compensated, (state, total, jnp.zeros_like(total)), samples)
    return (state, total), None


def robust_square(standardised: Float[Array, "..."], huber: float | None) -> Float[Array, "..."]:
    """Return the square, or twice Huber's function: r^2 within `huber`, 2*huber*|r| - huber^2 beyond."""
    if huber is None:
        return standardised**2
    size = jnp.abs(standardised)
    return jnp.where(size > huber, 2.0 * huber * size - huber**2, standardised**2)


def huber_weight(standardised: Float[Array, "..."], huber: float | None) -> Float[Array, "..."]:
    """Return the weight of each standardised residual: 1, or `huber`/|r| beyond `huber`."""
    if huber is None:
        return jnp.ones_like(standardised)
    return huber / jnp.maximum(jnp.abs(standardised), huber)


def _scan(problem: Problem, parameters, own, samples: Samples, visit, carry, rest, scan=kernels.scan):
    here = {n: jnp.where(jnp.isnan(value), parameters[n], value) for n, value in samples.constants.items()}
    here |= {n: own[n] for n in problem.free_by_record}
    initial = {n: value for n, value in own.items() if n not in problem.free_by_record}
    return scan_model(
        problem.equations._replace(stepper=_stored_once(problem.equations.stepper)),
        problem.grid if problem.substeps is None else problem.grid._replace(substeps=problem.substeps),
        identity,
        parameters | here,
        initial,
        samples.inputs,
        samples.sample_period,
        visit,
        carry,
        rest,
        scan,
        samples.holds,
    )


def _stored_once(stepper):
    """Return the stepper with steps that compute no value twice."""

    def tuned(parameters, step_size, signal):
        step = stepper(parameters, step_size, signal)
        return lambda state, inputs: kernels.stored_once(lambda state: step(state, inputs))(state)

    return tuned


def _split(problem: Problem, individual) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return parameters by name, and by name `[record]` what each has for itself: initial conditions, parameters."""
    values = to_values(problem.coordinates, individual)
    count = len(problem.free)
    parameters = problem.known | dict(zip(problem.free, values[:count], strict=True))
    own = (*problem.free_by_record, *problem.free_initial)
    by_record = values[count:].reshape(problem.samples.inputs.shape[0], len(own))
    return parameters, problem.known_initial | dict(zip(own, by_record.T, strict=True))
