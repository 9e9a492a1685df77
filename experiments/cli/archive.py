"""`track` and `evaluate` on an archive: recordings one by one, finished ones kept, one table of results."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.cli.archive_folders import RESULTS
from trackwright.experiments.cli.archive_part import (
    ERRORS,
    SCORED,
    TRACKED,
    Item,
    RecordingResult,
    RecordingStore,
    Scoring,
    Tracking,
    refusal,
)
from trackwright.experiments.cli.archive_tables import Refusals, Run, compared, gathered, read_results, write_results
from trackwright.experiments.cli.console import json_alone, output_folder, ready
from trackwright.experiments.cli.evaluating import COMPARISON, code_of, condition_of
from trackwright.experiments.cli.options import EvaluateOptions, TrackOptions
from trackwright.experiments.cli.runtime import LEFT_OUT, write_manifest
from trackwright.experiments.cli.tracking import endings, notice_levels, tracker_names, write_shown
from trackwright.experiments.jobs.executors import Threads, cluster_executor
from trackwright.experiments.jobs.portable import file_of
from trackwright.experiments.jobs.run import run as run_parts
from trackwright.experiments.pages.reports.comparison import WIDTH, write_comparison
from trackwright.experiments.pages.reports.track import run_data
from trackwright.experiments.pages.scored_tracks import ScoredTracks, drawn_of
from trackwright.experiments.text.evaluation_text import archive_text, content
from trackwright.experiments.text.tables import Section, sections_text, terminal_width
from trackwright.experiments.text.terminal import Begin, notice, stages
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.run.chunks import CHUNK
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.evaluate import Evaluation, metric_names, truths_of
from trackwright.trackers.evaluation.events import EVENTS
from trackwright.trackers.evaluation.rows import is_scored, scored_rows
from trackwright.trackers.recordings.atomic import config_hash, held
from trackwright.trackers.recordings.folder import read_recording
from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig
from trackwright.trackers.recordings.tracks_table import EVALUATION, TRACKS, read_tracks

LISTED = 20  # the most refusals that are printed; the table of results has all


def track_archive(
    paths: Sequence[Path], options: TrackOptions, started: datetime, begin: Begin,
    put: Callable[[Mapping[str, Any]], None],
) -> int:  # fmt: skip
    """Tracks the recordings that are not finished, and writes the tables of all; returns the exit code."""
    tracking = _tracking(options, paths)
    store = RecordingStore(output_folder(options.out), TRACKED)
    with held(options.out):
        done, refused = _run("tracked", store, paths, tracking, options.cluster, begin("tracking", len(paths)))
        begin("tables")
        runs, rows, noticed = gathered(store, paths, done, refused)
        # Before anything is printed: the reader of a pipe may close it.
        write_results(options.out, rows)
        for run in runs:
            out = output_folder(options.out if len(runs) == 1 else options.out / run.short)
            evaluation, count = run.write(out, ERRORS[TRACKED]), run.write_table(out, TRACKS)
            run.write_table(out, EVENTS)
            run.write_sources(out)
            tracks = counted(sum(run.endings.values()), "track")
            print(f"{run.short}: {tracks} of {counted(len(run.paths), 'recording')}: {endings(run.endings)}")
            put(_shown(run, evaluation))
            notice_levels(evaluation.overall, options.fit)
            shown = [] if options.figures == "none" else _show(run, evaluation, tracking, options, out, begin)
            extra = {"recordings": len(run.paths), "verdicts": run.endings}
            write_manifest(out, sys.argv, options.manifest(run.tracker), started, chunk=CHUNK, extra=extra)
            written = f"{out / TRACKS} ({counted(count, 'estimate')})"
            print(f"wrote {', '.join([written, EVENTS, EVALUATION, *shown, 'manifest.json'])}")
        tables = _compare(runs)
        if tables and options.figures != "none":
            page = write_comparison(options.out / COMPARISON, [run.short for run in runs], tables, [], sys.argv)
            print(f"wrote {page}")
        return _ended("tracked", options.out, noticed, [refused[path] for path in paths if path in refused], len(paths))


def _tracking(options: TrackOptions, paths: Sequence[Path]) -> Tracking:
    """How each recording is tracked; raises UnusableInput for unknown trackers and an unreadable calibration."""
    of_file = None if options.tuned is None else options.tuned.tracker
    names = tracker_names(options.tracker or of_file, options.noise)
    texts = tuple((name, file_of(name)) for name in names if spec_of(name))
    return Tracking(texts, options, options.used.read_calibration(), _renamed(paths))


def _renamed(paths: Sequence[Path]) -> dict[Path, str]:
    """The path as the name of each recording that has another's name; raises nothing for an unreadable rig."""
    names: dict[Path, str] = {}
    for path in paths:
        with suppress(UnusableInput):
            names[path] = read_rig(path / RIG_FILE)[0].name
    counts = Counter([*names.values(), *map(str, paths)])
    renamed = {path: str(path) for path, name in names.items() if counts[name] > 1 and name != str(path)}
    for path in [*renamed][:1]:
        notice(f"notice: {len(renamed)} recordings, as {path}, are named by their paths: others have their names")
    return renamed


def _run(
    verb: str, store: RecordingStore, paths: Sequence[Path], part: Tracking | Scoring, cluster: str | None,
    advance: Callable[[int], None],
) -> tuple[set[Path], Refusals]:  # fmt: skip
    """Runs the part of each recording that is not stored; the finished recordings, and a line for each refusal."""
    done: set[Path] = set()
    refused: Refusals = {}
    settings = part.settings()

    def items() -> Iterator[Item]:
        for path in paths:
            try:
                fingerprint = config_hash({"content": part.content(path), **settings})
            except OSError:
                fingerprint = None
            yield Item(path, store.folder(path), fingerprint)

    def each(item: Item, kept: Mapping[str, Any]) -> None:
        if kept["outcomes"]:
            done.add(item.path)
        if kept["refused"]:
            refused[item.path] = kept["refused"]
        advance(1)

    def whole(item: Item) -> RecordingResult:
        source: Any = part.read(item)
        return part(source)

    with cluster_executor(cluster) if cluster else Threads() as executor:
        # For workers it is read here, since they need not see the files.
        function, read = (part, part.read) if cluster else (whole, None)
        run_parts(items(), function, store, executor, each, read, refusal)
    if not done:
        first, *others = [refused[path] for path in paths]
        _list_refused(verb, others)
        raise UnusableInput(first[0])
    return done, refused


def _compare(runs: Sequence[Run]) -> list[Section]:
    """Prints the comparison of several trackers; its tables."""
    if tables := compared(runs):
        print(sections_text(tables, WIDTH), end="")
    return tables


def _shown(run: Run, evaluation: Evaluation) -> dict[str, Any]:
    """Prints the table of a tracker; its metrics by its name, as JSON holds them."""
    if evaluation.overall["n"]:
        print(archive_text(evaluation, terminal_width()), end="")
    else:
        print(*(f"Without truth: {sentence}" for sentence in evaluation.statements), sep="\n")
    return {run.short: content(evaluation)}


def _show(
    run: Run, evaluation: Evaluation, tracking: Tracking, options: TrackOptions, out: Path, begin: Begin
) -> list[str]:
    """Writes the page and the figures of a few recordings; returns in words what was written."""
    rmse = [metrics["rmse_direction_rad" if evaluation.bearing else "rmse_m"] for metrics in evaluation.recordings]
    chosen = [evaluation.recordings[k] for k in drawn_of(np.array(rmse, float), evaluation.bearing)]
    names = [metrics["recording"] for metrics in chosen]
    folders, batches, tables, events = [], [], [], []
    texts = dict(tracking.names)
    for name in names:
        folder, _ = ready(replace(read_recording(run.paths[name]), name=name), options.used, tracking.calibration)
        batches += options.valued(tracking.named(run.tracker, texts.get(run.tracker, ""), folder)).batches(folder)
        folders.append(folder)
        tables.append(read_tracks(run.folders[name]))
        events.append(pl.read_parquet(run.folders[name] / EVENTS))
    stations = {folder.name: folder.rig.stations for folder in folders}
    rows = scored_rows(pl.concat(tables, how="diagonal"), truths_of(folders), stations)
    part = Evaluation(
        evaluation.bearing,
        evaluation.overall,
        chosen,
        [metrics for metrics in evaluation.tracks if metrics["recording"] in names],
    )
    tracks = ScoredTracks(rows, folders, batches)
    known = part if is_scored(rows).any() else None
    about = f"{run.tracker}: {spec_of(run.tracker).about}"
    page = run_data(tracks, pl.concat(events, how="diagonal"), known, about, run.short)
    page |= {"recordingCount": len(run.paths), "statements": evaluation.statements if known else []}
    return write_shown(tracks, page, options, out, begin)


def _list_refused(verb: str, refused: Sequence[Sequence[str]], table: Path | None = None) -> None:
    """A line for each refusal, up to some; `table`: the file that has all."""
    lines = [line for of_recording in refused for line in of_recording]
    for line in lines[:LISTED]:
        notice(f"not {verb}: {line}")
    if len(lines) > LISTED:
        where = "" if table is None else f": column 'refused' of {table}"
        notice(f"not {verb}: {len(lines) - LISTED} more{where}")


def _ended(verb: str, out: Path, noticed: int, refused: Sequence[Sequence[str]], of: int) -> int:
    """Says where the table of results is, and lists what was refused, of so many recordings; the exit code."""
    table = out / RESULTS
    print(f"wrote {table}, a row for each recording and tracker")
    if noticed:
        notice(f"notice: {counted(noticed, 'recording')} with notices: column 'notices' of {table}")
    if refused:
        notice(f"not {verb}: {len(refused)} of {counted(of, 'recording')}")
    _list_refused(verb, refused, table)
    return LEFT_OUT if refused else 0


def evaluate_archive(out: Path, options: EvaluateOptions) -> int:
    """Scores the estimates of an archive again, recording by recording; returns the exit code."""
    fail_if = options.fail_if
    tracked, store = RecordingStore(out, TRACKED), RecordingStore(out, SCORED)
    known = read_results(out)
    paths = [path for path in known if (tracked.folder(path) / TRACKED).is_file()]
    if not paths:
        raise UnusableInput(f"{out / RESULTS}: names no recording that is kept beside it; run `track` again")
    if fail_if is not None:
        first = tracked.folder(paths[0])
        for outcome in tracked.read(first)["outcomes"]:
            condition_of(fail_if, metric_names(read_tracks(first / outcome["short"])))
    scoring = Scoring(options.used.part, tracked)
    with held(out), json_alone(options.json) as put, stages("evaluate") as begin:
        done, refused = _run("evaluated", store, paths, scoring, options.cluster, begin("scoring", len(paths)))
        # What could not be tracked keeps its line, but is no failure of this command.
        lines = {path: reasons for path, reasons in known.items() if path not in paths} | refused
        runs, rows, noticed = gathered(store, list(known), done, lines)
        write_results(out, rows)
        failed = False
        for run in runs:
            evaluation = run.write(out if len(runs) == 1 else output_folder(out / run.short), ERRORS[SCORED])
            put(_shown(run, evaluation))
            failed |= bool(code_of(evaluation, fail_if, f"{run.short}: "))
        _compare(runs)
        code = _ended("evaluated", out, noticed, [lines[path] for path in paths if path in lines], len(paths))
    return 1 if failed else code
