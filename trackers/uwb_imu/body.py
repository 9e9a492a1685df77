"""The assembled tracker of a rigid body with several ranging tags: position, velocity, heading and turning rate."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from trackwright.trackers.core.errors import is_count, require
from trackwright.trackers.core.model.algebra import Scalar, Vector, diagonal
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.motion import Noise
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.track_loss import TrackScorePolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import DriftingBiases, damped_velocity
from trackwright.trackers.parts.ranges import RANGES, RangeSensor
from trackwright.trackers.parts.start_nearby import AbstractNearbyStart
from trackwright.trackers.recordings.calibration import Calibration
from trackwright.trackers.uwb_imu.fusion import MAX_BIASES, REACH, range_levels
from trackwright.trackers.uwb_imu.yaw_mixture import YawMixtureFilter


class BodyState(NamedTuple):
    """Position, m, velocity, m/s, range biases, m, heading about the vertical, rad, and turning rate, rad/s."""

    position: Vector
    velocity: Vector
    bias: Vector
    shared: Vector
    attitude: Heading
    rate: Scalar


class TurningBody(DriftingBiases):
    """`DriftingBiases` of an upright body whose turning rate is a first-order Gauss–Markov process.

    `sigma_turn`: white angular acceleration, rad/s² per √Hz; `turn_memory`: time constant of the turning rate, s.
    """

    sigma_turn: Noise
    turn_memory: Noise

    def __init__(self, sigma_turn: float, turn_memory: float, *args: Any):
        """`args`: those of `DriftingBiases`."""
        super().__init__(*args)
        self.sigma_turn = Scale(sigma_turn, "rad/s^2/sqrt(Hz)", "process noise")
        self.turn_memory = Scale(turn_memory, "s")

    @property
    def noise_dimension(self) -> int:
        return super().noise_dimension + 2

    def step(self, state: Any, inputs: Inputs, dt: Scalar, w: Vector) -> Any:
        *carried, a, b = w.parts
        carried_on = super().step(state, inputs, dt, Vector(*carried))
        decay, gain, rate_noise, shared, separate = damped_velocity(dt, self.turn_memory.value)
        sigma = self.sigma_turn.value
        heading = state.attitude.angle + state.rate * gain + sigma * (a * shared + b * separate)
        return BodyState(*carried_on, Heading(heading), state.rate * decay + sigma * a * rate_noise)


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
        sizes = {"position": n, "velocity": n, "bias": self.biases, "shared": 1, "heading": 1, "rate": 1}
        state = BodyState(
            Vector(*(candidate[k] for k in range(n))),
            Vector(*[zero] * n),
            Vector(*[zero] * self.biases),
            Vector(zero),
            Heading(zero),
            zero,
        )
        variances = [getattr(self, f"sigma_{name}").value ** 2 for name, size in sizes.items() for _ in range(size)]
        return Gaussian(state, diagonal(variances, zero))


def body_tracker(
    anchors: int,
    planar: bool = False,
    sigma_a: float = 0.44,
    sigma_z: float = 0.7,
    memory: float = 5.5,
    sigma_turn: float = 0.5,
    turn_memory: float = 1.0,
    sigma_r: float = 0.2,
    positive_skew: float = 4.0,
    dof: float = 1.8,
    bias: float = 0.07,
    sigma_bias: float = 0.085,
    time_constant: float = 65.0,
    length: float = 5.0,
    sigma_shared: float = 0.1,
) -> Tracker:
    """Position, velocity, heading and turning rate of an upright body from the ranges of its tags, one range per row.

    Levels of motion and biases are those of `range_tracker`; `sigma_r` is larger, since the ranges of several tags to
    an anchor share errors (docs/decisions.md). `sigma_turn`, `turn_memory` as in `TurningBody`.
    Estimates are of the place from which the input `levers` leads to the tags.
    """
    require(is_count(anchors), "body_tracker", anchors, "the number of anchors, as body_tracker(len(rig.anchors))")
    biases = anchors if anchors <= MAX_BIASES else 0
    start = {
        "sigma_position": 1.0, "sigma_velocity": 1.0, "sigma_bias": sigma_bias, "sigma_shared": sigma_shared,
        "sigma_heading": 1.0, "sigma_rate": 0.5,
    }  # fmt: skip
    units = {"sigma_velocity": "m/s", "sigma_heading": "rad", "sigma_rate": "rad/s"}
    return Tracker(
        TurningBody(sigma_turn, turn_memory, biases, sigma_a, sigma_z, memory, sigma_bias, time_constant, length),
        {RANGES: RangeSensor(1, anchors, sigma_r, positive_skew, dof, bias)},
        BodyStart(
            **{name: Scale(value, units.get(name, "m")) for name, value in start.items()}, planar=planar, biases=biases
        ),
        YawMixtureFilter(),
        TrackScorePolicy(REACH, "m"),
    )


def body_levels(calibration: Calibration | None) -> dict[str, float]:
    """The noise levels of `body_tracker`, by name, at a site with this calibration; none where it has no anchors."""
    return {name: value for name, value in range_levels(calibration).items() if name != "sigma_r"}
