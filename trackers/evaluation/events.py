"""Events of tracks: lost, found again, and departures from a known path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.tracker_spec import TrackerBatch, TrackerSpec
from trackwright.trackers.recordings.tracks import from_origins
from trackwright.trackers.recordings.tracks_table import track_keys
from trackwright.trackers.recordings.trajectories import Trajectories, Trajectory

EVENTS = "events.parquet"
"""File in the output folder of `trackwright track`."""

LEFT_SLACK, LEFT_LIMIT = 1.0, 2.0
"""Deviation of free from constrained estimates that counts as none, m, and the m s beyond it that make a departure."""

REDUNDANT, WINDOW_S = 4, 2.0
"""Anchors required within this many seconds: with fewer, a departure cannot be told from a range that is too long."""

TOLERANCE, CERTAIN = 0.2, 0.5
"""Distance from a prescribed path that counts as on it, m, and the m s beyond it that make a departure."""

_COLUMNS = {"t_s": pl.Float64, "event": pl.String, "detail": pl.String}


def events_of(tracks: pl.DataFrame, spec: TrackerSpec, batches: Sequence[TrackerBatch]) -> pl.DataFrame:
    """One row per event: recording, tag (and station for bearings), `t_s`, `event` in words, `detail`.

    `tracks`: the table of estimates by the tracker `spec` of the trajectories in `batches`.
    """
    keys, tracks = track_keys(tracks), from_origins(tracks, batches)
    # A track lost and found again at one time has the status of a restart alone, which is both events.
    restarted, before = pl.col("status") == "restarted", pl.col("status").shift(1).over(keys)
    lost = ((pl.col("status") == "lost") | restarted) & (before != "lost").fill_null(True)
    events = [
        tracks.filter(happened).select(*keys, "t_s", event=pl.lit(event), detail=pl.lit(""))
        for event, happened in (("lost", lost), ("found again", restarted))
    ]
    if not spec.bearing_only:
        departures = left_the_line if spec.on_path else off_the_path
        trajectories = {
            (trajectory.folder.name, trajectory.tag): trajectory
            for batch in batches
            if spec.on_path or any(f.rig.path_knots is not None for f in Trajectories.of(batch.trajectories).folders)
            for trajectory in batch.trajectories
        }
        by_track = tracks.partition_by(["recording", "tag"], as_dict=True) if trajectories else {}
        for (recording, tag), trajectory in trajectories.items():
            rows = by_track[recording, tag]
            table = pl.DataFrame(departures(trajectory, rows), schema=_COLUMNS, orient="row")
            events.append(table.select(pl.lit(recording).alias("recording"), pl.lit(tag).alias("tag"), *_COLUMNS))
    return pl.concat(events, how="diagonal").sort([*keys, "t_s"], maintain_order=True)


def off_the_path(trajectory: Trajectory, tracks: pl.DataFrame) -> list[tuple[float, str, str]]:
    """Events (t_s, event, detail) of a freely tracked tag off the prescribed path of its rig; none without a path.

    The alarm of Kwon et al. 2021, section 1. An estimate is off by its distance from the path beyond `TOLERANCE` and
    twice its standard deviation. `tracks`: the estimates of this tag.
    """
    known = tracks.filter(pl.all_horizontal(pl.col("x_m", "y_m").is_finite()))
    if trajectory.folder.rig.path_knots is None or known.is_empty():
        return []
    from trackwright.trackers.line.rows import path_of

    times, positions = float_column(known, "t_s"), np.stack([float_column(known, f"{a}_m") for a in "xy"], axis=1)
    sigma = np.nan_to_num(np.hypot(float_column(known, "std_x_m"), float_column(known, "std_y_m")))
    away, names = path_of(trajectory.folder).nearest(positions)[1], ("off the prescribed path", "back on the path")
    return _departures(times, away, TOLERANCE + 2 * sigma, CERTAIN, names, "from it")


def left_the_line(trajectory: Trajectory, tracks: pl.DataFrame) -> list[tuple[float, str, str]]:
    """Events (t_s, event, detail) of a tag that left the line to which a line tracker constrains its estimates.

    The free estimate is a Kalman filter on fixes, or the multilateration of recent ranges. `tracks`: the constrained
    estimates of this tag.
    """
    times, free = _free_positions(trajectory)
    known = tracks.filter(pl.all_horizontal(pl.col("x_m", "y_m").is_finite()))
    if known.is_empty():
        return []
    at = known["t_s"].to_numpy()
    constrained = np.stack([np.interp(times, at, float_column(known, f"{a}_m")) for a in "xy"], axis=1)
    deviation, names = np.linalg.norm(free - constrained, axis=1), ("left the line", "back on the line")
    return _departures(times, deviation, LEFT_SLACK, LEFT_LIMIT, names, "between free and constrained estimate")


def _departures(
    times: np.ndarray,
    deviation: np.ndarray,
    slack: np.ndarray | float,
    limit: float,
    names: tuple[str, str],
    where: str,
) -> list[tuple[float, str, str]]:
    """Events of `excursions`: both their `names`, and `where` the deviation, m, is."""
    from trackwright.trackers.line.leaving import excursions

    rows: list[tuple[float, str, str]] = []
    for start, end, farthest in excursions(times, deviation, slack, limit):
        rows.append((float(times[start]), names[0], f"up to {farthest:.2f} m {where}"))
        if end < len(times):
            rows.append((float(times[end]), names[1], f"after {times[end] - times[start]:.1f} s"))
    return rows


def _free_positions(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,), s, and positions (T, 2), m, estimated without the path; NaN where there is none."""
    from trackwright.trackers.baselines.fixes import fix_tracker
    from trackwright.trackers.line.rows import raw_positions
    from trackwright.trackers.parts.fixes import FIXES
    from trackwright.trackers.parts.ranges import RANGES

    whole = trajectory.recording
    if RANGES in whole.readings:
        times, positions = raw_positions(trajectory)
        observed = _observed_anchors(whole, whole.readings[RANGES].seen[:, 0])
        return times, np.where(observed[:, None] >= REDUNDANT, positions, np.nan)
    fixes = whole.readings[FIXES]
    missing = np.zeros((len(whole), 1))
    reported = np.zeros((len(whole), 3)) if fixes.reported is None else np.hstack([fixes.reported, missing])
    readings = {FIXES: Readings(np.hstack([fixes.values, missing]), np.hstack([fixes.seen, missing > 0]), reported)}
    free = fix_tracker(planar=True).run(Recording(whole.times, readings, whole.inputs, name=whole.name))
    positions = np.stack([np.asarray(x) for x in free.mean.position], axis=1)
    return whole.times, np.where(free.usable[:, None], positions, np.nan)


def _observed_anchors(recording: Recording, seen: np.ndarray) -> np.ndarray:
    """Number of different anchors with a range in the last `WINDOW_S` seconds, at each row (T,); `seen`: with one."""
    times, number = recording.times, recording.inputs["anchor"][:, 0]
    observed = np.zeros(len(times), int)
    for anchor in np.unique(number):
        rows = np.flatnonzero(seen & (number == anchor))
        last = np.searchsorted(rows, np.arange(len(times)), side="right") - 1
        observed += (last >= 0) & (times - times[rows[np.maximum(last, 0)]] <= WINDOW_S if len(rows) else False)
    return observed
