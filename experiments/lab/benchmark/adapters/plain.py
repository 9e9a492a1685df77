"""An extended Kalman filter as a plain NumPy loop, one row after another: the textbook.

Each channel is one scalar update in Joseph form, linearised at the predicted mean, in double precision, with the weight
of Student's t where the model has degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.lab.benchmark.motion import Levels, Path, diffusion, transition
from trackwright.experiments.lab.benchmark.problems import Problem, beginning, steps
from trackwright.experiments.lab.benchmark.readings import gradient, predicted

Channel = tuple[float, np.ndarray, float]
"""One channel seen: measured minus predicted value, gradient (n,) of the prediction, standard deviation."""


class Model(NamedTuple):
    """A filter's model: `moved(state, P, row, dt)`, the predicted state with F and Q, given the covariance P;
    `channels(state, row)`, those seen; `added(state, step)`, the state after a small step; `dof`, degrees of freedom of
    Student's t, 0 for none.
    """

    moved: Callable[[Any, np.ndarray, int, float], tuple[Any, np.ndarray, np.ndarray]]
    channels: Callable[[Any, int], Iterator[Channel]]
    added: Callable[[Any, np.ndarray], Any]
    dof: float


def estimate(problem: Problem, levels: Levels) -> Path:
    """The filtered path of a tag."""
    d = problem.dimensions
    means, covariances = filtered(model(problem, levels), *beginning(problem), steps(problem), 0)
    return Path(means[:, :d], covariances[:, :d, :d])


def states(problem: Problem, levels: Levels) -> np.ndarray:
    """The filtered states (N, 2d), from which iterations of others begin."""
    return filtered(model(problem, levels), *beginning(problem), steps(problem), 0)[0]


def model(problem: Problem, levels: Levels) -> Model:
    """Constant velocity in each coordinate, and the readings of a tag."""
    d = problem.dimensions

    def moved(x: np.ndarray, P: np.ndarray, row: int, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        F = transition(d, dt)
        return F @ x, F, diffusion(d, dt, levels.acceleration)

    def channels(x: np.ndarray, row: int) -> Iterator[Channel]:
        place, near, geometry = problem.places(x[:d]), problem.values[row], problem.geometry[row]
        differences = near - predicted(problem.kind, place, geometry, near)
        slopes = gradient(problem.kind, place, geometry)
        for k in np.flatnonzero(problem.seen[row]):
            if problem.kind == "fixes" and k >= d:
                continue
            yield float(differences[k]), np.concatenate([slopes[k, :d], np.zeros(d)]), levels.reading

    return Model(moved, channels, np.add, 0.0)


def filtered(model: Model, state: Any, P: np.ndarray, dts: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
    """The states' vectors (T − first, n) and covariances of the rows from `first`, given the state of the row before
    it.
    """
    means, eye = np.empty((len(dts) - first, len(P))), np.eye(len(P))
    covariances = np.empty((len(means), *P.shape))
    for row in range(first, len(dts)):
        state, F, Q = model.moved(state, P, row, dts[row])
        P = F @ P @ F.T + Q
        step = np.zeros(len(P))
        for difference, slope, sigma in model.channels(state, row):
            h, r = slope / sigma, difference / sigma
            Ph = P @ h
            a = float(h @ Ph)
            innovation = float(r - h @ step)
            noise = 1.0
            if model.dof:
                noise = (model.dof + innovation**2 / (1.0 + a)) / (model.dof + 1.0)
            k = Ph / (noise + a)
            step = step + k * innovation
            rest = eye - np.outer(k, h)
            P = rest @ P @ rest.T + noise * np.outer(k, k)
        state = model.added(state, step)
        means[row - first] = state[0] if isinstance(state, tuple) else state
        covariances[row - first] = P
    return means, covariances
