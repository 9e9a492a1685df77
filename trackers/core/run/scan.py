"""The scan of a recursive tracker: one `lax.scan` over time steps of a step that `vmap` maps over trajectories.

Arrays of a chunk of B trajectories are batch-last, (T, ..., B), so that each number of a step is one contiguous vector
over trajectories. The exception is a belief with an axis of particles or cells: there the trajectories come first.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Bool, UInt32

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.filters.filter import Innovation
from trackwright.trackers.core.jax_private import live_part
from trackwright.trackers.core.model import covariance
from trackwright.trackers.core.model.algebra import Scalar, mark_dependent, select, total
from trackwright.trackers.core.model.covariance import (
    ONE_KERNEL,
    AnyCovariance,
    Gaussian,
    OneArray,
    as_scalars,
    by_entry,
    entries,
    matrix,
    side_by_side,
    with_covariances,
)
from trackwright.trackers.core.model.inputs import RawKey
from trackwright.trackers.core.model.sensor import Row


class StepInfo(NamedTuple):
    """Per-step diagnostics: log-likelihood, NIS and its degrees of freedom, ambiguous wraps, `Status`."""

    log_likelihood: Scalar
    nis: Scalar
    nis_dof: Scalar
    wrapped: Scalar
    status: Scalar


class Carry(NamedTuple):
    """The carry between two time steps: belief, track status, statistic of track loss, s since the last measurement."""

    belief: Any
    running: Scalar
    started: Scalar
    loss_statistic: Any
    time_since_measurement: Scalar


RecursiveTracker = Any
"""A `Tracker`, whose module imports this one."""


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
    return Carry(tracker.filter.init(prior, key), one > 0, one > 0, tracker.track_loss.initial(prior), one * 0)


def in_form(carry: Carry, few: bool) -> Carry:
    """The carry of one trajectory with its covariances in the form for few trajectories, or for many."""
    return carry._replace(belief=with_covariances(carry.belief, matrix if few else as_scalars))


def first_carry(tracker: RecursiveTracker, row: Row, few: bool) -> Carry:
    """The carry before the first row: zeros, no track running, unless the start is known."""

    def started(row: Row) -> Carry:
        return in_form(initial_carry(tracker, tracker.start.candidate(tracker.sensors, row), row), few)

    if tracker.start.known:
        return started(row)
    shape = jax.eval_shape(started, row)
    return jax.tree_util.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), shape)


def in_one_kernel(tracker: RecursiveTracker, trajectories: int) -> bool:
    """Whether the loop over rows becomes one kernel, without hundreds of calls in each step.

    It must hold no search for starts, which takes many times as long there, and store one array: several are copied
    whole in every step.
    """
    return trajectories <= ONE_KERNEL and not tracker.start.searches and not tracker.filter.has_particle_axis


STARTS_AT_ONCE = 16
"""Trajectories whose start is searched for together; one search costs as much as hundreds of filter steps."""


class ScanState(NamedTuple):
    """The state of a recursive tracker after some rows, trajectories first in every array: `scan` continues from it.

    `n_rows` (B,): rows so far; the row of a start is part of the track's random key.
    """

    carry: Carry
    n_rows: UInt32[Array | np.ndarray, " B"]


class Output(NamedTuple):
    """The result of one time step: mean of the state, upper triangle of its covariance entry by entry, and `StepInfo`.

    `age`: time from the estimate's validity to its row, s; None where they coincide.
    """

    mean: Any
    cov: Any
    log_likelihood: Scalar
    nis: Scalar
    nis_dof: Scalar
    wrapped: Scalar
    status: Scalar
    age: Scalar | None = None


Score = Callable[[Output, dict[str, tuple[Any, Any]]], tuple[Any, ...]]
"""A function of a time step's output and truth: numbers per trajectory, (B,) each."""


def scan_rows(
    tracker: RecursiveTracker, batch: Batch, initial: ScanState | None = None, score: Score | None = None,
    moments: Callable[[Any], tuple[Any, AnyCovariance]] | None = None, every_row: bool = False,
) -> tuple[tuple[Any, ...], Any, Any]:  # fmt: skip
    """All time steps of one chunk, batch-last: the outputs of every step, or with a `score` its sums over time.

    `initial`: the state before the first row, by default no track. `moments`: mean and covariance of an output from the
    belief of one trajectory, by default the tracker's. `every_row`: the scores of every step instead of their sums.
    Returns (sums, None, None) with a score, ((), outputs, state) without.
    """
    size, trajectory_keys = batch.size, jnp.asarray(batch.key)
    rows = Row(batch.dt, batch.valid, batch.readings, batch.inputs, None, jnp.arange(len(batch.dt), dtype=jnp.uint32))
    # XLA would join a constant with the loop's counter: a run that starts here would be another program, with other
    # rounding errors, than one that continues.
    first_number = jax.lax.optimization_barrier(jnp.zeros(size, jnp.uint32))
    n_rows = first_number if initial is None else jnp.asarray(initial.n_rows)
    axes = carry_axes(tracker)
    few = covariance.few(size) and not tracker.filter.has_particle_axis
    packed = few or in_one_kernel(tracker, size)
    every_moments = jax.vmap(
        moments or (lambda belief: moments_by_entry(tracker, belief)), in_axes=axes.belief, out_axes=-1
    )

    def one_row(carry: Carry, row: Row) -> tuple[Carry, Output]:
        row = row._replace(key=trajectory_keys, number=n_rows + row.number)
        carry, info = step(tracker, carry, row, few)
        carry, info = reinitialise(tracker, carry, row, info, few)
        mean, cov = every_moments(carry.belief)
        return carry, Output(mean, cov, *info)

    def body(state: tuple[Carry, tuple[Any, ...]], inputs: tuple[Row, Any]) -> tuple[Any, Any]:
        carry, sums = state
        row, truth = inputs
        if score is None:
            carry, output = one_row(carry, row)
            return (carry, sums), outputs_of.packed(output) if packed else output

        def scored(carry: Carry) -> tuple[Carry, tuple[Any, ...]]:
            after, output = one_row(carry, row)
            return after, score(output._replace(cov=tuple(output.cov)), truth)

        # A likelihood needs no moments; their derivatives would be traced all the same.
        carry, scores = without_dead_code(scored, carry)
        if every_row:
            return (carry, sums), scores_of.packed(tuple(x[None] for x in scores))
        return (carry, tuple(a + b for a, b in zip(sums, scores, strict=True))), None

    outputs_of, scores_of = OneArray(), OneArray()
    first_row, first_truth = jax.tree_util.tree_map(lambda x: jnp.asarray(x[0]), (rows, batch.truth))
    if initial is None:
        first_row = first_row._replace(key=trajectory_keys, number=jnp.zeros(size, jnp.uint32))
        before = jax.vmap(lambda row: first_carry(tracker, row, few), in_axes=-1, out_axes=axes)(first_row)
    else:
        given = jax.tree_util.tree_map(jnp.asarray, initial.carry)
        before = jax.vmap(lambda carry: in_form(carry, few), out_axes=axes)(given)
    # XLA derives the memory layout of the carry from its first value, and the layout decides the order of sums in the
    # loop. A fixed layout makes a continued run bit-identical to one long run.
    before = jax.tree_util.tree_map(lambda x: with_layout_constraint(x, Layout(tuple(range(x.ndim)))), before)
    sums: tuple[Any, ...] = ()
    if score is not None and not every_row:
        # The shapes of the score come from the state before the first row: tracing one more step takes seconds for
        # large states.
        zero = jnp.zeros_like(first_row.dt)
        info = StepInfo(zero, zero, zero, zero, zero.astype(jnp.int8))
        mean, cov = every_moments(before.belief)
        shapes = jax.eval_shape(lambda: score(Output(mean, tuple(cov), *info), first_truth))
        sums = tuple(jnp.zeros(s.shape, s.dtype) for s in shapes)
    # Particles have no derivative, so that nothing is marked as dependent.
    start = (before, sums) if tracker.filter.has_particle_axis else mark_dependent((before, sums), tracker)
    (carry, sums), outputs = jax.lax.scan(jax.checkpoint(body, prevent_cse=False), start, (rows, batch.truth))
    if every_row:
        return tuple(x[:, 0] for x in scores_of.unpacked(outputs)), None, None
    if score is not None:
        return sums, None, None
    if outputs is not None and packed:
        outputs = outputs_of.unpacked(outputs)
        outputs = outputs._replace(cov=by_entry(outputs.cov))
    n_rows = n_rows + jnp.sum(jnp.asarray(batch.valid), axis=0, dtype=jnp.uint32)
    return sums, outputs, ScanState(jax.vmap(lambda carry: in_form(carry, False), in_axes=(axes,))(carry), n_rows)


def without_dead_code(function: Callable[[Any], Any], argument: Any) -> Any:
    """`function(argument)`, traced without the operations that its results do not need."""
    program, shapes = jax.make_jaxpr(function, return_shape=True)(argument)
    live, used = live_part(program.jaxpr)
    leaves = jax.tree_util.tree_leaves(argument)
    results = jax.core.eval_jaxpr(live, program.consts, *[x for x, u in zip(leaves, used, strict=True) if u])
    return jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(shapes), results)


def moments_by_entry(tracker: RecursiveTracker, belief: Any) -> tuple[Any, AnyCovariance]:
    """The mean of an estimate and the `entries` of its covariance."""
    mean, cov = tracker.moments(belief)
    return mean, entries(cov)


def step(tracker: RecursiveTracker, carry: Carry, row: Row, few: bool) -> tuple[Carry, StepInfo]:
    """Prediction and update of all trajectories of a chunk, and the status of their tracks.

    With few trajectories the prediction is skipped on rows at the time of the previous row (ranges of one epoch), and
    the update on rows without readings (IMU samples between two ranges); of one trajectory sensor by sensor.
    """
    axes = carry_axes(tracker)
    predict = jax.vmap(tracker.predict, in_axes=(axes.belief, -1), out_axes=axes.belief)
    update = jax.vmap(tracker.update, in_axes=(axes.belief, -1), out_axes=(axes.belief, -1))
    advance = jax.vmap(tracker.advance, in_axes=(axes, -1, axes.belief, -1), out_axes=(axes, -1))
    if not few:
        return advance(carry, row, *update(predict(carry.belief, row), row))

    chosen = jax.vmap(select, (-1, axes.belief, axes.belief), axes.belief)

    def where(condition: Bool[Array, " B"], after: Any, before: Any) -> Any:
        # The bits of a trajectory must not depend on its neighbours: it keeps its belief where only others step.
        return after if len(condition) == 1 else chosen(condition, after, before)

    moves = row.dt > 0

    def measured(names: Collection[str], seen: Bool[Array, " B"], belief: Any) -> tuple[Any, Innovation]:
        of_sensors = jax.vmap(partial(tracker.update, names=names), (axes.belief, -1), (axes.belief, -1))
        after, innovation = of_sensors(belief, row)
        statistics = (jnp.where(seen, x, 0.0).astype(row.dt.dtype) for x in innovation)
        return where(seen, after, belief), Innovation(*statistics)

    def unmeasured(belief: Any) -> tuple[Any, Innovation]:
        return belief, Innovation(*[jnp.zeros_like(row.dt)] * 4)

    belief = jax.lax.cond(jnp.any(moves), lambda b: where(moves, predict(b, row), b), lambda b: b, carry.belief)
    innovations = []
    for names in [[name] for name in tracker.sensors] if len(moves) == 1 else [list(tracker.sensors)]:
        seen = jnp.any(jnp.concatenate([row.readings[name].seen for name in names]), axis=0)
        belief, innovation = jax.lax.cond(jnp.any(seen), partial(measured, names, seen), unmeasured, belief)
        innovations.append(innovation)
    innovation = Innovation(*(total(x) for x in zip(*innovations, strict=True)))
    return advance(carry, row, belief, innovation)


def reinitialise(
    tracker: RecursiveTracker, carry: Carry, row: Row, info: StepInfo, few: bool
) -> tuple[Carry, StepInfo]:
    """Start a track in every trajectory of the chunk that has none and whose row suffices; the others are unchanged.

    After a numerical failure the next row that suffices starts a track, so that the failure stays visible in its row.
    """
    sufficient = jax.vmap(tracker.start.can_start, in_axes=-1)(row)
    need = starting(carry, row, sufficient, info)
    candidates = search(tracker, row, need, few)
    axes = carry_axes(tracker)

    def with_new_tracks() -> Carry:
        started = jax.vmap(lambda c, r: in_form(initial_carry(tracker, c, r), few), in_axes=-1, out_axes=axes)
        fresh = started(candidates, row)
        return jax.vmap(select, in_axes=(-1, axes, axes), out_axes=axes)(need, fresh, carry)

    # Making a Gaussian belief costs less than the condition; making a thousand particles costs more.
    after = (
        jax.lax.cond(jnp.any(need), with_new_tracks, lambda: carry)
        if tracker.filter.has_particle_axis
        else with_new_tracks()
    )
    return after, with_start(carry, need, info)


def starting(carry: Carry, row: Row, sufficient: Scalar, info: StepInfo) -> Scalar:
    """Whether a track starts: none runs, and the row suffices and is not one of a numerical failure."""
    return row.valid & ~carry.running & sufficient & (info.status != Status.NON_FINITE)


def with_start(carry: Carry, need: Scalar, info: StepInfo) -> StepInfo:
    """The diagnostics of a row after which a track starts where there is `need`; `carry`: without it."""
    status = jnp.where(need, jnp.where(carry.started, Status.RESTARTED, Status.OK), info.status).astype(jnp.int8)
    return info._replace(status=status)


def search(tracker: RecursiveTracker, row: Row, need: Bool[Array, " B"], few: bool) -> Any:
    """`start.candidate` of the trajectories where `need` (B,) is true; anything elsewhere."""
    numbers, rest = eqx.partition((tracker.start, tracker.sensors), eqx.is_array)
    start, sensors = eqx.combine(numbers if tracker.start.smooth else jax.lax.stop_gradient(numbers), rest)
    row = jax.lax.stop_gradient(row)
    candidate = jax.vmap(lambda r: start.candidate(sensors, r), in_axes=-1, out_axes=-1)
    size = need.shape[0]
    if in_one_kernel(tracker, size):
        return candidate(row)
    shapes = jax.eval_shape(candidate, row)
    nothing = jax.tree_util.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    def all_at_once(state: tuple[Any, Any]) -> tuple[Any, Any]:
        need, _ = state
        return jnp.zeros_like(need), jax.tree_util.tree_map(lambda x: jnp.where(need, x, 0.0), candidate(row))

    def some(state: tuple[Any, Any]) -> tuple[Any, Any]:
        need, candidates = state
        index = jnp.nonzero(need, size=side_by_side(STARTS_AT_ONCE, size), fill_value=size)[0]
        rows = jax.tree_util.tree_map(lambda x: jnp.take(x, index, axis=-1, mode="clip"), row)
        candidates = jax.tree_util.tree_map(
            lambda a, b: a.at[..., index].set(b, mode="drop"), candidates, candidate(rows)
        )
        return need.at[index].set(False, mode="drop"), candidates

    # A search within one kernel pays for few trajectories alone.
    body = all_at_once if few else some
    return jax.lax.while_loop(lambda state: jnp.any(state[0]), body, (need, nothing))[1]
