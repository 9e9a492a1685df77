"""The origin of a recording's times: the time of the source at which `t_s` is zero."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime

import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.kinds import first_time


def origin_of(text: str, tables: Mapping[str, pl.DataFrame]) -> float:
    """The origin, s on the clock of the source: `start`, the earliest measurement, a number, or a date.

    `start` is the earliest row where the tables have no measurements. A date without a time zone is UTC. Raises
    UnusableInput for another text.
    """
    if text == "start":
        return first_time(tables)
    try:
        seconds = float(text)
    except ValueError:
        try:
            date = datetime.fromisoformat(text)
        except ValueError:
            seconds = math.nan
        else:
            seconds = (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    if not math.isfinite(seconds):
        raise UnusableInput(f"--origin {text}: expected start, seconds, or a date such as 2026-05-01T12:00:00.25")
    return seconds


def since(tables: Mapping[str, pl.DataFrame], origin: float) -> dict[str, pl.DataFrame]:
    """The tables with times, s, from the origin on."""
    return {name: table.with_columns(pl.col("t_s") - origin) for name, table in tables.items()}
