"""Worlds in which a tracker's model is exactly true, drawn from the model itself, and the smallest tracker there is."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np

from tests.known_start import NEVER_LOST, KnownStart, recording
from trackwright.sim.stations import work_station
from trackwright.trackers.core.data.recording import Recording
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import ConstantPosition, Placed
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, independent
from trackwright.trackers.core.model.tunable import Real, Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.tuning.problem import Problem

STATION = work_station().stations["1"]
SIGMA_START = 0.5


class Gauge(AbstractSensor):
    """Reads a place on a line with white noise, and two constant errors that nobody can tell apart."""

    sigma: Any
    offset: Any
    bias: Any

    @property
    def channels(self):
        return (Channel("x", "m"),)

    def measure(self, view, inputs):
        return [view.position[0] + self.offset.value + self.bias.value]

    def residual(self, reading, predicted):
        return independent([reading.values[0] - predicted[0]], [self.sigma.value], reading.seen)


def _on_the_line(x: Any) -> Placed:
    return Placed(Vector(x[0]))


class LineStart(KnownStart):
    """A place on a line, known to `SIGMA_START`."""

    build: Any = eqx.field(static=True, default=_on_the_line)


def line_tracker(sigma_v: float = 0.3, sigma: float = 0.2) -> Tracker:
    """A random walk on a line, read by a gauge: compiles in a second, and a textbook Kalman filter is its oracle."""
    gauge = Gauge(Scale(sigma, "m", "measurement noise"), Real(0.0, "m", typical=0.1), Real(0.0, "m", typical=0.1))
    return Tracker(ConstantPosition(sigma_v, 1), {"gauge": gauge}, LineStart(), track_loss=NEVER_LOST)


def walks(
    lengths: list[int], seed: int, sigma_v: float = 0.3, sigma: float = 0.2, missing: float = 0.2
) -> list[Recording]:
    """Random walks on a line of so many rows, with irregular times, read by a gauge with white noise."""
    rng = np.random.default_rng(seed)
    recordings = []
    for rows in lengths:
        dts = np.concatenate([[0.0], rng.uniform(0.05, 0.2, rows - 1)])
        place = SIGMA_START * rng.normal() + np.cumsum(sigma_v * np.sqrt(dts) * rng.normal(size=rows))
        seen = rng.random((rows, 1)) >= missing
        values = np.where(seen[:, 0], place + sigma * rng.normal(size=rows), 0.0)[:, None]
        made = recording(np.cumsum(dts), {"gauge": (values, seen)}, [0.0], [[SIGMA_START**2]])
        truth = {"position": (place[:, None], np.ones(rows, bool))}
        recordings.append(Recording(made.times, made.readings, made.inputs, truth))
    return recordings


def figure(tracker, batches, objective, weights=None) -> float:
    """The objective of a tracker over batches."""
    return float(Problem(tracker, batches, objective, [], weights=weights).values(np.zeros((1, 0)))[0])
