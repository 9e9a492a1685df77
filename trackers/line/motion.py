"""Motions along a known path: the thesis's (2.1), (2.2), and one with halts at the joins of segments or anywhere."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.scipy.special import ndtri

from trackwright.trackers.core.filters.particle.filter import AbstractOutputMap, second_moments, weighted_mean
from trackwright.trackers.core.model.algebra import Scalar, Vector
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.motion import AbstractMotion, Kinematic, Noise, draw_log_density, process_noise
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.tunable import Fraction, Scale


class PathState(NamedTuple):
    """Arclength, m, and speed along the path, m/s, never negative (2.1)."""

    arclength: Scalar
    speed: Scalar


class HaltingState(NamedTuple):
    """Arclength, m, speed, m/s, and whether the tag rests (1) or travels (0).

    Section 2.1 of the thesis models a rest as a segment of length zero; `resting` and the arclength identify it.
    """

    arclength: Scalar
    speed: Scalar
    resting: Scalar


class LineMotion(AbstractMotion):
    """d ← d + speed·dt, speed ← max(0, speed + a), a normal (2.2); it stops at the end of a path that is not closed.

    `sigma_a`: m/s per √s. The thesis has a standard deviation per step, which depends on the sampling rate.
    """

    line: Polyline
    sigma_a: Noise

    def __init__(self, line: Polyline, sigma_a: float | Noise):
        self.line = line
        self.sigma_a = process_noise(sigma_a, "m/s/sqrt(s)")

    @property
    def noise_dimension(self) -> int:
        return 1

    def step(self, state: PathState, inputs: Inputs, dt: Scalar, w: Vector) -> PathState:
        arclength, speed = possible(self.line, state.arclength, state.speed)
        change = w[0] * (self.sigma_a.value * jnp.sqrt(dt))
        return PathState(self.line.on_path(arclength + speed * dt), jnp.maximum(speed + change, 0.0))

    def log_density(self, state: PathState, inputs: Inputs, dt: Scalar, w: Vector) -> Scalar:
        return draw_log_density(w[0], self.sigma_a.value)

    def view(self, state: Any) -> Kinematic:
        return floor_state(self.line, state)


class HaltingMotion(AbstractMotion):
    """`LineMotion`, with halts: at a join the tag rests with probability `halting`, for `rest` s on average.

    `sigma_a`: white acceleration along the path, m/s per √s. The speed after a rest is half-normal with scale
    `sigma_departure` m/s. `travel`: mean time of travel, s, after which the tag halts away from joins, too; None for
    never. Future work in chapter 4 of the thesis: `LineMotion` overshoots rests at joins. Its speed, never negative,
    also carries a tag at rest on wherever readings are weak.
    """

    line: Polyline
    sigma_a: Noise
    halting: Noise
    rest: Noise
    sigma_departure: Noise
    travel: Noise | None

    def __init__(
        self,
        line: Polyline,
        sigma_a: float,
        halting: float = 0.5,
        rest: float = 5.0,
        sigma_departure: float = 0.5,
        travel: float | None = None,
    ):
        self.line = line
        self.sigma_a = Scale(sigma_a, "m/s/sqrt(s)", "process noise")
        self.halting = Fraction(halting)
        self.rest = Scale(rest, "s")
        self.sigma_departure = Scale(sigma_departure, "m/s", "process noise")
        self.travel = None if travel is None else Scale(travel, "s")

    @property
    def noise_dimension(self) -> int:
        return 2

    def step(self, state: HaltingState, inputs: Inputs, dt: Scalar, w: Vector) -> HaltingState:
        travelled, ahead = self._travelled(state, inputs, dt, w)
        resting, at_join, halts, leaves = self._choices(state, ahead, dt, w)
        there = self.line.on_path(jnp.where(at_join, ahead, travelled.arclength))
        arclength = jnp.where(resting, self.line.on_path(state.arclength), there)
        # At rest the speed is zero; the speed of departure uses the same noise component as a change of speed.
        departure = jnp.where(leaves, jnp.abs(w[0]) * self.sigma_departure.value, 0.0)
        speed = jnp.where(resting, departure, jnp.where(halts, 0.0, travelled.speed))
        still = jnp.where((resting & ~leaves) | halts, jnp.ones_like(speed), 0.0)
        return HaltingState(arclength, jnp.where(dt > 0, speed, state.speed), jnp.where(dt > 0, still, state.resting))

    def log_density(self, state: HaltingState, inputs: Inputs, dt: Scalar, w: Vector) -> Scalar:
        _, ahead = self._travelled(state, inputs, dt, w)
        resting, at_join, halts, leaves = self._choices(state, ahead, dt, w)
        travels = draw_log_density(w[0], self.sigma_a.value)
        rate, (join, either) = 1.0 / self.rest.value, self._halting(ahead, dt)
        chance = jnp.where(dt > 0, self.leaving(dt), 1.0)
        departs = jnp.log(chance) + draw_log_density(w[0], self.sigma_departure.value)
        rests = jnp.where(leaves, departs, -dt * rate)
        halting = jnp.where(at_join, join, jnp.where(halts, either - join, 1.0))
        return jnp.where(resting, rests, jnp.where(halts, jnp.log(halting), travels + jnp.log1p(-either)))

    def _travelled(self, state: HaltingState, inputs: Inputs, dt: Scalar, w: Vector) -> tuple[PathState, Scalar]:
        """The state after travel without halts, and the arclength of the first join reached; infinite for none."""
        travelled = LineMotion(self.line, self.sigma_a).step(PathState(state.arclength, state.speed), inputs, dt, w)
        arclength, speed = possible(self.line, state.arclength, state.speed)
        ahead = self.line.next_join(arclength)
        return travelled, jnp.where(ahead <= arclength + speed * dt, ahead, jnp.inf)

    def _choices(self, state: HaltingState, ahead: Scalar, dt: Scalar, w: Vector) -> tuple[Scalar, ...]:
        """Whether the tag rests, halts at the join ahead, halts there or elsewhere, and leaves its rest."""
        resting = jnp.asarray(state.resting) > 0.5
        at_join, halts = ((w[1] < ndtri(p)) & ~resting for p in self._halting(ahead, dt))
        return resting, at_join, halts, resting & (w[1] < ndtri(self.leaving(dt)))

    def _halting(self, ahead: Scalar, dt: Scalar) -> tuple[Scalar, Scalar]:
        """The probabilities of a halt within `dt` s at the join `ahead`, infinite for none, and of one anywhere."""
        join = jnp.where(jnp.isfinite(ahead), self.halting.value, 0.0)
        return join, join + (1.0 - join) * self.stopping(dt)

    def stopping(self, dt: Scalar) -> Scalar:
        """The probability that a tag halts away from joins within `dt` s of travel."""
        return 0.0 * dt if self.travel is None else -jnp.expm1(-dt / self.travel.value)

    def leaving(self, dt: Scalar) -> Scalar:
        """The probability that a rest ends within `dt` s."""
        return -jnp.expm1(-dt / self.rest.value)

    def view(self, state: Any) -> Kinematic:
        return floor_state(self.line, state)


def possible(line: Polyline, arclength: Scalar, speed: Scalar) -> PathState:
    """The state with its arclength on the path and its speed clipped at zero.

    A normal prior extends beyond the ends of the path and to negative speeds: the mass there goes to the limits, as in
    `GridFilter.init`.
    """
    return PathState(line.on_path(arclength), jnp.maximum(speed, 0.0))


def floor_state(line: Polyline, state: Any) -> Kinematic:
    """Position, m, and velocity, m/s, on the floor of a state on the path (2.4)."""
    arclength, speed = possible(line, state.arclength, state.speed)
    return Kinematic(line.position(arclength), line.direction(arclength) * speed)


class PathOutputMap(AbstractOutputMap):
    """Output: position and velocity on the floor; `sigma_line`: standard deviation of the path itself, m."""

    line: Polyline
    sigma_line: Noise

    def moments(self, states: Any, weights: Any) -> tuple[Kinematic, tuple[Scalar, ...]]:
        """Mean and covariance: position and velocity of the mean state, positions and speeds about it.

        The covariance of the velocity is along the segment of the mean.
        """
        states = possible(self.line, states.arclength, states.speed)
        mean = weighted_mean(states._replace(arclength=self.line.gathered(states.arclength, weights)), weights)
        output = floor_state(self.line, mean)
        offsets = self.line.position(states.arclength) - output.position
        xx, xy, xs, yy, ys, ss = second_moments([*offsets, states.speed - mean.speed], weights)
        u, v = self.line.direction(mean.arclength)
        path = self.sigma_line.value**2
        return output, (xx + path, xy, xs * u, xs * v, yy + path, ys * u, ys * v, ss * u * u, ss * u * v, ss * v * v)
