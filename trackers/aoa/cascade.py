"""The paper's chain: a beam tracker per station, then bearings-only fusion with the covariances they report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackers.aoa.beam import beam_tracker
from trackers.aoa.fusion import BEARINGS, BearingSensor, bearing_inputs, surroundings
from trackers.aoa.rays import nearest_to_rays, unit_vector
from trackers.core.estimates import Status
from trackers.core.motion import ConstantVelocity
from trackers.core.recording import Batch
from trackers.core.rig import Station
from trackers.core.scan import Output, Score
from trackers.core.sensor import Reading
from trackers.core.tracker import AbstractTracker, Tracker
from trackers.core.tunable import Scale
from trackers.parts.start_nearby import NearbyStart


class Cascade(AbstractTracker):
    """A beam tracker per station, `beams` by the stations' names in a recording, and the `fusion` of their angles.

    The estimates of a beam tracker are fused as if they were readings with independent errors, as the paper does;
    `fusion.sensors.bearings.reported_std_scale` scales the reported standard deviations where they are too small for that.
    """

    beams: Mapping[str, Tracker]
    fusion: Tracker
    geometry: Mapping[str, Any]
    centre: Any

    def scan(self, batch: Batch) -> Output:
        return self._joined(self.fusion.scan(self._bearings(batch)))

    def accumulate(self, batch: Batch, score: Score) -> tuple[Any, ...]:
        return self.fusion.accumulate(self._bearings(batch), score)

    def _bearings(self, batch: Batch) -> Batch:
        """The recording that the fusion sees: the stations' angles of each row one after another, dt = 0 between."""
        readings = [self._reading(name, batch) for name in self.beams]
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
        inputs["nearby"] = repeated(self._meeting(readings))
        return Batch(
            jnp.where(first, repeated(batch.dt), 0.0),
            repeated(batch.valid),
            {BEARINGS: jax.tree_util.tree_map(lambda *x: interleaved(list(x)), *readings)},
            inputs,
            jax.tree_util.tree_map(repeated, batch.truth),
            batch.key,
        )

    def _meeting(self, readings: list[Reading]) -> Any:
        """Where each row's beams meet, (T, 4, B), and whether two or more were heard."""

        def one(*parts: Reading) -> Any:
            rays = []
            for name, part in zip(self.beams, parts, strict=True):
                geometry = jnp.asarray(self.geometry[name])
                direction = geometry[3:].reshape(3, 3).T @ unit_vector(*part.values)
                rays.append((geometry[:3], direction, part.seen[0]))
            count = sum(jnp.where(part.seen[0], 1, 0) for part in parts)
            point = nearest_to_rays(rays, jnp.asarray(self.centre))
            return jnp.append(point, jnp.where(count > 1, jnp.ones_like(point[0]), 0.0))

        return jax.vmap(jax.vmap(one, in_axes=-1, out_axes=-1))(*readings)

    def _reading(self, name: str, batch: Batch) -> Reading:
        """One station's beam estimates as readings with covariances, where the row had phases of that station."""
        output = self.beams[name].scan(batch._replace(readings={name: batch.readings[name]}))
        mean, cov = output.mean, output.cov
        heard = (output.status == Status.RESTARTED) | ((output.status == Status.OK) & (output.nis_dof > 0))
        angles = jnp.stack([mean.azimuth, mean.elevation], axis=1)
        return Reading(angles, jnp.stack([heard, heard], axis=1), jnp.stack([cov[0], cov[1], cov[4]], axis=1))

    def _joined(self, output: Output) -> Output:
        """The fusion's rows back to one per row of the recording: the last belief, the sums of what was said."""
        stations = len(self.beams)

        def last(x: Any) -> Any:
            return x[stations - 1 :: stations]

        def every(x: Any) -> Any:
            return x.reshape(-1, stations, *x.shape[1:])

        restarted = jnp.any(every(output.status) == Status.RESTARTED, axis=1)
        status = jnp.where(restarted & (last(output.status) == Status.OK), Status.RESTARTED, last(output.status))
        log_likelihood, nis, nis_dof, wrapped = (jnp.sum(every(x), axis=1) for x in output[2:6])
        mean, cov = jax.tree_util.tree_map(last, (output.mean, output.cov))
        return Output(mean, cov, log_likelihood, nis, nis_dof, wrapped, status.astype(jnp.int8))


def cascade_tracker(
    stations: Mapping[str, Station],
    sigma_a_beam: float = 0.5,
    sigma_p: float = 0.2,
    sigma_a: float = 0.2,
    paper_form: bool = False,
    span: float = np.deg2rad(30.0),
) -> Cascade:
    """The cascade for these stations (Will et al. 2020, sections 3 and 4.2).

    σa of the beams rad/s², of the fusion m/s² per √Hz; σp and the span of the start rad.
    """
    beams = {name: beam_tracker(s, name, sigma_a_beam, sigma_p, paper_form, span) for name, s in stations.items()}
    sensors = {BEARINGS: BearingSensor(np.deg2rad(0.3), np.deg2rad(0.3), dof=30.0)}
    start = NearbyStart(Scale(0.2, "m"), Scale(0.5, "m/s"), False, 3)
    fusion = Tracker(ConstantVelocity(sigma_a, 3), sensors, start)
    geometry = {name: bearing_inputs(s) for name, s in stations.items()}
    return Cascade(beams, fusion, geometry, surroundings(stations))
