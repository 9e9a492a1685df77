"""How often the right point of work was named and released, with intervals, and whether 95 % means 95 %."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from trackers.worksteps.decisions import LEVEL, NOWHERE, Decisions, WorkPoints, at_work, decide, visits_of

EDGES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0)
"""Between which claimed probabilities rows are counted together to see how often they are right."""


class Share(NamedTuple):
    """A share of `n`, with its 95 % interval; all NaN where `n` is zero."""

    value: float
    low: float
    high: float
    n: int


class Bin(NamedTuple):
    """Rows at work that claim a probability from `low` to `high`: the mean claimed, and the share that is right."""

    low: float
    high: float
    claimed: float
    right: Share


@dataclass(frozen=True)
class Workstep:
    """What is counted of a set of rows.

    Of the rows at work: `named`, the most probable point is the right one; `right`, `wrong` and `missed`, released at
    the right point, at another, not at all: they add up to 1. `false`: of the releases those at a point where the tip
    is not, another or none. `claimed`: the mean probability of the named point, which is `named` where covariances are
    right. Of the visits, rows in a row at one point: `visits_right` and `visits_wrong`, released rightly, or wrongly,
    at least once. `elsewhere`: rows at no point; `released_elsewhere`: their share that is released.
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
class Judged:
    """Rows with decisions: `at` (n,) the points at which the tip really is, `visit` (n,) the rows' visits."""

    decisions: Decisions
    at: np.ndarray
    visit: np.ndarray

    def part(self, rows: np.ndarray) -> Judged:
        """Some of the rows: their numbers or a mask."""
        return Judged(Decisions(*(x[rows] for x in self.decisions)), self.at[rows], self.visit[rows])


def judge(
    means: np.ndarray,
    covariances: np.ndarray,
    truth: np.ndarray,
    starts: np.ndarray,
    points: WorkPoints,
    tolerance: float,
    play: float,
    level: float = LEVEL,
) -> Judged:
    """Decisions on estimates (n, d) beside the truth (n, d) of tracks that begin at the rows `starts`."""
    at = at_work(truth, points, tolerance)
    return Judged(decide(means, covariances, points, tolerance, play, level), at, visits_of(at, starts))


def workstep(judged: Judged) -> Workstep:
    """The figures of the rows."""
    d, visit, at = judged.decisions, judged.visit, judged.at
    work = at != NOWHERE
    names_it = d.point == at
    right, wrong = d.released & names_it & work, d.released & ~names_it & work
    _, numbers = np.unique(visit[work], return_inverse=True)
    ever = [np.bincount(numbers, x[work]) > 0 for x in (right, wrong)] if work.any() else [np.zeros(0, bool)] * 2
    return Workstep(
        share(names_it[work], visit[work]),
        share(right[work], visit[work]),
        share(wrong[work], visit[work]),
        share(~d.released[work], visit[work]),
        share(~right[d.released], visit[d.released]),
        float(np.mean(d.probability[work])) if work.any() else np.nan,
        share(ever[0], np.arange(len(ever[0]))),
        share(ever[1], np.arange(len(ever[1]))),
        int(np.sum(~work)),
        share(d.released[~work], visit[~work]),
    )


def calibration(judged: Judged) -> list[Bin]:
    """By the claimed probability of the named point: how often it is the right one, of rows at work."""
    work = judged.part(judged.at != NOWHERE)
    claimed, right = work.decisions.probability, work.decisions.point == work.at
    # A claim of exactly 1 belongs to the last bin.
    which = np.minimum(np.searchsorted(EDGES, claimed, side="right") - 1, len(EDGES) - 2)
    bins = []
    for k, (low, high) in enumerate(pairwise(EDGES)):
        here = which == k
        mean = float(np.mean(claimed[here])) if here.any() else np.nan
        bins.append(Bin(low, high, mean, share(right[here], work.visit[here])))
    return bins


def share(hits: np.ndarray, cluster: np.ndarray, level: float = 0.95) -> Share:
    """The share of `hits` (n,) with Wilson's interval (1927), rows of one `cluster` (n,) counting as they agree.

    Rows of a visit are alike, so that n of them say less than n draws would: the interval is that of n divided by the
    design effect (Kish 1965), the variance of the share over clusters to that over independent rows. Where all rows
    agree, every cluster counts once.
    """
    n = len(hits)
    if n == 0:
        return Share(np.nan, np.nan, np.nan, 0)
    _, which = np.unique(cluster, return_inverse=True)
    sizes, found = np.bincount(which).astype(float), np.bincount(which, hits)
    p, clusters = float(np.mean(hits)), len(sizes)
    between = float(np.sum((found - p * sizes) ** 2)) * clusters / max(clusters - 1, 1)
    independent = p * (1 - p) * n
    effective = min(n, n * independent / between) if between > 0 and clusters > 1 else clusters
    z = NormalDist().inv_cdf((1 + level) / 2)
    shrunk = 1 + z * z / effective
    middle = (p + z * z / (2 * effective)) / shrunk
    half = z / shrunk * np.sqrt(p * (1 - p) / effective + z * z / (4 * effective**2))
    return Share(p, max(0.0, min(p, middle - half)), min(1.0, max(p, middle + half)), n)
