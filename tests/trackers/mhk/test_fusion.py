"""MH-K row by row against the equations in NumPy: a tag that accelerates, irregular rows, fixes missing."""

from itertools import pairwise

import numpy as np
import pytest

from tests.known_start import flat
from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.mhk.tracker import STILL, mhk_tracker
from trackwright.trackers.parts.fixes import FIXES

pytestmark = pytest.mark.slow

SIGMA_A, SIGMA_DISPLACEMENT, WINDOW = 0.8, 0.01, 3


def _path(t):
    # Up to 1.6 m/s², which is within the sphere of accelerations, 2 m/s².
    return np.stack([2.5 * np.sin(0.8 * t), 0.2 * t**2, 1.0 + 0.1 * np.cos(t)], axis=1)


@pytest.fixture(scope="module")
def recording():
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.05, 0.7, 40))
    rows = rng.random(40) > 0.3
    fixes = _path(times) + 0.005 * rng.normal(size=(40, 3))
    seen = np.tile(rows[:, None], (1, 3))
    truth = {"position": (_path(times), np.ones(40, bool))}
    return Recording(times, {FIXES: Readings(np.where(seen, fixes, 0.0), seen)}, truth=truth)


def _states():
    """Accelerations (7129, 3) and their probabilities by quadrature over each block, for the tracker's four levels."""
    still, full, p_still, p_full = 0.1, 2.0, 0.6, 0.1
    nodes, weights = np.polynomial.legendre.leggauss(12)
    half_elevation, half_azimuth = np.deg2rad(5.0), np.deg2rad(5.0)
    radii = np.cbrt(np.linspace(still**3, full**3, 11))
    directions, solid_angles = [], []
    for elevation in np.deg2rad(np.arange(-85, 90, 10)):
        for azimuth in np.deg2rad(np.arange(5, 360, 10)):
            a, b = np.meshgrid(elevation + half_elevation * nodes, azimuth + half_azimuth * nodes, indexing="ij")
            area = np.outer(weights, weights) * np.cos(a) * half_elevation * half_azimuth
            unit = np.stack([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])
            directions.append((unit * area).sum(axis=(1, 2)) / area.sum())
            solid_angles.append(area.sum() / (4 * np.pi))
    directions, solid_angles = np.array(directions), np.array(solid_angles)
    accelerations, probabilities = [], []
    for inner, outer in pairwise(radii):
        k = 0.5 * (outer + inner) + 0.5 * (outer - inner) * nodes
        accelerations.append(directions * (weights @ k**3) / (weights @ k**2))
        probabilities.append(solid_angles * (1 - p_still) * (1 - p_full) / 10)
    accelerations += [directions * full, np.zeros((1, 3))]
    probabilities += [solid_angles * (1 - p_still) * p_full, [p_still]]
    return np.concatenate(accelerations), np.concatenate(probabilities)


def _oracle(recording, rate):
    """Mean and covariance of each row from the first median on, by dense matrices; NaN before."""
    values, seen = recording.readings[FIXES].values, recording.readings[FIXES].seen[:, 0]
    accelerations, stationary = _states()
    eye, zero = np.eye(3), np.zeros((3, 3))
    means, covs = np.full((len(values), 6), np.nan), np.full((len(values), 6, 6), np.nan)
    window, started, a, remaining = [], False, np.zeros(3), 0.0
    for row, dt in enumerate(np.diff(recording.times, prepend=recording.times[0])):
        window = [*window, values[row]][-WINDOW:] if seen[row] else window
        median = np.median(window, axis=0) if seen[row] and len(window) == WINDOW else None
        if started:
            # The acceleration first, then straight on.
            driven = min(dt, remaining)
            p, v = p + v * driven + 0.5 * a * driven**2, v + a * driven
            p = p + v * (dt - driven)
            remaining, elapsed = remaining - driven, elapsed + dt
            F = np.block([[eye, dt * eye], [zero, eye]])
            Q = SIGMA_A**2 * np.block([[dt**3 / 3 * eye, dt**2 / 2 * eye], [dt**2 / 2 * eye, dt * eye]])
            P = F @ P @ F.T + Q
            if rate is not None:
                kept = np.exp(-rate * dt)
                weights = kept * weights + (1 - kept) * stationary
        if median is not None and not started:
            started, p, v, elapsed = True, median, np.zeros(3), 0.0
            P, weights, last, last_v = np.diag([0.25] * 3 + [1.0] * 3), stationary, median, v
        elif median is not None:
            K = P[:, :3] @ np.linalg.inv(P[:3, :3] + STILL)
            correction = K @ (median - p)
            p, v, P = p + correction[:3], v + correction[3:], P - K @ P[:3]
            # What constant velocity since the last fix leaves of the way is that of a constant acceleration.
            off = median - last - elapsed * last_v - 0.5 * elapsed**2 * accelerations
            log = -0.5 * (off**2).sum(axis=1) / SIGMA_DISPLACEMENT**2
            posterior = (stationary if rate is None else weights) * np.exp(log - log.max())
            weights = posterior / posterior.sum()
            a, remaining, elapsed, last, last_v = weights @ accelerations, elapsed, 0.0, median, v
        if started:
            means[row], covs[row] = np.concatenate([p, v]), P
    return means, covs


def _tracker(**options):
    levels = {"sigma_a": SIGMA_A, "sigma_displacement": SIGMA_DISPLACEMENT}
    return mhk_tracker(window=WINDOW, speed_limit=1e3, **levels, **options)


@pytest.mark.parametrize("rate", [None, 1.5], ids=["as printed", "sticky"])
def test_every_row_of_an_accelerating_tag_is_that_of_the_equations(recording, rate):
    means, covs = _oracle(recording, rate)
    estimates = _tracker(rate=rate).run(recording)
    rows = np.isfinite(means[:, 0])
    assert rows.sum() > 30
    # Centroids by closed form and by quadrature agree to 1e-12.
    np.testing.assert_allclose(flat(estimates.mean)[rows], means[rows], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(estimates.covariance[rows], covs[rows], rtol=1e-8, atol=1e-10)


def test_the_estimated_acceleration_shortens_the_lag_of_an_accelerating_tag(recording):
    times = recording.times
    # Without noise and with a window of one fix the rest is the filter's lag.
    exact = Recording(times, {FIXES: Readings(_path(times), np.ones((len(times), 3), bool))})
    errors = []
    for sigma in (0.005, 1e3):
        tracker = mhk_tracker(sigma_a=0.1, sigma_displacement=sigma, window=1, speed_limit=1e3)
        errors.append(np.linalg.norm(flat(tracker.run(exact).mean)[10:, :3] - _path(times)[10:], axis=1).mean())
    assert errors[0] < 0.8 * errors[1]
