"""A tracker's scored rows, as `evaluate` has them, as sums and histograms of each trajectory, and as arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl
from polars import selectors as cs

from trackwright.experiments.monte_carlo.scores import Scores, arrays_of, cells
from trackwright.trackers.core.data.estimates import STATUS_WORDS, Status
from trackwright.trackers.evaluation.evaluate import with_truth
from trackwright.trackers.evaluation.metrics import ERROR_KINDS, TERMS, sums
from trackwright.trackers.evaluation.rows import ANGLES, AXES, covariances
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks_table import is_bearing

FAILURES = ("non-finite", "restarted", "lost")
JUDGED = cs.starts_with("size_", "nees", "density", "energy", "slow", "along", "way") - cs.by_name("slow_nis")


class TrackedRuns(NamedTuple):
    """A tracker's estimates of n trajectories at T times beside their truth: the argument of a study's measures.
    Positions: `times` (n, T) s, `estimates` and `truth` (n, T, 3) m, `covariance` (n, T, 3, 3), zero of a known height;
    NaN without an estimate. Bearings have an axis of S stations: `estimates` and `truth` (n, T, S, 2) rad, azimuth and
    elevation, `covariance` (n, T, S, 2, 2). `known`: rows with both truth and a usable estimate. `status` (codes of
    `Status`), `nis`, `dof`: per row, and per station for bearings."""

    times: np.ndarray
    estimates: np.ndarray
    covariance: np.ndarray
    truth: np.ndarray
    known: np.ndarray
    status: np.ndarray
    nis: np.ndarray
    dof: np.ndarray
    folder: RecordingFolder

    @property
    def error(self) -> np.ndarray:
        """Estimates less truth, m or rad; NaN for rows that are not scored."""
        return np.where(self.known[..., None], self.estimates - self.truth, np.nan)

    @classmethod
    def of(cls, rows: pl.DataFrame, folder: RecordingFolder) -> TrackedRuns:
        """The arrays of scored rows with their `number`."""
        bearing = is_bearing(rows)
        names = ANGLES if bearing else AXES
        station = rows["station"].rank("dense").to_numpy() - 1 if bearing else np.zeros(len(rows), int)
        row = rows.select(pl.int_range(pl.len()).over("track")).to_series().to_numpy()
        at = rows["number"].to_numpy(), row, station
        shape = [int(k.max(initial=0)) + 1 for k in at]

        def array(x: np.ndarray, fill: float = np.nan) -> np.ndarray:
            whole = np.full((*shape, *x.shape[1:]), fill, x.dtype)
            whole[at] = x
            return whole if bearing else whole[:, :, 0]

        estimates = np.stack([float_column(rows, name) for name in names], axis=1)
        truth = np.stack([float_column(rows, f"{'error' if bearing else 'true'}_{name}") for name in names], axis=1)
        codes = {word: code for code, word in STATUS_WORDS.items()}
        status = rows["status"].replace_strict(codes, return_dtype=pl.Int8).to_numpy()
        of_rows = [array(estimates), array(covariances(rows, names)), array(estimates - truth if bearing else truth)]
        of_rows += [array(rows["why"].is_null().to_numpy(), False), array(status, Status.PADDING)]
        of_rows += [array(float_column(rows, name), 0.0) for name in ("nis", "nis_dof")]
        times = array(float_column(rows, "t_s"))
        return cls._make([times[:, :, 0] if bearing else times, *of_rows, folder])


def numbered_rows(table: pl.DataFrame, folder: RecordingFolder, ids: np.ndarray, every: float | None) -> pl.DataFrame:
    """The scored rows of the table of a simulated folder, with the `number` of the trajectory of each. `every`: an
    interval, s, in which only a trajectory's last row is scored."""
    rows = with_truth(table, folder)
    number = {str(k): at for at, k in enumerate(ids)}
    rows = rows.with_columns(number=pl.col("tag").replace_strict(number, return_dtype=pl.Int32))
    if every is None:
        return rows
    # 0.3 s belongs to the interval that starts there although 0.3 / 0.1 is 2.9999999999999996.
    scored, interval = pl.col("why").is_null(), (pl.col("t_s") / every + 1e-6).floor()
    last = pl.col("t_s") == pl.col("t_s").filter(scored).max().over("track", interval)
    why = pl.when(scored & ~last).then(pl.lit("left out")).otherwise("why")
    return rows.with_columns(pl.when(scored & last).then(JUDGED), why=why)


def scored(rows: pl.DataFrame, n: int) -> dict[str, np.ndarray]:
    """The sums, largest errors and histograms of n trajectories; rows of all stations count as their trajectory's."""
    each = pl.DataFrame({"number": np.arange(n, dtype=np.int32)}).join(
        sums(rows, "number"), "number", how="left", maintain_order="left"
    )
    number, status = rows["number"].to_numpy(), rows["status"].cast(pl.String)
    failed, restarted, lost = (np.bincount(number, status == word, n) > 0 for word in FAILURES)
    found = {name: np.nan_to_num(float_column(each, name)) for name in TERMS if name in each.columns}
    found |= {"diverged": failed | restarted | lost, "trajectories": np.ones(n), "failed": failed | (found["n"] == 0)}
    kinds = [kind for kind in ERROR_KINDS if f"size_{kind}" in rows.columns]
    tops = {kind: np.nan_to_num(float_column(each, f"largest {kind}"), nan=-1.0) for kind in kinds}
    of_rows = {kind: cells(np.nan_to_num(float_column(rows, f"size_{kind}"), nan=-1.0), number, n) for kind in kinds}
    return arrays_of([Scores(found, tops, of_rows)], n)
