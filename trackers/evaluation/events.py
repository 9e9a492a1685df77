"""Events of tracks: lost, and found again."""

from __future__ import annotations

import polars as pl

from trackwright.trackers.recordings.tracks_table import track_keys

EVENTS = "events.parquet"
"""File in the output folder of `trackwright track`."""


def events_of(tracks: pl.DataFrame) -> pl.DataFrame:
    """One row per event of a table of estimates: recording, tag (and station for bearings), `t_s`, `event`."""
    keys = track_keys(tracks)
    # A track lost and found again at one time has the status of a restart alone, which is both events.
    restarted, before = pl.col("status") == "restarted", pl.col("status").shift(1).over(keys)
    lost = ((pl.col("status") == "lost") | restarted) & (before != "lost").fill_null(True)
    events = [
        tracks.filter(happened).select(*keys, "t_s", event=pl.lit(event))
        for event, happened in (("lost", lost), ("found again", restarted))
    ]
    return pl.concat(events).sort([*keys, "t_s"], maintain_order=True)
