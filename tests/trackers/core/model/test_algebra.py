"""Numbers written to memory before they are used."""

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.model.algebra import stored


def test_stored_arrays_keep_their_bits_and_derivatives():
    x = jnp.asarray([[-jnp.inf, 1.0, jnp.nan], [0.1, -0.0, 3.0]])
    for program in (stored, jax.jit(stored), jax.jit(jax.vmap(stored, in_axes=1, out_axes=1))):
        np.testing.assert_array_equal(np.signbit(program(x)), np.signbit(x))
        np.testing.assert_array_equal(program(x), x)
    _, tangent = jax.jit(lambda x: jax.jvp(stored, (x,), (2.0 * x,)))(x)
    np.testing.assert_array_equal(tangent, 2.0 * x)
    np.testing.assert_array_equal(jax.jit(jax.grad(lambda x: jnp.sum(3.0 * stored(x))))(x), np.full(x.shape, 3.0))


def test_the_compiler_does_not_see_through_the_condition():
    def symmetric(a):
        square = stored(a @ a)
        return square + square.T

    program = jax.jit(symmetric).lower(jnp.ones((9, 9))).compile()
    assert " conditional(" in program.as_text()
