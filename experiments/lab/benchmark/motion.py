"""The model of all estimators that take one: constant velocity with white acceleration, and white noise of readings."""

from __future__ import annotations

from functools import cache
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
    same, drift, *_ = _blocks(d)
    return np.asarray(same + dt * drift)


def diffusion(d: int, dt: float, acceleration: float) -> np.ndarray:
    """The covariance (2d, 2d) that white acceleration adds over dt seconds."""
    _, _, positions, both, velocities = _blocks(d)
    return np.asarray(acceleration**2 * (dt**3 / 3 * positions + dt**2 / 2 * both + dt * velocities))


@cache
def _blocks(d: int) -> tuple[np.ndarray, ...]:
    """The unit matrices of all, of positions by velocities, and of the blocks of a covariance."""
    patterns = ([[1, 0], [0, 1]], [[0, 1], [0, 0]], [[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]])
    return tuple(np.kron(np.array(pattern, float), np.eye(d)) for pattern in patterns)
