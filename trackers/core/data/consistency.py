"""The consistency of reported covariances with errors (Bar-Shalom 2001, section 5.4), and the chi-square distribution.

e  error, estimate − truth, (N, d)        P  reported covariance, (N, d, d)
NEES  eᵀP⁻¹e, normalised estimation error squared        NIS  the same of an innovation
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import gammainc, gammaincinv

from trackwright.trackers.core.model.inputs import AnyArray

Errors = Float[AnyArray, "*rows d"]
Covariances = Float[np.ndarray, "N d d"]
Entries = Mapping[tuple[int, int], Float[AnyArray, "*rows"]]

NORMAL = 1.96
"""Half the width of the central 95 % interval of a normal distribution, in standard deviations."""


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
    """The entries (N,) of covariances by row and column, from the upper triangle."""
    d = covs.shape[-1]
    return {(i, j): covs[:, i, j] for i in range(d) for j in range(i, d)}


def nees_of_leading(errors: Errors, upper: Entries) -> list[Float[np.ndarray, " N"]]:
    """NEES of the first axis, of the first two, … and of all d; NaN where their part of P is not positive definite.

    `upper`: the `upper_entries` of P. Elimination over the d columns, for all rows at once: a singular P affects its
    row alone.
    """
    values: list[np.ndarray] = []
    with np.errstate(over="ignore", invalid="ignore"):
        for reduced, pivot in eliminated(errors, upper):
            value = reduced**2 / pivot
            values.append(values[-1] + value if values else value)
    return values


def eliminated(errors: Errors, upper: Entries) -> list[tuple[Float[AnyArray, "*rows"], Float[AnyArray, "*rows"]]]:
    """Of each axis the error less what those before predict, and its variance, NaN where P is not positive definite.

    The density of the error is the product of the normal ones of these. `upper`: the `upper_entries` of P.
    """
    xp = errors.__array_namespace__()
    remainder = [xp.asarray(errors[..., k], float) for k in range(errors.shape[-1])]
    P = {at: xp.asarray(x, float) for (i, j), x in upper.items() for at in ((i, j), (j, i))}
    parts: list[tuple[Any, Any]] = []
    least = [1e-12 * P[j, j] for j in range(len(remainder))]  # what rounding leaves of a singular P
    # Covariances of a damaged file may overflow; the NEES of their rows is infinite or NaN.
    with np.errstate(over="ignore", invalid="ignore"):
        for j, reduced in enumerate(remainder):
            pivot = xp.where(P[j, j] > least[j], P[j, j], math.nan)
            parts.append((reduced, pivot))
            for a in range(j + 1, len(remainder)):
                gain = P[a, j] / pivot
                remainder[a] = remainder[a] - gain * reduced
                for b in range(j + 1, len(remainder)):
                    P[a, b] = P[a, b] - gain * P[j, b]
    return parts


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
    return Consistency(float(values[known].mean(dtype=float)), total / n, low, high, n)


def chi_square_probability(values: Float[np.ndarray, "*shape"], dof: float) -> Float[np.ndarray, "*shape"]:
    """The probability of a smaller value than each of `values` ≥ 0, for `dof` degrees of freedom."""
    return np.asarray(gammainc(dof / 2, np.asarray(values, float) / 2))


def chi_square_quantile(probability: float, dof: float) -> float:
    """The quantile of the chi-square distribution; NaN outside 0 ≤ probability ≤ 1 and dof > 0."""
    return 2 * float(gammaincinv(dof / 2, probability))
