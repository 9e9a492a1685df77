"""Ground truth by a least-squares fit along a known path, for recordings without a reference (thesis, section 2.6).

Model: the tag rests at the first knot, travels each segment at a constant speed, may rest at the knots in between, and
rests at the last knot. The times at which it leaves and reaches the knots are fitted to its fixes. NumPy,
on the host.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

# Candidate times of the global search, which is exact among them and initialises the continuous fit.
CANDIDATES = 400
# Of the continuous fit: sweeps over all knot times, and the factor of a step that did not lower the cost.
SWEEPS, SHRINK = 60, 0.7


@dataclass(frozen=True)
class KnotTimes:
    """Start and end of the travel along each segment, `departed` and `arrived` (k,) s; `rms` m: of the residuals."""

    knots: np.ndarray
    departed: np.ndarray
    arrived: np.ndarray
    rms: float

    def positions(self, times: np.ndarray) -> np.ndarray:
        """The positions (n, 2), m, at `times` (n,) s: (2.7) solved for x."""
        events = np.stack([self.departed, self.arrived], axis=1).ravel()
        corners = np.repeat(self.knots, 2, axis=0)[1:-1]
        return np.stack([np.interp(times, events, axis) for axis in corners.T], axis=1)


def knot_times(knots: np.ndarray, times: np.ndarray, fixes: np.ndarray) -> KnotTimes:
    """The knot times of least squared distance to `fixes` (n, 2), m, at increasing `times` (n,), s.

    Raises ValueError for fewer than 2k + 1 different times on a path of k segments.
    """
    knots, times, fixes = (np.asarray(x, float) for x in (knots, times, fixes))
    segments = len(knots) - 1
    if len(np.unique(times)) < 2 * segments + 1:
        raise ValueError(
            f"{len(np.unique(times))} different times are too few for a path of {segments} segments, "
            f"expected at least {2 * segments + 1}"
        )
    events = _global_fit(knots, times, fixes)
    events = _refined(knots, times, fixes, events)
    rms = float(np.sqrt(_cost(knots, times, fixes, events) / len(times)))
    return KnotTimes(knots, events[0::2], events[1::2], rms)


def _global_fit(knots: np.ndarray, times: np.ndarray, fixes: np.ndarray) -> np.ndarray:
    """The best event times (2k,) among `CANDIDATES` of the rows' times, by dynamic programming.

    The cost of a rest or a straight travel between any two rows follows from cumulative sums of the fixes' moments.
    """
    rows = np.unique(np.linspace(0, len(times) - 1, min(CANDIDATES, len(times))).round().astype(int))
    t = times - times[0]

    def cumulated(x: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])[rows]

    sums = [cumulated(x) for x in (np.ones(len(t)), t, t * t, fixes, fixes * t[:, None], (fixes**2).sum(axis=1))]
    # Rows i … j − 1 for candidates i ≤ j: the sums over an interval are differences.
    count, first, second, position, moment, square = (x[None, :] - x[:, None] for x in sums)
    start, span = t[rows][:, None], t[rows][None, :] - t[rows][:, None]
    possible = np.triu(np.ones((len(rows), len(rows)), bool))
    moving = possible & (span > 0)
    rate = np.where(moving, 1.0 / np.where(moving, span, 1.0), 0.0)

    def resting(knot: np.ndarray) -> np.ndarray:
        cost = square - 2 * position @ knot + count * (knot @ knot)
        return np.where(possible, cost, np.inf)

    def travelling(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        u = b - a
        along, along_moment = position @ u, moment @ u
        share = (first - start * count) * rate
        share_square = (second - 2 * start * first + start**2 * count) * rate**2
        cross = (along_moment - start * along) * rate
        cost = square - 2 * position @ a + count * (a @ a) + 2 * share * (a @ u) + share_square * (u @ u) - 2 * cross
        return np.where(moving, cost, np.inf)

    last = len(rows) - 1
    best = resting(knots[0])[0]
    back: list[np.ndarray] = []
    for k, (a, b) in enumerate(pairwise(knots)):
        phases = [travelling(a, b)] if k == len(knots) - 2 else [travelling(a, b), resting(b)]
        for phase in phases:
            through = best[:, None] + phase
            back.append(np.argmin(through, axis=0))
            best = np.min(through, axis=0)
    end = best + resting(knots[-1])[:, last]
    marks = [int(np.argmin(end))]
    for choice in reversed(back):
        marks.append(int(choice[marks[-1]]))
    return times[rows[np.array(marks[::-1])]]


def _refined(knots: np.ndarray, times: np.ndarray, fixes: np.ndarray, events: np.ndarray) -> np.ndarray:
    """The event times after a coordinate search, one at a time between its neighbours."""
    events = events.copy()
    steps = np.full(len(events), 2.0 * (times[-1] - times[0]) / min(CANDIDATES, len(times)))
    cost = _cost(knots, times, fixes, events)
    for _ in range(SWEEPS):
        for k in range(len(events)):
            low = events[k - 1] if k else times[0]
            high = events[k + 1] if k + 1 < len(events) else times[-1]
            improved = False
            for step in (steps[k], -steps[k]):
                moved = events.copy()
                moved[k] = np.clip(events[k] + step, low, high)
                other = _cost(knots, times, fixes, moved)
                if other < cost:
                    events, cost, improved = moved, other, True
                    break
            steps[k] *= 1.0 if improved else SHRINK
    return events


def _cost(knots: np.ndarray, times: np.ndarray, fixes: np.ndarray, events: np.ndarray) -> float:
    """The sum of squared distances of the fixes from the positions of these events, m²."""
    positions = KnotTimes(knots, events[0::2], events[1::2], 0.0).positions(times)
    return float(((fixes - positions) ** 2).sum())
