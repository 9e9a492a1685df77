"""Checks of coverage: ids of the rig without measurements, holes in the truth, measurements outside the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping

import polars as pl

from trackwright.trackers.core.data.seconds import HOLE_M, HOLE_S, moment, place_in_time, span, zero_of
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.checks.anomalies import streams
from trackwright.trackers.recordings.checks.check_result import CheckResult, Level
from trackwright.trackers.recordings.kinds import first_time, layout

ENOUGH = 0.5
"""Share of the measurements that truth should cover."""


def check_ids(rig: Rig, measured: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """Anchors and stations of the rig without a measurement: failed devices, or misspelt ids."""
    observed: dict[str, set[str]] = {"anchor": set(), "station": set()}
    for name, table in measured.items():
        expected = layout(name, table.columns)
        present = table.filter(pl.any_horizontal(pl.col(expected.values).is_not_null()))
        for column in expected.ids[1:]:
            observed[column.partition("_")[0]] |= set(present[column].unique())
    results = []
    for column, known in (("anchor", rig.anchors), ("station", rig.stations)):
        unobserved = [key for key in known if key not in observed[column]]
        # a folder of fixes may have anchors that no table names
        if unobserved and (observed[column] or column == "station"):
            message = f"{column}s never observed: {len(unobserved)} of {len(known)} ({listed(unobserved, 8)})"
            results.append(CheckResult("warning", "rig.toml", message))
    return results


def check_truth(truth: pl.DataFrame, measured: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """Holes in the truth, measured tags without truth, and the share of measurements that truth covers."""
    axes = ("x_m", "y_m", "z_m")
    moved = pl.sum_horizontal(*((pl.col(c).shift(-1) - pl.col(c)) ** 2 for c in axes)).sqrt()
    known = streams(truth.drop_nulls(axes), ("tag",)).with_columns(
        until=pl.col("t_s").shift(-1).over("stream"), moved=moved
    )
    hole = (pl.col("until") - pl.col("t_s") > HOLE_S) & (pl.col("moved") > HOLE_M)
    known = known.with_columns(since=pl.col("t_s"), hole=hole.fill_null(False))
    results = []
    holes = known.filter("hole").with_columns(lasts=pl.col("until") - pl.col("t_s"))
    if holes.height:
        worst = holes.sort("lasts").row(-1, named=True)
        begin = place_in_time(worst["t_s"], zero_of(first_time(measured)))
        message = (
            f"holes longer than {HOLE_S:g} s with motion: {holes.height}, the longest {worst['lasts']:.3g} s "
            f"after {begin} (tag {worst['tag']}); estimates inside are not scored"
        )
        results.append(CheckResult("warning", "truth", message))
    rows = pl.concat([table.select("t_s", "tag") for table in measured.values()]).sort("t_s")
    right = known.sort("t_s").select("t_s", "tag", "since", "until", "hole")
    joined = rows.join_asof(right, on="t_s", by="tag", strategy="backward", check_sortedness=False)
    inside = (pl.col("until").is_not_null() & ~pl.col("hole")) | (pl.col("since") == pl.col("t_s"))
    share = float(joined.select(inside.fill_null(False).mean()).item())
    without = sorted(set(rows["tag"].unique()) - set(known["tag"].unique()))
    if without:
        results.append(
            CheckResult("info", "truth", f"measured tags without truth: {len(without)} ({listed(without, 8)})")
        )
    apart = check_overlap(truth, measured)
    if apart or math.isclose(share, 0.0):
        message = "no measurement lies inside the time span of the truth; expected one clock for all tables"
        return [*results, *(apart or [CheckResult("error", "truth", message)])]
    level: Level = "info" if share >= ENOUGH else "warning"
    return [*results, CheckResult(level, "truth", f"covers {100 * share:.3g} % of the measurements in time")]


def check_overlap(truth: pl.DataFrame, measured: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """An error where truth and measurements have no time in common: how far they are apart, and the likely cause."""
    first, last = (float(x) for x in truth.select(a=pl.col("t_s").min(), b=pl.col("t_s").max()).row(0))
    starts = [float(table["t_s"].to_numpy().min()) for table in measured.values()]
    ends = [float(table["t_s"].to_numpy().max()) for table in measured.values()]
    if first <= max(ends) and last >= min(starts):
        return []
    apart = first - min(starts)
    cause = ""
    hours = apart / 3600
    if abs(apart) > 1e8:
        cause = "; one of them counts from 1970, the other from its own zero"
    elif abs(hours) > 0.4 and abs(hours * 2 - round(hours * 2)) < 0.05:
        cause = f"; {hours:.3g} hours apart, as two time zones"
    message = (
        f"no measurement lies inside the time span of the truth, {span(first, last)}; the measurements "
        f"begin at {moment(min(starts))}{cause}; expected one clock for all tables"
    )
    return [CheckResult("error", "truth", message)]
