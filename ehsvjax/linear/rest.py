"""Where a model rests, or moves on steadily, while its inputs are constant."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jax import lax

from ehsvjax import kernels
from ehsvjax.linear.state import as_vector, state_names
from ehsvjax.linear.steps import first_order
from ehsvjax.models.model import Equations, Model, identity

# Steps of a first look, and the most.
_FIRST, _MOST = 64, 2**20
# Share of what a state has been by which it may still change its course.
_RESTS = 1e-9


def rested(model: Model, values: Mapping[str, Any], state: Any, inputs: Mapping[str, Any]) -> Any:
    """Return the state where nothing changes its course any more under constant inputs: at rest, or in steady motion.

    Raises:
        ValueError: if that does not come, with what still changes.

    """
    reach, course, steps = 0.0, None, _FIRST
    while steps <= _MOST:
        later = _after(model.equations, values, state, inputs, model.max_step, steps)
        before, after = (np.nan_to_num(np.asarray(as_vector(s)[0]), nan=0.0, posinf=np.inf) for s in (state, later))
        if not np.isfinite(np.asarray(as_vector(later)[0])).all():
            break
        reach = np.maximum(reach, np.maximum(np.abs(before), np.abs(after)))
        moved = (after - before) / steps
        if course is not None:
            # A rate at rest is but the rounding of what drives it.
            by_state = first_order(model.equations, (), values, later, inputs, model.max_step).by_state
            coupling = np.nan_to_num(np.abs(by_state - np.eye(len(after))), nan=0.0, posinf=0.0)
            changes = np.abs(moved - course) * steps / np.maximum(np.maximum(reach, coupling @ reach), 1e-300)
            if np.all(changes <= _RESTS):
                return later
        state, course, steps = later, moved, 2 * steps
    else:
        name = state_names(state)[int(np.argmax(changes))]
        raise ValueError(
            f"expected {model.name} to come to rest, or to a steady motion, where its inputs are {_in_words(inputs)}; "
            f"{name} still changes after {_MOST * model.max_step:.3g} s: start it elsewhere with initial=..., or hold "
            "the inputs at other values"
        )
    raise ValueError(
        f"expected {model.name} to come to rest where its inputs are {_in_words(inputs)}, got a simulation that is not "
        "finite: start it elsewhere with initial=..., or hold the inputs at other values"
    )


def _in_words(inputs) -> str:
    return ", ".join(f"{name} = {float(value):.6g}" for name, value in inputs.items()) or "none"


@kernels.jit(static_argnums=0)
def _after(equations: Equations, values, state, inputs, step_size, steps):
    """Return the state some steps later, under constant inputs."""
    step = equations.stepper(values, step_size, identity)
    return lax.fori_loop(0, steps, lambda _, state: step(state, lambda fraction: inputs), state)
