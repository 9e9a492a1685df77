"""What `trackwright track` does with recordings that were read: trackers, estimates, events, metrics, files."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import trackwright as tw
from trackwright.experiments.cli.console import (
    LEFT_OUT,
    Run,
    notice_unused_calibration,
    notices,
    output_folder,
    write_manifest,
)  # fmt: skip
from trackwright.experiments.cli.options import TrackOptions, config, file_format
from trackwright.experiments.pages.reports.pages import typed
from trackwright.experiments.pages.reports.track import PAGE, run_data, write_track_page
from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.experiments.text.evaluation_text import content, to_json, to_text
from trackwright.experiments.text.tables import terminal_width
from trackwright.experiments.text.terminal import Begin, notice
from trackwright.experiments.text.wording import figures_drawn, uncapitalised
from trackwright.trackers.catalogue import several, spec_of, tracked_by
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.run.chunks import CHUNK
from trackwright.trackers.core.user_file import split_name
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.cautions import level_caution
from trackwright.trackers.evaluation.events import EVENTS
from trackwright.trackers.evaluation.scored_run import ScoredRun
from trackwright.trackers.programs.process_settings import give_back
from trackwright.trackers.recordings.atomic import Content, write_whole
from trackwright.trackers.recordings.tracks_table import EVALUATION, RESULTS, SOURCES, TRACKS, sources_text
from trackwright.trackers.recordings.trajectories import known_height


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


def files_of(found: ScoredRun, evaluation: tw.Evaluation) -> dict[str, Content]:
    """The files of a run folder."""
    paths = sources_text(folder.path for folder in found.folders)
    return {TRACKS: found.tracks.table, EVENTS: found.events, SOURCES: paths, EVALUATION: to_json(evaluation)}


def tracked(
    named: tw.NamedTracker, folders: Sequence[tw.RecordingFolder], options: TrackOptions, begin: Begin
) -> tuple[ScoredRun, list[str]]:
    """Runs a tracker on recordings, valued, fitted and smoothed as options ask for; and a line for each fit."""
    named, fits = options.valued(named), list[str]()
    parts: list[tuple[tw.NamedTracker, Sequence[tw.RecordingFolder]]] = [(named, folders)]
    if options.fit:
        parts, advance = [], begin("fitting", len(folders))
        for folder in folders:
            own = tw.fitted(named, folder)
            parts.append((own.tracker, [folder]))
            fits.append(own.line)
            advance(1)
    if options.smooth or options.lag is not None:
        parts = [(one.smoothing(options.lag), of) for one, of in parts]
    give_back()
    return ScoredRun.of(parts, options.seed, begin), fits


def track_together(
    folders: Sequence[tw.RecordingFolder], refused: Sequence[str], options: TrackOptions, run: Run
) -> int:
    """Tracks the recordings, writes all files and prints the metrics; the exit code. Several trackers get a folder
    each; those that the user named are compared."""
    chosen = options.numbers.tracker is None
    runs, unfit = tracked_by(folders, named_runs(options))
    for name, of in runs.items() if chosen else ():
        _notice_choice(name, of, options)
    with suppress(OSError):
        (options.out / RESULTS).unlink(missing_ok=True)  # left by an earlier archive
    together, pages = 1 if chosen else len(runs), list[dict[str, Any]]()
    for name, of in runs.items():
        out = options.out if len(runs) == 1 else options.out / short(name)
        pages += _track(name, of, options, out, run, together)
    if together > 1:
        run.begin("comparison")
        from trackwright.experiments.cli.evaluating import print_comparison

        if pages:
            _write_page(options.out, pages)
            print(f"wrote {options.out / PAGE}")
        shown = options.figures != "none"
        print_comparison(
            [options.out / short(name) for name in runs],
            options.out,
            file_format(options.figures),
            page=shown,
            playback=PAGE if shown else None,
        )
    for line in (*refused, *unfit):
        notice(f"not tracked: {line}")
    return LEFT_OUT if refused or unfit else 0


def _notice_choice(name: str, folders: Sequence[tw.RecordingFolder], options: TrackOptions) -> None:
    """Says which tracker was chosen for recordings, and what it leaves unread."""
    if options.named is not None:
        notice(f"tracker: {name}, by {options.noise}; choose another with --tracker")
        return
    spec = spec_of(name)
    unread = {table for folder in folders for table in folder.tables if table not in spec.reads | {"imu", "truth"}}
    without = f"; without {listed(sorted(unread))}" if unread else ""
    notice(f"tracker: {name} ({spec.about}{without}); choose another with --tracker")


def _track(
    name: str, folders: Sequence[tw.RecordingFolder], options: TrackOptions, out: Path, run: Run, of: int
) -> list[dict[str, Any]]:
    """Tracks recordings with one of `of` trackers into the folder `out`; its page, if there is to be one."""
    named = tw.build(name, folders, options.numbers.free_height, options.numbers.side)
    notice_unused_calibration(folders, name, named.spec.table)
    found, fits = tracked(named, folders, options, run.begin)
    evaluation, endings = found.evaluation, found.tracks.summaries
    for line in fits:
        notice(line)
    flat = [one for batch in found.tracks.batches if batch.planar for one in batch.trajectories]
    heights = sum(known_height(trajectory.folder, trajectory.tag) is not None for trajectory in flat)
    if heights and not named.spec.bearing_only:
        notice(f"height: known from rig.toml for {counted(heights, 'tag')} and used; estimate it with --free-height")
    notices(found.notices)
    for file, rows in files_of(found, evaluation).items():
        write_whole(output_folder(out) / file, rows)
    whose = "" if out == options.out else f"{short(name)}: "
    print(f"{whose}{counted(sum(endings.values()), 'track')}: {words_of(endings)}")
    pages = list[dict[str, Any]]()

    def show() -> list[str]:
        if options.figures != "none":
            run.begin("report")
            pages.append(page_of(found, evaluation, of))
        drawn = write_shown(scored(found), pages, options, out, run) if of == 1 else []
        for event, count in found.events.group_by("event", maintain_order=True).len().iter_rows():
            print(f"event: {event} ({counted(count, 'time')})")
        return drawn

    about = {"recordings": [str(folder.path) for folder in folders], "verdicts": endings, "fitted": fits}
    text = partial(to_text, evaluation, terminal_width()) if of == 1 else str
    end_run(name, evaluation, text, show, len(found.rows), about, options, out, run)
    return pages


def end_run(
    name: str, evaluation: tw.Evaluation, text: Callable[[], str], show: Callable[[], list[str]], rows: int,
    about: Mapping[str, Any], options: TrackOptions, out: Path, run: Run,
) -> None:  # fmt: skip
    """Prints the metrics of a tracker as `text`, or without truth what innovations show; what `show` draws is written,
    and the manifest, with what is `about` the run. A notice where noise levels seem wrong."""
    if evaluation.overall["n"]:
        print(text(), end="")
    else:
        for sentence in evaluation.statements:
            print(f"Without truth: {uncapitalised(sentence)}")
    if not options.fit and (wrong := level_caution(evaluation.overall)):
        notice(f"notice: innovations are {wrong}; --fit fits noise levels to the readings")
    run.put({short(name): content(evaluation)})
    drawn = show()
    used = config(options, "cluster", "force", "keep_going", "set_") | {"tracker": name, "set": options.numbers.values}
    write_manifest(out, used, run.started, chunk=CHUNK, **about)
    written = [f"{out / TRACKS} ({counted(rows, 'estimate')})", EVENTS, EVALUATION, "manifest.json", *drawn]
    print(f"wrote {', '.join(written)}")


def words_of(endings: Mapping[str, int]) -> str:
    """How many tracks ended how, the most first."""
    return "; ".join(f"{n} {words}" for words, n in sorted(endings.items(), key=lambda x: -x[1]))


def scored(found: ScoredRun) -> ScoredTracks:
    """The tracks as the page and the figures show them."""
    return ScoredTracks(found.rows, found.folders, found.tracks.batches)


def page_of(found: ScoredRun, evaluation: tw.Evaluation, of: int) -> dict[str, Any]:
    """The data of the page of one of `of` trackers."""
    name, known = found.named.name, evaluation if evaluation.overall["n"] else None
    return run_data(scored(found), found.events, known, f"{name}: {found.named.spec.about}", short(name), of)


def write_shown(
    tracks: ScoredTracks, pages: Sequence[Mapping[str, Any]], options: TrackOptions, out: Path, run: Run
) -> list[str]:
    """Writes the page, if any, and the figures that are asked for; in words, what was written."""
    written = []
    if pages:
        _write_page(out, pages)
        written.append(PAGE)
    if kind := file_format(options.figures):
        run.begin("figures")
        # matplotlib takes a third of a second to import.
        from trackwright.experiments.pages.charts.recording import plot_tracks

        written.append(figures_drawn(plot_tracks(out, tracks, kind)))
    return written


def _write_page(out: Path, pages: Sequence[Mapping[str, Any]]) -> None:
    write_track_page(out / PAGE, pages, typed(sys.argv))
