"""Stone Soup's extended Kalman filter; by Mahalanobis distance a reading is of the tag, or missed."""

from datetime import datetime, timedelta
from typing import Any

import numpy as np
from model import Path, Problem
from stonesoup.base import Property
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.measures import Mahalanobis
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.array import StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track
from stonesoup.updater.kalman import ExtendedKalmanUpdater

MISSED = {1: 3.0, 2: 3.44, 3: 3.76}
"""Mahalanobis distance within which 99.7 % of the readings of so many channels are."""


class Reading(NonLinearGaussianMeasurement):  # type: ignore[misc]
    """The channels seen of one reading; states are x, its velocity, y, …"""

    p: Any = Property()
    row: int = Property()
    ndim_meas = property(lambda self: len(self.noise_covar), doc="Channels.")

    def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
        """The expected reading."""
        x, z = np.asarray(state.state_vector, float).ravel()[::2], self.p.values[self.row]
        return StateVector(self.p.predicted(x, self.p.geometry[self.row], z)[self.p.seen[self.row]])

    def jacobian(self, state: Any, **kwargs: Any) -> Any:
        """The slopes (m, 2d)."""
        x = np.asarray(state.state_vector, float).ravel()[::2]
        return np.kron(self.p.slopes(x, self.row)[:, : self.p.d], [1.0, 0.0])


def estimate(p: Problem, acceleration: float, reading: float) -> Path:
    """The filtered path."""
    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(acceleration**2)] * p.d)
    predictor, updater = KalmanPredictor(motion), ExtendedKalmanUpdater(None)
    order, (mean, P) = np.arange(2 * p.d).reshape(2, p.d).T.ravel(), p.beginning
    at = [datetime(2020, 1, 1) + timedelta(seconds=float(t - p.times[0])) for t in p.times]
    state = GaussianState(mean[order, None], P[np.ix_(order, order)], at[0])
    positions, covariances = np.empty((len(at), p.d)), np.empty((len(at), p.d, p.d))
    for row, time in enumerate(at):
        z = p.values[row, p.seen[row], None]
        model = Reading(2 * p.d, range(0, 2 * p.d, 2), reading**2 * np.eye(len(z)), p=p, row=row)
        gate = DistanceHypothesiser(predictor, updater, Mahalanobis(), MISSED[len(z)])
        best = gate.hypothesise(Track([state]), {Detection(z, time, measurement_model=model)}, time)[0]
        state = updater.update(best) if best else best.prediction
        positions[row] = np.asarray(state.mean, float).ravel()[::2]
        covariances[row] = np.asarray(state.covar, float)[::2, ::2]
    return positions, covariances
