"""The assembled trackers of a tag on a line, by particles or on a grid; their sensors are whatever reads a position."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, diagonal, total
from trackers.core.ekf import Gaussian
from trackers.core.motion import Noise
from trackers.core.particle.filter import ParticleFilter, log_density
from trackers.core.polyline import Polyline
from trackers.core.recording import Row
from trackers.core.sensor import AbstractSensor
from trackers.core.start import AbstractStart
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tracker import Tracker
from trackers.core.tunable import Scale
from trackers.line.grid import GridFilter
from trackers.line.motion import HaltingMotion, LineMotion, OnFloor, OnLine, OnSegment, on_floor

SIGMA_A = 0.05
"""Change of speed, m/s per √s: a cart at walking pace that may take another speed on every segment."""

SIGMA_LINE = 0.02
"""How well a marked path is known, m."""

DRAWN = 0.5
"""Metres between knots below which they draw a curve."""

PATIENT = TrackLossPolicy(nis_limit=30.0, max_gap=np.inf)
"""A path that is known keeps a silent tag, and errors of fixes last for seconds; whether it left: `leaving.py`."""

PLACES = 201
"""Places along the path among which a start is looked for."""


class LineStart(AbstractStart):
    """Where the first row's readings put a tag on the line, of which it more likely has just entered the beginning.

    Before them, half of the belief stands on the first knot, the other half of a normal one whose scale is half the
    path's length; on a closed path all places are as likely. Afterwards the tag may be off by `sigma_start` m beyond
    what they say, since a first reading can be wild. Half of the belief has no speed, the rest one of scale
    `sigma_speed` m/s, or `resting` says that it rests.
    """

    line: Polyline
    sigma_start: Noise
    sigma_speed: Noise
    resting: bool = eqx.field(static=True)

    smooth: ClassVar[bool] = True

    def can_start(self, row: Row) -> Scalar:
        seen = [jnp.any(reading.seen) for reading in row.readings.values()]
        return jnp.any(jnp.stack(seen))

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        along = jnp.arange(PLACES, dtype=row.dt.dtype) * (self.line.length / (PLACES - 1))
        prior = jnp.exp(-2.0 * (along / self.line.length) ** 2)
        # Of a closed path the first place is the last one again.
        prior = jnp.ones_like(along).at[0].set(0.0) if self.line.closed else prior.at[0].set(jnp.sum(prior))

        def weigh(arclength: Scalar) -> Scalar:
            view = on_floor(self.line, OnLine(arclength, 0.0 * arclength))
            densities = []
            for name, sensor in sensors.items():
                reading = row.readings[name]
                densities.append(log_density(sensor.residual(reading, list(sensor.measure(view, row.inputs)))))
            return total(densities)

        densities = jax.vmap(weigh)(along)
        weights = jnp.exp(densities - jnp.max(densities)) * prior
        weights = weights / jnp.sum(weights)
        along = self.line.gathered(along, weights)
        mean = jnp.sum(weights * along)
        return jnp.stack([mean, jnp.sum(weights * (along - mean) ** 2)])

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        place, zero = candidate[0], jnp.zeros_like(candidate[0])
        start, speed = candidate[1] + self.sigma_start.value**2, self.sigma_speed.value**2
        if self.resting:
            return Gaussian(OnSegment(place, zero, zero + 1.0), diagonal([start, 0.0, 0.0], zero))
        return Gaussian(OnLine(place, zero), diagonal([start, speed], zero))


def line_motion(line: Polyline, sigma_a: float = SIGMA_A) -> LineMotion | HaltingMotion:
    """Travel that halts at joins; σa in m/s per √s.

    Plain travel where the path has none, or where its segments are shorter than `DRAWN` on average: the knots of a
    curve are no places to rest.
    """
    drawn = line.length < DRAWN * len(line.lengths)
    return LineMotion(line, sigma_a) if drawn or not len(line.joins) else HaltingMotion(line, sigma_a)


def line_tracker(
    motion: LineMotion | HaltingMotion, sensors: Mapping[str, AbstractSensor], n_particles: int = 1000
) -> Tracker:
    """Arclength and speed along a known path by particles, shown as place and velocity on the floor (thesis, 2.2)."""
    return Tracker(motion, sensors, _start(motion), ParticleFilter(n_particles, output_map=_report(motion)), PATIENT)


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
    return Tracker(motion, sensors, _start(motion), grid, PATIENT)


def _start(motion: LineMotion | HaltingMotion) -> LineStart:
    return LineStart(motion.line, Scale(0.5, "m"), Scale(0.1, "m/s"), isinstance(motion, HaltingMotion))


def _report(motion: LineMotion | HaltingMotion) -> OnFloor:
    return OnFloor(motion.line, Scale(SIGMA_LINE, "m"))
