"""Trajectories of trackers of ranges, and how each is built: tables `ranges`, `imu` and `odometry`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.data.recording import Columns, Readings
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.inputs import HEIGHT_LIMITS
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.parts.range_rows import (
    CARRIER,
    anchor_positions,
    lacks_a_plane,
    range_inputs,
    range_rows,
    range_trajectories,
    room_of_anchors,
)
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.parts.recent_positions import latest_rows
from trackwright.trackers.recordings.columns import QUATERNION, TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracker_spec import TrackerSpec
from trackwright.trackers.recordings.trajectories import (
    Trajectories,
    Trajectory,
    known_height,
    known_heights,
    trajectories_of,
)
from trackwright.trackers.uwb_imu.body import LASTS, ODOMETRY, Wheels, body_tracker, odometry_inputs
from trackwright.trackers.uwb_imu.difference_rows import difference_trajectories, lacks_differences
from trackwright.trackers.uwb_imu.differences import TDOA, difference_tracker
from trackwright.trackers.uwb_imu.fusion import range_levels, range_tracker
from trackwright.trackers.uwb_imu.inertial import inertial_difference_tracker, inertial_tracker
from trackwright.trackers.uwb_imu.multilateration import multilateration_tracker
from trackwright.trackers.uwb_imu.rows_between import imu_inputs, tilting_tags, to_level_axes, with_rows_between
from trackwright.trackers.uwb_imu.strapdown import ARM
from trackwright.trackers.uwb_imu.trilateration import trilateration_tracker

GRAVITY = 9.81
"""m/s²."""

MIN_ANCHORS = 3
"""Least number of anchors for the tracker of ranges and an IMU."""

WINDOWS = (0.1, 0.25, 0.5, 1.0)
"""Candidate times, s, for which a range stays valid in a snapshot of the latest ranges."""

MAX_RANGE_RATIO = 20.0
"""Largest plausible median range, as a multiple of the anchors' extent."""


def inertial_trajectories(folder: RecordingFolder, free_height: bool) -> Iterable[Trajectory]:
    """Each tag's ranges, one per row, and further rows at the times of the IMU's samples.

    The IMU is at the origin of a tag's body: the trajectory of each has the ranges of all tags on it, with their lever
    arms from its own tag.
    """
    rows = folder.rows("ranges")
    bodies = {tag: _tags_on_body(folder, tag, free_height) for tag in sorted(rows.tags)}
    shared = {tag: body for tag, body in bodies.items() if len(body) > 1}
    single = [tag for tag in bodies if tag not in shared]
    alone = _ranges_with_imu(folder, rows, {tag: [tag] for tag in single}, free_height) if single else []
    if not shared:
        return alone
    together = _ranges_with_imu(folder, _ranges_of_bodies(folder, shared), shared, free_height)
    return sorted([*alone, *together], key=lambda trajectory: trajectory.tag) if alone else together


def inertial_difference_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's range differences, one row per message, and further rows at the times of the IMU's samples.

    The IMU may be another tag's on the body; the differences are the tag's alone.
    """
    alone = difference_trajectories(folder, free_height)
    bodies = {tag: _tags_on_body(folder, tag, free_height) for tag in alone.tags}
    return _with_imu(folder, alone.tags, alone.columns, bodies, alone.columns.readings, alone.columns.inputs)


def body_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Of each tag on a body the ranges of all tags on it, one per row, with their lever arms from that tag.

    A tag without ranges is a place on the body, such as a tool's tip. Where the wheels of a body are measured, there
    are further rows at the times of their readings.
    """
    rows = _ranges_by_body(folder)
    readings, number = range_rows(folder, rows)
    heights = np.full(len(rows.tags), np.nan) if free_height else known_heights(folder, rows.tags)
    inputs = range_inputs(rows.starts, rows.times, readings, number, anchor_positions(folder), heights, folder.rig)
    inputs |= {"levers": _levers(folder, rows, upright=True)}
    if ODOMETRY.name not in folder.tables:
        inputs |= room_of_anchors(folder, len(number))
        return trajectories_of(folder, rows.tags, rows.starts, rows.times, {RANGES: readings}, inputs)
    wheels, bodies = folder.rows(ODOMETRY.name), _bodies(folder)
    measured, at = wheels.floats(["speed_mps", "yaw_rate_radps"]), _of_bodies(wheels, bodies)
    merged = with_rows_between(rows.tags, rows, {tag: wheels.times[at[tag]] for tag in rows.tags})
    held = [
        odometry_inputs(merged.times[first:end], wheels.times[at[tag]], measured[at[tag]])
        for tag, (first, end) in zip(rows.tags, pairwise(merged.starts), strict=True)
    ]
    further = {ODOMETRY.name: np.concatenate(held), ARM.name: _arms(folder, rows.tags, merged.starts)}
    return merged.trajectories(folder, rows.tags, {RANGES: readings}, inputs, further)


def _bodies(folder: RecordingFolder) -> dict[str, tuple[str, ...]]:
    """The tags on the body of each tag that is on one with others, or on one whose wheels are measured."""
    driven = set(folder.rows(ODOMETRY.name).tags) if ODOMETRY.name in folder.tables else set[str]()
    bodies = {tag: folder.rig.on_body_of(tag) or (tag,) for tag in sorted({*folder.rig.tags, *driven})}
    return {tag: body for tag, body in bodies.items() if len(body) > 1 or driven & {*body}}


def _of_bodies(rows: TagRows, bodies: Mapping[str, Sequence[str]]) -> dict[str, slice]:
    """The rows of an IMU or of wheels by the tag of each body, none where no tag on it has any."""
    at = {tag: slice(*rows.starts[k : k + 2]) for k, tag in enumerate(rows.tags)}
    return {tag: next((at[other] for other in body if other in at), slice(0)) for tag, body in bodies.items()}


def _arms(folder: RecordingFolder, tags: Sequence[str], starts: np.ndarray) -> np.ndarray:
    """The input `arm` (N, 3), m, of the rows of tags."""
    return np.repeat(np.stack([_offset(folder, tag) for tag in tags]), np.diff(starts), axis=0)


def _tags_on_bodies(folder: RecordingFolder) -> list[str]:
    """The tags of `_bodies`, by their ids."""
    return list(_bodies(folder))


def _ranges_by_body(folder: RecordingFolder) -> TagRows:
    """As `_ranges_of_bodies`, of all tags on bodies."""
    return _ranges_of_bodies(folder, _bodies(folder))


def _ranges_of_bodies(folder: RecordingFolder, bodies: Mapping[str, Sequence[str]]) -> TagRows:
    """The ranges of all tags on the body of each tag, of which the column `carrier` holds the one ranged to."""
    table = folder.tables["ranges"].with_columns(pl.col("tag").cast(pl.String))
    return TagRows(
        pl.concat(
            table.filter(pl.col("tag").is_in(body)).with_columns(pl.col("tag").alias(CARRIER), tag=pl.lit(tag))
            for tag, body in sorted(bodies.items())
        )
    )


def _levers(folder: RecordingFolder, rows: TagRows, upright: bool = False) -> np.ndarray:
    """The lever arms (N, 3), m, from each row's tag to its carrier.

    Of a body that is `upright`, to where the ranges of the carrier end, which a calibration has ahead and to the left.
    """
    carriers = _tags_on_bodies(folder)
    ends = np.stack([_offset(folder, carrier) for carrier in carriers])
    if upright and folder.calibration is not None:
        known = folder.calibration.tags
        ends[:, :2] += [known[carrier].offset if carrier in known else (0.0, 0.0) for carrier in carriers]
    places = np.stack([_offset(folder, tag) for tag in rows.tags])
    return np.asarray(ends[rows.codes(CARRIER, carriers)] - rows.of_each(places))


def _ranges_with_imu(
    folder: RecordingFolder, rows: TagRows, bodies: Mapping[str, Sequence[str]], free_height: bool
) -> Trajectories:
    """The trajectories of the tags in `bodies`, which holds the tags on the body of each; `rows`: ranges by body."""
    readings, number = range_rows(folder, rows)
    heights = np.full(len(rows.tags), np.nan) if free_height else known_heights(folder, rows.tags)
    inputs = range_inputs(rows.starts, rows.times, readings, number, anchor_positions(folder), heights, folder.rig)
    if any(len(body) > 1 for body in bodies.values()):
        inputs["levers"] = _levers(folder, rows)
    return _with_imu(folder, rows.tags, rows, bodies, {RANGES: readings}, inputs)


def _with_imu(
    folder: RecordingFolder,
    tags: Sequence[str],
    rows: TagRows | Columns,
    bodies: Mapping[str, Sequence[str]],
    readings: Mapping[str, Readings],
    inputs: Mapping[str, np.ndarray],
) -> Trajectories:
    """The trajectories of the tags in `bodies`, with the IMU of the body, from the `rows` of `tags`."""
    samples = folder.rows("imu")
    accel, gyro = _imu_samples(samples)
    at = _of_bodies(samples, bodies)
    merged = with_rows_between(tags, rows, {tag: samples.times[at[tag]] for tag in bodies})
    of_tags = [
        imu_inputs(merged.times[first:end], samples.times[at[tag]], accel[at[tag]], gyro[at[tag]])
        for tag, (first, end) in zip(bodies, pairwise(merged.starts), strict=True)
    ]
    further = {name: np.concatenate([of_tag[name] for of_tag in of_tags]) for name in of_tags[0]}
    further[ARM.name] = _arms(folder, list(bodies), merged.starts)
    return merged.trajectories(folder, list(bodies), readings, inputs, further)


def _tags_on_body(folder: RecordingFolder, tag: str, free_height: bool) -> list[str]:
    """The tags on the same body, the tag itself first; the tag alone if its state is planar."""
    planar = known_height(folder, tag) is not None and not free_height
    return [tag] if planar else [tag, *(other for other in folder.rig.on_body_of(tag) if other != tag)]


def _offset(folder: RecordingFolder, tag: str) -> np.ndarray:
    known = folder.rig.tags.get(tag)
    return np.zeros(3) if known is None or known.offset is None else np.asarray(known.offset, float)


def _imu_samples(rows: TagRows) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations, m/s², and turning rates, rad/s (N, 3), NaN where missing."""
    accel, gyro = (
        rows.floats([f"{kind}_{axis}_{unit}" for axis in "xyz"])
        for kind, unit in (("accel", "mps2"), ("gyro", "radps"))
    )
    if QUATERNION[0] not in rows:
        return accel, gyro
    return to_level_axes(accel, rows.floats(QUATERNION), GRAVITY)


class Snapshots(NamedTuple):
    """The times of all tags, and at each every anchor's latest range.

    `starts` (n + 1,): the first of the N times of each tag, then N. `times` (N,) s. `latest` (N, A): ranges, m, zero
    unless `fresh` (N, A), recent enough.
    """

    rows: TagRows
    starts: np.ndarray
    times: np.ndarray
    latest: np.ndarray
    fresh: np.ndarray


def snapshot_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's ranges, one row per time, with the latest range of every anchor in a slot of its own."""
    snapshots = _snapshots(folder, free_height)
    rows = {"anchors": anchor_positions(folder).ravel(), HEIGHT_LIMITS.name: folder.rig.height_limits()}
    inputs = {name: np.tile(row, (len(snapshots.times), 1)) for name, row in rows.items()}
    readings = {RANGES: Readings(snapshots.latest, snapshots.fresh)}
    return trajectories_of(folder, snapshots.rows.tags, snapshots.starts, snapshots.times, readings, inputs)


def triple_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """As `snapshot_trajectories`, with the three anchors of each row that span the largest triangle."""
    anchors, snapshots = anchor_positions(folder), _snapshots(folder, free_height)
    triples = np.array(list(combinations(range(len(anchors)), 3)))
    legs = anchors[triples][:, 1:, :2] - anchors[triples][:, :1, :2]
    areas = np.abs(legs[:, 0, 0] * legs[:, 1, 1] - legs[:, 0, 1] * legs[:, 1, 0])
    patterns, which = np.unique(snapshots.fresh, axis=0, return_inverse=True)
    complete = patterns[:, triples].all(axis=2)
    best = triples[np.argmax(np.where(complete, areas, -1.0), axis=1)][which.ravel()]
    values, seen = (np.take_along_axis(x, best, axis=1) for x in (snapshots.latest, snapshots.fresh))
    inputs = {"anchors": anchors[best].reshape(len(snapshots.times), 9)}
    return trajectories_of(
        folder, snapshots.rows.tags, snapshots.starts, snapshots.times, {RANGES: Readings(values, seen)}, inputs
    )


def _snapshots(folder: RecordingFolder, free_height: bool) -> Snapshots:
    """The latest ranges of all tags at each of their times."""
    rows = folder.rows("ranges")
    readings, number = range_rows(folder, rows)
    latest = latest_rows(rows.starts, number, readings.seen[:, 0], len(folder.rig.anchors))
    # The last row of each time of a tag.
    last = np.append(np.diff(rows.times) != 0, True)
    last[rows.starts[1:] - 1] = True
    times, latest = rows.times[last], latest[last]
    starts = np.concatenate([[0], np.cumsum(last)[rows.starts[1:] - 1]])
    age = np.where(latest >= 0, times[:, None] - rows.times[latest], np.inf)
    heights = np.full(len(rows.tags), np.nan) if free_height else known_heights(folder, rows.tags)
    windows = _snapshot_windows(starts, age, np.where(np.isnan(heights), 4, 3))
    fresh = age <= np.repeat(windows, np.diff(starts))[:, None]
    return Snapshots(rows, starts, times, np.where(fresh, readings.values[latest, 0], 0.0), fresh)


def _snapshot_windows(starts: np.ndarray, age: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Of each tag (n,): the shortest of the `WINDOWS`, s, in which half of its times have at least `least` anchors."""
    windows = np.full(len(least), WINDOWS[-1])
    for window in reversed(WINDOWS):
        enough = (age <= window).sum(axis=1) >= np.repeat(least, np.diff(starts))
        windows[np.add.reduceat(enough, starts[:-1], dtype=float) / np.diff(starts) >= 0.5] = window
    return windows


def lacks_ranges_or_imu(folder: RecordingFolder) -> str | None:
    """What a folder lacks for the tracker of ranges and an IMU, in words."""
    for name in ("ranges", "imu"):
        if name not in folder.tables:
            return f"a {name} table, found no such table"
    count = len(np.unique(folder.rows("ranges").codes("anchor", sorted(folder.rig.anchors))))
    return None if count >= MIN_ANCHORS else f"ranges to at least {MIN_ANCHORS} anchors, found {count}"


def lacks_differences_or_imu(folder: RecordingFolder) -> str | None:
    """What a folder lacks for the tracker of range differences and an IMU, in words."""
    return lacks_differences(folder) or (None if "imu" in folder.tables else "an imu table, found no such table")


def lacks_ranges(folder: RecordingFolder, rows: TagRows | None = None) -> str | None:
    """What a folder lacks for a tracker of ranges, in words: enough anchors, not collinear, and ranges in metres.

    `rows`: the ranges of each trajectory, by default of each tag.
    """
    if "ranges" not in folder.tables:
        return "a ranges table with at least 3 anchors, found no such table"
    rows, ids = folder.rows("ranges") if rows is None else rows, sorted(folder.rig.anchors)
    ranges = rows.floats(["range_m"])[:, 0]
    positive = ranges > 0
    heard = np.zeros((len(rows.tags), len(ids)), bool)
    heard[rows.of_each(np.arange(len(rows.tags)))[positive], rows.codes("anchor", ids)[positive]] = True
    counts, needed = heard.sum(axis=1), np.where(np.isnan(known_heights(folder, rows.tags)), 4, 3)
    if not (counts >= needed).any():
        return (
            "positive ranges from a tag to at least 3 anchors, or 4 where rig.toml gives it no height_m, found "
            f"{counts.max(initial=0)} at most"
        )
    positions = anchor_positions(folder)[heard.any(axis=0)]
    line = lacks_a_plane(positions)
    if line is not None:
        return line
    median, extent = float(np.median(ranges[positive])), float(np.ptp(positions, axis=0).max())
    if median > MAX_RANGE_RATIO * extent:
        return (
            f"ranges in metres, found a median of {median:.4g} among anchors {extent:.4g} m apart; "
            "are they in centimetres or millimetres?"
        )
    return None


def _lacks_bodies(folder: RecordingFolder) -> str | None:
    """What a folder lacks for the tracker of bodies, in words."""
    if "ranges" not in folder.tables:
        return lacks_ranges(folder)
    single = sorted(set(folder.rows("ranges").tags) - set(_tags_on_bodies(folder)))
    if single:
        return (
            "for every tag another one on its body (offset_m of both in rig.toml), or odometry of it; found neither "
            f"for {listed(single)}"
        )
    return lacks_ranges(folder, _ranges_by_body(folder))


def _lacks_known_height(folder: RecordingFolder) -> str | None:
    """What a folder lacks for trilateration, in words."""
    lacking = lacks_ranges(folder)
    if lacking is not None:
        return lacking
    free = sorted(tag for tag in folder.rows("ranges").tags if known_height(folder, tag) is None)
    return f"height_m in rig.toml for every tag, found none for {', '.join(free)}" if free else None


def _anchors(trajectory: Trajectory) -> int:
    return len(trajectory.folder.rig.anchors)


def bias_slots(trajectory: Trajectory, together: int = 8) -> int:
    """The number of biases of anchors in a state: a multiple of `together`, so that installations share a program."""
    return -(-_anchors(trajectory) // together) * together


def _is_calibrated(trajectory: Trajectory) -> bool:
    return bool(range_levels(trajectory.folder.calibration))


def tracker_of_ranges(trajectory: Trajectory, planar: bool, together: int = 8) -> Tracker:
    """The tracker of a trajectory's ranges, with `bias_slots`."""
    levels = range_levels(trajectory.folder.calibration)
    return replace(range_tracker(bias_slots(trajectory, together), planar, **levels), lasting_errors=not levels)


def _body(trajectory: Trajectory, planar: bool) -> AbstractTracker:
    levels = range_levels(trajectory.folder.calibration)
    wheels = Wheels() if ODOMETRY.name in trajectory.recording.inputs else None
    tracker = body_tracker(bias_slots(trajectory), planar, _as_one(trajectory), wheels, **levels)
    return replace(tracker, lasting_errors=not levels)


def _as_one(trajectory: Trajectory) -> int:
    """How many ranges between a tag and an anchor count as one in a recording of bodies."""
    rows = trajectory.folder.rows("ranges")
    pairs = rows.of_each(np.arange(len(rows.tags))) * _anchors(trajectory)
    pairs += rows.codes("anchor", sorted(trajectory.folder.rig.anchors))
    order = np.lexsort((rows.times, pairs))
    elapsed = np.diff(rows.times[order])[np.diff(pairs[order]) == 0]
    return max(1, round(LASTS / max(float(np.median(elapsed)), 1e-3))) if len(elapsed) else 1


def _inertial(trajectory: Trajectory, planar: bool) -> AbstractTracker:
    return replace(inertial_tracker(_anchors(trajectory), planar), lasting_errors=not _is_calibrated(trajectory))


def _inertial_of_differences(trajectory: Trajectory, planar: bool) -> AbstractTracker:
    return replace(inertial_difference_tracker(_anchors(trajectory), _slots(trajectory), planar), lasting_errors=True)


def _slots(trajectory: Trajectory) -> int:
    return int(trajectory.recording.readings[TDOA].values.shape[1])


def tracker_of_differences(trajectory: Trajectory, planar: bool, together: int = 8) -> Tracker:
    """The tracker of a trajectory's range differences, with `bias_slots`."""
    tracker = difference_tracker(bias_slots(trajectory, together), _slots(trajectory), planar)
    return replace(tracker, lasting_errors=True)


_trilateration = partial(
    TrackerSpec,
    trajectories=triple_trajectories,
    lacks=_lacks_known_height,
    planar=lambda trajectory, free_height: True,
    every_row=(RANGES,),
)

TRACKERS: Mapping[str, Callable[..., TrackerSpec]] = {
    "uwb-imu": partial(
        TrackerSpec,
        trajectories=inertial_trajectories,
        build=_inertial,
        notices=tilting_tags,
        lacks=lacks_ranges_or_imu,
        geometry=lambda trajectory: (
            _anchors(trajectory),
            "levers" in trajectory.recording.inputs,
            _is_calibrated(trajectory),
        ),
    ),
    "uwb": partial(
        TrackerSpec,
        trajectories=range_trajectories,
        build=tracker_of_ranges,
        lacks=lacks_ranges,
        geometry=lambda trajectory: (bias_slots(trajectory), *range_levels(trajectory.folder.calibration).values()),
    ),
    "body": partial(
        TrackerSpec,
        trajectories=body_trajectories,
        build=_body,
        lacks=_lacks_bodies,
        geometry=lambda trajectory: (
            bias_slots(trajectory),
            _as_one(trajectory),
            ODOMETRY.name in trajectory.recording.inputs,
            *range_levels(trajectory.folder.calibration).values(),
        ),
        automatic=lambda folder: False,
    ),
    "tdoa": partial(
        TrackerSpec,
        trajectories=difference_trajectories,
        build=tracker_of_differences,
        lacks=lacks_differences,
        geometry=lambda trajectory: (bias_slots(trajectory), _slots(trajectory)),
    ),
    "tdoa-imu": partial(
        TrackerSpec,
        trajectories=inertial_difference_trajectories,
        build=_inertial_of_differences,
        notices=partial(tilting_tags, read=TDOA, without=TDOA),
        lacks=lacks_differences_or_imu,
        geometry=lambda trajectory: (_anchors(trajectory), _slots(trajectory)),
    ),
    "multilateration": partial(
        TrackerSpec,
        trajectories=snapshot_trajectories,
        build=lambda trajectory, planar: multilateration_tracker(planar),
        lacks=lacks_ranges,
        geometry=_anchors,
        every_row=(RANGES,),
    ),
    "trilateration": partial(
        _trilateration,
        build=lambda trajectory, planar: trilateration_tracker(compensated=False),
    ),
    "trilateration-compensated": partial(
        _trilateration,
        build=lambda trajectory, planar: trilateration_tracker(compensated=True),
    ),
}
"""How each tracker is built; `trackers.catalogue` has its table and its line in lists."""
