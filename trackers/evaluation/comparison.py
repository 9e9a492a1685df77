"""Differences between two runs on the same recordings, with intervals that respect that errors last.

Both runs are cut into the same pieces of time, several times longer than the correlation of the errors, so that pieces
are nearly independent; many tracks are pieces themselves. The interval is Student's t's with the variance of the
jackknife over pieces (Efron and Stein 1981; Künsch 1989 for pieces of a time series).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.evaluation.metrics import metrics, sums
from trackwright.trackers.evaluation.rows import correlation_times, main_size
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.tracks_table import track_keys

MOST_PIECES, LEAST_PIECES, MANY_TRACKS = 30, 5, 30  # pieces at most, for an interval at least; tracks to be pieces
CORRELATION_TIMES, BINS = 4.0, 600  # least length of a piece in correlation times of the difference; bins to find these

COMPARED = ("rmse_m", "median_m", "p95_m", "rmse_direction_rad", "median_direction_rad", "p95_direction_rad",
            "rmse_3d_m", "coverage_95", "log_density", "energy_score_m")  # fmt: skip
"""The metrics that are compared."""


class Difference(NamedTuple):
    """The second value less the first, its 95 % interval, and the p-value of no difference; NaN where unknown.

    `first`, `second`: the metric of each run over the `pieces` that both cover; `kind`: in words, what these are.
    """

    first: float
    second: float
    low: float
    high: float
    p: float
    pieces: int
    kind: str = ""

    @property
    def value(self) -> float:
        """The second value less the first."""
        return self.second - self.first


def paired_differences(
    first: pl.DataFrame, second: pl.DataFrame, names: Sequence[str] = COMPARED
) -> dict[str, Difference]:
    """The differences of the metrics of scored rows over the tracks that both runs have; empty without a common one."""
    runs, keys = [run.filter(pl.col("why").is_null()) for run in (first, second)], track_keys(first)
    common = runs[0].select(keys).unique().join(runs[1].select(keys), keys, "semi").sort(keys).with_row_index("piece")
    if common.is_empty():
        return {}
    runs, kind = [run.join(common, keys, maintain_order="left") for run in runs], "tracks"
    if len(common) < MANY_TRACKS:
        size, kind = pl.col(main_size(first)), "pieces of time, several times longer than errors last"
        runs = _in_pieces([run.with_columns(value=size**2) for run in runs])
    shared = sorted({*runs[0]["piece"]} & {*runs[1]["piece"]})
    found = []
    for run in runs:
        rows = run.lazy().filter(pl.col("piece").is_in(shared))
        parts = [rows, *(rows.filter(pl.col("piece") != piece) for piece in shared)]
        # Polars computes the sums of these metrics alone.
        found.append(pl.concat([metrics(sums(part), names) for part in parts]).collect())
    x, y = ({name: float_column(of, name) for name in of.columns} for of in found)
    return {n: jackknifed(x[n][0].item(), y[n][0].item(), y[n][1:] - x[n][1:], kind) for n in x if n in y}


def paired_means(times: np.ndarray, first: np.ndarray, second: np.ndarray, recording: np.ndarray) -> Difference:
    """The difference of the means of values (n,) at the same `times`, s; every `recording` (n,) has the same weight."""
    table = pl.DataFrame({"recording": recording, "t_s": times, "first": first, "second": second})
    rows = _in_pieces([table.with_columns(value=pl.col(name)) for name in ("first", "second")])[0]
    weight = 1 / pl.len().over("recording")
    parts = rows.with_columns(weight=weight, first=pl.col("first") * weight, second=pl.col("second") * weight)
    a, b, weights = parts.group_by("piece").agg(pl.col("first", "second", "weight").sum())[:, 1:].to_numpy().T
    with np.errstate(invalid="ignore"):  # of one piece none is left
        without = ((b - a).sum() - (b - a)) / (weights.sum() - weights)
    return jackknifed(float(a.sum() / weights.sum()), float(b.sum() / weights.sum()), without)


def _in_pieces(runs: Sequence[pl.DataFrame]) -> list[pl.DataFrame]:
    """The rows of both runs in the time that both cover, with their `piece` of it.

    A piece lasts a thirtieth of the time of all recordings, and several correlation times of the difference of the
    runs' `value`, about its mean in each recording.
    """
    t, begin, end = pl.col("t_s"), pl.col("begin"), pl.col("end")
    ends = pl.concat(run.group_by("recording").agg(begin=t.min(), end=t.max()) for run in runs)
    spans = ends.group_by("recording").agg(begin.max(), end.min()).sort("recording")
    total = max(spans.select((end - begin).clip(0.0).sum()).item(), 1e-9)

    def cut(run: pl.DataFrame, length: float) -> pl.DataFrame:
        count = ((end - begin) / length).cast(pl.Int64).clip(lower_bound=1)
        numbers = spans.with_columns(count=count, before=count.cum_sum() - count)
        share = (t - begin) / (end - begin).clip(1e-9) * pl.col("count")
        piece = pl.col("before") + share.cast(pl.Int64).clip(upper_bound=pl.col("count") - 1)
        inside = run.join(numbers, "recording", maintain_order="left").filter(t.is_between(begin, end))
        return inside.with_columns(piece=piece).drop("begin", "end", "count", "before")

    means = [cut(run, total / BINS).group_by("recording", "piece").agg(pl.col("value").mean()) for run in runs]
    both, x = means[0].join(means[1], ["recording", "piece"]).sort("piece"), pl.col("value_right") - pl.col("value")
    series = both.select("recording", x=x - x.mean().over("recording"))
    lasting = correlation_times(series["x"].to_numpy()[:, None], series["recording"].rle_id().to_numpy(), 1).mean()
    return [cut(run, total * max(1 / MOST_PIECES, CORRELATION_TIMES * lasting / BINS)) for run in runs]


def jackknifed(first: float, second: float, without: np.ndarray, kind: str = "") -> Difference:
    """The difference of two values, with its interval by the differences without each of the pieces (n,)."""
    from scipy.special import stdtr, stdtrit

    n, value = len(without), second - first
    variance = (n - 1) / n * float(((without - without.mean()) ** 2).sum()) if n >= LEAST_PIECES else math.nan
    sigma = math.sqrt(variance)
    size = abs(value) / sigma if sigma else math.inf if value else 0.0
    half, p = float(stdtrit(n - 1, 0.975)) * sigma, 2.0 * float(stdtr(n - 1, -size))
    return Difference(first, second, value - half, value + half, p, n, kind)


def holm(p: Sequence[float]) -> list[float]:
    """The p-values adjusted for their number (Holm 1979): those up to 0.05 differ, wrongly in 5 % of all families.

    NaN stays NaN and does not count.
    """
    values = np.asarray(p, float)
    order, count = np.argsort(values), np.isfinite(values).sum()
    values[order] = np.minimum(np.maximum.accumulate((count - np.arange(len(order))) * values[order]), 1.0)
    return values.tolist()
