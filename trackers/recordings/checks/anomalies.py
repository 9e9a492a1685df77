"""Anomalies in the tables of a usable recording, one line each with counts: ids, values, duplicates, gaps, outliers.

A stream is the rows of one sensor and one tag in one table; order, gaps and outliers are defined along a stream.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import place_in_time, zero_of
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.columns import codes, stable_order
from trackwright.trackers.recordings.kinds import QUATERNION, Kind, duplicates_line, first_time, table_kinds

DT = pl.col("dt")
JUMP_S = 1e7
"""Time between two rows, s, that is a jump of the clock and no gap."""

LONG_GAP = DT.gt(1.0) & DT.gt(5.0 * DT.filter(DT > 0).median()) & DT.lt(JUMP_S)
"""Of the rows of one stream: those after a gap longer than 1 s and than five times its median interval."""

_LEAST_JUMP = {"m": 1.0, "mps": 5.0, "mps2": 20.0, "radps": 5.0}
"""Least jumps of outliers by unit: smaller ones are within reach of a person, cart or drone between two rows."""


def anomalies(tables: Mapping[str, pl.DataFrame], rig: Rig) -> Iterator[str]:
    """A line for each kind of anomaly in each table, and one for all outliers; empty for a clean recording."""
    kinds, zero, outliers, observed = table_kinds(), zero_of(first_time(tables)), list[str](), set[str]()
    for name, table in tables.items():
        kind = kinds[name]
        ids, values, *_ = kind.layout(table.columns)
        unknown = [tag for tag in table["tag"].unique(maintain_order=True) if rig.tags and tag not in rig.tags]
        if unknown:
            yield f"{name}: tags that are not in rig.toml: {len(unknown)} ({listed(map(repr, unknown))})"
        yield from _impossible(kind, table, values)
        yield from _jumps(name, table)
        present = with_value(table, values)
        ordered = streams(present, ids)
        if (ordered["dt"] == 0).any():
            yield from _duplicates(name, ordered, values)
        if name == "truth":
            continue
        observed |= {*present["tag"].unique()}
        # Which anchors a message has in common changes from one to the next.
        gaps = (streams(present, ids[:1]) if kind.difference else ordered).filter(LONG_GAP.over("stream"))
        if gaps.height:
            longest = gaps.row(int(gaps["dt"].arg_max() or 0), named=True)
            place = _place(longest, ids[:1] if kind.difference else ids, zero)
            yield f"{name}: gaps longer than 1 s: {gaps.height}, the longest {longest['dt']:.3g} s before {place}"
        outliers += _outliers(name, ordered, ids, values, zero)
    unobserved = [tag for tag in rig.tags if tag not in observed]
    if unobserved and observed:
        count = f"{len(unobserved)} of {len(rig.tags)} ({listed(map(repr, unobserved))})"
        yield f"rig.toml: tags never observed: {count}"
    if outliers:
        yield "; ".join(outliers)


def with_value(table: pl.DataFrame, values: Sequence[str]) -> pl.DataFrame:
    """The rows with any of the values."""
    return table.filter(pl.any_horizontal(pl.col(values).is_not_null()))


def streams(table: pl.DataFrame, ids: Sequence[str]) -> pl.DataFrame:
    """The table sorted by stream, then time, with `stream` (its number) and `dt`, s, null in its first row."""
    table = table.sort("t_s", maintain_order=True)
    code = np.zeros(len(table), np.int64)
    for column in ids:
        kinds = table[column].unique(maintain_order=True)
        code = code * len(kinds) + codes(table[column], list(kinds))
    ordered = table.with_columns(stream=code)[stable_order(code)]
    return ordered.with_columns(dt=pl.when(pl.col("stream") == pl.col("stream").shift()).then(pl.col("t_s").diff()))


def _duplicates(name: str, ordered: pl.DataFrame, values: Sequence[str]) -> Iterator[str]:
    repeated = ordered.filter((DT == 0) | (DT.shift(-1) == 0))
    exact = repeated.height - repeated.n_unique(subset=["stream", "t_s", *values])
    times = repeated.height - repeated.n_unique(subset=["stream", "t_s"]) - exact
    if exact:
        yield duplicates_line(name, exact)
    if times:
        few = "; the stamps have lost digits" if times > ordered.height / 2 else ""
        yield f"{name}: rows with the time of another row of the same sensor and tag: {times}; kept{few}"


def _jumps(name: str, table: pl.DataFrame) -> Iterator[str]:
    """Clocks that jump by months or more, and times of 0 among others far away."""
    times = table["t_s"].sort().to_numpy()
    steps = np.diff(times)
    for k in np.flatnonzero(steps > JUMP_S).tolist():
        if times[0] == 0.0 == times[k]:
            yield f"{name}: times of 0 in {k + 1} rows, the others from {times[k + 1]:.10g} s: missing; remove the rows"
        else:
            jump = f"the clock jumps by {steps[k] / 31_557_600:.3g} years at row {k + 2} in order of time"
            yield f"{name}: {jump}, from {times[k]:.10g} to {times[k + 1]:.10g} s: make two recordings"


def _place(row: Mapping[str, Any], ids: Sequence[str], zero: float) -> str:
    """The time, the tag and the sensors of a row."""
    return f"{place_in_time(row['t_s'], zero)} ({', '.join(f'{column} {row[column]}' for column in ids)})"


def _impossible(kind: Kind, table: pl.DataFrame, values: Sequence[str]) -> Iterator[str]:
    """Angles out of their range, negative distances, and quaternions that are none."""
    x, norm = pl.col(values), pl.sum_horizontal(pl.col("^q[wxyz]$") ** 2, ignore_nulls=False).sqrt()
    for name in values:
        column, x = kind.column(name), pl.col(name)
        bounds = "±π/2" if column.bound < math.pi else "±π"
        if column.unit == "rad":  # with room for π rounded up in text
            broken, words = x.abs() > column.bound + 1e-3, f"values of {name} beyond {bounds}"
        else:
            broken, words = x < (0.0 if column.positive else -math.inf), f"negative values of {name}"
        if n := table.select(broken.sum()).item():
            why = "; degrees, or not wrapped"
            if column.unit != "rad" or not_wrapped(table[name], column.bound):
                why = "; from 0 to 2π, not wrapped: trackers wrap them" if column.unit == "rad" else ""
            yield f"{kind.name}: {words}: {n}{why}"
    if {*QUATERNION} <= {*table.columns} and (n := table.select(((norm - 1).abs() > 0.01).sum()).item()):
        yield f"{kind.name}: quaternions more than 1 % from unit length: {n}"


def not_wrapped(angles: pl.Series, bound: float) -> bool:
    """Whether angles, rad, some of them beyond their bound, are from 0 to 2π and within it when wrapped."""
    x = angles.drop_nulls().to_numpy()
    turned = np.mod(x + np.pi, 2 * np.pi) - np.pi
    return bool(((x >= -1e-3) & (x <= 2 * np.pi + 1e-3) & (np.abs(turned) <= bound + 1e-3)).all())


def _outliers(
    name: str, ordered: pl.DataFrame, ids: Sequence[str], columns: Sequence[str], zero: float
) -> Iterator[str]:
    """Values far from both neighbours in their stream, or above 100 times its median: spikes, unlike motion."""
    for column, least in ((name, _LEAST_JUMP.get(name.rpartition("_")[2])) for name in columns):
        if least is None:  # angles are bounded
            continue
        x = pl.col(column)
        rows = ordered.select("stream", "t_s", *ids, column).drop_nulls(column)
        steps, away = (
            x.diff().abs().median().over("stream").fill_null(0.0),
            (x - x.rolling_median(9, center=True)).abs(),
        )
        rows = rows.with_columns(
            allowed=(14.826 * steps).clip(least), typical=x.abs().median().over("stream"), away=away.over("stream")
        ).with_columns(middle=pl.col("away").median().over("stream"), jumping=steps > 3 * least)
        broken = (x.abs() > 100 * pl.col("typical")) & (x.abs() > least)
        # Where many are wild, so are the neighbours of most.
        many = (pl.col("away") > (14.826 * pl.col("middle")).clip(2 * least)) & pl.col("jumping")
        broken = broken | many.fill_null(False)
        for reach in (1, 2):  # 2 finds two adjacent outliers
            before, after = (x.shift(way).over("stream") for way in (reach, -reach))
            middle = x.clip(pl.min_horizontal(before, after), pl.max_horizontal(before, after))
            known = before.is_not_null() & after.is_not_null()
            broken = broken | (known & ((x - middle).abs() > pl.col("allowed")))
        found = rows.filter(broken)
        if found.height:
            worst = found.row(int((found[column].abs() - found["typical"]).abs().arg_max() or 0), named=True)
            example = f"the worst {worst[column]:.4g} at {_place(worst, ids, zero)}"
            yield f"{name}: outliers of {column}: {found.height}, {example}"
