"""What is odd but usable in a recording's tables, one line each with counts.

A stream is what one sensor says of one tag; order, gaps and wild values only have a meaning along a stream.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import polars as pl

from trackers.core.rig import Rig
from trackers.recordings.tables import QUATERNION, layout

GAP_FACTOR, GAP_LEAST_S = 5.0, 1.0
WILD_SPREAD, WILD_MEDIAN = 10.0, 100.0
_ANGLE_SLACK = 1e-3  # a printed π rounded up
_LEAST_JUMP = {"m": 1.0, "mps2": 20.0, "radps": 5.0}  # what a person, a cart or a drone can do between two rows


def anomalies(tables: Mapping[str, pl.DataFrame], rig: Rig) -> list[str]:
    """A line for each kind of oddity in each table: unknown tags, impossible values, doubles, gaps, wild values."""
    lines: list[str] = _silent(tables, rig)
    for name, table in tables.items():
        expected = layout(name, table.columns)
        if rig.tags:
            strange = [tag for tag in table["tag"].unique(maintain_order=True) if tag not in rig.tags]
            if strange:
                shown = ", ".join(map(repr, strange[:5])) + (" …" if len(strange) > 5 else "")
                lines.append(f"{name}: tags that are not in rig.toml: {len(strange)} ({shown})")
        lines += _impossible(name, table, expected.values)
        ordered = streams(table.filter(pl.any_horizontal(pl.col(expected.values).is_not_null())), expected.ids)
        lines += _doubles(name, ordered, expected.values)
        if name != "truth":
            lines += _gaps(name, ordered, expected.ids)
            lines += _wild(name, ordered, expected.values)
    return lines


def _silent(tables: Mapping[str, pl.DataFrame], rig: Rig) -> list[str]:
    """Tags of the rig that no table of measurements has a value of."""
    heard: set[str] = set()
    for name, table in tables.items():
        if name != "truth":
            said = table.filter(pl.any_horizontal(pl.col(layout(name, table.columns).values).is_not_null()))
            heard.update(said["tag"].unique())
    silent = [tag for tag in rig.tags if tag not in heard]
    shown = ", ".join(map(repr, silent[:5])) + (" …" if len(silent) > 5 else "")
    return [f"rig.toml: tags that are never heard: {len(silent)} ({shown})"] if silent and heard else []


def streams(table: pl.DataFrame, ids: tuple[str, ...]) -> pl.DataFrame:
    """The table sorted by stream and then time, with `trajectory` (a number), and `dt` in s, null on a stream's first row."""
    code = pl.lit(0, pl.Int64)
    for column in ids:
        kinds = table[column].unique(maintain_order=True)
        code = code * len(kinds) + pl.col(column).cast(pl.Enum(kinds)).to_physical().cast(pl.Int64)
    coded = table.with_columns(stream=code)
    # two stable sorts by numbers are faster than one by two columns, and the first has nothing to do on a sorted table
    coded = coded if table["t_s"].is_sorted() else coded.sort("t_s", maintain_order=True)
    coded = coded.sort("stream", maintain_order=True)
    same = pl.col("stream") == pl.col("stream").shift()
    return coded.with_columns(dt=pl.when(same).then(pl.col("t_s").diff()))


def long_gaps(ordered: pl.DataFrame) -> pl.DataFrame:
    """The rows of `trajectories` that end a gap: longer than 1 s and than five times their stream's median interval."""
    typical = pl.col("dt").filter(pl.col("dt") > 0).median().over("stream")
    longer = ordered.filter(pl.col("dt") > GAP_LEAST_S)
    if longer.height == 0:
        return longer
    mine = ordered.join(longer.select("stream").unique(), on="stream", how="semi")
    return mine.with_columns(typical=typical).filter(
        (pl.col("dt") > GAP_LEAST_S) & (pl.col("dt") > GAP_FACTOR * pl.col("typical"))
    )


def _doubles(name: str, ordered: pl.DataFrame, values: tuple[str, ...]) -> list[str]:
    again = ordered.filter((pl.col("dt") == 0) | (pl.col("dt").shift(-1) == 0))
    if again.height == 0:
        return []
    exact = again.height - again.n_unique(subset=["stream", "t_s", *values])
    times = again.height - again.n_unique(subset=["stream", "t_s"]) - exact
    lines = [f"{name}: rows that stand there twice, values and all: {exact}; kept"] if exact else []
    if times:
        lines.append(f"{name}: rows with the time of another row of the same sensor and tag: {times}; kept")
    return lines


def _gaps(name: str, ordered: pl.DataFrame, ids: tuple[str, ...]) -> list[str]:
    found = long_gaps(ordered)
    if found.height == 0:
        return []
    longest = found.row(int(found["dt"].arg_max() or 0), named=True)
    where = ", ".join(f"{column} {longest[column]}" for column in ids)
    spell = f"the longest {longest['dt']:.3g} s before t_s {longest['t_s']:g} ({where})"
    return [f"{name}: gaps longer than 1 s: {found.height}, {spell}"]


def _impossible(name: str, table: pl.DataFrame, values: tuple[str, ...]) -> list[str]:
    lines = []
    for column in values:
        if column.endswith("_rad"):
            limit = math.pi / 2 if column == "elevation_rad" else math.pi
            beyond = int((table[column].abs() > limit + _ANGLE_SLACK).sum())
            if beyond:
                what = "±π/2" if column == "elevation_rad" else "±π"
                lines.append(f"{name}: values of {column} beyond {what}: {beyond}; degrees, or not wrapped")
        elif column == "range_m":
            negative = int((table[column] < 0).sum())
            if negative:
                lines.append(f"{name}: negative values of {column}: {negative}")
    if set(QUATERNION) <= set(table.columns):
        norm = pl.sum_horizontal(pl.col(QUATERNION) ** 2, ignore_nulls=False).sqrt()
        uneven = int(table.select((norm - 1).abs() > 0.01).to_series().sum())
        if uneven:
            lines.append(f"{name}: quaternions more than 1 % from unit length: {uneven}")
    return lines


def _wild(name: str, ordered: pl.DataFrame, values: tuple[str, ...]) -> list[str]:
    """Values far from both neighbours of their stream, or 100 times the stream's median: spikes, not motion."""
    lines = []
    for column in values:
        least = _LEAST_JUMP.get(column.rpartition("_")[2])
        if least is None:  # angles are bounded: nothing in them is wild
            continue
        x = pl.col(column)
        seen = ordered.select("stream", "t_s", column).drop_nulls()
        spike = pl.lit(False)
        for reach in (1, 2):  # 2 finds a pair of wild values side by side
            before, after = x.shift(reach), x.shift(-reach)
            inside = (pl.col("stream").shift(reach) == pl.col("stream")) & (
                pl.col("stream").shift(-reach) == pl.col("stream")
            )
            middle = x + before + after - pl.max_horizontal(x, before, after) - pl.min_horizontal(x, before, after)
            spike = spike | (inside & ((x - middle).abs() > pl.col("allowed"))).fill_null(False)
        step = x.diff().abs().filter(pl.col("stream") == pl.col("stream").shift())
        per_trajectory = seen.group_by("stream").agg(
            allowed=(WILD_SPREAD * 1.4826 * step.median()).fill_null(0.0).clip(lower_bound=least),
            typical=x.abs().median(),
        )
        tall = (x.abs() > WILD_MEDIAN * pl.col("typical")) & (x.abs() > least)
        wild = seen.join(per_trajectory, on="stream", how="left", maintain_order="left").filter(spike | tall)
        if wild.height:
            worst = wild.row(int((wild[column].abs() - wild["typical"]).abs().arg_max() or 0), named=True)
            example = f"the worst {worst[column]:.4g} at t_s {worst['t_s']:g}"
            lines.append(f"{name}: wild values of {column}: {wild.height}, {example}")
    return lines
