"""Checks of sampling and coverage: time base, rates, gaps; ids without measurements; holes in the truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import HOLE_M, HOLE_S, moment, place_in_time, span, zero_of
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.wording import counted
from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.anomalies import DT, LONG_GAP, streams, with_value
from trackwright.trackers.recordings.columns import TableRows
from trackwright.trackers.recordings.kinds import first_time, layout
from trackwright.trackers.recordings.truth import TruePaths, TruthStatus

STREAMS_SHOWN = 24
"""Tables of more streams get one summary line."""

LEAST_STAMPS = 10
"""Rows of a sensor and tag that cannot all have one time."""

_OUTSIDE = "no measurement lies inside the time span of the truth"
_FINER_UNITS = ((1e17, "nanoseconds"), (1e14, "microseconds"), (1e11, "milliseconds"))
_SINCE_1970_S = 1e8
_EXPECTED_TIMES = "expected seconds since the start of recording"


def check_ids(rig: Rig, measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """Anchors and stations of the rig without a measurement: failed devices, or misspelt ids."""
    observed: dict[str, set[str]] = {"anchor": set(), "station": set()}
    for name, table in measured.items():
        (_, *ids), values, *_ = layout(name, table.columns)
        for column in ids:
            observed[column.partition("_")[0]] |= set(with_value(table, values)[column].unique())
    for noun, known in (("anchor", rig.anchors), ("station", rig.stations)):
        unobserved = [key for key in known if key not in observed[noun]]
        # a folder of fixes may have anchors that no table names
        if unobserved and (observed[noun] or noun == "station"):
            count = f"{len(unobserved)} of {len(known)} ({listed(unobserved, 8)})"
            yield CheckResult("warning", "rig.toml", f"{noun}s never observed: {count}")


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
    without = sorted({*rows.tags} - {*known["tag"]})
    if without:
        yield CheckResult("info", "truth", f"measured tags without truth: {len(without)} ({listed(without, 8)})")
    apart = list(check_overlap(truth, measured))
    yield from apart
    status = TruePaths.of_table(truth.drop_nulls(axes), "").at(rows.tags, rows.starts, rows.times)[1]
    share = float(np.mean(status == TruthStatus.SCORED))
    if not apart and share == 0.0:
        yield CheckResult("error", "truth", f"{_OUTSIDE}; expected one clock for all tables")
    elif not apart:
        message = f"covers {100 * share:.3g} % of the measurements in time"
        yield CheckResult("info" if share >= 0.5 else "warning", "truth", message)


def check_overlap(truth: pl.DataFrame, measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error where truth and measurements have no time in common: how far they are apart, and the likely cause."""
    (first, last), (start, end) = _span({"truth": truth}), _span(measured)
    if first > end or last < start:
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
    return f"{cause}; expected one clock for all tables"


def _span(tables: Mapping[str, pl.DataFrame]) -> tuple[float, float]:
    """The first and the last time of all tables, s."""
    times = [table["t_s"].to_numpy() for table in tables.values()]
    return min(float(t.min()) for t in times), max(float(t.max()) for t in times)


def check_time_unit(tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error for times in fractions of seconds since 1970, a warning for times that look like milliseconds."""
    first, last = _span(tables)
    steps = [table["t_s"].unique().diff().median() for table in tables.values()]
    shortest = min((float(step) for step in steps if isinstance(step, float)), default=0.0)
    if unit := next((unit for least, unit in _FINER_UNITS if first > least), None):
        yield CheckResult("error", "t_s", f"starts at {first:.0f}: looks like {unit} since 1970, {_EXPECTED_TIMES}")
    elif shortest >= 5 and last - first > 1000:
        message = f"rows {shortest:.4g} s apart over {last - first:.6g} s: looks like milliseconds, expected seconds"
        yield CheckResult("warning", "t_s", message)


def check_stamps(tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """An error for each table in which all rows of a sensor and tag have one time."""
    for name, table in tables.items():
        of_streams = table.group_by(layout(name, table.columns).ids).agg(rows=pl.len(), times=pl.col("t_s").n_unique())
        same = of_streams.filter((pl.col("times") == 1) & (pl.col("rows") >= LEAST_STAMPS))["rows"]
        if len(same):
            message = f"{same.sum()} rows have one time per sensor and tag: the stamps have lost their digits"
            yield CheckResult("error", name, f"{message}; export them again with fractions of a second")


def check_time_base(tables: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """The span of all tables in time; warnings for times since 1970 and for a late start."""
    first, last = _span(tables)
    if _SINCE_1970_S < first <= _FINER_UNITS[-1][0]:
        message = f"starts at {first:.0f}: looks like seconds since 1970, {_EXPECTED_TIMES}"
        yield CheckResult("warning", "t_s", f"{message}; `trackwright import --origin start` makes them so")
    elif first <= _SINCE_1970_S:
        if abs(first) > 60.0:
            yield CheckResult("warning", "t_s", f"starts at {moment(first)}, expected a start near 0")
        yield CheckResult("info", "t_s", f"from {span(first, last)}")


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
        empty = ", ".join(f"{column} {100 * share:.3g} %" for column, share in shares.items() if share)
        if empty:
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
