"""A smoothed mixture of yaws: each component smoothed by itself, weighted by its likelihood of the whole track."""

import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, flat, recording
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.ranges import RangeSensor
from trackwright.trackers.uwb_imu.strapdown import ImuNoise, PlanarInertial, PlanarStrapdown
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
