"""GTSAM with Huber's loss: in batch, and incremental. GTSAM's own factors hold the anchors as variables, too."""

from typing import Any

import gtsam
import numpy as np
from model import Path, Problem, diffusion, transition
from plain import states

HUBER, LAG_S = 1.345, 2.0


def factors(p: Problem, acceleration: float, reading: float, row: int) -> Any:
    """The factors that a state adds: start, or motion from the state before, and its readings."""
    (times, row_of), Gaussian, graph = p.epochs, gtsam.noiseModel.Gaussian, gtsam.NonlinearFactorGraph()
    if row == 0:
        graph.add(gtsam.PriorFactorVector(0, p.beginning[0], Gaussian.Covariance(p.beginning[1])))
    else:
        dt = times[row] - times[row - 1]
        F = transition(p.d, dt)

        def motion(factor: Any, values: Any, jacobians: Any) -> np.ndarray:
            if jacobians is not None:
                jacobians[0], jacobians[1] = -F, np.eye(len(F))
            return values.atVector(row) - F @ values.atVector(row - 1)

        graph.add(gtsam.CustomFactor(Gaussian.Covariance(diffusion(p.d, dt, acceleration)), [row - 1, row], motion))
    for k in range(*np.searchsorted(row_of, [row, row + 1])):

        def error(factor: Any, values: Any, jacobians: Any, k: int = k) -> np.ndarray:
            x = values.atVector(row)
            if jacobians is not None:
                jacobians[0] = p.slopes(x, p.geometry[k])[p.seen[k]]
            return (p.predicted(x, p.geometry[k], p.values[k]) - p.values[k])[p.seen[k]]

        normal = gtsam.noiseModel.Isotropic.Sigma(int(p.seen[k].sum()), reading)
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(HUBER), normal)
        graph.add(gtsam.CustomFactor(noise, [row], error))
    return graph


def batch(p: Problem, acceleration: float, reading: float) -> Path:
    """The path by Levenberg and Marquardt to convergence, from the plain filter's, with its covariances."""
    (times, row_of), graph, values = p.epochs, gtsam.NonlinearFactorGraph(), gtsam.Values()
    last = np.searchsorted(row_of, np.arange(len(times)), "right") - 1
    for row, state in enumerate(states(p, acceleration, reading)[0][last]):
        graph.push_back(factors(p, acceleration, reading, row))
        values.insert(row, state)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    positions = np.array([result.atVector(row)[: p.d] for row in range(len(times))])
    try:
        of = gtsam.Marginals(graph, result).marginalCovariance
        return positions[row_of], np.array([of(row)[: p.d, : p.d] for row in range(len(times))])[row_of]
    except RuntimeError:  # By Cholesky alone.
        return positions[row_of], None


def fixed_lag(p: Problem, acceleration: float, reading: float) -> Path:
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
