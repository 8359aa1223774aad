"""Random numbers of the genetic algorithm, in a few calls for flat arrays: they are most of what a search compiles.

XLA takes 0.38 s to compile Threefry over two axes, 0.13 s over one and 0.07 s as one native function, for each call
anew. The numbers of `uniform` are those that `jax.random.uniform` gives.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int, Key

from ehsvjax import kernels
from ehsvjax.checks import refused

# XLA shares larger arrays out to threads, which a native function cannot.
_MOST_IN_A_KERNEL = 16384


def check_key(key) -> None:
    """Refuse what is no random key.

    Raises:
        ValueError: for anything but `jax.random.key(...)` or `jax.random.PRNGKey(...)`.

    """
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ()
    raw = isinstance(key, jax.Array) and key.dtype == jnp.uint32 and key.shape == (2,)
    if not (typed or raw):
        raise refused("key", "a random key such as jax.random.key(0)", key, "make one of a whole number, the seed")


def split(key: Key[Array, ""], count: int) -> Key[Array, " count"]:
    """Return new keys, those of `jax.random.split`."""
    generator = jax.random.key_impl(key)
    keys = _drawn(lambda key: jax.random.key_data(jax.random.split(key, count)), key, count)
    return jax.random.wrap_key_data(keys, impl=generator)


def uniform(
    key: Key[Array, ""], shape: tuple[int, ...], dtype=jnp.float32, lower: float = 0.0, upper: float = 1.0
) -> Float[Array, "..."]:
    """Return numbers uniform in [lower, upper)."""
    count = math.prod(shape)
    return _drawn(lambda key: jax.random.uniform(key, (count,), dtype, lower, upper), key, count).reshape(shape)


def integers(key: Key[Array, ""], shape: tuple[int, ...], count: int) -> Int[Array, "..."]:
    """Return whole numbers from 0 to count - 1, each as likely as the others to within count / 2^32."""
    size = math.prod(shape)
    bits = _drawn(lambda key: jax.random.bits(key, (size,), jnp.uint32), key, size)
    return (bits % jnp.uint32(count)).astype(jnp.int32).reshape(shape)


def normal_from(uniform: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return standard normal numbers made of uniform ones in [0, 1)."""
    # Zero would be minus infinity.
    above = jnp.maximum(2.0 * uniform - 1.0, -1.0 + jnp.finfo(uniform.dtype).epsneg)
    return 2.0**0.5 * lax.erf_inv(above)


def _drawn(draw: Callable, key: Key[Array, ""], count: int) -> Array:
    """Return `draw(key)`, in one kernel for not too many numbers by Threefry; other generators call libraries."""
    generator = str(jax.random.key_impl(key))
    if generator != "threefry2x32" or count > _MOST_IN_A_KERNEL:
        return draw(key)

    def from_data(data):
        return draw(jax.random.wrap_key_data(data, impl=generator))

    in_kernel = custom_vmap(kernels.one_kernel(from_data))

    @in_kernel.def_vmap
    def for_many_keys(count, batched, data):
        del count, batched
        return jax.vmap(from_data)(data), True

    return in_kernel(jax.random.key_data(key))
