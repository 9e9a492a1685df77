"""The effective number of rows of a likelihood: how much correlated innovations inflate the variance of its scores.

The score of a noise level is about NIS − dof of each row. Sums of it over windows of time have the variance of
independent rows times an inflation, which grows with the window up to that of the errors.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, Num

from trackers.core.chunks import run_chunks
from trackers.core.recording import Batch
from trackers.core.scan import Output
from tuning.point import BESIDE, Point, plain_rows
from tuning.problem import Problem

WINDOWS_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Lengths of the windows, s, each twice the one before."""

MIN_WINDOWS = 20
"""Windows of a length for an estimate of a variance to a third."""

FLAT = 1.05
"""Growth of the inflation from a window to one of twice the length below which it has reached that of the errors."""

MIN_ROWS = 4
"""Rows of a window, on average, below which it is too short."""


def rows_and_inflation(problem: Problem, vector: Float[np.ndarray, " p"]) -> tuple[int, float]:
    """The rows with innovations at the vector (p,), and how many of them carry the information of one.

    1 for white innovations. Windows are lengthened until the inflation is flat, or the recordings are too short for
    longer ones; it is extrapolated in the inverse of the length, which removes most of what correlation beyond a window
    adds.
    """
    pairs = [(problem.point(vector), part) for part in problem.chunks]
    found: list[tuple[np.ndarray, np.ndarray]]
    if problem.few:
        # By the program that the starts were compared with.
        at = [BESIDE.index(name) - len(BESIDE) for name in ("nis", "nis_dof")]
        found = [(np.asarray(rows[0, at[0]]), np.asarray(rows[0, at[1]])) for (rows,) in run_chunks(plain_rows, pairs)]
    else:
        found = run_chunks(_nis_of_rows, pairs)
    times, values, track = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for (nis, dof), part in zip(found, problem.chunks, strict=True):
        clock, known = np.cumsum(np.asarray(part.dt, float), axis=0), np.isfinite(nis) & (dof > 0)
        known &= np.asarray(part.valid)
        for k in range(part.size):
            own = known[:, k]
            times.append(clock[own, k])
            values.append(nis[own, k].astype(float) / dof[own, k])
            track.append(np.full(int(own.sum()), len(track)))
    t, x, n = (np.concatenate(parts) for parts in (times, values, track))
    if len(x) < MIN_WINDOWS:
        return len(x), 1.0
    scores = x - x.mean()
    before = last = 1.0
    for window in WINDOWS_S:
        if len(scores) < MIN_ROWS * len(_starts(t, n, window)):
            continue
        now = inflation(t, scores, n, window)
        if np.isnan(now):
            break
        flat, before, last = now < FLAT * last, last, now
        if flat:
            break
    return len(x), max(1.0, last, 2 * last - before)


def inflation(
    times: Float[np.ndarray, " n"], scores: Float[np.ndarray, " n"], track: Num[np.ndarray, " n"], window: float
) -> float:
    """The variance of sums of scores over windows of time relative to that of independent rows; NaN with few windows.

    `track` (n,): the number of each row's trajectory, in order.
    """
    first = _starts(times, track, window)
    squares = float(scores @ scores)
    if len(first) < MIN_WINDOWS or squares == 0:
        return np.nan
    sums = np.add.reduceat(scores, first)
    return float(sums @ sums) / squares


def _starts(times: Float[np.ndarray, " n"], track: Num[np.ndarray, " n"], window: float) -> Int[np.ndarray, " windows"]:
    """The first row of each window of each trajectory."""
    return np.flatnonzero(np.append(True, (np.diff(np.floor(times / window)) != 0) | (np.diff(track) != 0)))


def _nis_of_rows(point: Point, batch: Batch) -> tuple[np.ndarray, np.ndarray]:
    """NIS and degrees of freedom of every row (T, B) at the point's first vector."""

    def score(output: Output, truth: object) -> tuple[np.ndarray, np.ndarray]:
        return output.nis, output.nis_dof

    nis, dof = point.tracker_at(point.vectors[0]).accumulate(batch, score, every_row=True)
    return nis, dof
