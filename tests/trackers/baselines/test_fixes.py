"""Fixes: the filter against a textbook one, the latency of fixes, and the times of the estimates."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, flat, recording
from tests.oracles import kalman, van_loan
from trackwright.trackers.baselines.fixes import fix_tracker, singer_tracker
from trackwright.trackers.baselines.floor import Walls, floor_tracker
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import GroundMotion, Kinematic
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.fixes import FIXES, CorrelatedFixSensor, FixSensor
from trackwright.tuning.objectives import NegativeLogLikelihood

LATENCY, SIGMA_A, SIGMA_Z = 0.35, 0.8, 0.2
R = np.array([[8.410, 3.510, -1.230], [3.510, 10.345, -0.769], [-1.230, -0.769, 0.584]]) * 1e-4
"""The covariance of Huang et al. 2018, section 4, m²."""


def _state(x):
    return Kinematic(Vector(*x[:3]), Vector(*x[3:]))


def _world(seed=0, rows=14):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.exponential(0.2, rows))
    seen = rng.random((rows, 3)) > 0.3
    return times, rng.normal(size=(rows, 3)), seen, rng.normal(size=5), np.diag(rng.uniform(0.5, 2.0, 5))


@pytest.mark.parametrize("reported", [False, True])
def test_the_filter_is_the_textbooks_with_correlated_noise_missing_channels_and_latency(reported):
    times, values, seen, mean, cov = _world()
    extra = np.full((len(times), 3), 0.01) if reported else np.zeros((len(times), 3))
    tracker = Tracker(
        GroundMotion(SIGMA_A, SIGMA_Z),
        {FIXES: CorrelatedFixSensor(R, latency=LATENCY)},
        KnownStart(_state),
        track_loss=NEVER_LOST,
    )
    estimates = tracker.run(recording(times, {FIXES: (values, seen, extra)}, mean, cov))
    A = np.zeros((5, 5))
    A[0, 3] = A[1, 4] = 1.0
    noise = np.diag([0, 0, SIGMA_Z**2, SIGMA_A**2, SIGMA_A**2])
    H = np.eye(3, 5)
    H[0, 3] = H[1, 4] = -LATENCY
    steps = [van_loan(A, noise, dt) for dt in np.diff(times)]
    means, covs, lls, _ = kalman(steps, H, R + 0.01 * reported * np.eye(3), values[1:], seen[1:], mean, cov)
    # Both are exact in double precision; the noise is a hundredth of the prior, which costs four digits.
    np.testing.assert_allclose(flat(estimates.mean)[1:], means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(estimates.covariance[1:], covs, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(estimates.log_likelihood[1:], lls, rtol=1e-9, atol=1e-9)


@pytest.fixture(scope="module")
def circling():
    """A tag on a circle, its fixes 0.4 s late, and the truth at every row."""
    times = np.arange(0, 40, 0.1)

    def position(t):
        return np.stack([3 * np.cos(t / 4), 3 * np.sin(t / 4), 1 + 0 * t], axis=1)

    fixes = position(times - 0.4) + 0.03 * np.random.default_rng(1).normal(size=(len(times), 3))
    truth = {"position": (position(times), times > 2)}
    readings = {FIXES: Readings(fixes, np.ones(fixes.shape, bool))}
    return Recording(times, readings, {"height": np.ones(len(times))}, truth), position


def test_a_second_sensor_without_latency_identifies_the_latency_without_truth(circling):
    recording, position = circling
    other = position(recording.times) + 0.05 * np.random.default_rng(2).normal(size=(len(recording), 3))
    readings = {**recording.readings, "other": Readings(other, np.ones(other.shape, bool))}
    batch = stack([Recording(recording.times, readings, recording.inputs)])
    sensors = {FIXES: FixSensor(0.03, 0.03), "other": FixSensor(0.05, 0.05)}
    tracker = as_dtype(eqx.tree_at(lambda t: t.sensors, fix_tracker(sigma_a=0.3), sensors), batch.dt.dtype)

    @jax.jit
    def metric(raw):
        at = eqx.tree_at(lambda t: t.sensors[FIXES].latency.raw, tracker, raw)
        return jnp.stack(at.accumulate(batch, NegativeLogLikelihood().terms))[0, 0]

    latencies = np.arange(0.25, 0.6, 0.05)
    metrics = [float(metric(jnp.asarray(latency / 0.5))) for latency in latencies]
    # Fixes of 3 cm at 0.75 m/s, hundreds of them: the latency is known to a few milliseconds, the grid has 50.
    assert latencies[np.argmin(metrics)] == pytest.approx(0.4, abs=0.026)


def test_estimates_are_valid_at_the_time_of_measurement_and_near_the_true_positions_then(circling):
    recording, position = circling
    sensor = FixSensor(0.1, 0.3, None, 0.4)
    tracker = eqx.tree_at(lambda t: t.sensors[FIXES].latency, fix_tracker(), sensor.latency)
    estimates, at_rows = tracker.run(recording), dataclasses.replace(tracker, latency_of=None).run(recording)
    np.testing.assert_allclose(estimates.times, recording.times - 0.4)
    np.testing.assert_array_equal(at_rows.times, recording.times)
    errors = flat(estimates.mean)[50:, :2] - position(estimates.times)[50:, :2]
    now = flat(at_rows.mean)[50:, :2] - position(recording.times)[50:, :2]
    # Straight motion for 0.4 s at 0.19 m/s² is 1.5 cm off, the fixes 3 cm per axis.
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.04
    assert np.mean(errors**2) < np.mean(now**2)


def test_a_height_that_comes_late_is_known_one_fix_behind_double_precision(circling):
    readings = Readings(circling[0].readings[FIXES].values, np.arange(400)[:, None] >= [0, 0, 20])
    late = dataclasses.replace(circling[0], readings={FIXES: readings})
    single, double = (fix_tracker().run(stack([late], dtype=x)).covariance for x in (np.float32, np.float64))
    np.testing.assert_allclose(single[0, 21:50, 2, 2], double[0, 20:49, 2, 2], rtol=0.02)


def test_a_tag_at_a_known_height_is_tracked_over_the_floor(circling):
    recording, position = circling
    seen = np.tile([True, True, False], (len(recording), 1))
    flat_world = Recording(recording.times, {FIXES: Readings(recording.readings[FIXES].values, seen)}, recording.inputs)
    for tracker in (fix_tracker(planar=True), singer_tracker(planar=True)):
        estimates = tracker.run(flat_world)
        assert len(estimates.mean.position) == 2
        errors = np.stack(list(estimates.mean.position), axis=1)[50:] - position(recording.times - 0.4)[50:, :2]
        assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("outline", [(), [(-1, -1), (11, -1), (11, 9), (-1, 9)]])
def test_a_first_fix_500_m_away_is_left_among_walls_within_half_a_second(outline):
    times = np.arange(100) * 0.1
    truth = np.column_stack([5 + 3 * np.cos(0.3 * times), 4 + 2 * np.sin(0.3 * times)])
    fixes = np.column_stack([truth + 0.1 * np.random.default_rng(0).normal(size=truth.shape), np.zeros(100)])
    fixes[0] = 500.0
    readings = {FIXES: Readings(fixes, np.tile([True, True, False], (100, 1)), np.zeros((100, 3)))}
    recording = Recording(times, readings, {"height": np.zeros(100)})
    estimates = floor_tracker(Walls([(5, 3.5, 5, 4.5)], outline)).run(recording)
    x, y = (np.asarray(p) for p in estimates.mean.position)
    assert np.hypot(x - truth[:, 0], y - truth[:, 1])[5:].max() < 0.4
