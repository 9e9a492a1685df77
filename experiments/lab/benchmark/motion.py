"""The model of all estimators that take one: constant velocity with white acceleration, and white noise of readings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Levels(NamedTuple):
    """Noise levels: `acceleration`, m/s² per √Hz along each axis; `reading`, m or, of angles, rad."""

    acceleration: float
    reading: float


class Path(NamedTuple):
    """Estimates at the times of the readings: `positions` (N, d), m, and `covariances` (N, d, d), m², or None."""

    positions: np.ndarray
    covariances: np.ndarray | None = None


def transition(d: int, dt: float) -> np.ndarray:
    """The transition (2d, 2d) of positions and velocities over dt seconds."""
    F = np.eye(2 * d)
    F[:d, d:] = dt * np.eye(d)
    return F


def diffusion(d: int, dt: float, acceleration: float) -> np.ndarray:
    """The covariance (2d, 2d) that white acceleration adds over dt seconds."""
    unit = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return np.kron(acceleration**2 * unit, np.eye(d))
