"""What a position is for: at which point of work is the tool, a screw hole or a station of a line, and is it released.

    m, P  estimate and its covariance        c_k  the points of work, K of them, one as likely as another
    s     play: the standard deviation, per axis, of a tip at work about its point

Given that the tip is at one of the points, the estimate is normal about it with covariance P + s² I, so that

    p_k = exp(-½ d_k²) / Σ_j exp(-½ d_j²),    d_k² = (m - c_k)ᵀ (P + s² I)⁻¹ (m - c_k),

and the tool is released for the most probable point where its p_k reaches a level and m lies within the tolerance of
it. The use is that of Will et al. 2020, section 2.1: a screwdriver that works at the right fastening position alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trackers.core.errors import UnusableInput
from trackers.core.metrics import nees

LEVEL = 0.95
"""The probability of one point from which on the tool is released."""

NOWHERE = -1
"""The number of the point where the tip is at none."""

_ROWS = 4096


@dataclass(frozen=True)
class WorkPoints:
    """Points of work: `names` and `places` (K, d) m, of two coordinates (over the floor) or three."""

    names: tuple[str, ...]
    places: np.ndarray

    @property
    def dimensions(self) -> int:
        """2 or 3."""
        return self.places.shape[1]

    def spacing(self) -> float:
        """The smallest distance between two of the points, m; infinite where there is but one."""
        apart = np.linalg.norm(self.places[:, None] - self.places, axis=-1)
        return float(np.min(apart + np.diag(np.full(len(apart), np.inf))))

    def tolerance(self) -> float:
        """Half the spacing, m: the largest tolerance with which no place belongs to two points.

        Raises UnusableInput where a single point leaves it open.
        """
        if len(self.names) < 2:
            raise UnusableInput(
                f"one point of work, '{self.names[0]}': half the distance to the next cannot be the tolerance; "
                "expected a tolerance in metres; give --tolerance"
            )
        return self.spacing() / 2


class Decisions(NamedTuple):
    """Of each of n estimates: the most probable `point`, its `probability`, and whether the tool is `released` there.

    `all` (n, K): the probabilities of all points; those of an estimate with NaN are NaN and it releases nothing.
    """

    point: np.ndarray
    probability: np.ndarray
    released: np.ndarray
    all: np.ndarray


def probabilities(means: np.ndarray, covariances: np.ndarray, points: WorkPoints, play: float) -> np.ndarray:
    """The probability (n, K) of each point, given that the tip is at one of them; rows of NaN where there is none.

    `means` (n, d) m, `covariances` (n, d, d) m²; what is NaN of a covariance counts as zero: the estimate is taken as
    exact. `play` m.
    """
    K, d = points.places.shape
    result = np.empty((len(means), K))
    for k in range(0, len(means), _ROWS):
        part = slice(k, k + _ROWS)
        spread = np.nan_to_num(covariances[part]) + play**2 * np.eye(d)
        apart = (means[part, None] - points.places).reshape(-1, d)
        square = nees(apart, np.repeat(spread, K, axis=0)).reshape(-1, K)
        # Less the smallest first: far from all points every exponential would be zero.
        weight = np.exp(-0.5 * (square - square.min(axis=1, keepdims=True)))
        result[part] = weight / weight.sum(axis=1, keepdims=True)
    return result


def decide(
    means: np.ndarray,
    covariances: np.ndarray,
    points: WorkPoints,
    tolerance: float,
    play: float,
    level: float = LEVEL,
) -> Decisions:
    """The most probable point of each estimate (n, d), and whether the tool is released for it."""
    every = probabilities(means, covariances, points, play)
    known = np.isfinite(every).all(axis=1)
    best = np.where(known, np.argmax(np.where(known[:, None], every, 0.0), axis=1), NOWHERE)
    probability = np.where(known, every.max(axis=1), np.nan)
    near = np.linalg.norm(means - points.places[best], axis=1) <= tolerance
    return Decisions(best, probability, known & near & (probability >= level), every)


def at_work(truth: np.ndarray, points: WorkPoints, tolerance: float) -> np.ndarray:
    """The number of the point (n,) at which the tip really is: the nearest within the tolerance, else `NOWHERE`."""
    here = np.full(len(truth), NOWHERE)
    for k in range(0, len(truth), _ROWS):
        apart = np.linalg.norm(truth[k : k + _ROWS, None] - points.places, axis=-1)
        nearest = np.argmin(np.nan_to_num(apart, nan=np.inf), axis=1)
        within = np.take_along_axis(apart, nearest[:, None], axis=1)[:, 0] <= tolerance
        here[k : k + _ROWS] = np.where(within, nearest, NOWHERE)
    return here


def visits_of(at: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """The number of the visit (n,) that each row belongs to: rows in a row at one point, or between points.

    `at` (n,) point numbers of tracks one after another, `starts` (g,) where each track begins.
    """
    new = np.diff(at, prepend=at[:1]) != 0
    new[starts[starts < len(at)]] = True
    return np.cumsum(new)
