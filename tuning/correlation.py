"""The effective number of rows of a likelihood: how much correlated innovations inflate the variance of its scores.

The score of a noise level is about NIS − dof of each row. Sums of it over windows of time have the variance of
independent rows times an inflation, which grows with the window up to that of the errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Num

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.run.scan import Output
from trackwright.tuning.point import BESIDE, Point, plain_rows
from trackwright.tuning.problem import Problem

WINDOWS_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Lengths of the windows, s, each twice the one before."""

MIN_WINDOWS = 20
"""Windows of a length for an estimate of a variance to a third."""

FLAT = 1.05
"""Growth of the inflation from a window to one of twice the length below which it has reached that of the errors."""

NO_SCATTER = 1e-12
"""Scatter of ratios, relative to the sum of their squares, below which they are equal but for rounding."""

MIN_ROWS = 4
"""Rows of a window, on average, below which it is too short."""


class WindowSums(NamedTuple):
    """Of the ratios x = NIS/dof of rows: their number, Σ x and Σ x²; and sums over the windows of each of W lengths.

    `windows` (4, W): their number, Σ S², Σ S n and Σ n², where S is the sum of the n ratios in a window.
    """

    rows: float
    total: float
    squares: float
    windows: Float[np.ndarray, "4 W"]

    @property
    def inflations(self) -> Float[np.ndarray, " W"]:
        """The variance of sums over windows relative to that of independent rows; NaN with few windows."""
        mean = self.total / self.rows
        count, of_squares, of_products, of_sizes = self.windows
        scatter = self.squares - self.total * mean
        if scatter <= NO_SCATTER * self.squares:
            return np.full(len(count), np.nan)
        found = (of_squares - 2 * mean * of_products + mean**2 * of_sizes) / scatter
        return np.where(count < MIN_WINDOWS, np.nan, found)


def rows_and_inflation(problem: Problem, vector: Float[np.ndarray, " p"]) -> tuple[int, float]:
    """The rows with innovations at the vector (p,), and how many of them carry the information of one.

    1 for white innovations. Windows are lengthened until the inflation is flat, or the recordings are too short for
    longer ones; it is extrapolated in the inverse of the length, which removes most of what correlation beyond a window
    adds.
    """
    # Of few trajectories by the program that the starts were compared with.
    function, reduced = (plain_rows, _sums_of_rows) if problem.few else (_nis_of_rows, _sums)
    found = [one for (one,) in problem.parts.run(function, [np.atleast_2d(vector)], reduced)]
    sums = WindowSums(*(np.sum(np.stack(parts), axis=0) for parts in zip(*found, strict=True)))
    if sums.rows < MIN_WINDOWS:
        return int(sums.rows), 1.0
    before = last = 1.0
    for count, now in zip(sums.windows[0], sums.inflations, strict=True):
        if sums.rows < MIN_ROWS * count:
            continue
        if np.isnan(now):
            break
        flat, before, last = now < FLAT * last, last, float(now)
        if flat:
            break
    return int(sums.rows), max(1.0, last, 2 * last - before)


def window_sums(
    times: Float[np.ndarray, " n"],
    ratios: Float[np.ndarray, " n"],
    track: Num[np.ndarray, " n"],
    windows: Sequence[float] = WINDOWS_S,
) -> WindowSums:
    """The sums over windows of so many seconds; `track` (n,): the number of each row's trajectory, in order."""
    own = np.zeros((4, len(windows)))
    for k, window in enumerate(windows if len(times) else ()):
        first = np.flatnonzero(np.append(True, (np.diff(np.floor(times / window)) != 0) | (np.diff(track) != 0)))
        sums, sizes = np.add.reduceat(ratios, first), np.diff(np.append(first, len(times)))
        own[:, k] = len(first), sums @ sums, sums @ sizes, sizes @ sizes
    return WindowSums(len(times), float(ratios.sum()), float(ratios @ ratios), own)


def _sums_of_rows(found: Any, chunk: Batch) -> WindowSums:
    """As `_sums`, from `plain_rows`."""
    nis, dof = (found[0][0, BESIDE.index(name) - len(BESIDE)] for name in ("nis", "nis_dof"))
    return _sums((nis, dof), chunk)


def _sums(found: Any, chunk: Batch) -> WindowSums:
    """The sums of the rows of a chunk that have a NIS."""
    nis, dof = (np.asarray(x) for x in found)
    known = np.isfinite(nis) & (dof > 0) & np.asarray(chunk.valid)
    track, row = np.nonzero(known.T)
    times = np.cumsum(np.asarray(chunk.dt, float), axis=0)[row, track]
    return window_sums(times, nis[row, track].astype(float) / dof[row, track], track)


def _nis_of_rows(point: Point, batch: Batch) -> tuple[np.ndarray, np.ndarray]:
    """NIS and degrees of freedom of every row (T, B) at the point's first vector."""

    def score(output: Output, truth: object) -> tuple[np.ndarray, np.ndarray]:
        return output.nis, output.nis_dof

    nis, dof = point.tracker_at(point.vectors[0]).accumulate(batch, score, every_row=True)
    return nis, dof
