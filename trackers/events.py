"""What happened to tracks and when: lost, found again, and what a tracker's own entry looks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from trackers.baselines.fixes import fix_tracker
from trackers.core.recording import Readings, Recording
from trackers.line.leaving import excursions
from trackers.line.rows import path_of, raw_positions
from trackers.parts.fixes import FIXES
from trackers.parts.ranges import RANGES
from trackers.recordings.columns import float_column
from trackers.recordings.tracker_spec import TrackerBatch, TrackerSpec
from trackers.recordings.tracks_table import track_keys
from trackers.recordings.trajectories import Trajectory

EVENTS = "events.parquet"
_COLUMNS = {"t_s": pl.Float64, "event": pl.String, "detail": pl.String}
LEFT_SLACK, LEFT_LIMIT = 1.0, 2.0
"""Metres by which a free estimate may be off, and metre seconds beyond that after which the tag has left the line."""


REDUNDANT, HEARD_S = 4, 2.0
"""Anchors that must be heard within so many seconds: with fewer, a tag away is like a range that is too long."""

TOLERANCE, CERTAIN = 0.2, 0.5
"""Metres beside a prescribed path that count as on it, and metre seconds beyond that after which a tag is off it."""

_WORDS = {"lost": "lost", "restarted": "found again"}


def events_of(tracks: pl.DataFrame, entry: TrackerSpec, groups: Sequence[TrackerBatch]) -> pl.DataFrame:
    """One row per event: whose track (recording, tag, station for bearings), `t_s`, `event` in words, `detail`."""
    keys = track_keys(tracks)
    changed = (pl.col("status") != pl.col("status").shift(1).over(keys)).fill_null(True)
    turns = tracks.filter(changed & pl.col("status").is_in(list(_WORDS)))
    found = [
        turns.select(
            *keys, pl.col("t_s"), pl.col("status").replace_strict(_WORDS).alias("event"), pl.lit("").alias("detail")
        )
    ]
    if not entry.bearing_only:
        look = left_the_line if entry.on_path else off_the_path
        trajectories = {
            (trajectory.folder.name, trajectory.tag): trajectory
            for group in groups
            for trajectory in group.trajectories
        }
        for (recording, tag), trajectory in trajectories.items():
            mine = tracks.filter((pl.col("recording") == recording) & (pl.col("tag") == tag))
            table = pl.DataFrame(look(trajectory, mine), schema=_COLUMNS, orient="row")
            found.append(table.select(pl.lit(recording).alias("recording"), pl.lit(tag).alias("tag"), *_COLUMNS))
    return pl.concat(found, how="diagonal").sort([*keys, "t_s"], maintain_order=True)


def off_the_path(trajectory: Trajectory, tracks: pl.DataFrame) -> list[tuple[float, str, str]]:
    """When a freely tracked tag was off the prescribed path of its rig: the alarm of Kwon et al. 2021, section 1.

    An estimate is off by what it lies beyond `TOLERANCE` and twice its own spread.
    """
    known = tracks.filter(pl.all_horizontal(pl.col("x_m", "y_m").is_finite()))
    if trajectory.folder.rig.path_knots is None or known.is_empty():
        return []
    path = path_of(trajectory.folder)
    times, places = float_column(known, "t_s"), np.stack([float_column(known, f"{a}_m") for a in "xy"], axis=1)
    spread = np.nan_to_num(np.hypot(float_column(known, "std_x_m"), float_column(known, "std_y_m")))
    rows: list[tuple[float, str, str]] = []
    for start, end, farthest in excursions(times, path.nearest(places)[1], TOLERANCE + 2 * spread, CERTAIN):
        rows.append((float(times[start]), "off the prescribed path", f"up to {farthest:.2f} m from it"))
        if end < len(times):
            rows.append((float(times[end]), "back on the path", f"after {times[end] - times[start]:.1f} s"))
    return rows


def left_the_line(trajectory: Trajectory, tracks: pl.DataFrame) -> list[tuple[float, str, str]]:
    """Rows (t_s, event, detail) of when the trajectory's tag left the line and came back, from its constrained estimates.

    `tracks`: the rows of a line tracker for this tag. The free estimate is a Kalman filter on fixes, or the place where
    recent ranges meet.
    """
    times, free = _free_places(trajectory)
    known = tracks.filter(pl.all_horizontal(pl.col("x_m", "y_m").is_finite()))
    if known.is_empty():
        return []
    held = np.stack([np.interp(times, known["t_s"].to_numpy(), float_column(known, f"{a}_m")) for a in "xy"], axis=1)
    apart = np.sqrt(((free - held) ** 2).sum(axis=1))
    rows: list[tuple[float, str, str]] = []
    for start, end, farthest in excursions(times, apart, LEFT_SLACK, LEFT_LIMIT):
        rows.append(
            (float(times[start]), "left the line", f"up to {farthest:.2f} m between free and constrained estimate")
        )
        if end < len(times):
            rows.append((float(times[end]), "back on the line", f"after {times[end] - times[start]:.1f} s"))
    return rows


def _free_places(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Times and places (T, 2) that know nothing of the path, NaN where there is none."""
    whole = trajectory.recording
    if RANGES in whole.readings:
        times, places = raw_positions(trajectory)
        return times, np.where(_heard(whole)[:, None] >= REDUNDANT, places, np.nan)
    fixes = whole.readings[FIXES]
    missing = np.zeros((len(whole), 1))
    reported = np.zeros((len(whole), 3)) if fixes.reported is None else np.hstack([fixes.reported, missing])
    readings = {FIXES: Readings(np.hstack([fixes.values, missing]), np.hstack([fixes.seen, missing > 0]), reported)}
    free = fix_tracker(planar=True).run(Recording(whole.times, readings, whole.inputs, name=whole.name))
    places = np.stack([np.asarray(x) for x in free.mean.position], axis=1)
    return whole.times, np.where(free.usable[:, None], places, np.nan)


def _heard(recording: Recording) -> np.ndarray:
    """How many different anchors were heard in the last `HEARD_S` seconds, at each row."""
    times, seen = recording.times, recording.readings[RANGES].seen[:, 0]
    number = recording.inputs["anchor"][:, 0]
    heard = np.zeros(len(times), int)
    for anchor in np.unique(number):
        mine = np.flatnonzero(seen & (number == anchor))
        last = np.searchsorted(mine, np.arange(len(times)), side="right") - 1
        heard += (last >= 0) & (times - times[mine[np.maximum(last, 0)]] <= HEARD_S if len(mine) else False)
    return heard
