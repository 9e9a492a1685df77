"""Motions along a path: the thesis's, and one whose state knows the segment, so that rests at joins end it."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.scipy.special import ndtri

from trackers.core.algebra import Scalar, Vector
from trackers.core.motion import AbstractMotion, Kinematic, Noise, scaled
from trackers.core.particle.filter import AbstractOutputMap, second_moments, weighted_mean
from trackers.core.polyline import Polyline
from trackers.core.tunable import Fraction, Scale


class OnLine(NamedTuple):
    """Arclength, m, and speed along the path, m/s, never negative (2.1)."""

    arclength: Scalar
    speed: Scalar


class OnSegment(NamedTuple):
    """Arclength, m, speed, m/s, and whether the tag rests (1) or travels (0).

    A rest is a segment of length zero in section 2.1 of the thesis; where it lies says the arclength, so that both
    together are its segment id.
    """

    arclength: Scalar
    speed: Scalar
    resting: Scalar


class LineMotion(AbstractMotion):
    """d ← d + speed·dt, speed ← max(0, speed + a) with a normal (2.2), up to the end of the path or round it.

    `sigma_a`: m/s per √s. The thesis has a standard deviation per step; per √s it does not depend on the rate.
    """

    line: Polyline
    sigma_a: Noise

    def __init__(self, line: Polyline, sigma_a: float | Noise):
        self.line = line
        self.sigma_a = sigma_a if isinstance(sigma_a, Noise) else Scale(sigma_a, "m/s/sqrt(s)")

    @property
    def noise_dimension(self) -> int:
        return 1

    def step(self, state: OnLine, inputs: Any, dt: Scalar, w: Vector) -> OnLine:
        _, there = _travel(self.line, state, dt)
        change = w[0] * (self.sigma_a.value * jnp.sqrt(dt))
        return OnLine(self.line.on_path(there), jnp.maximum(state.speed + change, 0.0))

    def log_density(self, state: OnLine, inputs: Any, dt: Scalar, w: Vector) -> Scalar:
        return scaled(w[0], self.sigma_a.value)

    def view(self, state: Any) -> Kinematic:
        return on_floor(self.line, state)


class HaltingMotion(AbstractMotion):
    """Travel as in `LineMotion`; with probability `halting` a tag that reaches a join rests there, `rest` s on average.

    It leaves with a speed of half-normal distribution, `sigma_departure` m/s. This is the future work of chapter 4 of
    the thesis: the plain motion overshoots such rests, because it has to slow down and does not know where.
    """

    line: Polyline
    sigma_a: Noise
    halting: Noise
    rest: Noise
    sigma_departure: Noise

    def __init__(
        self, line: Polyline, sigma_a: float, halting: float = 0.5, rest: float = 5.0, sigma_departure: float = 0.5
    ):
        self.line = line
        self.sigma_a = Scale(sigma_a, "m/s/sqrt(s)")
        self.halting = Fraction(halting)
        self.rest = Scale(rest, "s")
        self.sigma_departure = Scale(sigma_departure, "m/s")

    @property
    def noise_dimension(self) -> int:
        return 2

    def step(self, state: OnSegment, inputs: Any, dt: Scalar, w: Vector) -> OnSegment:
        travelled, ahead = self._travelled(state, inputs, dt, w)
        resting, halts, leaves = self._choices(state, ahead, dt, w)
        there = self.line.on_path(jnp.where(halts, ahead, travelled.arclength))
        arclength = jnp.where(resting, self.line.on_path(state.arclength), there)
        # A tag at rest has no speed; the one with which it leaves is drawn from the same number as a change of speed.
        departure = jnp.where(leaves, jnp.abs(w[0]) * self.sigma_departure.value, 0.0)
        speed = jnp.where(resting, departure, jnp.where(halts, 0.0, travelled.speed))
        still = jnp.where((resting & ~leaves) | halts, jnp.ones_like(speed), 0.0)
        return OnSegment(arclength, jnp.where(dt > 0, speed, state.speed), jnp.where(dt > 0, still, state.resting))

    def log_density(self, state: OnSegment, inputs: Any, dt: Scalar, w: Vector) -> Scalar:
        _, ahead = self._travelled(state, inputs, dt, w)
        resting, halts, leaves = self._choices(state, ahead, dt, w)
        travels = scaled(w[0], self.sigma_a.value)
        halting, rate = self.halting.value, 1.0 / self.rest.value
        passes = travels + jnp.where(jnp.isfinite(ahead), jnp.log1p(-halting), 0.0)
        chance = jnp.where(dt > 0, self.leaving(dt), 1.0)
        departs = jnp.log(chance) + scaled(w[0], self.sigma_departure.value)
        rests = jnp.where(leaves, departs, -dt * rate)
        return jnp.where(resting, rests, jnp.where(halts, jnp.log(halting), passes))

    def _travelled(self, state: OnSegment, inputs: Any, dt: Scalar, w: Vector) -> tuple[OnLine, Scalar]:
        """The state after travel without joins, and the arclength of the first join on its way; infinite for none."""
        travelled = LineMotion(self.line, self.sigma_a).step(OnLine(state.arclength, state.speed), inputs, dt, w)
        here, there = _travel(self.line, state, dt)
        ahead = self.line.next_join(here)
        return travelled, jnp.where(ahead <= there, ahead, jnp.inf)

    def _choices(self, state: OnSegment, ahead: Scalar, dt: Scalar, w: Vector) -> tuple[Scalar, Scalar, Scalar]:
        """Whether the tag rests, halts at the join ahead, leaves its rest."""
        resting = jnp.asarray(state.resting) > 0.5
        halts = jnp.isfinite(ahead) & (w[1] < ndtri(self.halting.value)) & ~resting
        return resting, halts, resting & (w[1] < ndtri(self.leaving(dt)))

    def leaving(self, dt: Scalar) -> Scalar:
        """The probability that a rest ends within `dt` s."""
        return -jnp.expm1(-dt / self.rest.value)

    def view(self, state: Any) -> Kinematic:
        return on_floor(self.line, state)


def _travel(line: Polyline, state: Any, dt: Scalar) -> tuple[Scalar, Scalar]:
    """Where a tag is on its path, and how far it gets in `dt` s without a stop, which may be beyond the end, m."""
    # A belief that was given as a normal one reaches beyond the path and below no speed: it is cut off here.
    here = line.on_path(state.arclength)
    return here, here + jnp.maximum(state.speed, 0.0) * dt


def on_floor(line: Polyline, state: Any) -> Kinematic:
    """Place, m, and velocity, m/s, on the floor of a state on the line (2.4)."""
    return Kinematic(line.position(state.arclength), line.direction(state.arclength) * state.speed)


class OnFloor(AbstractOutputMap):
    """Place and velocity on the floor of a state on the line; `sigma_line`: how well the path itself is known, m."""

    line: Polyline
    sigma_line: Noise

    def moments(self, states: Any, weights: Any) -> tuple[Kinematic, tuple[Scalar, ...]]:
        """The mean state's place and velocity; the spread of places about it, velocities along the segment there."""
        mean = weighted_mean(states._replace(arclength=self.line.gathered(states.arclength, weights)), weights)
        shown = on_floor(self.line, mean)
        places = self.line.position(states.arclength) - shown.position
        xx, xy, xs, yy, ys, ss = second_moments([*places, states.speed - mean.speed], weights)
        u, v = self.line.direction(mean.arclength)
        known = self.sigma_line.value**2
        return shown, (xx + known, xy, xs * u, xs * v, yy + known, ys * u, ys * v, ss * u * u, ss * u * v, ss * v * v)
