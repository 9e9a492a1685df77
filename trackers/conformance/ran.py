"""A tracker with recordings of every kind that the identities need, and how its estimates differ from others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import jax
import numpy as np

from trackwright.trackers.conformance.contract import BrokenContract
from trackwright.trackers.core.data.estimates import Estimates, Status
from trackwright.trackers.core.data.recording import Batch, Readings, Recording, stack
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.state import path_name
from trackwright.trackers.core.run.chunks import CHUNK, batch_estimates
from trackwright.trackers.core.run.requirements import check_input
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.trajectories import cut

ROWS, FEWEST, MOST = 64, 6, 8
"""Rows to which recordings are cut, and how many there are at least and at most: batches of 5 to 8 have one program."""

FIELDS = ("mean", "cov_upper", "log_likelihood", "nis", "nis_dof", "wrapped", "status")
"""The arrays of estimates that identities compare."""


class Ran:
    """A tracker and its estimates of recordings, all of one shape so that runs share one compiled program.

    The recordings have missing readings of each channel, and lengths that differ: where the given ones do not, readings
    are hidden at random and ends are cut off. The last is the longest.
    """

    def __init__(self, tracker: AbstractTracker, recordings: Sequence[Recording]) -> None:
        self.tracker = tracker
        whole = [cut(r, 0, min(ROWS, len(r))) for r in recordings[:MOST]]
        more = [whole[k % len(whole)] for k in range(len(whole), FEWEST)]
        varied = [*whole, *(_thinned(r, k) for k, r in enumerate(more))]
        if len({len(r) for r in varied}) == 1:
            varied[-1] = cut(varied[-1], 0, max(len(varied[-1]) * 2 // 3, 1))
        if unhidden(varied):
            varied[1:] = [_thinned(r, k) for k, r in enumerate(varied[1:])]
        longest = max(range(len(varied)), key=lambda k: len(varied[k]))
        varied.append(varied.pop(longest))
        self.recordings = [replace(r, id=k) for k, r in enumerate(varied)]
        self.rows = len(self.recordings[-1])

    def stacked(self, recordings: Sequence[Recording]) -> Batch:
        """Recordings as a batch of this number of rows."""
        return stack(recordings, rows=self.rows)

    @cached_property
    def batch(self) -> Batch:
        """All recordings."""
        return self.stacked(self.recordings)

    @cached_property
    def estimates(self) -> Estimates:
        """The estimates of all recordings; raises UnusableInput where they lack what the tracker reads."""
        check_input(self.tracker, self.recordings, "check_tracker")
        return self.run(self.batch)

    def run(self, batch: Batch, tracker: AbstractTracker | None = None) -> Estimates:
        """The estimates of a batch by this tracker or another, with the program of `run` for recordings."""
        return batch_estimates(tracker or self.tracker, batch, CHUNK, continues=True)

    def changed(self, change: Callable[[Reading], Reading]) -> Batch:
        """The batch with each reading changed by a function of it."""
        return self.batch._replace(readings={name: change(r) for name, r in self.batch.readings.items()})

    def require_same(self, mine: Estimates, number: int, what: str, fix: str, rows: slice = slice(None)) -> None:
        """Raises unless estimates of recording `number` have the bits of the one run, in these of its rows.

        `what`: the change that changes no bit, in words.
        """
        found = difference(mine, self.estimates[number], rows, rows)
        if found is not None:
            raise BrokenContract(f"{what} changes {found} of recording {number}, expected the same bits; {fix}")


def unhidden(recordings: Sequence[Recording]) -> list[str]:
    """The names of readings of which a channel is seen in every row of all recordings."""
    names = dict.fromkeys(name for one in recordings for name in one.readings)
    seen = {name: [one.readings[name].seen for one in recordings if name in one.readings] for name in names}
    return [name for name, parts in seen.items() if np.concatenate(parts).all(axis=0).any()]


def _thinned(recording: Recording, seed: int) -> Recording:
    """The recording with one reading in ten hidden, and without its last rows."""
    rng = np.random.default_rng(seed)
    part = cut(recording, 0, max(len(recording) - 3 * seed, 1))
    readings = {
        name: Readings(r.values, r.seen & (rng.random(np.shape(r.seen)) > 0.1), r.reported)
        for name, r in part.readings.items()
    }
    return replace(part, readings=readings)


def leaves(estimates: Estimates, rows: slice = slice(None)) -> dict[str, np.ndarray]:
    """The arrays of estimates by name, in some rows."""
    tree = {field: getattr(estimates, field) for field in FIELDS}
    return {path_name(path): np.asarray(x)[..., rows] for path, x in jax.tree_util.tree_flatten_with_path(tree)[0]}


def difference(mine: Estimates, other: Estimates, rows: slice, other_rows: slice) -> str | None:
    """The first array and row in which estimates of one recording differ, by how much, in words; None for the same."""
    others = leaves(other, other_rows)
    for name, a in leaves(mine, rows).items():
        b = others[name]
        if not np.array_equal(a, b, equal_nan=True):
            apart = ~((a == b) | (np.isnan(a) & np.isnan(b)))
            row = int(np.argwhere(apart)[0][-1])
            size = np.nanmax(np.abs(np.where(apart, a.astype(float) - b.astype(float), 0.0)))
            return f"{name.removeprefix('mean.')} in row {row} by up to {size:.2g}"
    return None


def draws_random_numbers(ran: Ran) -> bool:
    """Whether another seed gives other estimates."""
    other = ran.run(ran.batch._replace(key=np.asarray(ran.batch.key)[::-1].copy()))
    everything = slice(None)
    return difference(other, ran.estimates, everything, everything) is not None


def share_estimated(ran: Ran) -> float:
    """The share of the rows of recordings with a running track."""
    return float(np.mean(ran.estimates.status[ran.batch.valid.T] == Status.OK))
