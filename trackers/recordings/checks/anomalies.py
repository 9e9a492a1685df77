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
from trackwright.trackers.recordings.kinds import QUATERNION, Kind, first_time, table_kinds

GAP_FACTOR, GAP_LEAST_S = 5.0, 1.0
OUTLIER_SPREAD, OUTLIER_MEDIAN = 10.0, 100.0
_ANGLE_SLACK = 1e-3  # for π rounded up in text
_LEAST_JUMP = {"m": 1.0, "mps": 5.0, "mps2": 20.0, "radps": 5.0}
"""Least jumps of outliers by unit: smaller ones are within reach of a person, cart or drone between two rows."""


def anomalies(tables: Mapping[str, pl.DataFrame], rig: Rig) -> Iterator[str]:
    """A line for each kind of anomaly in each table, and one for all outliers; empty for a clean recording."""
    kinds = table_kinds()
    layouts = {name: kinds[name].layout(table.columns) for name, table in tables.items()}
    present = {
        name: table.select("t_s", *layouts[name].ids, *layouts[name].values)
        .filter(pl.any_horizontal(pl.col(layouts[name].values).is_not_null()))
        .with_row_index("row")
        for name, table in tables.items()
    }
    tags = {name: table["tag"].unique(maintain_order=True) for name, table in present.items()}
    observed = {tag for name, tags_of_table in tags.items() if name != "truth" for tag in tags_of_table}
    unobserved = [tag for tag in rig.tags if tag not in observed]
    if unobserved and observed:
        count = f"{len(unobserved)} of {len(rig.tags)} ({listed(map(repr, unobserved))})"
        yield f"rig.toml: tags never observed: {count}"
    outliers, zero = list[str](), zero_of(first_time(tables))
    for name, table in tables.items():
        expected, whole = layouts[name], present[name]
        if rig.tags:
            of_all = tags[name] if len(whole) == len(table) else table["tag"].unique(maintain_order=True)
            unknown = [tag for tag in of_all if tag not in rig.tags]
            if unknown:
                yield f"{name}: tags that are not in rig.toml: {len(unknown)} ({listed(map(repr, unknown))})"
        yield from _impossible(kinds[name], table, expected.values)
        compared = [column for column in expected.values if _least_jump(column) is not None]
        # Ordering ids and the phases of many antennas takes as long as reading them.
        ordered = streams(whole, expected.ids, ["row", "t_s", *compared], tags[name])
        if (ordered["dt"] == 0).any():
            yield from _duplicates(name, streams(whole, expected.ids), expected.values)
        if name != "truth":
            # Which anchors a message has in common changes from one to the next.
            of_gaps = expected.ids[:1] if kinds[name].difference else expected.ids
            by_gaps = ordered if of_gaps == expected.ids else streams(whole, of_gaps, ["row", "t_s"], tags[name])
            gaps = long_gaps(by_gaps)
            if gaps.height:
                longest = gaps.row(int(gaps["dt"].arg_max() or 0), named=True)
                place = _place(longest, whole.select(of_gaps), zero)
                yield f"{name}: gaps longer than 1 s: {gaps.height}, the longest {longest['dt']:.3g} s before {place}"
            outliers += _outliers(name, ordered, whole.select(expected.ids), compared, zero)
    if outliers:
        yield "; ".join(outliers)


def streams(
    table: pl.DataFrame, ids: tuple[str, ...], columns: Sequence[str] | None = None, tags: pl.Series | None = None
) -> pl.DataFrame:
    """The table sorted by stream, then time, with `stream` (its number) and `dt`, s, null in its first row.

    `columns`: those that are kept; by default all. `tags`: all of the table, where they are known.
    """
    table = table if table["t_s"].is_sorted() else table.sort("t_s", maintain_order=True)
    code = np.zeros(len(table), np.int64)
    for column in ids:
        kinds = table[column].unique(maintain_order=True) if tags is None or column != "tag" else tags
        code = code * len(kinds) + codes(table[column], list(kinds))
    coded = (table if columns is None else table.select(columns)).with_columns(stream=code)[stable_order(code)]
    same = pl.col("stream") == pl.col("stream").shift()
    return coded.with_columns(dt=pl.when(same).then(pl.col("t_s").diff()))


def long_gaps(ordered: pl.DataFrame) -> pl.DataFrame:
    """The rows of `streams` after a gap longer than 1 s and than five times the median interval of their stream."""
    typical = pl.col("dt").filter(pl.col("dt") > 0).median().over("stream")
    longer = ordered.filter(pl.col("dt") > GAP_LEAST_S)
    if longer.height == 0:
        return longer
    candidates = ordered.join(longer.select("stream").unique(), on="stream", how="semi")
    return candidates.with_columns(typical=typical).filter(
        (pl.col("dt") > GAP_LEAST_S) & (pl.col("dt") > GAP_FACTOR * pl.col("typical"))
    )


def _duplicates(name: str, ordered: pl.DataFrame, values: tuple[str, ...]) -> Iterator[str]:
    repeated = ordered.filter((pl.col("dt") == 0) | (pl.col("dt").shift(-1) == 0))
    exact = repeated.height - repeated.n_unique(subset=["stream", "t_s", *values])
    times = repeated.height - repeated.n_unique(subset=["stream", "t_s"]) - exact
    if exact:
        yield f"{name}: duplicate rows: {exact}; kept"
    if times:
        yield f"{name}: rows with the time of another row of the same sensor and tag: {times}; kept"


def _place(row: Mapping[str, Any], ids: pl.DataFrame, zero: float) -> str:
    """The time, the tag and the sensors of a row."""
    of = ", ".join(f"{column} {ident}" for column, ident in ids.row(row["row"], named=True).items())
    return f"{place_in_time(row['t_s'], zero)} ({of})"


def _impossible(kind: Kind, table: pl.DataFrame, values: tuple[str, ...]) -> Iterator[str]:
    for name in values:
        column = kind.column(name)
        if column.unit == "rad":
            beyond = int((table[name].abs() > column.bound + _ANGLE_SLACK).sum())
            if beyond:
                bounds = "±π/2" if column.bound < math.pi else "±π"
                yield f"{kind.name}: values of {name} beyond {bounds}: {beyond}; degrees, or not wrapped"
        elif column.positive and (negative := int((table[name] < 0).sum())):
            yield f"{kind.name}: negative values of {name}: {negative}"
    if set(QUATERNION) <= set(table.columns):
        norm = pl.sum_horizontal(pl.col(QUATERNION) ** 2, ignore_nulls=False).sqrt()
        uneven = int(table.select((norm - 1).abs() > 0.01).to_series().sum())
        if uneven:
            yield f"{kind.name}: quaternions more than 1 % from unit length: {uneven}"


def _least_jump(column: str) -> float | None:
    """The least jump of an outlier in the column's unit; None for angles, which are bounded."""
    return _LEAST_JUMP.get(column.rpartition("_")[2])


def _outliers(
    name: str, ordered: pl.DataFrame, ids: pl.DataFrame, columns: Sequence[str], zero: float
) -> Iterator[str]:
    """Values far from both neighbours in their stream, or above 100 times its median: spikes, unlike motion."""
    for column in columns:
        x, least = pl.col(column), _least_jump(column)
        present = ordered.select("stream", "row", "t_s", column).drop_nulls()
        spike = pl.lit(False)
        for reach in (1, 2):  # 2 finds two adjacent outliers
            before, after = x.shift(reach), x.shift(-reach)
            inside = (pl.col("stream").shift(reach) == pl.col("stream")) & (
                pl.col("stream").shift(-reach) == pl.col("stream")
            )
            middle = x + before + after - pl.max_horizontal(x, before, after) - pl.min_horizontal(x, before, after)
            spike = spike | (inside & ((x - middle).abs() > pl.col("allowed"))).fill_null(False)
        step = x.diff().abs().filter(pl.col("stream") == pl.col("stream").shift())
        per_stream = present.group_by("stream").agg(
            allowed=(OUTLIER_SPREAD * 1.4826 * step.median()).fill_null(0.0).clip(lower_bound=least),
            typical=x.abs().median(),
        )
        tall = (x.abs() > OUTLIER_MEDIAN * pl.col("typical")) & (x.abs() > least)
        outliers = present.join(per_stream, on="stream", how="left", maintain_order="left").filter(spike | tall)
        if outliers.height:
            worst = outliers.row(int((outliers[column].abs() - outliers["typical"]).abs().arg_max() or 0), named=True)
            example = f"the worst {worst[column]:.4g} at {_place(worst, ids, zero)}"
            yield f"{name}: outliers of {column}: {outliers.height}, {example}"
