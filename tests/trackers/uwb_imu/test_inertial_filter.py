"""The fifteen-state filter on worlds that follow its model: 500 runs with biases, ranges one anchor at a time.

One batch serves all tests: true states drawn from the motion itself, IMU at 50 Hz, a range every fifth row, a second
without an IMU in the middle, and one recording that ends early.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, recording
from trackwright.trackers.core.data.consistency import consistency, nees
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.state import Rotation, local, retract
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.ranges import RangeSensor
from trackwright.trackers.uwb_imu.strapdown import ImuNoise, Inertial, Strapdown

pytestmark = pytest.mark.slow

RUNS, ROWS, ENDS, DT, SIGMA_R = 500, 200, 120, 0.02, 0.05
MOTION = Strapdown(ImuNoise(0.1, 0.01, 0.02, 0.002, 1.0, 0.05))
ANCHORS = np.array([[0, 0, 0.5], [8, 0, 2.5], [8, 8, 0.3], [0, 8, 2.8], [4, 0, 2.0], [4, 8, 1.0]])
# On a circle of 1.5 m about the centre of the room.
MEAN = np.array([5.5, 4.0, 1.0, 0.0, 1.5, 0.0, 1.0, 0.0, 0.0, 0.0, *[0.0] * 6])
# Attitude known to a degree: at 3 degrees gravity's second order, 10 m/s² × 0.05²/2, makes the NEES 5 % too large.
SIGMAS = np.repeat([0.1, 0.1, 0.02, 0.2, 0.02], 3)


def _build(x):
    return Inertial(Vector(*x[:3]), Vector(*x[3:6]), Rotation(*x[6:10]), Vector(*x[10:13]), Vector(*x[13:16]))


def _truth_and_batch():
    rng = np.random.default_rng(0)
    t = np.arange(ROWS) * DT
    # What the IMU read, the same in all runs: a body that swings on a circle; what was true differs by bias and noise.
    accel = np.stack([-1.5 + 0.5 * np.sin(5 * t), 0.5 * np.cos(7 * t), 9.81 + np.cos(4 * t)], axis=1)
    gyro = np.stack([0.2 * np.cos(6 * t), 0.2 * np.sin(8 * t), 1.0 + 0.5 * np.cos(3 * t)], axis=1)
    available = np.repeat(((t < 2) | (t >= 3)).astype(float)[:, None], 2, axis=1)
    fixed = freeze(MOTION)
    base = _build(list(jnp.asarray(MEAN)))

    @jax.jit
    @jax.vmap
    def states(start, kicks):
        def step(state, row):
            inputs, dt, w = row
            state = fixed.step(state, inputs, dt, Vector.of(w))
            return state, state

        dts = jnp.concatenate([jnp.zeros(1), jnp.full(ROWS - 1, DT)])
        rows = ({"accel": jnp.asarray(accel), "gyro": jnp.asarray(gyro), "imu": jnp.asarray(available)}, dts, kicks)
        return jax.lax.scan(step, retract(base, list(start)), rows)[1]

    true = states(SIGMAS * rng.normal(size=(RUNS, 15)), rng.normal(size=(RUNS, ROWS, 15)))
    position = np.stack([np.asarray(x) for x in true.position], axis=-1)
    number = np.arange(ROWS) // 5 % len(ANCHORS)
    ranges = np.linalg.norm(position - ANCHORS[number], axis=2) + SIGMA_R * rng.normal(size=(RUNS, ROWS))
    seen = (np.arange(ROWS) % 5 == 0)[:, None] & (np.arange(ROWS) > 0)[:, None]
    inputs = {
        "accel": accel,
        "gyro": gyro,
        "imu": available,
        "anchors": ANCHORS[number],
        "anchor": number[:, None] * 1.0,
    }
    inputs["height"] = np.zeros(ROWS)
    records = []
    for k in range(RUNS):
        part = slice(ENDS if k == 0 else ROWS)
        cut = {name: x[part] for name, x in inputs.items()}
        records.append(
            recording(t[part], {"ranges": (ranges[k, part, None], seen[part])}, MEAN, np.diag(SIGMAS**2), cut, str(k))
        )
    return true, stack(records)


@pytest.fixture(scope="module")
def world():
    return _truth_and_batch()


@pytest.fixture(scope="module")
def estimates(world):
    # A tail this long is the normal distribution.
    sensor = RangeSensor(1, 0, SIGMA_R, 1.0, 1e9)
    return Tracker(MOTION, {"ranges": sensor}, KnownStart(_build), track_loss=NEVER_LOST).run(world[1])


def test_the_nees_is_inside_its_95_percent_interval_with_biases_and_a_gap_of_the_imu(world, estimates):
    true, covs = world[0], estimates.covariance[1:]
    errors = np.stack(jax.jit(jax.vmap(jax.vmap(local)))(estimates.mean, true), axis=-1)[1:]
    for row in (60, 149, ROWS - 1):  # before the gap, at its end, at the end
        metric = consistency(nees(errors[:, row], covs[:, row]), 15)
        assert metric.low <= metric.mean <= metric.high
    means = nees(errors.reshape(-1, 15), covs.reshape(-1, 15, 15)).reshape(RUNS - 1, ROWS).mean(axis=1)
    # Rows of one run are correlated: the interval comes from the scatter of the runs' own means.
    assert abs(means.mean() - 15) < 1.96 * means.std() / np.sqrt(RUNS)


def test_the_nis_is_inside_its_95_percent_interval(estimates):
    updated = estimates.nis_dof[1:] > 0
    metric = consistency(estimates.nis[1:][updated], estimates.nis_dof[1:][updated].astype(float))
    assert metric.low <= metric.mean <= metric.high
