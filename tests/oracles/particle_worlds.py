"""Two small worlds with trackers that match them: a corridor whose walls kill particles, and a halt on a line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from tests.known_start import NEVER_LOST
from trackwright.trackers.baselines.floor import Walls
from trackwright.trackers.core.data.recording import Batch, Readings, Recording, stack
from trackwright.trackers.core.filters.filter import AbstractStart, Innovation
from trackwright.trackers.core.filters.particle.filter import AbstractParticleFilter, ParticleFilter, Particles
from trackwright.trackers.core.model.algebra import Scalar, Vector, diagonal
from trackwright.trackers.core.model.covariance import AnyCovariance, Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.motion import AbstractMotion, ConstantPosition, Noise, Placed
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Row
from trackwright.trackers.core.model.state import State
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.line.motion import LineMotion, PathState
from trackwright.trackers.line.tracker import FloorFixes
from trackwright.trackers.parts.fixes import FIXES

CORRIDOR = np.array([[0.0, 0.0], [6.0, 1.5]])  # opposite corners of the corridor, m

START = np.array([[0.75, 0.45], [1.35, 1.05]])
"""Opposite corners of the rectangle, m, over which the initial position is uniform."""

SIGMA_MOVE, SIGMA_FIX = 0.45, 0.8  # standard deviations per axis, m: of the motion in one second, and of a fix

CORRIDOR_TUNABLES = ("motion.sigma_v", "sensors.fixes.sigma_p")
"""The tunables of the corridor's tracker, in the order of the oracle's gradient."""

HALT_TUNABLES = ("motion.sigma_a", "sensors.fixes.sigma_p", "start.sigma")
"""The tunables of the halt's tracker, in the order of the oracle's gradient."""

HALT_SIGMA_A, HALT_SIGMA_FIX, HALT_DT, HALT_ROWS = 0.3, 0.25, 0.5, 24
"""Noise of the speed, m/s per √s; standard deviation of a fix, m; seconds between fixes; number of fixes."""

HALT_ARCLENGTH, HALT_SPEED, HALT_SPREAD = 2.0, 0.6, 0.1
"""Prior of the halt: mean arclength, m, mean speed, m/s, and the standard deviation of both."""


def corridor_fixes(rows: int, seed: int = 3) -> np.ndarray:
    """Fixes (rows, 2), m, at 1 Hz, of a tag that moves along the centre line from 1 m to 5 m."""
    noise = np.random.default_rng(seed).standard_normal((rows, 2))
    along = np.linspace(0.0, 1.0, rows)
    return np.stack([1.0 + 4.0 * along, np.full(rows, 0.75)], axis=1) + SIGMA_FIX * noise


def rectangle(corners: np.ndarray) -> np.ndarray:
    """The four walls (4, 4), each x1, y1, x2, y2 in m, of the rectangle with these opposite corners (2, 2)."""
    (left, low), (right, high) = corners
    knots = np.array([[left, low], [right, low], [right, high], [left, high], [left, low]])
    return np.hstack([knots[:-1], knots[1:]])


class CorridorStart(AbstractStart):
    """A prior has to be normal. This one is standard normal, for `uniform` to map it to the start rectangle."""

    def can_start(self, row):
        return row.valid

    def candidate(self, sensors, row):
        return jnp.zeros_like(row.dt)

    def belief(self, candidate, row):
        return Gaussian(Placed(Vector(candidate, candidate)), diagonal([1.0, 1.0], candidate))


CORRIDOR_START = CorridorStart()


def uniform(belief: Particles) -> Particles:
    """Standard normal particles mapped to a uniform density over the start rectangle by their distribution function."""
    low, high = START
    positions = [a + (b - a) * ndtr(x) for a, b, x in zip(low, high, belief.states.position, strict=True)]
    return belief._replace(states=Placed(Vector.of(positions)))


class UniformParticles(AbstractParticleFilter):
    """The particle filter `particles` with initial particles uniform over the start rectangle."""

    particles: ParticleFilter

    @property
    def bootstrap(self) -> ParticleFilter:
        return self.particles

    def init(self, belief: Gaussian, key: Any) -> Particles:
        return uniform(self.particles.init(belief, key))

    def predict(self, belief: Particles, motion: AbstractMotion, inputs: Inputs, dt: Scalar) -> Particles:
        return self.particles.predict(belief, motion, inputs, dt)

    def update(
        self, belief: Particles, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
    ) -> tuple[Particles, Innovation]:
        return self.particles.update(belief, motion, sensor, reading, inputs)

    def moments(self, belief: Particles) -> tuple[State, AnyCovariance]:
        return self.particles.moments(belief)


def corridor_tracker(n_particles: int) -> Tracker:
    """The tracker whose model is the corridor's world; its particles die at the walls."""
    particles = UniformParticles(ParticleFilter(n_particles, potential=Walls(rectangle(CORRIDOR))))
    sensors = {FIXES: FloorFixes(SIGMA_FIX, None)}
    return Tracker(ConstantPosition(SIGMA_MOVE, 2), sensors, CORRIDOR_START, particles, NEVER_LOST)


def corridor_batch(rows: int, keys: int) -> Batch:
    """The corridor's fixes, one a second, repeated under `keys` trajectory names, hence random keys."""
    return _repeated(corridor_fixes(rows), 1.0, keys)


class HaltStart(AbstractStart):
    """Normal prior with known means at the first row; `sigma` is the spread of arclength, m, and speed, m/s."""

    sigma: Noise

    def can_start(self, row: Row) -> Scalar:
        return row.dt == row.dt

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        return row.dt

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        zero, variance = jnp.zeros_like(row.dt), self.sigma.value**2
        return Gaussian(PathState(zero + HALT_ARCLENGTH, zero + HALT_SPEED), diagonal([variance, variance], zero))


def halt_tracker(filter: Any) -> Tracker:
    """The tracker whose model is the halt's world, with a particle or a grid filter."""
    motion = LineMotion(Polyline([[0.0, 0.0], [12.0, 0.0]]), HALT_SIGMA_A)
    sensors = {FIXES: FloorFixes(HALT_SIGMA_FIX, None)}
    return Tracker(motion, sensors, HaltStart(Scale(HALT_SPREAD, "m")), filter, NEVER_LOST)


def halt_fixes(seed: int = 3) -> np.ndarray:
    """Fixes (HALT_ROWS, 2), m, of a tag that travels for 4 s at 0.6 m/s, rests for 4 s and travels on."""
    times = HALT_DT * np.arange(1, HALT_ROWS + 1)
    along = HALT_ARCLENGTH + np.interp(times, [0.0, 4.0, 8.0, 12.0], [0.0, 2.4, 2.4, 4.8])
    noise = np.random.default_rng(seed).standard_normal((HALT_ROWS, 2))
    return np.stack([along, np.zeros(HALT_ROWS)], axis=1) + HALT_SIGMA_FIX * noise


def halt_batch(keys: int) -> Batch:
    """The halt's fixes, repeated under `keys` trajectory names, hence random keys."""
    return _repeated(halt_fixes(), HALT_DT, keys)


def _repeated(fixes: np.ndarray, dt: float, keys: int) -> Batch:
    """Fixes (T, 2), m, at dt, 2 dt, … under `keys` names; the track starts at time 0, a row without a fix."""
    values = np.vstack([np.zeros((1, 2)), fixes])
    seen = np.arange(len(values))[:, None].repeat(2, axis=1) > 0
    times = dt * np.arange(len(values))
    return stack([Recording(times, {FIXES: Readings(values, seen)}, name=f"key {k}") for k in range(keys)])
