"""A tag confined to a corridor by its walls: a world in which naive particle gradients are wrong."""

from __future__ import annotations

import numpy as np

CORRIDOR = np.array([[0.0, 0.0], [6.0, 1.5]])
"""Opposite corners of the corridor, m."""

START = np.array([[0.75, 0.45], [1.35, 1.05]])
"""Opposite corners of the rectangle, m, over which the initial position is uniform."""

SIGMA_MOVE, SIGMA_FIX = 0.45, 0.8
"""Standard deviations per axis, m: of the motion in one second, and of a fix."""


def corridor_fixes(rows: int, seed: int = 3) -> np.ndarray:
    """Fixes (rows, 2), m, at 1 Hz, of a tag that moves along the centre line from 1 m to 5 m."""
    noise = np.random.default_rng(seed).standard_normal((rows, 2))
    along = np.linspace(0.0, 1.0, rows)
    return np.stack([1.0 + 4.0 * along, np.full(rows, 0.75)], axis=1) + SIGMA_FIX * noise


def rectangle(corners: np.ndarray) -> np.ndarray:
    """The four walls (4, 4), each x1, y1, x2, y2 in m, of the rectangle with these opposite corners (2, 2)."""
    (left, low), (right, high) = corners
    knots = np.array([[left, low], [right, low], [right, high], [left, high], [left, low]])
    return np.hstack([knots[:-1], knots[1:]])
