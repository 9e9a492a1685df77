"""Trajectories and catalogue entries of trackers of ranges, with and without an IMU: tables `ranges` and `imu`."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import combinations

import numpy as np
import polars as pl

from trackers.core.recording import Readings
from trackers.parts.range_rows import anchor_positions, range_rows, range_trajectories
from trackers.parts.ranges import RANGES
from trackers.recordings.columns import by_tag, float_column
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tables import QUATERNION
from trackers.recordings.tracker_spec import TrackerSpec, on_request
from trackers.recordings.trajectories import Trajectory, known_height, trajectory_of
from trackers.recordings.truth import truth_by_tag
from trackers.uwb_imu.fusion import range_tracker
from trackers.uwb_imu.imu_inputs import imu_inputs, to_level_axes
from trackers.uwb_imu.inertial import inertial_tracker
from trackers.uwb_imu.multilateration import multilateration_tracker
from trackers.uwb_imu.trilateration import trilateration_tracker

GRAVITY = 9.81
"""m/s²."""

MIN_ANCHORS = 3
"""Least number of anchors for the tracker of ranges and an IMU."""

WINDOWS = (0.1, 0.25, 0.5, 1.0)
"""Candidate times, s, for which a range stays valid in a snapshot of the latest ranges."""

COLLINEAR = 1e-2
"""Ratio of the horizontal singular values of the anchor positions below which the anchors count as collinear."""

MAX_RANGE_RATIO = 20.0
"""Largest plausible median range, as a multiple of the anchors' extent."""


def inertial_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's ranges, one per row, and further rows at the times of the IMU's samples.

    Tags with an `offset_m` are on one body, with the IMU at the body's origin: the trajectory of each has the ranges of
    all of them, with their lever arms from its own tag.
    """
    paths = truth_by_tag(folder)
    tables = folder.tables
    for tag in tables["ranges"]["tag"].unique(maintain_order=True).sort().to_list():
        tags = _tags_on_body(folder, tag, free_height)
        table = tables["ranges"].filter(pl.col("tag").is_in(tags))
        imu_times, accel, gyro = _imu_samples(tables["imu"], tags)
        range_times = table["t_s"].to_numpy()
        between = imu_times[~np.isin(imu_times, range_times)]
        times = np.concatenate([range_times, between])
        order = np.argsort(times, kind="stable")
        readings, inputs = range_rows(folder, tag, table, free_height)
        if len(tags) > 1:
            levers = {other: _offset(folder, other) - _offset(folder, tag) for other in tags}
            inputs["levers"] = np.stack([levers[other] for other in table["tag"].to_list()])
        merged = {name: _zero_padded(values, len(between))[order] for name, values in inputs.items()}
        merged |= imu_inputs(times[order], imu_times, accel, gyro)
        merged["arm"] = np.tile(_offset(folder, tag), (len(times), 1))
        assert readings.reported is not None
        seen = _zero_padded(readings.seen, len(between))[order]
        reported = _zero_padded(readings.reported, len(between))[order]
        rows = Readings(_zero_padded(readings.values, len(between))[order], seen, reported)
        yield trajectory_of(folder, tag, "", times[order], {RANGES: rows}, merged, paths)


def _tags_on_body(folder: RecordingFolder, tag: str, free_height: bool) -> list[str]:
    """The tags on the same body, the tag itself first; the tag alone if its state is planar."""
    known = folder.rig.tags.get(tag)
    if known is None or known.offset is None or (known.height is not None and not free_height):
        return [tag]
    return [tag, *(other for other, t in folder.rig.tags.items() if t.offset is not None and other != tag)]


def _offset(folder: RecordingFolder, tag: str) -> np.ndarray:
    known = folder.rig.tags.get(tag)
    return np.zeros(3) if known is None or known.offset is None else np.asarray(known.offset, float)


def _zero_padded(values: np.ndarray, count: int) -> np.ndarray:
    """The rows followed by `count` rows of zeros."""
    return np.concatenate([values, np.zeros((count, *values.shape[1:]), values.dtype)])


def _imu_samples(table: pl.DataFrame, tags: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,) s, accelerations m/s² and turning rates rad/s (n, 3) of the first tag that has IMU samples."""
    own = next((part for part in (table.filter(pl.col("tag") == t) for t in tags) if len(part)), table.head(0))
    accel, gyro = (
        np.stack([float_column(own, f"{kind}_{axis}_{unit}") for axis in "xyz"], axis=1)
        for kind, unit in (("accel", "mps2"), ("gyro", "radps"))
    )
    if QUATERNION[0] in own.columns:
        attitude = np.stack([float_column(own, name) for name in QUATERNION], axis=1)
        accel, gyro = to_level_axes(accel, attitude, GRAVITY)
    return own["t_s"].to_numpy(), accel, gyro


def snapshot_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's ranges, one row per time, with the latest range of every anchor in a slot of its own."""
    for tag, times, latest, fresh, inputs in _snapshots(folder, free_height):
        yield trajectory_of(folder, tag, "", times, {RANGES: Readings(latest, fresh)}, inputs, truth_by_tag(folder))


def triple_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """As `snapshot_trajectories`, with the three anchors of each row that span the largest triangle."""
    anchors = anchor_positions(folder)
    triples = np.array(list(combinations(range(len(anchors)), 3)))
    legs = anchors[triples][:, 1:, :2] - anchors[triples][:, :1, :2]
    areas = np.abs(legs[:, 0, 0] * legs[:, 1, 1] - legs[:, 0, 1] * legs[:, 1, 0])
    for tag, times, latest, fresh, inputs in _snapshots(folder, free_height):
        patterns, which = np.unique(fresh, axis=0, return_inverse=True)
        complete = patterns[:, triples].all(axis=2)
        best = triples[np.argmax(np.where(complete, areas, -1.0), axis=1)][which.ravel()]
        values, seen = (np.take_along_axis(x, best, axis=1) for x in (latest, fresh))
        inputs = {**inputs, "anchors": anchors[best].reshape(len(times), 9)}
        yield trajectory_of(folder, tag, "", times, {RANGES: Readings(values, seen)}, inputs, truth_by_tag(folder))


def _snapshots(
    folder: RecordingFolder, free_height: bool
) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]]:
    """Per tag: its times (t,), each anchor's latest range (t, A) m, whether it is recent enough, and the inputs."""
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
                row = mine[np.maximum(last, 0)]
                latest[:, k] = readings.values[row, 0]
                age[:, k] = np.where(last >= 0, times - rows[row], np.inf)
        fresh = age <= _snapshot_window(age, 3 if known else 4)
        yield tag, times, np.where(fresh, latest, 0.0), fresh, {"anchors": np.tile(anchors.ravel(), (len(times), 1))}


def _snapshot_window(age: np.ndarray, least: int) -> float:
    """The shortest of the `WINDOWS`, s, in which at least half of the times have `least` anchors."""
    enough = [w for w in WINDOWS if np.mean(np.sum(age <= w, axis=1) >= least) >= 0.5]
    return enough[0] if enough else WINDOWS[-1]


def lacks_ranges_or_imu(folder: RecordingFolder) -> str | None:
    """What a folder lacks for the tracker of ranges and an IMU, in words."""
    for name in ("ranges", "imu"):
        if name not in folder.tables:
            return f"a {name} table, found no such table"
    found = folder.tables["ranges"]["anchor"].n_unique()
    return None if found >= MIN_ANCHORS else f"ranges to at least {MIN_ANCHORS} anchors, found {found}"


def lacks_ranges(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker of ranges, in words: enough anchors, not collinear, and ranges in metres."""
    if "ranges" not in folder.tables:
        return "a ranges table with at least 3 anchors, found no such table"
    table = folder.tables["ranges"].filter(pl.col("range_m") > 0)
    anchors_of = {tag: part["anchor"].unique().to_list() for tag, part in by_tag(table)}
    needed = {tag: 4 if known_height(folder, tag) is None else 3 for tag in anchors_of}
    if not any(len(anchors_of[tag]) >= needed[tag] for tag in anchors_of):
        most = max(map(len, anchors_of.values()), default=0)
        return (
            f"positive ranges from a tag to at least 3 anchors, or 4 where rig.toml gives it no height_m, found {most} "
            "at most"
        )
    positions = np.stack([np.asarray(folder.rig.anchors[a], float) for a in sorted(set().union(*anchors_of.values()))])
    sizes = np.linalg.svd(positions[:, :2] - positions[:, :2].mean(axis=0), compute_uv=False)
    if sizes[1] < COLLINEAR * sizes[0]:
        return f"anchors that span a plane, found all {len(positions)} that are heard on one line seen from above"
    median, extent = float(table["range_m"].median()), float(np.ptp(positions, axis=0).max())  # type: ignore[arg-type]
    if median > MAX_RANGE_RATIO * extent:
        return (
            f"ranges in metres, found a median of {median:.4g} among anchors {extent:.4g} m apart; "
            "are they in centimetres or millimetres?"
        )
    return None


def _lacks_known_height(folder: RecordingFolder) -> str | None:
    """What a folder lacks for trilateration, in words."""
    lacking = lacks_ranges(folder)
    if lacking is not None:
        return lacking
    free = sorted(tag for tag in folder.tables["ranges"]["tag"].unique() if known_height(folder, tag) is None)
    return f"height_m in rig.toml for every tag, found none for {', '.join(free)}" if free else None


def _anchors(trajectory: Trajectory) -> int:
    return len(trajectory.folder.rig.anchors)


def _bias_slots(trajectory: Trajectory) -> int:
    """The number of range biases of a tracker: a multiple of eight, so that installations share a program."""
    return -(-_anchors(trajectory) // 8) * 8


_trilateration = partial(
    TrackerSpec,
    table="ranges",
    trajectories=triple_trajectories,
    lacks=_lacks_known_height,
    planar=lambda trajectory, free_height: True,
    automatic=on_request,
)

TRACKERS = {
    "uwb-imu": TrackerSpec(
        about="position, velocity and attitude from ranges and an IMU, error-state EKF",
        table="ranges and imu",
        trajectories=inertial_trajectories,
        build=lambda trajectory, planar: inertial_tracker(_anchors(trajectory), planar),
        lacks=lacks_ranges_or_imu,
        geometry=lambda trajectory: (_anchors(trajectory), "levers" in trajectory.recording.inputs),
    ),
    "uwb": TrackerSpec(
        about="position from ranges, EKF with a drifting bias per anchor",
        table="ranges",
        trajectories=range_trajectories,
        build=lambda trajectory, planar: range_tracker(_bias_slots(trajectory), planar),
        lacks=lacks_ranges,
        geometry=_bias_slots,
    ),
    "multilateration": TrackerSpec(
        about="position from the latest ranges, robust least squares without a filter",
        table="ranges",
        trajectories=snapshot_trajectories,
        build=lambda trajectory, planar: multilateration_tracker(planar),
        lacks=lacks_ranges,
        geometry=_anchors,
        automatic=on_request,
    ),
    "trilateration": _trilateration(
        about="planar position from three ranges, intersection of circles (Kwon et al.) without compensation (14)",
        build=lambda trajectory, planar: trilateration_tracker(compensated=False),
    ),
    "trilateration-compensated": _trilateration(
        about="planar position from three ranges, intersection of circles with compensation (14) (Kwon et al.)",
        build=lambda trajectory, planar: trilateration_tracker(compensated=True),
    ),
}
