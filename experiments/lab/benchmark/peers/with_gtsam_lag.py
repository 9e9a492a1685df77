"""GTSAM with Huber's loss, incremental."""

import gtsam
import numpy as np
from model import Path, Problem, transition
from with_gtsam import factors

LAG_S = 2.0


def estimate(p: Problem, acceleration: float, reading: float) -> Path:
    """The newest state of an incremental smoother over `LAG_S` seconds that linearises anew at every step."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")  # By Cholesky, its default, indeterminate where states are milliseconds apart.
    parameters.setRelinearizeThreshold(0.0)
    parameters.relinearizeSkip = 1
    smoother, (times, row_of) = gtsam.IncrementalFixedLagSmoother(LAG_S, parameters), p.epochs
    positions, covariances, state = np.empty((len(times), p.d)), np.empty((len(times), p.d, p.d)), p.beginning[0]
    for row, time in enumerate(times):
        values = gtsam.Values()
        values.insert(row, transition(p.d, time - times[row - 1]) @ state if row else state)
        smoother.update(factors(p, acceleration, reading, row), values, {row: float(time)})
        state = smoother.calculateEstimateVector(row)
        positions[row], covariances[row] = state[: p.d], smoother.marginalCovariance(row)[: p.d, : p.d]
    return positions[row_of], covariances[row_of]
