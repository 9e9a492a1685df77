"""System C with an inertial sensor on the command line: the tracker of ranges and an IMU, and its trajectories."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import polars as pl

from trackers.core.recording import Readings
from trackers.parts.range_rows import range_rows
from trackers.parts.ranges import RANGES
from trackers.recordings.columns import float_column
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tables import QUATERNION
from trackers.recordings.tracker_spec import TrackerSpec, at_known_height
from trackers.recordings.trajectories import Trajectory, trajectory_of
from trackers.recordings.truth import truth_by_tag
from trackers.uwb_imu.inertial import inertial_tracker
from trackers.uwb_imu.samples import held_inputs, levelled

GRAVITY = 9.81
LEAST_ANCHORS = 3


def inertial_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's ranges, one a row, and rows at the times of the IMU's samples, which move the rows.

    Tags with a place on the body (`offset_m`) sit on one body, with its IMU at the body's origin: each of their trajectories
    has the ranges of all of them, by their levers from the trajectory's own tag.
    """
    paths = truth_by_tag(folder)
    tables = folder.tables
    for tag in tables["ranges"]["tag"].unique(maintain_order=True).sort().to_list():
        mates = _mates(folder, tag, free_height)
        table = tables["ranges"].filter(pl.col("tag").is_in(mates))
        imu_times, accel, gyro = _samples(tables["imu"], tag, mates)
        range_times = table["t_s"].to_numpy()
        between = imu_times[~np.isin(imu_times, range_times)]
        times = np.concatenate([range_times, between])
        order = np.argsort(times, kind="stable")
        readings, inputs = range_rows(folder, tag, table, free_height)
        if len(mates) > 1:
            place = {mate: _offset(folder, mate) - _offset(folder, tag) for mate in mates}
            inputs["levers"] = np.stack([place[mate] for mate in table["tag"].to_list()])
        merged = {name: _with_rows(values, len(between))[order] for name, values in inputs.items()}
        merged |= held_inputs(times[order], imu_times, accel, gyro)
        merged["arm"] = np.tile(_offset(folder, tag), (len(times), 1))
        assert readings.reported is not None
        seen = _with_rows(readings.seen, len(between))[order]
        reported = _with_rows(readings.reported, len(between))[order]
        rows = Readings(_with_rows(readings.values, len(between))[order], seen, reported)
        yield trajectory_of(folder, tag, "", times[order], {RANGES: rows}, merged, paths)


def _mates(folder: RecordingFolder, tag: str, free_height: bool) -> list[str]:
    """The tags on the same body, the tag itself first; a tag tracked over the floor is alone."""
    known = folder.rig.tags.get(tag)
    if known is None or known.offset is None or (known.height is not None and not free_height):
        return [tag]
    return [tag, *(other for other, t in folder.rig.tags.items() if t.offset is not None and other != tag)]


def _offset(folder: RecordingFolder, tag: str) -> np.ndarray:
    known = folder.rig.tags.get(tag)
    return np.zeros(3) if known is None or known.offset is None else np.asarray(known.offset, float)


def _with_rows(values: np.ndarray, more: int) -> np.ndarray:
    """The rows with so many rows of zeros after them."""
    return np.concatenate([values, np.zeros((more, *values.shape[1:]), values.dtype)])


def _samples(table: pl.DataFrame, tag: str, mates: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), accelerations and turning rates (n, 3) of the body's IMU: the tag's own, else one of its mates'."""
    own = next((part for part in (table.filter(pl.col("tag") == t) for t in mates) if len(part)), table.head(0))
    accel, gyro = (
        np.stack([float_column(own, f"{kind}_{axis}_{unit}") for axis in "xyz"], axis=1)
        for kind, unit in (("accel", "mps2"), ("gyro", "radps"))
    )
    if QUATERNION[0] in own.columns:
        attitude = np.stack([float_column(own, name) for name in QUATERNION], axis=1)
        accel, gyro = levelled(accel, attitude, GRAVITY)
    return own["t_s"].to_numpy(), accel, gyro


def lacks(folder: RecordingFolder) -> str | None:
    """What a folder lacks for the tracker of ranges and an IMU, in words."""
    for name in ("ranges", "imu"):
        if name not in folder.tables:
            return f"a {name} table, found no such table"
    found = folder.tables["ranges"]["anchor"].n_unique()
    return None if found >= LEAST_ANCHORS else f"ranges to at least {LEAST_ANCHORS} anchors, found {found}"


def _anchors(trajectory: Trajectory) -> int:
    return len(trajectory.folder.rig.anchors)


TRACKERS = {
    "uwb-imu": TrackerSpec(
        "position, velocity and attitude from ranges and an IMU, error-state EKF",
        table="ranges",
        trajectories=inertial_trajectories,
        build=lambda trajectory, planar: inertial_tracker(_anchors(trajectory), planar),
        lacks=lacks,
        geometry=lambda trajectory: (_anchors(trajectory), "levers" in trajectory.recording.inputs),
        planar=at_known_height,
    ),
}
