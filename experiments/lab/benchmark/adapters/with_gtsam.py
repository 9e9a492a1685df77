"""GTSAM with Huber's loss: the most probable path given all readings, in batch, and the newest state over a lag.

Motion and readings are custom factors on one vector of place and velocity a state. GTSAM's own factors of ranges and
bearings hold the anchors as variables too, which join all states of a path: an iteration took ten times as long.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from trackwright.experiments.lab.benchmark.adapters.plain import beginning, states
from trackwright.experiments.lab.benchmark.motion import Levels, Path, diffusion, transition
from trackwright.experiments.lab.benchmark.problems import Problem
from trackwright.experiments.lab.benchmark.readings import gradient, predicted

HUBER = 1.345
"""Threshold of Huber's loss, in standard deviations, the default of GTSAM."""

LAG_S = 2.0
ITERATIONS = 10


def batch(problem: Problem, levels: Levels) -> Path:
    """The path by Levenberg and Marquardt from the plain filter's, with its marginal covariances where GTSAM has them."""
    import gtsam

    (times, row_of), d = problem.epochs, problem.dimensions
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    last = np.searchsorted(row_of, np.arange(len(times)), "right") - 1
    for row, state in enumerate(states(problem, levels)[last]):
        values.insert(row, state)
        for factor in _factors(problem, levels, row):
            graph.add(factor)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(ITERATIONS)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    positions = np.array([result.atVector(row)[:d] for row in range(len(times))])
    try:
        marginals = gtsam.Marginals(graph, result)
    except RuntimeError:  # By Cholesky alone, which is indeterminate where states are milliseconds apart.
        return Path(positions[row_of])
    covariances = np.array([marginals.marginalCovariance(row)[:d, :d] for row in range(len(times))])
    return Path(positions[row_of], covariances[row_of])


def fixed_lag(problem: Problem, levels: Levels) -> Path:
    """The newest state of an incremental smoother over `LAG_S` seconds, without a covariance."""
    import gtsam

    parameters = gtsam.ISAM2Params()
    # By Cholesky, its default, the system is indeterminate where states are milliseconds apart.
    parameters.setFactorization("QR")
    smoother = gtsam.IncrementalFixedLagSmoother(LAG_S, parameters)
    (times, row_of), d = problem.epochs, problem.dimensions
    positions, state = np.empty((len(times), d)), beginning(problem)[0]
    for row, time in enumerate(times):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for factor in _factors(problem, levels, row):
            graph.add(factor)
        values.insert(row, transition(d, time - times[row - 1]) @ state if row else state)
        smoother.update(graph, values, {row: float(time)})
        state = smoother.calculateEstimateVector(row)
        positions[row] = state[:d]
    return Path(positions[row_of])


def _factors(problem: Problem, levels: Levels, row: int) -> Iterator[Any]:
    """The factors that a state adds: the start, or the motion from the state before, and its readings."""
    import gtsam

    (times, row_of), d, Gaussian = problem.epochs, problem.dimensions, gtsam.noiseModel.Gaussian
    if row == 0:
        mean, P = beginning(problem)
        yield gtsam.PriorFactorVector(0, mean, Gaussian.Covariance(P))
    else:
        dt = times[row] - times[row - 1]
        yield _custom(Gaussian.Covariance(diffusion(d, dt, levels.acceleration)), row, transition(d, dt))
    for k in range(*np.searchsorted(row_of, [row, row + 1])):
        sigmas = gtsam.noiseModel.Isotropic.Sigma(int(problem.seen[k].sum()), levels.reading)
        huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
        yield _reading(gtsam.noiseModel.Robust.Create(huber, sigmas), row, problem, k)


def _custom(noise: Any, row: int, F: np.ndarray) -> Any:
    import gtsam

    def error(factor: Any, values: Any, jacobians: Any) -> np.ndarray:
        if jacobians is not None:
            jacobians[0], jacobians[1] = -F, np.eye(len(F))
        return np.asarray(values.atVector(row) - F @ values.atVector(row - 1))

    return gtsam.CustomFactor(noise, [row - 1, row], error)


def _reading(noise: Any, row: int, problem: Problem, k: int) -> Any:
    import gtsam

    z, seen, geometry, d = problem.values[k], problem.seen[k], problem.geometry[k], problem.dimensions

    def error(factor: Any, values: Any, jacobians: Any) -> np.ndarray:
        place = problem.places(values.atVector(row)[:d])
        if jacobians is not None:
            slopes = gradient(problem.kind, place, geometry)[seen, :d]
            jacobians[0] = np.hstack([slopes, np.zeros_like(slopes)])
        return np.asarray(predicted(problem.kind, place, geometry, z) - z)[seen]

    return gtsam.CustomFactor(noise, [row], error)
