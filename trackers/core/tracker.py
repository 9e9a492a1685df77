"""Trackers: what turns recordings into estimates, and the recursive tracker of a motion, sensors, a filter and a start.

`Tracker.step` is written for one trajectory and one time step; `scan` maps it over trajectories and scans it over time.
A batch runs in chunks of one fixed size, so that the numbers of a trajectory do not depend on the others in its batch.
"""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import compute_once, total
from trackers.core.chunks import CHUNK, as_dtype, chunks, run_chunks
from trackers.core.ekf import ExtendedKalman
from trackers.core.estimates import Estimates, Status
from trackers.core.filter import AbstractFilter
from trackers.core.layout import Layout
from trackers.core.motion import AbstractMotion
from trackers.core.recording import Batch, Recording, Row, stack
from trackers.core.requirements import Parts, check_input, check_parts
from trackers.core.scan import Carry, Output, Score, StepInfo, scan_rows
from trackers.core.select import select, where_mostly
from trackers.core.sensor import AbstractSensor
from trackers.core.start import AbstractStart
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tunable import freeze


class AbstractTracker(eqx.Module):
    """Anything that turns recordings into estimates."""

    @abstractmethod
    def scan(self, batch: Batch) -> Output:
        """The outputs of all time steps of one chunk, batch-last: (T, B), mean fields (T, …, B).

        Pure and traceable, so that it can be jitted and differentiated with respect to the tracker's tunables. Raises
        KeyError while it is traced, for a sensor or an input that the batch lacks.
        """

    @abstractmethod
    def accumulate(self, batch: Batch, score: Score) -> tuple[Any, ...]:
        """The sums over time of `score` of each step's output, (B,) each; memory does not grow with the rows."""

    @abstractmethod
    def check_layout(self, layout: Layout) -> None:
        """Raises UnusableInput unless recordings of this layout have what the tracker reads."""

    def run(self, recordings: Recording | Sequence[Recording] | Batch, chunk: int = CHUNK) -> Estimates:
        """The estimates for one recording, several, or a batch of them, in chunks of `chunk` trajectories.

        Raises UnusableInput, a ValueError, before anything is traced: for no recording at all, for one that lacks what
        the tracker reads, and where the recordings differ in their sensors, inputs or truth.
        """
        recordings = check_input(self, recordings, "run")
        if isinstance(recordings, Recording):
            one = self._run(stack([recordings]), 1)[0]
            return dataclasses.replace(one, times=recordings.times, names=(recordings.name,))
        if isinstance(recordings, Batch):
            return self._run(recordings, chunk)
        batch = stack(recordings)
        times = np.full((len(recordings), len(batch.dt)), np.nan)
        for row, recording in zip(times, recordings, strict=True):
            row[: len(recording)] = recording.times
        return dataclasses.replace(self._run(batch, chunk), times=times, names=tuple(r.name for r in recordings))

    def _run(self, batch: Batch, chunk: int) -> Estimates:
        model = as_dtype(self, batch.dt.dtype)
        parts = run_chunks(scan_chunk, [(model, part) for part in chunks(batch, chunk)])

        def join(*arrays: np.ndarray) -> np.ndarray:
            return np.moveaxis(np.concatenate(arrays, axis=-1)[..., : batch.size], -1, 0)

        joined = jax.tree_util.tree_map(join, *parts)
        return Estimates(joined.mean, np.stack(joined.cov), *joined[2:])

    def at_valid_time(self, times: np.ndarray, estimates: Estimates) -> tuple[np.ndarray, Estimates]:
        """The times (T,), s, for which the estimates of rows at `times` are valid, and the estimates at these times.

        `times` themselves, unless the tracker models a latency of its measurements.
        """
        return times, estimates


class AbstractEpochwiseTracker(AbstractTracker):
    """A tracker whose `accumulate` scores the output of `scan`, held in memory for all rows."""

    def accumulate(self, batch: Batch, score: Score) -> tuple[Any, ...]:
        truth = jax.tree_util.tree_map(jnp.asarray, batch.truth)
        return tuple(jnp.sum(x, axis=0) for x in jax.vmap(score)(self.scan(batch), truth))


def scan_chunk(tracker: AbstractTracker, batch: Batch) -> Output:
    """`tracker.scan(batch)`, a function of both for `run_chunks`."""
    return tracker.scan(batch)


class Tracker(AbstractTracker):
    """A recursive Bayesian tracker: predict, update with each sensor in turn, detect track loss, start again.

    `sensors`: by the names of their readings in a recording.
    """

    motion: AbstractMotion
    sensors: Mapping[str, AbstractSensor]
    start: AbstractStart
    filter: AbstractFilter[Any] = ExtendedKalman()
    track_loss: TrackLossPolicy = TrackLossPolicy()

    def check_layout(self, layout: Layout) -> None:
        check_parts(layout, Parts(self.motion, self.sensors, self.start, self.filter))

    def scan(self, batch: Batch) -> Output:
        output = scan_rows(freeze(self), batch)[1]
        assert output is not None
        return output

    def accumulate(self, batch: Batch, score: Score) -> tuple[Any, ...]:
        return scan_rows(freeze(self), batch, score)[0]

    def step(self, carry: Carry, row: Row) -> tuple[Carry, StepInfo]:
        """One time step of one trajectory: predict, update, track status; `scan.reinitialise` then starts tracks."""
        belief = self.filter.predict(carry.belief, self.motion, row.inputs, row.dt)
        innovations = []
        for name, sensor in self.sensors.items():
            belief, innovation = self.filter.update(belief, self.motion, sensor, row.readings[name], row.inputs)
            innovations.append(innovation)
        log_likelihood, nis, nis_dof, wrapped = (total(x) for x in zip(*innovations, strict=True))
        if self.filter.has_particle_axis:
            # A non-finite belief gives a non-finite likelihood; summing the whole belief would be a pass over memory.
            log_likelihood, nis = compute_once((log_likelihood, nis))
            finite = jnp.isfinite(log_likelihood)
        else:
            belief, log_likelihood, nis = compute_once((belief, log_likelihood, nis))
            numbers = jax.tree_util.tree_leaves(eqx.filter(belief, eqx.is_inexact_array))
            finite = jnp.isfinite(compute_once(total(x if x.ndim == 0 else jnp.sum(x) for x in numbers)))
        has_measurement = nis_dof > 0
        correction = (nis / jnp.maximum(nis_dof, 1.0) - carry.nis_average) / self.track_loss.nis_window.value
        nis_average = carry.nis_average + jnp.where(has_measurement, correction, 0.0)
        time_since_measurement = carry.time_since_measurement + row.dt
        lost = (nis_average > self.track_loss.nis_limit.value) | (
            time_since_measurement > self.track_loss.max_gap.value
        )
        time_since_measurement = jnp.where(has_measurement, 0.0, time_since_measurement)
        status = jnp.where(finite, jnp.where(lost, Status.LOST, Status.OK), Status.NON_FINITE)
        status = jnp.where(carry.running, status, jnp.where(carry.started, Status.LOST, Status.WAITING))
        updated = Carry(belief, carry.running & finite & ~lost, carry.started, nis_average, time_since_measurement)
        keep = row.valid & carry.running & finite
        kept = (where_mostly if self.filter.has_particle_axis else select)(keep, belief, carry.belief)
        after = Carry(kept, *select(row.valid, updated[1:], carry[1:]))
        zero = jnp.zeros_like(nis)
        log_likelihood, nis, nis_dof, wrapped = select(keep, (log_likelihood, nis, nis_dof, wrapped), (zero,) * 4)
        status = jnp.where(row.valid, status, Status.PADDING).astype(jnp.int8)
        return after, StepInfo(log_likelihood, nis, nis_dof, wrapped, status)
