"""What runs along the named signals of a model while it is simulated: values, and the context of each."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ehsvjax.models.check import check_equations
from ehsvjax.models.model import Equations, Model, identity
from ehsvjax.record import Record
from ehsvjax.simulate import grid_of, simulate


class Internal(NamedTuple):
    """Along one trajectory, `[time]`, or several, SI: `values` of each signal, and of its context by quantity."""

    values: dict[str, Float[np.ndarray, "*record time"]]
    contexts: dict[str, dict[str, Float[np.ndarray, "*record time"]]]


def internal_signals(
    model: Model, record: Record, parameters: Mapping[str, float], initial: Mapping[str, float]
) -> Internal:
    """Return what runs along the signals at the samples of a record, arguments as for `simulate`."""
    grid = grid_of(model, record)
    reporting = watched(model.equations, record.sample_period / grid.substeps)
    names = _names_of(model, reporting)
    seen = simulate(
        replace(
            model,
            measure=reporting.measure,
            signals=(*model.signals, *(model.signals[0]._replace(name=n, kind="sensor") for n in names)),
        ),
        record,
        parameters,
        initial,
    )
    values: dict[str, np.ndarray] = {}
    contexts: dict[str, dict[str, np.ndarray]] = {}
    for name in names:
        signal, quantity = _parts(name)
        if quantity:
            contexts[signal][quantity] = seen[name]
        else:
            values[signal] = seen[name]
            contexts.setdefault(signal, {})
    return Internal(values, contexts)


def side_by_side(trajectories: Sequence[Internal]) -> Internal:
    """Return several trajectories as `[record, time]`; the shorter ones stay where they end."""
    first = trajectories[0]

    def stacked(series):
        longest = max(map(len, series))
        return np.stack([np.pad(one, (0, longest - len(one)), mode="edge") for one in series])

    return Internal(
        {name: stacked([t.values[name] for t in trajectories]) for name in first.values},
        {
            signal: {name: stacked([t.contexts[signal][name] for t in trajectories]) for name in context}
            for signal, context in first.contexts.items()
        },
    )


def contexts_of(model: Model) -> dict[str, tuple[str, ...]]:
    """Return for each signal that a model passes values through the names of the quantities in its context.

    Raises:
        ValueError: for equations that cannot be traced.

    """
    check_equations(model)
    contexts: dict[str, tuple[str, ...]] = {}
    for name in _names_of(model, watched(model.equations, model.max_step)):
        signal, quantity = _parts(name)
        contexts[signal] = (*contexts.get(signal, ()), *((quantity,) if quantity else ()))
    return contexts


def watch_name(signal: str, quantity: str = "") -> str:
    """Return the name of the output of `watched` equations that tells of a signal, or of a quantity of its context."""
    return f"along {signal}|{quantity}"


def _parts(name: str) -> tuple[str, str]:
    signal, _, quantity = name.removeprefix("along ").rpartition("|")
    return signal, quantity


def _names_of(model: Model, reporting: Equations) -> list[str]:
    """Return the names under which the watched equations report, by tracing them once."""

    def outputs(values, initial, inputs):
        return reporting.measure(values, model.start(values, initial, inputs), inputs, identity)

    # Shapes only, no values: there is none that every parameter can have (an area, less all of it, divides by zero).
    number = jax.ShapeDtypeStruct((), jnp.float32)
    values = {p.name: number for p in model.parameters}
    initial = {p.name: number for p in model.initial}
    traced = jax.eval_shape(outputs, values, initial, dict.fromkeys(model.inputs, number))
    return [name for name in traced if name.startswith("along ")]


@functools.cache
def watched(base: Equations, step_size: float) -> Equations:
    """Return equations whose outputs tell of the signals too: each as it is at the beginning of a step."""

    def measure(parameters, state, inputs, signal):
        seen = {}

        def watching(name, value, **context):
            value = signal(name, value, **context)
            if watch_name(name) not in seen:
                seen[watch_name(name)] = value
                seen.update({watch_name(name, quantity): size for quantity, size in context.items()})
            return value

        base.stepper(parameters, step_size, watching)(state, lambda fraction: inputs)
        outputs = base.measure(parameters, state, inputs, watching)
        return outputs | {name: signal(name, jnp.asarray(value, float)) for name, value in seen.items()}

    return base._replace(measure=measure)
