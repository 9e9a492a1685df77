"""How often the right fastening point was named and unlocked, with intervals, and calibration of probabilities."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from trackwright.trackers.worksteps.decisions import (
    LEVEL,
    NO_POINT,
    Decisions,
    FasteningPoints,
    decide,
    nearest_point,
    visit_numbers,
)

EDGES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0)
"""Edges of the bins of predicted probability, for calibration."""


class Share(NamedTuple):
    """A fraction of `n` with its 95 % interval; NaN for `n` = 0."""

    value: float
    low: float
    high: float
    n: int


class CalibrationBin(NamedTuple):
    """Rows at a point with predicted probability from `low` to `high`: its mean `claimed`, and the fraction `right`."""

    low: float
    high: float
    claimed: float
    right: Share


@dataclass(frozen=True)
class UnlockMetrics:
    """Fractions of a set of rows; the field names are keys of `evaluation.json`.

    Of the rows at a fastening point: `named`, the most probable point is the right one; `right`, `wrong` and `missed`,
    unlocked at the right point, unlocked at another, not unlocked (they sum to 1). `false`: of all unlock decisions,
    those at a point where the tip is not. `claimed`: mean probability of the named point, which equals `named` if the
    covariances are right. Of the visits (consecutive rows at one point): `visits_right` and `visits_wrong`, unlocked
    there, or at another point, at least once. `elsewhere`: number of rows at no point; `released_elsewhere`: the
    fraction of these that is unlocked.
    """

    named: Share
    right: Share
    wrong: Share
    missed: Share
    false: Share
    claimed: float
    visits_right: Share
    visits_wrong: Share
    elsewhere: int
    released_elsewhere: Share


@dataclass(frozen=True)
class ScoredDecisions:
    """Decisions with truth: `at` (n,) the true points, `visit` (n,) the visits of the rows."""

    decisions: Decisions
    at: np.ndarray
    visit: np.ndarray

    def part(self, rows: np.ndarray) -> ScoredDecisions:
        """The selected rows, by number or mask."""
        return ScoredDecisions(Decisions(*(x[rows] for x in self.decisions)), self.at[rows], self.visit[rows])


def score(
    means: np.ndarray,
    covariances: np.ndarray,
    truth: np.ndarray,
    starts: np.ndarray,
    points: FasteningPoints,
    tolerance: float,
    play: float,
    level: float = LEVEL,
) -> ScoredDecisions:
    """Decisions for estimates (n, d) and truth (n, d) of concatenated tracks that begin at rows `starts`."""
    at = nearest_point(truth, points, tolerance)
    return ScoredDecisions(decide(means, covariances, points, tolerance, play, level), at, visit_numbers(at, starts))


def unlock_metrics(scored: ScoredDecisions) -> UnlockMetrics:
    """The fractions of all rows."""
    d, visit, at = scored.decisions, scored.visit, scored.at
    at_point = at != NO_POINT
    named = d.point == at
    right, wrong = d.unlocked & named & at_point, d.unlocked & ~named & at_point
    _, numbers = np.unique(visit[at_point], return_inverse=True)
    ever = (
        [np.bincount(numbers, x[at_point]) > 0 for x in (right, wrong)] if at_point.any() else [np.zeros(0, bool)] * 2
    )
    return UnlockMetrics(
        share(named[at_point], visit[at_point]),
        share(right[at_point], visit[at_point]),
        share(wrong[at_point], visit[at_point]),
        share(~d.unlocked[at_point], visit[at_point]),
        share(~right[d.unlocked], visit[d.unlocked]),
        float(np.mean(d.probability[at_point])) if at_point.any() else np.nan,
        share(ever[0], np.arange(len(ever[0]))),
        share(ever[1], np.arange(len(ever[1]))),
        int(np.sum(~at_point)),
        share(d.unlocked[~at_point], visit[~at_point]),
    )


def calibration(scored: ScoredDecisions) -> list[CalibrationBin]:
    """Fraction of right named points by their predicted probability, over the rows at a point."""
    at_points = scored.part(scored.at != NO_POINT)
    claimed, right = at_points.decisions.probability, at_points.decisions.point == at_points.at
    # A probability of exactly 1 belongs to the last bin.
    which = np.minimum(np.searchsorted(EDGES, claimed, side="right") - 1, len(EDGES) - 2)
    bins = []
    for k, (low, high) in enumerate(pairwise(EDGES)):
        here = which == k
        mean = float(np.mean(claimed[here])) if here.any() else np.nan
        bins.append(CalibrationBin(low, high, mean, share(right[here], at_points.visit[here])))
    return bins


def share(hits: np.ndarray, cluster: np.ndarray, level: float = 0.95) -> Share:
    """The fraction of `hits` (n,) with Wilson's interval (1927) for rows that are correlated within a `cluster` (n,).

    The interval is that of n divided by the design effect (Kish 1965): the variance of the fraction over clusters, over
    its variance for independent rows. If all rows agree, each cluster counts once.
    """
    n = len(hits)
    if n == 0:
        return Share(np.nan, np.nan, np.nan, 0)
    _, which = np.unique(cluster, return_inverse=True)
    sizes, cluster_hits = np.bincount(which).astype(float), np.bincount(which, hits)
    p, clusters = float(np.mean(hits)), len(sizes)
    between = float(np.sum((cluster_hits - p * sizes) ** 2)) * clusters / max(clusters - 1, 1)
    independent = p * (1 - p) * n
    effective = min(n, n * independent / between) if between > 0 and clusters > 1 else clusters
    z = NormalDist().inv_cdf((1 + level) / 2)
    shrunk = 1 + z * z / effective
    middle = (p + z * z / (2 * effective)) / shrunk
    half = z / shrunk * np.sqrt(p * (1 - p) / effective + z * z / (4 * effective**2))
    return Share(p, max(0.0, min(p, middle - half)), min(1.0, max(p, middle + half)), n)
