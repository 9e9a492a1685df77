"""What `trackwright track` does with recordings that were read: estimates, events, error metrics, figures, manifest."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl

from experiments.cli.console import notice, notice_unused_calibration, output_folder
from experiments.cli.evaluate import SOURCES
from experiments.cli.manifest import write_manifest
from experiments.cli.stages import Begin
from experiments.executors import cluster_executor
from experiments.portable_tracker import run_on
from experiments.reports.evaluation_text import to_text
from experiments.reports.tables import terminal_width
from experiments.reports.wording import counted, uncapitalised
from experiments.scored_tracks import ScoredTracks
from trackers.catalogue import build, fitting
from trackers.core.chunks import CHUNK
from trackers.core.errors import UnusableInput
from trackers.core.freed_memory import give_back
from trackers.evaluation import Evaluation, evaluate, evaluate_association
from trackers.events import EVENTS, events_of
from trackers.recordings.association import Association, associate_truth
from trackers.recordings.atomic import atomic_write
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.selection import Selection
from trackers.recordings.tracks import Tracks, track
from trackers.recordings.tracks_table import TRACKS, write_tracks
from trackers.recordings.trajectories import known_height
from tuning.tuned_file import Tuned


@dataclass(frozen=True)
class Options:
    """The options of the command.

    `tuned`: the content of the file `noise`. `values`: by tunable or pattern. `part`: of the recordings.
    """

    recordings: Sequence[Path]
    out: Path
    tracker: str | None
    noise: Path | None
    tuned: Tuned | None
    values: Mapping[str, Any]
    calibration: Path | None
    part: Selection
    average: float | None
    free_height: bool
    smooth: bool
    lag: float | None
    seed: int
    cluster: str | None
    figures: bool
    report: bool
    format: str


def track_folders(folders: Sequence[RecordingFolder], options: Options, started: datetime, begin: Begin) -> int:
    """Tracks the recordings, writes all files and prints the metrics; returns the exit code. `begin`: of a stage."""
    out, tuned = options.out, options.tuned
    of_file = None if tuned is None else tuned.tracker
    name = options.tracker or of_file or fitting(folders[0])
    named = build(name, folders, options.free_height)
    if options.tracker is None and of_file is not None:
        notice(f"tracker: {name}, that of {options.noise}; choose another with --tracker")
    elif options.tracker is None:
        notice(f"tracker: {name} ({named.spec.about}); choose another with --tracker")
    notice_unused_calibration(folders, name, named.spec.table)
    if tuned is not None:
        named = named.with_values(tuned.values, options.noise)
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
    paths = "\n".join(str(p.resolve()) for p in options.recordings)
    atomic_write(out / SOURCES, lambda path: path.write_text(paths + "\n", encoding="utf-8"))
    print(
        f"{counted(sum(summaries.values()), 'track')}: "
        + "; ".join(f"{n} {v}" for v, n in sorted(summaries.items(), key=lambda x: -x[1]))
    )
    truths = {f.name: f.tables["truth"] for f in folders if "truth" in f.tables}
    association = associate_truth(table, truths)
    evaluation = None
    if association.scored.any():
        evaluation = evaluate(association, folders).with_residuals(tracks)
        print(to_text(evaluation, terminal_width()), end="")
    else:
        _without_truth(association, folders, tracks)
    scored = ScoredTracks(association, folders, batches)
    drawn = _shown(scored, happened, evaluation, f"{name}: {named.spec.about}", options, begin)
    config = {
        "tracker": name,
        "noise": None if options.noise is None else str(options.noise),
        "set": {name: value.tolist() for name, value in options.values.items()},
        "part": dataclasses.asdict(options.part),
        "calibration": None if options.calibration is None else str(options.calibration),
        "average": options.average,
        "free_height": options.free_height,
        "smooth": options.smooth,
        "lag": options.lag,
        "seed": options.seed,
    }
    write_manifest(
        out,
        sys.argv,
        config,
        started,
        chunk=CHUNK,
        extra={"recordings": [str(p) for p in options.recordings], "verdicts": summaries},
    )
    for event, count in happened.group_by("event", maintain_order=True).len().iter_rows():
        print(f"event: {event} ({counted(count, 'time')})")
    written = f"{out / TRACKS} ({counted(len(table), 'estimate')}), {EVENTS}, manifest.json"
    print(f"wrote {', '.join([written, *drawn])}")
    return 0


def _shown(
    tracks: ScoredTracks,
    events: pl.DataFrame,
    evaluation: Evaluation | None,
    tracker: str,
    options: Options,
    begin: Begin,
) -> list[str]:
    """Writes the page and the figures that are asked for; returns in words what was written."""
    written = []
    if options.report:
        begin("report")
        from experiments.interactive.track_page import PAGE, write_track_page

        command = shlex.join(["trackwright", *sys.argv[1:]])
        write_track_page(options.out / PAGE, tracks, events, evaluation, tracker, command)
        written.append(PAGE)
    if options.figures:
        begin("figures")
        # matplotlib takes a third of a second to import.
        from experiments.plots.track_folder import plot_tracks

        drawn = plot_tracks(options.out, tracks, options.format)
        written.append(f"{counted(len(drawn), 'figure')} ({', '.join(drawn[:4])}{', …' if len(drawn) > 4 else ''})")
    return written


def _without_truth(association: Association, folders: Sequence[RecordingFolder], tracks: Tracks) -> None:
    """Prints why the tracks are not evaluated, if there is a truth, and the statement on their innovations."""
    if any("truth" in f.tables for f in folders):
        try:
            evaluate(association, folders)
        except UnusableInput as problem:
            notice(f"notice: not evaluated: {problem}")
    for sentence in evaluate_association(association).with_residuals(tracks).statements:
        print(f"Without truth: {uncapitalised(sentence)}")
