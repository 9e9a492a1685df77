"""Recordings before and after a fit: errors and consistency as `evaluate` has them, the verdict, tracks."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.pages.reports.verdict import Verdict, cells, density_content, judge
from trackwright.experiments.pages.scored_tracks import ScoredRecording, ScoredTracks, drawn_of, root_mean_square
from trackwright.experiments.text.tables import Section, sections_text
from trackwright.experiments.text.wording import SHOWN, fixed, length_unit
from trackwright.trackers.evaluation.evaluate import Evaluation, truths_of
from trackwright.trackers.evaluation.rows import scored_rows
from trackwright.trackers.evaluation.statements import covariance_statements
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker

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

    @property
    def section(self) -> Section:
        """The table and the sentences on covariances, for a terminal and a page."""
        title, looks = f"{self.about[0].upper()}{self.about[1:]}, before → after", dict.fromkeys(self.head[1:], "after")
        note = "Tracked as by `track`. Regret: nats of the log density that the scale of the covariances loses."
        return Section(title, self.head, self.rows, 1, note, looks, self.statements)

    def text(self) -> str:
        """The table and the sentences for a terminal."""
        verdict = f"Verdict: {self.verdict.word}. {self.verdict.sentence(self.about)}"
        return sections_text([self.section], WIDTH, *self.statements, verdict, *self.verdict.got_worse)

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


def tracked(tracker: NamedTracker, folders: Sequence[RecordingFolder]) -> pl.DataFrame:
    """The estimates of the recordings, tracked as `track` does it, with their truth."""
    return with_truth(tracker.run(folders).table, folders)


def with_truth(tracks: pl.DataFrame, folders: Sequence[RecordingFolder]) -> pl.DataFrame:
    """Estimates of the recordings with their truth."""
    return scored_rows(tracks, truths_of(folders), {folder.name: folder.rig.stations for folder in folders})


def compare(
    sides: Sequence[pl.DataFrame], folders: Sequence[RecordingFolder], dimensions: int, about: str, why_not: str = ""
) -> Compared:
    """Errors of the recordings `folders` in the estimates before and after tuning, those of `tracked`.

    `dimensions`: 3 for errors and ellipsoids in space, 2 for those over the floor. `about`: in words, the recordings.
    `why_not`: why there is no verdict. A recording without truth has no figures but those of its innovations.
    """
    sides = [side.filter(pl.col("recording").is_in([folder.name for folder in folders])) for side in sides]
    before, after = map(Evaluation.of, sides)
    suffix = "_3d" if dimensions == 3 and before.overall.get("coverage_95_3d") is not None else ""
    error = "rmse_direction_rad" if before.bearing else f"rmse{suffix}_m"
    pairs = list(zip(before.recordings, after.recordings, strict=True))
    unit = DEGREES if before.bearing else length_unit(before.overall[error] or 1.0)
    shape = "ellipsoid" if suffix else "ellipse"
    named = {
        f"{'3-D ' if suffix else ''}RMSE, {unit.name}": (error, unit.factor, 3 if unit.name == "m" else 1),
        f"% in 95 % {shape}": (f"coverage_95{suffix}", 100.0, 0),
        "NEES/dof": (f"nees{suffix}_ratio", 1.0, 2),
        "regret": (f"regret{suffix}", 1.0, 2),
        "NIS/dof": ("nis_ratio", 1.0, 2),
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
    values = {name: [m[name] for m in metrics] for name, _, _ in columns}
    return {name: None if None in x else sum(x) / len(x) for name, x in values.items()}


MOST_PLANS = 8
"""The most floor plans of a report."""

MOST_TAGS = 3
"""The most tags of a recording that have a floor plan each."""


class ErrorTrack(NamedTuple):
    """Sizes of the errors of a track before and after (t,), m or °, NaN where unknown, at `times` (t,).

    `times`: s since the first estimate of the recording.
    """

    name: str
    times: np.ndarray
    before: np.ndarray
    after: np.ndarray


class TrackChange(NamedTuple):
    """A track by its number in its recording before and after, whether that was held out, and why it is shown."""

    before: ScoredRecording
    after: ScoredRecording
    track: int
    held_out: bool
    why: str = ""

    @property
    def name(self) -> str:
        """The recording, the tag and, of bearings, the station."""
        first = self.after.first.row(self.track, named=True)
        of_station = f", station {first['station']}" if self.after.angles else ""
        return f"{self.after.folder.name}, tag {first['tag']}{of_station}"

    @property
    def errors(self) -> ErrorTrack:
        """The errors over time."""
        rows, factor = self.after.rows_of(self.track), 180 / np.pi if self.after.angles else 1.0
        times = self.after.times - self.after.times.min()
        return ErrorTrack(self.name, times[rows], factor * self.before.miss[rows], factor * self.after.miss[rows])

    @property
    def rmse(self) -> str:
        """The RMSE before and after in words; empty without truth."""
        pair = self.before.rmse[self.track], self.after.rmse[self.track]
        if not np.isfinite(pair).any():
            return ""
        unit = length_unit(float(np.nanmax(pair)))
        return " → ".join(fixed(unit.factor * x, 3 if unit.name == "m" else 1) for x in pair) + f" {unit.name}"

    @property
    def moved(self) -> float:
        """The root mean square distance, m, of the estimates after from those before; NaN without both of a moment."""
        rows = self.after.rows_of(self.track)
        return root_mean_square(np.linalg.norm(self.after.places[rows] - self.before.places[rows], axis=1))


class TrackChanges(NamedTuple):
    """The tracks that are shown, of how many, and the errors of all that are held out or, without these, of all."""

    shown: tuple[TrackChange, ...]
    total: int
    errors: tuple[ErrorTrack, ...]


NO_PLANS = TrackChanges((), 0, ())


def track_changes(
    before: pl.DataFrame, after: pl.DataFrame, folders: Sequence[RecordingFolder], held_out: Collection[str]
) -> TrackChanges:
    """The tracks of these recordings before and after; of bearings there are errors alone.

    Of a recording with more than `MOST_TAGS` tags the worst, the median and the best after the fit; of more than
    `MOST_PLANS` tracks those that moved most, and of recordings named `held_out` before others.
    """
    ordered = sorted(folders, key=lambda folder: folder.name not in held_out)
    changes, errors, total = list[TrackChange](), list[ErrorTrack](), 0
    for old, new in zip(*(ScoredTracks(side, ordered, ()).recordings for side in (before, after)), strict=True):
        every = [TrackChange(old, new, k, new.folder.name in held_out) for k in range(len(new.rmse))]
        judged = [change for change in every if change.held_out or not held_out]
        errors += [change.errors for change in judged if np.isfinite([old.rmse, new.rmse])[:, change.track].all()]
        known = [] if new.angles else [change for change in every if np.isfinite(change.moved)]
        chosen = drawn_of(new.rmse[[change.track for change in known]], False, MOST_TAGS)
        changes, total = [*changes, *(known[k]._replace(why=why) for k, why in chosen.items())], total + len(known)
    order = sorted(range(len(changes)), key=lambda k: (not changes[k].held_out, -changes[k].moved))
    return TrackChanges(tuple(changes[k] for k in sorted(order[:MOST_PLANS])), total, tuple(errors))
