"""Random numbers written out: the generator of jax, and normal numbers from sixteen bits each."""

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.filters.particle.filter import draws
from trackwright.trackers.core.model.inputs import threefry


def test_the_generator_is_the_one_of_jax():
    key = jax.random.key_data(jax.random.key(7))
    x, y = jnp.arange(5, dtype=jnp.uint32), jnp.full(5, 3, jnp.uint32)
    theirs = jax.extend.random.threefry_2x32(key, jnp.concatenate([x, y]))
    np.testing.assert_array_equal(jnp.concatenate(threefry(key, x, y)), theirs)


def test_normal_numbers_have_the_moments_and_the_quantiles_of_the_normal_distribution():
    key = jax.random.key_data(jax.random.key(1))
    _, _, (x, y) = jax.jit(lambda key: draws(key, 2, 200_000, jnp.float64))(key)
    for z in (np.asarray(x), np.asarray(y)):
        # Standard errors of 200,000 numbers: 0.0022, 0.0032, 0.0087 for mean, variance, and fourth moment over 3.
        assert abs(z.mean()) < 0.01
        assert abs(z.var() - 1) < 0.015
        assert abs(np.mean(z**4) / 3 - 1) < 0.04
        assert abs(np.mean(np.abs(z) > 1.959964) - 0.05) < 0.002
    assert abs(np.mean(np.asarray(x) * np.asarray(y))) < 0.01


def test_keys_follow_one_another_and_uniform_numbers_fill_the_interval():
    key, offsets = jax.random.key_data(jax.random.key(2)), []
    step = jax.jit(lambda key: draws(key, 1, 3, jnp.float32))
    for _ in range(400):
        key, offset, _ = step(key)
        offsets.append(float(offset))
    assert 0 <= min(offsets) < 0.02
    assert 0.98 < max(offsets) < 1
    assert len(set(offsets)) == 400
    assert abs(np.mean(offsets) - 0.5) < 0.05
