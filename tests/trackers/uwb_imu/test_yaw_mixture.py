"""The Gaussian sum over the initial yaw: its components at the start, in the plane and in space."""

import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.filters.ekf import Gaussian
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.state import Heading, Rotation
from trackwright.trackers.uwb_imu.strapdown import Inertial, PlanarInertial
from trackwright.trackers.uwb_imu.yaw_mixture import YawMixtureFilter


def _zeros(n):
    return Vector(*[jnp.asarray(0.0)] * n)


def test_in_the_plane_the_headings_divide_the_circle_from_the_given_one():
    state = PlanarInertial(_zeros(2), _zeros(2), _zeros(2), Heading(jnp.asarray(0.3)), jnp.asarray(0.0))
    mixture = YawMixtureFilter(count=4).init(Gaussian(state, (jnp.asarray(1.0),) * 36), None)
    np.testing.assert_allclose(mixture.beliefs.mean.attitude.angle, 0.3 + np.pi / 2 * np.arange(4), rtol=1e-12)
    np.testing.assert_allclose(np.exp(mixture.log_weights), 0.25, rtol=1e-12)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.2, -0.5, 0.4)])
def test_in_space_the_attitudes_are_rotated_about_the_worlds_vertical(axis):
    attitude = Rotation.exp(tuple(jnp.asarray(x) for x in axis))
    state = Inertial(_zeros(3), _zeros(3), attitude, _zeros(3), _zeros(3))
    mixture = YawMixtureFilter(count=3).init(Gaussian(state, (jnp.asarray(1.0),) * 120), None)
    tilted = np.array([float(x) for x in attitude.apply(Vector(0.3, 0.4, 0.5))])
    for k in range(3):
        part = Rotation(*(np.asarray(getattr(mixture.beliefs.mean.attitude, q))[k] for q in "wxyz"))
        c, s = np.cos(2 * np.pi * k / 3), np.sin(2 * np.pi * k / 3)
        expected = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ tilted
        np.testing.assert_allclose([float(x) for x in part.apply(Vector(0.3, 0.4, 0.5))], expected, atol=1e-12)
