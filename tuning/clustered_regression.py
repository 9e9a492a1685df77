"""Robust linear regressions with a normal prior, whose errors are correlated within pieces of time and within places.

Symbols: x, factors of the terms; w, weights of rows; A, information of the rows; B, covariance of their score; P, the
prior precision; D, the design effect, by which B exceeds A. The tempered posterior has the Hessian H = A/D + P, so that
the prior has its proper weight, and the covariance of the terms is H⁻¹ (B/D² + P) H⁻¹: the prior's for terms
that the rows do not determine, the clustered sandwich A⁻¹ B A⁻¹ for those that they do.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.stats import t as student_t

from trackwright.trackers.recordings.columns import within_groups

DOF = 4.0  # degrees of freedom of Student's t of the errors
POOLED = 10.0  # clusters that the design effect of all regressions counts as, beside a regression's own
MOST = 100  # the most rows of one place in one piece of time, evenly spaced: their errors are dependent
LEAST_SPARE = 2.0  # least degrees of freedom of a variance: with one, intervals would be 13 standard deviations wide
SMALLEST = 1e-6  # least scale of the errors, rad or m, below any resolution of a reading

_ROUNDS, _STEPS = 8, 10


class Rows(NamedTuple):
    """The rows of a regression: `x` (N, p), `y` (N,), and the numbers of recording, piece of time and place (N,)."""

    x: np.ndarray
    y: np.ndarray
    recording: np.ndarray
    piece: np.ndarray
    place: np.ndarray


class Regression(NamedTuple):
    """Terms (p,) with their covariance (p, p), and the scale of Student's t of the errors."""

    terms: np.ndarray
    covariance: np.ndarray
    scale: float


def regressions(rows: Mapping[str, Rows], mean: np.ndarray, sigmas: np.ndarray) -> dict[str, Regression]:
    """The regressions of several sources of a kind, with the normal prior `mean`, `sigmas` (p,) of their terms.

    Errors are of Student's t; each recording has the same weight, and of one place in one piece of time at most `MOST`
    rows count. The design effects of the sources are pooled where their own clusters are few.
    """
    fits = {name: _fit(of_source, mean, sigmas, None) for name, of_source in rows.items()}
    spare = {name: max(clusters - len(mean), 0.0) for name, (_, _, clusters) in fits.items()}
    total = sum(spare.values())
    result = {}
    for name, of_source in rows.items():
        pooled = sum(spare[k] * effect for k, (_, effect, _) in fits.items()) / total if total > 0.0 else fits[name][1]
        result[name] = _fit(of_source, mean, sigmas, (pooled, total))[0]
    return result


def _fit(
    rows: Rows, mean: np.ndarray, sigmas: np.ndarray, pooled: tuple[float, float] | None
) -> tuple[Regression, float, float]:
    """A regression, its design effect and clusters; `pooled`: the effect of all of them, and its degrees of freedom."""
    rows, cells = _in_order(rows)
    x, y, begins = rows.x, rows.y, np.flatnonzero(np.append(True, np.diff(cells) != 0))
    clusterings = [_numbered(c[begins]) for c in (rows.piece, rows.place)]
    recording = _numbered(rows.recording)
    totals = np.bincount(recording)
    weights = (totals.mean() / totals)[recording]
    clusters = min(_effective(c, np.add.reduceat(weights, begins)) for c in clusterings)
    precision = np.diag(1.0 / sigmas**2)
    terms, effect = mean.copy(), 1.0
    sigma = max(float(np.median(np.abs(y - x @ mean))), SMALLEST)
    for _ in range(_ROUNDS):
        for _ in range(_STEPS):
            robust = _robust(weights, (y - x @ terms) / sigma)
            moments = (x * robust[:, None]).T @ np.column_stack([x, y]) / (sigma**2 * effect)
            terms = np.linalg.solve(moments[:, :-1] + precision, moments[:, -1] + precision @ mean)
            residuals = y - x @ terms
            sigma = max(
                float(np.sqrt((_robust(weights, residuals / sigma) * residuals**2).sum() / weights.sum())), SMALLEST
            )
        robust = _robust(weights, residuals / sigma)
        weighted = x * (robust / sigma**2)[:, None]
        scores = np.add.reduceat(weighted * residuals[:, None], begins)
        curved = _curvature(residuals / sigma, weights) / robust.sum()
        parts = np.add.reduceat(curved * weighted[:, :, None] * x[:, None, :], begins)
        A = parts.sum(axis=0)
        H = A / effect + precision
        alone = _scatter(np.arange(len(begins)), scores, parts / effect, H)
        B = _positive(sum(_scatter(c, scores, parts / effect, H) for c in clusterings) - alone)
        effect = max(float(np.trace(np.linalg.solve(A + precision, B))) / len(mean), 1e-3)
        if pooled is not None:
            spare = max(clusters - len(mean), 0.0)
            more = min(POOLED, max(pooled[1] - spare, 0.0))
            B = (clusters * B + more * pooled[0] * A) / (clusters + more)
            effect = (clusters * effect + more * pooled[0]) / (clusters + more)
            # Few clusters widen the variance, so that ±1.96 standard deviations hold 95 %.
            wider = float(student_t.ppf(0.975, max(spare + more, LEAST_SPARE)) / student_t.ppf(0.975, np.inf)) ** 2
            B, effect = B * wider, effect * wider
    inverse = np.linalg.inv(A / effect + precision)
    covariance = inverse @ (B / effect**2 + precision) @ inverse
    return Regression(terms, 0.5 * (covariance + covariance.T), sigma), effect, clusters


def _in_order(rows: Rows) -> tuple[Rows, np.ndarray]:
    """At most `MOST` rows of each place in a piece of time, together, and the number of each row's place and piece."""
    cells = np.unique(np.stack([rows.piece, rows.place]), axis=1, return_inverse=True)[1].ravel()
    order = np.argsort(cells, kind="stable")
    counts = np.bincount(cells)
    kept = order[within_groups(counts) % -(-counts[cells[order]] // MOST) == 0]
    return Rows(*(column[kept] for column in rows)), cells[kept]


def _numbered(numbers: np.ndarray) -> np.ndarray:
    """The numbers as indices from 0 up."""
    return np.unique(numbers, return_inverse=True)[1].ravel()


def _effective(clusters: np.ndarray, weights: np.ndarray) -> float:
    """The number of clusters, as many of equal weight as have the same scatter."""
    totals = np.bincount(clusters, weights)
    return float(totals.sum() ** 2 / (totals**2).sum())


def _robust(weights: np.ndarray, whitened: np.ndarray) -> np.ndarray:
    """The weights times Student's t's for whitened residuals."""
    return weights * (DOF + 1.0) / (DOF + whitened**2)


def _curvature(whitened: np.ndarray, weights: np.ndarray) -> float:
    """The second derivative of −log of Student's t, summed; at least a tenth of a normal distribution's."""
    squares = whitened**2
    second = (DOF + 1.0) * (DOF - squares) / (DOF + squares) ** 2
    return max(float((weights * second).sum()), 0.1 * float(weights.sum()))


def _scatter(clusters: np.ndarray, scores: np.ndarray, parts: np.ndarray, hessian: np.ndarray) -> np.ndarray:
    """The sum of squared scores (p, p) of clusters, each as if the terms had been fitted without it.

    Cameron and Miller 2015, CR3. `scores` (n, p) and `parts` (n, p, p) of the Hessian: of the rows of each cluster.
    """
    count = clusters.max() + 1
    sums, cluster_hessians = np.zeros((count, scores.shape[1])), np.zeros((count, *parts.shape[1:]))
    np.add.at(sums, clusters, scores)
    np.add.at(cluster_hessians, clusters, parts)
    adjusted = (hessian @ np.linalg.solve(hessian - cluster_hessians, sums[:, :, None]))[:, :, 0]
    return adjusted.T @ adjusted


def _positive(matrix: np.ndarray) -> np.ndarray:
    """The symmetric matrix without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def with_least_slope(regression: Regression, slopes: np.ndarray, least: float) -> Regression:
    """The nearest terms, in the metric of their covariance, with `slopes @ terms` (k,) at least `least`.

    The least-distance problem of Lawson and Hanson 1974, chapter 23, by non-negative least squares.
    """
    lacking = least - slopes @ regression.terms
    if (lacking <= 0.0).all():
        return regression
    factor = np.linalg.cholesky(regression.covariance)
    system = np.vstack([(slopes @ factor).T, lacking])
    target = np.append(np.zeros(len(regression.terms)), 1.0)
    residual = system @ nnls(system, target)[0] - target
    return regression._replace(terms=regression.terms - factor @ (residual[:-1] / residual[-1]))
