"""Delay-and-sum on each row separately, the baseline of the beam tracker (Will et al. 2020, section 4.1)."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from trackwright.trackers.aoa.beam import PHASES, Beam, InPlaneBeam
from trackwright.trackers.aoa.beamformer import Grid, direction
from trackwright.trackers.aoa.phases import require_array
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.algebra import triangle
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.sensor import Channel
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker


class DelayAndSum(AbstractEpochwiseTracker):
    """The maximum of the delay-and-sum spectrum of each row with three antennas or more; the covariance is NaN."""

    grid: Grid
    name: str = eqx.field(static=True)

    @classmethod
    def of(cls, station: Station, name: str = PHASES, in_plane: bool = False) -> DelayAndSum:
        """The beamformer of a station, whose readings a recording holds under `name`, on the paper's grid.

        Raises UnusableInput for anything but a station with an array.
        """
        require_array("DelayAndSum.of", station)
        return cls(Grid.in_plane(station) if in_plane else Grid.of(station), name)

    def check_layout(self, layout: Layout) -> None:
        antennas = range(1, len(self.grid.cosine) + 1)
        layout.check_readings("DelayAndSum", self.name, [Channel(f"phase_{k}", "rad", True) for k in antennas])

    def scan(self, batch: Batch, initial: Any = None) -> tuple[Output, Any]:
        reading = batch.readings[self.name]

        def one(values: Any, seen: Any) -> Any:
            return direction(self.grid, values, seen)

        # One row at a time: the spectra of a whole chunk would take gigabytes.
        row = jax.vmap(one, in_axes=-1, out_axes=-1)
        angles = jax.lax.map(lambda r: row(*r), (jnp.asarray(reading.values), jnp.asarray(reading.seen)))
        zero = jnp.zeros_like(angles[:, 0])
        in_plane = angles.shape[1] == 1
        mean = InPlaneBeam(Heading(angles[:, 0]), zero) if in_plane else Beam(angles[:, 0], angles[:, 1], zero, zero)
        cov = tuple(zero + jnp.nan for _ in triangle(2 if in_plane else 4))
        enough = jnp.sum(reading.seen, axis=1) >= 3
        status = jnp.where(enough, Status.OK, Status.WAITING)
        status = jnp.where(jnp.asarray(batch.valid), status, Status.PADDING).astype(jnp.int8)
        return Output(mean, cov, zero, zero, zero, zero, status), ()
