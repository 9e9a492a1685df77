"""A tag on a straight line that halts: the world in which the speed of particles is cut off at zero."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, diagonal
from trackers.core.ekf import Gaussian
from trackers.core.motion import Noise
from trackers.core.polyline import Polyline
from trackers.core.recording import Batch, Readings, Recording, Row, stack
from trackers.core.sensor import AbstractSensor
from trackers.core.start import AbstractStart
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tracker import Tracker
from trackers.core.tunable import Scale
from trackers.line.fixes import FIXES, FloorFixes
from trackers.line.motion import LineMotion, OnLine

SIGMA_A, SIGMA_FIX, DT, ROWS = 0.3, 0.25, 0.5, 24
"""Change of speed, m/s per √s; of a fix, m; seconds between fixes, and how many there are."""

PLACE, SPEED, SPREAD = 2.0, 0.6, 0.1
"""The belief before the first fix: m, m/s, and the standard deviation of both."""

TUNED = ("motion.sigma_a", "sensors.fixes.sigma_p", "start.sigma")
"""The tunables of its tracker, in the order of the oracle's slopes."""

NEVER_LOST = TrackLossPolicy(nis_limit=np.inf, max_gap=np.inf)


class Known(AbstractStart):
    """Begins at the first row at the known place with the known speed, both with a spread of `sigma` m and m/s."""

    sigma: Noise

    def can_start(self, row: Row) -> Scalar:
        return row.dt == row.dt

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        return row.dt

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        zero, variance = jnp.zeros_like(row.dt), self.sigma.value**2
        return Gaussian(OnLine(zero + PLACE, zero + SPEED), diagonal([variance, variance], zero))


def halt_tracker(filter: Any) -> Tracker:
    """The tracker of the halt, by particles or on a grid."""
    motion, sensors = LineMotion(Polyline([[0.0, 0.0], [12.0, 0.0]]), SIGMA_A), {FIXES: FloorFixes(SIGMA_FIX)}
    return Tracker(motion, sensors, Known(Scale(SPREAD, "m")), filter, NEVER_LOST)


def halt_fixes(seed: int = 3) -> np.ndarray:
    """Fixes (ROWS, 2), m, of a tag that travels 4 s at 0.6 m/s, rests 4 s and goes on."""
    times = DT * np.arange(1, ROWS + 1)
    along = PLACE + np.interp(times, [0.0, 4.0, 8.0, 12.0], [0.0, 2.4, 2.4, 4.8])
    noise = np.random.default_rng(seed).standard_normal((ROWS, 2))
    return np.stack([along, np.zeros(ROWS)], axis=1) + SIGMA_FIX * noise


def halt_batch(keys: int) -> Batch:
    """The same fixes under as many names, which are as many keys; a row without fix before them starts the track."""
    fixes = np.vstack([np.zeros((1, 2)), halt_fixes()])
    seen = np.arange(ROWS + 1)[:, None].repeat(2, axis=1) > 0
    times = DT * np.arange(ROWS + 1)
    return stack([Recording(times, {FIXES: Readings(fixes, seen)}, name=f"key {k}") for k in range(keys)])
