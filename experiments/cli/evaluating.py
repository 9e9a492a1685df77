"""What `trackwright evaluate` does with folders and files of estimates: metrics, pose errors, comparing."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import polars as pl

from trackwright.experiments.cli.console import LEFT_OUT, notices, output_folder, prepared, running
from trackwright.experiments.cli.options import EvaluateOptions, Readings
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
from trackwright.trackers.evaluation.evaluate import (
    Evaluation,
    condition_of,
    evaluate,
    metric_names,
    rows_of,
    violation,
)
from trackwright.trackers.recordings.archives import read_archive
from trackwright.trackers.recordings.atomic import held, json_text, write_whole
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks_table import EVALUATION, TRACKS, read_tracks, require_sources

COMPARISON = "comparison.html"  # the page that compares runs


def evaluate_folder(folder: Path, options: EvaluateOptions) -> int:
    """Evaluates an output folder of `track`, prints the errors and writes evaluation.json; the exit code."""
    tracks = options.used.part.of_estimates(read_tracks(folder))
    folders = prepared(options.truth or require_sources(folder), Readings(), check=False)
    evaluation = _evaluated(folder, tracks, folders, options)
    print(to_json(evaluation) if options.json else to_text(evaluation, terminal_width()), end="")
    return code_of(evaluation, options.fail_if)


def evaluate_archive(out: Path, options: EvaluateOptions) -> int:
    """Evaluates the tracks of an archive again, by tracker, and writes each evaluation.json; the exit code."""
    rows, truths, refused = read_archive(out)
    several, failed = rows["tracker"].n_unique() > 1, False
    with held(out), running("evaluate", options.json) as run:
        for (tracker,), of in rows.group_by("tracker", maintain_order=True):
            folder = out / str(tracker) if several else out
            tracks = options.used.part.of_estimates(read_tracks(folder))
            known = [truths[name] for name in of["recording"] if name in truths]
            evaluation = _evaluated(folder, tracks, known, options)
            print(archive_text(evaluation, terminal_width()), end="")
            run.put({str(tracker): content(evaluation)})
            failed |= bool(code_of(evaluation, options.fail_if, f"{tracker}: "))
    for line in refused:
        notice(f"not evaluated: {line}")
    return 1 if failed else LEFT_OUT if refused else 0


def _evaluated(
    folder: Path, tracks: pl.DataFrame, truths: Sequence[RecordingFolder], options: EvaluateOptions
) -> Evaluation:
    """The metrics of the tracks in a folder, written there; the condition of `--fail-if` is read before."""
    if options.fail_if is not None:
        condition_of(options.fail_if, metric_names(tracks))
    evaluation = evaluate(tracks, truths)
    write_whole(folder / EVALUATION, to_json(evaluation))
    return evaluation


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
        written.insert(0, write_comparison(path, [*runs], tables, charts, sys.argv, playback).name)
    if written and not json:
        print(f"wrote {', '.join([str(out / written[0]), *written[1:]])}")


def evaluate_poses(source: Path, truth: Sequence[Path], options: EvaluateOptions) -> int:
    """Evaluates a file of estimates or a folder of `track`; prints the errors, and writes them with `--out`."""
    from trackwright.trackers.exchange.estimates import pooled_names
    from trackwright.trackers.exchange.pose_evaluation import STEPS, Poses

    given, align, steps = options.poses, options.poses.align or "none", options.poses.rpe or STEPS
    tolerance = 0.01 if given.time_tolerance is None else given.time_tolerance
    poses = Poses.read(source, truth, options.used.part, align == "none", lambda line: notices([line]))
    if options.fail_if is not None:
        condition_of(options.fail_if, [*metric_names(poses.tracks), *pooled_names(steps)])
    moved, compared, evaluation = poses.compared(align, given.time_offset, tolerance, steps, given.all_pairs)
    errors = {"poses": {"align": align, "tracks": [track.to_dict() for track in compared]}}
    text, width = json_text(content(evaluation) | errors), terminal_width()
    shown = f"{to_text(evaluation, width)}\n{pose_errors_text(compared, align, width, given.time_offset == 'auto')}"
    print(text if options.json else shown, end="")
    if given.out is not None:
        written = _write(output_folder(given.out), text, evaluation, moved, poses.folders, str(source))
        if not options.json:
            print(written)
    return code_of(evaluation, options.fail_if)


def _write(
    out: Path, text: str, evaluation: Evaluation, tracks: pl.DataFrame, folders: Sequence[RecordingFolder], source: str
) -> str:
    """Writes the files of `--out`; in words, which."""
    from trackwright.experiments.pages.report import typed
    from trackwright.experiments.pages.scored_tracks import ScoredTracks
    from trackwright.experiments.pages.track import NO_EVENTS, PAGE, run_data, write_track_page
    from trackwright.trackers.recordings.tracks_table import SOURCES, sources_text

    write_whole(out / EVALUATION, text)
    write_whole(out / TRACKS, tracks)
    if paths := [folder.path for folder in folders if folder.path is not None and folder.path.is_dir()]:
        write_whole(out / SOURCES, sources_text(paths))
    scored = ScoredTracks(rows_of(tracks, folders), folders, ())
    run = run_data(scored, NO_EVENTS, evaluation, source)
    write_track_page(out / PAGE, [run], typed(sys.argv), "evaluate")
    return f"wrote {out}: {PAGE}, {EVALUATION}, and {TRACKS} as compared"
