"""Trackers turn recordings into estimates; the recursive one is made of a motion, sensors, a filter and a start.

`Tracker.predict`, `update` and `advance` are written for one trajectory and one time step; `scan` maps them over
trajectories and scans them over time. A batch runs in chunks: in chunks of one size the estimates of a trajectory are
bit-identical whatever the others are; chunks of other sizes are other programs, which agree to rounding.
"""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from itertools import takewhile
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import DTypeLike, Float

from trackwright.trackers.core.data.estimates import Estimates, Status
from trackwright.trackers.core.data.recording import Batch, Recording, stack
from trackwright.trackers.core.errors import UnusableInput, moment
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.filters.filter import AbstractFilter, AbstractStart, Innovation
from trackwright.trackers.core.model.algebra import Scalar, compute_once, select, total, where_mostly
from trackwright.trackers.core.model.covariance import AnyCovariance, Gaussian, leading
from trackwright.trackers.core.model.inputs import RawKey
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractDelayedSensor, AbstractSensor, Row
from trackwright.trackers.core.model.state import component_names
from trackwright.trackers.core.model.tunable import freeze, with_values
from trackwright.trackers.core.run.chunks import CHUNK, as_dtype, batch_estimates
from trackwright.trackers.core.run.latency import scored_truth, shifted_back
from trackwright.trackers.core.run.requirements import Layout, check_input, check_parts
from trackwright.trackers.core.run.scan import Carry, Output, ScanState, Score, StepInfo, carry_of, scan_rows
from trackwright.trackers.core.run.track_loss import ROOM, AbstractTrackLoss, TrackLossPolicy, outside


class TrackerState(NamedTuple):
    """The state of a tracker after the last row of each recording, from which a later run continues.

    `state`: as `tracker.scan` returns it, trajectories first in every array. `times` (B,): of the last rows, s.
    """

    state: Any
    times: Float[np.ndarray, " B"]


def continued(batch: Batch, recordings: Sequence[Recording], initial: TrackerState) -> Batch:
    """The batch with the time from the last row of each earlier recording to its first row."""
    if len(initial.times) != len(recordings):
        raise UnusableInput(
            f"run: `initial` is the state after {len(initial.times)} recordings, found {len(recordings)}; expected the "
            "recordings that continue them, in their order"
        )
    gaps = np.array([r.times[0] for r in recordings]) - initial.times
    if (gaps < 0).any():
        k = int(np.argmax(gaps < 0))
        raise UnusableInput(
            f"run: '{recordings[k].name}' begins at {moment(recordings[k].times[0])}, its `initial` state is that at "
            f"{moment(initial.times[k])}; expected later rows; leave out the rows that were run before"
        )
    dt = np.array(batch.dt)
    dt[0] = gaps
    return batch._replace(dt=dt)


def stacked_priors(prior: Gaussian | Sequence[Gaussian], count: int, dtype: DTypeLike) -> Gaussian:
    """One prior for each of `count` trajectories, (B,) first in every array."""
    each = [prior] * count if isinstance(prior, Gaussian) else list(prior)
    if len(each) != count or (others := [type(g).__name__ for g in each if not isinstance(g, Gaussian)]):
        found = f"{len(each)} beliefs for {count} recordings" if len(each) != count else f"{others[0]} as a belief"
        fix = "expected one Gaussian for all, one for each, or the `final` of one earlier run of all"
        raise UnusableInput(f"run: `initial` holds {found}; {fix}")
    stacked: Gaussian = jax.tree_util.tree_map(lambda *x: jnp.stack([jnp.asarray(v, dtype) for v in x]), *each)
    return stacked


class AbstractTracker(eqx.Module):
    """Anything that turns recordings into estimates."""

    @abstractmethod
    def scan(self, batch: Batch, initial: Any = None) -> tuple[Output, Any]:
        """The outputs of all time steps of one chunk, batch-last, (T, B), mean fields (T, …, B), and the state after.

        `initial`: the state before the first row, as `scan` and `begin` return it. Pure and traceable, to be jitted
        and differentiated with respect to the tracker's tunables.
        """

    @abstractmethod
    def accumulate(self, batch: Batch, score: Score, every_row: bool = False) -> tuple[Any, ...]:
        """The sums over time of `score` of each step's output, (B,) each; memory does not grow with the rows.

        With `every_row` the scores of each step instead, (T, B) each.
        """

    @abstractmethod
    def check_layout(self, layout: Layout) -> None:
        """Raises UnusableInput unless recordings of this layout have what the tracker reads."""

    def with_values(self, values: Mapping[str, Any], source: object = "values") -> Self:
        """This tracker with other values by tunable name or pattern; raises UnusableInput where they do not fit.

        Values may be traced: `jax.grad` and `jax.vmap` over noise levels go through `filter_batch`.
        """
        return with_values(self, values, source)

    def for_positions(self) -> Self:
        """This tracker with estimates that have the covariances of positions alone, where it computes others."""
        return self

    @property
    def nis_sensors(self) -> tuple[AbstractSensor, ...]:
        """The sensors whose innovations make up the NIS of the estimates; none for a tracker without NIS."""
        return ()

    def begin(self, prior: Gaussian, batch: Batch) -> Any:
        """The scan state of tracks that start at the first row with the belief `prior`; trajectories are first.

        Raises UnusableInput for a tracker without a belief to begin with.
        """
        raise UnusableInput(
            f"run: found a Gaussian as `initial` of a {type(self).__name__}, whose estimates depend on no belief; "
            "expected the `final` of an earlier run; leave `initial` out"
        )

    def run(
        self,
        recordings: Recording | Sequence[Recording] | Batch,
        chunk: int = CHUNK,
        *,
        seed: int = 0,
        initial: Gaussian | Sequence[Gaussian] | TrackerState | None = None,
    ) -> Estimates:
        """The estimates for one recording, several, or a batch, in chunks of `chunk` trajectories.

        `seed`: for filters that draw random numbers; a batch has its keys from `stack`. `initial`: the belief at the
        first row, one for all recordings or one for each, or the `final` of the estimates that these recordings
        continue; by default the first row that suffices starts a track. Raises UnusableInput, a ValueError, before
        anything is traced: for no recording, for one that lacks what the tracker reads, and where recordings differ in
        their sensors, inputs or truth; TypeError where the tracker or a batch is traced.
        """
        if any(isinstance(x, jax.core.Tracer) for x in jax.tree_util.tree_leaves((self, recordings))):
            raise TypeError(
                "run: found traced values, as inside jax.grad, jax.vmap or jax.jit; expected numbers, since run works "
                "in NumPy; use trackwright.filter_batch(tracker, batch), a pure function"
            )
        recordings = check_input(self, recordings, "run")
        if isinstance(recordings, Batch):
            if seed or initial is not None:
                raise UnusableInput(
                    "run: found a Batch with a seed or an initial belief; expected recordings for these; give the seed "
                    "to `stack`, the initial state to `tracker.scan`"
                )
            return batch_estimates(self, recordings, chunk)
        single = isinstance(recordings, Recording)
        listed = [recordings] if isinstance(recordings, Recording) else recordings
        longest = max(len(r) for r in listed)
        # XLA unrolls a loop of one row, with other last bits.
        batch = stack(listed, rows=max(longest, 2), seed=seed)
        state = None
        if isinstance(initial, TrackerState):
            batch, state = continued(batch, listed, initial), initial.state
        elif initial is not None:
            state = self.begin(stacked_priors(initial, len(listed), batch.dt.dtype), batch)
        estimates = batch_estimates(self, batch, 1 if single else chunk, state, continues=True)
        times = np.full((len(listed), longest), np.nan)
        for row, recording in zip(times, listed, strict=True):
            row[: len(recording)] = recording.times
        final = TrackerState(estimates.final, np.array([r.times[-1] for r in listed]))
        estimates = estimates if longest == len(batch.dt) else estimates.rows(slice(0, longest))
        names = tuple(r.name for r in listed)
        estimates = dataclasses.replace(estimates, times=estimates.valid_times(times), names=names, final=final)
        return estimates[0] if single else estimates


class AbstractEpochwiseTracker(AbstractTracker):
    """A tracker whose `accumulate` scores the output of `scan`, held in memory for all rows."""

    def accumulate(self, batch: Batch, score: Score, every_row: bool = False) -> tuple[Any, ...]:
        output = self.scan(batch)[0]
        scores = jax.vmap(score)(output, scored_truth(batch, output.age))
        return scores if every_row else tuple(jnp.sum(x, axis=0) for x in scores)


def filter_batch(tracker: AbstractTracker | Any, batch: Batch | Any) -> Output:
    """The estimates of a tracker for a batch, a pure function of both for jax.grad, jax.vmap and jax.jit.

    Arrays are batch-last: fields of the mean (T, …, B), entries of the covariance's upper triangle (T, B). Every number
    of the tracker and of the batch may be traced; the truth is unused. `tracker.scan` also returns the state after the
    last row. A tracker by name takes its recordings' folders in place of the batch; raises UnusableInput where these
    need several trackers.
    """
    if hasattr(tracker, "only_batch"):
        group = tracker.only_batch(batch)
        tracker, batch = group.tracker, stack([trajectory.recording for trajectory in group.trajectories])
    return as_dtype(tracker, jnp.asarray(batch.dt).dtype).scan(batch)[0]


class Tracker(AbstractTracker):
    """A recursive Bayesian tracker: predict, update with each sensor in turn, detect track loss, start again.

    `sensors`: by the names of their readings in a recording. `latency_of`: the sensor at whose time of measurement
    estimates are valid, an `AbstractDelayedSensor`; by default they are valid at the time of their row.
    `position_alone`: estimates have the covariance of the position alone where the state begins with it, with
    and of an attitude where it comes next.
    `lasting_errors`: whether errors of readings outlast the model, as constant ones of sensors without a calibration,
    so that earlier and later readings share them; `Smoothed` then reports a bound.
    """

    motion: AbstractMotion
    sensors: Mapping[str, AbstractSensor]
    start: AbstractStart
    filter: AbstractFilter[Any] = ExtendedKalman()
    track_loss: AbstractTrackLoss = TrackLossPolicy()
    latency_of: str | None = eqx.field(static=True, default=None)
    position_alone: bool = eqx.field(static=True, default=False)
    lasting_errors: bool = eqx.field(static=True, default=False)

    def check_layout(self, layout: Layout) -> None:
        check_parts(layout, self)

    def for_positions(self) -> Self:
        return dataclasses.replace(self, position_alone=True)

    @property
    def nis_sensors(self) -> tuple[AbstractSensor, ...]:
        return tuple(self.sensors.values())

    def scan(self, batch: Batch, initial: ScanState | None = None) -> tuple[Output, ScanState]:
        _, output, state = scan_rows(freeze(self), batch, initial)
        return self.with_age(output), state

    def accumulate(self, batch: Batch, score: Score, every_row: bool = False) -> tuple[Any, ...]:
        truth = scored_truth(batch, self.latency)
        return scan_rows(freeze(self), batch._replace(truth=truth), score=score, every_row=every_row)[0]

    def begin(self, prior: Gaussian, batch: Batch) -> ScanState:
        def one(prior: Gaussian, key: RawKey) -> Carry:
            return carry_of(freeze(self), prior, key, np.uint32(0))

        carry = jax.vmap(one, in_axes=(0, 1))(prior, jnp.asarray(batch.key))
        return ScanState(carry, jnp.zeros(batch.size, jnp.uint32))

    @property
    def _delayed(self) -> AbstractDelayedSensor | None:
        """The sensor at whose time of measurement estimates are valid."""
        if self.latency_of is None:
            return None
        sensor = self.sensors[self.latency_of]
        assert isinstance(sensor, AbstractDelayedSensor)
        return sensor

    @property
    def latency(self) -> Scalar | None:
        """The time from the measurement for which an estimate is valid to its row, s; None for no latency."""
        return None if self._delayed is None else self._delayed.latency.value

    def moments(self, belief: Any) -> tuple[Any, AnyCovariance]:
        """The mean and covariance of an estimate, at the time for which it is valid."""
        mean, cov = self.filter.moments(belief)
        if self._delayed is not None:
            mean, cov = shifted_back(mean, cov, self._delayed.latency.value, self._delayed.latency_std.value)
        if not self.position_alone:
            return mean, cov
        fields = [name.partition(".")[0] for name in component_names(mean)]
        pose = list(takewhile(lambda field: field in ("position", "attitude"), fields))
        return mean, leading(cov, len(fields), len(pose)) if fields[0] == "position" else cov

    def with_age(self, output: Output) -> Output:
        """The output with its `age`."""
        latency = self.latency
        return output if latency is None else output._replace(age=jnp.broadcast_to(latency, output.nis.shape))

    def predict(self, belief: Any, row: Row) -> Any:
        """The belief of one trajectory at the time of a row."""
        return self.filter.predict(belief, self.motion, row.inputs, row.dt)

    def update(self, belief: Any, row: Row, names: Collection[str] | None = None) -> tuple[Any, Innovation]:
        """The belief of one trajectory after the readings of a row, and their `Innovation`.

        `names`: of the sensors, by default all.
        """
        innovations = []
        for name in self.sensors if names is None else names:
            sensor = self.sensors[name]
            belief, innovation = self.filter.update(belief, self.motion, sensor, row.readings[name], row.inputs)
            innovations.append(innovation)
        return belief, Innovation(*(total(x) for x in zip(*innovations, strict=True)))

    def advance(self, carry: Carry, row: Row, belief: Any, innovation: Innovation) -> tuple[Carry, StepInfo]:
        """The carry of one trajectory after a row, from its updated belief: track status and diagnostics.

        `scan.reinitialise` then starts tracks.
        """
        log_likelihood, nis, nis_dof, wrapped = innovation
        if self.filter.has_particle_axis:
            # A non-finite belief gives a non-finite likelihood; summing the whole belief would be a pass over memory.
            log_likelihood, nis = compute_once((log_likelihood, nis))
            finite = jnp.isfinite(log_likelihood)
        else:
            belief, log_likelihood, nis = compute_once((belief, log_likelihood, nis))
            numbers = jax.tree_util.tree_leaves(eqx.filter(belief, eqx.is_inexact_array))
            finite = jnp.isfinite(compute_once(total(x if x.ndim == 0 else jnp.sum(x) for x in numbers)))
        has_measurement = nis_dof > 0
        innovation = Innovation(log_likelihood, nis, nis_dof, wrapped)
        statistic = self.track_loss.after(carry.loss_statistic, innovation, row, self, carry.belief)
        time_since_measurement = carry.time_since_measurement + row.dt
        lost = self.track_loss.exceeded(statistic) | (time_since_measurement > self.track_loss.max_gap.value)
        if ROOM in self.track_loss.inputs and ROOM.name in row.inputs and not self.filter.has_particle_axis:
            lost |= outside(*self.filter.moments(belief), row.inputs[ROOM.name])
        time_since_measurement = jnp.where(has_measurement, 0.0, time_since_measurement)
        status = jnp.where(finite, jnp.where(lost, Status.LOST, Status.OK), Status.NON_FINITE)
        status = jnp.where(carry.running, status, jnp.where(carry.started, Status.LOST, Status.WAITING))
        updated = Carry(belief, carry.running & finite & ~lost, carry.started, statistic, time_since_measurement)
        keep = row.valid & carry.running & finite
        kept = (where_mostly if self.filter.has_particle_axis else select)(keep, belief, carry.belief)
        after = Carry(kept, *select(row.valid, updated[1:], carry[1:]))
        zero = jnp.zeros_like(nis)
        log_likelihood, nis, nis_dof, wrapped = select(keep, (log_likelihood, nis, nis_dof, wrapped), (zero,) * 4)
        status = jnp.where(row.valid, status, Status.PADDING).astype(jnp.int8)
        return after, StepInfo(log_likelihood, nis, nis_dof, wrapped, status)
