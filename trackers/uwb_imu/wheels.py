"""Wheel odometry: the motion of an upright body whose forward speed and turning rate are measured.

A reading is an input of the rows after it, not a measurement: it holds until the next, and its integral is exact where
it jumps, as of a body that turns on the spot. The body does not move sideways.

    θ⁺ = θ + ω dt    p⁺ = p + R(θ + ½ ω dt) (v dt sinc(½ ω dt), 0) + (R(θ⁺) − R(θ)) a
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.model.algebra import Scalar, Vector
from trackwright.trackers.core.model.inputs import Input, Inputs
from trackwright.trackers.core.model.motion import Noise, process_noise
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.model.tunable import Real
from trackwright.trackers.parts.ranges import in_world_axes
from trackwright.trackers.uwb_imu.strapdown import ARM

ODOMETRY = Input(
    "odometry",
    (3,),
    "m/s, rad/s",
    "forward speed and turning rate since the row before, and 1 where they are known, else 0",
    "`tw.build('body', folder)`, from the table odometry of a recording folder",
)
"""The input with the reading of the wheels that holds up to a row."""

SLIP_S = 0.1
"""How long a slip lasts, s: the velocity at a time has the mean error of so long."""

HOLD_S = 1.0
"""Longest time for which a reading is held, s; after it the speed is unknown."""


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
