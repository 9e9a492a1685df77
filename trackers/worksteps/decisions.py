"""Unlock decisions: at which fastening point is the tool, and is it unlocked there.

    m, P  estimate and its covariance        c_k  the K fastening points, equally probable a priori
    s     play: standard deviation, per axis, of the tool tip about its fastening point

Given that the tip is at one of the points, the estimate is normally distributed about it with covariance P + s² I:

    p_k = exp(-½ d_k²) / Σ_j exp(-½ d_j²),    d_k² = (m - c_k)ᵀ (P + s² I)⁻¹ (m - c_k)

The tool is unlocked for the most probable point if its p_k reaches a level and m lies within the tolerance of it. The
application is that of Will et al. 2020, section 2.1: a screwdriver that works at the right fastening point only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trackwright.trackers.core.data.consistency import nees
from trackwright.trackers.core.errors import UnusableInput

LEVEL = 0.95
"""Smallest probability of a point at which the tool is unlocked."""

NO_POINT = -1
"""Number that stands for no fastening point."""

_ROWS = 4096


@dataclass(frozen=True)
class FasteningPoints:
    """Fastening points: `names`, and `positions` (K, d) m with d = 2 (horizontal) or 3 coordinates."""

    names: tuple[str, ...]
    positions: np.ndarray

    @property
    def dimensions(self) -> int:
        """Number of coordinates, 2 or 3."""
        return self.positions.shape[1]

    def spacing(self) -> float:
        """The smallest distance between two points, m; infinite for a single point."""
        distance = np.linalg.norm(self.positions[:, None] - self.positions, axis=-1)
        return float(np.min(distance + np.diag(np.full(len(distance), np.inf))))

    def tolerance(self) -> float:
        """Half the spacing, m: the largest tolerance for which no position is within that of two points.

        Raises UnusableInput for a single point.
        """
        if len(self.names) < 2:
            raise UnusableInput(
                f"one fastening point, '{self.names[0]}': the default tolerance, half the distance between two points, "
                "is undefined; expected a tolerance in metres; give one"
            )
        return self.spacing() / 2


class Decisions(NamedTuple):
    """Of each of n estimates: the most probable `point`, its `probability`, and whether the tool is `unlocked` there.

    `all` (n, K): the probabilities of all points. An estimate with NaN has probabilities of NaN and is not unlocked.
    """

    point: np.ndarray
    probability: np.ndarray
    unlocked: np.ndarray
    all: np.ndarray


def probabilities(means: np.ndarray, covariances: np.ndarray, points: FasteningPoints, play: float) -> np.ndarray:
    """The probability (n, K) of each point, given that the tip is at one of them; NaN for estimates with NaN.

    `means` (n, d) m, `covariances` (n, d, d) m², in which NaN counts as zero (an exact estimate). `play` m.
    """
    K, d = points.positions.shape
    result = np.empty((len(means), K))
    for k in range(0, len(means), _ROWS):
        part = slice(k, k + _ROWS)
        spread = np.nan_to_num(covariances[part]) + play**2 * np.eye(d)
        deviation = (means[part, None] - points.positions).reshape(-1, d)
        square = nees(deviation, np.repeat(spread, K, axis=0)).reshape(-1, K)
        # The smallest is subtracted first: far from all points every exponential would underflow.
        weight = np.exp(-0.5 * (square - square.min(axis=1, keepdims=True)))
        result[part] = weight / weight.sum(axis=1, keepdims=True)
    return result


def decide(
    means: np.ndarray,
    covariances: np.ndarray,
    points: FasteningPoints,
    tolerance: float,
    play: float,
    level: float = LEVEL,
) -> Decisions:
    """The most probable point of each estimate (n, d), and whether the tool is unlocked for it."""
    probabilities_of_points = probabilities(means, covariances, points, play)
    known = np.isfinite(probabilities_of_points).all(axis=1)
    best = np.where(known, np.argmax(np.where(known[:, None], probabilities_of_points, 0.0), axis=1), NO_POINT)
    probability = np.where(known, probabilities_of_points.max(axis=1), np.nan)
    near = np.linalg.norm(means - points.positions[best], axis=1) <= tolerance
    return Decisions(best, probability, known & near & (probability >= level), probabilities_of_points)


def nearest_point(truth: np.ndarray, points: FasteningPoints, tolerance: float) -> np.ndarray:
    """The number of the nearest point (n,) to each true position (n, d), `NO_POINT` beyond the tolerance."""
    here = np.full(len(truth), NO_POINT)
    for k in range(0, len(truth), _ROWS):
        distance = np.linalg.norm(truth[k : k + _ROWS, None] - points.positions, axis=-1)
        nearest = np.argmin(np.nan_to_num(distance, nan=np.inf), axis=1)
        within = np.take_along_axis(distance, nearest[:, None], axis=1)[:, 0] <= tolerance
        here[k : k + _ROWS] = np.where(within, nearest, NO_POINT)
    return here


def visit_numbers(at: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """The visit (n,) of each row: consecutive rows of a track at the same point, or at none, share a number.

    `at` (n,) point numbers of concatenated tracks, `starts` (g,) the first row of each track.
    """
    new = np.diff(at, prepend=at[:1]) != 0
    new[starts[starts < len(at)]] = True
    return np.cumsum(new)
