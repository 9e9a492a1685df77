"""`track` on an archive: recordings one by one, finished ones kept, one table of results.

A finished recording is a run folder for each tracker, and a file beside them, written last, that says what it depends
on: options, trackers, versions, and the content of the recording.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import trackwright as tw
from trackwright.experiments.cli import tracking as runs
from trackwright.experiments.cli.console import LEFT_OUT, Run, output_folder, ready
from trackwright.experiments.cli.options import TrackOptions, config
from trackwright.experiments.jobs.environment import environment
from trackwright.experiments.jobs.executors import Threads, cluster_executor
from trackwright.experiments.jobs.portable import file_of, spec_here
from trackwright.experiments.jobs.store import Store
from trackwright.experiments.jobs.store import run as run_parts
from trackwright.experiments.pages.scored_tracks import drawn_of
from trackwright.experiments.text.tables import archive_text, terminal_width, to_json
from trackwright.experiments.text.terminal import notice
from trackwright.trackers.catalogue import fitting, spec_of
from trackwright.trackers.core.errors import has_control, one_line
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.events import EVENTS
from trackwright.trackers.evaluation.metrics import RESIDUALS, added, metrics, sums
from trackwright.trackers.evaluation.scored_run import silent
from trackwright.trackers.recordings.archives import RECORDINGS, RESULTS, content_of
from trackwright.trackers.recordings.atomic import Content, atomic_write, config_hash, held, json_text, write_whole
from trackwright.trackers.recordings.checks.all_checks import require_sound
from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig
from trackwright.trackers.recordings.tracks_table import EVALUATION, SOURCES, TRACKS, sources_text

FINISHED, ERRORS = "tracked.json", "tracked.parquet"
"""The file written last for a recording, and its errors, which the percentiles of all are taken from."""

NAMES, TEXTS = ("recording", "path", "tracker", "tracks", "endings"), ("notices", "refused")
"""The columns of the table of results before and after the metrics."""

LISTED = 20  # the most refusals that are printed; the table of results has all
Summary = dict[str, Any]
"""What one tracker found in one recording, in plain values."""


@dataclass(frozen=True)
class Result:
    """What was found in one recording: summaries, files by place below its folder, a line for each refusal, notices."""

    outcomes: list[Summary] = field(default_factory=list)
    files: dict[str, Content] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Tracking:
    """How the recordings of an archive are tracked, as it travels. `names`: of the trackers, with the texts of the
    users' files; none for the one that fits each recording. `renamed`: names of recordings."""

    names: tuple[tuple[str, str], ...]
    options: TrackOptions
    calibration: tw.Calibration | None
    renamed: Mapping[Path, str]

    @classmethod
    def of(cls, options: TrackOptions, paths: Sequence[Path]) -> Tracking:
        """The options as they travel; raises UnusableInput for unknown trackers and an unreadable calibration."""
        texts = tuple((name, file_of(name)) for name in runs.named_runs(options) if spec_of(name))
        names: dict[Path, str] = {}
        for path in paths:
            with suppress(tw.UnusableInput):
                names[path] = read_rig(path / RIG_FILE)[0].name
        counts = Counter([*names.values(), *map(str, paths)])
        renamed = {path: str(path) for path, name in names.items() if counts[name] > 1 and name != str(path)}
        for path in [*renamed][:1]:
            notice(f"notice: {len(renamed)} recordings, as {path}, are named by their paths: others have their names")
        return cls(texts, options, options.used.read_calibration(), renamed)

    def named(self, name: str, folders: tw.RecordingFolder | Sequence[tw.RecordingFolder]) -> tw.NamedTracker:
        """A tracker for recordings; raises UnusableInput as `NamedTracker.of`."""
        numbers, text = self.options.numbers, dict(self.names).get(name, "")
        return tw.NamedTracker.of(name, spec_here(name, text), folders, numbers.free_height, numbers.side)

    def read(self, path: Path) -> tw.RecordingFolder:
        """The recording by its name in the archive; raises UnusableInput."""
        folder = tw.read(path)
        return replace(folder, name=self.renamed.get(path, folder.name))

    def part(self, path: Path) -> Result:
        """What is found in the recording at `path`, which is read where this runs."""
        return self(self.read(path))

    def __call__(self, recording: tw.RecordingFolder) -> Result:
        """What is found in one recording; raises UnusableInput where it has errors."""
        for name, text in self.names:
            spec_here(name, text)  # a user's file may add the kind of the recording's tables
        lines = require_sound(recording, self.options.force, self.calibration is not None)
        folder, more = ready(recording, self.options.used, self.calibration)
        result = Result(notices=[*map(one_line, (*lines, *more))])
        for name in [name for name, _ in self.names] or [fitting(folder)]:
            try:
                found, fits = runs.tracked(self.named(name, folder), [folder], self.options, silent)
            except tw.UnusableInput as problem:
                result.refused.append(_naming(folder.path, problem))
                continue
            evaluation, rows, own = found.evaluation, found.rows, runs.short(name)
            (of_recording,) = evaluation.recordings
            summary = {"tracker": name, "short": own, "endings": found.tracks.summaries, "recording": folder.name}
            totals = sums(rows).row(0, named=True) | {ratio: of_recording[ratio] for ratio in RESIDUALS}
            parts = {"metrics": of_recording, "tracks": evaluation.tracks, "sums": totals}
            result.outcomes.append(summary | {"bearing": evaluation.bearing} | parts)
            errors = rows.filter(pl.col("why").is_null()).select("^(size_.*|nees|nees_3d)$")
            result.files.update(
                {f"{own}/{file}": x for file, x in (runs.files_of(found, evaluation) | {ERRORS: errors}).items()}
            )
            result.notices.extend(map(one_line, (*fits, *found.notices)))
        return result


@dataclass(frozen=True)
class Finished(Store[Path, Result, Result]):
    """The finished recordings in the output folder of an archive."""

    out: Path
    tracking: Tracking

    @cached_property
    def _settings(self) -> dict[str, Any]:
        """All that the outcome of a recording depends on, beside its content."""
        options, calibration = self.tracking.options, self.tracking.options.used.calibration
        return config(options, "tracker", "noise", "cluster", "keep_going") | {
            "trackers": self.tracking.names,
            "noise": None if options.tuned is None else options.tuned.values,
            "calibration": None if calibration is None else calibration.read_text("utf-8"),
            "versions": {name: value for name, value in environment().items() if name != "programs kept"},
        }

    def folder(self, path: Path) -> Path:
        """The folder of the recording at `path`: its name, and a digest of the path."""
        whole = path.resolve()
        digest = hashlib.sha256(os.fsencode(whole)).hexdigest()[:8]
        plain = re.sub(r"[^\w.-]", "_", whole.name, flags=re.ASCII)[:80]
        return self.out / RECORDINGS / f"{plain}-{digest}"

    def _digest(self, path: Path) -> str:
        return config_hash({"content": content_of(path) + self.tracking.renamed.get(path, ""), **self._settings})

    def read(self, item: Path) -> Result:
        """As `Store`."""
        kept = json.loads((self.folder(item) / FINISHED).read_bytes())
        if kept.pop("digest") != self._digest(item):
            raise LookupError("of other inputs")
        for summary in kept["outcomes"]:
            for table in (TRACKS, EVENTS, ERRORS):
                pl.read_parquet_schema(self.folder(item) / summary["short"] / table)
        return Result(**kept)

    def files(self, item: Path, result: Result) -> dict[Path, Content]:
        """As `Store`; a recording in which nothing was found is tried again by the next run."""
        if not result.outcomes:
            return {}
        kept = {name: getattr(result, name) for name in ("outcomes", "refused", "notices")}
        files = result.files | {FINISHED: json_text({"digest": self._digest(item)} | kept)}
        return {self.folder(item) / name: rows for name, rows in files.items()}


def _refusal(path: Path, error: Exception) -> Result:
    """What stands for a recording that could not be used: a line that names it, so that the others go on."""
    if isinstance(error, tw.UnusableInput):
        return Result(refused=[_naming(path, error)])
    why = f"cannot be used ({type(error).__name__}: {one_line(error) or 'no message'})"
    if type(error).__name__ == "KilledWorker":
        why = "its workers ended while they computed it; expected enough memory for one recording a worker"
    return Result(refused=[f"{path}: {why}"])


def _naming(path: Path | None, problem: tw.UnusableInput) -> str:
    """The refusal with the path of the recording."""
    return str(problem) if one_line(path) in str(problem) else f"{path}: {problem}"


def track_archive(paths: Sequence[Path], options: TrackOptions, run: Run) -> int:
    """Tracks the recordings that are not finished, and writes the tables of all; returns the exit code."""
    tracking, found = Tracking.of(options, paths), dict[Path, Result]()
    store = Finished(output_folder(options.out), tracking)
    advance = run.begin("tracking", len(paths))

    def each(path: Path, result: Result) -> None:
        found[path] = result
        advance(1)

    with held(options.out):
        with cluster_executor(options.cluster) if options.cluster else Threads() as executor:
            # A cluster's workers need not see the recordings, which are read here.
            part, read = (tracking, tracking.read) if options.cluster else (tracking.part, None)
            run_parts(paths, part, store, executor, each, read, _refusal)
        refused = [found[path].refused for path in paths if found[path].refused]
        lines = [line for of_recording in refused for line in of_recording]
        if not any(result.outcomes for result in found.values()):
            _list_refused(lines[1:], "")
            raise tw.UnusableInput(lines[0])
        run.begin("tables")
        results = options.out / RESULTS
        atomic_write(results, _results([(path, found[path]) for path in paths]).write_csv)
        by_tracker: dict[str, list[tuple[Path, Summary]]] = {}
        for path in paths:
            for summary in found[path].outcomes:
                by_tracker.setdefault(summary["short"], []).append((path, summary))
        for name, of in by_tracker.items():
            out = options.out if len(by_tracker) == 1 else output_folder(options.out / name)
            _write_run(name, sorted(of, key=lambda one: str(one[1]["recording"])), out, store, run)
    print(f"wrote {results}, a row for each recording and tracker")
    if noticed := sum(bool(result.notices and result.outcomes) for result in found.values()):
        notice(f"notice: {counted(noticed, 'recording')} with notices: column 'notices' of {results}")
    if refused:
        notice(f"not tracked: {len(refused)} of {counted(len(paths), 'recording')}")
    _list_refused(lines, f": column 'refused' of {results}")
    return LEFT_OUT if refused else 0


def _results(found: Sequence[tuple[Path, Result]]) -> pl.DataFrame:
    """The table of results."""
    rows: list[dict[str, Any]] = [dict.fromkeys((*NAMES, *TEXTS))]
    for path, result in found:
        # A name that no line can hold is shown; no command looks for it.
        whole = str(path.resolve()) if not has_control(str(path.resolve())) else one_line(path.resolve())
        for summary in result.outcomes:
            endings = summary["endings"]
            tracks = {"tracks": sum(endings.values()), "endings": "; ".join(f"{k} {n}" for k, n in endings.items())}
            names = {"path": whole, "tracker": summary["short"], "notices": "; ".join(result.notices)}
            rows.append(names | tracks | summary["metrics"])
        rows += [{"path": whole, "refused": line} for line in result.refused]
    table = pl.DataFrame(rows, infer_schema_length=None)[1:]
    return table.select(*NAMES, pl.exclude(*NAMES, *TEXTS), *TEXTS)


def _write_run(name: str, of: Sequence[tuple[Path, Summary]], out: Path, store: Finished, run: Run) -> None:
    """Writes the tables of a tracker over all recordings, and prints its metrics."""
    options, summaries = store.tracking.options, [summary for _, summary in of]

    def rows(table: str) -> pl.LazyFrame:
        """The tables of all recordings as one, which is not in memory."""
        files, schema = [store.folder(path) / name / table for path, _ in of], dict[str, Any]()
        for file in files:
            schema |= pl.read_parquet_schema(file)
        return pl.scan_parquet(files, schema=pl.Schema(schema), missing_columns="insert")

    whole = added(pl.DataFrame([x["sums"] for x in summaries], infer_schema_length=None), rows(ERRORS))
    levels = [x["metrics"] for x in summaries], [track for x in summaries for track in x["tracks"]]
    filled = [pl.DataFrame(level, infer_schema_length=None).to_dicts() for level in levels]
    evaluation = tw.Evaluation(summaries[0]["bearing"], metrics(whole).row(0, named=True), *filled)
    write_whole(out / EVALUATION, to_json(evaluation))
    write_whole(out / SOURCES, sources_text(path for path, _ in of))
    for table in (TRACKS, EVENTS):
        atomic_write(out / table, partial(rows(table).sink_parquet, compression_level=1))
    endings = sum((Counter(x["endings"]) for x in summaries), Counter[str]())
    print(f"{name}: {counted(endings.total(), 'track')} of {counted(len(of), 'recording')}: {runs.words_of(endings)}")
    rows_written = pl.scan_parquet(out / TRACKS).select(pl.len()).collect().item()
    about, tracker = {"recordings": len(of), "verdicts": endings}, summaries[0]["tracker"]
    text, show = (
        partial(archive_text, evaluation, terminal_width()),
        partial(_show, of, evaluation, out, store.tracking, run),
    )
    runs.end_run(tracker, evaluation, text, show, rows_written, about, options, out, run)


def _show(
    of: Sequence[tuple[Path, Summary]], evaluation: tw.Evaluation, out: Path, tracking: Tracking, run: Run
) -> list[str]:
    """Writes the page and the figures of a few recordings, tracked again; in words, what was written."""
    if tracking.options.figures == "none":
        return []
    rmse = [metrics["rmse_direction_rad" if evaluation.bearing else "rmse_m"] for metrics in evaluation.recordings]
    chosen = [of[k][0] for k in drawn_of(np.array(rmse, float))]
    folders = [ready(tracking.read(path), tracking.options.used, tracking.calibration)[0] for path in chosen]
    named = tracking.named(of[0][1]["tracker"], folders)
    found, _ = runs.tracked(named, folders, tracking.options, run.begin)
    statements = {"statements": evaluation.statements} if evaluation.overall["n"] else {}
    page = runs.page_of(found, found.evaluation, 1) | {"recordingCount": len(of)} | statements
    return runs.write_shown(runs.scored(found), [page], tracking.options, out, run)


def _list_refused(lines: Sequence[str], where: str) -> None:
    """A line for each refusal, up to some; `where`: the place of all."""
    for line in lines[:LISTED]:
        notice(f"not tracked: {line}")
    if len(lines) > LISTED:
        notice(f"not tracked: {len(lines) - LISTED} more{where}")
