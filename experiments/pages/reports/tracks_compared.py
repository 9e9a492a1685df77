"""Tracks before and after tuning over their truth, as the floor plans of a tuning report show them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.pages.interactive.decimation import drawn_rows
from trackwright.experiments.pages.plots.style import broken_at_gaps
from trackwright.experiments.text.wording import fixed, length_unit
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.association import Association
from trackwright.trackers.evaluation.scoring import covariances
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks_table import is_bearing
from trackwright.trackers.recordings.truth import TruthStatus

MOST_PLANS = 8
"""The most floor plans of a report."""

MOST_TAGS = 3
"""The most tags of a recording that have a floor plan each."""

MOST_POINTS = 1000
"""The most points of a path."""

ELLIPSES = 12
"""Moments at which both ellipses are drawn."""

LARGE = 3.0
"""A moment whose ellipse has a major axis so many times the median, as that of a start, is left out."""


class Side(NamedTuple):
    """A track with one of the two sets of noise levels.

    `path` (n, 2), m, with a row of NaN in each gap. `centres` (k, 2), m, and `covs` (k, 2, 2), m², of some estimates,
    those of the same moments on both sides. `rmse`: horizontal, m, NaN without truth.
    """

    path: np.ndarray
    centres: np.ndarray
    covs: np.ndarray
    rmse: float


@dataclass(frozen=True)
class TrackChange:
    """A track before and after, its true path (n, 2), m, with NaN in gaps, and why it is shown, empty for all tags."""

    recording: str
    tag: str
    held_out: bool
    why: str
    rig: Rig
    truth: np.ndarray
    before: Side
    after: Side

    @property
    def rmse(self) -> str:
        """The RMSE before and after in words; empty without truth."""
        pair = (self.before.rmse, self.after.rmse)
        if not np.isfinite(pair).any():
            return ""
        unit = length_unit(float(np.nanmax(pair)))
        return " → ".join(fixed(unit.factor * x, 3 if unit.name == "m" else 1) for x in pair) + f" {unit.name}"


class TrackChanges(NamedTuple):
    """The tracks that are shown, and of how many."""

    shown: tuple[TrackChange, ...]
    total: int


@dataclass(frozen=True)
class _Pair:
    """One track of a recording before and after: the rows `own` of both associations.

    `positions` (n, 2), m, of each side, NaN in rows without an estimate. `why`: it is shown.
    """

    folder: RecordingFolder
    sides: tuple[Association, Association]
    own: slice
    positions: tuple[np.ndarray, np.ndarray]
    why: str = ""

    @cached_property
    def rmse(self) -> tuple[float, ...]:
        """The horizontal RMSE of each side, m; NaN without truth."""
        return tuple(
            _rms(positions - side.truth[self.own, :2])
            for side, positions in zip(self.sides, self.positions, strict=True)
        )

    @cached_property
    def moved(self) -> float:
        """The root mean square distance, m, of the estimates after from those before."""
        return _rms(self.positions[1] - self.positions[0])


def track_changes(
    before: Association, after: Association, folders: Sequence[RecordingFolder], held_out: Collection[str]
) -> TrackChanges:
    """The tracks of these recordings before and after; of bearings there are none.

    Of a recording with more than `MOST_TAGS` tags those with the largest, the median and the smallest RMSE after the
    fit; of more than `MOST_PLANS` tracks those that moved most, and of recordings named `held_out` before others.
    """
    if is_bearing(after.rows):
        return TrackChanges((), 0)
    found, total = list[_Pair](), 0
    for folder in sorted(folders, key=lambda folder: folder.name not in held_out):
        own = _pairs(folder, (before.of_recording(folder.name), after.of_recording(folder.name)))
        found, total = [*found, *_chosen(own)], total + len(own)
    order = sorted(range(len(found)), key=lambda k: (found[k].folder.name not in held_out, -found[k].moved))
    shown = (found[k] for k in sorted(order[:MOST_PLANS]))
    return TrackChanges(tuple(_change(pair, pair.folder.name in held_out) for pair in shown), total)


def _pairs(folder: RecordingFolder, sides: tuple[Association, Association]) -> list[_Pair]:
    """The tracks of a recording that have estimates of a moment both before and after."""
    old, new = (_positions(side) for side in sides)
    parts = [slice(a, b) for a, b in pairwise(sides[0].starts)]
    pairs = [_Pair(folder, sides, part, (old[part], new[part])) for part in parts]
    return [pair for pair in pairs if np.isfinite(pair.moved)]


def _chosen(pairs: list[_Pair]) -> list[_Pair]:
    """All tracks of a recording, or of many the worst, the median and the best; without truth by how far they moved."""
    if len(pairs) <= MOST_TAGS:
        return pairs
    known = [pair for pair in pairs if np.isfinite(pair.rmse[1])]
    if known:
        ranked = sorted(known, key=lambda pair: -pair.rmse[1])
        about = f"RMSE after the fit, of {len(ranked)} tags"
    else:
        ranked = sorted(pairs, key=lambda pair: -pair.moved)
        about = f"change, of {len(ranked)} tags"
    places = {"largest": 0, "median": len(ranked) // 2, "smallest": len(ranked) - 1}
    return [replace(ranked[k], why=f"{word} {about}") for word, k in places.items()]


def _change(pair: _Pair, held_out: bool) -> TrackChange:
    rows = pair.sides[1].rows[pair.own]
    tag, times = str(rows["tag"][0]), float_column(rows, "t_s")
    covs = [covariances(side.rows[pair.own])[:, :2, :2] for side in pair.sides]
    moments = _moments(pair.positions, covs)
    before, after = (
        Side(_path(times, positions, side.truth[pair.own, :2]), positions[moments], cov[moments], rmse)
        for positions, side, cov, rmse in zip(pair.positions, pair.sides, covs, pair.rmse, strict=True)
    )
    true = _truth(pair.folder, tag, times[0], times[-1])
    return TrackChange(pair.folder.name, tag, held_out, pair.why, pair.folder.rig, true, before, after)


def _positions(side: Association) -> np.ndarray:
    """The estimates (n, 2), m, NaN in rows without one."""
    positions = np.stack([float_column(side.rows, "x_m"), float_column(side.rows, "y_m")], axis=1)
    return np.where((side.truth_status != TruthStatus.NO_ESTIMATE)[:, None], positions, np.nan)


def _rms(offsets: np.ndarray) -> float:
    """The root mean square length of the offsets (n, 2) that are finite; NaN where none is."""
    squares = (offsets**2).sum(axis=1)
    known = np.isfinite(squares)
    return float(np.sqrt(squares[known].mean())) if known.any() else float("nan")


def _moments(positions: Sequence[np.ndarray], covs: Sequence[np.ndarray]) -> np.ndarray:
    """The rows whose ellipses are drawn: evenly over those with a usual covariance on both sides."""
    usable = np.ones(len(positions[0]), bool)
    for place, cov in zip(positions, covs, strict=True):
        proper = np.isfinite(place).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)) & (cov[:, 0, 0] > 0)
        major = np.full(len(cov), np.inf)
        major[proper] = np.linalg.eigvalsh(cov[proper])[:, 1]
        usable &= major <= LARGE**2 * (np.median(major[proper]) if proper.any() else 0.0)
    rows = np.flatnonzero(usable)
    return rows[np.unique((np.arange(ELLIPSES) + 0.5) * len(rows) / ELLIPSES).astype(int)] if len(rows) else rows


def _path(times: np.ndarray, positions: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """At most about `MOST_POINTS` positions, those with the largest errors among them, with NaN in gaps."""
    there = np.isfinite(positions).all(axis=1)
    times, positions, errors = times[there], positions[there], np.linalg.norm(positions - truth, axis=1)[there]
    _, broken, weight = broken_at_gaps(times, positions, errors)
    kept = drawn_rows(np.array([len(broken)]), np.where(np.isnan(broken[:, 0]), np.inf, weight), MOST_POINTS)
    return broken[kept]


def _truth(folder: RecordingFolder, tag: str, start: float, stop: float) -> np.ndarray:
    """The true path of a tag between two times."""
    if "truth" not in folder.tables:
        return np.zeros((0, 2))
    rows = folder.tables["truth"].filter(pl.col("tag").cast(pl.String) == tag, pl.col("t_s").is_between(start, stop))
    rows = rows.sort("t_s")
    positions = np.stack([float_column(rows, "x_m"), float_column(rows, "y_m")], axis=1)
    return _path(float_column(rows, "t_s"), positions, positions)
