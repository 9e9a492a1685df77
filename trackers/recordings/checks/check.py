"""Is this recording sane: time base, order, duplicates, gaps, rates, ids, units, truth, geometry.

Units and geometry have files of their own (`trackers.recordings.checks.units`, `trackers.recordings.checks.geometry`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import polars as pl

from trackers.core.rig import Rig
from trackers.recordings.checks.anomalies import anomalies, long_gaps, streams
from trackers.recordings.checks.findings import LEVELS, Finding, Level, format_findings
from trackers.recordings.checks.geometry import check_geometry
from trackers.recordings.checks.units import check_units
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tables import MEASUREMENTS, layout

__all__ = ["Finding", "check_folder", "format_findings"]

LANES_SHOWN = 24  # more are summed up by sensor, or by table where there are many sensors
HOLE_S, HOLE_M = 1.0, 0.02  # truth is not interpolated over a longer hole in which it moved further
ENOUGH = 0.5  # of the measurements inside the truth
START_S = 60.0
_EPOCHS = ((1e17, "nanoseconds"), (1e14, "microseconds"), (1e11, "milliseconds"), (1e8, "seconds"))


def check_folder(folder: RecordingFolder) -> list[Finding]:
    """What is wrong, odd or good to know about a recording that could be read, the gravest first."""
    tables, rig = folder.tables, folder.rig
    findings = []
    for notice in dict.fromkeys((*folder.notices, *anomalies(tables, rig))):
        where, _, message = notice.partition(": ")
        findings.append(Finding("warning", where, message))
    measured = {name: tables[name] for name in MEASUREMENTS if name in tables}
    if not measured:
        findings.append(Finding("error", "tables", "there is nothing but truth: nothing to track"))
    findings += _time_base(measured or tables)
    findings += _rates(tables)
    findings += _ids(rig, measured)
    findings += check_units(rig, tables)
    if measured and "truth" in tables:
        findings += _truth(tables["truth"], measured)
    findings += check_geometry(rig, tables)
    return sorted(findings, key=lambda finding: LEVELS.index(finding.level))


def _time_base(tables: Mapping[str, pl.DataFrame]) -> list[Finding]:
    first = min(float(table["t_s"].to_numpy().min()) for table in tables.values())
    last = max(float(table["t_s"].to_numpy().max()) for table in tables.values())
    for least, unit in _EPOCHS:
        if first > least:
            message = f"starts at {first:.0f}: looks like {unit} since 1970, expected seconds from the recording's zero"
            return [Finding("warning" if unit == "seconds" else "error", "t_s", message)]
    findings = []
    if abs(first) > START_S:
        findings.append(Finding("warning", "t_s", f"starts at {first:.6g} s, expected a start near 0"))
    steps = [table["t_s"].unique().diff().median() for table in tables.values()]
    shortest = min((float(step) for step in steps if isinstance(step, float)), default=0.0)
    if shortest >= 5 and last - first > 1000:
        message = f"rows {shortest:.4g} s apart over {last - first:.6g} s: looks like milliseconds, expected seconds"
        findings.append(Finding("warning", "t_s", message))
    return [*findings, Finding("info", "t_s", f"from {first:.6g} to {last:.6g} s")]


def _rates(tables: Mapping[str, pl.DataFrame]) -> list[Finding]:
    """One line a stream while there are few, else one a table: rows, rate, gaps; and the share of empty cells."""
    findings = []
    for name, table in tables.items():
        expected = layout(name, table.columns)
        values = pl.col(expected.values)
        ordered = streams(table.filter(pl.any_horizontal(values.is_not_null())), expected.ids)
        if ordered.height == 0:
            findings.append(Finding("warning" if name == "truth" else "error", name, "has not a single value"))
            continue
        empty = {c: table[c].null_count() / table.height for c in expected.values if table[c].null_count()}
        if empty:
            shares = ", ".join(f"{column} {100 * share:.3g} %" for column, share in empty.items())
            findings.append(Finding("info", name, f"empty cells: {shares}"))
        gaps = (
            long_gaps(ordered).group_by("stream").agg(gaps=pl.len(), longest=pl.col("dt").max(), before=_at_longest())
        )
        per_trajectory = (
            ordered.group_by("stream", *expected.ids, maintain_order=True)
            .agg(
                rows=pl.len(),
                interval=pl.col("dt").filter(pl.col("dt") > 0).median(),
            )
            .join(gaps, on="stream", how="left", maintain_order="left")
        )
        if per_trajectory.height <= LANES_SHOWN:
            words = [_trajectory_words(stream, expected.ids) for stream in per_trajectory.iter_rows(named=True)]
        else:
            words = [_summary(per_trajectory, expected.ids)]
        findings += [Finding("info", name, line) for line in words]
    return findings


def _at_longest() -> pl.Expr:
    return pl.col("t_s").sort_by("dt").last()


def _trajectory_words(stream: dict, ids: tuple[str, ...]) -> str:
    words = ", ".join(f"{column} {stream[column]}" for column in reversed(ids)) + f": {stream['rows']} rows"
    if stream["interval"]:
        words += f", {1 / stream['interval']:.3g} a second"
    if stream["gaps"]:
        words += f", long gaps: {stream['gaps']}, the longest {stream['longest']:.3g} s before t_s {stream['before']:g}"
    return words


def _summary(per_trajectory: pl.DataFrame, ids: tuple[str, ...]) -> str:
    counts = ", ".join(f"{per_trajectory[column].n_unique()} {column}s" for column in ids)
    rates = np.sort(1 / per_trajectory["interval"].drop_nulls().to_numpy())
    words = f"{counts}: {per_trajectory['rows'].sum()} rows"
    if len(rates):
        words += f", each {rates[0]:.3g} to {rates[-1]:.3g} a second, median {np.median(rates):.3g}"
    gappy = per_trajectory.filter(pl.col("gaps").is_not_null())
    if gappy.height:
        worst = gappy.sort("longest").row(-1, named=True)
        where = ", ".join(f"{column} {worst[column]}" for column in ids)
        words += f"; long gaps: {gappy['gaps'].sum()}, "
        words += f"the longest {worst['longest']:.3g} s before t_s {worst['before']:g} ({where})"
    return words


def _ids(rig: Rig, measured: Mapping[str, pl.DataFrame]) -> list[Finding]:
    """Ids of the rig that no measurement comes from: a dead device, or a misspelt id."""
    heard: dict[str, set[str]] = {"tag": set(), "anchor": set(), "station": set()}
    for name, table in measured.items():
        expected = layout(name, table.columns)
        seen = table.filter(pl.any_horizontal(pl.col(expected.values).is_not_null()))
        for column in expected.ids:
            heard[column] |= set(seen[column].unique())
    findings = []
    for column, known in (("anchor", rig.anchors), ("station", rig.stations), ("tag", rig.tags)):
        silent = [key for key in known if key not in heard[column]]
        # anchors behind ready-made fixes are never named in a table
        if silent and (heard[column] or column == "station"):
            shown = ", ".join(silent[:8]) + (" …" if len(silent) > 8 else "")
            findings.append(
                Finding("warning", "rig.toml", f"{column}s never heard: {len(silent)} of {len(known)} ({shown})")
            )
    return findings


def _truth(truth: pl.DataFrame, measured: Mapping[str, pl.DataFrame]) -> list[Finding]:
    """Holes in the truth, and how many measurements lie inside it."""
    place = ("x_m", "y_m", "z_m")
    moved = pl.sum_horizontal(*((pl.col(c).shift(-1) - pl.col(c)) ** 2 for c in place)).sqrt()
    known = streams(truth.drop_nulls(place), ("tag",)).with_columns(
        until=pl.col("t_s").shift(-1).over("stream"), moved=moved
    )
    hole = (pl.col("until") - pl.col("t_s") > HOLE_S) & (pl.col("moved") > HOLE_M)
    known = known.with_columns(since=pl.col("t_s"), hole=hole.fill_null(False))
    findings = []
    holes = known.filter("hole").with_columns(lasts=pl.col("until") - pl.col("t_s"))
    if holes.height:
        worst = holes.sort("lasts").row(-1, named=True)
        message = (
            f"holes longer than {HOLE_S:g} s in which it moved: {holes.height}, the longest {worst['lasts']:.3g} s "
            f"after t_s {worst['t_s']:g} (tag {worst['tag']}); estimates inside are not judged"
        )
        findings.append(Finding("warning", "truth", message))
    rows = pl.concat([table.select("t_s", "tag") for table in measured.values()]).sort("t_s")
    right = known.sort("t_s").select("t_s", "tag", "since", "until", "hole")
    matched = rows.join_asof(right, on="t_s", by="tag", strategy="backward", check_sortedness=False)
    inside = (pl.col("until").is_not_null() & ~pl.col("hole")) | (pl.col("since") == pl.col("t_s"))
    share = float(matched.select(inside.fill_null(False).mean()).item())
    untrue = sorted(set(rows["tag"].unique()) - set(known["tag"].unique()))
    if untrue:
        shown = ", ".join(untrue[:8]) + (" …" if len(untrue) > 8 else "")
        findings.append(Finding("info", "truth", f"measured tags without truth: {len(untrue)} ({shown})"))
    if math.isclose(share, 0.0):
        message = "no measurement lies inside the truth's time; expected one clock and one zero for all tables"
        return [*findings, Finding("error", "truth", message)]
    level: Level = "info" if share >= ENOUGH else "warning"
    return [*findings, Finding(level, "truth", f"covers {100 * share:.3g} % of the measurements in time")]
