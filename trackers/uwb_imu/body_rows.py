"""Trajectories of several tags on a body and of tags with an IMU or wheels, and how their trackers are built."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import polars as pl

from trackwright.trackers.core.data.recording import Columns, Readings
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.parts.ranges import (
    CARRIER,
    RANGES,
    anchor_positions,
    range_inputs,
    range_rows,
    room_of_anchors,
)
from trackwright.trackers.recordings.columns import QUATERNION, TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import TrackerSpec
from trackwright.trackers.recordings.tracks import (
    Trajectories,
    Trajectory,
    known_height,
    known_heights,
    trajectories_of,
)
from trackwright.trackers.uwb_imu.body import LASTS, ODOMETRY, Wheels, body_tracker, odometry_inputs
from trackwright.trackers.uwb_imu.difference_rows import difference_trajectories, lacks_differences, slots_of
from trackwright.trackers.uwb_imu.fusion import TDOA, range_levels
from trackwright.trackers.uwb_imu.inertial import inertial_difference_tracker, inertial_tracker
from trackwright.trackers.uwb_imu.rows import anchors_of, bias_slots, lacks_ranges
from trackwright.trackers.uwb_imu.rows_between import imu_inputs, tilting_tags, to_level_axes, with_rows_between
from trackwright.trackers.uwb_imu.strapdown import ARM

GRAVITY = 9.81  # m/s²

MIN_ANCHORS = 3  # least number of anchors for the tracker of ranges and an IMU


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
    bodies = _bodies(folder)
    rows = _ranges_of_bodies(folder, bodies)
    readings, number = range_rows(folder, rows)
    heights = np.full(len(rows.tags), np.nan) if free_height else known_heights(folder, rows.tags)
    inputs = range_inputs(rows.starts, rows.times, readings, number, anchor_positions(folder), heights, folder.rig)
    inputs |= {"levers": _levers(folder, rows, upright=True)}
    if ODOMETRY.name not in folder.tables:
        inputs |= room_of_anchors(folder, len(number))
        return trajectories_of(folder, rows.tags, rows.starts, rows.times, {RANGES: readings}, inputs)
    wheels = folder.rows(ODOMETRY.name)
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
    carriers = list(_bodies(folder))
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
    folder: RecordingFolder, tags: Sequence[str], rows: TagRows | Columns, bodies: Mapping[str, Sequence[str]],
    readings: Mapping[str, Readings], inputs: Mapping[str, np.ndarray],
) -> Trajectories:  # fmt: skip
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


def lacks_ranges_or_imu(folder: RecordingFolder) -> str | None:
    """What a folder lacks for the tracker of ranges and an IMU, in words."""
    for name in ("ranges", "imu"):
        if name not in folder.tables:
            return f"a {name} table, found no such table"
    count = len(np.unique(folder.rows("ranges").codes("anchor", sorted(folder.rig.anchors))))
    return None if count >= MIN_ANCHORS else f"ranges to at least {MIN_ANCHORS} anchors, found {count}"


def _lacks_bodies(folder: RecordingFolder) -> str | None:
    """What a folder lacks for the tracker of bodies, in words."""
    if "ranges" not in folder.tables:
        return lacks_ranges(folder)
    bodies = _bodies(folder)
    if single := sorted(set(folder.rows("ranges").tags) - set(bodies)):
        return (
            "for every tag another one on its body (offset_m of both in rig.toml), or odometry of it; found neither "
            f"for {listed(single)}"
        )
    return lacks_ranges(folder, _ranges_of_bodies(folder, bodies))


def _is_calibrated(trajectory: Trajectory) -> bool:
    return bool(range_levels(trajectory.folder.calibration))


def _body(trajectory: Trajectory, planar: bool) -> AbstractTracker:
    levels = range_levels(trajectory.folder.calibration)
    wheels = Wheels() if ODOMETRY.name in trajectory.recording.inputs else None
    tracker = body_tracker(bias_slots(trajectory), planar, _as_one(trajectory), wheels, **levels)
    return replace(tracker, lasting_errors=not levels)


def _as_one(trajectory: Trajectory) -> int:
    """How many ranges between a tag and an anchor count as one in a recording of bodies."""
    rows = trajectory.folder.rows("ranges")
    pairs = rows.of_each(np.arange(len(rows.tags))) * anchors_of(trajectory)
    pairs += rows.codes("anchor", sorted(trajectory.folder.rig.anchors))
    order = np.lexsort((rows.times, pairs))
    elapsed = np.diff(rows.times[order])[np.diff(pairs[order]) == 0]
    return max(1, round(LASTS / max(float(np.median(elapsed)), 1e-3))) if len(elapsed) else 1


TRACKERS: Mapping[str, Callable[..., TrackerSpec]] = {
    "uwb-imu": partial(
        TrackerSpec,
        trajectories=inertial_trajectories,
        build=lambda trajectory, planar: replace(
            inertial_tracker(anchors_of(trajectory), planar), lasting_errors=not _is_calibrated(trajectory)
        ),
        notices=tilting_tags,
        lacks=lacks_ranges_or_imu,
        geometry=lambda trajectory: (
            anchors_of(trajectory),
            "levers" in trajectory.recording.inputs,
            _is_calibrated(trajectory),
        ),
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
    "tdoa-imu": partial(
        TrackerSpec,
        trajectories=inertial_difference_trajectories,
        build=lambda trajectory, planar: replace(
            inertial_difference_tracker(anchors_of(trajectory), slots_of(trajectory), planar), lasting_errors=True
        ),
        notices=partial(tilting_tags, read=TDOA, without=TDOA),
        lacks=lambda of: lacks_differences(of) or (None if "imu" in of.tables else "an imu table, found no such table"),
        geometry=lambda trajectory: (anchors_of(trajectory), slots_of(trajectory)),
    ),
}
"""How each tracker is built; `trackers.catalogue` has its table and its line in lists."""
