"""What `trackwright track` does with recordings that were read: estimates, metrics, files."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import polars as pl

import trackwright as tw
from trackwright.experiments.cli.console import LEFT_OUT, chosen_tracker, notices, write_manifest
from trackwright.experiments.cli.options import TrackOptions
from trackwright.experiments.pages.report import typed, write_page
from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.experiments.pages.track import PAGE, run_data, track_page
from trackwright.experiments.text.tables import figures_drawn, terminal_width, to_json, to_text, uncapitalised
from trackwright.experiments.text.terminal import Begin, notice
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.errors import counted
from trackwright.trackers.core.programs import give_back
from trackwright.trackers.evaluation.evaluate import truths_of, with_truth
from trackwright.trackers.evaluation.rows import refuse_without_overlap
from trackwright.trackers.recordings.files import Content, write_whole
from trackwright.trackers.recordings.tracks_table import EVALUATION, RESULTS, SOURCES, TRACKS, sources_text

MUCH = 0.3  # the regret of NIS, nats, from which on innovations contradict the noise levels


class ScoredRun(NamedTuple):
    """What one tracker found in recordings: `tracks`, and their scored rows and metrics."""

    named: tw.NamedTracker
    folders: Sequence[tw.RecordingFolder]
    tracks: tw.Tracks
    rows: pl.DataFrame
    evaluation: tw.Evaluation


def files_of(found: ScoredRun) -> dict[str, Content]:
    """The files of a run folder."""
    paths = sources_text(folder.path for folder in found.folders)
    return {TRACKS: found.tracks.table, SOURCES: paths, EVALUATION: to_json(found.evaluation)}


def tracked(
    name: str, folders: Sequence[tw.RecordingFolder], options: TrackOptions, begin: Begin
) -> tuple[ScoredRun, list[str]]:
    """Runs a tracker on recordings, valued, fitted and smoothed as options ask for; and its notices."""
    named, lines = options.numbers.build(name, [*folders]), list[str]()
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
    return ScoredRun(named, folders, tracks, rows, tw.Evaluation.of(rows)), [*tracks.notices, *lines]


def track_together(
    folders: Sequence[tw.RecordingFolder], refused: list[str], options: TrackOptions, begin: Begin
) -> int:
    """Tracks the recordings that the tracker fits, writes all files and prints the metrics; the exit code."""
    name, out = chosen_tracker(folders, options.numbers), options.out
    lacking = [(folder, spec_of(name).refusal(folder, name)) for folder in folders]
    fit, unfit = [folder for folder, line in lacking if not line], [line for _, line in lacking if line]
    if not fit:
        raise tw.UnusableInput(unfit[0])
    (out / RESULTS).unlink(missing_ok=True)  # left by an earlier archive
    run, lines = tracked(name, fit, options, begin)
    notices(lines)
    for file, rows in files_of(run).items():
        write_whole(out / file, rows)
    print(words_of(run.tracks.summaries))
    evaluation, written = run.evaluation, list[str]()
    if evaluation.overall["n"]:
        print(to_text(evaluation, terminal_width()), end="")
    scored = ScoredTracks(run.rows, run.folders, run.tracks.batches)
    if options.figures != "none":
        begin("report")
        known = evaluation if evaluation.overall["n"] else None
        page = run_data(scored, known, f"{name}: {run.named.spec.about}", name)
        write_page(out / PAGE, track_page([page], typed(sys.argv)))
        written.append(PAGE)
    if options.figures == "png" or options.figures == "pdf":  # matplotlib takes a third of a second to import
        from trackwright.experiments.pages.charts import plot_tracks

        begin("figures")
        written.append(figures_drawn(plot_tracks(out, scored, options.figures)))
    conclude(evaluation, name, len(run.rows), options, written)
    for line in (*refused, *unfit):
        notice(f"not tracked: {line}")
    return LEFT_OUT if refused or unfit else 0


def words_of(endings: Mapping[str, int]) -> str:
    """How many tracks ended how, the most first."""
    words = "; ".join(f"{n} {words}" for words, n in sorted(endings.items(), key=lambda x: -x[1]))
    return f"{counted(sum(endings.values()), 'track')}: {words}"


def conclude(evaluation: tw.Evaluation, name: str, rows: int, options: TrackOptions, written: Sequence[str]) -> None:
    """Prints what innovations show without truth, notices levels that seem wrong, and writes the manifest."""
    for sentence in () if evaluation.overall["n"] else evaluation.statements:
        print(f"Without truth: {uncapitalised(sentence)}")
    ratio = evaluation.overall["nis_ratio"]
    if not options.fit and ratio and ratio - 1 - math.log(ratio) > MUCH:
        wrong = f"innovations contradict the noise levels, NIS/dof {ratio:.2g}"
        notice(f"notice: {wrong}; --fit fits them to the readings")
    write_manifest(options.out, tracker=name, set=options.numbers.values, seed=options.seed)
    table = f"{options.out / TRACKS} ({counted(rows, 'estimate')})"
    print(f"wrote {', '.join([table, EVALUATION, 'manifest.json', *written])}")
