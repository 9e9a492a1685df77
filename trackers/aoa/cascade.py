"""The paper's cascade: a beam tracker per station, then bearings-only fusion of their estimates and covariances."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.aoa.beam import beam_tracker
from trackwright.trackers.aoa.fusion import AXES, BEARINGS, ORIGIN, BearingSensor, bearing_inputs, region_centre
from trackwright.trackers.aoa.phases import require_arrays
from trackwright.trackers.aoa.rays import nearest_to_rays, unit_vector
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.algebra import product
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.linearise import covariance_of
from trackwright.trackers.core.model.motion import ConstantVelocity
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output, ScanState
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker, Tracker
from trackwright.trackers.parts.start_nearby import NEARBY, NearbyStart


class CascadeState(NamedTuple):
    """The states of the beam trackers by station, None before their first rows, and of the fusion."""

    beams: dict[str, ScanState] | None
    fusion: ScanState | None


class Cascade(AbstractEpochwiseTracker):
    """A beam tracker per station, `beams` by the stations' names in a recording, and the `fusion` of their angles.

    As in the paper, estimates of a beam tracker are fused as readings with independent errors;
    `fusion.sensors.bearings.reported_std_scale` scales their standard deviations where that makes them too small.
    `geometry`: origin and axes (12,) of each station; `centre` (3,) m: see `region_centre`.
    """

    beams: Mapping[str, Tracker]
    fusion: Tracker
    geometry: Mapping[str, Any]
    centre: Any

    def check_layout(self, layout: Layout) -> None:
        """Checks the readings of each station; `bearings` and their inputs are made of the beams' estimates."""
        for beam in self.beams.values():
            beam.check_layout(layout)
        made = {declared.name: declared.row_shape(2) for declared in (ORIGIN, AXES, NEARBY)}
        self.fusion.check_layout(layout._replace(readings={BEARINGS: (2, 3)}, inputs={**layout.inputs, **made}))

    @property
    def nis_sensors(self) -> tuple[AbstractSensor, ...]:
        return self.fusion.nis_sensors

    def scan(self, batch: Batch, initial: CascadeState | None = None) -> tuple[Output, CascadeState]:
        before = CascadeState(None, None) if initial is None else initial
        readings, states = [], {}
        for name, beam in self.beams.items():
            of_station = batch._replace(readings={name: batch.readings[name]})
            output, states[name] = beam.scan(of_station, None if before.beams is None else before.beams[name])
            readings.append(_bearing_reading(output))
        output, fusion = self.fusion.scan(self._bearings(batch, readings), before.fusion)
        return self._per_row(output), CascadeState(states, fusion)

    def begin(self, prior: Gaussian, batch: Batch) -> CascadeState:
        """The fusion begins with `prior`; each beam tracker starts by its measurements."""
        return CascadeState(None, self.fusion.begin(prior, batch))

    def _bearings(self, batch: Batch, readings: list[Reading]) -> Batch:
        """The batch for the fusion: one row per station and row, the stations' angles in order with dt = 0 between."""
        count = len(readings)

        def interleaved(parts: list[Any]) -> Any:
            stacked = jnp.stack(parts, axis=1)
            return stacked.reshape(-1, *stacked.shape[2:])

        def repeated(x: Any) -> Any:
            return jnp.repeat(jnp.asarray(x), count, axis=0)

        def geometry(part: slice) -> Any:
            trajectories = batch.dt.shape
            rows = [jnp.asarray(self.geometry[name][part])[None, :, None] for name in self.beams]
            return interleaved([jnp.broadcast_to(r, (trajectories[0], r.shape[1], trajectories[1])) for r in rows])

        first = jnp.arange(batch.dt.shape[0] * count)[:, None] % count == 0
        inputs = {name: repeated(x) for name, x in batch.inputs.items()}
        inputs |= {"origin": geometry(slice(0, 3)), "axes": geometry(slice(3, 12))}
        inputs["nearby"] = repeated(self._nearest_points(readings))
        return Batch(
            jnp.where(first, repeated(batch.dt), 0.0),
            repeated(batch.valid),
            {BEARINGS: jax.tree_util.tree_map(lambda *x: interleaved(list(x)), *readings)},
            inputs,
            jax.tree_util.tree_map(repeated, batch.truth),
            batch.key,
        )

    def _nearest_points(self, readings: list[Reading]) -> Any:
        """The point nearest to each row's beams, m, and 1 where there are two or more, (T, 4, B)."""

        def nearest(*parts: Reading) -> Any:
            rays = []
            for name, part in zip(self.beams, parts, strict=True):
                geometry = jnp.asarray(self.geometry[name])
                direction = product(geometry[3:].reshape(3, 3).T, unit_vector(*part.values))
                rays.append((geometry[:3], direction, part.seen[0]))
            count = sum(jnp.where(part.seen[0], 1, 0) for part in parts)
            point = nearest_to_rays(rays, jnp.asarray(self.centre))
            return jnp.append(point, jnp.where(count > 1, jnp.ones_like(point[0]), 0.0))

        return jax.vmap(jax.vmap(nearest, in_axes=-1, out_axes=-1))(*readings)

    def _per_row(self, output: Output) -> Output:
        """The fusion's output per row of the recording: the last belief, and the sums of the diagnostics."""
        stations = len(self.beams)

        def last(x: Any) -> Any:
            return x[stations - 1 :: stations]

        def per_row(x: Any) -> Any:
            return x.reshape(-1, stations, *x.shape[1:])

        restarted = jnp.any(per_row(output.status) == Status.RESTARTED, axis=1)
        status = jnp.where(restarted & (last(output.status) == Status.OK), Status.RESTARTED, last(output.status))
        log_likelihood, nis, nis_dof, wrapped = (jnp.sum(per_row(x), axis=1) for x in output[2:6])
        mean, cov = jax.tree_util.tree_map(last, (output.mean, output.cov))
        return Output(mean, cov, log_likelihood, nis, nis_dof, wrapped, status.astype(jnp.int8))


def _angular_covariance(mean: Any, cov: Any) -> Any:
    """The variance of the azimuth, the covariance of both angles and the variance of the elevation, (3,) rad²."""
    angular = covariance_of(mean, cov, lambda beam: (beam.azimuth, beam.elevation))
    return jnp.stack([angular[0, 0], angular[0, 1], angular[1, 1]])


def _bearing_reading(output: Output) -> Reading:
    """One station's beam estimates as readings with covariances, masked on rows without its phases."""
    mean, cov = output.mean, output.cov
    updated = (output.status == Status.RESTARTED) | ((output.status == Status.OK) & (output.nis_dof > 0))
    angles = jnp.stack([mean.azimuth, mean.elevation], axis=1)
    angular = jax.vmap(jax.vmap(_angular_covariance, in_axes=-1, out_axes=-1))(mean, cov)
    return Reading(angles, jnp.stack([updated, updated], axis=1), angular)


def cascade_tracker(
    stations: Mapping[str, Station],
    sigma_a_beam: float = 0.5,
    sigma_p: float = 0.2,
    sigma_a: float = 0.2,
    paper_form: bool = False,
    span: float = np.deg2rad(30.0),
) -> Cascade:
    """The cascade for these stations (Will et al. 2020, sections 3 and 4.2).

    `sigma_a_beam` rad/s², `sigma_a` of the fusion m/s² per √Hz; `sigma_p` and the `span` of the start rad.
    """
    require_arrays("cascade_tracker", stations)
    beams = {name: beam_tracker(s, name, sigma_a_beam, sigma_p, paper_form, span) for name, s in stations.items()}
    sensors = {BEARINGS: BearingSensor(np.deg2rad(0.3), np.deg2rad(0.3), dof=30.0)}
    start = NearbyStart(Scale(0.2, "m"), Scale(0.5, "m/s"), False, 3)
    fusion = Tracker(ConstantVelocity(sigma_a, 3), sensors, start)
    geometry = {name: bearing_inputs(s) for name, s in stations.items()}
    return Cascade(beams, fusion, geometry, region_centre(stations))
