"""NIS of a filter against its distribution: the band of means and quantiles."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float

from trackwright.trackers.core.data.consistency import chi_square_quantile
from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading
from trackwright.trackers.core.run.tracker import AbstractTracker


def student_t_dof_of(tracker: AbstractTracker) -> Scalar | None:
    """The degrees of freedom of the noise behind the tracker's NIS; None for normal noise, or without NIS.

    Raises ValueError for several sensors with Student's t among them: their sum has no known distribution.
    """
    by_sensor = [_student_t_dof(sensor) for sensor in tracker.nis_sensors]
    dofs = [dof for dof in by_sensor if dof is not None]
    if dofs and len(by_sensor) > 1:
        sensors = f"{len(by_sensor)} sensors, {len(dofs)} of them with Student's t"
        raise ValueError(f"the NIS of {sensors}, has no known distribution; expected one sensor, or normal noise")
    return dofs[0] if dofs else None


def _student_t_dof(sensor: AbstractSensor) -> Scalar | None:
    """The degrees of freedom that the sensor's residuals have, from one of zeros."""
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
    return float(scale * scipy.special.betaincinv(a, b, probability))
