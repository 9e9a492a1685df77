"""What `trackwright track` does with recordings that were read: trackers, estimates, events, metrics, files."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

import trackwright as tw
from trackwright.experiments.cli.console import LEFT_OUT, notices, write_manifest
from trackwright.experiments.cli.evaluating import print_comparison
from trackwright.experiments.cli.options import TrackOptions, file_format
from trackwright.experiments.pages.report import typed
from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.experiments.pages.track import PAGE, run_data, write_track_page
from trackwright.experiments.text.tables import content, terminal_width, to_json, to_text
from trackwright.experiments.text.terminal import Advance, Begin, notice
from trackwright.experiments.text.wording import figures_drawn, uncapitalised
from trackwright.trackers.catalogue import several, spec_of, tracked_by
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.user_file import split_name
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.evaluate import truths_of, with_truth
from trackwright.trackers.evaluation.rows import refuse_without_overlap
from trackwright.trackers.programs.program_cache import give_back
from trackwright.trackers.recordings.atomic import Content, write_whole
from trackwright.trackers.recordings.tracks_table import EVALUATION, RESULTS, SOURCES, TRACKS, sources_text

MUCH = 0.3
"""The regret of NIS, nats, from which on innovations contradict the noise levels."""


class ScoredRun(NamedTuple):
    """What one tracker found in recordings: `tracks`, and their `scored_rows`."""

    named: tw.NamedTracker
    folders: Sequence[tw.RecordingFolder]
    tracks: tw.Tracks
    rows: pl.DataFrame

    @property
    def evaluation(self) -> tw.Evaluation:
        """The metrics."""
        return tw.Evaluation.of(self.rows)


def silent(name: str, total: int | None = None) -> Advance:
    """Begins a stage of which nobody hears."""
    return lambda done, now="": None


def short(tracker: str) -> str:
    """The name of a tracker as a folder: for one in a file, without the file."""
    return split_name(tracker)[1] or tracker


def named_runs(options: TrackOptions) -> list[str]:
    """The trackers that options name, none for those that fit; raises UnusableInput for a repeated one."""
    names = [*several(options.named).values()]
    if len(names) > 1 and options.noise is not None:
        found = options.named
        raise tw.UnusableInput(f"--noise {options.noise}: belongs to one tracker, found {found}; name one of them")
    return names


def files_of(found: ScoredRun) -> dict[str, Content]:
    """The files of a run folder."""
    paths = sources_text(folder.path for folder in found.folders)
    return {TRACKS: found.tracks.table, SOURCES: paths, EVALUATION: to_json(found.evaluation)}


def tracked(
    name: str, folders: Sequence[tw.RecordingFolder], options: TrackOptions, begin: Begin
) -> tuple[ScoredRun, list[str]]:
    """Runs a tracker on recordings, valued, fitted and smoothed as options ask for; and its notices."""
    numbers, lines = options.numbers, list[str]()
    named = options.valued(tw.build(name, folders, numbers.free_height, numbers.side))
    parts: list[tuple[tw.NamedTracker, Sequence[tw.RecordingFolder]]] = [(named, folders)]
    if options.fit:
        parts, advance = [], begin("fitting", len(folders))
        for folder in folders:
            own = tw.fitted(named, folder)
            parts.append((own.tracker, [folder]))
            lines.append(own.line)
            advance(1)
    if options.smooth or options.lag is not None:
        parts = [(one.smoothing(options.lag), of) for one, of in parts]
    give_back()
    batches = [batch for one, of in parts for batch in one.batches(of)]
    advance = begin("tracking", sum(len(batch.trajectories) for batch in batches))
    tracks = named.track(batches, advance, seed=options.seed)
    begin("errors")
    rows = with_truth(tracks.table, folders)
    try:
        refuse_without_overlap(rows, truths_of(folders))
    except tw.UnusableInput as problem:
        lines.append(f"not evaluated: {problem}")
    return ScoredRun(named, folders, tracks, rows), [*tracks.notices, *lines]


def track_together(
    folders: Sequence[tw.RecordingFolder], refused: Sequence[str], options: TrackOptions, begin: Begin
) -> tuple[int, dict[str, Any]]:
    """Tracks the recordings, writes all files and prints the metrics; the exit code, and the metrics by tracker.
    Several trackers get a folder each; those that the user named are compared."""
    chosen = options.numbers.tracker is None
    runs, unfit = tracked_by(folders, named_runs(options))
    with suppress(OSError):
        (options.out / RESULTS).unlink(missing_ok=True)  # left by an earlier archive
    compared, found, pages = len(runs) > 1 and not chosen, dict[str, Any](), list[dict[str, Any]]()
    for name, of in runs.items():
        if chosen:
            _notice_choice(name, of)
        out = options.out if len(runs) == 1 else options.out / short(name)
        run, lines = tracked(name, of, options, begin)
        notices(lines)
        for file, rows in files_of(run).items():
            write_whole(out / file, rows)
        print(f"{f'{short(name)}: ' if len(runs) > 1 else ''}{words_of(run.tracks.summaries)}")
        evaluation, written = run.evaluation, list[str]()
        if evaluation.overall["n"] and not compared:
            print(to_text(evaluation, terminal_width()), end="")
        scored = ScoredTracks(run.rows, run.folders, run.tracks.batches)
        if options.figures != "none":
            begin("report")
            known = evaluation if evaluation.overall["n"] else None
            about, several_runs = f"{name}: {run.named.spec.about}", len(runs) if compared else 1
            pages.append(run_data(scored, known, about, short(name), several_runs))
            if not compared:
                write_track_page(out / PAGE, [pages.pop()], typed(sys.argv))
                written.append(PAGE)
        if (kind := file_format(options.figures)) and not compared:
            # matplotlib takes a third of a second to import.
            from trackwright.experiments.pages.charts import plot_tracks

            begin("figures")
            written.append(figures_drawn(plot_tracks(out, scored, kind)))
        conclude(evaluation, name, len(run.rows), options, out, written)
        found[short(name)] = content(evaluation)
    if compared:
        begin("comparison")
        if pages:
            write_track_page(options.out / PAGE, pages, typed(sys.argv))
            print(f"wrote {options.out / PAGE}")
        outs, page = [options.out / name for name in found], PAGE if pages else None
        print_comparison(outs, options.out, file_format(options.figures), page=page is not None, playback=page)
    for line in (*refused, *unfit):
        notice(f"not tracked: {line}")
    return LEFT_OUT if refused or unfit else 0, found


def _notice_choice(name: str, folders: Sequence[tw.RecordingFolder]) -> None:
    """Says which tracker was chosen for recordings, and what it leaves unread."""
    spec = spec_of(name)
    unread = {table for folder in folders for table in folder.tables if table not in spec.reads | {"imu", "truth"}}
    without = f"; without {listed(sorted(unread))}" if unread else ""
    notice(f"tracker: {name} ({spec.about}{without}); choose another with --tracker")


def words_of(endings: Mapping[str, int]) -> str:
    """How many tracks ended how, the most first."""
    words = "; ".join(f"{n} {words}" for words, n in sorted(endings.items(), key=lambda x: -x[1]))
    return f"{counted(sum(endings.values()), 'track')}: {words}"


def conclude(
    evaluation: tw.Evaluation, name: str, rows: int, options: TrackOptions, out: Path, written: Sequence[str] = ()
) -> None:
    """Prints what innovations show without truth, notices levels that seem wrong, and writes the manifest."""
    for sentence in () if evaluation.overall["n"] else evaluation.statements:
        print(f"Without truth: {uncapitalised(sentence)}")
    ratio = evaluation.overall["nis_ratio"]
    if not options.fit and ratio and ratio - 1 - math.log(ratio) > MUCH:
        wrong = f"innovations contradict the noise levels, NIS/dof {ratio:.2g}"
        notice(f"notice: {wrong}; --fit fits them to the readings")
    write_manifest(out, tracker=name, set=options.numbers.values, seed=options.seed)
    files = f"{out / TRACKS} ({counted(rows, 'estimate')})", EVALUATION, "manifest.json"
    print(f"wrote {', '.join([*files, *written])}")
