"""A mixture of yaws: its components at the start, and each smoothed by itself, weighted by its likelihood of the track."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, flat, recording
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.filters.ekf import ExtendedKalman, Gaussian
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.state import Heading, Rotation
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.ranges import RangeSensor
from trackwright.trackers.uwb_imu.strapdown import ImuNoise, Inertial, PlanarInertial, PlanarStrapdown
from trackwright.trackers.uwb_imu.yaw_mixture import YawMixtureFilter

ROWS, STEP_S, SIGMA_R, RADIUS = 24, 0.05, 0.3, 3.0
ANCHORS = np.array([[0.0, 0.0, 2.0], [10.0, 0.0, 2.0], [10.0, 10.0, 2.0], [0.0, 10.0, 2.0]])


def _state(x):
    return PlanarInertial(Vector(*x[:2]), Vector(*x[2:4]), Vector(*x[4:6]), Heading(x[6]), x[7])


def _recording(yaw=0.0):
    """A body on a circle at 1 rad/s, a range a row; its velocity is too uncertain to resolve the yaw at once."""
    rng, times = np.random.default_rng(1), STEP_S * np.arange(ROWS)
    position = 5.0 + RADIUS * np.stack([np.cos(times), np.sin(times)], axis=1)
    anchors = ANCHORS[np.arange(ROWS) % 4]
    ranges = np.sqrt(((position - anchors[:, :2]) ** 2).sum(axis=1) + 1.0) + SIGMA_R * rng.normal(size=ROWS)
    inputs = {
        "accel": np.tile([-RADIUS, 0.0, 9.81], (ROWS, 1)),
        "gyro": np.tile([0.0, 0.0, 1.0], (ROWS, 1)),
        "imu": np.ones((ROWS, 2)),
        "anchors": anchors,
        "anchor": np.zeros((ROWS, 1)),
        "height": np.ones(ROWS),
    }
    mean = np.array([*position[0], 0.0, RADIUS, 0.0, 0.0, 0.3 + yaw, 0.0])
    cov = np.diag([0.5, 0.5, 3.0, 3.0, 0.2, 0.2, 0.3, 0.02]) ** 2
    readings = {"ranges": (ranges[:, None], np.ones((ROWS, 1), bool), np.zeros((ROWS, 0)))}
    return recording(times, readings, mean, cov, inputs)


def _smoothed(filter):
    sensors = {"ranges": RangeSensor(1, 0, SIGMA_R, 1.0, 1e6, 0.0)}
    motion = PlanarStrapdown(ImuNoise(0.05, 0.005, 0.005, 0.0005))
    return Smoothed(Tracker(motion, sensors, KnownStart(_state), filter, NEVER_LOST))


@pytest.fixture(scope="module")
def runs():
    both = _smoothed(ExtendedKalman()).run(stack([_recording(), _recording(np.pi)]))
    return _smoothed(YawMixtureFilter(count=2)).run(_recording()), [both[0], both[1]]


@pytest.mark.slow
def test_the_mean_of_the_mixture_is_the_components_weighted_by_likelihood(runs):
    bank, yaws = runs
    evidence = np.array([one.log_likelihood.sum() for one in yaws])
    weights = np.exp(evidence - np.logaddexp.reduce(evidence))
    # Both have weight, so that the weights depend on the later rows and not on the first ones.
    assert weights.max() < 1 - 1e-6
    parts = [flat(one.mean) for one in yaws]
    angle = 6
    apart = (parts[1] - parts[0])[1:]
    apart[:, angle] = (apart[:, angle] + np.pi) % (2 * np.pi) - np.pi
    # About the likelier one's yaw, as angles are averaged.
    best = int(np.argmax(weights))
    mean = parts[best][1:] + (weights[1] if best == 0 else -weights[0]) * apart
    estimated = flat(bank.mean)[1:]
    estimated[:, angle] += 2 * np.pi * np.round((mean - estimated)[:, angle] / (2 * np.pi))
    np.testing.assert_allclose(estimated, mean, rtol=1e-9, atol=1e-9)


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
