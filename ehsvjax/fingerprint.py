"""What a function computes, as a digest: of its traced equations, the same in every process, whatever its names are."""

import hashlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

# Parameters of an equation that say how it is called, not what it computes.
_LABELS = frozenset(("debug_info", "name"))


def fingerprint(function: Callable, *arguments: Any) -> str:
    """Return a digest of what a function computes of arguments, and of the arguments' values.

    Constants that the function closes over count by their values, functions by their equations. What runs outside of
    JAX (a callback) counts by its place alone.

    Args:
        function: what JAX can trace.
        arguments: pytrees of arrays, random keys and numbers.

    """
    traced = jax.make_jaxpr(function)(*arguments)
    digest = hashlib.sha256(_equations(traced.jaxpr, traced.consts, {}).encode())
    for leaf in jax.tree.leaves(arguments):
        digest.update(_described(leaf, {}).encode())
    return digest.hexdigest()


def _equations(jaxpr: Jaxpr, constants: Any, known: dict[int, str]) -> str:
    """Return a digest of equations; variables go by the order in which they appear, `known` holds inner equations."""
    # The constants of inner equations are their arguments, but for those that are closed over.
    if not constants and id(jaxpr) in known:
        return known[id(jaxpr)]
    order: dict[Any, int] = {}

    def atom(one) -> str:
        value = _described(one.val, known) if isinstance(one, Literal) else str(order.setdefault(one, len(order)))
        return f"{value}:{one.aval.str_short()}"

    digest = hashlib.sha256()
    digest.update(repr([_described(value, known) for value in constants]).encode())
    digest.update(repr([atom(v) for v in (*jaxpr.constvars, *jaxpr.invars)]).encode())
    for equation in jaxpr.eqns:
        settings = {key: _described(v, known) for key, v in sorted(equation.params.items()) if key not in _LABELS}
        line = (
            equation.primitive.name,
            settings,
            [atom(v) for v in equation.invars],
            [atom(v) for v in equation.outvars],
        )
        digest.update(repr(line).encode())
    digest.update(repr([atom(v) for v in jaxpr.outvars]).encode())
    if not constants:
        known[id(jaxpr)] = digest.hexdigest()
    return digest.hexdigest()


def _described(value: Any, known: dict[int, str]) -> str:
    """Return what a value says, without anything that another process would say differently."""
    if isinstance(value, ClosedJaxpr):
        return _equations(value.jaxpr, value.consts, known)
    if isinstance(value, Jaxpr):
        return _equations(value, (), known)
    if isinstance(value, Mapping):
        return repr(sorted((str(key), _described(v, known)) for key, v in value.items()))
    if isinstance(value, set | frozenset):
        return repr(sorted(_described(v, known) for v in value))
    if isinstance(value, list | tuple):
        return repr([_described(v, known) for v in value])
    if isinstance(value, np.ndarray | jax.Array):
        is_key = jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        array = np.asarray(jax.random.key_data(value) if is_key else value)
        return f"{value.dtype}{array.shape}{hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()}"
    said = repr(value)
    # An address says nothing: a function that is no equations counts by its kind alone.
    return type(value).__qualname__ if " at 0x" in said or "object at" in said else said
