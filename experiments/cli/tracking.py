"""What `trackwright track` does with recordings that were read: trackers, estimates, events, metrics, files."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.cli.archive_folders import RESULTS
from trackwright.experiments.cli.console import notice_unused_calibration, output_folder
from trackwright.experiments.cli.options import TrackOptions, file_format
from trackwright.experiments.cli.runtime import LEFT_OUT, write_manifest
from trackwright.experiments.pages.reports.track import PAGE, run_data, write_track_page
from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.experiments.text.evaluation_text import to_json, to_text
from trackwright.experiments.text.tables import terminal_width
from trackwright.experiments.text.terminal import Begin, notice
from trackwright.experiments.text.wording import figures_drawn, uncapitalised
from trackwright.trackers.catalogue import ENTRIES, build, fitting, spec_of
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import SAY_SIDE
from trackwright.trackers.core.run.chunks import CHUNK
from trackwright.trackers.core.user_file import split_name
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.evaluate import Evaluation, truths_of
from trackwright.trackers.evaluation.events import EVENTS, events_of
from trackwright.trackers.evaluation.residuals import residual_ratios
from trackwright.trackers.evaluation.rows import is_scored, refuse_without_overlap, scored_rows
from trackwright.trackers.programs.process_settings import give_back
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.checks.residuals import delay_against_truth
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.tracks_table import EVALUATION, SOURCES, TRACKS, write_tracks
from trackwright.trackers.recordings.trajectories import known_height

CONTRADICTED, CORRELATED = 1.5, 3.0  # by what factor innovations are off, and rows that carry the information of one
LATE_S = 0.1  # delay of readings against truth, beyond the latency that the tracker assumes, that is worth a notice
APART_M, MIRRORED_SHARE = 0.5, 0.1
"""Distance of true heights from the anchors' plane, m, from which on their side counts; share of estimates on the other
side that is worth a notice."""


class TrackedBy(NamedTuple):
    """A tracker and the recordings that it runs on; `short`: its name as a folder."""

    tracker: str
    folders: list[RecordingFolder]

    @property
    def short(self) -> str:
        """The name of the tracker, of one in a file without the file."""
        return split_name(self.tracker)[1] or self.tracker


def tracker_names(trackers: str | None, noise: Path | None = None) -> list[str]:
    """The names in a text with commas; raises UnusableInput for a repeated one, and several with `noise` of one."""
    names = [] if trackers is None else [name.strip() for name in trackers.split(",")]
    # By which the folder of each is named.
    shorts = [split_name(name)[1] or name for name in names]
    repeated = next((name for k, name in enumerate(shorts) if name in shorts[:k]), None)
    if "" in names:
        raise UnusableInput(f"--tracker {trackers}: a name is empty; expected names with commas, without blanks")
    if repeated is not None:
        raise UnusableInput(f"--tracker {trackers}: '{repeated}' twice; expected different names; remove one")
    if len(names) > 1 and noise is not None:
        raise UnusableInput(f"--noise {noise}: belongs to one tracker, found {trackers}; name one with --tracker")
    return names


def tracked_by(
    folders: Sequence[RecordingFolder], trackers: str | None, noise: Path | None = None
) -> tuple[list[TrackedBy], list[str]]:
    """The runs, and a line for each recording that a tracker does not fit. `trackers`: names separated by commas; None:
    each recording is run by the tracker that fits it. Raises UnusableInput where nothing can be run."""
    names = tracker_names(trackers, noise)
    runs: dict[str, list[RecordingFolder]] = {}
    refused: list[str] = []
    for name in names:
        spec, runs[name] = spec_of(name), []
        for folder in folders:
            line = spec.refusal(folder, name)
            if line is None:
                runs[name].append(folder)
            else:
                refused.append(line)
    if not names:
        for folder in folders:
            try:
                runs.setdefault(fitting(folder), []).append(folder)
            except UnusableInput as problem:
                refused.append(str(problem))
    tracked = [TrackedBy(name, recordings) for name, recordings in runs.items() if recordings]
    if not tracked:
        raise UnusableInput(refused[0])
    return tracked, refused


def track_folders(
    folders: Sequence[RecordingFolder], refused: Sequence[str], options: TrackOptions, started: datetime, begin: Begin,
    put: Callable[[Mapping[str, Any]], None],
) -> int:  # fmt: skip
    """Tracks the recordings, writes all files and prints the metrics; the exit code. Several trackers get a folder
    each; those that the user named are compared. `put`: of the metrics, by tracker."""
    of_file = None if options.tuned is None else options.tuned.tracker
    runs, unfit = tracked_by(folders, options.tracker or of_file, options.noise)
    for name, chosen in runs if options.tracker is None else ():
        if of_file is not None:
            notice(f"tracker: {name}, by {options.noise}; choose another with --tracker")
        else:
            spec = spec_of(name)
            unread = {t for folder in chosen for t in folder.tables if t not in spec.reads | {"imu", "truth"}}
            tables = listed(sorted(unread))
            without = f"; without {tables}" if unread else ""
            # Of the same system, so that no other is imported.
            others = [k for k, entry in ENTRIES.items() if unread and entry.system == ENTRIES[name].system]
            fits = (k for k in others if unread <= spec_of(k).reads and spec_of(k).missing(chosen[0]) is None)
            another = f", such as {reader}, which reads {tables}" if (reader := next(fits, None)) else ""
            notice(f"tracker: {name} ({spec.about}{without}); choose another with --tracker{another}")
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
            from trackwright.experiments.cli.evaluating import print_comparison

            if pages:
                _write_page(options.out, pages)
                print(f"wrote {options.out / PAGE}")
            print_comparison(
                [options.out / run.short for run in runs],
                options.out,
                file_format(options.figures),
                page=options.figures != "none",
                playback=PAGE if pages else None,
            )
    for line in (*refused, *unfit):
        notice(f"not tracked: {line}")
    return LEFT_OUT if refused or unfit else 0


def _track(
    run: TrackedBy, options: TrackOptions, out: Path, started: datetime, begin: Begin, of: int
) -> tuple[Any, dict[str, Any] | None]:
    """Tracks recordings with one of `of` trackers into the folder `out`; returns its evaluation.json and its page."""
    name, folders = run
    named = build(name, folders, options.free_height, options.side)
    notice_unused_calibration(folders, name, named.spec.table)
    advance = begin("fitting", len(folders)) if options.fit else (lambda done: None)
    parts, fits = options.applied(named, folders, advance)
    for line in fits:
        notice(line)
    named, batches = parts[0][0], [batch for each, of in parts for batch in each.batches(of)]
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
    tracks = named.track(batches, advance, seed=options.seed)
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
    rows, lines = with_truth(table, named, folders)
    for line in lines:
        notice(f"notice: {line}")
    evaluation, known = Evaluation.of(rows, residual_ratios(tracks)), bool(is_scored(rows).any())
    if not known:
        for sentence in evaluation.statements:
            print(f"Without truth: {uncapitalised(sentence)}")
    elif of == 1:
        print(to_text(evaluation, terminal_width()), end="")
    notice_levels(evaluation.overall, options.fit)
    metrics = to_json(evaluation)
    atomic_write(out / EVALUATION, lambda path: path.write_text(metrics, encoding="utf-8"))
    scored = ScoredTracks(rows, folders, batches)
    page, drawn = None, list[str]()
    if options.figures != "none":
        begin("report")
        shown = evaluation if known else None
        page = run_data(scored, happened, shown, f"{name}: {named.spec.about}", run.short, of)
    if of == 1:
        drawn = write_shown(scored, page, options, out, begin)
    write_manifest(
        out,
        sys.argv,
        options.manifest(name),
        started,
        chunk=CHUNK,
        extra={"recordings": [str(folder.path) for folder in folders], "verdicts": summaries, "fitted": fits},
    )
    for event, count in happened.group_by("event", maintain_order=True).len().iter_rows():
        print(f"event: {event} ({counted(count, 'time')})")
    written = f"{out / TRACKS} ({counted(len(table), 'estimate')}), {EVENTS}, {EVALUATION}, manifest.json"
    print(f"wrote {', '.join([written, *drawn])}")
    return json.loads(metrics), page


def notice_levels(metrics: Mapping[str, Any], fitted: bool) -> None:
    """A notice where innovations contradict the noise levels by a factor, or by correlation, as of fast motion."""
    ratio, rows, samples = (metrics[name] for name in ("nis_ratio", "n_rows", "n_effective_nis"))
    if fitted or ratio is None:
        return
    wrong = f"{math.sqrt(ratio):.2g} times what the noise levels let expect (NIS/dof {ratio:.2g})"
    if CONTRADICTED**-2 <= ratio <= CONTRADICTED**2:
        wrong = f"correlated, {rows} rows with the information of {samples:.0f}" if rows > CORRELATED * samples else ""
    if wrong:
        notice(f"notice: innovations are {wrong}; --fit fits noise levels to the readings")


def endings(summaries: Mapping[str, int]) -> str:
    """How many tracks ended how, the most first."""
    return "; ".join(f"{n} {v}" for v, n in sorted(summaries.items(), key=lambda x: -x[1]))


def write_shown(
    tracks: ScoredTracks, page: Mapping[str, Any] | None, options: TrackOptions, out: Path, begin: Begin
) -> list[str]:
    """Writes the page, if any, and the figures that are asked for; returns in words what was written."""
    written = []
    if page is not None:
        _write_page(out, [page])
        written.append(PAGE)
    if kind := file_format(options.figures):
        begin("figures")
        # matplotlib takes a third of a second to import.
        from trackwright.experiments.pages.charts.recording import plot_tracks

        drawn = plot_tracks(out, tracks, kind)
        written.append(figures_drawn(drawn))
    return written


def _write_page(out: Path, pages: Sequence[Mapping[str, Any]]) -> None:
    write_track_page(out / PAGE, pages, shlex.join(["trackwright", *sys.argv[1:]]))


def with_truth(
    table: pl.DataFrame, named: NamedTracker, folders: Sequence[RecordingFolder]
) -> tuple[pl.DataFrame, list[str]]:
    """The scored rows, and notices: why the truth is not used, or which readings come late against it."""
    truths = truths_of(folders)
    rows = scored_rows(table, truths, {folder.name: folder.rig.stations for folder in folders})
    if is_scored(rows).any():
        return rows, [*mirrored_heights(rows, folders), *late_readings(named, folders)]
    try:
        if truths:
            refuse_without_overlap(rows, truths)
    except UnusableInput as problem:
        return rows, [f"not evaluated: {problem}"]
    return rows, []


def mirrored_heights(rows: pl.DataFrame, folders: Sequence[RecordingFolder]) -> list[str]:
    """A line with the recordings in which heights are on the other side of the anchors' plane than the true ones."""
    names = []
    for folder in folders:
        part, plane = rows.filter(pl.col("recording") == folder.name), folder.rig.plane
        if plane is not None and "std_z_m" in part.columns:
            true, estimated = (float_column(part, name) - plane for name in ("true_z_m", "z_m"))
            apart = is_scored(part) & (abs(true) > APART_M) & (float_column(part, "std_z_m") > 0)
            if np.mean((true * estimated < 0) & apart) > MIRRORED_SHARE:
                names.append(folder.name)
    return [f"{listed(names)}: height mirrored at the anchors' plane; {SAY_SIDE}"] if names else []


def mirror_lines(named: NamedTracker, folders: Sequence[RecordingFolder]) -> list[str]:
    """The lines on heights that are, or may be, mirrored in recordings that a tracker, run as it is, tells about."""
    if all(batch.planar for batch in named.batches(folders)) or all(folder.rig.plane is None for folder in folders):
        return []
    tracks = named.run(folders)
    told = [line for line in tracks.notices if SAY_SIDE in line]
    return [*told, *mirrored_heights(scored_rows(tracks.table, truths_of(folders)), folders)]


def late_readings(named: NamedTracker, folders: Sequence[RecordingFolder]) -> list[str]:
    """A line for each recording whose readings come later against truth than the tracker assumes."""
    read = [name for name in ("ranges", "fixes", "bearings") if name in named.spec.reads]
    lines = []
    for folder in folders:
        for table in (name for name in read if name in folder.tables):
            tunable, delay = f"sensors.{table}.latency", delay_against_truth(folder, table)
            latency = named.tunables.get(tunable)
            if not abs(delay - (0.0 if latency is None else float(latency.value))) > LATE_S:
                continue
            what = f"{folder.path or folder.name}: {table} come {abs(delay):.2f} s {'late' if delay > 0 else 'early'}"
            fix = "compare the clocks" if latency is None or delay < 0 else f"allow for it: --set {tunable}={delay:.2f}"
            lines.append(f"{what} against truth; {fix}")
    return lines
