"""Checks of the time base and of the sampling: start, span, unit, and for each stream rows, rate and gaps."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import moment, place_in_time, span, zero_of
from trackwright.trackers.core.wording import counted
from trackwright.trackers.recordings.checks.anomalies import long_gaps, streams
from trackwright.trackers.recordings.checks.check_result import CheckResult
from trackwright.trackers.recordings.kinds import first_time, layout

STREAMS_SHOWN = 24
"""Tables of more streams get one summary line."""

START_S = 60.0
"""Expected limit of the first time, s."""

_EPOCHS = ((1e17, "nanoseconds"), (1e14, "microseconds"), (1e11, "milliseconds"), (1e8, "seconds"))


def check_time_base(tables: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """The span of all tables in time; times since 1970, a late start and milliseconds are reported."""
    first = min(float(table["t_s"].to_numpy().min()) for table in tables.values())
    last = max(float(table["t_s"].to_numpy().max()) for table in tables.values())
    for least, unit in _EPOCHS:
        if first > least:
            message = (
                f"starts at {first:.0f}: looks like {unit} since 1970, expected seconds since the start of recording"
                + ("; `trackwright import --origin start` makes them so" if unit == "seconds" else "")
            )
            return [CheckResult("warning" if unit == "seconds" else "error", "t_s", message)]
    results = []
    if abs(first) > START_S:
        results.append(CheckResult("warning", "t_s", f"starts at {moment(first)}, expected a start near 0"))
    steps = [table["t_s"].unique().diff().median() for table in tables.values()]
    shortest = min((float(step) for step in steps if isinstance(step, float)), default=0.0)
    if shortest >= 5 and last - first > 1000:
        message = f"rows {shortest:.4g} s apart over {last - first:.6g} s: looks like milliseconds, expected seconds"
        results.append(CheckResult("warning", "t_s", message))
    return [*results, CheckResult("info", "t_s", f"from {span(first, last)}")]


def check_rates(tables: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """Rows, rate and gaps of each stream, or of each table if it has many streams; the share of empty cells."""
    results, zero = [], zero_of(first_time(tables))
    for name, table in tables.items():
        expected = layout(name, table.columns)
        ordered = streams(table.filter(pl.any_horizontal(pl.col(expected.values).is_not_null())), expected.ids)
        if ordered.height == 0:
            results.append(CheckResult("warning" if name == "truth" else "error", name, "all values are missing"))
            continue
        empty = {c: table[c].null_count() / table.height for c in expected.values if table[c].null_count()}
        if empty:
            shares = ", ".join(f"{column} {100 * share:.3g} %" for column, share in empty.items())
            results.append(CheckResult("info", name, f"empty cells: {shares}"))
        gaps = (
            long_gaps(ordered)
            .group_by("stream")
            .agg(gaps=pl.len(), longest=pl.col("dt").max(), before=pl.col("t_s").sort_by("dt").last())
        )
        per_stream = (
            ordered.group_by("stream", *expected.ids, maintain_order=True)
            .agg(rows=pl.len(), interval=pl.col("dt").filter(pl.col("dt") > 0).median())
            .join(gaps, on="stream", how="left", maintain_order="left")
        )
        if per_stream.height <= STREAMS_SHOWN:
            lines = [_stream_line(stream, expected.ids, zero) for stream in per_stream.iter_rows(named=True)]
        else:
            lines = [_summary(per_stream, expected.ids, zero)]
        results += [CheckResult("info", name, line) for line in lines]
    return results


def _stream_line(stream: dict, ids: tuple[str, ...], zero: float) -> str:
    line = ", ".join(f"{column} {stream[column]}" for column in reversed(ids)) + f": {counted(stream['rows'], 'row')}"
    if stream["interval"]:
        line += f", {1 / stream['interval']:.3g} Hz"
    if stream["gaps"]:
        before = place_in_time(stream["before"], zero)
        line += f", long gaps: {stream['gaps']}, the longest {stream['longest']:.3g} s before {before}"
    return line


def _summary(per_stream: pl.DataFrame, ids: tuple[str, ...], zero: float) -> str:
    counts = ", ".join(f"{per_stream[column].n_unique()} {column}s" for column in ids)
    rates = np.sort(1 / per_stream["interval"].drop_nulls().to_numpy())
    line = f"{counts}: {per_stream['rows'].sum()} rows"
    if len(rates):
        low, high = f"{rates[0]:.3g}", f"{rates[-1]:.3g}"
        line += f", {low} Hz each" if low == high else f", {low} to {high} Hz each, median {np.median(rates):.3g} Hz"
    with_gaps = per_stream.filter(pl.col("gaps").is_not_null())
    if with_gaps.height:
        worst = with_gaps.sort("longest").row(-1, named=True)
        where = ", ".join(f"{column} {worst[column]}" for column in ids)
        line += f"; long gaps: {with_gaps['gaps'].sum()}, "
        line += f"the longest {worst['longest']:.3g} s before {place_in_time(worst['before'], zero)} ({where})"
    return line
