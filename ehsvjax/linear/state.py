"""The state of a model, whatever its form, as a vector of real numbers; what counts steps stays apart."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float


def real_state(state: Any) -> Any:
    """Return a state with all its numbers in JAX's precision, counts as they are."""
    return jax.tree.map(lambda leaf: leaf if _counts(leaf) else jnp.asarray(leaf, float), state)


def as_vector(state: Any) -> tuple[Float[Array, " state"], Callable]:
    """Return the real numbers of a state as a vector, and how a state is made of such a vector; counts stay."""
    leaves, structure = jax.tree.flatten(state)
    real = [i for i, leaf in enumerate(leaves) if not _counts(leaf)]
    vector, unravel = ravel_pytree([leaves[i] for i in real])

    def whole(vector):
        changed = list(leaves)
        for i, leaf in zip(real, unravel(vector), strict=True):
            changed[i] = leaf
        return jax.tree.unflatten(structure, changed)

    return vector, whole


def state_names(state: Any) -> list[str]:
    """Return a name for each real number of a state: that of its field or key, with those around it."""
    names = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]:
        if _counts(leaf):
            continue
        name = jax.tree_util.keystr(path, simple=True, separator=".").removeprefix("state.")
        names += [name] if np.ndim(leaf) == 0 else [f"{name}[{i}]" for i in range(np.size(leaf))]
    return names


def _counts(leaf) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jnp.integer)
