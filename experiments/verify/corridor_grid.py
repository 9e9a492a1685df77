"""The oracle of particles between walls: the corridor's likelihood by quadrature, double precision, NumPy alone.

What wanders by independent normal moves and dies outside a rectangle has the density p'(x') = g(x') ∫ N(x'; x, σ²) p(x)
over the rectangle. At Gauss-Legendre points of the inside every integrand is smooth, and the first one, from an even
density, is a difference of error functions: so the likelihood converges exponentially with the number of points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sim.corridor import CORRIDOR, SIGMA_FIX, SIGMA_MOVE, START

POINTS = (64, 24)
"""Along and across the corridor."""

STEP = 1e-4
"""Of the central difference by log σ, whose own error is some 1e-8 of the derivative."""


class Axis(NamedTuple):
    """One axis: points (n,) m, their weights, the density after the first move, and a move's matrix, weights in it."""

    points: np.ndarray
    weights: np.ndarray
    first: np.ndarray
    move: np.ndarray


def log_likelihood(
    fixes: np.ndarray, sigma: float = SIGMA_MOVE, sigma_fix: float = SIGMA_FIX, points: tuple[int, int] = POINTS
) -> float:
    """log L of fixes (T, 2), m, with moves of `sigma` m per axis before each, alive inside the corridor alone."""
    along, across = (_axis(k, sigma, points[k]) for k in (0, 1))
    density, value = np.empty(0), 0.0
    for row, (x, y) in enumerate(fixes):
        predicted = along.move @ density @ across.move.T if row else np.outer(along.first, across.first)
        weighted = predicted * np.outer(_normal(along.points - x, sigma_fix), _normal(across.points - y, sigma_fix))
        likelihood = along.weights @ weighted @ across.weights
        density, value = weighted / likelihood, value + math.log(likelihood)
    return value


def slopes(fixes: np.ndarray, points: tuple[int, int] = POINTS) -> tuple[float, float]:
    """d log L / d log σ of the moves and of the fixes, by central differences."""
    up, down = math.exp(STEP), math.exp(-STEP)
    moves = [log_likelihood(fixes, SIGMA_MOVE * f, points=points) for f in (up, down)]
    readings = [log_likelihood(fixes, sigma_fix=SIGMA_FIX * f, points=points) for f in (up, down)]
    return (moves[0] - moves[1]) / (2 * STEP), (readings[0] - readings[1]) / (2 * STEP)


def _axis(k: int, sigma: float, count: int) -> Axis:
    (low, high), (start, stop) = CORRIDOR[:, k], START[:, k]
    nodes, weights = np.polynomial.legendre.leggauss(count)
    points, weights = low + (high - low) * (nodes + 1) / 2, weights * (high - low) / 2
    first = (_below((points - start) / sigma) - _below((points - stop) / sigma)) / (stop - start)
    return Axis(points, weights, first, _normal(points[:, None] - points[None, :], sigma) * weights[None, :])


def _normal(x: np.ndarray, sigma: float) -> np.ndarray:
    return np.exp(-0.5 * (x / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))


def _below(x: np.ndarray) -> np.ndarray:
    return np.array([0.5 * math.erfc(-v / math.sqrt(2)) for v in x])
