"""Error figures of tracks against truth, per track, per recording and over all rows.

Names are as `--fail-if` and the JSON use them: metres and radians, horizontal unless `3d` says otherwise. A figure that
cannot be had (no heights, no reported covariance) is None.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import polars as pl

from trackers.core import metrics
from trackers.core.errors import UnusableInput
from trackers.core.estimates import Estimates
from trackers.core.recording import Recording
from trackers.core.rig import Station
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracks import Tracks
from trackers.recordings.truth import Matched, TruthStatus, is_bearing, match_truth, numbers, track_keys, true_bearings

Figures = dict[str, Any]


@dataclass(frozen=True)
class Evaluation:
    """The figures; those of recordings and tracks also say what they belong to (recording, tag, station)."""

    bearing: bool
    overall: Figures
    recordings: list[Figures]
    tracks: list[Figures]


@dataclass(frozen=True)
class _Judged:
    """What is judged.

    Of the rows that count: `index`, their place in the matched rows; `errors` (n, 3) m, of bearings (n, 2) rad; `apart`
    (n, 1) rad, for bearings the angle between the estimated and the true direction; `nees` in the plane (or of the two
    angles) and in space. Of all rows: `nis` and `dof`. Of each track: `lost` (g, 3), seconds lost, seconds, rows lost.
    """

    index: np.ndarray
    errors: np.ndarray
    apart: np.ndarray | None
    nees: np.ndarray
    nees_3d: np.ndarray | None
    nis: np.ndarray
    dof: np.ndarray
    lost: np.ndarray


def evaluate(
    estimates: Tracks | Estimates | pl.DataFrame,
    recordings: RecordingFolder | Recording | Sequence[RecordingFolder] | Sequence[Recording],
    every: float | None = None,
) -> Evaluation:
    """The error metrics of estimates against the truth of their recordings, at the times of the estimates.

    `estimates`: `Tracks`, a table with the columns of tracks.parquet, or the `Estimates` of `Recording`s whose truth
    is a `position`. `every`: s, evaluate only the last estimate in every interval of so many seconds. Raises
    UnusableInput where no recording has truth, and where no estimate meets one.
    """
    listed: list[RecordingFolder | Recording]
    listed = [recordings] if isinstance(recordings, (RecordingFolder, Recording)) else list(recordings)
    folders = [r for r in listed if isinstance(r, RecordingFolder)]
    truths = {f.name: f.tables["truth"] for f in folders if "truth" in f.tables}
    truths |= {r.name: _true_positions(r) for r in listed if isinstance(r, Recording) and "position" in r.truth}
    if not truths:
        names = ", ".join(str(getattr(r, "path", None) or r.name) for r in listed)
        raise UnusableInput(f"{names}: no truth table, expected one to evaluate against; give it with --truth")
    if isinstance(estimates, Estimates):
        # A recording in arrays has one trajectory, so that its name tells all.
        estimates = estimates.to_polars().with_columns(tag=pl.lit(""))
    table = estimates.to_polars() if isinstance(estimates, Tracks) else estimates
    return evaluate_table(table, truths, {f.name: f.rig.stations for f in folders}, every)


def _true_positions(recording: Recording) -> pl.DataFrame:
    """The truth of a recording in arrays as a truth table."""
    values, known = recording.truth["position"]
    axes = {
        f"{a}_m": np.asarray(values, float)[known, k] for k, a in zip(range(np.shape(values)[1]), "xyz", strict=False)
    }
    none = {f"{a}_m": np.full(int(np.sum(known)), np.nan) for a in "xyz"}
    return pl.DataFrame({"t_s": recording.times[known], "tag": [""] * int(np.sum(known))} | none | axes)


def evaluate_table(
    tracks: pl.DataFrame,
    truths: Mapping[str, pl.DataFrame],
    stations: Mapping[str, Mapping[str, Station]] | None = None,
    every: float | None = None,
) -> Evaluation:
    """The error figures of tracks against the truth of their recordings; levels above a track pool its rows.

    `stations`: for each recording its stations by id, needed for bearings. `every`: s, judge only the last estimate in
    every interval of so many seconds. Raises UnusableInput where no estimate meets a truth.
    """
    matched = match_truth(tracks, truths)
    _refuse_without_overlap(matched, truths)
    kept = last_of_every(matched, every) if every else np.flatnonzero(matched.counts)
    judged = _bearings(matched, kept, stations or {}) if is_bearing(tracks) else _positions(matched, kept)
    names = matched.rows.select(track_keys(tracks))[matched.starts[:-1]].to_dicts()
    last = len(names)
    first = [k for k in range(last) if k == 0 or names[k]["recording"] != names[k - 1]["recording"]]
    recordings = [
        {"recording": names[a]["recording"], **_figures(matched, judged, a, b)} for a, b in pairwise([*first, last])
    ]
    per_track = [{**name, **_figures(matched, judged, k, k + 1)} for k, name in enumerate(names)]
    return Evaluation(is_bearing(tracks), _figures(matched, judged, 0, last), recordings, per_track)


def covariances(rows: pl.DataFrame) -> np.ndarray:
    """The reported covariances (n, 3, 3), m², of position rows; what the table does not say is uncorrelated."""
    covs = np.empty((3, 3, len(rows)))
    for i, a in enumerate("xyz"):
        covs[i, i] = numbers(rows, f"std_{a}_m") ** 2
        for j, b in enumerate("xyz"[:i]):
            covs[i, j] = covs[j, i] = np.nan_to_num(numbers(rows, f"cov_{b}{a}_m2"))
    return np.moveaxis(covs, -1, 0)


def _figures(matched: Matched, judged: _Judged, first: int, end: int) -> Figures:
    """The figures of the tracks from `first` up to `end`."""
    begin, stop = matched.starts[first], matched.starts[end]
    part = slice(*np.searchsorted(judged.index, (begin, stop)))
    tally = np.bincount(matched.verdict[begin:stop], minlength=len(TruthStatus)).tolist()
    found: Figures = {
        "n": int(part.stop - part.start),
        "n_rows": int(stop - begin),
        "n_no_estimate": tally[TruthStatus.NO_ESTIMATE],
        "n_no_truth": tally[TruthStatus.NO_TRUTH],
        "n_hole": tally[TruthStatus.HOLE],
    }
    found |= _errors_of(judged.errors[part], None if judged.apart is None else judged.apart[part])
    found |= _belief(judged.nees[part], 2, "")
    if judged.nees_3d is not None:
        found |= _belief(judged.nees_3d[part], 3, "_3d")
    freedom = float(judged.dof[begin:stop].sum())
    seconds, span, rows = judged.lost[first:end].sum(axis=0).tolist()
    found |= {
        "nis_ratio": float(judged.nis[begin:stop].sum()) / freedom if freedom > 0 else None,
        "lost_s": seconds,
        "lost_fraction": seconds / span if span > 0 else rows / float(stop - begin),
    }
    return {name: None if value != value else value for name, value in found.items()}


def _errors_of(errors: np.ndarray, apart: np.ndarray | None) -> Figures:
    if apart is not None:
        parts = {"_direction_rad": apart, "_azimuth_rad": errors[:, :1], "_elevation_rad": errors[:, 1:]}
        bias = dict(zip(("bias_azimuth_rad", "bias_elevation_rad"), metrics.bias(errors).tolist(), strict=True))
    else:
        solid = errors[np.isfinite(errors[:, 2])]
        parts = {"_m": errors[:, :2], "_3d_m": solid}
        means = [*metrics.bias(errors[:, :2]).tolist(), float(metrics.bias(solid)[2])]
        bias = dict(zip(("bias_x_m", "bias_y_m", "bias_z_m"), means, strict=True))
    named = {
        name + suffix: value
        for suffix, values in parts.items()
        for name, value in metrics.error_metrics(values)._asdict().items()
    }
    return named | bias


def _belief(nees: np.ndarray, dof: int, suffix: str) -> Figures:
    known = nees[np.isfinite(nees)]
    return {
        f"nees{suffix}_mean": float(known.mean()) if len(known) else None,
        f"coverage_68{suffix}": metrics.covered(known, dof, 0.68),
        f"coverage_95{suffix}": metrics.covered(known, dof, 0.95),
    }


def _positions(matched: Matched, kept: np.ndarray) -> _Judged:
    rows = matched.rows[kept]
    errors = np.stack([numbers(rows, f"{axis}_m") for axis in "xyz"], axis=1) - matched.truth[kept]
    covs = covariances(rows)
    nees, nees_3d = metrics.nees(errors[:, :2], covs[:, :2, :2]), metrics.nees(errors, covs)
    return _Judged(kept, errors, None, nees, nees_3d, *_innovations(matched), _lost(matched))


def _bearings(matched: Matched, kept: np.ndarray, stations: Mapping[str, Mapping[str, Station]]) -> _Judged:
    rows = matched.rows[kept]
    true = true_bearings(matched, stations)[kept]
    estimate = np.stack([numbers(rows, "azimuth_rad"), numbers(rows, "elevation_rad")], axis=1)
    errors = estimate - true
    errors[:, 0] = np.pi - (np.pi - errors[:, 0]) % (2 * np.pi)
    u, v = _directions(estimate), _directions(true)
    # The sine and cosine together: the arc cosine alone loses angles under 1e-8 rad.
    apart = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("nd,nd->n", u, v))
    sigmas = np.stack([numbers(rows, "std_azimuth_rad"), numbers(rows, "std_elevation_rad")], axis=1)
    nees = metrics.nees(errors, sigmas[:, :, None] ** 2 * np.eye(2))
    return _Judged(kept, errors, apart[:, None], nees, None, *_innovations(matched), _lost(matched))


def _directions(angles: np.ndarray) -> np.ndarray:
    azimuth, elevation = angles.T
    flat = np.cos(elevation)
    return np.stack([np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat], axis=1)


def _innovations(matched: Matched) -> tuple[np.ndarray, np.ndarray]:
    """NIS and its degrees of freedom for every row, both zero where a row has none."""
    nis, dof = numbers(matched.rows, "nis"), numbers(matched.rows, "nis_dof")
    known = np.isfinite(nis) & (dof > 0)
    return np.where(known, nis, 0.0), np.where(known, dof, 0.0)


def _lost(matched: Matched) -> np.ndarray:
    """For each track (g, 3): seconds lost, seconds spanned, rows lost."""
    times, table = numbers(matched.rows, "t_s"), np.zeros((len(matched.starts) - 1, 3))
    if "status" not in matched.rows.columns:
        return table
    lost = (matched.rows["status"] == "lost").fill_null(False).to_numpy()
    for k, (a, b) in enumerate(pairwise(matched.starts)):
        known = np.isfinite(times[a:b])
        at, gone = times[a:b][known], lost[a:b][known]
        if len(at):
            table[k] = metrics.time_lost(at, gone).seconds, at[-1] - at[0], gone.sum()
    return table


def last_of_every(matched: Matched, every: float) -> np.ndarray:
    """Of the rows that count those that are the last of their track in their interval of `every` seconds."""
    rows = np.flatnonzero(matched.counts)
    # A time such as 0.3 s belongs to the interval it opens although 0.3 / 0.1 is 2.9999999999999996.
    interval = np.floor(numbers(matched.rows, "t_s")[rows] / every + 1e-6)
    track = np.searchsorted(matched.starts, rows, side="right")
    return rows[np.append((np.diff(interval) != 0) | (np.diff(track) != 0), True)]


def _refuse_without_overlap(matched: Matched, truths: Mapping[str, pl.DataFrame]) -> None:
    if matched.counts.any():
        return
    rows, usable = matched.rows, matched.verdict != TruthStatus.NO_ESTIMATE
    expected = "expected estimates inside the span of a truth of the same recording and tag"
    if not usable.any():
        raise UnusableInput(
            f"the tracks: none of {len(rows)} rows holds an estimate (waiting, non-finite or empty); {expected}; "
            "ask `trackwright check` about the recording"
        )
    common = sorted(set(rows["recording"]) & set(truths))
    if not common:
        raise UnusableInput(
            f"the tracks are of recording {_some(rows['recording'])}, the truth is of {_some(truths)}; {expected}; "
            "give the recordings that were tracked as --truth"
        )
    truth = truths[common[0]]
    raise UnusableInput(
        f"no estimate meets a truth: estimates {_span(rows.filter(usable))} of tags {_some(rows['tag'])}, "
        f"truth of '{common[0]}' {_span(truth)} of tags {_some(truth['tag'])}; "
        f"{expected}; compare time bases and tag ids"
    )


def _span(table: pl.DataFrame) -> str:
    times = numbers(table, "t_s")
    return f"from {times.min():g} to {times.max():g} s" if len(times) else "at no time"


def _some(names: Iterable[object]) -> str:
    listed = sorted({str(name) for name in names})
    return (", ".join(listed[:5]) or "none") + (f" and {len(listed) - 5} more" if len(listed) > 5 else "")
