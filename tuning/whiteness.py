"""Whether a filter's innovations are what it says: their NIS against χ², and one row's against the next."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammainc, ndtri

from experiments.reports.tuning_data import Innovations
from trackers.core.metrics import chi_square_density
from tuning.consistency import tailed_below


def probabilities(innovations: Innovations) -> np.ndarray:
    """How likely a smaller NIS was, by each row's degrees of freedom (n,): even over 0 … 1 if consistent.

    Rows with different degrees of freedom can be looked at together in this way (Dawid 1984).
    """
    nis, dof = np.asarray(innovations.nis, float), np.asarray(innovations.dof, float)
    with jax.enable_x64(True):
        if innovations.tail is None:
            return np.asarray(gammainc(dof / 2, nis / 2))
        return np.asarray(tailed_below(jnp.asarray(nis), jnp.asarray(dof), jnp.asarray(innovations.tail)))


def normal_scores(innovations: Innovations) -> np.ndarray:
    """NIS values as the standard normal values of the same probability (n,), at most 7 from zero."""
    with jax.enable_x64(True):
        return np.asarray(ndtri(np.clip(probabilities(innovations), 1e-12, 1 - 1e-12)))


def autocorrelation(innovations: Innovations, lags: int) -> tuple[np.ndarray, int]:
    """The autocorrelation of the normal scores at 1 … `lags` rows (lags,), and how many pairs lag 1 has.

    Pairs are of one trajectory; NaN where there are none. Near zero for a filter whose model is true.
    """
    scores = normal_scores(innovations)
    centred = scores - scores.mean() if len(scores) else scores
    power = float(np.mean(centred**2)) if len(scores) else np.nan
    found, pairs = np.full(lags, np.nan), 0
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        together = innovations.trajectory[lag:] == innovations.trajectory[:-lag]
        products = (centred[lag:] * centred[:-lag])[together]
        if len(products) and power > 0:
            found[lag - 1] = products.mean() / power
        pairs = len(products) if lag == 1 else pairs
    return found, pairs


def expected_density(x: np.ndarray, innovations: Innovations) -> np.ndarray:
    """The density at positive `x` of the NIS of a consistent filter with the rows' degrees of freedom.

    A mixture of χ², or for Student's t of the beta distributions of `tuning.consistency`.
    """
    kinds, counts = np.unique(innovations.dof, return_counts=True)
    density = np.zeros(len(x))
    for dof, count in zip(kinds, counts, strict=True):
        one = (
            chi_square_density(x, float(dof))
            if innovations.tail is None
            else _tailed_density(x, float(dof), innovations.tail)
        )
        density += count / len(innovations.dof) * one
    return density


def _tailed_density(x: np.ndarray, count: float, tail: float) -> np.ndarray:
    both = 0.5 * (count * (tail + 3) - 2)
    a, reach = both / (tail + 1), count * (tail + 1)
    b = tail * a
    share = np.clip(x / reach, 1e-12, 1 - 1e-12)
    log_beta = math.lgamma(a) + math.lgamma(b) - math.lgamma(both)
    density = np.exp((a - 1) * np.log(share) + (b - 1) * np.log1p(-share) - log_beta) / reach
    found: np.ndarray = np.where(x < reach, density, 0.0)
    return found
