"""What `trackwright evaluate` does with folders and files of estimates: metrics, pose errors, comparing."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from trackwright.experiments.cli.console import LEFT_OUT, notices, output_folder
from trackwright.experiments.cli.options import EvaluateOptions
from trackwright.experiments.text import tables as text
from trackwright.experiments.text.terminal import notice
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import Evaluation, condition_of, evaluate, metric_names, violation
from trackwright.trackers.recordings.files import json_text, write_whole
from trackwright.trackers.recordings.folder import read_recordings
from trackwright.trackers.recordings.tracks_table import EVALUATION, RECORDINGS, RESULTS, read_archive, read_tracks
from trackwright.trackers.recordings.tracks_table import require_sources as sources_of


def evaluate_run(run: Path, options: EvaluateOptions) -> int:
    """Evaluates an output folder of `track`, prints the errors and writes evaluation.json.

    Returns the exit code: 1 where `--fail-if` holds, else 3 where recordings of an archive are left out unasked.
    """
    archive = (run / RECORDINGS).is_dir() and not options.truth
    if archive and not (run / RESULTS).is_file():
        raise UnusableInput(f"{run}: an archive that was not tracked to its end; run the same `track` again")
    tracks = options.used.part.of_estimates(read_tracks(run))
    truths, refused = read_archive(run) if archive else (read_recordings(options.truth or sources_of(run)), [])
    if options.fail_if is not None:
        condition_of(options.fail_if, metric_names(tracks))
    evaluation = evaluate(tracks, truths)
    write_whole(run / EVALUATION, text.to_json(evaluation))
    shown = (text.archive_text if archive else text.to_text)(evaluation, text.terminal_width())
    print(text.to_json(evaluation) if options.json else shown, end="")
    for line in refused:
        notice(f"not evaluated: {line}")
    return code_of(evaluation, options.fail_if) or (LEFT_OUT if refused and not options.allow_left_out else 0)


def code_of(evaluation: Evaluation, fail_if: str | None) -> int:
    """The exit code, 1 with a notice where the condition holds."""
    why = None if fail_if is None else violation(evaluation, fail_if)
    if why is not None:
        print(f"fails: {why}", file=sys.stderr)
    return int(why is not None)


def print_comparison(folders: Sequence[Path], out: Path | None) -> None:
    """Prints the comparison of the runs in these folders, and writes its page into the folder `out`."""
    # Reading errors of tracks and drawing take a second to import, which a refused command need not wait for.
    from trackwright.experiments.pages import comparison as pages

    runs, lines = pages.read_runs(folders)
    tables, _ = pages.comparison(runs)
    notices([*lines, *pages.lone_subjects(runs)])
    print(text.sections_text(tables, pages.WIDTH), end="")
    if out is not None:
        names, charts, page = [*runs], pages.comparison_charts(runs), "comparison.html"
        print(f"wrote {pages.write_comparison(output_folder(out) / page, names, tables, charts, sys.argv)}")


def evaluate_poses(source: Path, options: EvaluateOptions) -> int:
    """Evaluates a file of estimates or a folder of `track`, prints the errors; the exit code."""
    from trackwright.trackers.exchange.trajectories import STEPS, compare_tracks, read_poses

    truth = options.truth if options.truth or source.is_file() else sources_of(source)
    align, steps, offset = options.align or "none", options.rpe or STEPS, options.time_offset
    tracks, folders = read_poses(source, truth, options.used.part, lambda line: notices([line]))
    if options.fail_if is not None:
        condition_of(options.fail_if, metric_names(tracks))
    _, compared, evaluation = compare_tracks(tracks, folders, align, offset, options.time_tolerance, steps)
    errors = {"poses": {"align": align, "tracks": [track.to_dict() for track in compared]}}
    width = text.terminal_width()
    if options.json:
        print(json_text(text.content(evaluation) | errors), end="")
    else:
        print(f"{text.to_text(evaluation, width)}\n{text.pose_errors_text(compared, align, width)}", end="")
    return code_of(evaluation, options.fail_if)
