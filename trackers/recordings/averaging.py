"""Readings averaged over intervals: of sensors that repeat readings, or send them faster than their errors change."""

from __future__ import annotations

import polars as pl

from trackwright.trackers.recordings.kinds import Layout, std_column, table_kinds


def averaged(table: pl.DataFrame, name: str, interval: float) -> pl.DataFrame:
    """A table with one row for each tag, anchor or station, and interval of so many s; other tables unchanged.

    Values are means, of angles circular ones, of those present, at the mean of the times. The errors of an interval
    count as one: a reported standard deviation is the root mean square.
    """
    kind = table_kinds()[name]
    if not kind.averaged:
        return table
    columns = kind.layout(table.columns)
    means = [_mean(column).alias(column) for column in columns.values]
    stds = [s for s in map(std_column, columns.values) if s in table.columns]
    squares = [pl.col(std).pow(2).mean().sqrt().alias(std) for std in stds]
    rows = table.filter(pl.any_horizontal(pl.col(columns.values).is_not_null()))
    groups = rows.with_columns(interval=(pl.col("t_s") / interval).floor()).group_by("interval", *columns.ids)
    found = groups.agg(pl.col("t_s").mean(), *means, *squares).sort("t_s", *columns.ids)
    return found.select(_ordered(table, columns))


def _mean(column: str) -> pl.Expr:
    """The mean of a column, of an angle the direction of the mean vector."""
    value = pl.col(column)
    if not column.endswith("_rad"):
        return value.mean()
    return pl.when(value.count() > 0).then(pl.arctan2(value.sin().mean(), value.cos().mean()))


def _ordered(table: pl.DataFrame, columns: Layout) -> list[str]:
    """The columns of the format, in the order of the table."""
    return [c for c in table.columns if c in ("t_s", *columns.ids, *columns.values, *columns.optional)]
