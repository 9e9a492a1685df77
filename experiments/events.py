"""What happened to tracks and when: lost, found again, and what a tracker's own entry looks for."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from experiments.entry import Entry, Group
from experiments.matching import track_keys

EVENTS = "events.parquet"
_COLUMNS = {"t_s": pl.Float64, "event": pl.String, "detail": pl.String}
_WORDS = {"lost": "lost", "restarted": "found again"}


def events_of(tracks: pl.DataFrame, entry: Entry, groups: Sequence[Group]) -> pl.DataFrame:
    """One row per event: whose track (recording, tag, station for bearings), `t_s`, `event` in words, `detail`."""
    keys = track_keys(tracks)
    changed = (pl.col("status") != pl.col("status").shift(1).over(keys)).fill_null(True)
    turns = tracks.filter(changed & pl.col("status").is_in(list(_WORDS)))
    found = [
        turns.select(
            *keys, pl.col("t_s"), pl.col("status").replace_strict(_WORDS).alias("event"), pl.lit("").alias("detail")
        )
    ]
    if entry.events is not None:
        lanes = {(lane.folder.name, lane.tag): lane for group in groups for lane in group.lanes}
        for (recording, tag), lane in lanes.items():
            mine = tracks.filter((pl.col("recording") == recording) & (pl.col("tag") == tag))
            table = pl.DataFrame(entry.events(lane, mine), schema=_COLUMNS, orient="row")
            found.append(table.select(pl.lit(recording).alias("recording"), pl.lit(tag).alias("tag"), *_COLUMNS))
    return pl.concat(found, how="diagonal").sort([*keys, "t_s"], maintain_order=True)
