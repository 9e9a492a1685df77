"""Sparse Jacobians against jax's own dense ones, and the zeros that structure promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import ConstantVelocity, Kinematic
from trackwright.trackers.core.model.state import Rotation, wrap

POINT = [0.7, -1.3, 2.1]


@jax.jit
def _inner(a, b):
    return a * jnp.sin(b), a + 2.0


@jax.jit
def _nested(a, b):
    p, q = _inner(a, b * 3.0)
    return _inner(q, p)[0]


FUNCTIONS = {
    "products": lambda x, y, z: [x * y * z, x - y, -z, x + x],
    "cos and division": lambda x, y, z: [jnp.cos(x) / y, x / (y * y + 1.0), 1.0 / z],
    "where": lambda x, y, z: [jnp.where(x > 0, x * y, z), jnp.where(x < 0, x * y, z), jnp.where(y > 0, y, 2.0)],
    "nested jit": lambda x, y, z: [_nested(x, y), _nested(z, x) * y],
    "constants": lambda x, y, z: [jnp.asarray(3.0), x * 0.0 + 1.0, jnp.asarray(2.0) * z],
    "roots and powers": lambda x, y, z: [jnp.sqrt(x * x + y * y), x**3, jnp.hypot(y, z), jnp.exp(y) * jnp.log(z)],
    "arrays inside": lambda x, y, z: list(jnp.linalg.inv(jnp.array([[2.0, 0.5], [0.5, 3.0]])) @ jnp.stack([x * y, z])),
    "sums and indexing": lambda x, y, z: [jnp.sum(jnp.stack([x, y, z]) ** 2), jnp.stack([x, y, z])[::-1][0] * y],
    "wrap and arctan2": lambda x, y, z: [wrap(4.0 * x), jnp.arctan2(y, z), jnp.maximum(x, z), jnp.abs(y)],
    "stop_gradient": lambda x, y, z: [x * jax.lax.stop_gradient(y), y - jax.lax.stop_gradient(y), z],
    "rotation": lambda x, y, z: list(Rotation.exp([x, y, z]).apply(Vector(1.0, 2.0, 3.0))),
    "loop": lambda x, y, z: [jax.lax.fori_loop(0, 3, lambda _, v: v * y + x, z)],
    "cond": lambda x, y, z: [jax.lax.cond(x > 0, lambda a, b: a * b, lambda a, b: a + b, y, z)],
}


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS.keys())
def test_values_and_jacobians_are_those_of_jacfwd(function):
    def stacked(x):
        return jnp.stack(function(*x))

    (values, rows), plain, expected = jax.jit(
        lambda x: (linearise(function, list(x)), stacked(x), jax.jacfwd(stacked)(x))
    )(jnp.array(POINT))
    np.testing.assert_allclose(values, plain, rtol=1e-14)
    dense = np.array([[float(row.get(j, 0.0)) for j in range(3)] for row in rows])
    np.testing.assert_allclose(dense, expected, rtol=1e-12, atol=1e-14)


def test_under_vmap_each_trajectory_has_its_own_jacobian():
    trajectories = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)))
    function = FUNCTIONS["where"]

    def jacobian(x):
        rows = linearise(function, list(x))[1]
        return jnp.stack([jnp.stack([x[0] * 0.0 + row.get(j, 0.0) for j in range(3)]) for row in rows])

    expected = jax.jit(jax.vmap(jax.jacfwd(lambda x: jnp.stack(function(*x)))))(trajectories)
    np.testing.assert_allclose(jax.jit(jax.vmap(jacobian))(trajectories), expected, rtol=1e-14)


def test_a_constant_velocity_step_has_its_structural_zeros_and_ones():
    def step(x, y, vx, vy, *w):
        moved = ConstantVelocity(0.5, 2).step(
            Kinematic(Vector(x, y), Vector(vx, vy)), None, jnp.asarray(0.1), Vector(*w)
        )
        return [*moved.position, *moved.velocity]

    _, rows = linearise(step, list(jnp.arange(8, dtype=float)))
    assert [sorted(row) for row in rows] == [[0, 2, 4, 6], [1, 3, 5, 7], [2, 4], [3, 5]]
    # A one that follows from the structure is a Python number: multiplying with it costs nothing.
    assert all(type(rows[k][k]) is float and rows[k][k] == 1.0 for k in range(4))
