"""A motion that stays, trackers that begin from a belief the test knows, and recordings that carry it."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.core.filters.filter import AbstractStart
from trackwright.trackers.core.model.algebra import total
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, independent
from trackwright.trackers.core.run.track_loss import TrackLossPolicy

NEVER_LOST = TrackLossPolicy(nis_limit=np.inf, max_gap=np.inf)


class Still(AbstractMotion):
    """A motion that leaves the state unchanged."""

    noise_dimension = 0

    def step(self, state, inputs, dt, w):
        return state


class KnownStart(AbstractStart):
    """Begins at the first row from the mean and covariance in that row's inputs; `build` makes a state of numbers."""

    build: Callable = eqx.field(static=True)

    def can_start(self, row):
        return row.dt == row.dt

    def candidate(self, sensors, row):
        return row.dt

    def belief(self, candidate, row):
        mean, cov = row.inputs["start_mean"], row.inputs["start_cov"]
        return Gaussian(self.build([mean[k] for k in range(mean.shape[0])]), tuple(cov[k] for k in range(cov.shape[0])))


class LinearSensor(AbstractSensor):
    """H times the state's components, with independent noise."""

    H: np.ndarray
    sigmas: np.ndarray
    m: int = eqx.field(static=True)

    @property
    def channels(self):
        return tuple(Channel(str(k), "m") for k in range(self.m))

    def measure(self, view, inputs):
        x = jax.tree_util.tree_leaves(view)
        return [total(self.H[i, j] * v for j, v in enumerate(x)) for i in range(self.m)]

    def residual(self, reading, predicted):
        differences = [z - p for z, p in zip(reading.values, predicted, strict=True)]
        return independent(differences, list(self.sigmas), reading.seen)


def recording(times, readings, mean, cov, inputs=None, name="test"):
    """A recording with the belief of its first row; `readings`: name -> (values, seen) or (values, seen, reported)."""
    known = {"start_mean": mean, "start_cov": np.asarray(cov)[np.triu_indices(len(cov))]}
    known = {key: np.tile(np.asarray(value, float), (len(times), 1)) for key, value in known.items()}
    return Recording(times, {key: Readings(*r) for key, r in readings.items()}, known | (inputs or {}), name=name)


def flat(mean):
    """The components of an estimate's mean state along a last axis."""
    return np.stack([np.asarray(x) for x in jax.tree_util.tree_leaves(mean)], axis=-1)
