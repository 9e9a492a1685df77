"""filterpy's extended Kalman filter, with the usual gate of three standard deviations of each reading."""

from __future__ import annotations

import numpy as np

from trackwright.experiments.lab.benchmark.adapters.plain import Channel, Model, model
from trackwright.experiments.lab.benchmark.motion import Levels, Path
from trackwright.experiments.lab.benchmark.problems import POSITION_STD, Problem, beginning, steps

GATE = 3.0
OPENED_S = 1.0
"""Seconds without a reading inside the gate after which the covariance of a start is added to that of the position."""


def estimate(problem: Problem, levels: Levels) -> Path:
    """The filtered path of a tag."""
    d = problem.dimensions
    means, covariances = filtered(model(problem, levels), *beginning(problem), steps(problem), 0, GATE)
    return Path(means[:, :d], covariances[:, :d, :d])


def filtered(
    model: Model, state: np.ndarray, P: np.ndarray, dts: np.ndarray, first: int, gate: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """`plain.filtered` by filterpy's `ExtendedKalmanFilter`, with normal noise; for states that are vectors."""
    from filterpy.kalman import ExtendedKalmanFilter

    means, covariances = np.empty((len(dts) - first, len(P))), np.empty((len(dts) - first, *P.shape))
    kalman = ExtendedKalmanFilter(len(P), 1)
    kalman.x, kalman.P = state.copy(), P.copy()
    waited = 0.0
    for row in range(first, len(dts)):
        _, kalman.F, kalman.Q = model.moved(kalman.x, kalman.P, row, dts[row])
        kalman.predict()
        waited += dts[row]
        seen = list(model.channels(kalman.x, row))
        inside = [channel for channel in seen if _inside(channel, kalman.P, gate)]
        if seen and not inside and waited > OPENED_S:
            d = len(P) // 2
            kalman.P[:d, :d] += POSITION_STD**2 * np.eye(d)
            inside = seen
        if inside:
            waited = 0.0
            differences = np.array([channel[0] for channel in inside])
            H, R = np.array([channel[1] for channel in inside]), np.diag([channel[2] ** 2 for channel in inside])
            kalman.update(differences, lambda x, H=H: H, lambda x: 0.0, R=R)
        means[row - first], covariances[row - first] = kalman.x, kalman.P
    return means, covariances


def _inside(channel: Channel, P: np.ndarray, gate: float) -> bool:
    difference, slope, sigma = channel
    return difference**2 <= gate**2 * (float(slope @ P @ slope) + sigma**2)
