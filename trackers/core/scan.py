"""The scan of a recursive tracker: one `lax.scan` over time steps of a step that `vmap` maps over trajectories.

Arrays of a chunk of B trajectories are batch-last, (T, ..., B), so that each number of a step is one contiguous vector
over trajectories. The exception is a belief with an axis of particles or cells: there the trajectories come first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Bool, UInt32

from trackers.core.algebra import Scalar, mark_dependent
from trackers.core.estimates import Status
from trackers.core.filter import AbstractFilter, Gaussian
from trackers.core.keys import RawKey
from trackers.core.recording import Batch, Row
from trackers.core.select import select
from trackers.core.sensor import AbstractSensor
from trackers.core.start import AbstractStart

STARTS_AT_ONCE = 16
"""Trajectories whose start is searched for together; one search costs as much as hundreds of filter steps."""


class StepInfo(NamedTuple):
    """Per-step diagnostics: log-likelihood, NIS and its degrees of freedom, ambiguous wraps, `Status`."""

    log_likelihood: Scalar
    nis: Scalar
    nis_dof: Scalar
    wrapped: Scalar
    status: Scalar


class Carry(NamedTuple):
    """The carry between two time steps: belief, track status, running mean of NIS/dof, s since the last measurement."""

    belief: Any
    running: Scalar
    started: Scalar
    nis_average: Scalar
    time_since_measurement: Scalar


class ScanState(NamedTuple):
    """The state of a recursive tracker after some rows, trajectories first in every array: `scan` continues from it.

    `n_rows` (B,): rows so far, which number the starts of a trajectory.
    """

    carry: Carry
    n_rows: UInt32[Array | np.ndarray, " B"]


class Output(NamedTuple):
    """The result of one time step: mean of the state, upper triangle of its covariance, and `StepInfo`.

    `age`: s between the time for which the estimate is valid and that of its row; None where they are the same.
    """

    mean: Any
    cov: tuple[Scalar, ...]
    log_likelihood: Scalar
    nis: Scalar
    nis_dof: Scalar
    wrapped: Scalar
    status: Scalar
    age: Scalar | None = None


Score = Callable[[Output, dict[str, tuple[Any, Any]]], tuple[Any, ...]]
"""Numbers per trajectory, (B,) each, of one time step: a function of its output and its truth."""


@runtime_checkable
class RecursiveTracker(Protocol):
    """The attributes of a `Tracker` that the scan uses."""

    @property
    def sensors(self) -> Mapping[str, AbstractSensor]: ...
    @property
    def start(self) -> AbstractStart: ...
    @property
    def filter(self) -> AbstractFilter[Any]: ...
    def step(self, carry: Carry, row: Row) -> tuple[Carry, StepInfo]: ...
    def moments(self, belief: Any) -> tuple[Any, tuple[Scalar, ...]]: ...


def scan_rows(
    tracker: RecursiveTracker,
    batch: Batch,
    initial: ScanState | None = None,
    score: Score | None = None,
    moments: Callable[[Any], tuple[Any, tuple[Scalar, ...]]] | None = None,
) -> tuple[tuple[Any, ...], Output | None, ScanState]:
    """All time steps of one chunk, batch-last: the outputs of every step, or with a `score` its sums over time.

    `initial`: the state before the first row, by default no track. `moments`: mean and covariance of an output from the
    belief of one trajectory, by default the tracker's. Returns (sums, None, state) with a score, ((), outputs, state)
    without.
    """
    size, trajectory_keys = batch.size, jnp.asarray(batch.key)
    rows = Row(batch.dt, batch.valid, batch.readings, batch.inputs, None, jnp.arange(len(batch.dt), dtype=jnp.uint32))
    n_rows = jnp.zeros(size, jnp.uint32) if initial is None else jnp.asarray(initial.n_rows)
    axes = carry_axes(tracker)
    step = jax.vmap(tracker.step, in_axes=(axes, -1), out_axes=(axes, -1))
    every_moments = jax.vmap(moments or tracker.moments, in_axes=axes.belief, out_axes=-1)

    def one_row(carry: Carry, row: Row) -> tuple[Carry, Output]:
        row = row._replace(key=trajectory_keys, number=n_rows + row.number)
        carry, info = step(carry, row)
        carry, info = reinitialise(tracker, carry, row, info)
        mean, cov = every_moments(carry.belief)
        return carry, Output(mean, cov, *info)

    def body(state: tuple[Carry, tuple[Any, ...]], inputs: tuple[Row, Any]) -> tuple[Any, Output | None]:
        carry, sums = state
        row, truth = inputs
        carry, output = one_row(carry, row)
        if score is None:
            return (carry, sums), output
        return (carry, tuple(a + b for a, b in zip(sums, score(output, truth), strict=True))), None

    first_row, first_truth = jax.tree_util.tree_map(lambda x: jnp.asarray(x[0]), (rows, batch.truth))
    if initial is None:
        first_row = first_row._replace(key=trajectory_keys, number=jnp.zeros(size, jnp.uint32))
        before = jax.vmap(lambda row: empty_carry(tracker, row), in_axes=-1, out_axes=axes)(first_row)
    else:
        before = jax.vmap(lambda carry: carry, out_axes=axes)(jax.tree_util.tree_map(jnp.asarray, initial.carry))
    # XLA chooses the layout of a carry whose first value it knows, and by it the order of sums in the loop: with one
    # layout, a run that continues another has the bits of the one run.
    before = jax.tree_util.tree_map(lambda x: with_layout_constraint(x, Layout(tuple(range(x.ndim)))), before)
    sums: tuple[Any, ...] = ()
    if score is not None:
        # The shapes of the score come from the state before the first row: tracing one more step takes seconds for
        # large states.
        zero = jnp.zeros_like(first_row.dt)
        info = StepInfo(zero, zero, zero, zero, zero.astype(jnp.int8))
        mean, cov = every_moments(before.belief)
        shapes = jax.eval_shape(lambda: score(Output(mean, cov, *info), first_truth))
        sums = tuple(jnp.zeros(s.shape, s.dtype) for s in shapes)
    # Particles have no derivative, so that nothing is marked as dependent.
    start = (before, sums) if tracker.filter.has_particle_axis else mark_dependent((before, sums), tracker)
    (carry, sums), outputs = jax.lax.scan(body, start, (rows, batch.truth))
    n_rows = n_rows + jnp.sum(jnp.asarray(batch.valid), axis=0, dtype=jnp.uint32)
    return sums, outputs, ScanState(jax.vmap(lambda carry: carry, in_axes=(axes,))(carry), n_rows)


def carry_axes(tracker: RecursiveTracker) -> Carry:
    """The axis of trajectories in each part of the carry: last, but first in a belief with a particle axis."""
    return Carry(0 if tracker.filter.has_particle_axis else -1, -1, -1, -1, -1)


def initial_carry(tracker: RecursiveTracker, candidate: Any, row: Row) -> Carry:
    """The carry after a row that starts a track."""
    return carry_of(tracker, tracker.start.belief(candidate, row), row.key, row.number)


def carry_of(tracker: RecursiveTracker, prior: Gaussian, key: RawKey, number: Scalar) -> Carry:
    """The carry of a track that begins with this prior at row `number` of a trajectory with this random key."""
    one = jnp.ones_like(prior.cov[0])
    # A new key for every start of a trajectory; XLA drops it where the filter draws no random numbers.
    key = jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(jnp.asarray(key)), number))
    return Carry(tracker.filter.init(prior, key), one > 0, one > 0, one, one * 0)


def empty_carry(tracker: RecursiveTracker, row: Row) -> Carry:
    """The carry before the first row: zeros, no track running."""
    shape = jax.eval_shape(lambda r: initial_carry(tracker, tracker.start.candidate(tracker.sensors, r), r), row)
    return jax.tree_util.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), shape)


def reinitialise(tracker: RecursiveTracker, carry: Carry, row: Row, info: StepInfo) -> tuple[Carry, StepInfo]:
    """Start a track in every trajectory of the chunk that has none and whose row suffices; the others are unchanged.

    After a numerical failure the next row that suffices starts a track, so that the failure stays visible in its row.
    """
    sufficient = jax.vmap(tracker.start.can_start, in_axes=-1)(row)
    need = row.valid & ~carry.running & sufficient & (info.status != Status.NON_FINITE)
    candidates = search(tracker, row, need)
    axes = carry_axes(tracker)

    def with_new_tracks() -> Carry:
        fresh = jax.vmap(lambda c, r: initial_carry(tracker, c, r), in_axes=-1, out_axes=axes)(candidates, row)
        return jax.vmap(select, in_axes=(-1, axes, axes), out_axes=axes)(need, fresh, carry)

    # Making a Gaussian belief costs less than the condition; making a thousand particles costs more.
    after = (
        jax.lax.cond(jnp.any(need), with_new_tracks, lambda: carry)
        if tracker.filter.has_particle_axis
        else with_new_tracks()
    )
    status = jnp.where(need, jnp.where(carry.started, Status.RESTARTED, Status.OK), info.status).astype(jnp.int8)
    return after, info._replace(status=status)


def search(tracker: RecursiveTracker, row: Row, need: Bool[Array, " B"]) -> Any:
    """`start.candidate` of the trajectories where `need` (B,) is true, `STARTS_AT_ONCE` at a time; zeros elsewhere."""
    numbers, rest = eqx.partition((tracker.start, tracker.sensors), eqx.is_array)
    start, sensors = eqx.combine(numbers if tracker.start.smooth else jax.lax.stop_gradient(numbers), rest)
    row = jax.lax.stop_gradient(row)
    candidate = jax.vmap(lambda r: start.candidate(sensors, r), in_axes=-1, out_axes=-1)
    size = need.shape[0]
    n_at_once = min(STARTS_AT_ONCE, size)
    shapes = jax.eval_shape(candidate, row)
    nothing = jax.tree_util.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    def some(state: tuple[Any, Any]) -> tuple[Any, Any]:
        need, candidates = state
        index = jnp.nonzero(need, size=n_at_once, fill_value=size)[0]
        rows = jax.tree_util.tree_map(lambda x: jnp.take(x, index, axis=-1, mode="clip"), row)
        candidates = jax.tree_util.tree_map(
            lambda a, b: a.at[..., index].set(b, mode="drop"), candidates, candidate(rows)
        )
        return need.at[index].set(False, mode="drop"), candidates

    return jax.lax.while_loop(lambda state: jnp.any(state[0]), some, (need, nothing))[1]
