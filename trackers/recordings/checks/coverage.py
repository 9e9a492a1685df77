"""Checks of coverage: ids of the rig without measurements, holes in the truth, measurements outside the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping

import polars as pl

from trackers.core.errors import listed
from trackers.core.rig import Rig
from trackers.recordings.checks.anomalies import streams
from trackers.recordings.checks.check_result import CheckResult, Level
from trackers.recordings.tables import HOLE_M, HOLE_S, layout

ENOUGH = 0.5
"""Share of the measurements that truth should cover."""


def check_ids(rig: Rig, measured: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """Anchors and stations of the rig without a measurement: failed devices, or misspelt ids."""
    observed: dict[str, set[str]] = {"anchor": set(), "station": set()}
    for name, table in measured.items():
        expected = layout(name, table.columns)
        present = table.filter(pl.any_horizontal(pl.col(expected.values).is_not_null()))
        for column in expected.ids[1:]:
            observed[column] |= set(present[column].unique())
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
        message = (
            f"holes longer than {HOLE_S:g} s with motion: {holes.height}, the longest {worst['lasts']:.3g} s "
            f"after t_s {worst['t_s']:g} (tag {worst['tag']}); estimates inside are not scored"
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
    if math.isclose(share, 0.0):
        message = "no measurement lies inside the time span of the truth; expected one clock for all tables"
        return [*results, CheckResult("error", "truth", message)]
    level: Level = "info" if share >= ENOUGH else "warning"
    return [*results, CheckResult(level, "truth", f"covers {100 * share:.3g} % of the measurements in time")]
