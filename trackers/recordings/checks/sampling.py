"""Checks of the rows of tables: ids, time base, rates, gaps, duplicates, impossible values, outliers, cover of truth.

A stream is the rows of one sensor and one tag in one table; order, gaps and outliers are defined along a stream.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import HOLE_M, HOLE_S, moment, place_in_time, span, zero_of
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.wording import counted
from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.columns import TableRows
from trackwright.trackers.recordings.kinds import QUATERNION, Kind, duplicates_line, first_time, layout, table_kinds
from trackwright.trackers.recordings.truth import TruePaths, TruthStatus

DT, JUMP_S = pl.col("dt"), 1e7
"""Time to a row from the one before in its stream, s, and from where on it is a jump of the clock and no gap."""

LONG_GAP = DT.gt(1.0) & DT.gt(5.0 * DT.filter(DT > 0).median()) & DT.lt(JUMP_S)
"""Of the rows of one stream: those after a gap longer than 1 s and than five times its median interval."""

LEAST_JUMP = {"m": 1.0, "mps": 5.0, "mps2": 20.0, "radps": 5.0}
"""Least jumps of outliers by unit: smaller ones are within reach of a person, cart or drone between two rows."""

STREAMS_SHOWN, LEAST_STAMPS = 24, 10
"""Streams of a table up to which each gets a line, and rows of a stream that cannot all have one time."""

OUTSIDE = "no measurement lies inside the time span of the truth"
ONE_CLOCK = "; expected one clock for all tables"
SINCE_1970 = ((1e17, "nanoseconds"), (1e14, "microseconds"), (1e11, "milliseconds"), (1e8, "seconds"))


def anomalies(tables: Mapping[str, pl.DataFrame], rig: Rig) -> Iterator[str]:
    """A line for each kind of anomaly in each table, and one for all outliers; empty for a clean recording."""
    kinds, zero, outliers = table_kinds(), zero_of(first_time(tables)), list[str]()
    for name, table in tables.items():
        kind = kinds[name]
        ids, values, *_ = kind.layout(table.columns)
        unknown = [tag for tag in table["tag"].unique(maintain_order=True) if rig.tags and tag not in rig.tags]
        if unknown:
            yield f"{name}: tags that are not in rig.toml: {len(unknown)} ({listed(map(repr, unknown))})"
        yield from (f"{name}: {line}" for line in (*_impossible(kind, table, values), *_jumps(table["t_s"])))
        ordered = streams(with_value(table, values), ids)
        repeated = ordered.filter((DT == 0) | (DT.shift(-1) == 0))
        if exact := repeated.height - repeated.n_unique(subset=["stream", "t_s", *values]):
            yield duplicates_line(name, exact)
        if times := repeated.height - repeated.n_unique(subset=["stream", "t_s"]) - exact:
            few = "; the stamps have lost digits" if times > ordered.height / 2 else ""
            yield f"{name}: rows with the time of another row of the same sensor and tag: {times}; kept{few}"
        if name == "truth":
            continue
        # Which anchors a message has in common changes from one to the next.
        of = ids[:1] if kind.difference else ids
        gaps = (streams(ordered, of) if kind.difference else ordered).filter(LONG_GAP.over("stream"))
        if gaps.height:
            longest = gaps.row(int(gaps["dt"].arg_max() or 0), named=True)
            place = _place(longest, of, zero)
            yield f"{name}: gaps longer than 1 s: {gaps.height}, the longest {longest['dt']:.3g} s before {place}"
        outliers += (f"{name}: {line}" for line in _outliers(ordered, ids, values, zero))
    yield from (one.where + ": " + one.message for one in _unobserved(rig, tables, "tag"))
    if outliers:
        yield "; ".join(outliers)


def with_value(table: pl.DataFrame, values: Sequence[str]) -> pl.DataFrame:
    """The rows with any of the values."""
    return table.filter(pl.any_horizontal(pl.col(values).is_not_null()))


def streams(table: pl.DataFrame, ids: Sequence[str]) -> pl.DataFrame:
    """The table sorted by stream, then time, with `stream` (its number) and `dt`, s, null in its first row."""
    table = table.sort("t_s", maintain_order=True).with_columns(stream=pl.int_range(pl.len()))
    table = table.sort([pl.col("stream").min().over(column) for column in ids], maintain_order=True)
    return table.with_columns(stream=pl.struct(ids).rle_id()).with_columns(dt=pl.col("t_s").diff().over("stream"))


def _jumps(column: pl.Series) -> Iterator[str]:
    """Clocks that jump by months or more, and times of 0 among others far away."""
    times = column.sort().to_numpy()
    for k in np.flatnonzero(np.diff(times) > JUMP_S).tolist():
        if times[0] == 0.0 == times[k]:
            yield f"times of 0 in {k + 1} rows, the others from {times[k + 1]:.10g} s: missing; remove the rows"
        else:
            years = (times[k + 1] - times[k]) / 31_557_600
            jump = f"the clock jumps by {years:.3g} years at row {k + 2} in order of time"
            yield f"{jump}, from {times[k]:.10g} to {times[k + 1]:.10g} s: make two recordings"


def _place(row: Mapping[str, Any], ids: Sequence[str], zero: float) -> str:
    """The time, the tag and the sensors of a row."""
    return f"{place_in_time(row['t_s'], zero)} ({', '.join(f'{column} {row[column]}' for column in ids)})"


def _impossible(kind: Kind, table: pl.DataFrame, values: Sequence[str]) -> Iterator[str]:
    """Angles out of their range, negative distances, and quaternions that are none."""
    norm = pl.sum_horizontal(pl.col("^q[wxyz]$") ** 2, ignore_nulls=False).sqrt()
    for name in values:
        column, x = kind.column(name), pl.col(name)
        if column.unit == "rad":  # with room for π rounded up in text
            broken = x.abs() > column.bound + 1e-3
            words = f"values of {name} beyond {'±π/2' if column.bound < math.pi else '±π'}"
            unwrapped = not_wrapped(table[name], column.bound)
            why = "; from 0 to 2π, not wrapped: trackers wrap them" if unwrapped else "; degrees, or not wrapped"
        else:
            broken, words, why = x < (0.0 if column.positive else -math.inf), f"negative values of {name}", ""
        if n := table.select(broken.sum()).item():
            yield f"{words}: {n}{why}"
    if {*QUATERNION} <= {*table.columns} and (n := table.select(((norm - 1).abs() > 0.01).sum()).item()):
        yield f"quaternions more than 1 % from unit length: {n}"


def not_wrapped(angles: pl.Series, bound: float) -> bool:
    """Whether angles, rad, some of them beyond their bound, are from 0 to 2π and within it when wrapped."""
    x = angles.drop_nulls().to_numpy()
    turned = np.mod(x + np.pi, 2 * np.pi) - np.pi
    return bool(((x >= -1e-3) & (x <= 2 * np.pi + 1e-3) & (np.abs(turned) <= bound + 1e-3)).all())


def _outliers(ordered: pl.DataFrame, ids: Sequence[str], columns: Sequence[str], zero: float) -> Iterator[str]:
    """Values far from both neighbours in their stream, or above 100 times its median: spikes, unlike motion."""
    for column in columns:
        if (least := LEAST_JUMP.get(column.rpartition("_")[2])) is None:  # angles are bounded
            continue
        x = pl.col(column)
        rows = ordered.select("stream", "t_s", *ids, column).drop_nulls(column)
        steps = x.diff().abs().median().over("stream").fill_null(0.0)
        away = (x - x.rolling_median(9, center=True)).abs().over("stream")
        rows = rows.with_columns(
            allowed=(14.826 * steps).clip(least), typical=x.abs().median().over("stream"), away=away
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
            yield f"outliers of {column}: {found.height}, the worst {worst[column]:.4g} at {_place(worst, ids, zero)}"


def check_ids(rig: Rig, measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Anchors and stations of the rig without a measurement: failed devices, or misspelt ids."""
    yield from _unobserved(rig, measured, "anchor")
    yield from _unobserved(rig, measured, "station")


def _unobserved(rig: Rig, tables: Mapping[str, pl.DataFrame], noun: str) -> Iterator[CheckResult]:
    known, seen = {"anchor": rig.anchors, "station": rig.stations, "tag": rig.tags}[noun], set[str]()
    for name, table in tables.items():
        ids, values, *_ = layout(name, table.columns)
        for column in ids if name != "truth" else ():
            if column.startswith(noun):
                seen |= set(with_value(table, values)[column].unique())
    unobserved = [repr(key) if noun == "tag" else key for key in known if key not in seen]
    # A folder of fixes may have anchors that no table names.
    if unobserved and (seen or noun == "station"):
        message = f"{noun}s never observed: {len(unobserved)} of {len(known)} ({listed(unobserved, 8)})"
        yield CheckResult("warning", "rig.toml", message)


def check_truth(truth: pl.DataFrame, measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Holes in the truth, measured tags without truth, and the share of measurements that truth covers."""
    axes = ("x_m", "y_m", "z_m")
    moved = pl.sum_horizontal(*(pl.col(c).diff() ** 2 for c in axes)).sqrt()
    known = streams(truth.drop_nulls(axes), ("tag",)).with_columns(begin=pl.col("t_s").shift(), moved=moved)
    holes = known.filter((DT > HOLE_S) & (pl.col("moved") > HOLE_M)).sort("dt")
    if holes.height:
        worst = holes.row(-1, named=True)
        begin = place_in_time(worst["begin"], zero_of(first_time(measured)))
        yield CheckResult(
            "warning", "truth", f"holes longer than {HOLE_S:g} s with motion: {holes.height}, the longest "
            f"{worst['dt']:.3g} s after {begin} (tag {worst['tag']}); estimates inside are not scored",
        )  # fmt: skip
    rows = TableRows(pl.concat([table.select("t_s", "tag") for table in measured.values()]))
    if without := sorted({*rows.tags} - {*known["tag"]}):
        yield CheckResult("info", "truth", f"measured tags without truth: {len(without)} ({listed(without, 8)})")
    if apart := list(check_overlap(truth, measured)):
        yield from apart
        return
    status = TruePaths.of_table(truth.drop_nulls(axes), "").at(rows.tags, rows.starts, rows.times)[1]
    share = float(np.mean(status == TruthStatus.SCORED))
    message = f"covers {100 * share:.3g} % of the measurements in time" if share else OUTSIDE + ONE_CLOCK
    yield CheckResult("error" if not share else "info" if share >= 0.5 else "warning", "truth", message)


def check_overlap(truth: pl.DataFrame, measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error where truth and measurements have no time in common: how far they are apart, and the likely cause."""
    (first, last), (start, end) = _span({"truth": truth}), _span(measured)
    if first > end or last < start:
        message = f"{OUTSIDE}, {span(first, last)}; the measurements begin at {moment(start)}"
        yield CheckResult("error", "truth", f"{message}{_two_clocks(first - start)}")


def check_clocks(measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error for each table that is far in time from the first one of a tag."""
    firsts = dict[str, tuple[str, float, float]]()
    ends = pl.col("t_s").min().alias("start"), pl.col("t_s").max().alias("end")
    for name, table in measured.items():
        for tag, start, end in table.group_by("tag", maintain_order=True).agg(*ends).iter_rows():
            one, first, last = firsts.setdefault(tag, (name, start, end))
            # One sensor may be switched on after another was switched off.
            if max(start - last, first - end) > max(10.0 * (last - first + end - start), 600.0):
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
    return cause + ONE_CLOCK


def _span(tables: Mapping[str, pl.DataFrame]) -> tuple[float, float]:
    """The first and the last time of all tables, s."""
    times = pl.concat([table["t_s"] for table in tables.values()])
    return float(times.min()), float(times.max())  # type: ignore[arg-type]


def check_times(tables: Mapping[str, pl.DataFrame], base: bool = True) -> Iterator[CheckResult]:
    """Errors and warnings of the unit of times; of the `base`, warnings of a late start, and the span of all tables."""
    first, last = _span(tables)
    steps = [table["t_s"].unique().diff().median() for table in tables.values()]
    shortest = min((float(step) for step in steps if isinstance(step, float)), default=0.0)
    unit = next((unit for least, unit in SINCE_1970 if first > least), None)
    if unit is not None and (base or unit != "seconds"):
        message = f"starts at {first:.0f}: looks like {unit} since 1970, expected seconds since the start of recording"
        fix = "; `trackwright import --origin start` makes them so" if unit == "seconds" else ""
        yield CheckResult("warning" if fix else "error", "t_s", message + fix)
    if shortest >= 5 and last - first > 1000 and unit in (None, "seconds"):
        message = f"rows {shortest:.4g} s apart over {last - first:.6g} s: looks like milliseconds, expected seconds"
        yield CheckResult("warning", "t_s", message)
    if base and unit is None:
        if abs(first) > 60.0:
            yield CheckResult("warning", "t_s", f"starts at {moment(first)}, expected a start near 0")
        yield CheckResult("info", "t_s", f"from {span(first, last)}")


def check_stamps(tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error for each table in which all rows of a sensor and tag have one time."""
    for name, table in tables.items():
        of_streams = table.group_by(layout(name, table.columns).ids).agg(rows=pl.len(), times=pl.col("t_s").n_unique())
        same = of_streams.filter((pl.col("times") == 1) & (pl.col("rows") >= LEAST_STAMPS))["rows"]
        if len(same):
            message = f"{same.sum()} rows have one time per sensor and tag: the stamps have lost their digits"
            yield CheckResult("error", name, f"{message}; export them again with fractions of a second")


def check_rates(tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Rows, rate and gaps of each stream, or of each table if it has many streams; the share of empty cells."""
    zero = zero_of(first_time(tables))
    for name, table in tables.items():
        ids, values, *_ = layout(name, table.columns)
        present = with_value(table, values)
        if present.is_empty():
            yield CheckResult("warning" if name == "truth" else "error", name, "all values are missing")
            continue
        shares = {column: table[column].null_count() / table.height for column in values}
        if empty := ", ".join(f"{column} {100 * share:.3g} %" for column, share in shares.items() if share):
            yield CheckResult("info", name, f"empty cells: {empty}")
        per_stream = streams(present, ids).group_by("stream", *ids, maintain_order=True).agg(
            pl.len().alias("rows"), (1 / DT.filter(DT > 0).median()).alias("rate"), LONG_GAP.sum().alias("gaps"),
            DT.max().alias("longest"), pl.col("t_s").sort_by("dt").last().alias("before"),
        )  # fmt: skip
        if per_stream.height > STREAMS_SHOWN:
            yield CheckResult("info", name, _summary(per_stream, ids))
            continue
        for row in per_stream.iter_rows(named=True):
            line = ", ".join(f"{column} {row[column]}" for column in reversed(ids)) + f": {counted(row['rows'], 'row')}"
            line += f", {row['rate']:.3g} Hz" if row["rate"] else ""
            if row["gaps"]:
                before = place_in_time(row["before"], zero)
                line += f", long gaps: {row['gaps']}, the longest {row['longest']:.3g} s before {before}"
            yield CheckResult("info", name, line)


def _summary(per_stream: pl.DataFrame, ids: tuple[str, ...]) -> str:
    counts = ", ".join(counted(per_stream[column].n_unique(), column) for column in ids[:2])
    counts += f", {counted(per_stream.select(ids[1:]).n_unique(), 'pair')} of {ids[1]}s" if len(ids) > 2 else ""
    rates, line = per_stream["rate"].drop_nulls().to_numpy(), f"{counts}: {per_stream['rows'].sum()} rows"
    if not len(rates):
        return line
    low, middle, high = (f"{q:.3g}" for q in np.quantile(rates, (0, 0.5, 1)))
    return f"{line}, {low} Hz each" if low == high else f"{line}, {low} to {high} Hz each, median {middle} Hz"
