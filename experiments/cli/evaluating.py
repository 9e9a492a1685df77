"""What `trackwright evaluate` does with folders and files of estimates: metrics, pose errors, comparing."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.experiments.cli.console import LEFT_OUT, notices, output_folder
from trackwright.experiments.cli.options import EvaluateOptions
from trackwright.experiments.text.tables import (
    archive_text,
    content,
    pose_errors_text,
    sections_text,
    terminal_width,
    to_json,
    to_text,
)
from trackwright.experiments.text.terminal import notice
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import (
    Evaluation,
    condition_of,
    evaluate,
    metric_names,
    rows_of,
    violation,
)
from trackwright.trackers.recordings.atomic import json_text, write_whole
from trackwright.trackers.recordings.folder import RecordingFolder, read_recordings
from trackwright.trackers.recordings.tracks_table import (
    EVALUATION,
    RECORDINGS,
    RESULTS,
    TRACKS,
    read_archive,
    read_tracks,
    require_sources,
)

COMPARISON = "comparison.html"  # the page that compares runs


def evaluate_run(folder: Path, options: EvaluateOptions) -> int:
    """Evaluates an output folder of `track`, or the runs in it, prints the errors and writes evaluation.json.

    Returns the exit code: 1 where `--fail-if` holds, else 3 where recordings of an archive are left out.
    """
    if (folder / RECORDINGS).is_dir() and not (folder / RESULTS).is_file():
        raise UnusableInput(f"{folder}: an archive that was not tracked to its end; run the same `track` again")
    runs = [folder] if (folder / TRACKS).exists() else sorted(path.parent for path in folder.glob(f"*/{TRACKS}"))
    archive, failed, found = (folder / RESULTS).is_file() and not options.truth, False, dict[str, Any]()
    known, refused = read_archive(folder) if archive else (read_recordings(options.truth) if options.truth else [], [])
    for run in runs or [folder]:
        tracks = options.used.part.of_estimates(read_tracks(run))
        truths = known or read_recordings(require_sources(run))
        if options.fail_if is not None:
            condition_of(options.fail_if, metric_names(tracks))
        evaluation = evaluate(tracks, truths)
        write_whole(run / EVALUATION, to_json(evaluation))
        found[run.name] = content(evaluation)
        if not options.json:
            print((archive_text if archive else to_text)(evaluation, terminal_width()), end="")
        failed |= bool(code_of(evaluation, options.fail_if, f"{run.name}: " if len(runs) > 1 else ""))
    if options.json:
        print(json_text(found if len(runs) > 1 else found.popitem()[1]), end="")
    for line in refused:
        notice(f"not evaluated: {line}")
    return 1 if failed else LEFT_OUT if refused else 0


def code_of(evaluation: Evaluation, fail_if: str | None, whose: str = "") -> int:
    """The exit code, 1 with a notice where the condition holds; `whose`: a tracker's name before it."""
    why = None if fail_if is None else violation(evaluation, fail_if)
    if why is not None:
        print(f"fails: {whose}{why}", file=sys.stderr)
    return int(why is not None)


def print_comparison(
    folders: Sequence[Path], out: Path | None, kind: str | None = None, json: bool = False, page: bool = True,
    playback: str | None = None,
) -> None:  # fmt: skip
    """Prints the comparison of the runs in these folders, and writes its page and figures into the folder `out`.
    `kind`: the ending of the figures, None for none. `playback`: another page beside it, which it names."""
    # Reading errors of tracks and drawing take a second to import, which a refused command need not wait for.
    from trackwright.experiments.pages.comparison import (
        WIDTH,
        comparison,
        comparison_charts,
        lone_subjects,
        read_runs,
        write_comparison,
    )

    runs, lines = read_runs(folders)
    tables, contrasts = comparison(runs)
    notices([*lines, *lone_subjects(runs)])
    if json:
        differences = [contrast._asdict() | {"difference": contrast.difference._asdict()} for contrast in contrasts]
        shown = [dict(zip(table._fields[:-1], table[:-1], strict=True)) for table in tables]
        print(json_text({"tables": shown, "contrasts": differences}), end="")
    else:
        print(sections_text(tables, WIDTH), end="")
    if out is None:
        return
    path, charts = output_folder(out) / COMPARISON, comparison_charts(runs)
    written = list[str]()
    if kind is not None:
        # matplotlib takes a third of a second to import.
        from trackwright.experiments.pages.chart import write_charts

        written += write_charts(out, charts, kind, f"{path.stem}-")
    if page:
        written.insert(0, write_comparison(path, [run.name for run in runs], tables, charts, sys.argv, playback).name)
    if written and not json:
        print(f"wrote {', '.join([str(out / written[0]), *written[1:]])}")


def evaluate_poses(source: Path, truth: Sequence[Path], options: EvaluateOptions) -> int:
    """Evaluates a file of estimates or a folder of `track`; prints the errors, and writes them with `--out`."""
    from trackwright.trackers.exchange.trajectories import STEPS, compare_tracks, read_poses

    given, align, steps = options.poses, options.poses.align or "none", options.poses.rpe or STEPS
    tolerance = 0.01 if given.time_tolerance is None else given.time_tolerance
    tracks, folders = read_poses(source, truth, options.used.part, lambda line: notices([line]))
    if options.fail_if is not None:
        condition_of(options.fail_if, metric_names(tracks))
    moved, compared, evaluation = compare_tracks(tracks, folders, align, given.time_offset, tolerance, steps)
    errors = {"poses": {"align": align, "tracks": [track.to_dict() for track in compared]}}
    text, width = json_text(content(evaluation) | errors), terminal_width()
    shown = f"{to_text(evaluation, width)}\n{pose_errors_text(compared, align, width)}"
    print(text if options.json else shown, end="")
    if given.out is not None:
        written = _write(output_folder(given.out), text, evaluation, moved, folders, str(source))
        if not options.json:
            print(written)
    return code_of(evaluation, options.fail_if)


def _write(
    out: Path, text: str, evaluation: Evaluation, tracks: pl.DataFrame, folders: Sequence[RecordingFolder], source: str
) -> str:
    """Writes the files of `--out`; in words, which."""
    from trackwright.experiments.pages.report import typed
    from trackwright.experiments.pages.scored_tracks import ScoredTracks
    from trackwright.experiments.pages.track import PAGE, run_data, write_track_page
    from trackwright.trackers.recordings.tracks_table import SOURCES, sources_text

    write_whole(out / EVALUATION, text)
    write_whole(out / TRACKS, tracks)
    if paths := [folder.path for folder in folders if folder.path is not None and folder.path.is_dir()]:
        write_whole(out / SOURCES, sources_text(paths))
    scored = ScoredTracks(rows_of(tracks, folders), folders, ())
    run = run_data(scored, evaluation, source)
    write_track_page(out / PAGE, [run], typed(sys.argv), "evaluate")
    return f"wrote {out}: {PAGE}, {EVALUATION}, and {TRACKS} as compared"
