"""What `trackwright track` does with recordings that were read: estimates, events, error metrics, figures, manifest."""

from __future__ import annotations

import dataclasses
import json
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from experiments.cli.archives.folders import RESULTS
from experiments.cli.console import ReadingOptions, notice_unused_calibration, output_folder
from experiments.cli.manifest import write_manifest
from experiments.cli.report import COMPARISON, print_comparison
from experiments.cli.tracked_by import TrackedBy, late_readings, tracked_by
from experiments.jobs.executors import cluster_executor
from experiments.jobs.portable_tracker import run_on
from experiments.pages.interactive.track_page import PAGE, run_data, write_track_page
from experiments.pages.scored_tracks import ScoredTracks
from experiments.text.evaluation_text import to_json, to_text
from experiments.text.tables import terminal_width
from experiments.text.terminal import Begin, notice
from experiments.text.wording import figures_drawn, uncapitalised
from trackers.catalogue import build, spec_of
from trackers.core.chunks import CHUNK
from trackers.core.errors import UnusableInput
from trackers.core.freed_memory import give_back
from trackers.core.wording import counted
from trackers.evaluation.association import Association, associate_truth
from trackers.evaluation.evaluate import Evaluation, evaluate, evaluate_association
from trackers.evaluation.events import EVENTS, events_of
from trackers.evaluation.residuals import residual_ratios
from trackers.recordings.atomic import atomic_write
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracks import Tracks, track
from trackers.recordings.tracks_table import EVALUATION, SOURCES, TRACKS, write_tracks
from trackers.recordings.trajectories import known_height
from tuning.tuned_file import Tuned


@dataclass(frozen=True)
class Options:
    """The options of the command.

    `tuned`: the content of the file `noise`. `values`: by tunable or pattern. `used`: of the recordings.
    """

    out: Path
    tracker: str | None
    noise: Path | None
    tuned: Tuned | None
    values: Mapping[str, Any]
    used: ReadingOptions
    free_height: bool
    smooth: bool
    lag: float | None
    seed: int
    cluster: str | None
    figures: bool
    report: bool
    format: str

    def config(self, tracker: str) -> dict[str, Any]:
        """What the manifest of a run of this tracker holds of the options."""
        return {
            "tracker": tracker,
            "noise": None if self.noise is None else str(self.noise),
            "set": {name: value.tolist() for name, value in self.values.items()},
            "part": dataclasses.asdict(self.used.part),
            "calibration": None if self.used.calibration is None else str(self.used.calibration),
            "average": self.used.average,
            "free_height": self.free_height,
            "smooth": self.smooth,
            "lag": self.lag,
            "seed": self.seed,
        }


def track_folders(
    folders: Sequence[RecordingFolder],
    refused: Sequence[str],
    options: Options,
    started: datetime,
    begin: Begin,
    put: Callable[[Mapping[str, Any]], None],
) -> int:
    """Tracks the recordings, writes all files and prints the metrics; returns the exit code, 1 if some were `refused`.

    Several trackers get a folder each, by their names; those that the user named are compared. `begin`: of a stage.
    `put`: of the metrics, by tracker.
    """
    of_file = None if options.tuned is None else options.tuned.tracker
    runs, unfit = tracked_by(folders, options.tracker or of_file, options.noise)
    for name in (run.tracker for run in runs if options.tracker is None):
        if of_file is not None:
            notice(f"tracker: {name}, that of {options.noise}; choose another with --tracker")
        else:
            notice(f"tracker: {name} ({spec_of(name).about}); choose another with --tracker")
    with suppress(OSError):
        # That of an archive which was tracked to this folder before.
        (options.out / RESULTS).unlink(missing_ok=True)
    if len(runs) == 1:
        put({runs[0].short: _track(runs[0], options, options.out, started, begin, 1)[0]})
    else:
        output_folder(options.out)
        of, pages = len(runs) if options.tracker is not None else 1, list[dict[str, Any]]()
        for run in runs:
            metrics, page = _track(run, options, options.out / run.short, started, begin, of)
            put({run.short: metrics})
            pages += [] if page is None else [page]
        if of > 1:
            begin("comparison")
            if pages:
                _write_page(options.out, pages)
                print(f"wrote {options.out / PAGE}")
            print_comparison(
                [options.out / run.short for run in runs],
                options.out / COMPARISON,
                options.format if options.figures else None,
                page=options.report,
                playback=PAGE if pages else None,
            )
    for line in (*refused, *unfit):
        notice(f"not tracked: {line}")
    return int(bool(refused or unfit))


def _track(
    run: TrackedBy, options: Options, out: Path, started: datetime, begin: Begin, of: int
) -> tuple[Any, dict[str, Any] | None]:
    """Tracks recordings with one tracker into the folder `out`; returns its evaluation.json and its page.

    `of`: how many trackers are compared; the only one has a table of errors, figures and its page in its folder.
    """
    name, folders = run
    named = build(name, folders, options.free_height)
    notice_unused_calibration(folders, name, named.spec.table)
    if options.tuned is not None:
        named = named.with_values(options.tuned.values, options.noise)
    if options.values:
        named = named.with_values(options.values, "--set")
    if options.smooth or options.lag is not None:
        named = named.smoothing(options.lag)
    batches = named.batches(folders)
    for batch in batches:
        for line in batch.notices:
            notice(f"notice: {line}")
    flat = [trajectory for batch in batches if batch.planar for trajectory in batch.trajectories]
    heights = sum(known_height(trajectory.folder, trajectory.tag) is not None for trajectory in flat)
    if heights and not named.spec.bearing_only:
        notice(f"height: known from rig.toml for {counted(heights, 'tag')} and used; estimate it with --free-height")
    output_folder(out)
    give_back()
    advance = begin("tracking", sum(len(batch.trajectories) for batch in batches))
    with cluster_executor(options.cluster) if options.cluster else nullcontext() as executor:
        if executor is None:
            tracks = track(batches, advance, options.seed)
        else:
            tracks = run_on(executor, named, folders, advance, options.seed)
    give_back()
    begin("errors and events")
    table, summaries = tracks.table, tracks.summaries
    atomic_write(out / TRACKS, partial(write_tracks, table))
    happened = events_of(table, named.spec, batches)
    atomic_write(out / EVENTS, happened.write_parquet)
    paths = "\n".join(str(folder.path.resolve()) for folder in folders if folder.path is not None)
    atomic_write(out / SOURCES, lambda path: path.write_text(paths + "\n", encoding="utf-8"))
    whose = "" if out == options.out else f"{run.short}: "
    print(f"{whose}{counted(sum(summaries.values()), 'track')}: {endings(summaries)}")
    truths = {f.name: f.tables["truth"] for f in folders if "truth" in f.tables}
    association = associate_truth(table, truths)
    if association.scored.any():
        stations = {folder.name: folder.rig.stations for folder in folders}
        evaluation = evaluate_association(association, stations, ratios=residual_ratios(tracks))
        for line in late_readings(named, folders):
            notice(f"notice: {line}")
        if of == 1:
            print(to_text(evaluation, terminal_width()), end="")
    else:
        evaluation = _without_truth(association, folders, tracks)
    metrics = to_json(evaluation)
    atomic_write(out / EVALUATION, lambda path: path.write_text(metrics, encoding="utf-8"))
    scored = ScoredTracks(association, folders, batches)
    page, drawn = None, list[str]()
    if options.report:
        begin("report")
        known, about = evaluation if association.scored.any() else None, f"{name}: {named.spec.about}"
        page = run_data(scored, happened, known, about, run.short, of, options.figures and of == 1)
    if of == 1:
        drawn = write_shown(scored, page, options, out, begin)
    write_manifest(
        out,
        sys.argv,
        options.config(name),
        started,
        chunk=CHUNK,
        extra={"recordings": [str(folder.path) for folder in folders], "verdicts": summaries},
    )
    for event, count in happened.group_by("event", maintain_order=True).len().iter_rows():
        print(f"event: {event} ({counted(count, 'time')})")
    written = f"{out / TRACKS} ({counted(len(table), 'estimate')}), {EVENTS}, {EVALUATION}, manifest.json"
    print(f"wrote {', '.join([written, *drawn])}")
    return json.loads(metrics), page


def endings(summaries: Mapping[str, int]) -> str:
    """How many tracks ended how, the most first."""
    return "; ".join(f"{n} {v}" for v, n in sorted(summaries.items(), key=lambda x: -x[1]))


def write_shown(
    tracks: ScoredTracks, page: Mapping[str, Any] | None, options: Options, out: Path, begin: Begin
) -> list[str]:
    """Writes the page, if any, and the figures that are asked for; returns in words what was written."""
    written = []
    if page is not None:
        _write_page(out, [page])
        written.append(PAGE)
    if options.figures:
        begin("figures")
        # matplotlib takes a third of a second to import.
        from experiments.pages.plots.track_folder import plot_tracks

        drawn = plot_tracks(out, tracks, options.format)
        written.append(figures_drawn(drawn))
    return written


def _write_page(out: Path, pages: Sequence[Mapping[str, Any]]) -> None:
    write_track_page(out / PAGE, pages, shlex.join(["trackwright", *sys.argv[1:]]))


def _without_truth(association: Association, folders: Sequence[RecordingFolder], tracks: Tracks) -> Evaluation:
    """The metrics of the innovations; prints what these show, and if there is a truth, why it is not used."""
    if any("truth" in f.tables for f in folders):
        try:
            evaluate(association, folders)
        except UnusableInput as problem:
            notice(f"notice: not evaluated: {problem}")
    evaluation = evaluate_association(association, ratios=residual_ratios(tracks))
    for sentence in evaluation.statements:
        print(f"Without truth: {uncapitalised(sentence)}")
    return evaluation
