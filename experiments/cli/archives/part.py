"""What is done with one recording of an archive, in a thread or in another process: tracked, or scored again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.experiments.cli.console import errors_of, ready
from trackwright.experiments.cli.options import ReadingOptions
from trackwright.experiments.cli.tracking import late_readings
from trackwright.experiments.jobs.portable_tracker import PortableTracker, spec_here
from trackwright.trackers.catalogue import fitting
from trackwright.trackers.core.errors import UnusableInput, one_line
from trackwright.trackers.core.user_file import split_name
from trackwright.trackers.evaluation.association import associate_truth, refuse_without_overlap
from trackwright.trackers.evaluation.evaluate import Evaluation, TrackScores
from trackwright.trackers.evaluation.events import EVENTS, events_of
from trackwright.trackers.evaluation.residuals import residual_ratios
from trackwright.trackers.recordings.calibration import Calibration
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.selection import Selection
from trackwright.trackers.recordings.tracks_table import TRACKS


@dataclass(frozen=True)
class Outcome:
    """What one tracker found in one recording.

    `summary`: plain values: `tracker`, `short`, its name as that of a folder, `recording`, `bearing`, `endings`, how
    many trajectories ended how, the metrics of the `recording` and of its `tracks`, and its `scores`. `tables`: by
    file name.
    """

    summary: dict[str, Any]
    evaluation: Evaluation
    tables: Mapping[str, pl.DataFrame] = field(default_factory=dict)


@dataclass(frozen=True)
class Found:
    """What was found in one recording: outcomes, a line for each refusal, and notices."""

    outcomes: list[Outcome] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)

    def in_lines(self) -> Found:
        """The same with each refusal and notice in one line that any file can hold, whatever names it quotes."""
        return replace(self, refused=[*map(one_line, self.refused)], notices=[*map(one_line, self.notices)])


def guarded(path: Path, function: Callable[..., Any], *arguments: Any) -> Any:
    """What the function returns; where it raises, a `Found` that names the recording, so that the others go on."""
    try:
        return function(*arguments)
    except UnusableInput as problem:
        return Found(refused=[_naming(path, problem)])
    except Exception as error:
        lines = str(error).splitlines() or ["no message"]
        return Found(refused=[f"{path}: cannot be used ({type(error).__name__}: {lines[0]})"])


def _naming(path: Path | None, problem: UnusableInput) -> str:
    """The refusal with the path of the recording."""
    line = str(problem)
    return line if one_line(path) in line else f"{path}: {line}"


@dataclass(frozen=True)
class Tracking:
    """How the recordings of an archive are tracked, as it travels.

    `names`: of the trackers, with the texts of the users' files; none for the one that fits each recording. `tracker`:
    the settings of each of them.
    """

    names: tuple[tuple[str, str], ...]
    tracker: PortableTracker
    seed: int
    force: bool
    used: ReadingOptions
    calibration: Calibration | None

    def __call__(self, recording: RecordingFolder) -> Found:
        """The estimates of one recording; raises UnusableInput where it has errors."""
        for name, text in self.names:
            spec_here(name, text)  # a user's file may add the kind of the recording's tables
        errors = errors_of(recording, self.force, self.calibration is not None)
        folder, lines = ready(recording, self.used, self.calibration)
        found = Found(notices=[*errors, *lines])
        for name, text in self.names or [(fitting(folder), "")]:
            try:
                outcome, lines = self._tracked(self.tracker._replace(name=name, text=text), folder)
            except UnusableInput as problem:
                found.refused.append(_naming(folder.path, problem))
                continue
            found.outcomes.append(outcome)
            found.notices.extend(lines)
        return found

    def _tracked(self, tracker: PortableTracker, folder: RecordingFolder) -> tuple[Outcome, list[str]]:
        """The outcome of one tracker, and its notices."""
        named = tracker.named(folder)
        tracks = named.run(folder, seed=self.seed)
        happened = events_of(tracks.table, named.spec, tracks.batches)
        notices = list(tracks.notices)
        truths = {folder.name: folder.tables["truth"]} if "truth" in folder.tables else {}
        association = associate_truth(tracks.table, truths)
        if association.scored.any():
            notices += late_readings(named, [folder])
        elif truths:
            try:
                refuse_without_overlap(association, truths)
            except UnusableInput as problem:
                notices.append(f"{folder.path}: not evaluated: {problem}")
        scored = TrackScores.of(association, {folder.name: folder.rig.stations})
        about = {
            "tracker": tracker.name,
            "short": split_name(tracker.name)[1] or tracker.name,
            "endings": tracks.summaries,
        }
        tables = {TRACKS: tracks.table, EVENTS: happened}
        return outcome_of(about, scored, residual_ratios(tracks), tables), notices


@dataclass(frozen=True)
class Scoring:
    """How the estimates of an archive are scored again, as it travels."""

    part: Selection
    every: float | None

    def __call__(self, source: tuple[list[tuple[dict[str, Any], pl.DataFrame]], list[str], RecordingFolder]) -> Found:
        """The metrics of one recording; `source`: each tracker's outcome and estimates, the notices, and the truth."""
        tables, notices, folder = source
        found = Found(notices=notices)
        if "truth" not in folder.tables:
            raise UnusableInput(f"{folder.path}: no truth table, expected one to evaluate against")
        truths = {folder.name: folder.tables["truth"]}
        for about, table in tables:
            try:
                association = associate_truth(self.part.of_estimates(table), truths)
                refuse_without_overlap(association, truths)
            except UnusableInput as problem:
                found.refused.append(f"{folder.path}: {about['short']}: {problem}")
                continue
            scored = TrackScores.of(association, {folder.name: folder.rig.stations}, self.every)
            found.outcomes.append(outcome_of(about, scored, {}, {}))
        return found


def outcome_of(
    about: Mapping[str, Any], scored: TrackScores, ratios: Mapping[str, float], tables: Mapping[str, pl.DataFrame]
) -> Outcome:
    """The outcome of the scored tracks of a recording; `about`: tracker, short name and endings; `ratios`: by name."""
    evaluation, ((name,), scores) = scored.evaluation(ratios), scored.recordings(ratios)
    summary = {key: about[key] for key in ("tracker", "short", "endings")} | {
        "recording": name,
        "bearing": scored.bearing,
        "metrics": evaluation.recordings[0],
        "tracks": evaluation.tracks,
        "scores": scores.condensed().plain(),
    }
    return Outcome(summary, evaluation, tables)
