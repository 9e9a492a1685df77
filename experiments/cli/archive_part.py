"""One recording of an archive: tracked, or scored again, in a thread or in another process, and what is kept of it.

A finished recording is a folder in the output, whose last file says what it depends on: options, trackers, versions,
and the content of the recording.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from trackwright.experiments.cli.archive_folders import RECORDINGS, is_table
from trackwright.experiments.cli.console import errors_of, ready
from trackwright.experiments.cli.options import TrackOptions
from trackwright.experiments.cli.tracking import with_truth
from trackwright.experiments.jobs.environment import environment
from trackwright.experiments.jobs.portable import spec_here
from trackwright.experiments.jobs.run import Store, written
from trackwright.experiments.text.evaluation_text import to_json
from trackwright.trackers.catalogue import fitting
from trackwright.trackers.core.errors import UnusableInput, one_line
from trackwright.trackers.core.user_file import split_name
from trackwright.trackers.evaluation.evaluate import Evaluation, Ratios
from trackwright.trackers.evaluation.events import EVENTS, events_of
from trackwright.trackers.evaluation.metrics import RESIDUALS, sums
from trackwright.trackers.evaluation.residuals import residual_ratios
from trackwright.trackers.evaluation.rows import refuse_without_overlap, scored_rows
from trackwright.trackers.recordings.atomic import json_text
from trackwright.trackers.recordings.calibration import Calibration
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, read_truth
from trackwright.trackers.recordings.input_file import file_bytes
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.rig_file import RIG_FILE
from trackwright.trackers.recordings.selection import Selection
from trackwright.trackers.recordings.tracks_table import EVALUATION, SOURCES, TRACKS, read_tracks, write_tracks

TRACKED, SCORED = "tracked.json", "scored.json"
"""The files that `track` and `evaluate` write last into the folder of a finished recording."""

ERRORS = {TRACKED: "tracked.parquet", SCORED: "scored.parquet"}
"""Beside them the table of errors from which the percentiles of all recordings are taken."""


@dataclass(frozen=True)
class Outcome:
    """What one tracker found in one recording: `summary` in plain values, as `outcome_of` makes it, and `tables` by
    file name."""

    summary: dict[str, Any]
    evaluation: Evaluation
    tables: Mapping[str, pl.DataFrame] = field(default_factory=dict)


@dataclass(frozen=True)
class RecordingResult:
    """What was found in one recording: outcomes, a line for each refusal, and notices."""

    outcomes: list[Outcome] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)


class Item(NamedTuple):
    """A recording of an archive: its path, its folder in the output, and what its outcome depends on, if known."""

    path: Path
    folder: Path
    fingerprint: str | None


@dataclass(frozen=True)
class RecordingStore(Store[Item, RecordingResult, dict[str, Any]]):
    """The finished recordings in the output folder of an archive; `name`: of the file that is written last."""

    out: Path
    name: str

    def folder(self, path: Path) -> Path:
        """The folder of the recording at `path`: its name, and a digest of the path."""
        whole = path.resolve()
        digest = hashlib.sha256(os.fsencode(whole)).hexdigest()[:8]
        plain = re.sub(r"[^\w.-]", "_", whole.name, flags=re.ASCII)[:80]
        return self.out / RECORDINGS / f"{plain}-{digest}"

    def read(self, folder: Path) -> dict[str, Any]:
        """What is kept of the recording with this folder."""
        kept: dict[str, Any] = json.loads(file_bytes(folder / self.name))
        return kept

    def kept(self, item: Item) -> dict[str, Any] | None:
        """What is kept of a finished recording; None where it is not finished, of other content, or damaged."""
        try:
            kept = self.read(item.folder)
            if item.fingerprint is None or kept["fingerprint"] != item.fingerprint:
                return None
            whole = all((item.folder / name).stat().st_size == size for name, size in kept["bytes"].items())
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
            return None
        return kept if whole else None

    def keep(self, item: Item, result: RecordingResult) -> dict[str, Any]:
        """Keeps what was found of a recording; one of which nothing was found is tried again by the next run."""
        about = {
            "fingerprint": item.fingerprint,
            "outcomes": [outcome.summary for outcome in result.outcomes],
            # In one line that any file can hold, whatever names it quotes.
            "refused": [*map(one_line, result.refused)],
            "notices": [*map(one_line, result.notices)],
        }
        tables, files = dict[str, Path](), dict[str, Callable[[Path], object]]()
        for outcome in result.outcomes:
            short = outcome.summary["short"]
            for name, table in outcome.tables.items():
                tables[f"{short}/{name}"] = item.folder / short / name
                files[f"{short}/{name}"] = partial(write_tracks, table)
            files[f"{short}/{SOURCES}"] = partial(_write_text, f"{item.path.resolve()}\n")
            files[f"{short}/{EVALUATION}"] = partial(_write_text, to_json(outcome.evaluation))

        def write_about(path: Path) -> None:
            sizes = {name: table.stat().st_size for name, table in tables.items()}
            _write_text(json_text(about | {"bytes": sizes}), path)

        if result.outcomes:
            written(item.folder, files | {self.name: write_about})
        return about


def _write_text(text: str, path: Path) -> None:
    path.write_text(text, encoding="utf-8")


def content_of(path: Path) -> str:
    """A digest of the rig.toml and the tables of a recording, and of the names beside them; raises OSError."""
    digest = hashlib.sha256()
    for entry in sorted(path.iterdir()):
        digest.update(os.fsencode(entry.name) + b"\0")
        if entry.is_file() and (entry.name == RIG_FILE or is_table(entry.name)):
            digest.update(digest_of(entry))
    return digest.hexdigest()


def digest_of(path: Path) -> bytes:
    """The SHA-256 of a file; raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


def _versions() -> dict[str, Any]:
    """What bits depend on beside options and content."""
    return {name: value for name, value in environment().items() if name != "programs kept"}


def refusal(item: Item, error: Exception) -> RecordingResult:
    """What stands for a recording that could not be used: a line that names it, so that the others go on."""
    if isinstance(error, UnusableInput):
        return RecordingResult(refused=[_naming(item.path, error)])
    if type(error).__name__ == "KilledWorker":
        fix = "expected enough memory for one recording a worker; see the workers' logs"
        return RecordingResult(refused=[f"{item.path}: its workers ended while they computed it; {fix}"])
    lines = str(error).splitlines() or ["no message"]
    return RecordingResult(refused=[f"{item.path}: cannot be used ({type(error).__name__}: {lines[0]})"])


def _naming(path: Path | None, problem: UnusableInput) -> str:
    """The refusal with the path of the recording."""
    line = str(problem)
    return line if one_line(path) in line else f"{path}: {line}"


@dataclass(frozen=True)
class Tracking:
    """How the recordings of an archive are tracked, as it travels. `names`: of the trackers, with the texts of the
    users' files; none for the one that fits each recording. `renamed`: names of recordings."""

    names: tuple[tuple[str, str], ...]
    options: TrackOptions
    calibration: Calibration | None
    renamed: Mapping[Path, str]

    def settings(self) -> dict[str, Any]:
        """All that the outcome of a recording depends on, beside its content."""
        options, calibration = self.options, self.options.used.calibration
        return options.config("tracker", "noise", "cluster", "keep_going") | {
            "trackers": self.names,
            "noise": None if options.tuned is None else options.tuned.values,
            "calibration": None if calibration is None else calibration.read_text("utf-8"),
            "versions": _versions(),
        }

    def content(self, path: Path) -> str:
        """A digest of the content of a recording; raises OSError."""
        return content_of(path) + self.renamed.get(path, "")

    def read(self, item: Item) -> RecordingFolder:
        """What is tracked; raises UnusableInput as `read_recording`."""
        folder = read_recording(item.path)
        return replace(folder, name=self.renamed.get(item.path, folder.name))

    def __call__(self, recording: RecordingFolder) -> RecordingResult:
        """The estimates of one recording; raises UnusableInput where it has errors."""
        for name, text in self.names:
            spec_here(name, text)  # a user's file may add the kind of the recording's tables
        errors = errors_of(recording, self.options.force, self.calibration is not None)
        folder, lines = ready(recording, self.options.used, self.calibration)
        result = RecordingResult(notices=[*errors, *lines])
        for name, text in self.names or [(fitting(folder), "")]:
            try:
                outcome, lines = self._tracked(name, text, folder)
            except UnusableInput as problem:
                result.refused.append(_naming(folder.path, problem))
                continue
            result.outcomes.append(outcome)
            result.notices.extend(lines)
        return result

    def named(self, name: str, text: str, folder: RecordingFolder) -> NamedTracker:
        """A tracker for one recording; raises UnusableInput as `NamedTracker.of`."""
        return NamedTracker.of(name, spec_here(name, text), folder, self.options.free_height, self.options.side)

    def _tracked(self, name: str, text: str, folder: RecordingFolder) -> tuple[Outcome, list[str]]:
        """The outcome of one tracker, and its notices."""
        ((named, _),), fits = self.options.applied(self.named(name, text, folder), [folder], lambda done: None)
        tracks = named.run(folder, seed=self.options.seed)
        happened = events_of(tracks.table, named.spec, tracks.batches)
        rows, lines = with_truth(tracks.table, named, [folder])
        about = {"tracker": name, "short": split_name(name)[1] or name, "endings": tracks.summaries}
        tables = {TRACKS: tracks.table, EVENTS: happened}
        return outcome_of(about, rows, residual_ratios(tracks), tables, TRACKED), [
            *fits,
            *tracks.notices,
            *lines,
        ]


Estimated = tuple[list[tuple[dict[str, Any], pl.DataFrame]], list[str], RecordingFolder]
"""A tracked recording: what is kept of each tracker's outcome, with its estimates; the notices, and the truth."""


@dataclass(frozen=True)
class Scoring:
    """How the estimates of an archive, of those `tracked`, are scored again, as it travels."""

    part: Selection
    tracked: RecordingStore

    def settings(self) -> dict[str, Any]:
        """As of `Tracking`."""
        return {"part": asdict(self.part), "versions": _versions()}

    def content(self, path: Path) -> str:
        """A digest of a recording and of what is kept of its tracks; raises OSError."""
        return content_of(path) + digest_of(self.tracked.folder(path) / TRACKED).hex()

    def read(self, item: Item) -> Estimated:
        """What is scored; raises UnusableInput as `read_tracks` and `read_truth`."""
        kept = self.tracked.read(item.folder)
        outcomes = [(outcome, read_tracks(item.folder / outcome["short"])) for outcome in kept["outcomes"]]
        return outcomes, kept["notices"], replace(read_truth(item.path), name=kept["outcomes"][0]["recording"])

    def __call__(self, estimated: Estimated) -> RecordingResult:
        """The metrics of one recording; raises UnusableInput without truth."""
        outcomes, notices, folder = estimated
        result = RecordingResult(notices=notices)
        if "truth" not in folder.tables:
            raise UnusableInput(f"{folder.path}: no truth table, expected one to evaluate against")
        truths = {folder.name: folder.tables["truth"]}
        for about, table in outcomes:
            try:
                rows = scored_rows(self.part.of_estimates(table), truths, {folder.name: folder.rig.stations})
                refuse_without_overlap(rows, truths)
            except UnusableInput as problem:
                result.refused.append(f"{folder.path}: {about['short']}: {problem}")
                continue
            result.outcomes.append(outcome_of(about, rows, {}, {}, SCORED))
        return result


def outcome_of(
    about: Mapping[str, Any], rows: pl.DataFrame, ratios: Ratios, tables: Mapping[str, pl.DataFrame], last: str
) -> Outcome:
    """The outcome of the scored rows of a recording; `about`: tracker, short name, endings; `last`: as in `ERRORS`."""
    evaluation = Evaluation.of(rows, ratios)
    (recording,) = evaluation.recordings
    summary = {key: about[key] for key in ("tracker", "short", "endings")} | {
        "recording": recording["recording"],
        "bearing": evaluation.bearing,
        "metrics": recording,
        "tracks": evaluation.tracks,
        "sums": sums(rows).row(0, named=True) | {name: recording[name] for name in RESIDUALS},
    }
    sizes = rows.filter(pl.col("why").is_null()).select("^(size_.*|nees|nees_3d)$")
    return Outcome(summary, evaluation, {**tables, ERRORS[last]: sizes})
