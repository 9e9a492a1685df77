"""What a likelihood counts for beside the prior: the effective rows, and what left-out recordings tell.

A fit is run on other recordings. Errors that last tell less than as many independent ones, and levels differ from
recording to recording: the more of these, the more a fit to them is to be trusted, and the less if they contradict it.

Correlated innovations inflate the variance of the likelihood's scores: a noise level's is about NIS − dof of each
row. Sums of it over windows of time have the variance of independent rows times an inflation, which grows with the
window up to the errors'.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Num

from trackwright.trackers.core.data.recording import Batch
from trackwright.tuning.optimisation import FitState, MultiStart, initial_state
from trackwright.tuning.problem import BESIDE, Point, Problem, plain_rows, weighted_sum
from trackwright.tuning.uncertainty import optimum, refit

MOST_ROWS = 4.0  # most independent estimates that a recording counts for: levels of errors differ between recordings
RATIO = 4.0  # ratio of the weights that left-out recordings may ask for, two steps from the first at most
FOLDS, ROUNDS = 4, 4  # most parts of the recordings that are left out in turn; steps of each fit without one
MORE = 1.5  # growth of the part of a likelihood that counts, from the start to the best point, with which a fit goes on
BETTER = 0.02  # gain in left-out recordings, nats per unit of the objective, from which on they ask for another weight


def discount(problem: Problem, vector: Float[np.ndarray, " p"], recordings: int) -> float:
    """The part of a likelihood's nats at a vector (p,) that counts, of errors that last and unequal weights.

    With an objective that needs truth none of the `recordings` counts for more than `MOST_ROWS`.
    """
    rows = np.concatenate(problem.rows).astype(float)
    part = min(problem.weights @ rows / (problem.weights**2 @ rows), 1.0) / rows_and_inflation(problem, vector)[1]
    if not problem.objective.needs_truth:
        return float(part)
    terms = problem.terms(vector)[0]
    nats = problem.objective.nats_per_unit(terms[:, np.isfinite(terms).all(axis=0)].sum(axis=1))
    return float(part / (1.0 + part * nats / (MOST_ROWS * recordings)))


def tempered_anew(driver: MultiStart, state: FitState) -> FitState:
    """The state of a finished fit without truth, or with another best point, where more of its nats count there.

    At levels that are far off innovations are correlated that are not at the fitted ones.
    """
    problem, winner = driver.problem, int(np.argmin(state.best_scores))
    vector = state.best_vectors[winner]
    if problem.objective.needs_truth or not (part := discount(problem, vector, 1)) > MORE * problem.discount:
        return state
    problem.discount = part
    again = driver.finished(initial_state(driver, vector, 1))
    return _with_best(state, winner, again.best_vectors[0], again.best_scores[0])


def weighed_anew(driver: MultiStart, state: FitState, recordings: Sequence[str]) -> FitState:
    """The state of a finished fit, or with another best point, where recordings left out ask for another weight.

    The likelihood's weight is divided by `RATIO`, or with three or more recordings multiplied, while fits without a
    part of the recordings get better on it, by more than a standard error. `recordings`: of each trajectory, empty for
    padding.
    """
    problem, winner = driver.problem, int(np.argmin(state.best_scores))
    names, of_trajectory = list(dict.fromkeys(name for name in recordings if name)), np.asarray(recordings)
    if len(names) < 2 or np.array_equal(state.best_vectors[winner], problem.prior.mean):
        return state
    left_out = np.stack([np.isin(of_trajectory, names[k::FOLDS]) for k in range(min(len(names), FOLDS))])
    others, every = (of_trajectory != "") & ~left_out, problem.valid[None]
    at, before = optimum(problem, state.best_vectors[winner]), problem.prior.mean

    def fitted(factor: float, count: Bool[np.ndarray, "S n"]) -> Float[np.ndarray, "S p"]:
        # Where the prior weighs more, the fit is to be found near its mean.
        starts = np.tile(at.vector if factor >= 1.0 else before, (len(count), 1))
        hessian = at.hessian + np.diag(at.prior * (1.0 / factor - 1.0))
        return np.clip(refit(problem, starts, hessian, None, factor * count, ROUNDS)[0], driver.low, driver.high)

    def scores(factor: float) -> Float[np.ndarray, " S"]:
        terms = problem.terms(fitted(factor, others))
        return problem.values_of(weighted_sum(terms, np.isfinite(terms).all(axis=1) & left_out))

    best, least = 1.0, scores(1.0)
    # Two recordings have one difference, which does not tell by how much recordings differ.
    for ratio in (1 / RATIO, RATIO)[: len(names) - 1]:
        for factor in (ratio, ratio**2) if best == 1.0 else ():
            gains = least - (values := scores(factor))
            if not gains.mean() > max(BETTER, gains.std(ddof=1) / len(gains) ** 0.5):
                break
            best, least = factor, values
    if best == 1.0:
        return state
    vector = fitted(best, every)[0]
    problem.discount *= best
    return _with_best(state, winner, vector, problem.values(vector)[0])


def _with_best(state: FitState, winner: int, vector: Float[np.ndarray, " p"], score: float) -> FitState:
    """The state with another best point (p,) of the start that won, and its score."""
    best_vectors, best_scores = state.best_vectors.copy(), state.best_scores.copy()
    best_vectors[winner], best_scores[winner] = vector, score
    return state._replace(best_vectors=best_vectors, best_scores=best_scores)


WINDOWS_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # lengths of the windows, s, each twice the one before
MIN_WINDOWS = 20  # windows of a length for an estimate of a variance to a third
FLAT = 1.05  # growth of the inflation from a window to one of twice the length below which it has reached the errors'
NO_SCATTER = 1e-12  # scatter of ratios, as a share of their squares, below which they are equal but for rounding
MIN_ROWS = 4  # rows of a window, on average, below which it is too short


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

    1 for white errors. Windows are lengthened until the inflation is flat, or the recordings are too short for longer
    ones; it is extrapolated in the inverse of the length, which removes most of what correlation beyond a window adds.
    """
    # Of few trajectories by the program that the starts were compared with.
    of_rows = plain_rows, lambda rows, chunk: _sums(rows[0][0, -BESIDE:], chunk)
    function, reduced = of_rows if problem.few else (_squares_of_rows, _sums)
    by_chunk = [chunk_sums for (chunk_sums,) in problem.compute(function, [np.atleast_2d(vector)], reduced)]
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
    times: Float[np.ndarray, " n"], ratios: Float[np.ndarray, " n"], track: Num[np.ndarray, " n"],
    windows: Sequence[float] = WINDOWS_S,
) -> WindowSums:  # fmt: skip
    """The sums over windows of so many seconds; `track` (n,): the number of each row's trajectory, in order."""
    of_windows = np.zeros((4, len(windows)))
    for k, window in enumerate(windows if len(times) else ()):
        first = np.flatnonzero(np.append(True, (np.diff(np.floor(times / window)) != 0) | (np.diff(track) != 0)))
        sums, sizes = np.add.reduceat(ratios, first), np.diff(np.append(first, len(times)))
        of_windows[:, k] = len(first), sums @ sums, sums @ sizes, sizes @ sizes
    return WindowSums(len(times), float(ratios.sum()), float(ratios @ ratios), of_windows)


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
