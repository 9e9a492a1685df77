"""Start of position trackers from a position that follows from recent bearings or ranges."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

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


class AbstractPlaces(eqx.Module):
    """How the input `nearby` follows from the readings of the N rows of a trajectory; rows of one time have the same.

    Called with the readings (N, m, B) of B such trajectories, and where they are `seen`, it gives theirs (N, 4, B).
    """

    @abstractmethod
    def __call__(self, values: Float[Array, "N m B"], seen: Bool[Array, "N m B"]) -> Float[Array, "N 4 B"]: ...


def last_of_times(
    starts: Int[np.ndarray, " ends"], times: Float[np.ndarray, " N"]
) -> tuple[Int[np.ndarray, " K"], Int[np.ndarray, " N"]]:
    """The last row of each of the K times of tags, and of each row the number of its time.

    `starts` (n + 1,): the first row of each of n tags, then N; `times`: sorted by tag, s.
    """
    ends = np.append(np.diff(times) != 0, True)
    ends[starts[1:] - 1] = True
    return np.flatnonzero(ends), np.cumsum(ends) - ends


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
