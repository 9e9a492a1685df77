"""How large the errors of readings are, and how long and how far they last: of each angle of a station, each anchor.

An error is a stationary Gauss–Markov process b of standard deviation σ and correlation exp(−(Δt/τ + Δs/ℓ)) along time
and way (Gelb 1974, section 3.8), plus white noise of standard deviation ν. The four numbers are the most probable ones
under a wide prior, with intervals from the curvature in their logarithms. The likelihood is that of a Kalman filter
with the one state b/σ, which runs over the series of all sources and over all trial values at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.ndimage import median_filter

GAP_S, MOST = 0.5, 1000
"""Least time between the rows of a series, s, over which `bearings` averages readings that repeat, and their most."""

STEP_M = 0.1
"""Distance, m, of the corners along which a way is measured: the noise of a truth at rest adds nothing to it."""

NEIGHBOURS, SPIKE = 11, 6.0
"""Rows of a running median, and how many robust standard deviations from it a row is one that the tails of a
tracker's noise are for, and no Gauss–Markov error."""

TIME_S, WAY_M, WIDTH = 5.0, 1.0, 2.0
"""τ and ℓ before any recording, and the standard deviation of the logarithms of all four numbers: a factor of 50."""

DETERMINED = 0.7
"""Largest standard deviation of a logarithm that counts as determined, as a share of that before any recording."""

Source = TypeVar("Source")

_STEPS, _DIFFERENCE, _CONVERGED = 40, 0.03, 1e-3
_SHARES = np.array([1.0, 0.5, 0.2, 0.05, 0.01])


class Series(NamedTuple):
    """Errors of one source along the path of one tag: `times` (N,) s, `way` (N,) m, `errors` (N,) rad or m."""

    times: np.ndarray
    way: np.ndarray
    errors: np.ndarray


class LastingErrors(NamedTuple):
    """Most probable values (4,) of σ and ν, rad or m, τ, s, and ℓ, m; `sigmas` (4,): those of their logarithms."""

    values: np.ndarray
    sigmas: np.ndarray

    @property
    def intervals(self) -> np.ndarray:
        """95 % intervals (4, 2)."""
        return self.values[:, None] * np.exp(1.96 * self.sigmas[:, None] * np.array([-1.0, 1.0]))

    @property
    def determined(self) -> np.ndarray:
        """Whether the recordings determine each number (4,), rather than its prior."""
        return self.sigmas < DETERMINED * WIDTH


def series_of(times: np.ndarray, positions: np.ndarray, errors: np.ndarray) -> Series:
    """The errors (N,) of rows in the order of time, at positions (N, 3), m, thinned and without spikes and gaps."""
    seen = np.flatnonzero(np.isfinite(errors))
    if not len(seen):
        return Series(*(np.zeros(0),) * 3)
    cell = np.floor((times[seen] - times[seen[0]]) / max(GAP_S, float(np.ptp(times[seen])) / MOST))
    kept = seen[np.append(True, np.diff(cell) > 0)]
    away = np.abs(errors[kept] - median_filter(errors[kept], NEIGHBOURS, mode="mirror"))
    limit = SPIKE * 1.4826 * float(np.median(away))
    # Where most readings repeat the one before, the median is zero.
    kept = kept[away <= limit] if limit > 0.0 else kept
    way, begun, corner, far = np.zeros(len(kept)), 0.0, positions[kept[0]], 0.0
    for k, position in enumerate(positions[kept]):
        far = max(far, float(np.linalg.norm(position - corner)))
        way[k] = begun + far
        if far >= STEP_M:
            begun, corner, far = way[k], position, 0.0
    return Series(times[kept], way, errors[kept])


def lasting_errors(series: Mapping[Source, Sequence[Series]]) -> dict[Source, LastingErrors]:
    """The numbers of each source with rows, by damped Newton steps with differences, all sources at once."""
    series = {name: kept for name, given in series.items() if (kept := [one for one in given if len(one.times)])}
    if not series:
        return {}
    source = np.repeat(np.arange(len(series)), [len(given) for given in series.values()])
    rows = side_by_side([one for given in series.values() for one in given])
    sizes = [np.sqrt(np.mean(np.concatenate([one.errors for one in given]) ** 2)) for given in series.values()]
    prior = np.log([[size + 1e-9, 0.5 * size + 1e-9, TIME_S, WAY_M] for size in sizes])

    def log_posterior(logarithms: np.ndarray) -> np.ndarray:
        """Of trial values (G, sources, 4) the log-density (G, sources)."""
        of_series = log_likelihood(rows, np.moveaxis(np.exp(logarithms), 2, 0)[:, :, source])
        sums = np.stack([of_series[:, source == k].sum(axis=1) for k in range(len(series))], axis=1)
        return sums - 0.5 * (((logarithms - prior) / WIDTH) ** 2).sum(axis=2)

    logarithms = prior
    for _ in range(_STEPS):
        value, gradient, information = _quadratic(log_posterior, logarithms)
        eigenvalues, axes = np.linalg.eigh(information)
        curvature = np.maximum(np.abs(eigenvalues), 1.0 / WIDTH**2)
        step = np.einsum("nij,nj,nkj,nk->ni", axes, 1.0 / curvature, axes, gradient)
        step /= np.maximum(np.abs(step).max(axis=1, keepdims=True), 1.0)
        trials = logarithms + _SHARES[:, None, None] * step
        values = log_posterior(trials)
        best = values.argmax(axis=0), np.arange(len(series))
        gain = values[best] - value
        logarithms = np.where((gain > 0.0)[:, None], trials[best], logarithms)
        if (gain < _CONVERGED).all():
            break
    variances = np.einsum("nij,nj,nij->ni", axes, 1.0 / curvature, axes)
    return {name: LastingErrors(np.exp(logarithms[k]), np.sqrt(variances[k])) for k, name in enumerate(series)}


class SideBySide(NamedTuple):
    """S series side by side, padded after the shorter ones: times and ways since the row before, errors (T, S)."""

    elapsed: np.ndarray
    gone: np.ndarray
    errors: np.ndarray
    seen: np.ndarray


def side_by_side(series: Sequence[Series]) -> SideBySide:
    """The series in arrays of common length; the first row of each follows nothing."""
    shape = max(len(one.times) for one in series), len(series)
    rows = SideBySide(np.full(shape, np.inf), np.zeros(shape), np.zeros(shape), np.zeros(shape, bool))
    for k, one in enumerate(series):
        count = len(one.times)
        rows.elapsed[1:count, k], rows.gone[1:count, k] = np.diff(one.times), np.diff(one.way)
        rows.errors[:count, k], rows.seen[:count, k] = one.errors, True
    return rows


def log_likelihood(rows: SideBySide, values: np.ndarray) -> np.ndarray:
    """The log-likelihood (G, S) of S series at trial values (4, G, S) of σ, ν, τ and ℓ."""
    sigma, noise, time_constant, length = values
    mean, variance, total = np.zeros_like(sigma), np.ones_like(sigma), np.zeros_like(sigma)
    for elapsed, gone, error, seen in zip(*rows, strict=True):
        kept = np.exp(-(elapsed / time_constant + gone / length))
        mean, variance = kept * mean, 1.0 - kept * kept * (1.0 - variance)
        spread = sigma * sigma * variance + noise * noise
        innovation = error - sigma * mean
        total -= np.where(seen, 0.5 * (np.log(2.0 * np.pi * spread) + innovation**2 / spread), 0.0)
        gain = np.where(seen, sigma * variance / spread, 0.0)
        mean, variance = mean + gain * innovation, variance * (1.0 - gain * sigma)
    return total


def _quadratic(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> tuple[np.ndarray, ...]:
    """Value (n,), gradient (n, p) and negative Hessian (n, p, p) of n functions at (n, p), by central differences."""
    unit = _DIFFERENCE * np.eye(at.shape[1])
    pairs = [(i, j) for i in range(len(unit)) for j in range(i)]
    moves = [0.0 * unit[0], *unit, *-unit]
    moves += [a * unit[i] + b * unit[j] for i, j in pairs for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    values = function(at + np.array(moves)[:, None])
    middle, ahead, behind, corners = np.split(values, [1, 1 + len(unit), 1 + 2 * len(unit)])
    information = np.zeros((*at.shape, at.shape[1]))
    for k in range(len(unit)):
        information[:, k, k] = -(ahead[k] - 2.0 * middle[0] + behind[k]) / _DIFFERENCE**2
    for (i, j), (a, b, c, d) in zip(pairs, corners.reshape(len(pairs), 4, -1), strict=True):
        information[:, i, j] = information[:, j, i] = -(a - b - c + d) / (4.0 * _DIFFERENCE**2)
    return middle[0], ((ahead - behind) / (2.0 * _DIFFERENCE)).T, information
