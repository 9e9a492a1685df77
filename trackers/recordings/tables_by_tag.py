"""The tables of a recording, as data frames and as columns by tag, as they were measured or averaged."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping

import polars as pl

from trackwright.trackers.core.data.seconds import seconds
from trackwright.trackers.recordings.columns import TableRows, TagRows
from trackwright.trackers.recordings.kinds import Layout, std_column, table_kinds
from trackwright.trackers.recordings.truth import TruePaths


class Tables(Mapping[str, pl.DataFrame]):
    """The tables of a recording by name; their rows by tag and the true paths are made once."""

    def __init__(self, frames: Mapping[str, pl.DataFrame]) -> None:
        self._frames = {name: _in_seconds(frame) for name, frame in frames.items()}
        self._rows: dict[tuple[str, float], TagRows] = {}
        self._paths: TruePaths | None = None

    def __getitem__(self, name: str) -> pl.DataFrame:
        return self._frames[name]

    def __contains__(self, name: object) -> bool:
        return name in list(self)

    def __iter__(self) -> Iterator[str]:
        return iter(self._frames)

    def __len__(self) -> int:
        return len(self._frames)

    def __or__(self, other: Mapping[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
        return {**self, **other}

    def rows(self, name: str, interval: float = 0.0) -> TagRows:
        """The rows of the table by tag, averaged over intervals of so many seconds where it has readings."""
        key = name, interval if table_kinds()[name].averaged else 0.0
        if key not in self._rows:
            self._rows[key] = TableRows(averaged(self[name], name, interval) if key[1] else self[name])
        return self._rows[key]

    def paths(self, recording: str) -> TruePaths:
        """The true paths of the tags, none without a truth table; `recording`: the name for messages."""
        if self._paths is None:
            self._paths = TruePaths.of_table(self["truth"], recording) if "truth" in self else TruePaths.none()
        return self._paths


def _in_seconds(frame: pl.DataFrame) -> pl.DataFrame:
    """The table with time stamps as seconds; a cast of them to numbers would count their unit."""
    if not frame.schema.get("t_s", pl.Float64()).is_temporal():
        return frame
    return frame.with_columns(t_s=seconds(frame["t_s"].to_numpy()))


def averaged(table: pl.DataFrame, name: str, interval: float) -> pl.DataFrame:
    """A table with one row for each tag, anchor or station, and interval of so many s; other tables unchanged.

    Values are means, of angles circular ones, of those present, at the mean of the times, and so is signal quality. The
    errors of an interval count as one: a reported standard deviation is the root mean square.
    """
    kind = table_kinds()[name]
    if not kind.averaged:
        return table
    columns = kind.layout(table.columns)
    means = [_mean(column).alias(column) for column in columns.values]
    means += [pl.col(column).mean() for column in columns.quality]
    stds = [s for s in map(std_column, columns.values) if s in table.columns]
    squares = [pl.col(std).pow(2).mean().sqrt().alias(std) for std in stds]
    rows = table.filter(pl.any_horizontal(pl.col(columns.values).is_not_null()))
    # No column has an empty name.
    groups = rows.group_by((pl.col("t_s") / interval).floor().alias(""), *columns.ids)
    averages = groups.agg(pl.col("t_s").mean(), *means, *squares).sort("t_s", *columns.ids)
    return averages.select(_ordered(table, columns))


def _mean(column: str) -> pl.Expr:
    """The mean of a column, of an angle the direction of the mean vector."""
    value = pl.col(column)
    if not column.endswith("_rad"):
        return value.mean()
    return pl.when(value.count() > 0).then(pl.arctan2(value.sin().mean(), value.cos().mean()))


def _ordered(table: pl.DataFrame, columns: Layout) -> list[str]:
    """The columns of the format, in the order of the table."""
    return [c for c in table.columns if c in ("t_s", *itertools.chain(*columns))]
