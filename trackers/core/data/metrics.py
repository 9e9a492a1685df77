"""Error metrics of estimates against truth, and the consistency of reported covariances (Bar-Shalom 2001, section 5.4).

    e  error, estimate − truth, (N, d)        P  reported covariance, (N, d, d)
    NEES  eᵀP⁻¹e, normalised estimation error squared        NIS  the same of an innovation

NumPy in double precision, on estimates and truth that are already associated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.core.data.chi_square import chi_square_quantile

Errors = Float[np.ndarray, "N d"]
Covariances = Float[np.ndarray, "N d d"]


class ErrorMetrics(NamedTuple):
    """Statistics of the norms of N error vectors, in the errors' unit; NaN for N = 0."""

    rmse: float
    median: float
    p90: float
    p95: float
    p99: float
    max: float


class Consistency(NamedTuple):
    """The mean of N chi-square values, its expectation, and its interval if the model is true."""

    mean: float
    expected: float
    low: float
    high: float
    n: int


class TimeLost(NamedTuple):
    """The time during which a track was lost: seconds, and the fraction of its duration."""

    seconds: float
    fraction: float


def error_metrics(errors: Errors) -> ErrorMetrics:
    """RMSE, median, 90th, 95th and 99th percentile and maximum of the error norms."""
    if len(errors) == 0:
        return ErrorMetrics(*[math.nan] * 6)
    return ErrorMetrics(rmse(errors), *percentiles(errors, (50.0, 90.0, 95.0, 99.0, 100.0)))


def rmse(errors: Errors) -> float:
    """The root of the mean squared norm of the errors."""
    return math.sqrt(_mean(np.einsum("nd,nd->n", errors, errors)))


def bias(errors: Errors) -> Float[np.ndarray, " d"]:
    """The mean error vector."""
    return errors.mean(axis=0) if len(errors) else np.full(errors.shape[1], math.nan)


def percentiles(errors: Errors, percents: tuple[float, ...]) -> list[float]:
    """Percentiles of the error norms, linear between order statistics (Hyndman & Fan 1996, definition 7)."""
    ordered = np.sort(np.sqrt(np.einsum("nd,nd->n", errors, errors)))
    ranks = np.asarray(percents) * ((len(ordered) - 1) / 100.0)
    return np.interp(ranks, np.arange(len(ordered)), ordered).tolist() if len(ordered) else [math.nan] * len(percents)


def nees(errors: Errors, covs: Covariances) -> Float[np.ndarray, " N"]:
    """NEES eᵀP⁻¹e of each row; NaN where P is not positive definite."""
    return nees_of_leading(errors, covs)[-1]


def nees_of_leading(errors: Errors, covs: Covariances) -> Float[np.ndarray, "d N"]:
    """NEES of the first axis, of the first two, … and of all d; NaN where their part of P is not positive definite.

    Elimination over the d columns, for all rows at once: a singular P affects its row alone.
    """
    # Each entry is a vector over the rows of the errors.
    remainder = [np.array(x, float) for x in errors.T]
    upper = {(i, j): np.array(covs[:, i, j], float) for i in range(len(remainder)) for j in range(i, len(remainder))}
    P = {(i, j): upper[min(i, j), max(i, j)] for i in range(len(remainder)) for j in range(len(remainder))}
    values: list[np.ndarray] = []
    # Covariances of a damaged file may overflow; the NEES of their rows is infinite or NaN.
    with np.errstate(over="ignore", invalid="ignore"):
        for j, reduced in enumerate(remainder):
            pivot = np.where(P[j, j] > 0, P[j, j], math.nan)
            value = reduced**2 / pivot
            values.append(values[-1] + value if values else value)
            for a in range(j + 1, len(remainder)):
                gain = P[a, j] / pivot
                remainder[a] = remainder[a] - gain * reduced
                for b in range(j + 1, len(remainder)):
                    P[a, b] = P[a, b] - gain * P[j, b]
    return np.stack(values) if values else np.zeros((0, len(errors)))


def consistency(
    values: Float[np.ndarray, " N"], dof: float | Float[np.ndarray, " N"], level: float = 0.95
) -> Consistency:
    """The mean NEES or NIS of N independent values and its two-sided interval (Bar-Shalom 2001, section 5.4.2).

    `dof`: degrees of freedom of each value; the sum of the values is chi-square with the sum of these. NaN is left out.
    Rows of one run with correlated errors are not independent: the interval is then too narrow.
    """
    known = np.isfinite(values)
    n, total = int(known.sum()), float(np.broadcast_to(dof, values.shape)[known].sum())
    if n == 0 or total <= 0:
        return Consistency(math.nan, math.nan, math.nan, math.nan, 0)
    low, high = (chi_square_quantile(p, total) / n for p in ((1 - level) / 2, (1 + level) / 2))
    return Consistency(_mean(values[known]), total / n, low, high, n)


def coverage(errors: Errors, covs: Covariances, level: float = 0.95) -> float:
    """The fraction of errors inside the reported ellipse of the given level; rows with an indefinite P are left out."""
    return covered(nees(errors, covs), errors.shape[1], level)


def covered(values: Float[np.ndarray, " N"], dof: int, level: float = 0.95) -> float:
    """The fraction of NEES values inside the ellipse of the given level; NaN is left out."""
    known = values[np.isfinite(values)]
    return _mean(known <= chi_square_quantile(level, dof))


def time_lost(times: Float[np.ndarray, " N"], lost: Bool[np.ndarray, " N"]) -> TimeLost:
    """The time during which a track was lost; a row's status holds until the next row.

    `times`: sorted, s. The fraction is of the time between first and last row, or of the rows if all have one time.
    """
    if len(times) == 0:
        return TimeLost(0.0, math.nan)
    seconds, span = float(np.diff(times) @ lost[:-1]), float(times[-1] - times[0])
    return TimeLost(seconds, seconds / span if span > 0 else _mean(lost))


def _mean(values: np.ndarray) -> float:
    return float(values.sum(dtype=float)) / values.size if values.size else math.nan
