"""System C without an inertial sensor on the command line: trackers of ranges, and their trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
import polars as pl

from trackers.core.recording import Readings
from trackers.parts.range_rows import anchor_positions, range_rows, range_trajectories
from trackers.parts.ranges import RANGES
from trackers.recordings.columns import by_tag
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerSpec, on_request
from trackers.recordings.trajectories import Trajectory, known_height, trajectory_of
from trackers.recordings.truth import truth_by_tag
from trackers.uwb_imu.fusion import range_tracker
from trackers.uwb_imu.multilateration import multilateration_tracker
from trackers.uwb_imu.trilateration import trilateration_tracker

WINDOWS = (0.1, 0.25, 0.5, 1.0)
"""Seconds over which ranges count as being of the moment."""

THIN = 1e-2
"""Width over length, seen from above, below which anchors stand on one line."""

FARTHEST = 20.0
"""Times the anchors' extent that the middle range may be."""


def snapshot_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's ranges, one row a time, with the latest range of every anchor in a slot of its own."""
    for tag, times, latest, fresh, inputs in _snapshots(folder, free_height):
        yield trajectory_of(folder, tag, "", times, {RANGES: Readings(latest, fresh)}, inputs, truth_by_tag(folder))


def triple_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """As `snapshot_lanes`, with the three anchors of each row that span the largest triangle, for trilateration."""
    anchors = anchor_positions(folder)
    triples = np.array(list(combinations(range(len(anchors)), 3)))
    legs = anchors[triples][:, 1:, :2] - anchors[triples][:, :1, :2]
    areas = np.abs(legs[:, 0, 0] * legs[:, 1, 1] - legs[:, 0, 1] * legs[:, 1, 0])
    for tag, times, latest, fresh, inputs in _snapshots(folder, free_height):
        patterns, which = np.unique(fresh, axis=0, return_inverse=True)
        whole = patterns[:, triples].all(axis=2)
        best = triples[np.argmax(np.where(whole, areas, -1.0), axis=1)][which.ravel()]
        values, seen = (np.take_along_axis(x, best, axis=1) for x in (latest, fresh))
        inputs = {**inputs, "anchors": anchors[best].reshape(len(times), 9)}
        yield trajectory_of(folder, tag, "", times, {RANGES: Readings(values, seen)}, inputs, truth_by_tag(folder))


def _snapshots(
    folder: RecordingFolder, free_height: bool
) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]]:
    """Per tag: its times (t,), the latest range of each anchor then (t, A), whether it is fresh, and the inputs."""
    anchors = anchor_positions(folder)
    for tag, table in by_tag(folder.tables["ranges"]):
        known = not free_height and known_height(folder, tag) is not None
        readings, inputs = range_rows(folder, tag, table, free_height)
        rows, number = table["t_s"].to_numpy(), inputs["anchor"][:, 0]
        times = np.unique(rows)
        latest, age = np.zeros((len(times), len(anchors))), np.full((len(times), len(anchors)), np.inf)
        for k in range(len(anchors)):
            mine = np.flatnonzero((number == k) & readings.seen[:, 0])
            if len(mine):
                last = np.searchsorted(rows[mine], times, side="right") - 1
                heard = mine[np.maximum(last, 0)]
                latest[:, k] = readings.values[heard, 0]
                age[:, k] = np.where(last >= 0, times - rows[heard], np.inf)
        fresh = age <= _window(age, 3 if known else 4)
        yield tag, times, np.where(fresh, latest, 0.0), fresh, {"anchors": np.tile(anchors.ravel(), (len(times), 1))}


def _window(age: np.ndarray, least: int) -> float:
    """The shortest of the `WINDOWS` in which at least half of the times hold `least` anchors."""
    enough = [w for w in WINDOWS if np.mean(np.sum(age <= w, axis=1) >= least) >= 0.5]
    return enough[0] if enough else WINDOWS[-1]


def lacks_ranges(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker of ranges: enough anchors that span a plane, and plausible metres."""
    if "ranges" not in folder.tables:
        return "a ranges table with at least 3 anchors, found no such table"
    table = folder.tables["ranges"].filter(pl.col("range_m") > 0)
    heard = {tag: part["anchor"].unique().to_list() for tag, part in by_tag(table)}
    needed = {tag: 4 if known_height(folder, tag) is None else 3 for tag in heard}
    if not any(len(heard[tag]) >= needed[tag] for tag in heard):
        most = max(map(len, heard.values()), default=0)
        return (
            f"positive ranges from a tag to at least 3 anchors, or 4 where rig.toml gives it no height_m, found {most} "
            "at most"
        )
    places = np.stack([np.asarray(folder.rig.anchors[a], float) for a in sorted(set().union(*heard.values()))])
    sizes = np.linalg.svd(places[:, :2] - places[:, :2].mean(axis=0), compute_uv=False)
    if sizes[1] < THIN * sizes[0]:
        return f"anchors that span a plane, found all {len(places)} that are heard on one line seen from above"
    middle, extent = float(table["range_m"].median()), float(np.ptp(places, axis=0).max())  # type: ignore[arg-type]
    if middle > FARTHEST * extent:
        return (
            f"ranges in metres, found a median of {middle:.4g} among anchors {extent:.4g} m apart; "
            "are they in centimetres or millimetres?"
        )
    return None


def _lacks_known_height(folder: RecordingFolder) -> str | None:
    """What a folder lacks for trilateration."""
    lacking = lacks_ranges(folder)
    if lacking is not None:
        return lacking
    free = sorted(tag for tag in folder.tables["ranges"]["tag"].unique() if known_height(folder, tag) is None)
    return f"height_m in rig.toml for every tag, found none for {', '.join(free)}" if free else None


def _biases(trajectory: Trajectory) -> int:
    """How many biases the tracker of a trajectory has: whole eights, so that installations share a tracker."""
    return -(-len(trajectory.folder.rig.anchors) // 8) * 8


TRACKERS = {
    "uwb": TrackerSpec(
        "position from ranges, with a drifting bias per anchor",
        table="ranges",
        trajectories=range_trajectories,
        build=lambda trajectory, planar: range_tracker(_biases(trajectory), planar),
        lacks=lacks_ranges,
        geometry=_biases,
    ),
    "multilateration": TrackerSpec(
        "position from the ranges of the moment, robust least squares: a baseline",
        table="ranges",
        trajectories=snapshot_trajectories,
        build=lambda trajectory, planar: multilateration_tracker(planar),
        lacks=lacks_ranges,
        geometry=lambda trajectory: len(trajectory.folder.rig.anchors),
        automatic=on_request,
    ),
    "trilateration": TrackerSpec(
        "position from three ranges, by circles and without the paper's (14)",
        table="ranges",
        trajectories=triple_trajectories,
        build=lambda trajectory, planar: trilateration_tracker(compensated=False),
        lacks=_lacks_known_height,
        planar=lambda trajectory, free_height: True,
        automatic=on_request,
    ),
    "trilateration-compensated": TrackerSpec(
        "position from three ranges, by circles, each range lengthened by (14): the paper's",
        table="ranges",
        trajectories=triple_trajectories,
        build=lambda trajectory, planar: trilateration_tracker(compensated=True),
        lacks=_lacks_known_height,
        planar=lambda trajectory, free_height: True,
        automatic=on_request,
    ),
}
