"""A tag that wanders in a corridor from which it cannot leave: the world in which wrong particle gradients show."""

from __future__ import annotations

import numpy as np

CORRIDOR = np.array([[0.0, 0.0], [6.0, 1.5]])
"""Opposite corners of the rectangle that holds the tag, m."""

START = np.array([[0.75, 0.45], [1.35, 1.05]])
"""Opposite corners of the rectangle in which the tag is at first, anywhere with the same density, m."""

SIGMA_MOVE, SIGMA_FIX = 0.45, 0.8
"""Standard deviations, per axis, of a second's move and of a fix, m."""


def corridor_fixes(rows: int, seed: int = 3) -> np.ndarray:
    """Fixes (rows, 2), m, one a second, of a tag that goes along the middle from 1 m to 5 m."""
    noise = np.random.default_rng(seed).standard_normal((rows, 2))
    along = np.linspace(0.0, 1.0, rows)
    return np.stack([1.0 + 4.0 * along, np.full(rows, 0.75)], axis=1) + SIGMA_FIX * noise


def rectangle(corners: np.ndarray) -> np.ndarray:
    """The four walls (4, 4), x1, y1, x2, y2 in m, of a rectangle given by opposite corners (2, 2)."""
    (left, low), (right, high) = corners
    knots = np.array([[left, low], [right, low], [right, high], [left, high], [left, low]])
    return np.hstack([knots[:-1], knots[1:]])
