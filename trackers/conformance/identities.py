"""What changes no bit of an estimate: padding, later rows, other trajectories, hidden values, a cut, a second run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np

from trackwright.trackers.conformance.contract import BrokenContract, Check, NotApplicable
from trackwright.trackers.conformance.ran import FEWEST, Ran, difference, leaves, share_estimated, unhidden
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Recording
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.tunable import replaced, tunables
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.recordings.trajectories import cut

SPOILT = 2
"""The trajectory whose measurements are spoilt."""

CUTS = 3
"""Cuts of a recording that is run in pieces."""

EVERY = slice(None)


def identity_checks(ran: Ran, causal: bool) -> list[Check]:
    """The identities of a tracker; `causal`: estimates do not depend on later rows."""
    begun = Check("run", partial(_check_run, ran))
    return [
        begun,
        Check("padding", partial(_check_padding, ran), begun),
        Check("later rows", partial(_check_later_rows, ran, causal), begun),
        Check("number of tags", partial(_check_number, ran), begun),
        Check("order of tags", partial(_check_order, ran), begun),
        Check("other tags", partial(_check_company, ran), begun),
        Check("hidden values", partial(_check_hidden, ran), begun),
        Check("cut and resume", partial(_check_resume, ran, causal), begun),
        Check("one program", partial(_check_one_program, ran), begun),
    ]


def _check_run(ran: Ran) -> str:
    share = share_estimated(ran)
    lost = ran.estimates.status == Status.NON_FINITE
    for what, bad in (("estimate", lost), ("log-likelihood", ~np.isfinite(ran.estimates.log_likelihood))):
        if np.any(bad & ran.batch.valid.T):
            tag, row = np.argwhere(bad & ran.batch.valid.T)[0]
            raise BrokenContract(
                f"the {what} of row {row} of recording {tag} is not finite; usual fix: check_motion and check_sensor "
                "of its parts at the state of the row before"
            )
    if share <= 0.5:
        raise BrokenContract(
            f"a track runs in {share:.0%} of the rows, expected more than half, since identities of rows without a "
            "track say nothing; usual fix: recordings that the tracker follows, or a start whose can_start is true"
        )
    return f"a track runs in {share:.0%} of {ran.batch.valid.sum()} rows"


def _check_padding(ran: Ran) -> None:
    hidden = ~np.asarray(ran.batch.valid)

    def filled(x: Any) -> np.ndarray:
        return np.where(np.expand_dims(hidden, tuple(range(1, x.ndim - 1))), np.asarray(1e30, x.dtype), x)

    def reversed_in_time(x: Any) -> np.ndarray:
        # Other inputs, though such as there are: numbers of anchors are checked before a run.
        return np.where(np.expand_dims(hidden, tuple(range(1, x.ndim - 1))), x[::-1], x)

    dirty = ran.batch._replace(
        dt=filled(ran.batch.dt),
        readings=jax.tree_util.tree_map(filled, ran.batch.readings),
        inputs=jax.tree_util.tree_map(reversed_in_time, ran.batch.inputs),
    )
    estimates = ran.run(dirty)
    fix = "usual fix: jnp.where(row.valid, after, before) for all that is carried, and sums weighed by batch.valid"
    for k, recording in enumerate(ran.recordings):
        what = "a number in rows of padding, which follow a recording's end,"
        ran.require_same(estimates[k], k, what, fix, slice(len(recording)))
    if not np.all(estimates.status[hidden.T] == Status.PADDING):
        raise BrokenContract(
            f"rows of padding have the status {estimates.status[hidden.T].min()}, expected Status.PADDING; {fix}"
        )
    if isinstance(ran.tracker, Tracker):
        for k, recording in enumerate(ran.recordings):
            last = leaves(ran.estimates[k], slice(len(recording) - 1, len(recording)))
            for name, x in leaves(ran.estimates[k], slice(len(recording), None)).items():
                if name.startswith(("mean", "cov_upper")) and not np.all(x == last[name]):
                    raise BrokenContract(
                        f"{name} of recording {k} changes in rows of padding, expected that of its last row; {fix}"
                    )


def _check_later_rows(ran: Ran, causal: bool) -> None:
    if not causal:
        raise NotApplicable("a smoothed estimate depends on later rows")
    rng = np.random.default_rng(0)
    ends = [int(rng.integers(max(len(r) // 8, 1), max(len(r) // 2, 2))) for r in ran.recordings]
    shorter = ran.run(ran.stacked([cut(r, 0, end) for r, end in zip(ran.recordings, ends, strict=True)]))
    fix = "usual fix: no operation over the axis of rows, or causal=False for a smoother"
    for k, end in enumerate(ends):
        ran.require_same(shorter[k], k, "leaving out later rows", fix, slice(end))


ALONE = "usual fix: no mean, maximum or sort over the last axis, that of trajectories"


def _check_number(ran: Ran) -> None:
    fewer = ran.run(ran.stacked(ran.recordings[: FEWEST - 1]))
    for k in range(FEWEST - 1):
        ran.require_same(fewer[k], k, f"leaving out all recordings but the first {FEWEST - 1}", ALONE)


def _check_order(ran: Ran) -> None:
    order = np.random.default_rng(1).permutation(len(ran.recordings))
    shuffled = ran.run(ran.stacked([ran.recordings[k] for k in order]))
    for column, k in enumerate(order):
        ran.require_same(shuffled[column], int(k), f"the order {order.tolist()} of the recordings", ALONE)


def _check_company(ran: Ran) -> None:
    rng = np.random.default_rng(2)
    for garbage in (1e30, -1e30, None):

        def spoilt(reading: Reading, garbage: float | None = garbage) -> Reading:
            values, seen = reading.values.copy(), reading.seen.copy()
            values[..., SPOILT] = rng.normal(size=values.shape[:-1]) * 1e3 if garbage is None else garbage
            seen[..., SPOILT] = True
            return reading._replace(values=values, seen=seen)

        estimates = ran.run(ran.changed(spoilt))
        words = "at random" if garbage is None else f"of {garbage:g}"
        for k in range(len(ran.recordings)):
            if k != SPOILT:
                ran.require_same(estimates[k], k, f"a reading {words} in recording {SPOILT}", ALONE)
        if difference(estimates[SPOILT], ran.estimates[SPOILT], EVERY, EVERY) is None:
            raise BrokenContract(
                f"readings {words} in recording {SPOILT} change nothing of its own estimates, expected others; usual "
                "fix: read the readings of the batch by the names of the sensors"
            )


def _check_hidden(ran: Ran) -> None:
    if shown := unhidden(ran.recordings):
        raise NotApplicable(f"a channel of {listed(shown)} is seen in every row, so that no value of it is hidden")
    for hidden in (1e30, -7.0):

        def filled(reading: Reading, hidden: float = hidden) -> Reading:
            return reading._replace(values=np.where(reading.seen, reading.values, hidden))

        estimates = ran.run(ran.changed(filled))
        for k in range(len(ran.recordings)):
            ran.require_same(
                estimates[k],
                k,
                f"the value {hidden:g} of a channel that is not seen",
                "usual fix: jnp.where(seen, …, 0.0) in the sensor's residual and in the start's candidate",
            )


class _Pieces:
    """Recordings in pieces at random rows of their own, and one more that is never cut: it keeps all runs at one shape.

    Ids, which random numbers depend on, are those of the whole recordings.
    """

    def __init__(self, recordings: Sequence[Recording], whole: Recording) -> None:
        self.recordings, self.whole = recordings, whole
        rng = np.random.default_rng(0)
        inner = [np.sort(rng.choice(np.arange(1, len(r)), CUTS, replace=False)) for r in recordings]
        self.ends = [[0, *(int(k) for k in rows), len(r)] for r, rows in zip(recordings, inner, strict=True)]

    def piece(self, j: int) -> list[Recording]:
        """The j-th piece of each."""
        parts = [replace(cut(r, e[j], e[j + 1]), id=r.id) for r, e in zip(self.recordings, self.ends, strict=True)]
        return [*parts, replace(self.whole, times=self.whole.times + 1000.0 * j)]


def _check_resume(ran: Ran, causal: bool) -> str:
    if not causal:
        raise NotApplicable("a smoothed estimate depends on later rows, also across a cut")
    *others, longest = ran.recordings
    pieces, state = _Pieces([r for r in others if len(r) > CUTS], longest), None
    if not pieces.recordings:
        raise NotApplicable(f"no recording but the longest has more than {CUTS} rows, to be cut {CUTS} times")
    for j in range(CUTS + 1):
        run = ran.tracker.run(pieces.piece(j), initial=state)
        state = run.final
        for k, (recording, ends) in enumerate(zip(pieces.recordings, pieces.ends, strict=True)):
            there = slice(ends[j], ends[j + 1])
            found = difference(run[k], ran.estimates[recording.id], slice(there.stop - there.start), there)
            if found is not None:
                raise BrokenContract(
                    f"a run of recording {recording.id} that continues another from row {ends[j]} on changes {found}, "
                    "expected the bits of one run; usual fix: all that later rows need is in the state that `scan` "
                    "returns and takes as `initial`, also sums, windows and counts of rows"
                )
    return f"the same bits in {CUTS + 1} pieces"


def _check_one_program(ran: Ran) -> str:
    moved = {n: eqx.tree_at(lambda x: x.raw, node, node.raw + 0.05) for n, node in tunables(ran.tracker).items()}
    before, traced = ran.estimates, []

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        # Tracing comes before compiling, also of what the cache of an earlier process has.
        if event.endswith("jaxpr_trace_duration"):
            traced.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        ran.run(ran.batch, replaced(ran.tracker, moved))
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    if traced:
        raise BrokenContract(
            f"a second run with other numbers traces {len(traced)} programs anew, expected none; usual fix: numbers of "
            "a tracker are Scale, Real or arrays, no static fields, and its functions are not made anew for each run"
        )

    def changes(name: str) -> bool:
        after = ran.run(ran.batch, replaced(ran.tracker, {name: moved[name]}))
        return any(difference(after[k], before[k], EVERY, EVERY) is not None for k in range(len(ran.recordings)))

    # No fault by itself: limits of track loss change nothing where no track is lost.
    idle = [name for name in moved if not changes(name)]
    return f"{len(moved)} tunables" + (f"; no estimate depends on {', '.join(idle)}" if idle else "")
