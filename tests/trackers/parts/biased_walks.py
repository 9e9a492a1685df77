"""Walks seen by stations whose bearings have Gauss–Markov biases, simulated in NumPy."""

from __future__ import annotations

import numpy as np

import trackwright as tw

LEVELS = {
    "sigma_a": 0.3,
    "memory": 4.0,
    "sigma_azimuth": 0.05,
    "sigma_elevation": 0.08,
    "dof": 100.0,
    "sigma_bias": (0.08, 0.12),
    "time_constant": 8.0,
    "length": 0.5,
}
CORNERS = {"A": [0.0, 3.0, 2.3], "B": [12.0, 3.0, 2.3], "C": [6.0, 0.0, 2.3], "D": [6.0, 6.0, 2.3]}
TURNS = {
    "A": (0.5, 0.5, 0.5, 0.5),
    "B": (0.5, 0.5, -0.5, -0.5),
    "C": (0.0, 0.0, 2**-0.5, 2**-0.5),
    "D": (2**-0.5, 2**-0.5, 0.0, 0.0),
}
HEIGHT, DT, ROWS = 1.1, 0.2, 400


def stations():
    return {name: tw.Station(np.array(place), np.array(TURNS[name])) for name, place in CORNERS.items()}


def walk(seed):
    """A recording of one walk with its true position, and the true biases (T, 8) of all stations."""
    rng = np.random.default_rng(seed)
    names, layout = list(CORNERS), stations()
    times, station = np.arange(ROWS) * DT, np.arange(ROWS) % 4
    decay = np.exp(-DT / LEVELS["memory"])
    spread = LEVELS["sigma_a"] * np.sqrt(LEVELS["memory"] / 2)
    velocity, position = spread * rng.normal(size=2), np.array([6.0, 3.0])
    sigmas = np.tile(LEVELS["sigma_bias"], 4)
    bias = sigmas * rng.normal(size=8)
    angles, truth, biases = np.empty((ROWS, 2)), np.empty((ROWS, 2)), np.empty((ROWS, 8))
    for row in range(ROWS):
        rate = 1 / LEVELS["time_constant"] + np.hypot(*velocity) / LEVELS["length"]
        kept = np.exp(-DT * rate)
        bias = kept * bias + np.sqrt(1 - kept**2) * sigmas * rng.normal(size=8)
        position = position + velocity * DT
        velocity = decay * velocity + np.sqrt(1 - decay**2) * spread * rng.normal(size=2)
        # Walls turn a walker round.
        leaving = (position < [1, 1]) & (velocity < 0) | (position > [11, 5]) & (velocity > 0)
        velocity = np.where(leaving, -velocity, velocity)
        k = station[row]
        noise = rng.normal(size=2) * [LEVELS["sigma_azimuth"], LEVELS["sigma_elevation"]]
        angles[row] = layout[names[k]].angles(np.append(position, HEIGHT)) + bias[2 * k : 2 * k + 2] + noise
        truth[row], biases[row] = position, bias
    recording = tw.bearing_recording(times, angles, [names[k] for k in station], layout, height=HEIGHT, truth=truth)
    return recording, truth, biases


def inside_shares(worlds):
    """Shares of rows, after 10 s, with the true position in the 95 % ellipse, and true biases in 95 % intervals."""
    tracker = tw.bearing_tracker(4, planar=True, **LEVELS)
    walks = [walk(seed) for seed in range(worlds)]
    estimates = tracker.run([recording for recording, _, _ in walks])
    positions, intervals = [], []
    for k, (_, truth, biases) in enumerate(walks):
        mean = np.stack([np.asarray(x)[k] for x in (*estimates.mean.position, *estimates.mean.bias)], axis=1)
        cov = np.delete(np.delete(np.asarray(estimates.covariance[k]), [2, 3], axis=1), [2, 3], axis=2)
        error = (mean - np.concatenate([truth, biases], axis=1))[50:]
        P = cov[50:]
        nees = np.einsum("ti,tij,tj->t", error[:, :2], np.linalg.inv(P[:, :2, :2]), error[:, :2])
        positions.append(nees < 5.991)
        intervals.append(np.abs(error[:, 2:]) < 1.96 * np.sqrt(np.einsum("tii->ti", P)[:, 2:]))
    return float(np.mean(positions)), float(np.mean(intervals))
