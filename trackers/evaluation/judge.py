"""What a perfect filter reaches with errors as correlated in time as these, and proper scores of its estimates.

The mean NEES per degree of freedom of n independent errors of a perfect filter is chi-square with n·d degrees of
freedom over n·d. Errors that last are fewer: the variance of a mean of squares falls with the sum of the squared
autocorrelation of the errors (Bartlett 1946; window of Sokal 1997), so that n rows count as n/τ.
"""

from __future__ import annotations

import numpy as np
import polars as pl
from jaxtyping import Float

LEAST_SAMPLES = 8.0
"""Effective samples below which a recording is too short for a verdict."""

UNCERTAIN = 3.0
"""The band belongs to n²/(n + 3) samples: n itself is estimated, which matters below some 20 samples."""

WINDOW = 3.0
"""Lags up to which the autocorrelation is summed, in correlation times of the sum so far."""

NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
TANGENTS = np.tan(np.pi / 4 * (1 + NODES))
CHUNK = 2_000


def correlation_times(values: Float[np.ndarray, "n d"], starts: np.ndarray, power: int = 2) -> np.ndarray:
    """Rows (g,) of each track with the information of one on the mean of squares of values of mean zero; 1 at least.

    `starts` (g + 1,): the first row of each track, then n. `power`: 1 for the mean of the values themselves.
    """
    lengths, times = np.diff(starts), np.ones(len(starts) - 1)
    for length in np.unique(lengths[lengths > 1]).tolist():
        tracks = np.flatnonzero(lengths == length)
        series = values[starts[tracks, None] + np.arange(length)]
        size, pairs = 1 << (2 * length - 1).bit_length(), np.arange(length, 0, -1)
        spectrum = (np.abs(np.fft.rfft(series, size, axis=1)) ** 2).sum(axis=2)
        products = np.fft.irfft(spectrum, size, axis=1)[:, :length]
        with np.errstate(invalid="ignore", divide="ignore"):  # of tracks whose values are zero
            correlation = products[:, 1:] / products[:, :1] * (length / pairs[1:])
        time = 1.0 + 2.0 * np.cumsum(correlation**power * pairs[1:] / length, axis=1)
        enough = np.arange(1, length) >= WINDOW * time
        enough[:, -1] = True
        times[tracks] = np.fmax(time[np.arange(len(tracks)), enough.argmax(axis=1)], 1.0)
    return times


def band(samples: pl.Expr, dof: pl.Expr | int, z: float) -> pl.Expr:
    """The limit of NEES per degree of freedom of a perfect filter with so many effective samples.

    Chi-square exceeds it as a normal variable exceeds `z` standard deviations (Wilson and Hilferty 1931).
    """
    part = 2 / 9 / (dof * samples**2 / (samples + UNCERTAIN))
    return (1 - part + z * part.sqrt()).clip(lower_bound=0) ** 3


def regret(ratio: pl.Expr) -> pl.Expr:
    """Nats per position lost by the scale of covariances alone: r − 1 − ln r, r = NEES/dof; null of errors of zero."""
    return pl.when(ratio > 0).then(ratio - 1 - ratio.log())


def energy_scores(errors: Float[np.ndarray, "n d"], covs: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, " n"]:
    """E|X − y| − ½E|X − X′| (n,), m, of normal X and X′ and the truth y in two or three dimensions (Gneiting 2007)."""
    scores = np.empty(len(errors))
    for a in range(0, len(errors), CHUNK):
        e, P = errors[a : a + CHUNK], covs[a : a + CHUNK]
        trace, moved = np.einsum("nii->n", P), np.einsum("nij,nj->ni", P, e)
        minors = 0.5 * (trace**2 - (P * P).sum(axis=(1, 2)))
        # det(I + sP) and eᵀadj(I + sP)e as polynomials in s, by Cayley and Hamilton.
        volume = np.stack([trace, minors, np.linalg.det(P) if P.shape[1] == 3 else 0 * trace])
        square, along = (e * e).sum(axis=1), (e * moved).sum(axis=1)
        last = (moved * moved).sum(axis=1) - trace * along + minors * square
        size = np.stack([square, trace * square - along, last])
        doubled = volume * np.array([[2.0], [4.0], [8.0]])
        scores[a : a + CHUNK] = _mean_norm(volume, size) - 0.5 * _mean_norm(doubled)
    return scores


def _mean_norm(
    volume: Float[np.ndarray, "3 n"], size: Float[np.ndarray, "3 n"] | None = None
) -> Float[np.ndarray, " n"]:
    """The mean length (n,) of normal vectors, m, by the coefficients of the polynomials of `energy_scores`.

    E√Q = π^(−½) ∫ (1 − E exp(−t²Q))/t² dt over t > 0, with t = tan θ over the root of EQ, by Gauss and Legendre.
    `size`: None for vectors of mean zero.
    """
    scale = np.sqrt(volume[0] if size is None else size[0] + volume[0])[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):  # of vectors of length zero
        s = 2 * (TANGENTS / scale) ** 2
        p, q, r = volume[..., None]
        spread = 1 + s * (p + s * (q + s * r))
        kept = 1 / np.sqrt(spread)
        if size is not None:
            a, b, c = size[..., None]
            kept *= np.exp(-0.5 * s * (a + s * (b + s * c)) / spread)
        integral = (1 - kept) @ (WEIGHTS * (1 + 1 / TANGENTS**2))
    return np.where(scale[:, 0] > 0, scale[:, 0] * integral * np.sqrt(np.pi) / 4, 0.0)
