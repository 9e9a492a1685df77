"""Differences between two runs on the same recordings, with intervals that respect that errors last.

Both runs are cut into the same pieces of time, several times longer than the correlation of the errors, so that pieces
are nearly independent; many tracks are pieces themselves. The interval is that of Student's t with the variance of the
jackknife over pieces (Efron and Stein 1981; Künsch 1989 for pieces of a time series).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trackwright.trackers.core.data.consistency import chi_square_quantile
from trackwright.trackers.evaluation import metrics as table
from trackwright.trackers.evaluation.association import Association
from trackwright.trackers.evaluation.scores import Groups, Scores, Values, error_sums
from trackwright.trackers.evaluation.scoring import Scored
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.tracks_table import track_keys

MOST_PIECES, LEAST_PIECES = 30, 5
MANY_TRACKS = 30
"""Tracks from which each is a piece."""

CORRELATION_TIMES = 4.0
"""Least length of a piece, in integrated autocorrelation times of the difference of squared errors."""

BINS = 600
"""Bins of time in which the autocorrelation is estimated."""

Key = tuple[str, ...]
"""Recording, tag and, of bearings, station."""


class TrackErrors(NamedTuple):
    """Scored estimates of a track: `times` (n,) s, and of each the error, m, or of bearings the angle, rad.

    `error_3d` (n,): NaN of bearings. `inside` (n,): 1 where the 95 % ellipse contains the truth, else 0; NaN without a
    covariance. `density`, `energy` (n,): log density of the truth, nats, and energy score, m; NaN without a positive
    definite covariance, and the latter of bearings.
    """

    times: np.ndarray
    error: np.ndarray
    error_3d: np.ndarray
    inside: np.ndarray
    density: np.ndarray
    energy: np.ndarray


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


METRICS = ("rmse_m", "median_m", "p95_m", "rmse_3d_m", "coverage_95", "log_density", "energy_score_m")
"""The metrics of which differences are taken; those of bearings are of the angle."""


def errors_by_track(association: Association, scored: Scored) -> dict[Key, TrackErrors]:
    """The scored errors of each track by its recording, tag and station."""
    keys = association.rows.select(track_keys(association.rows))[association.starts[:-1]].rows()
    times = float_column(association.rows, "t_s")[scored.index]
    in_space = scored.sizes.get("3d_m", np.full(len(times), math.nan))
    inside = np.where(~np.isnan(scored.nees), scored.nees <= chi_square_quantile(0.95, 2), math.nan)
    known, energy = np.isfinite(scored.nees), np.full(len(times), math.nan)
    if scored.nees_3d is not None:
        energy[known] = scored.energy_score(known, 2)
    density = np.where(known, scored.log_density(2), math.nan)
    ends = np.searchsorted(scored.index, association.starts)
    rows = TrackErrors(times, scored.size, in_space, inside, density, energy)
    return {
        tuple(key): TrackErrors(*(x[a:b] for x in rows))
        for key, a, b in zip(keys, ends[:-1], ends[1:], strict=True)
        if b > a
    }


def paired_differences(
    first: Mapping[Key, TrackErrors], second: Mapping[Key, TrackErrors], metrics: Sequence[str] = tuple(METRICS)
) -> dict[str, Difference]:
    """The differences of the metrics over the tracks that both runs have; empty without a common track."""
    common = [key for key in first if key in second]
    if not common:
        return {}
    a, b = _in_pieces(common, first, second)
    pieces = np.intersect1d(a.piece, b.piece)
    a, b = a.of(pieces), b.of(pieces)
    kind = "tracks" if len(common) >= MANY_TRACKS else "pieces of time, several times longer than errors last"
    before, after = (run.metrics(metrics, pieces) for run in (a, b))
    return {
        name: jackknifed(x[0].item(), y[0].item(), y[1:] - x[1:])._replace(kind=kind)
        for (name, x), y in zip(before.items(), after.values(), strict=True)
    }


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


class _Pieces(NamedTuple):
    """The rows of a run and the `piece` (n,) of each."""

    rows: TrackErrors
    piece: np.ndarray

    def of(self, pieces: np.ndarray) -> _Pieces:
        kept = np.isin(self.piece, pieces)
        return _Pieces(TrackErrors(*(x[kept] for x in self.rows)), self.piece[kept])

    def metrics(self, names: Sequence[str], pieces: np.ndarray) -> dict[str, np.ndarray]:
        """The metrics by name, (1 + k,): of all rows, and of those without each of the k pieces."""
        parts = [_scores(self.rows, self.piece != piece) for piece in (None, *pieces)]
        with np.errstate(invalid="ignore", divide="ignore"):
            return {name: np.array([table.METRICS[name].formula(part).item() for part in parts]) for name in names}


def _scores(rows: TrackErrors, kept: np.ndarray) -> Scores:
    """The scores of the rows that are kept, (n,), as one group."""
    sums: dict[str, np.ndarray] = {}
    for kind, size in (("m", rows.error), ("3d_m", rows.error_3d)):
        known = size[kept & ~np.isnan(size)]
        sums |= error_sums(kind, known, Groups(np.array([0, len(known)])))[0]
    inside, density, energy = (x[kept & ~np.isnan(x)] for x in (rows.inside, rows.density, rows.energy))
    sums |= {
        "n nees": np.array([len(density)]),
        "zero nees": np.array([len(inside) - len(density)]),
        "inside 95 nees": np.array([inside.sum()]),
        "log density nees": np.array([density.sum()]),
        "energy nees": np.array([energy.sum() if len(energy) else math.nan]),
    }
    errors = rows.error[kept]
    return Scores(sums, {}, {}, {"m": Values(errors, np.array([0, len(errors)]))})


def _in_pieces(
    common: Sequence[Key], first: Mapping[Key, TrackErrors], second: Mapping[Key, TrackErrors]
) -> tuple[_Pieces, _Pieces]:
    """The rows of the common tracks of both runs with their pieces, −1 outside the time that both cover."""
    joined = [_joined([run[key] for key in common]) for run in (first, second)]
    lengths = [np.array([len(run[key].times) for key in common]) for run in (first, second)]
    if len(common) >= MANY_TRACKS:
        return tuple(  # type: ignore[return-value]
            _Pieces(rows, np.repeat(np.arange(len(common)), n)) for rows, n in zip(joined, lengths, strict=True)
        )
    names = list(dict.fromkeys(key[0] for key in common))
    number = np.array([names.index(key[0]) for key in common])
    recording = [np.repeat(number, n) for n in lengths]
    spans = []
    for k in range(len(names)):
        times = [rows.times[of == k] for rows, of in zip(joined, recording, strict=True)]
        spans.append((max(x.min() for x in times), min(x.max() for x in times)))
    length = _piece_length([(rows.times, rows.error**2) for rows in joined], recording, spans)
    parts = []
    for rows, of in zip(joined, recording, strict=True):
        piece = _numbered(rows.times, of, spans, length)
        parts.append(_Pieces(rows, piece).of(np.unique(piece[piece >= 0])))
    return tuple(parts)  # type: ignore[return-value]


def paired_means(times: np.ndarray, first: np.ndarray, second: np.ndarray, recording: np.ndarray) -> Difference:
    """The difference of the means of two values (n,) of the same rows; all recordings have the same weight.

    `times` (n,), s; `recording` (n,): the name of that of each row.
    """
    _, of, rows = np.unique(recording, return_inverse=True, return_counts=True)
    spans = [(times[of == k].min(), times[of == k].max()) for k in range(len(rows))]
    # About the mean of each recording: what differs between them is no correlation in time.
    means = np.bincount(of, second - first) / rows
    length = _piece_length([(times, np.zeros(len(of))), (times, second - first - means[of])], [of, of], spans)
    _, piece = np.unique(_numbered(times, of, spans, length), return_inverse=True)
    a, b, weight = (np.bincount(piece, x / rows[of]) for x in (first, second, np.ones(len(of))))
    with np.errstate(invalid="ignore"):  # of one piece none is left
        without = ((b - a).sum() - (b - a)) / (weight.sum() - weight)
    return jackknifed(float(a.sum() / weight.sum()), float(b.sum() / weight.sum()), without)


def _numbered(times: np.ndarray, of: np.ndarray, spans: Sequence[tuple], length: float) -> np.ndarray:
    """The piece (n,) of each row of the recordings `of` (n,), whose spans have pieces of that length, s; −1 outside."""
    piece, before = np.full(len(times), -1), 0
    for k, (begin, end) in enumerate(spans):
        count = max(int((end - begin) / length), 1) if end > begin else 1
        in_span = np.flatnonzero((of == k) & (times >= begin) & (times <= end))
        share = (times[in_span] - begin) / max(end - begin, 1e-9)
        piece[in_span] = before + np.minimum((share * count).astype(int), count - 1)
        before += count
    return piece


def _piece_length(
    values: Sequence[tuple[np.ndarray, np.ndarray]], recording: Sequence[np.ndarray], spans: Sequence[tuple]
) -> float:
    """Seconds: a thirtieth of the time of all recordings, and several correlation times of the difference.

    `values`: of each run, the times of its rows and the values whose difference that is.
    """
    total = sum(max(end - begin, 0.0) for begin, end in spans)
    width, runs = max(total / BINS, 1e-9), []
    for k, (begin, end) in enumerate(spans):
        count = max(int((end - begin) / width), 1)
        means = []
        for (times, value), of in zip(values, recording, strict=True):
            in_span = (of == k) & (times >= begin) & (times <= end)
            place = np.minimum(((times[in_span] - begin) / width).astype(int), count - 1)
            n = np.bincount(place, minlength=count)
            means.append(np.bincount(place, value[in_span], minlength=count) / np.where(n, n, np.nan))
        difference = means[1] - means[0]
        runs.append(difference[np.isfinite(difference)])
    return max(total / MOST_PIECES, CORRELATION_TIMES * width * _correlation_time(runs), 1e-9)


def _correlation_time(runs: Sequence[np.ndarray]) -> float:
    """The integrated autocorrelation time, in rows, of series about their common mean (Sokal's window of 5 times)."""
    values = np.concatenate(runs)
    if len(values) < 4 or np.ptp(values) == 0:
        return 1.0
    mean, variance, time = values.mean(), values.var(), 1.0
    for lag in range(1, len(values) // 3):
        products = [(x[lag:] - mean) * (x[:-lag] - mean) for x in runs if len(x) > lag]
        time += 2.0 * float(np.concatenate(products).sum()) / len(values) / variance if products else 0.0
        if lag >= 5 * time:
            break
    return max(time, 1.0)


def jackknifed(first: float, second: float, without: np.ndarray) -> Difference:
    """The difference of two values, with its interval by the differences without each of the pieces (n,)."""
    n = len(without)
    unknown = Difference(first, second, math.nan, math.nan, math.nan, n)
    if n < LEAST_PIECES or not math.isfinite(second - first):
        return unknown
    variance = (n - 1) / n * float(((without - without.mean()) ** 2).sum())
    if not math.isfinite(variance):
        return unknown
    if variance == 0.0:
        same = second == first
        return Difference(first, second, second - first, second - first, 1.0 if same else 0.0, n)
    from scipy.special import stdtr, stdtrit

    sigma, value = math.sqrt(variance), second - first
    half = float(stdtrit(n - 1, 0.975)) * sigma
    return Difference(first, second, value - half, value + half, 2.0 * float(stdtr(n - 1, -abs(value) / sigma)), n)


def _joined(parts: Sequence[TrackErrors]) -> TrackErrors:
    return TrackErrors(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
