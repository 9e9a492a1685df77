"""GTSAM with Huber's loss, in batch. GTSAM's own factors hold the anchors as variables, too."""

from typing import Any

import gtsam
import numpy as np
from gtsam import noiseModel
from model import Path, Problem, diffusion, transition
from with_numpy_ekf import states

HUBER = noiseModel.mEstimator.Huber.Create(1.345)


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
