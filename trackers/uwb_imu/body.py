"""The assembled tracker of a rigid body with ranging tags: position, velocity, heading and turning rate.

Its wheels may be measured. A reading is an input of the rows after it, not a measurement: it holds until the next, and
its integral is exact where it jumps, as of a body that turns on the spot. The body does not move sideways.

    θ⁺ = θ + ω dt    p⁺ = p + R(θ + ½ ω dt) (v dt sinc(½ ω dt), 0) + (R(θ⁺) − R(θ)) a
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.model.algebra import Scalar, Vector, diagonal, select
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Input, Inputs
from trackwright.trackers.core.model.motion import AbstractMotion, Noise, process_noise
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.model.tunable import Real, Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import BiasedStart, DriftingBiases, damped_velocity
from trackwright.trackers.parts.ranges import in_world_axes
from trackwright.trackers.parts.start_nearby import AbstractNearbyStart
from trackwright.trackers.uwb_imu.fusion import range_tracker
from trackwright.trackers.uwb_imu.strapdown import ARM
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


ODOMETRY = Input(
    "odometry",
    (3,),
    "m/s, rad/s",
    "forward speed and turning rate since the row before, and 1 where they are known, else 0",
    "`tw.build('body', folder)`, from the table odometry of a recording folder",
)
"""The input with the reading of the wheels that holds up to a row."""

SLIP_S = 0.1  # how long a slip lasts, s: the velocity at a time has the mean error of so long

HOLD_S = 1.0  # longest time for which a reading is held, s; after it the speed is unknown


class Wheels(eqx.Module):
    """The motion by odometry, with white errors.

    `sigma_slip`: of the velocity, m/s per √Hz, forward and sideways alike. `sigma_yaw_rate`: of the turning rate, rad/s
    per √Hz. `arm` (2,): adds to the lever arm of the rig, ahead and to the left, m.
    """

    sigma_slip: Noise
    sigma_yaw_rate: Noise
    arm: Noise

    def __init__(self, sigma_slip: float | Noise = 0.01, sigma_yaw_rate: float | Noise = 0.04):
        self.sigma_slip = process_noise(sigma_slip, "m/s/sqrt(Hz)")
        self.sigma_yaw_rate = process_noise(sigma_yaw_rate, "rad/s/sqrt(Hz)")
        self.arm = Real(np.zeros(2), "m", typical=0.05)

    def driven(self, state: Any, inputs: Inputs, dt: Scalar, w: Vector) -> dict[str, Any]:
        """Position and velocity over the floor, heading and turning rate `dt` s later; `w`: six draws.

        `arm` in the inputs: the lever arm from the middle of the axle to the place of the state.
        """
        speed, rate, _ = (inputs[ODOMETRY.name][k] for k in range(3))
        root, turn = jnp.sqrt(dt), rate * dt
        middle, turned = (Heading(state.attitude.angle + share * turn) for share in (0.5, 1.0))
        after = Heading(turned.angle + self.sigma_yaw_rate.value * root * w[4])
        chord = in_world_axes(middle, Vector(speed * dt * jnp.sinc(turn / (2 * np.pi)), 0.0, 0.0))
        added = self.arm.value
        arm = Vector(inputs[ARM.name][0] + added[0], inputs[ARM.name][1] + added[1], inputs[ARM.name][2])
        moved = chord + (in_world_axes(after, arm) - in_world_axes(state.attitude, arm))
        velocity = in_world_axes(turned, Vector(speed - rate * arm[1], rate * arm[0], 0.0))
        slip = self.sigma_slip.value
        return {
            "position": [state.position[k] + moved[k] + slip * root * w[k] for k in range(2)],
            "velocity": [velocity[k] + (slip / SLIP_S**0.5) * w[2 + k] for k in range(2)],
            "attitude": after,
            "rate": rate + (self.sigma_yaw_rate.value / SLIP_S**0.5) * w[5],
        }


def odometry_inputs(times: np.ndarray, read_times: np.ndarray, readings: np.ndarray) -> np.ndarray:
    """The input `odometry` (T, 3) of rows at `times` (T,) s: of each the reading that holds from the row before.

    `readings` (n, 2): forward speed, m/s, and turning rate, rad/s, at `read_times` (n,) s, sorted; NaN if missing.
    """
    known = np.isfinite(readings).all(axis=1)
    read_times, readings = read_times[known], np.append(readings[known], [[0.0, 0.0]], axis=0)
    last = np.searchsorted(read_times, np.append(times[:1], times[:-1]), side="right") - 1
    held = (last >= 0) & (times - np.append(read_times, np.inf)[last] <= HOLD_S)
    return np.where(held[:, None], np.column_stack([readings[last], np.ones(len(times))]), 0.0)
