"""GTSAM with Huber's loss, in batch and incremental. GTSAM's own factors hold the anchors as variables, too."""

from typing import Any

import gtsam
import numpy as np
from gtsam import noiseModel
from model import Path, Problem, diffusion, states, transition

HUBER = noiseModel.mEstimator.Huber.Create(1.345)
LAG_S = 2.0


def factor(noise: Any, rows: list[int], error: Any, slopes: Any) -> Any:
    """A factor by its error and the gradients of it, functions of the states of these rows."""

    def both(factor: Any, values: Any, jacobians: Any) -> np.ndarray:
        x = [values.atVector(row) for row in rows]
        for k, slope in enumerate(slopes(*x) if jacobians else ()):
            jacobians[k] = slope
        return np.asarray(error(*x))

    return gtsam.CustomFactor(noise, rows, both)


def factors(p: Problem, acceleration: float, reading: float, row: int) -> Any:
    """The factors that a state adds: start, or motion from the state before, and its readings."""
    (times, row_of), graph = p.epochs, gtsam.NonlinearFactorGraph()
    if row == 0:
        graph.add(gtsam.PriorFactorVector(0, p.beginning[0], noiseModel.Gaussian.Covariance(p.beginning[1])))
    else:
        dt = times[row] - times[row - 1]
        F, noise = transition(p.d, dt), noiseModel.Gaussian.Covariance(diffusion(p.d, dt, acceleration))
        graph.add(factor(noise, [row - 1, row], lambda x, y: y - F @ x, lambda *_: (-F, np.eye(len(F)))))
    for k in range(*np.searchsorted(row_of, [row, row + 1])):
        noise = noiseModel.Robust.Create(HUBER, noiseModel.Isotropic.Sigma(int(p.seen[k].sum()), reading))
        graph.add(factor(noise, [row], lambda x, k=k: -p.off(x, k), lambda x, k=k: [p.slopes(x, k)]))
    return graph


def estimate(p: Problem, acceleration: float, reading: float) -> Path:
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


def incremental(p: Problem, acceleration: float, reading: float) -> Path:
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
