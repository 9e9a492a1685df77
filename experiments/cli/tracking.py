"""What `trackwright track` does with recordings that were read: estimates, events, metrics, files."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress

import trackwright as tw
from trackwright.experiments.cli.console import LEFT_OUT, chosen_tracker, notices, write_manifest
from trackwright.experiments.cli.options import TrackOptions
from trackwright.experiments.pages.reports.pages import typed
from trackwright.experiments.pages.reports.track import PAGE, run_data, write_track_page
from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.experiments.text.evaluation_text import to_json, to_text
from trackwright.experiments.text.tables import terminal_width
from trackwright.experiments.text.terminal import Begin, notice
from trackwright.experiments.text.wording import figures_drawn, uncapitalised
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.cautions import level_caution
from trackwright.trackers.evaluation.events import EVENTS
from trackwright.trackers.evaluation.scored_run import ScoredRun
from trackwright.trackers.programs.process_settings import give_back
from trackwright.trackers.recordings.archives import RESULTS
from trackwright.trackers.recordings.atomic import Content, write_whole
from trackwright.trackers.recordings.tracks_table import EVALUATION, SOURCES, TRACKS, sources_text


def files_of(found: ScoredRun) -> dict[str, Content]:
    """The files of a run folder."""
    paths = sources_text(folder.path for folder in found.folders)
    return {TRACKS: found.tracks.table, EVENTS: found.events, SOURCES: paths, EVALUATION: to_json(found.evaluation)}


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
    found = ScoredRun.of(parts, options.seed, begin)
    return found, [*lines, *found.notices]


def track_together(
    folders: Sequence[tw.RecordingFolder], refused: list[str], options: TrackOptions, begin: Begin
) -> int:
    """Tracks the recordings that the tracker fits, writes all files and prints the metrics; the exit code."""
    name, out = chosen_tracker(folders, options.numbers), options.out
    lacking = [(folder, spec_of(name).refusal(folder, name)) for folder in folders]
    fit, unfit = [folder for folder, line in lacking if not line], [line for _, line in lacking if line]
    if not fit:
        raise tw.UnusableInput(unfit[0])
    with suppress(OSError):
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
        page = run_data(scored, run.events, known, f"{name}: {run.named.spec.about}", name)
        write_track_page(out / PAGE, [page], typed(sys.argv))
        written.append(PAGE)
    if options.figures == "png" or options.figures == "pdf":
        # matplotlib takes a third of a second to import.
        from trackwright.experiments.pages.charts.recording import plot_tracks

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
    if not options.fit and (wrong := level_caution(evaluation.overall)):
        notice(f"notice: innovations are {wrong}; --fit fits noise levels to the readings")
    write_manifest(options.out, tracker=name, set=options.numbers.values, seed=options.seed)
    table = f"{options.out / TRACKS} ({counted(rows, 'estimate')})"
    print(f"wrote {', '.join([table, EVENTS, EVALUATION, 'manifest.json', *written])}")
