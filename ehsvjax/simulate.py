"""One trajectory of one individual: a model's equations under `lax.scan`."""

import functools
import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ehsvjax import kernels
from ehsvjax.checks import by_name, function, instance, number, whole
from ehsvjax.holds import HOLDS, at_nodes, between, course, through_nodes
from ehsvjax.integrators import repeated, scan_samples
from ehsvjax.models.check import check_equations, where_not_finite
from ehsvjax.models.model import Equations, Model, identity
from ehsvjax.record import Record, checked_record

# Of one simulation: what takes minutes.
_MOST_STEPS = 10**9


class Grid(NamedTuple):
    """How a trajectory is stepped; static, a part of what is compiled.

    Attributes:
        substeps: integration steps per sample period.
        hold: the last of `holds.HOLDS` that any input has.

    """

    substeps: int
    hold: str


def simulate(
    model: Model,
    record: Record,
    parameters: Mapping[str, float] | None = None,
    initial: Mapping[str, float] | None = None,
    *,
    substeps: int | None = None,
    signal: Callable = identity,
) -> dict[str, Float[np.ndarray, " time"]]:
    """Simulate a model over a record's time and inputs, in float64.

    Args:
        model: the model.
        record: gives time, inputs and what is known of its constants; its outputs are not looked at.
        parameters: values that differ from the nominal ones, SI.
        initial: initial conditions that differ from the nominal ones, SI.
        substeps: integration steps per sample; by default as many as the model's `max_step` asks for.
        signal: what every named signal passes through, `signal(name, value, **context) -> value`.

    Returns:
        every output of the model at the record's sample times, by name, in SI units.

    Raises:
        ValueError: for an unknown parameter, a value that is no finite number, an input that the record lacks, substeps
            below 1, or equations that cannot be simulated (`ehsvjax.models.check`). A simulation that is not finite
            from its start is no error but a warning that says what is not.

    """
    instance("model", model, Model, "make one, such as ehsvjax.servovalve()")
    checked_record(record)
    function("signal", signal, "signal(name, value, **context) -> value")
    values = changed(model, "parameters", model.nominal, parameters) | constants_of(model, record)
    start = changed(model, "initial conditions", {p.name: p.value for p in model.initial}, initial)
    grid = grid_of(model, record, substeps)
    inputs = input_array(model, record)
    with kernels.double_precision():
        as_scalars = functools.partial(jax.tree.map, jnp.float64)
        outputs = _simulate(
            model.equations,
            grid,
            signal,
            as_scalars(values),
            as_scalars(start),
            jnp.asarray(inputs),
            jnp.float64(record.sample_period),
            jnp.asarray(holds_of(model, record)),
        )
    found = {name: np.asarray(outputs[name]) for name in model.outputs}
    if not all(np.isfinite(series[:2]).all() for series in found.values()):
        step_size = record.sample_period / grid.substeps
        warnings.warn(where_not_finite(model, signal, values, start, inputs, step_size), stacklevel=2)
    return found


def changed(
    model: Model, kind: str, nominal: Mapping[str, float], changes: Mapping[str, float] | None
) -> dict[str, float]:
    """Return nominal values with changes; `kind` says what they are, "parameters" or "initial conditions".

    Raises:
        ValueError: for a name that is none of the nominal ones', or is tied, or a value that is no finite number.

    """
    changes = by_name(kind, changes, "{'mass': 20.0}")
    # All values of a model may be handed back, those of parameters that follow others among them.
    model.check_untied([name for name, value in changes.items() if value != nominal.get(name)])
    for name, value in changes.items():
        model.parameter(name)
        if name not in nominal:
            known = ", ".join(nominal) or "none"
            raise ValueError(f"expected one of the {kind} of {model.name} here, got {name!r}; they are {known}")
        changes[name] = number(name, value, remedy="give its value, SI")
    return {**nominal, **changes}


def constants_of(model: Model, record: Record) -> dict[str, float]:
    """Return what is known of a model's parameters in a record.

    Raises:
        ValueError: for a name that is no parameter of the model, or one that is tied to others.

    """
    model.check_untied(record.constants)
    for name in record.constants:
        if name not in model.nominal:
            raise ValueError(
                f"expected the constants of {record.name} to be parameters of {model.name}, "
                f"{', '.join(model.nominal)}; got {name!r}: mind the spelling"
            )
    return dict(record.constants)


def grid_of(model: Model, record: Record, substeps: int | None = None) -> Grid:
    """Return the steps per sample that the model's `max_step` asks for, and what inputs do between samples.

    Raises:
        ValueError: for substeps that are not a positive whole number, or so many that a simulation would take minutes.

    """
    if substeps is None:
        # A period that equals max_step but for rounding is one step.
        substeps = max(1, math.ceil(record.sample_period / model.max_step * (1.0 - 1e-3)))
    whole("substeps", substeps, 1)
    if substeps * len(record) > _MOST_STEPS:
        raise ValueError(
            f"expected at most {_MOST_STEPS:g} integration steps, got {len(record)} samples of {substeps:.3g} each: "
            f"take fewer substeps, or a longer max_step of {model.name} ({model.max_step} s)"
        )
    return Grid(int(substeps), max((record.hold_of(name) for name in record.inputs), key=HOLDS.index, default="zero"))


def input_array(model: Model, record: Record) -> Float[np.ndarray, "time input"]:
    """Return the record's inputs in the model's order.

    Raises:
        ValueError: if the record lacks an input of the model, or its equations cannot be simulated.

    """
    check_equations(model)
    missing = [name for name in model.inputs if name not in record.inputs]
    if missing:
        raise ValueError(
            f"expected {record.name} to hold the inputs of {model.name}, {', '.join(model.inputs)}; it lacks "
            f"{', '.join(missing)} and has {', '.join(record.inputs) or 'none'}: name its columns accordingly"
        )
    return np.array([record.inputs[name] for name in model.inputs], float).reshape(len(model.inputs), len(record)).T


def holds_of(model: Model, record: Record) -> Float[np.ndarray, " input"]:
    """Return the place in `holds.HOLDS` of what every input does between samples, in the model's order.

    What the record does not hold is held.
    """
    return np.array([float(HOLDS.index(record.hold_of(name))) for name in model.inputs])


def scan_model(
    equations: Equations,
    grid: Grid,
    signal: Callable,
    parameters: Mapping[str, Any],
    initial: Mapping[str, Any],
    inputs: Float[Array, "time input"],
    sample_period: Float[Array, ""],
    visit: Callable,
    carry: Any,
    samples: Any,
    scan: Callable = lax.scan,
    holds: Float[Array, " input"] | None = None,
):
    """Visit each sample of one trajectory: `visit(carry, outputs, sample) -> (carry, kept)`.

    Args:
        equations: the model's.
        grid: steps per sample, and what inputs do between samples.
        signal: what every named signal passes through.
        parameters: scalars by name.
        initial: scalars by name.
        inputs: in the order of `equations.inputs`.
        sample_period: s.
        visit: sees the outputs by name, at the sample itself, before the inputs act.
        carry: what `visit` accumulates.
        samples: pytree of arrays `[time, ...]`, of which `visit` sees a slice.
        scan: `lax.scan`, or what does the same.
        holds: of each input its place in `holds.HOLDS`; None: all as the grid says.

    Returns:
        the last carry, and what was kept, stacked `[time, ...]`.

    """
    given = course(inputs, holds, grid.hold)
    periods = {name: tuple(c[:, i] for c in given) for i, name in enumerate(equations.inputs)}
    periods |= _prepared(equations, grid, parameters, given, holds, sample_period)

    def inputs_at(here, fraction):
        return {name: between(course, fraction) for name, course in here.items()}

    def inputs_of(sample):
        return functools.partial(inputs_at, sample[0])

    def visit_state(carry, state, sample):
        here, rest, _ = sample
        return visit(carry, equations.measure(parameters, state, inputs_at(here, 0.0), signal), rest)

    step = equations.stepper(parameters, sample_period / grid.substeps, signal)
    first = jax.tree.map(lambda each: each[0], periods)
    state = equations.start(parameters, initial, inputs_at(first, 0.0))
    # A state may start from Python numbers or from a float32 constant; the loop needs one type throughout. A count
    # stays one.
    state = jax.tree.map(lambda leaf: leaf if _is_count(leaf) else jnp.asarray(leaf, inputs.dtype), state)
    step = repeated(step, grid.substeps)
    # A model without inputs runs as many samples all the same.
    counted = None if periods else jnp.zeros(len(inputs), inputs.dtype)
    return scan_samples(step, state, visit_state, carry, (periods, samples, counted), inputs_of, scan)


def _prepared(equations, grid, parameters, given, holds, sample_period) -> dict[str, tuple[Array, ...]]:
    """Return the course of every input that the equations change as a whole, by name."""
    if equations.prepare is None:
        return {}
    nodes = at_nodes(given)
    column = {name: i for i, name in enumerate(equations.inputs)}
    changed = equations.prepare(parameters, {name: nodes[..., i] for name, i in column.items()}, sample_period)
    return {
        name: through_nodes(series, None if holds is None else holds[column[name]], grid.hold)
        for name, series in changed.items()
    }


def _is_count(leaf) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jnp.integer)


@kernels.jit(static_argnums=(0, 1, 2))
def _simulate(equations, grid, signal, parameters, initial, inputs, sample_period, holds):
    def keep(carry, outputs, sample):
        return carry, outputs

    _, outputs = scan_model(
        equations, grid, signal, parameters, initial, inputs, sample_period, keep, None, None, holds=holds
    )
    return outputs
