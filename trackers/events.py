"""What happened to tracks and when: lost, found again, and what a tracker's own entry looks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from trackers.line.leaving import absences
from trackers.line.rows import path_of
from trackers.recordings.tracker_spec import TrackerBatch, TrackerSpec
from trackers.recordings.trajectories import Trajectory
from trackers.recordings.truth import numbers, track_keys

EVENTS = "events.parquet"
_COLUMNS = {"t_s": pl.Float64, "event": pl.String, "detail": pl.String}
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
    look = entry.events or (None if entry.bearing_only else off_the_path)
    if look is not None:
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
    times, places = numbers(known, "t_s"), np.stack([numbers(known, f"{a}_m") for a in "xy"], axis=1)
    spread = np.nan_to_num(np.hypot(numbers(known, "std_x_m"), numbers(known, "std_y_m")))
    rows: list[tuple[float, str, str]] = []
    for start, end, farthest in absences(times, path.nearest(places)[1], TOLERANCE + 2 * spread, CERTAIN):
        rows.append((float(times[start]), "off the prescribed path", f"up to {farthest:.2f} m from it"))
        if end < len(times):
            rows.append((float(times[end]), "back on the path", f"after {times[end] - times[start]:.1f} s"))
    return rows
