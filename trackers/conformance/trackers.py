"""The contract of a tracker: what changes no bit of an estimate, its sums, derivatives, consistency and speed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.conformance.contract import Check, NotApplicable, check, reported, require_part
from trackwright.trackers.conformance.worlds import compare_conditioned, compare_errors, drawn_world, own_recordings
from trackwright.trackers.core.data.estimates import Estimates, Status
from trackwright.trackers.core.data.recording import Batch, Readings, Recording, each_array, stack
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.state import path_name
from trackwright.trackers.core.model.tunable import replaced, tunables
from trackwright.trackers.core.run.chunks import CHUNK, as_dtype, batch_estimates, called
from trackwright.trackers.core.run.requirements import check_input
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractTracker, filter_batch
from trackwright.trackers.recordings.trajectories import cut

ROWS, FEWEST, MOST = 64, 6, 8
"""Rows to which recordings are cut, and how many there are at least and at most: batches of 5 to 8 have one program."""

SPOILT, CUTS = 2, 3
"""The recording whose measurements are spoilt, and the cuts of one that is run in pieces."""

STEPS = (3e-4, 1e-5)
"""Steps of difference quotients, of the unconstrained value of a tunable."""

LENGTHS, GROWTH = (64, 512), 1.2
"""Rows of two programs, and the factor by which the numbers that one row computes may grow."""

FIELDS = ("mean", "cov_upper", "log_likelihood", "nis", "nis_dof", "wrapped", "status")
ALONE = "usual fix: no mean, maximum or sort over the last axis, that of trajectories"
EVERY = slice(None)


def tracker_checks(
    tracker: AbstractTracker, recordings: Sequence[Recording] | None = None, *, causal: bool = True, seed: int = 0
) -> list[Check]:
    """The checks of a tracker on recordings that it follows, of which the first 64 rows are used.

    `recordings`: by default drawn from the tracker's own motion and sensors, where these read no inputs. `causal`:
    False for a smoother, whose estimates depend on later rows. No bit of an estimate depends on padding, later rows,
    other trajectories, values that are not seen, or a cut after which `initial` continues; `accumulate` agrees with
    `scan`; derivatives are difference quotients; a linear tracker has the likelihood and the moments of conditioning;
    covariances are consistent with the errors in a world drawn from its own model; time is linear in rows. Raises
    UnusableInput for an object of another kind, and where recordings are needed and missing.
    """
    require_part("check_tracker", tracker)
    given = own_recordings(tracker, FEWEST, seed) if recordings is None else list(recordings)
    varied = _varied(given)
    rows, numbers = len(varied[-1]), range(len(varied))

    def stacked(some: Sequence[Recording]) -> Batch:
        return stack(some, rows=rows)

    def run(changed: Batch, by: AbstractTracker = tracker) -> Estimates:
        return batch_estimates(by, changed, CHUNK, continues=True)

    batch = cache(lambda: stacked(varied))

    @cache
    def estimates() -> Estimates:
        check_input(tracker, varied, "check_tracker")
        return run(batch())

    def same(mine: Estimates, k: int, change: str, fix: str, part: slice = EVERY) -> None:
        found = _difference(mine, estimates()[k], part, part)
        assert found is None, f"{change} changes {found} of recording {k}, expected the same bits; {fix}"

    def with_readings(change: Callable[[Reading], Reading]) -> Estimates:
        return run(batch()._replace(readings={name: change(r) for name, r in batch().readings.items()}))

    @check()
    def run_() -> str:
        valid = batch().valid.T
        lost, fix = estimates().status == Status.NON_FINITE, "usual fix: check_motion and check_sensor of its parts"
        for what, bad in (("estimate", lost), ("log-likelihood", ~np.isfinite(estimates().log_likelihood))):
            where = " of recording ".join(str(k) for k in np.argwhere(bad & valid)[:1].ravel()[::-1])
            assert not where, f"the {what} of row {where} is not finite; {fix} at the state of the row before"
        share = float(np.mean(estimates().status[valid] == Status.OK))
        assert share > 0.5, (
            f"a track runs in {share:.0%} of the rows, expected more than half, else the checks say little; "
            "usual fix: recordings that the tracker follows, or a start whose can_start is true"
        )
        return f"a track runs in {share:.0%} of {valid.sum()} rows"

    @check(run_)
    def padding() -> None:
        hidden, fix = (
            ~np.asarray(batch().valid),
            "usual fix: jnp.where(row.valid, after, before) in what is kept",
        )

        def filled(x: Any, other: Any = None) -> np.ndarray:
            other = np.asarray(1e30, x.dtype) if other is None else other
            return np.where(np.expand_dims(hidden, tuple(range(1, x.ndim - 1))), other, x)

        readings = jax.tree_util.tree_map(filled, batch().readings)
        # Other inputs that occur: numbers of anchors are checked before a run.
        inputs = jax.tree_util.tree_map(lambda x: filled(x, x[::-1]), batch().inputs)
        dirty = run(batch()._replace(dt=filled(batch().dt), readings=readings, inputs=inputs))
        for k, one in enumerate(varied):
            same(dirty[k], k, "a number in rows of padding, after a recording's end,", fix, slice(len(one)))
        found = dirty.status[hidden.T]
        assert (found == Status.PADDING).all(), f"rows of padding have another status than Status.PADDING; {fix}"

    @check(run_)
    def later_rows() -> None:
        if not causal:
            raise NotApplicable("a smoothed estimate depends on later rows")
        rng = np.random.default_rng(0)
        ends = [int(rng.integers(max(len(r) // 8, 1), max(len(r) // 2, 2))) for r in varied]
        shorter = run(stacked([cut(r, 0, end) for r, end in zip(varied, ends, strict=True)]))
        for k, end in enumerate(ends):
            fix = "usual fix: no operation over the axis of rows, or causal=False for a smoother"
            same(shorter[k], k, "leaving out later rows", fix, slice(end))

    @check(run_)
    def number_of_tags() -> None:
        fewer = run(stacked(varied[: FEWEST - 1]))
        for k in numbers[: FEWEST - 1]:
            same(fewer[k], k, f"leaving out all recordings but the first {FEWEST - 1}", ALONE)

    @check(run_)
    def order_of_tags() -> None:
        order = np.random.default_rng(1).permutation(len(varied)).tolist()
        shuffled = run(stacked([varied[k] for k in order]))
        for column, k in enumerate(order):
            same(shuffled[column], k, f"the order {order} of the recordings", ALONE)

    @check(run_)
    def other_tags() -> None:
        for garbage in (1e30, -1e30, 1e3):

            def spoilt(reading: Reading, garbage: float = garbage) -> Reading:
                values, seen = reading.values.copy(), reading.seen.copy()
                values[..., SPOILT], seen[..., SPOILT] = garbage, True
                return reading._replace(values=values, seen=seen)

            found, change = with_readings(spoilt), f"a reading of {garbage:g} in recording {SPOILT}"
            for k in {*numbers} - {SPOILT}:
                same(found[k], k, change, ALONE)
            read = _difference(found[SPOILT], estimates()[SPOILT], EVERY, EVERY)
            assert read, f"{change} changes nothing of its own estimates; usual fix: read the batch by sensors' names"

    @check(run_)
    def hidden_values() -> None:
        if shown := _unhidden(varied):
            raise NotApplicable(f"a channel of {listed(shown)} is seen in every row, so that no value of it is hidden")
        for hidden in (1e30, -7.0):
            found = with_readings(lambda r, x=hidden: r._replace(values=np.where(r.seen, r.values, x)))  # type: ignore[misc]
            fix = "usual fix: jnp.where(seen, …, 0.0) in the sensor's residual and in the start's candidate"
            for k in numbers:
                same(found[k], k, f"the value {hidden:g} of a channel that is not seen", fix)

    @check(run_)
    def cut_and_resume() -> str:
        if not causal:
            raise NotApplicable("a smoothed estimate depends on later rows, also across a cut")
        *others, whole = varied
        pieces = [r for r in others if len(r) > CUTS]
        if not pieces:
            raise NotApplicable(f"no recording but the longest has more than {CUTS} rows, to be cut {CUTS} times")
        rng, state = np.random.default_rng(0), None
        inner = [np.sort(rng.choice(np.arange(1, len(r)), CUTS, replace=False)) for r in pieces]
        ends = [[0, *(int(k) for k in cuts), len(r)] for r, cuts in zip(pieces, inner, strict=True)]
        for j in range(CUTS + 1):
            # Random numbers depend on ids; one recording is never cut: it keeps all runs at one shape.
            parts = [replace(cut(r, e[j], e[j + 1]), id=r.id) for r, e in zip(pieces, ends, strict=True)]
            found = tracker.run([*parts, replace(whole, times=whole.times + 1000.0 * j)], initial=state)
            state = found.final
            for k, (one, e) in enumerate(zip(pieces, ends, strict=True)):
                apart = _difference(found[k], estimates()[one.id], slice(e[j + 1] - e[j]), slice(e[j], e[j + 1]))
                assert apart is None, (
                    f"a run of recording {one.id} that continues another from row {e[j]} on changes {apart}, expected "
                    "the bits of one run; usual fix: all that later rows need is in the state that `scan` returns and "
                    "takes as `initial`"
                )
        return f"the same bits in {CUTS + 1} pieces"

    @check(run_)
    def one_program() -> str:
        moved = {n: eqx.tree_at(lambda x: x.raw, node, node.raw + 0.05) for n, node in tunables(tracker).items()}
        before, traced = estimates(), []

        def listen(event: str, duration_secs: float, **_: Any) -> None:
            # Tracing comes before compiling, also of what the cache of an earlier process has.
            traced.extend([event] * event.endswith("jaxpr_trace_duration"))

        jax.monitoring.register_event_duration_secs_listener(listen)
        try:
            run(batch(), replaced(tracker, moved))
        finally:
            jax.monitoring.unregister_event_duration_listener(listen)
        assert not traced, (
            f"a second run with other numbers traces {len(traced)} programs anew, expected none; usual fix: numbers of "
            "a tracker are Scale, Real or arrays, no static fields, and its functions are not made anew for each run"
        )
        # No fault by itself: limits of track loss change nothing where no track is lost.
        changed = {name: run(batch(), replaced(tracker, {name: moved[name]})) for name in moved}
        idle = [name for name, after in changed.items() if _difference(after, before, EVERY, EVERY) is None]
        return f"{len(moved)} tunables" + (f"; no estimate depends on {', '.join(idle)}" if idle else "")

    sums = cache(lambda: _Sums(tracker, varied))

    @check(run_)
    @jax.enable_x64(True)
    def single_and_batch() -> None:
        alone = called(filter_batch, sums().model, sums().batch.columns(0, 1), for_few=True)
        numbers = ((x.mean, x.cov, x.log_likelihood, x.nis, x.nis_dof, x.wrapped) for x in (alone, sums().output))
        for a, b in zip(*map(jax.tree_util.tree_leaves, numbers), strict=True):
            apart = np.nanmax(np.abs(np.asarray(a, float)[..., 0] - np.asarray(b, float)[..., 0]), initial=0.0)
            assert np.allclose(a[..., 0], b[..., 0], rtol=1e-7, atol=1e-9, equal_nan=True), (
                f"estimates of recording 0 alone and in a batch differ by {apart:.2g}, expected the same; {ALONE}"
            )

    @check(run_)
    @jax.enable_x64(True)
    def accumulate() -> str:
        found, of_scan = sums().here, [float(jnp.sum(x)) for x in jax.vmap(_score, (0, None))(sums().output, {})]
        for what, mine, other in zip(("log-likelihood", "estimates"), found, of_scan, strict=True):
            assert abs(mine - other) <= 1e-6 * max(abs(other), 1.0), (
                f"the sum of the {what} over all rows is {mine:.8g} by `accumulate`, {other:.8g} by `scan`; usual fix: "
                "derive from AbstractEpochwiseTracker, whose `accumulate` scores the output of `scan`"
            )
        return f"log-likelihood {of_scan[0]:.6g} by both"

    @check(run_)
    def gradient() -> str:
        if not tunables(tracker):
            raise NotApplicable("the tracker has no tunables")
        if _difference(run(batch()._replace(key=np.asarray(batch().key)[::-1].copy())), estimates(), EVERY, EVERY):
            raise NotApplicable("estimates depend on random numbers, whose derivative is no difference quotient")
        with jax.enable_x64(True):
            slopes = np.asarray(jax.jit(jax.jacfwd(sums().sums))(jnp.asarray(sums().point)))
            # The smaller step for corners close together; a wrong derivative is wrong over both.
            sides = np.stack([sums().sides(step) for step in STEPS])
        least, most = sides.min(axis=1), sides.max(axis=1)
        near = 1e-3 * np.maximum(np.abs(least), np.abs(most)) + sums().rounding
        fits = ((slopes >= least - near) & (slopes <= most + near)).any(axis=0)
        for figure, k in np.argwhere(~fits)[:1]:
            raise AssertionError(
                f"the derivative of the {('log-likelihood', 'estimates')[figure]} by {sums().labels[k]} is "
                f"{slopes[figure, k]:.6g}, by difference quotients {sides[0, :, figure, k].mean():.6g}; usual fix: no "
                "stop_gradient, rounding or NumPy on its way, and smooth = True for a start that reads it"
            )
        return f"{len(sums().point)} tunables"

    @cache
    def world() -> Any:
        return drawn_world(tracker, varied[-1], estimates()[numbers[-1]], seed)

    @check(run_)
    @jax.enable_x64(True)
    def conditioning() -> str:
        return compare_conditioned(world(), world().estimates)

    @check(run_)
    @jax.enable_x64(True)
    def consistency() -> str:
        return compare_errors(world(), world().estimates)

    @check(run_)
    def speed() -> str:
        longest, computed = max(given, key=len), []
        for length in LENGTHS:
            repeated = stack([_repeated(longest, length)])._replace(truth={})
            program = eqx.filter_make_jaxpr(filter_batch)(as_dtype(tracker, repeated.dt.dtype), repeated)[0]
            computed.append(_computed_numbers(program.jaxpr) / length)
        few, many = computed
        assert many <= GROWTH * few, (
            f"each of {LENGTHS[1]} rows computes {many:.0f} numbers, each of {LENGTHS[0]} rows {few:.0f}: the time is "
            "not linear in the rows; usual fix: jax.lax.scan with a carry of fixed size, no array of all rows inside"
        )
        return f"{many:.0f} numbers a row of {LENGTHS[1]}"

    identities = [run_, padding, later_rows, number_of_tags, order_of_tags, other_tags, hidden_values, cut_and_resume]
    return [*identities, one_program, single_and_batch, accumulate, gradient, conditioning, consistency, speed]


check_tracker = reported(tracker_checks)


class _Sums:
    """Sums over all rows of log-likelihood and estimates, at the tunables of a tracker and a little off each."""

    def __init__(self, tracker: AbstractTracker, recordings: Sequence[Recording]) -> None:
        self.batch = stack(recordings)._replace(truth={})
        self.model = as_dtype(tracker, self.batch.dt.dtype)
        self.nodes = tunables(self.model)
        self.labels = [name for name, node in self.nodes.items() for _ in range(np.size(node.raw))]
        self.point = np.concatenate([np.ravel(np.asarray(x.raw)) for x in self.nodes.values()] or [np.zeros(0)])
        self.program = jax.jit(lambda vectors: jax.lax.map(self.sums, vectors))
        self.here = np.asarray(self.program(jnp.asarray(self.point[None])))[0]
        # An update of a diffuse prior loses digits to cancellation.
        self.rounding = 1e-9 * np.maximum(np.abs(self.here), 1.0)[:, None] / STEPS[0]
        self.output: Output = called(filter_batch, self.model, self.batch)

    def sums(self, vector: Any) -> jax.Array:
        """The sums by `accumulate`, (2,), with the unconstrained values of all tunables."""
        parts = jnp.split(vector, np.cumsum([np.size(node.raw) for node in self.nodes.values()])[:-1])
        named = zip(self.nodes.items(), parts, strict=True) if self.nodes else ()
        nodes = {name: eqx.tree_at(lambda n: n.raw, x, jnp.reshape(v, np.shape(x.raw))) for (name, x), v in named}
        return jnp.stack([jnp.sum(x) for x in replaced(self.model, nodes).accumulate(self.batch, _score)])

    def sides(self, step: float) -> np.ndarray:
        """The slopes of the sums above and below the tunables, (2, 2, p)."""
        shifts = step * np.eye(len(self.point))
        above, below = np.split(
            np.asarray(self.program(jnp.asarray(self.point + np.concatenate([shifts, -shifts])))), 2
        )
        return np.stack([(above - self.here).T, (self.here - below).T]) / step


def _score(output: Output, truth: Any) -> tuple[Any, Any]:
    """The log-likelihood of each trajectory in a row, and a sum of its estimate's numbers with weights near one."""
    numbers = [x.reshape(-1, x.shape[-1]) for x in jax.tree_util.tree_leaves(output.mean)]
    each = jnp.concatenate([x.astype(output.log_likelihood.dtype) for x in numbers])
    weights = 1.0 + 0.1 * np.cos(np.arange(len(each)))
    return output.log_likelihood, jnp.sum(jnp.asarray(weights, each.dtype)[:, None] * each, axis=0)


def _varied(recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings of different lengths with missing readings of each channel, numbered, the longest last."""
    whole = [cut(r, 0, min(ROWS, len(r))) for r in recordings[:MOST]]
    varied = [*whole, *(_thinned(whole[k % len(whole)], k - len(whole)) for k in range(len(whole), FEWEST))]
    if len({len(r) for r in varied}) == 1:
        varied[-1] = cut(varied[-1], 0, max(len(varied[-1]) * 2 // 3, 1))
    if _unhidden(varied):
        varied[1:] = [_thinned(r, k) for k, r in enumerate(varied[1:])]
    varied.append(varied.pop(max(range(len(varied)), key=lambda k: len(varied[k]))))
    return [replace(r, id=k) for k, r in enumerate(varied)]


def _unhidden(recordings: Sequence[Recording]) -> list[str]:
    """The names of readings of which a channel is seen in every row of all recordings."""
    names = dict.fromkeys(name for one in recordings for name in one.readings)
    seen = {name: [one.readings[name].seen for one in recordings if name in one.readings] for name in names}
    return [name for name, parts in seen.items() if np.concatenate(parts).all(axis=0).any()]


def _thinned(recording: Recording, seed: int) -> Recording:
    """The recording with one reading in ten hidden, and without its last rows."""
    rng, part = np.random.default_rng(seed), cut(recording, 0, max(len(recording) - 3 * seed, 1))
    hidden = {name: r.seen & (rng.random(np.shape(r.seen)) > 0.1) for name, r in part.readings.items()}
    return replace(part, readings={n: Readings(r.values, hidden[n], r.reported) for n, r in part.readings.items()})


def _difference(mine: Estimates, other: Estimates, rows: slice, other_rows: slice) -> str | None:
    """The first array and row in which estimates differ, by how much, in words; None for the same bits."""
    trees = [{name: getattr(x, name) for name in FIELDS} for x in (mine, other)]
    leaves = (jax.tree_util.tree_flatten_with_path(tree)[0] for tree in trees)
    for (path, x), (_, y) in zip(*leaves, strict=True):
        a, b = np.asarray(x)[..., rows], np.asarray(y)[..., other_rows]
        if not np.array_equal(a, b, equal_nan=True):
            apart = ~((a == b) | (np.isnan(a) & np.isnan(b)))
            size = np.nanmax(np.abs(np.where(apart, a.astype(float) - b.astype(float), 0.0)))
            name = path_name(path).removeprefix("mean.")
            return f"{name} in row {int(np.argwhere(apart)[0][-1])} by up to {size:.2g}"
    return None


def _repeated(recording: Recording, rows: int) -> Recording:
    """The recording again and again, one after another in time, up to this number of rows."""
    index = np.arange(rows) % len(recording)
    span = recording.times[-1] - recording.times[0] + np.median(np.diff(recording.times))
    times = recording.times[index] + span * (np.arange(rows) // len(recording))
    return Recording(times, *each_array(recording, lambda x: x[index]))


def _computed_numbers(program: Any) -> int:
    """The numbers that all operations of a jaxpr yield; a loop counts once per turn, once where turns are unknown."""
    total = 0
    for operation in program.eqns:
        inner = [_computed_numbers(part) for part in _programs(operation.params)]
        if not inner:
            total += sum(math.prod(getattr(out.aval, "shape", ())) for out in operation.outvars)
        else:
            several = max(inner) if operation.primitive.name == "cond" else sum(inner)
            total += several * int(operation.params.get("length", 1))
    return total


def _programs(params: dict[str, Any]) -> Iterator[Any]:
    """The jaxprs among the parameters of an operation."""
    for value in params.values():
        parts = [getattr(x, "jaxpr", x) for x in (value if isinstance(value, (tuple, list)) else (value,))]
        yield from (part for part in parts if hasattr(part, "eqns"))
