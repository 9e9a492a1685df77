"""The one scorer: estimates in files against the truth of data sets, ours and those that others submit.

A folder has ESTIMATOR/DATASET.tum, .csv or .parquet. A table has the columns of `track`, with `std_x_m`, `cov_xy_m2` …
where covariances are reported, and may have `cpu_us`, the processor time of a reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.lab.benchmark.readings import CHANNELS
from trackwright.experiments.lab.benchmark.running import CPU, FAILED
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.evaluation.association import Association, associate_truth, refuse_without_overlap
from trackwright.trackers.evaluation.comparison import Difference, TrackErrors, errors_by_track, paired_differences
from trackwright.trackers.evaluation.evaluate import evaluate_association
from trackwright.trackers.evaluation.scoring import score
from trackwright.trackers.exchange.estimates import assigned, read_estimates
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.table_file import read_parquet
from trackwright.trackers.recordings.tracks_table import is_bearing
from trackwright.trackers.recordings.truth import TruthStatus

SUFFIXES = (".parquet", ".csv", ".csv.gz", ".tum", ".txt")

NEAR_S = 1.0
"""Seconds from a reading within which an estimate is expected."""

READINGS = (*CHANNELS, "phases")


class Cell(NamedTuple):
    """How one estimator does on one data set.

    `rmse`, `p75`, `p95`: of horizontal errors, m, or of directions, rad. `inside`, `nees`: the share of the truth in
    the 95 % ellipses and NEES per degree of freedom, None without covariances. `cpu`: µs of processor time a reading,
    None where unknown. `missing`: share of the readings whose tag has no estimate within `NEAR_S`. `failed`: why there
    is none.
    """

    rmse: float = np.nan
    p75: float = np.nan
    p95: float = np.nan
    inside: float | None = None
    nees: float | None = None
    cpu: float | None = None
    missing: float = 0.0
    failed: str = ""
    errors: Mapping[Any, TrackErrors] | None = None


def files(root: Path) -> dict[str, dict[str, Path]]:
    """The files of estimates, and those with reasons of failures, by estimator and data set.

    Raises UnusableInput for a folder without any, and for two files of one estimator and data set.
    """
    found: dict[str, dict[str, Path]] = {}
    for path in sorted(root.glob("*/*")):
        name = next((path.name.removesuffix(s) for s in (*SUFFIXES, FAILED) if path.name.endswith(s)), None)
        if name is None or not path.is_file():
            continue
        of_one = found.setdefault(path.parent.name, {})
        if name in of_one:
            raise UnusableInput(f"{path}: the same data set as {of_one[name]}; expected one file; remove the other")
        of_one[name] = path
    if not found:
        raise UnusableInput(f"{root}: no estimates; expected files ESTIMATOR/DATASET with {', '.join(SUFFIXES)}")
    return found


def cell(path: Path, folder: RecordingFolder) -> Cell:
    """The figures of a file of estimates; raises UnusableInput for one that cannot be read, or misses the truth."""
    if path.name.endswith(FAILED):
        return Cell(failed=path.read_text("utf-8").strip())
    table, truths = _read(path), {folder.name: folder.tables["truth"]}
    tags = truths[folder.name]["tag"].unique()
    if "tag" not in table.columns and len(tags) > 1:
        raise UnusableInput(f"{path}: names no tag; the truth has {listed(sorted(tags))}; add a column tag")
    table = assigned(table.with_columns(recording=pl.lit(folder.name)), truths, None, path)
    association = associate_truth(_with_stds(table), truths)
    if (association.truth_status == TruthStatus.NO_ESTIMATE).all():
        return Cell(failed=f"none of {len(table)} rows has a finite estimate")
    try:
        refuse_without_overlap(association, truths)
    except UnusableInput as error:
        raise UnusableInput(f"{path}: {error}") from error
    stations = {folder.name: folder.rig.stations}
    metrics = evaluate_association(association, stations).overall
    scored = score(association, stations)
    p75, p95 = np.quantile(scored.size[np.isfinite(scored.size)], [0.75, 0.95])
    return Cell(
        rmse=metrics["rmse_direction_rad" if is_bearing(table) else "rmse_m"],
        p75=float(p75),
        p95=float(p95),
        inside=metrics["coverage_95"],
        nees=metrics["nees_ratio"],
        cpu=table[CPU].max() if CPU in table.columns else None,  # type: ignore[arg-type]
        missing=_missing(association, folder),
        errors=errors_by_track(association, scored),
    )


def _read(path: Path) -> pl.DataFrame:
    """The estimates of a file, positions, or directions as `track` writes them."""
    if path.suffix == ".parquet":
        table = read_parquet(path)
        if {"azimuth_rad", "station", "tag"} <= set(table.columns):
            return table
    return read_estimates(path)[0]


def _missing(association: Association, folder: RecordingFolder) -> float:
    """The share of the readings of a data set without a finite estimate of their tag within `NEAR_S`."""
    tables = [folder.tables[name] for name in READINGS if name in folder.tables]
    read = pl.concat([table.select("t_s", pl.col("tag").cast(pl.String)) for table in tables]).sort("t_s")
    finite = association.rows.filter(association.truth_status != TruthStatus.NO_ESTIMATE)
    near = read.join_asof(
        finite.select("t_s", "tag", found=True).sort("t_s"),
        on="t_s", by="tag", strategy="nearest", tolerance=NEAR_S, check_sortedness=False,
    )  # fmt: skip
    return near["found"].null_count() / len(near)


def difference(ours: Cell, other: Cell) -> Difference | None:
    """The RMSE of another estimator less ours over the time that both cover, with its interval; None without both."""
    if ours.errors is None or other.errors is None:
        return None
    return paired_differences(ours.errors, other.errors, ["rmse_m"]).get("rmse_m")


def _with_stds(table: pl.DataFrame) -> pl.DataFrame:
    """The estimates with columns of standard deviations, empty where none is reported."""
    if is_bearing(table):
        return table
    return table.with_columns(pl.lit(None, pl.Float64).alias(c) for c in STDS if c not in table.columns)


STDS = ("z_m", "std_x_m", "std_y_m", "std_z_m", "cov_xy_m2", "cov_xz_m2", "cov_yz_m2")
