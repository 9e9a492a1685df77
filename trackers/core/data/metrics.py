"""The consistency of reported covariances with errors (Bar-Shalom 2001, section 5.4).

    e  error, estimate − truth, (N, d)        P  reported covariance, (N, d, d)
    NEES  eᵀP⁻¹e, normalised estimation error squared        NIS  the same of an innovation

NumPy in double precision, on estimates and truth that are already associated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.data.chi_square import chi_square_quantile

Errors = Float[np.ndarray, "N d"]
Covariances = Float[np.ndarray, "N d d"]
Entries = Mapping[tuple[int, int], Float[np.ndarray, " N"]]


class Consistency(NamedTuple):
    """The mean of N chi-square values, its expectation, and its interval if the model is true."""

    mean: float
    expected: float
    low: float
    high: float
    n: int


def nees(errors: Errors, covs: Covariances) -> Float[np.ndarray, " N"]:
    """NEES eᵀP⁻¹e of each row; NaN where P is not positive definite."""
    return nees_of_leading(errors, upper_entries(covs))[-1]


def upper_entries(covs: Covariances) -> Entries:
    """The entries (N,) of covariances by row and column, those of the upper triangle."""
    d = covs.shape[-1]
    return {(i, j): covs[:, i, j] for i in range(d) for j in range(i, d)}


def nees_of_leading(errors: Errors, upper: Entries) -> list[Float[np.ndarray, " N"]]:
    """NEES of the first axis, of the first two, … and of all d; NaN where their part of P is not positive definite.

    `upper`: the `upper_entries` of P. Elimination over the d columns, for all rows at once: a singular P affects its
    row alone.
    """
    remainder = [np.asarray(x, float) for x in errors.T]
    P = {at: np.asarray(x, float) for (i, j), x in upper.items() for at in ((i, j), (j, i))}
    values: list[np.ndarray] = []
    # Covariances of a damaged file may overflow; the NEES of their rows is infinite or NaN.
    with np.errstate(over="ignore", invalid="ignore"):
        for j, reduced in enumerate(remainder):
            positive = P[j, j] > 0
            pivot = P[j, j] if positive.all() else np.where(positive, P[j, j], math.nan)
            value = reduced**2 / pivot
            values.append(values[-1] + value if values else value)
            for a in range(j + 1, len(remainder)):
                gain = P[a, j] / pivot
                remainder[a] = remainder[a] - gain * reduced
                for b in range(j + 1, len(remainder)):
                    P[a, b] = P[a, b] - gain * P[j, b]
    return values


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


def _mean(values: np.ndarray) -> float:
    return float(values.sum(dtype=float)) / values.size if values.size else math.nan
