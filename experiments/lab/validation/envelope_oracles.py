"""Trackers in plain NumPy and SciPy, in double precision: textbook loops, an IMM filter, robust least squares."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student_t

from trackwright.experiments.lab.bench.loops import fix_channels, ground, model_of, vector
from trackwright.experiments.lab.benchmark.adapters.plain import filtered
from trackwright.trackers.core.data.estimates import Estimates, Status
from trackwright.trackers.core.data.recording import Recording
from trackwright.trackers.core.filters.imm import InteractingModels, SwitchingMotion
from trackwright.trackers.core.model.motion import GroundMotion
from trackwright.trackers.parts.fixes import FIXES
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.recordings.tracker_spec import TrackerBatch
from trackwright.trackers.uwb_imu.multilateration import Multilateration
from trackwright.trackers.uwb_imu.yaw_mixture import YawMixtureFilter

METHODS = {
    "fix-kf": "NumPy loop, Jacobians by hand",
    "uwb": "NumPy loop, Jacobians by hand",
    "bearings": "NumPy loop, Jacobians by hand",
    "uwb-imu": "NumPy loop of one of its three filters (Solà 2017)",
    "imm": "NumPy loop with all pairs of modes (Blom and Bar-Shalom 1988)",
    "multilateration": "`scipy.optimize.least_squares` with Cauchy's loss",
}
"""How double precision is itself checked, by tracker."""


def difference(group: TrackerBatch, recording: Recording) -> float:
    """The largest distance of the tracker's positions in double precision from those of another method.

    In standard deviations that the tracker reports; NaN where no other method is written for it, or no track lasts.
    """
    tracker: Any = group.tracker
    if isinstance(tracker, Multilateration):
        return _of_least_squares(tracker, recording)
    if isinstance(getattr(tracker, "filter", None), YawMixtureFilter):
        tracker = dataclasses.replace(tracker, filter=tracker.filter.kalman)
    estimates = tracker.run(recording)
    running = np.flatnonzero(estimates.usable)
    if not len(running) or (estimates.status[running[1:]] != Status.OK).any() or len(running) < 2:
        return np.nan
    first = int(running[0]) + 1
    at_start = jax.tree_util.tree_map(lambda x: x[first - 1], estimates.mean)
    P, dts = np.asarray(estimates.covariance[first - 1], float), np.diff(recording.times, prepend=recording.times[0])
    if isinstance(getattr(tracker, "filter", None), InteractingModels):
        means = _switched(tracker, recording, vector(at_start), P, dts, first)
    else:
        model = model_of(tracker, recording, group.planar)
        if model is None:
            return np.nan
        means, _ = filtered(model, vector(at_start), P, dts, first)
    return _largest(estimates, means, slice(first, None))


def _largest(estimates: Estimates, means: np.ndarray, rows: slice | np.ndarray) -> float:
    positions = np.stack([np.asarray(x, float) for x in estimates.mean.position], axis=-1)[rows]
    sigmas = np.stack([estimates.sigmas[f"position.{k}"] for k in range(positions.shape[1])], axis=-1)[rows]
    return float(np.max(np.abs(means[:, : positions.shape[1]] - positions) / sigmas))


def _switched(
    tracker: Any, recording: Recording, x: np.ndarray, P: np.ndarray, dts: np.ndarray, first: int
) -> np.ndarray:
    """The means (T − first, n) of an interacting-multiple-model filter, mixed over every pair of modes."""
    motion, sensor = tracker.motion, tracker.sensors[FIXES]
    assert isinstance(motion, SwitchingMotion)
    prior = np.asarray(tracker.filter.mode_prior.value, float)
    prior, rate = prior / prior.sum(), float(tracker.filter.switching_rate.value)
    moves = [ground(mode, False) for mode in motion.modes if isinstance(mode, GroundMotion)]
    channels, dof = fix_channels(sensor, recording, False), float(sensor.dof.value)
    means, covs, weights = np.stack([x] * len(prior)), np.stack([P] * len(prior)), prior.copy()
    merged = []
    for row in range(first, len(dts)):
        stays = np.exp(-rate * dts[row])
        joint = weights[:, None] * (stays * np.eye(len(prior)) + (1 - stays) * prior)
        predicted = joint.sum(axis=0)
        log_weights = np.log(predicted)
        mixed = [_mixture(joint[:, j] / predicted[j], means, covs) for j in range(len(prior))]
        for j, (mean, cov) in enumerate(mixed):
            mean, F, Q = moves[j](mean, cov, row, dts[row])
            cov, at = F @ cov @ F.T + Q, mean.copy()
            for residual, h, sigma in channels(at, row):
                innovation, spread = residual - h @ (mean - at), h @ cov @ h + sigma**2
                square = innovation**2 / spread
                log_weights[j] += student_t.logpdf(innovation, dof, scale=np.sqrt(spread))
                weight = (dof + 1) / (dof + square)
                gain = cov @ h / (h @ cov @ h + sigma**2 / weight)
                mean, rest = mean + gain * innovation, np.eye(len(mean)) - np.outer(gain, h)
                cov = rest @ cov @ rest.T + np.outer(gain, gain) * sigma**2 / weight
            means[j], covs[j] = mean, cov
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        merged.append(weights @ means)
    return np.array(merged)


def _mixture(weights: np.ndarray, means: np.ndarray, covs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mean = weights @ means
    away = means - mean
    return mean, np.einsum("k,kij->ij", weights, covs + away[:, :, None] * away[:, None])


def _of_least_squares(tracker: Multilateration, recording: Recording) -> float:
    """The largest distance from the positions of least Cauchy loss, at rows with an estimate."""
    estimates = tracker.run(recording)
    readings, sigma = recording.readings[RANGES], float(tracker.sigma_r.value)
    places = recording.inputs["anchors"].reshape(len(recording), -1, 3)
    positions = np.stack([np.asarray(x, float) for x in estimates.mean.position], axis=-1)
    rows = np.flatnonzero(estimates.usable)
    if not len(rows):
        return np.nan
    optima = []
    for row in rows.tolist():
        seen = readings.seen[row]

        def residual(x: np.ndarray, row: int = row, seen: np.ndarray = seen) -> np.ndarray:
            return np.linalg.norm(x - places[row, seen], axis=1) - readings.values[row, seen]

        exact = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
        optima.append(
            least_squares(residual, positions[row], loss="cauchy", f_scale=3 * sigma, x_scale=sigma, **exact).x
        )
    return _largest(estimates, np.array(optima), rows)
