"""One step of a model to first order."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ehsvjax import kernels
from ehsvjax.linear.state import as_vector
from ehsvjax.models.model import Equations


class Step(NamedTuple):
    """One step to first order.

    Attributes:
        by_state, by_acting: derivatives of the state that follows, by the state and by what acts.
        outputs: at the step's beginning, in their units.
        outputs_by_state, outputs_by_acting: their derivatives.

    """

    by_state: Float[np.ndarray, "state state"]
    by_acting: Float[np.ndarray, "state input"]
    outputs: Float[np.ndarray, " output"]
    outputs_by_state: Float[np.ndarray, "output state"]
    outputs_by_acting: Float[np.ndarray, "output input"]


def first_order(
    equations: Equations,
    seen: tuple[str, ...],
    values: Mapping[str, Any],
    state: Any,
    acting: Mapping[str, Any],
    step_size: float,
) -> Step:
    """Return one step from a state, under inputs that stay as they are.

    Args:
        equations: the model's.
        seen: which of its outputs.
        values: of all parameters.
        state: at the beginning.
        acting: the inputs, and what is added to other signals, by name.
        step_size: s.

    """
    # By name a dict would come out of the compiled function in another order.
    added = jnp.stack([jnp.asarray(value, float) for value in acting.values()])
    found = _first_order(equations, seen, tuple(acting), values, state, added, step_size)
    return Step(*(np.asarray(leaf) for leaf in found))


@kernels.jit(static_argnums=(0, 1, 2))
def _first_order(equations: Equations, seen, acting, values, state, u, step_size):
    x, whole = as_vector(state)

    def apart(u):
        named = dict(zip(acting, u, strict=True))

        def signal(name, value, **context):
            return value + named[name] if name in acting and name not in equations.inputs else value

        return {name: named[name] for name in equations.inputs}, signal

    def moved(x, u):
        inputs, signal = apart(u)
        step = equations.stepper(values, step_size, signal)
        return as_vector(step(whole(x), lambda fraction: inputs))[0]

    def outputs(x, u):
        inputs, signal = apart(u)
        found = equations.measure(values, whole(x), inputs, signal)
        return jnp.array([jnp.asarray(found[name], float) for name in seen])

    return *jax.jacfwd(moved, (0, 1))(x, u), outputs(x, u), *jax.jacfwd(outputs, (0, 1))(x, u)
