"""Recordings before and after a fit: errors and consistency as `evaluate` has them, the verdict, tracks."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.pages.scored_tracks import ScoredRecording, ScoredTracks, drawn_of, root_mean_square
from trackwright.experiments.text.tables import Section, sections_text
from trackwright.experiments.text.wording import SHOWN, fixed, length_unit
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.comparison import Difference, paired_means
from trackwright.trackers.evaluation.evaluate import Evaluation, with_truth
from trackwright.trackers.evaluation.statements import covariance_statements
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker

MOST_PLANS, MOST_TAGS = 8, 3
"""The most floor plans of a report, and the most tags of a recording that have one."""

Pair = tuple[float | None, float | None]


class Verdict(NamedTuple):
    """Whether left-out recordings got better.

    `change`: of the mean log density of the true position, nats, all recordings with the same weight; None where it
    cannot be judged, for the reason `why_not`. `recordings`: the same of each.
    """

    change: Difference | None
    recordings: Mapping[str, Difference]
    why_not: str = ""

    @property
    def word(self) -> str:
        """The verdict in a word or two."""
        if self.change is None:
            return "not judged"
        return "better" if self.change.low > 0 else "worse" if self.change.high < 0 else "not told apart"

    def sentence(self, about: str) -> str:
        """What the verdict is by; `about`: in words, the recordings."""
        if self.change is None:
            return f"{self.why_not[0].upper()}{self.why_not[1:]}."
        return f"Mean log density of the true position, {about}: {_changed(self.change)}."

    @property
    def got_worse(self) -> list[str]:
        """A sentence for each recording that got worse."""
        worse = {name: d for name, d in self.recordings.items() if d.value < 0 and not d.high >= 0}
        return [f"{name} got worse, {_changed(difference)}." for name, difference in worse.items()]


def _changed(change: Difference) -> str:
    interval = f"95 % interval {change.low:+.2f} to {change.high:+.2f}"
    if not np.isfinite(change.low):
        interval = f"no interval: too short, {counted(change.pieces, 'piece')} of time longer than errors last"
    return f"{change.first:.2f} → {change.second:.2f} nats, {change.value:+.2f} ({interval})"


def _content(change: Difference | None) -> dict[str, Any]:
    if change is None:
        return {}
    named = {"before": change.first, "after": change.second, "low_95": change.low, "high_95": change.high}
    return {"log_density": {name: float(f"{value:.6g}") for name, value in named.items()}}


def judge(sides: Sequence[pl.DataFrame], dimensions: int) -> Verdict:
    """The verdict on the estimates of left-out recordings before and after, of the same rows."""
    densities = [float_column(side, "density_3d" if dimensions == 3 else "density") for side in sides]
    known = np.isfinite(densities).all(axis=0)
    if not known.any():
        return Verdict(None, {}, "no estimate has both a covariance and a truth")
    names = sides[0]["recording"].to_numpy()[known]
    given = float_column(sides[0], "t_s")[known], *(x[known] for x in densities), names
    return Verdict(
        paired_means(*given), {str(x): paired_means(*(of[names == x] for of in given)) for x in np.unique(names)}
    )


class Compared(NamedTuple):
    """Recordings before and after tuning: their table, sentences on the covariances after it, and the verdict.

    `about`: in words, the recordings. `metrics`: of each recording by name, before and after.
    """

    about: str
    section: Section
    verdict: Verdict
    metrics: Mapping[str, Mapping[str, Pair]] = {}

    def text(self) -> str:
        """The table, the sentences and the verdict for a terminal."""
        verdict = f"Verdict: {self.verdict.word}. {self.verdict.sentence(self.about)}"
        return sections_text([self.section], 120, *self.section.parts, verdict, *self.verdict.got_worse)

    def content(self) -> dict[str, Any]:
        """The verdict and the table as tuned.toml holds them, nan for what is unknown."""
        verdict = self.verdict
        recordings = {
            name: {key: [math.nan if x is None else float(f"{x:.6g}") for x in pair] for key, pair in metrics.items()}
            | _content(verdict.recordings.get(name))
            for name, metrics in self.metrics.items()
        }
        head = {"verdict": verdict.word, "judged_by": self.about}
        return head | _content(verdict.change) | {"recordings": recordings}


def tracked(tracker: NamedTracker, folders: Sequence[RecordingFolder]) -> pl.DataFrame:
    """The estimates of the recordings, tracked as `track` does it, with their truth."""
    return with_truth(tracker.run(folders).table, folders)


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
    unit = SHOWN["rad"] if before.bearing else length_unit(before.overall[error] or 1.0)
    columns = {
        f"{'3-D ' if suffix else ''}RMSE, {unit.name}": (error, unit.factor, 3 if unit.name == "m" else 1),
        f"% in 95 % {'ellipsoid' if suffix else 'ellipse'}": (f"coverage_95{suffix}", 100.0, 0),
        "NEES/dof": (f"nees{suffix}_ratio", 1.0, 2),
        "regret": (f"regret{suffix}", 1.0, 2),
        "NIS/dof": ("nis_ratio", 1.0, 2),
    }
    pairs = [*zip(before.recordings, after.recordings, strict=True)]
    verdict = Verdict(None, {}, why_not) if why_not else judge(sides, 3 if suffix else 2)
    shown = [(old["recording"], old, new, verdict.recordings.get(old["recording"])) for old, new in pairs]
    if len(pairs) > 1:
        # Each with the same weight; none where a recording has no value.
        means = pl.col([key for key, _, _ in columns.values()]).cast(pl.Float64).fill_null(np.nan).mean()
        sides_of = (pl.DataFrame(of, infer_schema_length=None) for of in (before.recordings, after.recordings))
        old, new = (table.select(means).row(0, named=True) for table in sides_of)
        shown.append((f"mean of {len(pairs)}", old, new, verdict.change))
    rows = []
    for name, old, new, change in shown:
        cells = [
            " → ".join(fixed(None if side[key] is None else factor * side[key], digits) for side in (old, new))
            for key, factor, digits in columns.values()
        ]
        density = ["– → –", "–"]
        if change is not None:
            half = f"{change.high - change.value:.2f}" if np.isfinite(change.low) else "?"
            density = [f"{change.first:.2f} → {change.second:.2f}", f"{change.value:+.2f} ± {half}"]
        rows.append([name, *cells, *density])
    head = ("recording", *columns, "log density, nats", "difference, 95 %")
    note = "Tracked as by `track`. Regret: nats of the log density that the scale of the covariances loses."
    title, looks = f"{about[0].upper()}{about[1:]}, before → after", dict.fromkeys(head[1:], "after")
    section = Section(title, head, rows, 1, note, looks, covariance_statements(after.overall, after.recordings))
    keys = [key for key, _, _ in columns.values()]
    metrics = {old["recording"]: {key: (old[key], new[key]) for key in keys} for old, new in pairs}
    return Compared(about, section, verdict, metrics)


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
    def errors(self) -> ErrorTrack:
        """The errors over time, with the names of recording, tag and, of bearings, station."""
        rows, factor = self.after.rows_of(self.track), 180 / np.pi if self.after.angles else 1.0
        first, times = self.after.first.row(self.track, named=True), self.after.times - self.after.times.min()
        name = f"{self.after.folder.name}, tag {first['tag']}" + f", station {first.get('station')}" * self.after.angles
        return ErrorTrack(name, times[rows], factor * self.before.miss[rows], factor * self.after.miss[rows])

    @property
    def rmse(self) -> np.ndarray:
        """The RMSE before and after (2,), m or rad."""
        return np.array([side.rmse[self.track] for side in (self.before, self.after)])

    @property
    def moved(self) -> float:
        """The root mean square distance, m, of the estimates after from those before; NaN without both of a moment."""
        rows = self.after.rows_of(self.track)
        before, after = (side.columns("x_m", "y_m")[rows] for side in (self.before, self.after))
        return root_mean_square(np.linalg.norm(after - before, axis=1))


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
        errors += [c.errors for c in every if (c.held_out or not held_out) and np.isfinite(c.rmse).all()]
        known = [] if new.angles else [change for change in every if np.isfinite(change.moved)]
        chosen = drawn_of(np.array([change.rmse[1] for change in known]), False, MOST_TAGS)
        changes, total = [*changes, *(known[k]._replace(why=why) for k, why in chosen.items())], total + len(known)
    order = sorted(range(len(changes)), key=lambda k: (not changes[k].held_out, -changes[k].moved))
    return TrackChanges(tuple(changes[k] for k in sorted(order[:MOST_PLANS])), total, tuple(errors))
