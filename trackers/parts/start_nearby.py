"""Start of position trackers from a position computed on the host from recent bearings or ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from trackwright.trackers.core.filters.filter import AbstractStart
from trackwright.trackers.core.model.algebra import Scalar, Vector, diagonal
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Input
from trackwright.trackers.core.model.motion import Kinematic, Noise
from trackwright.trackers.core.model.sensor import AbstractSensor, Row

NEARBY = Input(
    "nearby",
    (4,),
    "m",
    "a position from recent measurements, and 1 where they determine it, else 0",
    "`range_recording`, `bearing_recording`, `recent_points`",
)
"""The input with the position of a start."""


class AbstractNearbyStart(AbstractStart):
    """A start at the position in the input `nearby` (4,): x, y, z in m, and 1 where recent measurements determine it.

    `nearby` comes from `recent_points` (trackers/aoa/rays.py) for bearings and from `recent_positions`
    (trackers/parts/multilaterate.py) for ranges.
    """

    @property
    def inputs(self) -> tuple[Input, ...]:
        return (NEARBY,)

    def can_start(self, row: Row) -> Scalar:
        return row.inputs["nearby"][3] > 0.5

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        return row.inputs["nearby"][:3]


class NearbyStart(AbstractNearbyStart):
    """A start at the position in the input `nearby` (4,), at rest: the prior of a `Kinematic` state.

    `sigma_position` m, `sigma_velocity` m/s: its standard deviations. `planar`: x and y alone. `velocities`: the number
    of velocities in the state.
    """

    sigma_position: Noise
    sigma_velocity: Noise
    planar: bool = eqx.field(static=True)
    velocities: int = eqx.field(static=True)

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        # Not the candidate, which carries no derivative: the points of a cascade depend on its beams.
        place = [row.inputs[NEARBY.name][k] for k in range(2 if self.planar else 3)]
        return at_rest(place, self.velocities, self.sigma_position, self.sigma_velocity)


def at_rest(place: Sequence[Scalar], velocities: int, sigma_position: Noise, sigma_velocity: Noise) -> Gaussian:
    """The belief of a `Kinematic` state at a place (n,), m, with so many velocities, all zero."""
    zero, position, velocity = jnp.zeros_like(place[0]), sigma_position.value**2, sigma_velocity.value**2
    state = Kinematic(Vector(*place), Vector(*[zero] * velocities))
    return Gaussian(state, diagonal([position] * len(place) + [velocity] * velocities, zero))
