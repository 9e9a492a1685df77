"""Stone Soup's extended Kalman filter; by Mahalanobis distance a reading is of the tag, or missed."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any

import numpy as np

from trackwright.experiments.lab.benchmark.motion import Levels, Path
from trackwright.experiments.lab.benchmark.problems import Problem, beginning
from trackwright.experiments.lab.benchmark.readings import gradient, predicted

EPOCH = datetime(2020, 1, 1)
MISSED = 3.0
"""Mahalanobis distance beyond which the reading is more probably not of the tag."""


def estimate(problem: Problem, levels: Levels) -> Path:
    """The filtered path of a tag."""
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.updater.kalman import ExtendedKalmanUpdater

    d, Reading = problem.dimensions, reading_model()
    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(levels.acceleration**2)] * d)
    predictor, updater = KalmanPredictor(motion), ExtendedKalmanUpdater(None)
    hypotheses = DistanceHypothesiser(predictor, updater, Mahalanobis(), MISSED)
    # Stone Soup's states are x, its velocity, y, …
    order = np.arange(2 * d).reshape(2, d).T.ravel()
    mean, P = beginning(problem)
    at = [EPOCH + timedelta(seconds=float(t - problem.times[0])) for t in problem.times]
    state = GaussianState(mean[order, None], P[np.ix_(order, order)], at[0])
    positions, covariances = np.empty((len(at), d)), np.empty((len(at), d, d))
    for row, time in enumerate(at):
        seen = np.flatnonzero(problem.seen[row])
        model = Reading(problem=problem, row=row, channels=seen, sigma=levels.reading)
        detection = Detection(problem.values[row, seen][:, None], timestamp=time, measurement_model=model)
        best = hypotheses.hypothesise(Track([state]), {detection}, time)[0]
        state = updater.update(best) if best else best.prediction
        positions[row] = np.asarray(state.mean, float).ravel()[::2]
        covariances[row] = np.asarray(state.covar, float)[::2, ::2]
    return Path(positions, covariances)


def reading_model() -> Any:
    """The class of a measurement model of the seen channels of one reading."""
    from stonesoup.base import Property
    from stonesoup.models.base import GaussianModel
    from stonesoup.models.measurement.base import MeasurementModel
    from stonesoup.types.array import CovarianceMatrix, StateVector, StateVectors

    class Reading(MeasurementModel, GaussianModel):
        """Channels of a reading, angles near the measured ones."""

        problem: Any = Property()
        row: int = Property()
        channels: Any = Property()
        sigma: float = Property()
        ndim_state: int = Property(default=0)
        mapping: Any = Property(default=())

        @property
        def ndim_meas(self) -> int:
            return len(self.channels)

        def jacobian(self, state: Any, **kwargs: Any) -> Any:
            p, d = self.problem, self.problem.dimensions
            place = p.places(np.asarray(state.state_vector, float).ravel()[::2])
            slopes = np.zeros((self.ndim_meas, 2 * d))
            slopes[:, ::2] = gradient(p.kind, place, p.geometry[self.row])[self.channels, :d]
            return slopes

        def covar(self, **kwargs: Any) -> Any:
            return CovarianceMatrix(self.sigma**2 * np.eye(self.ndim_meas))

        def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
            points = np.asarray(state.state_vector, float)
            p = self.problem
            z = predicted(p.kind, p.places(points[::2].T), p.geometry[self.row], p.values[self.row]).T[self.channels]
            return StateVectors(z) if z.shape[1] > 1 else StateVector(z)

        def rvs(self, *args: Any, **kwargs: Any) -> Any:
            raise NotImplementedError

        def pdf(self, *args: Any, **kwargs: Any) -> Any:
            raise NotImplementedError

    return Reading
