"""The assembled trackers of a tag on a line, by particles or on a grid; their sensors are whatever reads a position."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, diagonal
from trackers.core.ekf import Gaussian
from trackers.core.motion import Noise
from trackers.core.particles import ParticleFilter
from trackers.core.sensor import AbstractSensor
from trackers.core.tracker import AbstractStart, LossPolicy, Row, Tracker
from trackers.core.tunable import Scale
from trackers.line.grid import GridFilter
from trackers.line.motion import HaltingMotion, LineMotion, OnFloor, OnLine, OnSegment
from trackers.line.polyline import Polyline

SIGMA_A = 0.03
SIGMA_LINE = 0.02

NEVER_LOST = LossPolicy(limit=1e3, patience=np.inf)
"""A path that is known keeps a silent tag; that one has left it is another question, see `trackers/line/leaving.py`."""


class LineStart(AbstractStart):
    """Parts enter a line at its beginning: a tag is there, or beyond by a half-normal distance of `sigma_start` m.

    Half of the belief stands on the first knot, since a normal belief is cut off at the ends of the path; likewise
    half of it has no speed, the rest one of scale `sigma_speed` m/s. `resting`: whether the state says so instead.
    """

    sigma_start: Noise
    sigma_speed: Noise
    resting: bool = eqx.field(static=True)

    def ready(self, row: Row) -> Scalar:
        seen = [jnp.any(reading.seen) for reading in row.readings.values()]
        return jnp.any(jnp.stack(seen))

    def acquire(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        return 0.0 * row.dt

    def begin(self, found: Any, row: Row) -> Gaussian:
        zero = found
        start, speed = self.sigma_start.value**2, self.sigma_speed.value**2
        if self.resting:
            return Gaussian(OnSegment(zero, zero, zero + 1.0), diagonal([start, 0.0, 0.0], zero))
        return Gaussian(OnLine(zero, zero), diagonal([start, speed], zero))


def line_motion(line: Polyline, sigma_a: float = SIGMA_A) -> LineMotion | HaltingMotion:
    """Travel that halts at joins where the path has any; σa in m/s per √s."""
    return HaltingMotion(line, sigma_a) if len(line.joins) else LineMotion(line, sigma_a)


def line_tracker(
    motion: LineMotion | HaltingMotion, sensors: Mapping[str, AbstractSensor], n_particles: int = 1000
) -> Tracker:
    """Arclength and speed along a known path by particles, shown as place and velocity on the floor (thesis, 2.2)."""
    return Tracker(motion, sensors, _start(motion), ParticleFilter(n_particles, report=_report(motion)), NEVER_LOST)


def line_grid_tracker(
    motion: LineMotion | HaltingMotion,
    sensors: Mapping[str, AbstractSensor],
    spacing: float = 0.05,
    fastest: float = 1.5,
    speeds: int = 64,
) -> Tracker:
    """The same by a grid: at least 81 places, `spacing` m apart or closer, and `speeds` from 0 to `fastest` m/s."""
    cells = max(81, int(np.ceil(float(motion.line.length) / spacing)) + 1)
    grid = GridFilter(_report(motion), cells, speeds, fastest)
    return Tracker(motion, sensors, _start(motion), grid, NEVER_LOST)


def _start(motion: LineMotion | HaltingMotion) -> LineStart:
    half = 0.5 * float(motion.line.length)
    return LineStart(Scale(half, "m"), Scale(0.1, "m/s"), isinstance(motion, HaltingMotion))


def _report(motion: LineMotion | HaltingMotion) -> OnFloor:
    return OnFloor(motion.line, Scale(SIGMA_LINE, "m"))
