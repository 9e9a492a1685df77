"""Latency: the truth at earlier times, the shifted estimate by another order of fields, and objectives without a jump."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model.algebra import Vector, dense
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.latency import scored_truth, shifted_back
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.evaluation.evaluate import rows_of
from trackwright.trackers.parts.fixes import FIXES
from trackwright.tuning.fitting import FitOptions, fit
from trackwright.tuning.objectives import RootMeanSquareError

# One by one, each of its operations would be compiled for itself.
scored_truth = jax.jit(scored_truth)


def _recording(rows=40, unknown=()):
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.05, 0.3, rows))
    path = np.stack([np.cos(times), np.sin(times), 1 + 0 * times], axis=1)
    known = ~np.isin(np.arange(rows), unknown)
    fixes = path + 0.03 * rng.normal(size=path.shape)
    readings = {FIXES: Readings(fixes, np.ones(path.shape, bool))}
    truth = np.where(known[:, None], path, 0.0)
    return Recording(times, readings, {"height": np.ones(rows)}, {"position": (truth, known)})


def test_the_truth_at_earlier_times_is_scipys_spline_within_a_stretch_and_its_tangent_beyond():
    recording = _recording(unknown=[15, 16, 17, 30])
    truth, known = recording.truth["position"]
    values, scored = scored_truth(stack([recording, recording]), np.array([0.21, 0.0]))["position"]
    np.testing.assert_array_equal(scored[:, 0], known)
    for first, end in ((0, 15), (18, 30), (31, 40)):
        t, z = recording.times[first:end], truth[first:end]
        slopes = np.gradient(z, t, axis=0)
        at = t - 0.21
        inside = CubicHermiteSpline(t, z, slopes)(np.maximum(at, t[0]))
        expected = inside + np.minimum(at - t[0], 0.0)[:, None] * slopes[0]
        np.testing.assert_allclose(values[first:end, :, 0], expected, atol=1e-12)
        np.testing.assert_allclose(values[first:end, :, 1], z, atol=1e-12)


def _after_a_gap(seconds):
    """The recording with its first row `seconds` before the second, 1 m away."""
    recording = _recording()
    truth = recording.truth["position"][0].copy()
    truth[0] += 1.0
    times = recording.times - recording.times[1]
    times[0] = -seconds
    known = np.ones(len(times), bool)
    return dataclasses.replace(recording, times=times, truth={"position": (truth, known)})


@pytest.mark.parametrize("gap", [1e3, 1e6, 1.7e9])
def test_in_single_precision_the_truth_after_a_long_gap_is_the_spline_and_that_in_the_gap_is_left_out(gap):
    recording = _after_a_gap(gap)
    (truth, known), t = recording.truth["position"], recording.times[1:]
    batch = stack([recording], dtype=np.float32)
    values, scored = scored_truth(batch, np.array([0.21], np.float32))["position"]
    np.testing.assert_array_equal(scored[:, 0], known & ~((t[0] <= recording.times) & (recording.times < t[0] + 0.21)))
    spline = CubicHermiteSpline(t, truth[1:], np.gradient(truth[1:], t, axis=0))
    later = t >= t[0] + 0.21
    np.testing.assert_allclose(values[1:, :, 0][later], spline(t[later] - 0.21), atol=1e-5)


@pytest.mark.slow
def test_an_objective_scores_the_rows_that_evaluate_scores_where_the_truth_has_a_hole():
    # Rows inside the hole have no truth; those after it are valid inside.
    recording = _recording(60, unknown=range(20, 32))
    tracker = fix_tracker()
    tracker = eqx.tree_at(lambda t: t.sensors[FIXES].latency, tracker, tracker.sensors[FIXES].latency.with_value(0.4))
    batch = stack([recording])
    estimates = tracker.run(recording)
    terms = RootMeanSquareError().terms
    counts = eqx.filter_jit(lambda tracker, batch: tracker.accumulate(batch, terms, every_row=True)[1][:, 0])
    rows = counts(as_dtype(tracker, batch.dt.dtype), batch)
    scored = rows_of(estimates, recording)["why"].is_null().to_numpy()
    before = estimates.times < recording.times[0]
    assert 0 < np.sum(~scored & ~before & recording.truth["position"][1]) < 10
    np.testing.assert_array_equal(np.asarray(rows) > 0, scored & recording.truth["position"][1] | before)


class Reordered(NamedTuple):
    velocity: Vector
    clock: float
    position: Vector


def test_an_estimate_is_shifted_by_the_names_of_its_fields():
    A = np.random.default_rng(0).normal(size=(6, 6))
    P = A @ A.T
    upper = tuple(jnp.asarray(P[i, j]) for i in range(6) for j in range(i, 6))
    mean = Reordered(Vector(1.0, 2.0), 5.0, Vector(3.0, 4.0, 7.0))
    shifted, cov = shifted_back(jax.tree_util.tree_map(jnp.asarray, mean), upper, 0.5)
    J = np.eye(6)
    J[3, 0] = J[4, 1] = -0.5
    np.testing.assert_allclose([*shifted.velocity, shifted.clock, *shifted.position], [1, 2, 5, 2.5, 3, 7])
    np.testing.assert_allclose(dense(list(cov), 6), J @ P @ J.T, rtol=1e-12)


def _set(tracker, **values):
    return tracker.with_values({f"sensors.fixes.{name}": value for name, value in values.items()})


@pytest.mark.slow
@pytest.mark.parametrize("of", [lambda tracker: tracker, Smoothed], ids=["filtered", "smoothed"])
def test_an_unknown_latency_adds_its_variance_times_the_squared_velocity_and_leaves_the_estimate(of):
    recording, tracker = _recording(), fix_tracker()
    without = of(_set(tracker, latency=0.2)).run(recording)
    with_it = of(_set(tracker, latency=0.2, latency_std=0.1)).run(recording)
    v = np.stack(list(without.mean.velocity), axis=-1)
    expected = without.covariance.copy()
    expected[:, :2, :2] += 0.1**2 * (v[:, :, None] * v[:, None, :] + without.covariance[:, 3:, 3:])
    np.testing.assert_allclose(with_it.covariance, expected, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(with_it.mean.position[0], without.mean.position[0])


@pytest.mark.slow
def test_a_fit_of_the_latency_ends_with_one_that_is_known():
    recording, tracker = _recording(), _set(fix_tracker(), latency_std=0.1)
    options = FitOptions(steps=2)
    of_latency = fit(tracker, recording, "rmse", "*latency*", options).tracker
    of_another = fit(tracker, recording, "rmse", "motion.sigma_a", options).tracker
    assert [float(t.sensors[FIXES].latency_std.value) for t in (of_latency, of_another)] == [0.0, 0.1]


@pytest.fixture(scope="module")
def rmse_of_latency():
    batch, tracker = stack([_recording()]), fix_tracker()

    @jax.jit
    def rmse(latency):
        at = eqx.tree_at(lambda t: t.sensors[FIXES].latency.raw, as_dtype(tracker, batch.dt.dtype), latency / 0.5)
        sums = at.accumulate(batch, RootMeanSquareError().terms)
        return jnp.sqrt(sums[0][0] / sums[1][0]), sums[1][0]

    return rmse


def test_an_error_has_no_jump_where_the_latency_is_zero(rmse_of_latency):
    at = [rmse_of_latency(x) for x in (-1e-6, 0.0, 1e-6)]
    # The same rows are scored, and the error changes by its slope, 0.1 m/s at most, times 1e-6 s.
    assert len({int(count) for _, count in at}) == 1
    assert np.ptp([float(x) for x, _ in at]) < 1e-6


@pytest.mark.slow
def test_the_gradient_by_the_latency_is_that_of_finite_differences(rmse_of_latency):
    gradient = jax.jit(jax.grad(lambda x: rmse_of_latency(x)[0]))
    for latency in (0.0, 0.17):
        slope = gradient(latency)
        up, down = (float(rmse_of_latency(latency + x)[0]) for x in (1e-5, -1e-5))
        assert slope == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-5)
