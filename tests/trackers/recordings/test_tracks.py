"""The table of estimates where several rows share a time: one line per time, which holds all of its rows."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.core.data.estimates import STEP_COLUMNS, Estimates, Status
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import Placed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder

PLACES = [(0, 0, 3), (8, 0, 2.5), (8, 6, 3), (0, 6, 2.5), (4, 0, 0.3), (8, 3, 0.5), (4, 6, 0.4), (0, 3, 0.2)]
ANCHORS = {str(k): np.array(p, float) for k, p in enumerate(PLACES)}


def _ranges(times, noise, tags=("a",), seed=0):
    """A folder of tags on circles with a range to every anchor at each time; `noise`: m, by anchor."""
    rng, names = np.random.default_rng(seed), list(ANCHORS)[: len(noise)]
    ranges, truths = [], []
    for number, tag in enumerate(tags):
        turn = 0.3 * times + number
        path = np.stack([4 + 2 * np.cos(turn), 3 + 1.5 * np.sin(turn), 1.2 + 0 * times], axis=1)
        truths.append(pl.DataFrame({"t_s": times, "tag": tag} | {f"{a}_m": path[:, k] for k, a in enumerate("xyz")}))
        distances = np.linalg.norm(path[:, None] - np.stack([ANCHORS[a] for a in names]), axis=-1)
        measured = distances + rng.normal(size=distances.shape) * noise
        columns = {"t_s": np.repeat(times, len(names)), "anchor": names * len(times), "range_m": measured.ravel()}
        ranges.append(pl.DataFrame(columns).with_columns(tag=pl.lit(tag), range_std_m=pl.lit(None, pl.Float64)))
    rig = Rig("hall", anchors={name: ANCHORS[name] for name in names})
    return RecordingFolder("hall", None, rig, {"ranges": pl.concat(ranges), "truth": pl.concat(truths)})


def _all_rows(tracker, folder):
    """The estimates of every row, of all tags one after the other."""
    runs = [b.tracker.run(trajectory.recording) for b in tracker.batches(folder) for trajectory in b.trajectories]
    return [np.concatenate([getattr(run, name) for run in runs]).astype(float) for name in (*STEP_COLUMNS, "wrapped")]


@pytest.mark.slow
def test_a_line_holds_the_sums_over_all_rows_of_its_time():
    # Four anchors at one time, one of them 12 times as noisy and never the last row of its time; two tags.
    one_noisy = _ranges(np.arange(60) * 0.1, np.array([0.05, 0.6, 0.05, 0.05]), tags=("a", "b"))
    tracker = tw.build("uwb", one_noisy)
    table = tracker.run(one_noisy).table
    assert table.height == 2 * 60
    sums = [x.sum() for x in _all_rows(tracker, one_noisy)]
    # Sums of 480 numbers in another order.
    assert [table[name].sum() for name in STEP_COLUMNS] == pytest.approx(sums[:3], rel=1e-12)
    # Every range but those before the start of the track.
    assert 4 * 2 * 57 <= table["nis_dof"].sum() <= 4 * 2 * 60


@pytest.mark.slow
def test_a_track_lost_and_restarted_within_one_time_is_told_by_its_line():
    times = np.concatenate([np.arange(150) * 0.1, 75 + np.arange(150) * 0.1])
    folder = _ranges(times, np.full(8, 0.05))
    tracker = tw.build("uwb", folder)
    tracks = tracker.run(folder)
    (trajectory,) = tracker.batches(folder)[0].trajectories
    status = tracker.batches(folder)[0].tracker.run(trajectory.recording).status
    after = trajectory.recording.times == 75.0
    # All ranges of the first time after the silence place the start in its first row; the others are updates.
    assert [Status(s) for s in status[after]] == [Status.RESTARTED] + [Status.OK] * (after.sum() - 1)
    assert tracks.table.filter(pl.col("status") != "ok").select("t_s", "status").rows() == [(75.0, "restarted")]
    assert tracks.summaries == {"lost and re-started": 1}


OK, WAITING, RESTARTED, LOST, BAD, PADDING = (
    Status.OK, Status.WAITING, Status.RESTARTED, Status.LOST, Status.NON_FINITE, Status.PADDING
)  # fmt: skip


@pytest.mark.parametrize(
    ("rows", "line"),
    [
        ((WAITING, OK, OK), OK),
        ((WAITING, WAITING), WAITING),
        ((OK, LOST, RESTARTED, OK), RESTARTED),
        ((OK, RESTARTED), RESTARTED),
        ((RESTARTED, OK, RESTARTED, OK), RESTARTED),
        ((RESTARTED, OK, LOST), LOST),
        ((OK, LOST, LOST), LOST),
        ((OK, BAD, RESTARTED, OK), BAD),
        ((BAD, LOST), BAD),
        # Without a filter each row stands alone: the line has the last row's estimate, so also its status.
        ((OK, WAITING), WAITING),
    ],
)
def test_the_status_of_a_line_is_the_worst_that_happened_and_still_holds(rows, line):
    times = np.array([0.0, *[1.0] * len(rows), 2.0, 2.0, np.nan])
    status = np.array([OK, *rows, OK, OK, PADDING], np.int8)
    number = np.arange(len(status), dtype=float)
    steps = [number, number, np.ones_like(number), number, status]
    estimates = Estimates(Placed(Vector(number)), number[None], *steps, times, ("a",))
    last, merged = estimates.per_time()
    assert np.flatnonzero(last).tolist() == [0, len(rows), len(rows) + 2]
    assert [Status(s) for s in merged.status] == [OK, line, OK]
    assert merged.times.tolist() == [0.0, 1.0, 2.0]
    np.testing.assert_array_equal(merged.mean.position.parts[0], number[last])
    np.testing.assert_array_equal(merged.cov_upper[0], number[last])
    within = number[1 : len(rows) + 1].sum()
    for name in ("log_likelihood", "nis", "wrapped"):
        assert getattr(merged, name)[1] == within
    assert merged.nis_dof.tolist() == [1.0, len(rows), 2.0]
