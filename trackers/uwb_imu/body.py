"""The assembled tracker of a rigid body with ranging tags: position, velocity, heading and turning rate."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from trackwright.trackers.core.model.algebra import Scalar, Vector, diagonal, select
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Input, Inputs
from trackwright.trackers.core.model.motion import AbstractMotion, Noise
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import BiasedStart, DriftingBiases, damped_velocity
from trackwright.trackers.parts.start_nearby import AbstractNearbyStart
from trackwright.trackers.uwb_imu.fusion import range_tracker
from trackwright.trackers.uwb_imu.strapdown import ARM
from trackwright.trackers.uwb_imu.wheels import ODOMETRY, Wheels
from trackwright.trackers.uwb_imu.yaw_mixture import YawMixtureFilter


class BodyState(NamedTuple):
    """Position, m, heading about the vertical, rad, velocity, m/s, turning rate, rad/s, and range biases, m."""

    position: Vector
    attitude: Heading
    velocity: Vector
    rate: Scalar
    bias: Vector
    shared: Vector


class TurningBody(AbstractMotion):
    """Motion of an upright body: of its place and biases, and a turning rate, first-order Gauss–Markov as well.

    `sigma_turn`: white angular acceleration, rad/s² per √Hz; `turn_memory`: time constant of the turning rate, s.
    With `wheels` the body moves by their odometry where that is known.
    """

    place: DriftingBiases
    sigma_turn: Noise
    turn_memory: Noise
    wheels: Wheels | None

    def __init__(self, place: DriftingBiases, sigma_turn: float, turn_memory: float, wheels: Wheels | None = None):
        self.place = place
        self.wheels = wheels
        self.sigma_turn = Scale(sigma_turn, "rad/s^2/sqrt(Hz)", "process noise")
        self.turn_memory = Scale(turn_memory, "s")

    @property
    def noise_dimension(self) -> int:
        return self.place.noise_dimension + 2

    @property
    def inputs(self) -> tuple[Input, ...]:
        return self.place.inputs if self.wheels is None else (*self.place.inputs, ODOMETRY, ARM)

    def at(self, belief: Gaussian) -> TurningBody:
        return eqx.tree_at(lambda motion: motion.place, self, self.place.at(belief))

    def step(self, state: Any, inputs: Inputs, dt: Scalar, w: Vector) -> BodyState:
        *carried, a, b = w.parts
        carried_on = self.place.step(state, inputs, dt, Vector(*carried))
        decay, gain, rate_noise, shared, separate = damped_velocity(dt, self.turn_memory.value)
        sigma = self.sigma_turn.value
        heading = state.attitude.angle + state.rate * gain + sigma * (a * shared + b * separate)
        turning = {"attitude": Heading(heading), "rate": state.rate * decay + sigma * a * rate_noise}
        free = BodyState(**carried_on._asdict(), **turning)
        if self.wheels is None:
            return free
        driven = self.wheels.driven(state, inputs, dt, Vector(*carried[:2], *carried[3:5], a, b))
        on_floor = {name: Vector(*driven[name], *getattr(free, name).parts[2:]) for name in ("position", "velocity")}
        known = (inputs[ODOMETRY.name][2] > 0.5) & (dt > 0)
        return select(known, free._replace(**{**driven, **on_floor}), free)


class BodyStart(AbstractNearbyStart):
    """A start at the position in the input `nearby` (4,), at rest, with zero biases and unknown heading.

    Standard deviations: `sigma_position` m, `sigma_velocity` m/s, `sigma_bias` and `sigma_shared` m, `sigma_heading`
    rad, of each component of the Gaussian sum over the heading, and `sigma_rate` rad/s.
    """

    sigma_position: Noise
    sigma_velocity: Noise
    sigma_bias: Noise
    sigma_shared: Noise
    sigma_heading: Noise
    sigma_rate: Noise
    planar: bool = eqx.field(static=True)
    biases: int = eqx.field(static=True)

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        n, zero = 2 if self.planar else 3, jnp.zeros_like(candidate[0])
        sizes = {"position": n, "heading": 1, "velocity": n, "rate": 1, "bias": self.biases, "shared": 1}
        state = BodyState(
            Vector(*(candidate[k] for k in range(n))),
            Heading(zero),
            Vector(*[zero] * n),
            zero,
            Vector(*[zero] * self.biases),
            Vector(zero),
        )
        variances = [getattr(self, f"sigma_{name}").value ** 2 for name, size in sizes.items() for _ in range(size)]
        return Gaussian(state, diagonal(variances, zero))


LASTS = 0.1
"""How long the error of a range to a tag on a body lasts, s: ranges of that time count as one (docs/decisions.md)."""


def body_tracker(
    anchors: int,
    planar: bool = False,
    as_one: int = 1,
    wheels: Wheels | None = None,
    sigma_turn: float = 0.5,
    turn_memory: float = 1.0,
    sigma_r: float = 0.09,
    **levels: float,
) -> Tracker:
    """Position, heading, velocity and turning rate of an upright body from the ranges of its tags, one range per row.

    `sigma_r` and `levels`: as in `range_tracker`, whose `range_levels` serve a calibrated site; `sigma_turn` and
    `turn_memory`: as in `TurningBody`; `wheels`: where the body has odometry. `as_one`: how many ranges between a
    tag and an anchor count as one, since they come within `LASTS` s; the noise of each is larger by the square root.
    Estimates are of the place from which the input `levers` leads to the tags.
    """
    tag = range_tracker(anchors, planar, sigma_r=sigma_r * math.sqrt(as_one), **levels)
    start = tag.start
    assert isinstance(tag.motion, DriftingBiases)
    assert isinstance(start, BiasedStart)
    assert start.sigma_shared is not None
    # A heading that the way alone shows is farther from linear than one that levers show.
    headings, sigma_heading = (3, 1.0) if wheels is None else (4, 0.8)
    return Tracker(
        TurningBody(tag.motion, sigma_turn, turn_memory, wheels),
        tag.sensors,
        BodyStart(
            start.sigma_position,
            start.sigma_velocity,
            start.sigma_bias,
            start.sigma_shared,
            Scale(sigma_heading, "rad"),
            Scale(0.5, "rad/s"),
            planar,
            start.biases,
        ),
        YawMixtureFilter(count=headings),
        tag.track_loss,
    )
