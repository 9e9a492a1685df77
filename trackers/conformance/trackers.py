"""The contract of a tracker: what changes no bit of an estimate, its sums, derivatives and consistency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.conformance.parts import BrokenContract, Check, NotApplicable, asserted
from trackwright.trackers.core.data.estimates import Estimates, Status, is_usable
from trackwright.trackers.core.data.recording import Batch, Recording, stack
from trackwright.trackers.core.errors import one_or_more, require
from trackwright.trackers.core.model.tunable import replaced, tunables
from trackwright.trackers.core.run.chunks import CHUNK, as_dtype, batch_estimates, called
from trackwright.trackers.core.run.requirements import check_input
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractTracker, filter_batch
from trackwright.trackers.recordings.tracks import cut

ROWS, FEWEST, MOST = 64, 6, 8  # rows and numbers of recordings: batches of 5 to 8 have one program
CUTS = 3  # of a recording that is run in pieces
STEPS = 1e-4, 1e-5  # of difference quotients, of unconstrained values: long ones meet jumps, short ones noise
FIELDS = ("mean", "cov_upper", "log_likelihood", "nis", "nis_dof", "wrapped", "status")
ALONE, EVERY = "no mean, maximum or sort over the last axis, of trajectories", slice(None)


def tracker_checks(tracker: AbstractTracker, recordings: Sequence[Recording], *, causal: bool = True) -> list[Check]:
    """The checks of a tracker on the first 64 rows of recordings that it follows; `causal`: False for a smoother.

    No bit of an estimate depends on padding, later rows, other trajectories, values that are not seen, or a cut after
    which `initial` continues; `accumulate` agrees with `scan`; derivatives are difference quotients.
    """
    require(isinstance(tracker, AbstractTracker), "check_tracker", tracker, "an object of AbstractTracker")
    varied = _varied(one_or_more(recordings, (Recording,), "recordings that the tracker follows"))
    stacked = partial(stack, rows=len(varied[-1]))

    def run(changed: Batch, by: AbstractTracker = tracker) -> Estimates:
        return batch_estimates(by, changed, CHUNK, continues=True)

    batch = cache(lambda: stacked(varied))

    @cache
    def estimates() -> Estimates:
        check_input(tracker, varied, "check_tracker")
        return run(batch())

    def same(mine: Estimates, k: Any, change: str, fix: str, part: slice = EVERY, of: slice | None = None) -> None:
        for name in FIELDS:
            both = zip(*(jax.tree_util.tree_leaves(getattr(x, name)) for x in (mine, estimates()[k])), strict=True)
            cut_out = ((np.asarray(x)[..., part], np.asarray(y)[..., of or part]) for x, y in both)
            kept = all(np.array_equal(x, y, equal_nan=True) for x, y in cut_out)
            assert kept, f"{change} changes {name} of recording {k}, expected the same bits; usual fix: {fix}"

    @Check
    def run_() -> None:
        valid, wrong = batch().valid.T, estimates().status == Status.NON_FINITE
        for k, row in np.argwhere((wrong | ~np.isfinite(estimates().log_likelihood)) & valid):
            raise BrokenContract(f"row {row} of recording {k} is not finite; usual fix: check_motion, check_sensor")
        share = float(np.mean(estimates().status[valid] == Status.OK))
        assert share > 0.5, f"a track runs in {share:.0%} of the rows; usual fix: recordings that the tracker follows"

    @Check
    def padding() -> None:
        hidden = ~np.asarray(batch().valid)

        def filled(x: Any, other: Any = None) -> np.ndarray:
            other = np.asarray(1e30, x.dtype) if other is None else other
            return np.where(np.expand_dims(hidden, tuple(range(1, x.ndim - 1))), other, x)

        readings = jax.tree_util.tree_map(filled, batch().readings)
        # Other inputs that occur: numbers of anchors are checked before a run.
        inputs = jax.tree_util.tree_map(lambda x: filled(x, x[::-1]), batch().inputs)
        dirty = run(batch()._replace(dt=filled(batch().dt), readings=readings, inputs=inputs))
        for k, one in enumerate(varied):
            same(dirty[k], k, "a number in rows of padding", "jnp.where(row.valid, after, before)", slice(len(one)))

    @Check
    def later_rows() -> None:
        if not causal:
            raise NotApplicable("a smoothed estimate depends on later rows")
        rng = np.random.default_rng(0)
        ends = [int(rng.integers(max(len(r) // 8, 1), max(len(r) // 2, 2))) for r in varied]
        shorter = run(stacked([cut(r, 0, end) for r, end in zip(varied, ends, strict=True)]))
        for k, end in enumerate(ends):
            same(shorter[k], k, "leaving out later rows", "causal=False for a smoother", slice(end))

    @Check
    def number_and_order() -> None:
        for order in ([*range(FEWEST - 1)], np.random.default_rng(1).permutation(len(varied)).tolist()):
            found = run(stacked([varied[k] for k in order]))
            for column, k in enumerate(order):
                same(found[column], k, f"a batch of the recordings {order}", ALONE)

    @Check
    def hidden_values() -> None:
        for hidden in (1e30, -7.0):
            given = batch().readings.items()
            readings = {name: r._replace(values=np.where(r.seen, r.values, hidden)) for name, r in given}
            found = run(batch()._replace(readings=readings))
            for k in range(len(varied)):
                same(found[k], k, f"the value {hidden:g} of a channel that is not seen", "jnp.where(seen, …, 0.0)")

    @Check
    def cut_and_resume() -> None:
        if not causal:
            raise NotApplicable("a smoothed estimate depends on later rows, also across a cut")
        *others, whole = varied
        pieces = [r for r in others if len(r) > CUTS]
        if not pieces:
            raise NotApplicable(f"no recording but the longest has more than {CUTS} rows, to be cut {CUTS} times")
        rng, state = np.random.default_rng(0), None
        ends = [[0, *np.sort(rng.choice(np.arange(1, len(r)), CUTS, replace=False)).tolist(), len(r)] for r in pieces]
        for j in range(CUTS + 1):
            # Random numbers depend on ids; one recording is never cut: it keeps all runs at one shape.
            parts = [replace(cut(r, e[j], e[j + 1]), id=r.id) for r, e in zip(pieces, ends, strict=True)]
            found = tracker.run([*parts, replace(whole, times=whole.times + 1000.0 * j)], initial=state)
            state = found.final
            for k, (one, e) in enumerate(zip(pieces, ends, strict=True)):
                fix = "all that later rows need is in the state that `scan` returns and takes as `initial`"
                part, of = slice(e[j + 1] - e[j]), slice(e[j], e[j + 1])
                same(found[k], one.id, f"a run that continues another from row {e[j]}", fix, part, of)

    @Check
    def one_program() -> None:
        moved = {n: eqx.tree_at(lambda x: x.raw, node, node.raw + 0.05) for n, node in tunables(tracker).items()}
        traced: list[str] = []
        estimates()

        def listen(event: str, duration_secs: float, **_: Any) -> None:
            traced.extend([event] * event.endswith("jaxpr_trace_duration"))  # also of what a cache on disk has

        jax.monitoring.register_event_duration_secs_listener(listen)
        try:
            run(batch(), replaced(tracker, moved))
        finally:
            jax.monitoring.unregister_event_duration_listener(listen)
        fix = "usual fix: numbers that are Scale, Real or arrays, no static fields; functions not made for each run"
        assert not traced, f"a run with other numbers traces {len(traced)} programs anew, expected none; {fix}"

    sums = cache(lambda: _Sums(tracker, varied))

    @Check
    @jax.enable_x64(True)
    def single_and_batch() -> None:
        alone = called(filter_batch, sums().model, sums().batch.columns(0, 1))
        numbers = ((x.mean, x.cov, x.log_likelihood, x.nis, x.nis_dof, x.wrapped) for x in (alone, sums().output))
        for a, b in zip(*map(jax.tree_util.tree_leaves, numbers), strict=True):
            same = np.allclose(a[..., 0], b[..., 0], 1e-7, 1e-9, True)
            assert same, f"alone and in a batch differ; usual fix: {ALONE}"

    @Check
    @jax.enable_x64(True)
    def accumulate() -> None:
        of_scan = [float(jnp.sum(x)) for x in jax.vmap(_score, (0, None))(sums().output, {})]
        assert np.allclose(sums().here, of_scan, 1e-6, 1e-6), f"{sums().here} by `accumulate`, {of_scan} by `scan`"

    @Check
    def gradient() -> None:
        if not tunables(tracker):
            raise NotApplicable("the tracker has no tunables")
        sensors = jax.tree_util.tree_leaves(tracker, is_leaf=lambda x: hasattr(x, "curved"))
        if any(getattr(x, "curved", False) for x in sensors):
            raise NotApplicable("where readings begin to bend, the likelihood has a step, and the bend no derivative")
        other = run(batch()._replace(key=np.asarray(batch().key)[::-1].copy()))
        if not np.array_equal(other.log_likelihood, estimates().log_likelihood, equal_nan=True):
            raise NotApplicable("estimates depend on random numbers, whose derivative is no difference quotient")
        with jax.enable_x64(True):
            slopes = np.asarray(jax.jit(jax.jacfwd(sums().sums))(jnp.asarray(sums().point)))
            quotients = sums().quotients()
        bound = 1e-3 * np.abs(quotients) + 1e-5 * np.maximum(np.abs(sums().here), 1.0)[:, None]
        for figure, k in np.argwhere((np.abs(slopes - quotients) > bound).all(axis=0)):
            found = f"the derivative of the {('log-likelihood', 'estimates')[figure]} by {sums().labels[k]} is"
            numbers = f"{slopes[figure, k]:.6g}, by difference quotients {quotients[0, figure, k]:.6g}"
            raise BrokenContract(f"{found} {numbers}; usual fix: no stop_gradient, smooth = True for a start")

    bits = [run_, padding, later_rows, number_and_order, hidden_values, cut_and_resume, one_program]
    return [*bits, single_and_batch, accumulate, gradient]


check_tracker = asserted(tracker_checks)


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
        self.output: Output = called(filter_batch, self.model, self.batch)

    def sums(self, vector: Any) -> jax.Array:
        """The sums by `accumulate`, (2,), with the unconstrained values of all tunables."""
        parts = jnp.split(vector, np.cumsum([np.size(node.raw) for node in self.nodes.values()])[:-1])
        named = zip(self.nodes.items(), parts, strict=True) if self.nodes else ()
        nodes = {name: eqx.tree_at(lambda n: n.raw, x, jnp.reshape(v, np.shape(x.raw))) for (name, x), v in named}
        return jnp.stack([jnp.sum(x) for x in replaced(self.model, nodes).accumulate(self.batch, _score)])

    def quotients(self) -> np.ndarray:
        """The slopes of the sums by difference quotients of each step (steps, 2, p)."""
        shifts = np.eye(len(self.point))
        ends = [[np.asarray(self.program(jnp.asarray(self.point + by * shifts))) for by in (h, -h)] for h in STEPS]
        return np.stack([(above - below).T / (2 * h) for h, (above, below) in zip(STEPS, ends, strict=True)])


def _score(output: Output, truth: Any) -> tuple[Any, Any]:
    """The log-likelihood of each trajectory in a row, and a weighted sum of its usable estimate's numbers."""
    numbers = [x.reshape(-1, x.shape[-1]) for x in jax.tree_util.tree_leaves(output.mean)]
    each = jnp.concatenate([x.astype(output.log_likelihood.dtype) for x in numbers])
    weights = jnp.asarray(1.0 + 0.1 * np.cos(np.arange(len(each))), each.dtype)
    return output.log_likelihood, jnp.where(is_usable(output.status), weights @ each, 0.0)


def _varied(recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings of different lengths with missing readings of each channel, numbered, the longest last."""
    varied = []
    for k in range(max(min(len(recordings), MOST), FEWEST)):
        rng, whole = np.random.default_rng(k), recordings[k % min(len(recordings), MOST)]
        part = cut(whole, 0, max(min(ROWS, len(whole)) - 3 * k, 1))
        readings = {n: replace(r, seen=r.seen & (rng.random(np.shape(r.seen)) > 0.1)) for n, r in part.readings.items()}
        varied.append(replace(part, readings=readings))
    varied.append(varied.pop(max(range(len(varied)), key=lambda k: len(varied[k]))))
    return [replace(r, id=k) for k, r in enumerate(varied)]
