"""From a model and an operating point to its linear model."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ehsvjax import kernels
from ehsvjax.checks import by_name, instance, number, refused
from ehsvjax.effects.internal import watch_name, watched
from ehsvjax.linear.limit import continuous
from ehsvjax.linear.model import LinearModel
from ehsvjax.linear.rest import rested
from ehsvjax.linear.state import as_vector, real_state, state_names
from ehsvjax.linear.steps import Step, first_order
from ehsvjax.models.check import check_equations
from ehsvjax.models.model import Model
from ehsvjax.simulate import changed


def linearise(
    model: Model,
    at: Mapping[str, float] | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
    initial: Mapping[str, float] | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
) -> LinearModel:
    """Return the linear model of small deviations about where a model rests, or moves on steadily, in float64.

    Args:
        model: the model.
        at: the inputs, held constant, by name; those that are not given are zero.
        parameters: values that differ from the nominal ones, SI.
        initial: initial conditions from which it comes to rest, where they differ from the nominal ones, SI.
        inputs: what acts: inputs of the model, or any of its signals, to which the deviation is added (a "load_force");
            by default the inputs.
        outputs: what is seen: outputs of the model, or any of its signals; by default the outputs.

    Raises:
        ValueError: for names that the model does not have, values that are no numbers, equations that cannot be
            simulated, an effect on a whole input (a delay, which no state space has), or a model that does not come to
            rest there, or has no slopes where it does.

    """
    instance("model", model, Model, "make one, such as ehsvjax.servovalve()")
    check_equations(model)
    if model.prepare is not None:
        raise ValueError(
            f"expected a model whose inputs act as they are, got {model.name}, which changes whole inputs beforehand: "
            "linearise the model without that effect, and put it before the result"
        )
    values = changed(model, "parameters", model.nominal, parameters)
    start = changed(model, "initial conditions", {p.name: p.value for p in model.initial}, initial)
    held = dict.fromkeys(model.inputs, 0.0) | by_name("at", at, '{"command": 1e-3}')
    for name, value in held.items():
        if name not in model.inputs:
            raise ValueError(f"expected inputs of {model.name}, {', '.join(model.inputs)}; got {name!r}")
        held[name] = number(name, value, remedy="give its value, SI")
    acting = _names(model, "inputs", inputs, model.inputs)
    seen = _names(model, "outputs", outputs, model.outputs)
    added = [name for name in acting if name not in model.inputs]
    equations = watched(model.equations, model.max_step)
    reported = tuple(name if name in model.outputs else watch_name(name) for name in seen)
    with kernels.double_precision():
        as_scalars = functools.partial(jax.tree.map, jnp.float64)
        constants, constant_inputs = as_scalars(values), as_scalars(held)
        state = real_state(equations.start(constants, as_scalars(start), constant_inputs))
        state = rested(model, constants, state, constant_inputs)
        disturbed = constant_inputs | as_scalars(dict.fromkeys(added, 0.0))
        step_of = functools.partial(first_order, equations, reported, constants, state, disturbed)
        names, values_there = state_names(state), np.asarray(as_vector(state)[0]).tolist()
        _check_slopes(model, step_of(model.max_step), [*names, *seen])
        kept, (a, b, c, d) = continuous(step_of, model.max_step)
        point = held | dict(zip(names, values_there, strict=True))
        point |= dict(zip(seen, step_of(model.max_step).outputs.tolist(), strict=True))
    columns = [list(disturbed).index(name) for name in acting]
    return LinearModel(a, b[:, columns], c, d[:, columns], tuple(names[i] for i in kept), acting, seen, point)


def _check_slopes(model: Model, step: Step, named: Sequence[str]) -> None:
    """Refuse a point where the equations have no slope, as a root has none at zero; names of states, then outputs."""
    slopes = np.block([[step.by_state, step.by_acting], [step.outputs_by_state, step.outputs_by_acting]])
    endless = [name for name, row in zip(named, slopes, strict=True) if not np.isfinite(row).all()]
    if endless:
        raise ValueError(
            f"expected {model.name} to have slopes at its operating point, got none of {', '.join(endless)}, as at a "
            "kink or the end of a root: hold the inputs at other values"
        )


def _names(model: Model, what: str, names: Any, usual: tuple[str, ...]) -> tuple[str, ...]:
    if names is None:
        return usual
    if isinstance(names, str) or not isinstance(names, Sequence) or not names:
        raise refused(what, "names of signals", names, "give them in a list, [name, ...]")
    for name in names:
        model.unit(name)
    return tuple(names)
