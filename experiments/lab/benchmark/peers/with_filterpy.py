"""filterpy's extended Kalman filter with the usual gate of three standard deviations of each channel."""

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from model import Path, Problem, diffusion, transition

GATE, OPENED_S = 3.0, 1.0
"""Standard deviations; seconds without a reading inside, after which 1 m² is added to the position's covariance."""


def estimate(p: Problem, acceleration: float, reading: float) -> Path:
    """The filtered path."""
    kalman, waited = ExtendedKalmanFilter(2 * p.d, 1), 0.0
    (kalman.x, kalman.P), N = p.beginning, len(p.times)
    means, covariances = np.empty((N, p.d)), np.empty((N, p.d, p.d))
    for row, dt in enumerate(p.steps):
        kalman.F, kalman.Q = transition(p.d, dt), diffusion(p.d, dt, acceleration)
        kalman.predict()
        waited += dt
        off, H = p.off(kalman.x, row), p.slopes(kalman.x, row)
        inside = off**2 <= GATE**2 * (np.einsum("ki,ij,kj->k", H, kalman.P, H) + reading**2)
        if not inside.any() and waited > OPENED_S:
            kalman.P[: p.d, : p.d] += np.eye(p.d)
            inside[:] = True
        if inside.any():
            waited, R = 0.0, reading**2 * np.eye(inside.sum())
            kalman.update(off[inside], lambda x, rows=H[inside]: rows, lambda x: 0.0, R=R)
        means[row], covariances[row] = kalman.x[: p.d], kalman.P[: p.d, : p.d]
    return means, covariances
