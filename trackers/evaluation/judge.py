"""What a perfect filter reaches with errors as correlated in time as these, and proper scores of its estimates.

The mean NEES per degree of freedom of n independent errors of a perfect filter is chi-square with n·d degrees of
freedom over n·d. Errors that last are fewer: the variance of a mean of squares falls with the sum of the squared
autocorrelation of the errors (Bartlett 1946; window of Sokal 1997), so that n rows count as n/τ.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.data.consistency import chi_square_quantile

LEAST_SAMPLES = 8.0
"""Effective samples below which a recording is too short for a verdict."""

UNCERTAIN = 3.0
"""The band is that of n²/(n + 3) samples: n itself is estimated, which matters below some 20 samples."""

WINDOW = 3.0
"""Lags up to which the autocorrelation is summed, in correlation times of the sum so far."""

NODES, WEIGHTS = np.polynomial.legendre.leggauss(48)
CHUNK = 50_000


def correlation_time(values: Float[np.ndarray, "n d"], starts: np.ndarray, power: int = 2) -> float:
    """Rows with the information of one on the mean of squares of values of mean zero; 1 at least.

    `starts`: the first row of each track, then n. `power`: 1 for the mean of the values themselves.
    """
    lengths = np.diff(starts)
    longest = int(lengths.max(initial=0))
    if longest < 2 or not values.any():
        return 1.0
    size, lags = 1 << (2 * longest - 1).bit_length(), np.arange(longest)
    products, pairs = np.zeros((2, longest))
    for a, b in pairwise(starts.tolist()):
        if b > a:
            spectrum = (np.abs(np.fft.rfft(values[a:b], size, axis=0)) ** 2).sum(axis=1)
            products[: b - a] += np.fft.irfft(spectrum, size)[: b - a]
            pairs[: b - a] += np.arange(b - a, 0, -1)
    correlation = products / pairs / (products[0] / pairs[0])
    time = 1.0 + 2.0 * np.cumsum((correlation**power * pairs / pairs[0])[1:])
    enough = np.flatnonzero(lags[1:] >= WINDOW * time)
    return max(float(time[enough[0] if len(enough) else -1]), 1.0)


def whitened(errors: Float[np.ndarray, "n d"], covs: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, "n d"]:
    """Errors in standard deviations: L⁻¹e with the positive definite covariances L Lᵀ."""
    white: np.ndarray = np.linalg.solve(np.linalg.cholesky(covs), errors[..., None])[..., 0]
    return white


def band(samples: np.ndarray, dof: int) -> tuple[np.ndarray, np.ndarray]:
    """The 95 % limits (g,) of NEES per degree of freedom of a perfect filter with so many effective samples (g,)."""
    n = dof * samples**2 / (samples + UNCERTAIN)
    low, high = ([chi_square_quantile(p, x) / x if x > 0 else math.nan for x in n.tolist()] for p in (0.025, 0.975))
    return np.array(low), np.array(high)


def regret(ratio: np.ndarray) -> np.ndarray:
    """Nats per position lost by the scale r of covariances alone: r − 1 − ln r, r = NEES/dof."""
    return ratio - 1 - np.log(ratio)


def energy_scores(errors: Float[np.ndarray, "n d"], covs: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, " n"]:
    """E|X − y| − ½E|X − X′| (n,), m, of normal X and X′ and the truth y (Gneiting and Raftery 2007)."""
    scores = np.empty(len(errors))
    for a in range(0, len(errors), CHUNK):
        part = slice(a, a + CHUNK)
        variances, axes = np.linalg.eigh(covs[part])
        variances = np.maximum(variances, 0.0)
        along = np.einsum("nji,nj->ni", axes, errors[part])
        scores[part] = _mean_norm(along, variances) - 0.5 * _mean_norm(0 * along, 2 * variances)
    return scores


def _mean_norm(mean: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """The mean length (n,) of normal vectors with this mean and these variances along their axes (n, d).

    E√Q = π^(−½) ∫ (1 − E exp(−t²Q))/t² dt over t > 0, with t = tan θ over the root of EQ, by Gauss and Legendre.
    """
    scale = np.sqrt((mean**2 + variances).sum(axis=1))[:, None]
    angle = np.pi / 4 * (1 + NODES)
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = (np.tan(angle) / scale)[..., None] ** 2
        spread = 1 + 2 * squares * variances[:, None]
        exponent = -squares * mean[:, None] ** 2 / spread - 0.5 * np.log(spread)
        integrand = -np.expm1(exponent.sum(axis=-1)) / np.sin(angle) ** 2
    return np.where(scale[:, 0] > 0, scale[:, 0] * (integrand @ WEIGHTS) * np.sqrt(np.pi) / 4, 0.0)
