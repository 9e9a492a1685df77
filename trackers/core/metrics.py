"""Error figures of estimates against truth, and whether the reported covariances deserve belief.

    e  error, estimate − truth, (N, d)        P  reported covariance, (N, d, d)
    NEES  eᵀP⁻¹e, normalised estimation error squared        NIS  the same of an innovation

Plain NumPy in double precision on arrays already matched; what is matched with what is not decided here.
"""

from __future__ import annotations

import functools
import math
from statistics import NormalDist
from typing import NamedTuple

import jax
import numpy as np
from jax.scipy.special import gammainc
from jaxtyping import Bool, Float

Errors = Float[np.ndarray, "N d"]
Covariances = Float[np.ndarray, "N d d"]


class ErrorMetrics(NamedTuple):
    """Figures of the lengths of N error vectors, in the errors' unit; NaN where N is zero."""

    rmse: float
    median: float
    p90: float
    p95: float
    p99: float
    max: float


class Consistency(NamedTuple):
    """The mean of chi-square values, what it should be, and the interval it lies in when the model is true."""

    mean: float
    expected: float
    low: float
    high: float
    n: int


class TimeLost(NamedTuple):
    """How long a track was lost: seconds, and the fraction of its span."""

    seconds: float
    fraction: float


def error_metrics(errors: Errors) -> ErrorMetrics:
    """RMSE, median, 90th, 95th and 99th percentile and maximum of the errors' lengths."""
    if len(errors) == 0:
        return ErrorMetrics(*[math.nan] * 6)
    return ErrorMetrics(rmse(errors), *percentiles(errors, (50.0, 90.0, 95.0, 99.0, 100.0)))


def rmse(errors: Errors) -> float:
    """The root of the mean squared length of the errors."""
    return math.sqrt(_mean(np.einsum("nd,nd->n", errors, errors)))


def bias(errors: Errors) -> Float[np.ndarray, " d"]:
    """The mean error vector."""
    return errors.mean(axis=0) if len(errors) else np.full(errors.shape[1], math.nan)


def percentiles(errors: Errors, percents: tuple[float, ...]) -> list[float]:
    """Percentiles of the errors' lengths, linear between order statistics (Hyndman & Fan 1996, definition 7)."""
    ordered = np.sort(np.sqrt(np.einsum("nd,nd->n", errors, errors)))
    ranks = np.asarray(percents) * ((len(ordered) - 1) / 100.0)
    return np.interp(ranks, np.arange(len(ordered)), ordered).tolist() if len(ordered) else [math.nan] * len(percents)


def distances_to_path(points: Float[np.ndarray, "N 2"], knots: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, " N"]:
    """The distance of each point from the nearest place of a polyline: the error where only the way is known, not when.

    An error along the way, as that of an estimate which comes late, does not show in it.
    """
    starts, ways = knots[:-1], np.diff(knots, axis=0)
    lengths = np.maximum(np.einsum("kd,kd->k", ways, ways), np.finfo(float).tiny)
    nearest = np.full(len(points), np.inf)
    for start, way, length in zip(starts, ways, lengths, strict=True):
        apart = points - start
        apart = apart - np.clip(apart @ way / length, 0.0, 1.0)[:, None] * way
        nearest = np.minimum(nearest, np.einsum("nd,nd->n", apart, apart))
    return np.sqrt(nearest)


def nees(errors: Errors, covs: Covariances) -> Float[np.ndarray, " N"]:
    """eᵀP⁻¹e of each row; NaN where P is not positive definite.

    By elimination over the d columns, all rows at once: a single singular P must not spoil the others.
    """
    # Rows last in memory: each step below then runs along one long vector.
    left, P = np.array(errors.T, float, order="C"), np.array(np.moveaxis(covs, 0, -1), float, order="C")
    value = np.zeros(left.shape[1])
    for j in range(len(left)):
        pivot = np.where(P[j, j] > 0, P[j, j], math.nan)
        value += left[j] ** 2 / pivot
        gain = P[j + 1 :, j] / pivot
        left[j + 1 :] -= gain * left[j]
        P[j + 1 :, j + 1 :] -= gain[:, None] * P[j, j + 1 :]
    return value


def consistency(
    values: Float[np.ndarray, " N"], dof: float | Float[np.ndarray, " N"], level: float = 0.95
) -> Consistency:
    """The mean NEES or NIS of N independent runs and its two-sided interval (Bar-Shalom 2001, section 5.4.2).

    `dof`: degrees of freedom of each value, which may differ from row to row. The sum of independent chi-square
    values is chi-square with the sum of the degrees; values that are NaN are left out. Rows of one run are not
    independent where errors last, so there the interval is too narrow.
    """
    known = np.isfinite(values)
    n, total = int(known.sum()), float(np.broadcast_to(dof, values.shape)[known].sum())
    if n == 0 or total <= 0:
        return Consistency(math.nan, math.nan, math.nan, math.nan, 0)
    low, high = (chi_square_quantile(p, total) / n for p in ((1 - level) / 2, (1 + level) / 2))
    return Consistency(_mean(values[known]), total / n, low, high, n)


def coverage(errors: Errors, covs: Covariances, level: float = 0.95) -> float:
    """The fraction of errors inside the reported ellipse of the given level; rows without a proper P left out."""
    return covered(nees(errors, covs), errors.shape[1], level)


def covered(values: Float[np.ndarray, " N"], dof: int, level: float = 0.95) -> float:
    """The fraction of NEES values inside the ellipse of the given level; values that are NaN are left out."""
    known = values[np.isfinite(values)]
    return _mean(known <= chi_square_quantile(level, dof))


def coverage_per_axis(errors: Errors, covs: Covariances, k: float) -> Float[np.ndarray, " d"]:
    """For each axis the fraction of errors within `k` reported standard deviations of zero."""
    variances = np.diagonal(covs, axis1=1, axis2=2)
    return np.array([_mean(e[v > 0] ** 2 <= k * k * v[v > 0]) for e, v in zip(errors.T, variances.T, strict=True)])


def time_lost(times: Float[np.ndarray, " N"], lost: Bool[np.ndarray, " N"]) -> TimeLost:
    """Time during which a track was lost; a row speaks for the time until the next one.

    `times`: sorted, s. The fraction is of the span of `times`, or of the rows where all share one time.
    """
    if len(times) == 0:
        return TimeLost(0.0, math.nan)
    seconds, span = float(np.diff(times) @ lost[:-1]), float(times[-1] - times[0])
    return TimeLost(seconds, seconds / span if span > 0 else _mean(lost))


def chi_square_cdf(x: float, dof: float) -> float:
    """The probability that a chi-square value with `dof` degrees of freedom is at most `x`."""
    # In single precision the incomplete gamma function is off by 3e-4 at 40,000 degrees of freedom.
    with jax.enable_x64(True):
        return float(gammainc(np.float64(dof / 2), np.float64(x / 2)))


def chi_square_density(x: Float[np.ndarray, " N"], dof: float) -> Float[np.ndarray, " N"]:
    """The density of chi-square with `dof` degrees of freedom at positive `x`."""
    a = dof / 2
    return np.exp((a - 1) * np.log(x) - x / 2 - a * math.log(2) - math.lgamma(a))


@functools.lru_cache(maxsize=4096)
def chi_square_quantile(probability: float, dof: float) -> float:
    """The value that a chi-square variable with `dof` degrees of freedom stays under with the given probability.

    Newton's method on the distribution function from the Wilson–Hilferty value, bisecting where a step would leave
    the bracket. Raises ValueError outside 0 < probability < 1 and dof > 0.
    """
    if not (0 < probability < 1 and dof > 0):
        raise ValueError(f"a chi-square quantile needs 0 < probability < 1 and dof > 0, found {probability} and {dof}")
    low, high = 0.0, dof + 10.0
    while chi_square_cdf(high, dof) < probability:
        low, high = high, 2 * high
    spread = 2 / (9 * dof)
    x = dof * (1 - spread + NormalDist().inv_cdf(probability) * math.sqrt(spread)) ** 3
    for _ in range(200):
        x = x if low < x < high else 0.5 * (low + high)
        excess = chi_square_cdf(x, dof) - probability
        low, high = (low, x) if excess > 0 else (x, high)
        density = float(chi_square_density(np.array([x]), dof)[0])
        step = excess / density if density > 0 else math.nan
        x -= step
        # The error after a Newton step is of the order of the step squared.
        if abs(step) <= 1e-8 * abs(x):
            break
    return x


def _mean(values: np.ndarray) -> float:
    return float(values.sum(dtype=float)) / values.size if values.size else math.nan
