"""GTSAM with Huber's loss: the most probable path given all readings, in batch, and the newest state over a lag."""

from __future__ import annotations

import numpy as np

from trackwright.experiments.lab.benchmark.adapters.gtsam_graph import graph_of
from trackwright.experiments.lab.benchmark.adapters.plain import states
from trackwright.experiments.lab.benchmark.motion import Levels, Path, transition
from trackwright.experiments.lab.benchmark.problems import Problem, beginning

LAG_S, ITERATIONS = 2.0, 10
"""The lag, and the most iterations of the batch."""


def batch(problem: Problem, levels: Levels) -> Path:
    """The path by Levenberg and Marquardt from the plain filter's, with its covariances where they are determined."""
    import gtsam

    (times, row_of), d = problem.epochs, problem.dimensions
    graph, values = graph_of(problem, levels, range(len(times))), gtsam.Values()
    last = np.searchsorted(row_of, np.arange(len(times)), "right") - 1
    for row, state in enumerate(states(problem, levels)[last]):
        values.insert(row, state)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(ITERATIONS)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    positions = np.array([result.atVector(row)[:d] for row in range(len(times))])
    try:
        marginals = gtsam.Marginals(graph, result)
    except RuntimeError:  # By Cholesky alone.
        return Path(positions[row_of])
    covariances = np.array([marginals.marginalCovariance(row)[:d, :d] for row in range(len(times))])
    return Path(positions[row_of], covariances[row_of])


def fixed_lag(problem: Problem, levels: Levels) -> Path:
    """The newest state of an incremental smoother over `LAG_S` seconds, without a covariance."""
    import gtsam

    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")  # By Cholesky, its default, indeterminate where states are milliseconds apart.
    smoother = gtsam.IncrementalFixedLagSmoother(LAG_S, parameters)
    (times, row_of), d = problem.epochs, problem.dimensions
    positions, state = np.empty((len(times), d)), beginning(problem)[0]
    for row, time in enumerate(times):
        values = gtsam.Values()
        values.insert(row, transition(d, time - times[row - 1]) @ state if row else state)
        smoother.update(graph_of(problem, levels, [row]), values, {row: float(time)})
        state = smoother.calculateEstimateVector(row)
        positions[row] = state[:d]
    return Path(positions[row_of])
