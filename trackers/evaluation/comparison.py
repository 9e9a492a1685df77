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

from trackwright.trackers.evaluation.metrics import columns_of, metrics, sums
from trackwright.trackers.recordings.columns import codes, float_column
from trackwright.trackers.recordings.tracks_table import is_bearing, track_keys

MOST_PIECES, LEAST_PIECES = 30, 5
MANY_TRACKS = 30
"""Tracks from which each is a piece."""

CORRELATION_TIMES = 4.0
"""Least length of a piece, in integrated autocorrelation times of the difference of squared errors."""

BINS = 600
"""Bins of time in which the autocorrelation is estimated."""

COMPARED = ("rmse_m", "median_m", "p95_m", "rmse_direction_rad", "median_direction_rad", "p95_direction_rad",
            "rmse_3d_m", "coverage_95", "log_density", "energy_score_m")  # fmt: skip
"""The metrics that are compared."""


class Difference(NamedTuple):
    """The second value less the first, its 95 % interval, and the p-value of no difference; NaN where unknown.

    `first`, `second`: the metric of each run over the pieces that both cover. `pieces`: their number. `kind`: in words,
    what they are; empty for runs that are not paired.
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


def main_size(rows: pl.DataFrame) -> str:
    """The column with the horizontal error, m, or of bearings with the angle to the true direction, rad."""
    return "size_direction_rad" if is_bearing(rows) else "size_m"


def paired_differences(
    first: pl.DataFrame, second: pl.DataFrame, names: Sequence[str] = COMPARED
) -> dict[str, Difference]:
    """The differences of the metrics of scored rows over the tracks that both runs have; empty without a common one."""
    runs, keys = [run.filter(pl.col("why").is_null()) for run in (first, second)], track_keys(first)
    common = runs[0].select(keys).unique(maintain_order=True).join(runs[1].select(keys), keys, "semi")
    if common.is_empty():
        return {}
    pieces = common.sort(keys).with_row_index("piece")
    runs = [run.join(pieces, keys, maintain_order="left") for run in runs]
    kind = "tracks"
    if len(common) < MANY_TRACKS:
        runs, kind = _in_pieces(runs), "pieces of time, several times longer than errors last"
    shared = np.intersect1d(runs[0]["piece"].to_numpy(), runs[1]["piece"].to_numpy())
    before, after = (_without_each(run, shared, names) for run in runs)
    return {
        name: jackknifed(x[0].item(), y[0].item(), y[1:] - x[1:])._replace(kind=kind)
        for name, x in before.items()
        if (y := after.get(name)) is not None
    }


def _without_each(rows: pl.DataFrame, pieces: np.ndarray, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The metrics by name, (1 + k,): of the rows in these k pieces, and of those without each of them."""
    needed = columns_of(names) & {*rows.columns}
    rows = rows.filter(pl.col("piece").is_in(pieces)).select("piece", *needed)
    parts = [rows, *(rows.filter(pl.col("piece") != piece) for piece in pieces)]
    found = metrics(pl.concat([sums(part, of=names) for part in parts]), names)
    return {name: float_column(found, name) for name in found.columns}


def holm(p: Sequence[float]) -> list[float]:
    """The p-values adjusted for their number (Holm 1979): those up to 0.05 differ, wrongly in 5 % of all families.

    NaN stays NaN and does not count.
    """
    values = np.asarray(p, float)
    known = np.flatnonzero(np.isfinite(values))
    order = known[np.argsort(values[known], kind="stable")]
    adjusted = np.full(len(values), math.nan)
    adjusted[order] = np.minimum(np.maximum.accumulate((len(order) - np.arange(len(order))) * values[order]), 1.0)
    return [float(x) for x in adjusted]


def _in_pieces(runs: Sequence[pl.DataFrame]) -> list[pl.DataFrame]:
    """The rows of both runs with their pieces of time, of the time that both cover."""
    names = runs[0]["recording"].unique(maintain_order=True).to_list()
    times = [float_column(run, "t_s") for run in runs]
    of = [codes(run["recording"], names) for run in runs]
    shared = [[t[number == k] for t, number in zip(times, of, strict=True)] for k in range(len(names))]
    spans = np.array([(max(x.min() for x in both), min(x.max() for x in both)) for both in shared])
    squares = [run[main_size(run)].to_numpy() ** 2 for run in runs]
    length = _piece_length([*zip(times, squares, strict=True)], of, spans)
    pieces = (_numbered(t, number, spans, length) for t, number in zip(times, of, strict=True))
    return [run.with_columns(piece=piece).filter(pl.col("piece") >= 0) for run, piece in zip(runs, pieces, strict=True)]


def paired_means(times: np.ndarray, first: np.ndarray, second: np.ndarray, recording: np.ndarray) -> Difference:
    """The difference of the means of two values (n,) of the same rows; all recordings have the same weight.

    `times` (n,), s; `recording` (n,): its name.
    """
    _, of, rows = np.unique(recording, return_inverse=True, return_counts=True)
    spans = np.array([(times[of == k].min(), times[of == k].max()) for k in range(len(rows))])
    # About the mean of each recording: what differs between them is no correlation in time.
    means = np.bincount(of, second - first) / rows
    length = _piece_length([(times, np.zeros(len(of))), (times, second - first - means[of])], [of, of], spans)
    _, piece = np.unique(_numbered(times, of, spans, length), return_inverse=True)
    a, b, weight = (np.bincount(piece, x / rows[of]) for x in (first, second, np.ones(len(of))))
    with np.errstate(invalid="ignore"):  # of one piece none is left
        without = ((b - a).sum() - (b - a)) / (weight.sum() - weight)
    return jackknifed(float(a.sum() / weight.sum()), float(b.sum() / weight.sum()), without)


def _numbered(times: np.ndarray, of: np.ndarray, spans: np.ndarray, length: float) -> np.ndarray:
    """The piece (n,) of each row of the recordings `of` (n,), whose spans have pieces of that length, s; −1 outside."""
    begin, end = spans.T
    counts = np.maximum(((end - begin) / length).astype(int), 1)
    share = (times - begin[of]) / np.maximum(end - begin, 1e-9)[of]
    piece = (np.cumsum(counts) - counts)[of] + np.minimum((share * counts[of]).astype(int), counts[of] - 1)
    return np.where((times >= begin[of]) & (times <= end[of]), piece, -1)


def _piece_length(
    values: Sequence[tuple[np.ndarray, np.ndarray]], recording: Sequence[np.ndarray], spans: np.ndarray
) -> float:
    """Seconds: a thirtieth of the time of all recordings, and several correlation times of the difference.

    `values`: of each run, the times of its rows and the values whose difference that is. `spans` (r, 2), s.
    """
    begin, end = spans.T
    total = float(np.maximum(end - begin, 0.0).sum())
    width, means = max(total / BINS, 1e-9), []
    counts = np.maximum(((end - begin) / width).astype(int), 1)
    for (times, value), of in zip(values, recording, strict=True):
        inside = (times >= begin[of]) & (times <= end[of])
        number, bins = of[inside], ((times - begin[of])[inside] / width).astype(int)
        place = (np.cumsum(counts) - counts)[number] + np.minimum(bins, counts[number] - 1)
        n, sums_of = (np.bincount(place, x, counts.sum()) for x in (None, value[inside]))
        means.append(sums_of / np.where(n, n, np.nan))
    runs = [x[np.isfinite(x)] for x in np.split(means[1] - means[0], np.cumsum(counts)[:-1])]
    return max(total / MOST_PIECES, CORRELATION_TIMES * width * _correlation_time(runs), 1e-9)


def _correlation_time(runs: Sequence[np.ndarray]) -> float:
    """The integrated autocorrelation time, in rows, of series about their common mean (Sokal's window of 5 times)."""
    values = np.concatenate(runs)
    if len(values) < 4 or np.ptp(values) == 0:
        return 1.0
    mean, variance, time = values.mean(), values.var(), 1.0
    for lag in range(1, len(values) // 3):
        products = sum(float((x[lag:] - mean) @ (x[:-lag] - mean)) for x in runs if len(x) > lag)
        time += 2.0 * products / len(values) / variance
        if lag >= 5 * time:
            break
    return max(time, 1.0)


def jackknifed(first: float, second: float, without: np.ndarray) -> Difference:
    """The difference of two values, with its interval by the differences without each of the pieces (n,)."""
    n, value = len(without), second - first
    variance = (n - 1) / n * float(((without - without.mean()) ** 2).sum()) if n >= LEAST_PIECES else math.nan
    if not math.isfinite(value + variance):
        return Difference(first, second, math.nan, math.nan, math.nan, n)
    if variance == 0.0:
        return Difference(first, second, value, value, float(value == 0), n)
    from scipy.special import stdtr, stdtrit

    sigma = math.sqrt(variance)
    half = float(stdtrit(n - 1, 0.975)) * sigma
    return Difference(first, second, value - half, value + half, 2.0 * float(stdtr(n - 1, -abs(value) / sigma)), n)
