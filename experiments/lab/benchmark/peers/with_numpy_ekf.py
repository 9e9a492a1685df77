"""The textbook's extended Kalman filter: NumPy, one row after another, scalar updates in Joseph form."""

import numpy as np
from model import Path, Problem, diffusion, transition


def states(p: Problem, acceleration: float, reading: float) -> tuple[np.ndarray, np.ndarray]:
    """The filtered states (N, 2d) and their covariances."""
    x, P = p.beginning
    means, covariances, eye = np.empty((len(p.times), len(x))), np.empty((len(p.times), *P.shape)), np.eye(len(x))
    for row, dt in enumerate(p.steps):
        F = transition(p.d, dt)
        x, P = F @ x, F @ P @ F.T + diffusion(p.d, dt, acceleration)
        step = np.zeros(len(x))
        for off, H in zip(p.off(x, row), p.slopes(x, row), strict=True):
            gain = P @ H / (H @ P @ H + reading**2)
            step = step + gain * (off - H @ step)
            rest = eye - np.outer(gain, H)
            P = rest @ P @ rest.T + reading**2 * np.outer(gain, gain)
        x = x + step
        means[row], covariances[row] = x, P
    return means, covariances


def estimate(p: Problem, acceleration: float, reading: float) -> Path:
    """The filtered path."""
    means, covariances = states(p, acceleration, reading)
    return means[:, : p.d], covariances[:, : p.d, : p.d]
