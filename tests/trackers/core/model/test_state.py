"""Curved leaves: retract and local undo each other, and both agree with matrices and quaternions of NumPy."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles import exponential
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.state import (
    Heading,
    Rotation,
    coordinates,
    dimension,
    local,
    retract,
    steps_of,
    wrap,
)

NUMBER = st.floats(-1.7, 1.7)
VECTOR = st.tuples(NUMBER, NUMBER, NUMBER)
# From steps whose square is denormal to half turns.
SIZE = st.sampled_from([1e-200, 1e-12, 9e-5, 1.1e-4, 1e-3, 1.0])


class Pose(NamedTuple):
    attitude: Rotation
    position: Vector
    bias: jax.Array
    heading: Heading
    speed: float


def _pose(vector):
    return Pose(
        Rotation.exp(vector), Vector(1.0, 2.0), jnp.array([0.1, -0.2]), Heading(jnp.asarray(3.0)), jnp.asarray(0.5)
    )


exp = jax.jit(lambda v: jax.tree_util.tree_leaves(Rotation.exp(v)))
log_of_exp = jax.jit(lambda v: Rotation.exp(v).log())
turned = jax.jit(lambda v, x: list(Rotation.exp(v).apply(Vector(*x))))
round_trip = jax.jit(lambda v, step: local(_pose(v), retract(_pose(v), step)))
inverse_trip = jax.jit(
    lambda u, v: list(Rotation.exp(u).retract(Rotation.exp(u).local(Rotation.exp(v))).apply(Vector(1.0, 2.0, 3.0)))
)


@settings(max_examples=100, deadline=None)
@given(VECTOR, SIZE)
def test_log_undoes_exp(vector, size):
    vector = np.array(vector) * size
    np.testing.assert_allclose(log_of_exp(list(vector)), vector, rtol=1e-12, atol=1e-300)


@settings(max_examples=60, deadline=None)
@given(VECTOR, VECTOR, SIZE)
def test_a_rotation_turns_vectors_like_the_exponential_of_its_cross_product_matrix(vector, other, size):
    a, b, c = np.array(vector) * size
    cross = np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
    np.testing.assert_allclose(turned([a, b, c], list(other)), exponential(cross) @ other, atol=1e-13)


@settings(max_examples=60, deadline=None)
@given(VECTOR, st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9), SIZE)
def test_local_undoes_retract_component_by_component(vector, step, size):
    step = np.array(step) * size
    # The flat components lose what 1 + step loses.
    np.testing.assert_allclose(round_trip(list(vector), list(step)), step, rtol=1e-12, atol=1e-15 * 4)


@settings(max_examples=60, deadline=None)
@given(VECTOR, VECTOR)
def test_retract_by_local_leads_to_the_other_rotation(u, v):
    np.testing.assert_allclose(inverse_trip(list(u), list(v)), turned(list(v), [1.0, 2.0, 3.0]), atol=1e-13)


def test_a_zero_step_gives_the_state_back_to_the_bit():
    pose = _pose([0.3, -0.4, 1.1])
    same = retract(pose, [0.0] * dimension(pose))
    assert all(np.array_equal(a, b) for a, b in zip(*map(jax.tree_util.tree_leaves, (pose, same)), strict=True))


def test_coordinates_rebuild_the_state_around_which_they_stand():
    pose = _pose([0.3, -0.4, 1.1])
    point, rebuild = coordinates(pose)
    assert [float(x) for x in point] == [0.0, 0.0, 0.0, 1.0, 2.0, 0.1, -0.2, 0.0, 0.5]
    np.testing.assert_array_equal(jnp.stack(local(pose, rebuild(point))), np.zeros(9))
    step = 1e-7 * np.linspace(-0.2, 0.3, 9)
    moved = rebuild([p + s for p, s in zip(point, step, strict=True)])
    np.testing.assert_allclose(jnp.stack(local(retract(pose, list(step)), moved)), np.zeros(9), atol=1e-15)


def test_the_step_of_a_change_is_the_derivative_of_local_at_the_state_itself():
    pose, rng = jax.tree_util.tree_map(jnp.asarray, _pose([0.3, -0.4, 1.1])), np.random.default_rng(0)
    change = jax.tree_util.tree_map(lambda x: jnp.asarray(rng.normal(size=jnp.shape(x))), pose)
    # A unit quaternion changes at right angles to itself.
    q, d = (jnp.stack(jax.tree_util.tree_leaves(x.attitude)) for x in (pose, change))
    change = change._replace(attitude=Rotation(*(d - q * (q @ d))))
    expected = jax.jvp(lambda other: local(pose, other), (pose,), (change,))[1]
    np.testing.assert_allclose(steps_of(pose, change), expected, atol=1e-12)


@pytest.mark.parametrize("at", [[0.0, 0.0, 0.0], [1e-5, 0.0, 0.0], [0.5, -0.2, 0.9]])
def test_the_derivative_of_local_after_retract_is_the_identity(at):
    rotation = Rotation.exp(at)
    jacobian = jax.jacfwd(lambda s: jnp.stack(rotation.local(rotation.retract(list(s)))))(jnp.zeros(3))
    np.testing.assert_allclose(jacobian, np.eye(3), atol=1e-12)


@settings(max_examples=100, deadline=None)
@given(st.floats(-1e4, 1e4))
def test_a_wrapped_angle_is_the_same_direction_inside_half_a_turn(angle):
    wrapped = float(wrap(angle))
    assert -np.pi <= wrapped <= np.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle), abs=1e-11)


def test_normalising_brings_a_rotations_length_back():
    stretched = Rotation(*(1.01 * q for q in jax.tree_util.tree_leaves(Rotation.exp([0.3, 0.2, 0.1]))))
    same = jax.tree_util.tree_leaves(stretched.normalised())
    np.testing.assert_allclose(same, jax.tree_util.tree_leaves(Rotation.exp([0.3, 0.2, 0.1])), atol=1e-15)
