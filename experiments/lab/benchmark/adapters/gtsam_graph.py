"""The factors of a path for GTSAM, on one vector of place and velocity a state, with Huber's loss of readings.

All are custom factors: GTSAM's own factors of ranges and bearings hold the anchors as variables too, which join all
states of a path, and its bearings have one standard deviation for both angles. Calling Python costs time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from trackwright.experiments.lab.benchmark.motion import Levels, diffusion, transition
from trackwright.experiments.lab.benchmark.problems import Problem, beginning
from trackwright.experiments.lab.benchmark.readings import gradient, predicted

HUBER = 1.345
"""Threshold of Huber's loss, in standard deviations, the default of GTSAM."""


def graph_of(problem: Problem, levels: Levels, rows: Iterable[int]) -> Any:
    """The factors that these states add: start, motion from the state before, and readings."""
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    for factor in (factor for row in rows for factor in _factors(problem, levels, row)):
        graph.add(factor)
    return graph


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
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
    for k in range(*np.searchsorted(row_of, [row, row + 1])):
        sigmas = gtsam.noiseModel.Isotropic.Sigma(int(problem.seen[k].sum()), levels.reading)
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
