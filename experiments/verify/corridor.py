"""The corridor as a tracker's world: particles that die at its walls, and its fixes as a batch of many keys."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from experiments.verify.estimators import Naive, Reparameterised
from sim.corridor import CORRIDOR, SIGMA_FIX, SIGMA_MOVE, START, corridor_fixes, rectangle
from trackers.core.algebra import Scalar, Vector, diagonal
from trackers.core.ekf import Gaussian
from trackers.core.motion import ConstantPosition, Placed
from trackers.core.particle.filter import ParticleFilter, Particles
from trackers.core.recording import Batch, Readings, Recording, Row, stack
from trackers.core.sensor import AbstractSensor
from trackers.core.start import AbstractStart
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tracker import Tracker
from trackers.line.fixes import FIXES, FloorFixes
from trackers.parts.walls import Walls

TUNED = ("motion.sigma_v", "sensors.fixes.sigma_p")
"""The tunables of its tracker, in the order of the oracle's slopes."""

NEVER_LOST = TrackLossPolicy(nis_limit=np.inf, max_gap=np.inf)


class InBox(AbstractStart):
    """Begins at the first row, anywhere in the corridor's first rectangle.

    A belief that begins is a normal one; so it stands for the number whose normal probability is the part of the way
    across the rectangle, and `evenly` takes it back.
    """

    def can_start(self, row: Row) -> Scalar:
        return row.dt == row.dt

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        return row.dt

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        zero = jnp.zeros_like(row.dt)
        return Gaussian(Placed(Vector(zero, zero)), diagonal([1.0, 1.0], zero))


def evenly(belief: Particles) -> Particles:
    """The particles of `InBox`'s belief, placed in the rectangle with even density."""
    low, high = START
    places = [a + (b - a) * ndtr(x) for a, b, x in zip(low, high, belief.states.position, strict=True)]
    return belief._replace(states=Placed(Vector.of(places)))


class Boxed(ParticleFilter):
    """The particle filter, whose first particles are evenly in the rectangle."""

    def init(self, belief: Gaussian, key: Any) -> Particles:
        return evenly(super().init(belief, key))


class BoxedNaive(Boxed, Naive):
    """The same, differentiated as the program stands."""


class BoxedReparameterised(Boxed, Reparameterised):
    """The same, differentiated along moves."""


def corridor_tracker(particles: ParticleFilter) -> Tracker:
    """The tracker whose model is the corridor's world."""
    sensors = {FIXES: FloorFixes(SIGMA_FIX)}
    return Tracker(ConstantPosition(SIGMA_MOVE, 2), sensors, InBox(), particles, NEVER_LOST)


def corridor_filter(n_particles: int, kind: type[ParticleFilter] = Boxed) -> ParticleFilter:
    """Particles that die at the corridor's walls."""
    return kind(n_particles, potential=Walls(rectangle(CORRIDOR)))


def corridor_batch(rows: int, keys: int) -> Batch:
    """The same fixes under as many names, which are as many keys; a row without fix before them starts the track."""
    fixes = np.vstack([np.zeros((1, 2)), corridor_fixes(rows)])
    seen = np.arange(rows + 1)[:, None].repeat(2, axis=1) > 0
    times = np.arange(rows + 1.0)
    return stack([Recording(times, {FIXES: Readings(fixes, seen)}, name=f"key {k}") for k in range(keys)])
