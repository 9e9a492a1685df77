"""The consistency of reported covariances with errors (Bar-Shalom 2001, section 5.4), and of NIS with its distribution.

e  error, estimate − truth, (N, d)        P  reported covariance, (N, d, d)
NEES  eᵀP⁻¹e, normalised estimation error squared        NIS  the same of an innovation
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import betaincinv, gammainc, gammaincinv

# Tables are evaluated without jax.
if TYPE_CHECKING:
    from trackwright.trackers.core.model.algebra import Scalar
    from trackwright.trackers.core.model.sensor import AbstractSensor

Errors = Float[Any, "*rows d"]
Covariances = Float[np.ndarray, "N d d"]
Entries = Mapping[tuple[int, int], Float[Any, "*rows"]]

NORMAL = 1.96  # half the width of the central 95 % interval of a normal distribution, in standard deviations


class Consistency(NamedTuple):
    """The mean of N chi-square values, its expectation, and its interval if the model is true."""

    mean: float
    expected: float
    low: float
    high: float
    n: int


def nees(errors: Errors, covs: Covariances) -> Float[np.ndarray, " N"]:
    """NEES eᵀP⁻¹e of each row; NaN where P is not positive definite."""
    with np.errstate(over="ignore", invalid="ignore"):
        parts = [reduced**2 / pivot for reduced, pivot in eliminated(errors, upper_entries(covs))]
    return np.sum(parts, axis=0)


def upper_entries(covs: Covariances) -> Entries:
    """The entries (N,) of covariances by row and column, from the upper triangle."""
    d = covs.shape[-1]
    return {(i, j): covs[:, i, j] for i in range(d) for j in range(i, d)}


def eliminated(errors: Errors, upper: Entries) -> list[tuple[Float[Any, "*rows"], Float[Any, "*rows"]]]:
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


def student_t_dof_of(sensors: Sequence[AbstractSensor]) -> Scalar | None:
    """The degrees of freedom of the noise behind the NIS of these sensors; None for normal noise, or without NIS.

    Raises ValueError for several sensors with Student's t among them: their sum has no known distribution.
    """
    dofs = [dof for dof in map(_student_t_dof, sensors) if dof is not None]
    if dofs and len(sensors) > 1:
        these = f"{len(sensors)} sensors, {len(dofs)} of them with Student's t"
        raise ValueError(f"the NIS of {these}, has no known distribution; expected one sensor, or normal noise")
    return dofs[0] if dofs else None


def _student_t_dof(sensor: AbstractSensor) -> Scalar | None:
    """The degrees of freedom that the sensor's residuals have, from one of zeros."""
    import jax
    import jax.numpy as jnp

    from trackwright.trackers.core.model.sensor import Reading

    zeros, ones = ([jnp.asarray(x, float)] * len(sensor.channels) for x in (0.0, 1.0))
    reading = Reading(zeros, [x > 0 for x in ones], [jnp.asarray(0.0)] * len(sensor.reported))
    # In a compiled program the residual itself, which nobody asks for, is not computed.
    return jax.jit(lambda: sensor.residual(reading, zeros).dof)()


def nis_band(
    freedom: Float[np.ndarray, " n"], student_t_dof: float | None = None
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The central 95 % of the mean NIS per degree of freedom of independent rows with `freedom` (n,) in sum.

    The mean is 1; the variance is 2/`freedom`, with Student's t noise ν/(ν + 3) of it: see `student_t_nis_beta`. By
    χ² with as many degrees of freedom as have this variance, exact for normal noise.
    """
    effective = freedom if student_t_dof is None else freedom * (1 + 3 / student_t_dof)
    different = np.unique(effective)
    # The bounds are smooth in the degrees of freedom: some dozens of exact values carry thousands.
    grid = different if len(different) <= 40 else np.geomspace(different[0], different[-1], 40)
    exact = [[chi_square_quantile(p, float(f)) / f for f in grid] for p in (0.025, 0.975)]
    low, high = (np.interp(effective, grid, values) if len(grid) else effective for values in exact)
    return low, high


def student_t_nis_beta(nis_dof: Any, nu: float) -> tuple[Any, Any, Any]:
    """The parameters a, b and the scale m(ν + 1) of a row's NIS as a beta variable.

    With ν degrees of freedom the NIS of a channel is q = (ν + 1) s/(ν + s) of the squared residual s, so that
    q/(ν + 1) is Beta(½, ν/2). The sum over m channels is approximated by m(ν + 1)·Beta(a, b) with the same mean and
    variance: exact for one channel and for ν → ∞; for two and three the error of its distribution function is at most
    0.036 at ν = 1, 0.020 at ν = 3, and 0.005 at ν = 30.
    """
    a = 0.5 * (nis_dof * (nu + 3) - 2) / (nu + 1)
    return a, nu * a, nis_dof * (nu + 1)


def nis_quantile(probability: float, dof: float, student_t_dof: float | None = None) -> float:
    """The quantile of the NIS of a row with `dof` degrees of freedom."""
    if student_t_dof is None:
        return chi_square_quantile(probability, dof)
    a, b, scale = student_t_nis_beta(dof, student_t_dof)
    return float(scale * betaincinv(a, b, probability))
