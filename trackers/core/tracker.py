"""Trackers: a motion, sensors, a filter, a start and a loss policy, run over batches by the one scan.

The parts are written for one trajectory and one row. Here they are mapped over a chunk of trajectories and scanned
over rows; chunks have a fixed size, so a trajectory's numbers never depend on what it is batched with.
"""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, compute_once, mark_dependent, total
from trackers.core.chunks import CHUNK, as_dtype, chunks, run_chunks
from trackers.core.ekf import ExtendedKalman, Gaussian
from trackers.core.estimates import Estimates, Status
from trackers.core.motion import AbstractMotion
from trackers.core.recording import Batch, Recording, stack
from trackers.core.select import select, where_mostly
from trackers.core.sensor import AbstractSensor, Reading
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tunable import freeze

ACQUIRED_AT_ONCE = 16
"""Trajectories whose start is searched for together; a search costs as much as hundreds of filter steps."""


class Row(NamedTuple):
    """One row of one trajectory; `key` (2,) is the trajectory's own, for filters that draw, `number` the row's."""

    dt: Scalar
    valid: Scalar
    readings: dict[str, Reading]
    inputs: dict[str, Any]
    key: Any
    number: Any


class AbstractStart(eqx.Module):
    """How a tracker finds its first belief from a single row; after a track loss the same code finds it again.

    `smooth`: what `candidate` finds has derivatives by the sensors' numbers, as a weighted mean has and a best one not.
    """

    smooth: ClassVar[bool] = False

    @abstractmethod
    def ready(self, row: Row) -> Scalar:
        """Whether this row holds enough to start from."""

    @abstractmethod
    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        """The expensive part, run only for trajectories that need it; differentiated only where it is `smooth`."""

    @abstractmethod
    def begin(self, found: Any, row: Row) -> Gaussian:
        """The normal belief at this row, from what `candidate` found; the filter makes its own kind of belief of it."""


class StepInfo(NamedTuple):
    """What one row's readings said, and what it is: the rest of an output, beside mean and covariance."""

    log_likelihood: Scalar
    nis: Scalar
    nis_dof: Scalar
    wrapped: Scalar
    status: Scalar


class Carry(NamedTuple):
    """What one row hands to the next."""

    belief: Any
    running: Scalar
    begun: Scalar
    nis_average: Scalar
    time_since_measurement: Scalar


class Output(NamedTuple):
    """What one row returns: the state's mean and the upper triangle of its covariance, and what its readings said."""

    mean: Any
    cov: tuple[Scalar, ...]
    log_likelihood: Scalar
    nis: Scalar
    nis_dof: Scalar
    wrapped: Scalar
    status: Scalar


Score = Callable[[Output, dict[str, tuple[Any, Any]]], tuple[Any, ...]]
"""Numbers per trajectory, (B,) each, of one row: from its output and its truth."""


class AbstractTracker(eqx.Module):
    """Anything that turns recordings into estimates."""

    @abstractmethod
    def scan(self, batch: Batch) -> Output:
        """All rows of one chunk of trajectories, batch-last; differentiable in the tracker's numbers."""

    @abstractmethod
    def accumulate(self, batch: Batch, score: Score) -> tuple[Any, ...]:
        """Sums over rows of what `score` makes of each row's output, per trajectory; memory flat in the rows."""

    def run(self, recordings: Recording | Sequence[Recording] | Batch, chunk: int = CHUNK) -> Estimates:
        """The estimates for one recording, several, or a batch of them, in chunks of `chunk` trajectories.

        Raises ValueError for no recording at all, and where the recordings differ in their sensors, inputs or truth.
        """
        if isinstance(recordings, Recording):
            one = self._run(stack([recordings]), 1)[0]
            return dataclasses.replace(one, times=recordings.times, names=(recordings.name,))
        if isinstance(recordings, Batch):
            return self._run(recordings, chunk)
        listed = list(recordings)
        if not listed or not all(isinstance(r, Recording) for r in listed):
            found = ", ".join(sorted({type(r).__name__ for r in listed})) or "nothing"
            raise ValueError(f"run: found {found}; expected a Recording, several, or a Batch")
        batch = stack(listed)
        times = np.full((len(listed), len(batch.dt)), np.nan)
        for row, recording in zip(times, listed, strict=True):
            row[: len(recording)] = recording.times
        return dataclasses.replace(self._run(batch, chunk), times=times, names=tuple(r.name for r in listed))

    def _run(self, batch: Batch, chunk: int) -> Estimates:
        model = as_dtype(self, batch.dt.dtype)
        parts = run_chunks(scanned, [(model, part) for part in chunks(batch, chunk)])

        def join(*arrays: np.ndarray) -> np.ndarray:
            return np.moveaxis(np.concatenate(arrays, axis=-1)[..., : batch.size], -1, 0)

        joined = jax.tree_util.tree_map(join, *parts)
        return Estimates(joined.mean, np.stack(joined.cov), *joined[2:])

    def at_valid_time(self, times: np.ndarray, estimates: Estimates) -> tuple[np.ndarray, Estimates]:
        """The times (T,), s, at which the estimates of rows at `times` are best known, and the estimates then.

        The rows' own, unless a tracker knows that its readings come late.
        """
        return times, estimates


class AbstractEpochwiseTracker(AbstractTracker):
    """A tracker whose `accumulate` scores the output of `scan`, which therefore stands in memory for all rows."""

    def accumulate(self, batch: Batch, score: Score) -> tuple[Any, ...]:
        truth = jax.tree_util.tree_map(jnp.asarray, batch.truth)
        return tuple(jnp.sum(x, axis=0) for x in jax.vmap(score)(self.scan(batch), truth))


def scanned(tracker: AbstractTracker, batch: Batch) -> Output:
    """`tracker.scan(batch)`, as a function of both."""
    return tracker.scan(batch)


class Tracker(AbstractTracker):
    """A recursive tracker; `sensors` by the names under which a recording holds their readings."""

    motion: AbstractMotion
    sensors: Mapping[str, AbstractSensor]
    start: AbstractStart
    filter: Any = ExtendedKalman()
    track_loss: TrackLossPolicy = TrackLossPolicy()

    def scan(self, batch: Batch) -> Output:
        output = scan_rows(freeze(self), batch)[1]
        assert output is not None
        return output

    def accumulate(self, batch: Batch, score: Score) -> tuple[Any, ...]:
        return scan_rows(freeze(self), batch, score)[0]

    def step(self, carry: Carry, row: Row) -> tuple[Carry, StepInfo]:
        """One row of one trajectory, short of starting: predict, update with every sensor, judge."""
        belief = self.filter.predict(carry.belief, self.motion, row.inputs, row.dt)
        said = []
        for name, sensor in self.sensors.items():
            belief, innovation = self.filter.update(belief, self.motion, sensor, row.readings[name], row.inputs)
            said.append(innovation)
        log_likelihood, nis, nis_dof, wrapped = (total(x) for x in zip(*said, strict=True))
        if has_particle_axis(self):
            # A belief that isn't finite says so by its likelihood; a sum over all its numbers is a pass over memory.
            log_likelihood, nis = compute_once((log_likelihood, nis))
            finite = jnp.isfinite(log_likelihood)
        else:
            belief, log_likelihood, nis = compute_once((belief, log_likelihood, nis))
            numbers = jax.tree_util.tree_leaves(eqx.filter(belief, eqx.is_inexact_array))
            finite = jnp.isfinite(compute_once(total(x if x.ndim == 0 else jnp.sum(x) for x in numbers)))
        heard = nis_dof > 0
        nis_average = carry.nis_average + jnp.where(
            heard, (nis / jnp.maximum(nis_dof, 1.0) - carry.nis_average) / self.track_loss.nis_window.value, 0.0
        )
        time_since_measurement = carry.time_since_measurement + row.dt
        lost = (nis_average > self.track_loss.nis_limit.value) | (
            time_since_measurement > self.track_loss.max_gap.value
        )
        time_since_measurement = jnp.where(heard, 0.0, time_since_measurement)
        status = jnp.where(finite, jnp.where(lost, Status.LOST, Status.OK), Status.NON_FINITE)
        status = jnp.where(carry.running, status, jnp.where(carry.begun, Status.LOST, Status.WAITING))
        moved = Carry(belief, carry.running & finite & ~lost, carry.begun, nis_average, time_since_measurement)
        keep = row.valid & carry.running & finite
        chosen = (where_mostly if has_particle_axis(self) else select)(keep, belief, carry.belief)
        after = Carry(chosen, *select(row.valid, moved[1:], carry[1:]))
        zero = jnp.zeros_like(nis)
        log_likelihood, nis, nis_dof, wrapped = select(keep, (log_likelihood, nis, nis_dof, wrapped), (zero,) * 4)
        status = jnp.where(row.valid, status, Status.PADDING).astype(jnp.int8)
        return after, StepInfo(log_likelihood, nis, nis_dof, wrapped, status)


def scan_rows(tracker: Tracker, batch: Batch, score: Score | None = None) -> tuple[tuple[Any, ...], Output | None]:
    """All rows of one chunk of trajectories, batch-last: the sums of a score, or else the outputs of every row."""
    size, trajectories_key = batch.size, jnp.asarray(batch.key)
    rows = Row(batch.dt, batch.valid, batch.readings, batch.inputs, None, jnp.arange(len(batch.dt), dtype=jnp.uint32))
    axes = carry_axes(tracker)
    trajectories = jax.vmap(tracker.step, in_axes=(axes, -1), out_axes=(axes, -1))
    moments = jax.vmap(tracker.filter.moments, in_axes=axes.belief, out_axes=-1)

    def one_row(carry: Carry, row: Row) -> tuple[Carry, Output]:
        row = row._replace(key=trajectories_key, number=jnp.broadcast_to(row.number, (size,)))
        carry, said = trajectories(carry, row)
        carry, said = reinitialise(tracker, carry, row, said)
        mean, cov = moments(carry.belief)
        return carry, Output(mean, cov, *said)

    def body(state: tuple[Carry, tuple[Any, ...]], inputs: tuple[Row, Any]) -> tuple[Any, Output | None]:
        carry, sums = state
        row, truth = inputs
        carry, output = one_row(carry, row)
        if score is None:
            return (carry, sums), output
        return (carry, tuple(a + b for a, b in zip(sums, score(output, truth), strict=True))), None

    first_row, first_truth = jax.tree_util.tree_map(lambda x: jnp.asarray(x[0]), (rows, batch.truth))
    first_row = first_row._replace(key=trajectories_key, number=jnp.zeros(size, jnp.uint32))
    empty = jax.vmap(lambda row: blank(tracker, row), in_axes=-1, out_axes=axes)(first_row)
    sums: tuple[Any, ...] = ()
    if score is not None:
        # Of the shapes of a row's output, without tracing a row once more: that takes seconds for large states.
        zero = jnp.zeros_like(first_row.dt)
        said = StepInfo(zero, zero, zero, zero, zero.astype(jnp.int8))
        mean, cov = moments(empty.belief)
        shapes = jax.eval_shape(lambda: score(Output(mean, cov, *said), first_truth))
        sums = tuple(jnp.zeros(s.shape, s.dtype) for s in shapes)
    # Particles have no derivative, and stay as they are.
    begin = (empty, sums) if has_particle_axis(tracker) else mark_dependent((empty, sums), tracker)
    (_, sums), outputs = jax.lax.scan(body, begin, (rows, batch.truth))
    return sums, outputs


def carry_axes(tracker: Tracker) -> Carry:
    """Where the trajectories stand in what one row hands to the next: last, but first in the belief of a heavy filter."""
    return Carry(0 if has_particle_axis(tracker) else -1, -1, -1, -1, -1)


def has_particle_axis(tracker: Tracker) -> bool:
    """Whether the filter's belief has an axis of its own, of particles or cells, along which its loops run."""
    return bool(getattr(tracker.filter, "has_particle_axis", False))


def begun(tracker: Tracker, found: Any, row: Row) -> Carry:
    """What a row hands on that starts a track."""
    one = jnp.ones_like(row.dt)
    # Another key for every start of a trajectory; a filter that draws nothing leaves it uncomputed.
    key = jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(row.key), row.number))
    return Carry(tracker.filter.init(tracker.start.begin(found, row), key), one > 0, one > 0, one, one * 0)


def blank(tracker: Tracker, row: Row) -> Carry:
    """What stands before the first row: zeros, not running."""
    shape = jax.eval_shape(lambda r: begun(tracker, tracker.start.candidate(tracker.sensors, r), r), row)
    return jax.tree_util.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), shape)


def reinitialise(tracker: Tracker, carry: Carry, row: Row, said: StepInfo) -> tuple[Carry, StepInfo]:
    """Start every trajectory of the chunk that isn't running and whose row holds enough; the others pass unchanged."""
    need = row.valid & ~carry.running & jax.vmap(tracker.start.ready, in_axes=-1)(row)
    found = search(tracker, row, need)
    axes = carry_axes(tracker)

    def started() -> Carry:
        fresh = jax.vmap(lambda f, r: begun(tracker, f, r), in_axes=-1, out_axes=axes)(found, row)
        return jax.vmap(select, in_axes=(-1, axes, axes), out_axes=axes)(need, fresh, carry)

    # A normal belief is made in less time than it takes to ask whether any is needed; a thousand particles aren't.
    after = jax.lax.cond(jnp.any(need), started, lambda: carry) if has_particle_axis(tracker) else started()
    status = jnp.where(need, jnp.where(carry.begun, Status.RESTARTED, Status.OK), said.status).astype(jnp.int8)
    return after, said._replace(status=status)


def search(tracker: Tracker, row: Row, need: Any) -> Any:
    """`start.acquire` for the trajectories that need it, a few at a time, so that a lone loss costs little."""
    numbers, rest = eqx.partition((tracker.start, tracker.sensors), eqx.is_array)
    start, sensors = eqx.combine(numbers if tracker.start.smooth else jax.lax.stop_gradient(numbers), rest)
    row = jax.lax.stop_gradient(row)
    candidate = jax.vmap(lambda r: start.candidate(sensors, r), in_axes=-1, out_axes=-1)
    size = need.shape[0]
    n_workers = min(ACQUIRED_AT_ONCE, size)
    shapes = jax.eval_shape(candidate, row)
    nothing = jax.tree_util.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    def some(state: tuple[Any, Any]) -> tuple[Any, Any]:
        need, found = state
        index = jnp.nonzero(need, size=n_workers, fill_value=size)[0]
        few = jax.tree_util.tree_map(lambda x: jnp.take(x, index, axis=-1, mode="clip"), row)
        found = jax.tree_util.tree_map(lambda a, b: a.at[..., index].set(b, mode="drop"), found, candidate(few))
        return need.at[index].set(False, mode="drop"), found

    return jax.lax.while_loop(lambda state: jnp.any(state[0]), some, (need, nothing))[1]
