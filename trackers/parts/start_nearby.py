"""The start of position trackers from a place that was found on the host, where recent bearings or ranges meet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector, diagonal
from trackers.core.ekf import Gaussian
from trackers.core.motion import Kinematic, Noise
from trackers.core.recording import Row
from trackers.core.sensor import AbstractSensor
from trackers.core.start import AbstractStart


class AbstractNearbyStart(AbstractStart):
    """From a place found on the host: the row's input `nearby` (4,), m, and 1 where there is one."""

    def can_start(self, row: Row) -> Scalar:
        return row.inputs["nearby"][3] > 0.5

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        return row.inputs["nearby"][:3]


class NearbyStart(AbstractNearbyStart):
    """A place found on the host from recent readings: the row's input `nearby` (4,), m, and 1 where there is one.

    `sigma_position` m, `sigma_velocity` m/s: how far off it may be. `velocities`: the number of the state's velocities.
    """

    sigma_position: Noise
    sigma_velocity: Noise
    planar: bool = eqx.field(static=True)
    velocities: int = eqx.field(static=True)

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        n = 2 if self.planar else 3
        zero = jnp.zeros_like(candidate[0])
        position, velocity = self.sigma_position.value**2, self.sigma_velocity.value**2
        state = Kinematic(Vector(*(candidate[k] for k in range(n))), Vector(*[zero] * self.velocities))
        return Gaussian(state, diagonal([position] * n + [velocity] * self.velocities, zero))
