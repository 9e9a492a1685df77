"""Recordings before and after a fit: errors and consistency as `evaluate` has them, the verdict, tracks."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.pages.charts.floor import ellipse_rows
from trackwright.experiments.pages.charts.style import broken_at_gaps
from trackwright.experiments.pages.reports.pages import drawn_rows
from trackwright.experiments.pages.reports.verdict import Verdict, cells, density_content, judge
from trackwright.experiments.text.tables import rendered, ruled_table, terminal_width
from trackwright.experiments.text.wording import SHOWN, fixed, length_unit
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.association import Association, associate_truth
from trackwright.trackers.evaluation.evaluate import evaluate_association
from trackwright.trackers.evaluation.scoring import covariances
from trackwright.trackers.evaluation.statements import covariance_statements
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.tracks_table import is_bearing
from trackwright.trackers.recordings.truth import TruthStatus

WIDTH = 120
DEGREES = SHOWN["rad"]


class Compared(NamedTuple):
    """A table of recordings before and after tuning, the verdict, and sentences on the covariances after it.

    `about`: in words, the recordings; `head`: its columns; `rows`: the text of its cells. `metrics`: of each recording
    by name, before and after.
    """

    about: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    statements: tuple[str, ...]
    verdict: Verdict
    metrics: Mapping[str, Mapping[str, tuple[float | None, float | None]]] = {}

    def text(self) -> str:
        """The table and the sentences for a terminal."""
        title = f"{self.about[0].upper()}{self.about[1:]}, before → after"
        verdict = f"Verdict: {self.verdict.word}. {self.verdict.sentence(self.about)}"
        sentences = (*self.statements, verdict, *self.verdict.got_worse)
        return rendered(terminal_width(WIDTH), ruled_table(title, self.head, 1, self.rows), *sentences)

    def content(self) -> dict[str, Any]:
        """The verdict and the table as tuned.toml holds them, nan for what is unknown."""
        verdict = self.verdict
        whole = {} if verdict.change is None else {"log_density": density_content(verdict.change)}
        recordings = {}
        for name, metrics in self.metrics.items():
            of_recording: dict[str, Any] = {
                metric: [math.nan if x is None else float(f"{x:.6g}") for x in pair] for metric, pair in metrics.items()
            }
            if name in verdict.recordings:
                of_recording["log_density"] = density_content(verdict.recordings[name])
            recordings[name] = of_recording | ({"worse": verdict.worse[name]} if name in verdict.worse else {})
        return {"verdict": verdict.word, "judged_by": self.about, **whole, "recordings": recordings}


def tracked(tracker: NamedTracker, folders: Sequence[RecordingFolder]) -> Association:
    """The estimates of the recordings, tracked as `track` does it, with their truth."""
    return with_truth(tracker.run(folders).table, folders)


def with_truth(tracks: pl.DataFrame, folders: Sequence[RecordingFolder]) -> Association:
    """Estimates of the recordings with their truth."""
    return associate_truth(tracks, {f.name: f.tables["truth"] for f in folders if "truth" in f.tables})


def compare(
    sides: Sequence[Association], folders: Sequence[RecordingFolder], dimensions: int, about: str, why_not: str = ""
) -> Compared:
    """Errors of the recordings `folders` in the estimates before and after tuning, those of `tracked`.

    `dimensions`: 3 for errors and ellipsoids in space, 2 for those over the floor. `about`: in words, the recordings.
    `why_not`: why there is no verdict. A recording without truth has no figures but those of its innovations.
    """
    names, stations = sorted(f.name for f in folders), {f.name: f.rig.stations for f in folders}
    sides = [Association.joined([side.of_recording(name) for name in names]) for side in sides]
    before, after = (evaluate_association(side, stations) for side in sides)
    suffix = "_3d" if dimensions == 3 and before.overall.get("coverage_95_3d") is not None else ""
    error = "rmse_direction_rad" if before.bearing else f"rmse{suffix}_m"
    pairs = list(zip(before.recordings, after.recordings, strict=True))
    unit = DEGREES if before.bearing else length_unit(before.overall[error] or 1.0)
    shape = "ellipsoid" if suffix else "ellipse"
    named = {
        f"{'3-D ' if suffix else ''}RMSE, {unit.name}": (error, unit.factor, 3 if unit.name == "m" else 1),
        f"% in 95 % {shape}": (f"coverage_95{suffix}", 100.0, 0),
        "NEES/dof": (f"nees{suffix}_ratio", 1.0, 2),
        "NIS r 1 s": ("nis_correlation_1s", 1.0, 2),
    }
    verdict = Verdict(None, {}, {}, why_not) if why_not else judge(sides, folders, 3 if suffix else 2)
    rows = [
        (name := old["recording"], *_cells(old, new, named.values()), *cells(verdict.recordings.get(name)))
        for old, new in pairs
    ]
    if len(pairs) > 1:
        means = [_means(side, named.values()) for side in zip(*pairs, strict=True)]
        rows.append((f"mean of {len(pairs)}", *_cells(means[0], means[1], named.values()), *cells(verdict.change)))
    sentences = covariance_statements(after.overall, after.recordings)
    metrics = {
        old["recording"]: {metric: (old[metric], new[metric]) for metric, _, _ in named.values()} for old, new in pairs
    }
    head = ("recording", *named, "log density, nats", "difference, 95 %")
    return Compared(about, head, tuple(rows), tuple(sentences), verdict, metrics)


def _cells(old: Any, new: Any, columns: Any) -> Iterator[str]:
    for name, factor, digits in columns:
        pair = (None if side[name] is None else factor * side[name] for side in (old, new))
        yield " → ".join(fixed(value, digits) for value in pair)


def _means(metrics: Sequence[Any], columns: Any) -> dict[str, float | None]:
    """The mean over recordings, each with the same weight; None where one has no value."""
    means: dict[str, float | None] = {}
    for name, _, _ in columns:
        values = [m[name] for m in metrics]
        means[name] = None if None in values else sum(values) / len(values)
    return means


MOST_PLANS = 8
"""The most floor plans of a report."""

MOST_TAGS = 3
"""The most tags of a recording that have a floor plan each."""

MOST_POINTS = 1000
"""The most points of a path."""

ELLIPSES = 12
"""Moments at which both ellipses are drawn."""


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
    """One track of a recording before and after: the rows `part` of both associations.

    `positions` (n, 2), m, of each side, NaN in rows without an estimate. `why`: it is shown.
    """

    folder: RecordingFolder
    sides: tuple[Association, Association]
    part: slice
    positions: tuple[np.ndarray, np.ndarray]
    why: str = ""

    @cached_property
    def rmse(self) -> tuple[float, ...]:
        """The horizontal RMSE of each side, m; NaN without truth."""
        return tuple(
            _rms(positions - side.truth[self.part, :2])
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
    pairs, total = list[_Pair](), 0
    for folder in sorted(folders, key=lambda folder: folder.name not in held_out):
        of_folder = _pairs(folder, (before.of_recording(folder.name), after.of_recording(folder.name)))
        pairs, total = [*pairs, *_chosen(of_folder)], total + len(of_folder)
    order = sorted(range(len(pairs)), key=lambda k: (pairs[k].folder.name not in held_out, -pairs[k].moved))
    shown = (pairs[k] for k in sorted(order[:MOST_PLANS]))
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
    rows = pair.sides[1].rows[pair.part]
    tag, times = str(rows["tag"][0]), float_column(rows, "t_s")
    covs = [covariances(side.rows[pair.part])[:, :2, :2] for side in pair.sides]
    moments = ellipse_rows(pair.positions, covs, ELLIPSES)
    before, after = (
        Side(_path(times, positions, side.truth[pair.part, :2]), positions[moments], cov[moments], rmse)
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


def _path(times: np.ndarray, positions: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """At most about `MOST_POINTS` positions, those with the largest errors among them, with NaN in gaps."""
    there = np.isfinite(positions).all(axis=1)
    times, positions, errors = times[there], positions[there], np.linalg.norm(positions - truth, axis=1)[there]
    _, broken, weight = broken_at_gaps(times, positions, errors)
    kept = drawn_rows(np.array([len(broken)]), np.where(np.isnan(broken[:, 0]), np.inf, weight), MOST_POINTS)
    return broken[kept]


def _truth(folder: RecordingFolder, tag: str, start: float, stop: float) -> np.ndarray:
    """The true path of a tag between two times."""
    if tag not in folder.paths.number:
        return np.zeros((0, 2))
    times, positions = folder.paths.of_tag(tag)
    part = (times >= start) & (times <= stop)
    return _path(times[part], positions[part, :2], positions[part, :2])
