"""Direct positioning: one EKF from the phases of all stations to the position, with spherical waves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.aoa.beamformer import Grid, direction
from trackwright.trackers.aoa.fusion import region_centre
from trackwright.trackers.aoa.phases import SphericalPhases, require_arrays
from trackwright.trackers.aoa.rays import nearest_to_rays, unit_vector
from trackwright.trackers.core.filters.filter import AbstractStart
from trackwright.trackers.core.model.algebra import Scalar, product, total
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import HEIGHT, Input
from trackwright.trackers.core.model.motion import ConstantVelocity, Noise
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.start_nearby import at_rest


class PhaseStart(AbstractStart):
    """A start at the point nearest to the delay-and-sum beams of one row, at rest.

    A start takes `stations` stations with three phases or more. `sigma_position` m, `sigma_velocity` m/s: standard
    deviations.
    """

    searches: ClassVar[bool] = True

    centre: Any
    sigma_position: Noise
    sigma_velocity: Noise
    grids: Mapping[str, Grid]
    planar: bool = eqx.field(static=True)
    stations: int = eqx.field(static=True)

    @property
    def inputs(self) -> tuple[Input, ...]:
        return (HEIGHT,)

    @property
    def readings(self) -> Mapping[str, int]:
        """The phases of its stations."""
        return dict.fromkeys(self.grids, 3)

    def can_start(self, row: Row) -> Scalar:
        return total(jnp.where(jnp.sum(row.readings[name].seen) >= 3, 1, 0) for name in self.grids) >= self.stations

    def candidate(self, sensors: Mapping[str, Any], row: Row) -> Any:
        rays = []
        for name, grid in self.grids.items():
            sensor, reading = sensors[name], row.readings[name]
            beam = unit_vector(*direction(grid, reading.values - sensor.offsets.value, reading.seen))
            rays.append((sensor.origin, product(sensor.array_from_world.T, beam), jnp.sum(reading.seen) >= 3))
        return nearest_to_rays(rays, jnp.asarray(self.centre), row.inputs["height"] if self.planar else None)

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        n = 2 if self.planar else 3
        return at_rest([candidate[k] for k in range(n)], n, self.sigma_position, self.sigma_velocity)


def direct_tracker(
    stations: Mapping[str, Station],
    sigma_a: float = 0.2,
    sigma_p: float = 0.2,
    span: float = np.deg2rad(45.0),
    planar: bool = False,
) -> Tracker:
    """Position and velocity from the phases of all stations; `sigma_a` m/s² per √Hz, `sigma_p` rad.

    `span`: half-width of the start's grid, rad. `planar`: at a known height.
    """
    require_arrays("direct_tracker", stations)
    sensors = {name: SphericalPhases(s, sigma_p) for name, s in stations.items()}
    start = PhaseStart(
        region_centre(stations),
        Scale(0.2, "m"),
        Scale(0.5, "m/s"),
        {name: Grid.of(s, span) for name, s in stations.items()},
        planar,
        min(2, len(stations)),
    )
    return Tracker(ConstantVelocity(sigma_a, 2 if planar else 3), sensors, start, track_loss=TrackLossPolicy())
