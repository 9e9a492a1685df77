"""Whether a filter's innovations are what it says: their NIS against χ², and one row's against the next."""

from __future__ import annotations

import jax
import numpy as np
from jax.scipy.special import gammainc, ndtri

from experiments.tuning_report.evidence import Innovations
from trackers.core.metrics import chi_square_density


def probabilities(innovations: Innovations) -> np.ndarray:
    """How likely a smaller NIS was, by the χ² of each row's degrees of freedom (n,): even over 0 … 1 if consistent.

    Rows with different degrees of freedom can be looked at together in this way (Dawid 1984).
    """
    with jax.enable_x64(True):
        return np.asarray(gammainc(np.asarray(innovations.dof, float) / 2, np.asarray(innovations.nis, float) / 2))


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
        together = innovations.lane[lag:] == innovations.lane[:-lag]
        products = (centred[lag:] * centred[:-lag])[together]
        if len(products) and power > 0:
            found[lag - 1] = products.mean() / power
        pairs = len(products) if lag == 1 else pairs
    return found, pairs


def mixture_density(x: np.ndarray, dof: np.ndarray) -> np.ndarray:
    """The density at positive `x` of χ² values whose degrees of freedom are as often what they are in `dof` (n,)."""
    kinds, counts = np.unique(dof, return_counts=True)
    return sum((c / len(dof) * chi_square_density(x, float(k)) for k, c in zip(kinds, counts, strict=True)), 0.0 * x)
