"""Checks of sampling and coverage: time base, rates, gaps; ids without measurements; holes in the truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import HOLE_M, HOLE_S, moment, place_in_time, span, zero_of
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.wording import counted
from trackwright.trackers.recordings.checks import CheckResult, Level
from trackwright.trackers.recordings.checks.anomalies import long_gaps, streams
from trackwright.trackers.recordings.kinds import first_time, layout

ENOUGH = 0.5
"""Share of the measurements that truth should cover."""

STREAMS_SHOWN = 24
"""Tables of more streams get one summary line."""

START_S = 60.0
"""Expected limit of the first time, s."""

FAR, FAR_S = 10.0, 600.0
"""Time between two tables of a tag, in their lengths and in s, from which they have two clocks."""

_OUTSIDE = "no measurement lies inside the time span of the truth"
_FINER_UNITS = ((1e17, "nanoseconds"), (1e14, "microseconds"), (1e11, "milliseconds"))
_SINCE_1970_S = 1e8
_EXPECTED_TIMES = "expected seconds since the start of recording"


def check_ids(rig: Rig, measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Anchors and stations of the rig without a measurement: failed devices, or misspelt ids."""
    observed: dict[str, set[str]] = {"anchor": set(), "station": set()}
    for name, table in measured.items():
        expected = layout(name, table.columns)
        present = table.filter(pl.any_horizontal(pl.col(expected.values).is_not_null()))
        for column in expected.ids[1:]:
            observed[column.partition("_")[0]] |= set(present[column].unique())
    for noun, known in (("anchor", rig.anchors), ("station", rig.stations)):
        unobserved = [key for key in known if key not in observed[noun]]
        # a folder of fixes may have anchors that no table names
        if unobserved and (observed[noun] or noun == "station"):
            count = f"{len(unobserved)} of {len(known)} ({listed(unobserved, 8)})"
            yield CheckResult("warning", "rig.toml", f"{noun}s never observed: {count}")


def check_truth(truth: pl.DataFrame, measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Holes in the truth, measured tags without truth, and the share of measurements that truth covers."""
    axes = ("x_m", "y_m", "z_m")
    moved = pl.sum_horizontal(*((pl.col(c).shift(-1) - pl.col(c)) ** 2 for c in axes)).sqrt()
    lasts = pl.col("t_s").shift(-1).over("stream") - pl.col("t_s")
    known = streams(truth.drop_nulls(axes), ("tag",)).with_columns(lasts=lasts, since=pl.col("t_s"))
    known = known.with_columns(hole=((pl.col("lasts") > HOLE_S) & (moved > HOLE_M)).fill_null(False))
    holes = known.filter("hole")
    if holes.height:
        worst = holes.sort("lasts").row(-1, named=True)
        begin = place_in_time(worst["t_s"], zero_of(first_time(measured)))
        message = (
            f"holes longer than {HOLE_S:g} s with motion: {holes.height}, the longest {worst['lasts']:.3g} s "
            f"after {begin} (tag {worst['tag']}); estimates inside are not scored"
        )
        yield CheckResult("warning", "truth", message)
    rows = pl.concat([table.select("t_s", "tag") for table in measured.values()]).sort("t_s")
    right = known.sort("t_s").select("t_s", "tag", "since", "lasts", "hole")
    joined = rows.join_asof(right, on="t_s", by="tag", strategy="backward", check_sortedness=False)
    inside = (pl.col("lasts").is_not_null() & ~pl.col("hole")) | (pl.col("since") == pl.col("t_s"))
    share = float(joined.select(inside.fill_null(False).mean()).item())
    without = sorted(set(rows["tag"].unique()) - set(known["tag"].unique()))
    if without:
        yield CheckResult("info", "truth", f"measured tags without truth: {len(without)} ({listed(without, 8)})")
    apart = list(check_overlap(truth, measured))
    yield from apart
    if not apart and share == 0.0:
        yield CheckResult("error", "truth", f"{_OUTSIDE}; expected one clock for all tables")
    elif not apart:
        level: Level = "info" if share >= ENOUGH else "warning"
        yield CheckResult(level, "truth", f"covers {100 * share:.3g} % of the measurements in time")


def check_overlap(truth: pl.DataFrame, measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error where truth and measurements have no time in common: how far they are apart, and the likely cause."""
    (first, last), (start, end) = _span({"truth": truth}), _span(measured)
    if first <= end and last >= start:
        return
    message = f"{_OUTSIDE}, {span(first, last)}; the measurements begin at {moment(start)}"
    yield CheckResult("error", "truth", f"{message}{_two_clocks(first - start)}")


def check_clocks(measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error for each table that is far in time from the first one of a tag."""
    firsts = dict[str, tuple[str, float, float]]()
    ends = pl.col("t_s").min().alias("start"), pl.col("t_s").max().alias("end")
    for name, table in measured.items():
        for tag, start, end in table.group_by("tag", maintain_order=True).agg(*ends).iter_rows():
            one, first, last = firsts.setdefault(tag, (name, start, end))
            # One sensor may be switched on after another was switched off.
            if max(start - last, first - end) > max(FAR * (last - first + end - start), FAR_S):
                message = f"tag {tag}: {span(start, end)}, and {one} {span(first, last)}{_two_clocks(start - first)}"
                yield CheckResult("error", name, message)
                break


def _two_clocks(apart: float) -> str:
    """The likely cause of tables that begin so many seconds apart, and what is expected."""
    half_hours, cause = apart / 1800, ""
    if abs(apart) > 1e8:
        cause = "; one of them counts from 1970, the other from its own zero"
    elif abs(half_hours) > 0.8 and abs(half_hours - round(half_hours)) < 0.05:
        cause = f"; {half_hours / 2:.3g} hours apart, as two time zones"
    return f"{cause}; expected one clock for all tables"


def _span(tables: Mapping[str, pl.DataFrame]) -> tuple[float, float]:
    """The first and the last time of all tables, s."""
    times = [table["t_s"].to_numpy() for table in tables.values()]
    return min(float(t.min()) for t in times), max(float(t.max()) for t in times)


def check_time_unit(tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error for times in fractions of seconds since 1970, a warning for times that look like milliseconds."""
    first, last = _span(tables)
    unit = next((unit for least, unit in _FINER_UNITS if first > least), None)
    if unit is not None:
        yield CheckResult("error", "t_s", f"starts at {first:.0f}: looks like {unit} since 1970, {_EXPECTED_TIMES}")
        return
    steps = [table["t_s"].unique().diff().median() for table in tables.values()]
    shortest = min((float(step) for step in steps if isinstance(step, float)), default=0.0)
    if shortest >= 5 and last - first > 1000:
        message = f"rows {shortest:.4g} s apart over {last - first:.6g} s: looks like milliseconds, expected seconds"
        yield CheckResult("warning", "t_s", message)


def check_time_base(tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """The span of all tables in time; warnings for times since 1970 and for a late start."""
    first, last = _span(tables)
    if first > _FINER_UNITS[-1][0]:
        return
    if first > _SINCE_1970_S:
        message = f"starts at {first:.0f}: looks like seconds since 1970, {_EXPECTED_TIMES}"
        yield CheckResult("warning", "t_s", f"{message}; `trackwright import --origin start` makes them so")
        return
    if abs(first) > START_S:
        yield CheckResult("warning", "t_s", f"starts at {moment(first)}, expected a start near 0")
    yield CheckResult("info", "t_s", f"from {span(first, last)}")


def check_values(tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error for each table without any value, a warning for such a truth."""
    for name, table in tables.items():
        if not any(table[column].count() for column in layout(name, table.columns).values):
            yield CheckResult("warning" if name == "truth" else "error", name, "all values are missing")


def check_rates(tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Rows, rate and gaps of each stream, or of each table if it has many streams; the share of empty cells."""
    zero = zero_of(first_time(tables))
    for name, table in tables.items():
        expected = layout(name, table.columns)
        ordered = streams(table.filter(pl.any_horizontal(pl.col(expected.values).is_not_null())), expected.ids)
        if ordered.height == 0:
            continue
        empty = {c: table[c].null_count() / table.height for c in expected.values if table[c].null_count()}
        if empty:
            shares = ", ".join(f"{column} {100 * share:.3g} %" for column, share in empty.items())
            yield CheckResult("info", name, f"empty cells: {shares}")
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
            for stream in per_stream.iter_rows(named=True):
                yield CheckResult("info", name, _stream_line(stream, expected.ids, zero))
        else:
            yield CheckResult("info", name, _summary(per_stream, expected.ids, zero))


def _stream_line(stream: dict, ids: tuple[str, ...], zero: float) -> str:
    line = ", ".join(f"{column} {stream[column]}" for column in reversed(ids)) + f": {counted(stream['rows'], 'row')}"
    if stream["interval"]:
        line += f", {1 / stream['interval']:.3g} Hz"
    if stream["gaps"]:
        before = place_in_time(stream["before"], zero)
        line += f", long gaps: {stream['gaps']}, the longest {stream['longest']:.3g} s before {before}"
    return line


def _summary(per_stream: pl.DataFrame, ids: tuple[str, ...], zero: float) -> str:
    counts = ", ".join(counted(per_stream[column].n_unique(), column) for column in ids[:2])
    counts += f", {counted(per_stream.select(ids[1:]).n_unique(), 'pair')} of {ids[1]}s" if len(ids) > 2 else ""
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
