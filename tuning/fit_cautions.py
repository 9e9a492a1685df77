"""What speaks against a finished fit: it stood still, a level collapsed, rows are correlated.

Correlated innovations inflate the variance of the likelihood's scores: a noise level's is about NIS − dof of each
row. Sums of it over windows of time have the variance of independent rows times an inflation, which grows with the
window up to the errors'.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Num

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.tunable import Scale
from trackwright.tuning.parameters import Parameter, split
from trackwright.tuning.parts import BESIDE, Computation, Point, plain_rows
from trackwright.tuning.problem import Problem
from trackwright.tuning.uncertainty import Uncertainty

COLLAPSED = 1e-3
"""Part of its starting value below which a noise level has collapsed."""

MOVED = 1e-6
"""Change in unconstrained coordinates below which a fit has not moved."""

INFLATION = 2.0
"""Rows with the information of one from which on innovations are correlated."""


def standstill(start: Float[np.ndarray, " p"], end: Float[np.ndarray, " p"], selected: bool = False) -> list[str]:
    """A clause where a fit found no better point than its start; `selected`: by held-out recordings."""
    if np.max(np.abs(end - start), initial=0.0) >= MOVED:
        return []
    where = " on the held-out recordings" if selected else ""
    return [f"the fit did not move from its starting values: no other point tried has a better objective{where}"]


def collapsed(
    parameters: Sequence[Parameter],
    start: Float[np.ndarray, " p"],
    end: Float[np.ndarray, " p"],
    uncertainty: Uncertainty | None = None,
) -> Iterator[str]:
    """Clauses on noise levels that fell to a thousandth of their start where the recordings do not determine them."""
    for (parameter, first), (_, last) in zip(split(parameters, start), split(parameters, end), strict=True):
        fell = isinstance(parameter.example, Scale) and np.min(last - first) < math.log(COLLAPSED)
        if fell and not _determined(uncertainty, parameter):
            yield (
                f"{parameter.label} collapsed to {float(np.exp(last.min())):.3g} {parameter.example.unit}, less than a "
                "thousandth of its starting value: give bounds"
            )


def _determined(uncertainty: Uncertainty | None, parameter: Parameter) -> bool:
    """Whether a noise level has a standard error below its value."""
    if uncertainty is None:
        return False
    sigmas = np.where(uncertainty.undetermined | uncertainty.at_bound, np.inf, uncertainty.sigmas)
    return any(p.label == parameter.label and np.all(x < 1.0) for p, x in split(uncertainty.parameters, sigmas))


def correlation(problem: Problem, vector: Float[np.ndarray, " p"]) -> list[str]:
    """A clause where errors are correlated: the effective number of rows."""
    rows, inflation = rows_and_inflation(problem, vector)
    if inflation < INFLATION:
        return []
    what = "errors" if problem.objective.needs_truth else "innovations"
    return [f"{what} are correlated over time: {rows} rows carry the information of about {rows / inflation:.0f}"]


WINDOWS_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Lengths of the windows, s, each twice the one before."""

MIN_WINDOWS = 20
"""Windows of a length for an estimate of a variance to a third."""

FLAT = 1.05
"""Growth of the inflation from a window to one of twice the length below which it has reached the errors'."""

NO_SCATTER = 1e-12
"""Scatter of ratios, relative to the sum of their squares, below which they are equal but for rounding."""

MIN_ROWS = 4
"""Rows of a window, on average, below which it is too short."""


class WindowSums(NamedTuple):
    """Of the ratios x of square and dof of rows: number, Σ x and Σ x²; and sums over the windows of each of W lengths.

    `windows` (4, W): their number, Σ S², Σ S n and Σ n², where S is the sum of the n ratios in a window.
    """

    rows: float
    total: float
    squares: float
    windows: Float[np.ndarray, "4 W"]

    @property
    def inflations(self) -> Float[np.ndarray, " W"]:
        """The variance of sums over windows relative to independent rows'; NaN with few windows."""
        mean = self.total / self.rows
        count, of_squares, of_products, of_sizes = self.windows
        scatter = self.squares - self.total * mean
        if scatter <= NO_SCATTER * self.squares:
            return np.full(len(count), np.nan)
        inflations = (of_squares - 2 * mean * of_products + mean**2 * of_sizes) / scatter
        return np.where(count < MIN_WINDOWS, np.nan, inflations)


def rows_and_inflation(problem: Problem, vector: Float[np.ndarray, " p"]) -> tuple[int, float]:
    """The rows that count at the vector (p,), and how many of them carry the information of one.

    1 for white errors. Windows are lengthened until the inflation is flat, or the recordings are too short for
    longer ones; it is extrapolated in the inverse of the length, which removes most of what correlation beyond a window
    adds.
    """
    # Of few trajectories by the program that the starts were compared with.
    function, reduced = (plain_rows, _sums_of_rows) if problem.few else (_squares_of_rows, _sums)
    computation = Computation(function, [np.atleast_2d(vector)], reduced)
    by_chunk = [chunk_sums for (chunk_sums,) in problem.parts.compute(computation)]
    sums = WindowSums(*(np.sum(np.stack(parts), axis=0) for parts in zip(*by_chunk, strict=True)))
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
    of_windows = np.zeros((4, len(windows)))
    for k, window in enumerate(windows if len(times) else ()):
        first = np.flatnonzero(np.append(True, (np.diff(np.floor(times / window)) != 0) | (np.diff(track) != 0)))
        sums, sizes = np.add.reduceat(ratios, first), np.diff(np.append(first, len(times)))
        of_windows[:, k] = len(first), sums @ sums, sums @ sizes, sizes @ sizes
    return WindowSums(len(times), float(ratios.sum()), float(ratios @ ratios), of_windows)


def _sums_of_rows(results: Any, chunk: Batch) -> WindowSums:
    """As `_sums`, from `plain_rows`."""
    return _sums(results[0][0, -BESIDE:], chunk)


def _sums(results: Any, chunk: Batch) -> WindowSums:
    """The sums of the rows of a chunk that have an error."""
    squares, dof = (np.asarray(x) for x in results)
    known = np.isfinite(squares) & (dof > 0) & np.asarray(chunk.valid)
    track, row = np.nonzero(known.T)
    times = np.cumsum(np.asarray(chunk.dt, float), axis=0)[row, track]
    return window_sums(times, squares[row, track].astype(float) / dof[row, track], track)


def _squares_of_rows(point: Point, batch: Batch) -> tuple[np.ndarray, np.ndarray]:
    """Square and degrees of freedom of every row's error (T, B) at the point's first vector."""
    squares = point.objective.squares
    return point.tracker_at(point.vectors[0]).accumulate(batch, squares, every_row=True)
