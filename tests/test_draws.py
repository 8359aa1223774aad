"""Random numbers: those of jax.random, for one key and many, few and many numbers, whatever the generator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ehsvjax import draws

KEY = jax.random.key(11)
SHAPES = [(7,), (101, 3), (2, 50, 4), (300, 400)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("generator", ["threefry2x32", "rbg"])
def test_uniform_numbers_are_those_of_jax(shape, generator):
    key = jax.random.key(3, impl=generator)
    ours = jax.jit(lambda key: draws.uniform(key, shape, lower=-2.0, upper=3.0))(key)
    flat = jax.random.uniform(key, (int(np.prod(shape)),), minval=-2.0, maxval=3.0)
    np.testing.assert_array_equal(ours, flat.reshape(shape))


def test_new_keys_are_those_of_jax():
    ours = jax.jit(lambda key: draws.split(key, 5))(KEY)
    np.testing.assert_array_equal(jax.random.key_data(ours), jax.random.key_data(jax.random.split(KEY, 5)))
    assert jax.random.key_impl(ours) == jax.random.key_impl(KEY)


@pytest.mark.parametrize("keys", [3, 5000])
def test_many_keys_at_once_give_what_each_gives_alone(keys):
    # So many that XLA shares the work out to threads.
    several = jax.random.split(KEY, keys)
    together = jax.jit(jax.vmap(lambda key: draws.uniform(key, (40,))))(several)
    for i in (0, keys - 1):
        np.testing.assert_array_equal(together[i], draws.uniform(several[i], (40,)))


@pytest.mark.parametrize("size", [300, 100_000])
def test_whole_numbers_are_equally_likely(size):
    drawn = np.asarray(jax.jit(lambda key: draws.integers(key, (size,), 7))(KEY))
    assert set(drawn) == set(range(7))
    assert stats.chisquare(np.bincount(drawn)).pvalue > 1e-6


def test_normal_numbers_have_the_normal_distribution_and_no_infinity():
    uniform = jax.random.uniform(KEY, (100_000,))
    assert stats.kstest(np.asarray(draws.normal_from(uniform)), "norm").pvalue > 1e-6
    assert bool(jnp.all(jnp.isfinite(draws.normal_from(jnp.array([0.0, 1.0 - 2.0**-24], jnp.float32)))))
