"""What `trackwright evaluate` does with folders and files of estimates: metrics, pose errors, conditions, comparing."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import polars as pl

from trackwright.experiments.cli.console import output_folder, read_with_notices
from trackwright.experiments.cli.options import EvaluateOptions, require_output
from trackwright.experiments.text.evaluation_text import content, pose_errors_text, to_json, to_text
from trackwright.experiments.text.tables import sections_text, terminal_width
from trackwright.experiments.text.terminal import notice
from trackwright.trackers.core.errors import UnusableInput, near
from trackwright.trackers.evaluation.evaluate import Evaluation, evaluate, metric_names, rows_of
from trackwright.trackers.recordings.atomic import atomic_write, json_text
from trackwright.trackers.recordings.checks.units import check_units
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks_table import (
    EVALUATION,
    SOURCES,
    TRACKS,
    read_tracks,
    source_paths,
    write_tracks,
)

COMPARISON = "comparison.html"  # the page that compares runs
DEFAULT_STEPS = ("1m", "1s")
DEFAULT_TOLERANCE = 0.01
FILE_TAG = "1"  # tag of a truth in a file that names none


def evaluate_folder(folder: Path, options: EvaluateOptions) -> int:
    """Evaluates an output folder of `track`, prints the errors and writes evaluation.json; the exit code."""
    part = options.used.part
    tracks = part.of_estimates(read_tracks(folder))
    folders = read_with_notices(options.truth or sources(folder))
    if options.fail_if is not None:
        condition_of(options.fail_if, metric_names(tracks))
    evaluation = evaluate(tracks, folders)
    text = to_json(evaluation)
    atomic_write(folder / EVALUATION, lambda path: path.write_text(text, encoding="utf-8"))
    print(text if options.json else to_text(evaluation, terminal_width()), end="")
    return code_of(evaluation, options.fail_if)


def print_comparison(
    folders: Sequence[Path], out: Path | None, kind: str | None = None, json: bool = False, page: bool = True,
    playback: str | None = None,
) -> None:  # fmt: skip
    """Prints the comparison of the runs in these folders, and writes its page and figures into the folder `out`.
    `kind`: the ending of the figures, None for none. `playback`: another page beside it, which it names."""
    # Reading errors of tracks and drawing take a second to import, which a refused command need not wait for.
    from trackwright.experiments.pages.charts.drawing import write_charts
    from trackwright.experiments.pages.reports.comparison import (
        WIDTH,
        comparison,
        comparison_charts,
        lone_subjects,
        read_runs,
        write_comparison,
    )

    runs, notices = read_runs(folders)
    tables, contrasts = comparison(runs)
    for text in (*notices, *lone_subjects(runs)):
        notice(f"notice: {text}")
    if json:
        differences = [contrast._asdict() | {"difference": contrast.difference._asdict()} for contrast in contrasts]
        shown = [dict(zip(table._fields[:-1], table[:-1], strict=True)) for table in tables]
        print(json_text({"tables": shown, "contrasts": differences}), end="")
    else:
        print(sections_text(tables, WIDTH), end="")
    if out is None:
        return
    path = output_folder(out) / COMPARISON
    charts = comparison_charts(runs)
    written = [] if kind is None else write_charts(out, charts, kind, f"{path.stem}-")
    if page:
        written.insert(0, write_comparison(path, [run.name for run in runs], tables, charts, sys.argv, playback).name)
    if written and not json:
        print(f"wrote {', '.join([str(out / written[0]), *written[1:]])}")


def code_of(evaluation: Evaluation, fail_if: str | None, whose: str = "") -> int:
    """The exit code, 1 with a notice where the condition holds; `whose`: a tracker's name before it."""
    why = None if fail_if is None else violation(evaluation, fail_if)
    if why is not None:
        print(f"fails: {whose}{why}", file=sys.stderr)
    return int(why is not None)


def sources(folder: Path) -> tuple[Path, ...]:
    """The recordings tracked into an output folder; raises UnusableInput if it does not list them."""
    paths = source_paths(folder)
    where, fix = folder / SOURCES, "give --truth RECORDING"
    if not paths:
        raise UnusableInput(f"{where}: names no recording; expected a folder written by `track`; {fix}")
    if moved := [path for path in paths if not path.exists()]:
        raise UnusableInput(f"{where}: {moved[0]} does not exist; expected the recordings there; {fix}")
    return tuple(paths)


def evaluate_poses(source: Path, truth: Sequence[Path], options: EvaluateOptions) -> int:
    """Evaluates a file of estimates or a folder of `track`; prints the errors, and writes them with `--out`."""
    part, poses = options.used.part, options.poses
    offset = poses.offset
    if poses.out is not None:
        require_output(poses.out)
    if source.is_file() and len(part.tags) > 1:
        raise UnusableInput(f"--tag {' '.join(part.tags)}: a file of estimates follows one tag; expected one")
    tag, name, tracks = part.tags[0] if part.tags else None, None, None
    if source.is_dir():
        tracks = part.of_estimates(read_tracks(source))
        followed = tracks.select("recording", "tag").unique()
        if len(followed) == 1:
            name, tag = followed.row(0)
    folders = _read_truth(truth, tag, name)
    truths = {folder.name: folder.tables["truth"] for folder in folders if "truth" in folder.tables}
    if not truths:
        raise UnusableInput(f"{truth[0]}: no truth table; expected a recording with truth, or a trajectory file")
    if tracks is None:
        from trackwright.trackers.exchange.estimates import assigned, read_estimates

        read, notices = read_estimates(source)
        for line in notices:
            notice(f"notice: {source}: {line}")
        tracks = part.of_estimates(assigned(read, truths, tag, source))
        # Of a truth in a file, there is no geometry beside which estimates may be large.
        for folder in (folder for folder in folders if folder.rig.places() and poses.align is None):
            for result in check_units(folder.rig, {"fixes": tracks.filter(pl.col("recording") == folder.name)}):
                notice(f"notice: {source}: {result.message}")
    from trackwright.trackers.exchange.estimates import compare_tracks, pooled, pooled_names

    steps = poses.rpe or DEFAULT_STEPS
    if options.fail_if is not None:
        condition_of(options.fail_if, [*metric_names(tracks), *pooled_names(steps)])
    align = poses.align or "none"
    tolerance = DEFAULT_TOLERANCE if poses.time_tolerance is None else poses.time_tolerance
    moved, compared = compare_tracks(tracks, truths, align, offset, tolerance, steps, poses.all_pairs)
    evaluation = evaluate(moved, folders)
    evaluation = dataclasses.replace(evaluation, overall=evaluation.overall | pooled(compared))
    text = json_text(
        content(evaluation) | {"poses": {"align": align, "tracks": [track.to_dict() for track in compared]}}
    )
    width = terminal_width()
    if options.json:
        print(text, end="")
    else:
        print(f"{to_text(evaluation, width)}\n{pose_errors_text(compared, align, width, offset == 'auto')}", end="")
    if poses.out is not None:
        written = _write(poses.out, text, evaluation, moved, folders, truth, str(source))
        if not options.json:
            print(written)
    return code_of(evaluation, options.fail_if)


def _read_truth(paths: Sequence[Path], tag: str | None, name: str | None) -> list[RecordingFolder]:
    """The recordings, or the one path of a trajectory file as of a tag and a recording, where they are known."""
    if not paths:
        raise UnusableInput("no --truth; expected recording folders, or a trajectory file: --truth FOLDER|FILE")
    for path in paths:
        if not path.exists():
            raise UnusableInput(f"--truth {path}: does not exist; expected a recording folder, or a trajectory file")
    files = [path for path in paths if path.is_file()]
    if not files:
        return read_with_notices(paths)
    if len(paths) > 1:
        raise UnusableInput(f"--truth {files[0]} and others; expected one trajectory file, or recording folders")
    from trackwright.trackers.exchange.estimates import read_truth

    folder = read_truth(files[0], tag or FILE_TAG)
    for line in folder.notices:
        notice(f"notice: {files[0]}: {line}")
    return [folder if name is None else dataclasses.replace(folder, name=name)]


def _write(
    out: Path, text: str, evaluation: Evaluation, tracks: pl.DataFrame, folders: Sequence[RecordingFolder],
    truth: Sequence[Path], source: str,
) -> str:  # fmt: skip
    """Writes the files of `--out`; returns in words which."""
    from trackwright.experiments.pages.reports.track import PAGE, run_data, write_track_page
    from trackwright.experiments.pages.scored_tracks import ScoredTracks

    output_folder(out)
    atomic_write(out / EVALUATION, lambda path: path.write_text(text, encoding="utf-8"))
    atomic_write(out / TRACKS, lambda path: write_tracks(tracks, path))
    if all(path.is_dir() for path in truth):
        names = "".join(f"{path.resolve()}\n" for path in truth)
        atomic_write(out / SOURCES, lambda path: path.write_text(names, encoding="utf-8"))
    scored = ScoredTracks(rows_of(tracks, folders), folders, ())
    none = pl.DataFrame(schema={"recording": pl.String, "tag": pl.String, "t_s": pl.Float64, "event": pl.String})
    run = run_data(scored, none, evaluation, source)
    write_track_page(out / PAGE, [run], shlex.join(["trackwright", *sys.argv[1:]]), "evaluate")
    return f"wrote {out}: {PAGE}, {EVALUATION}, and {TRACKS} as compared"


def condition_of(expression: str, names: Sequence[str]) -> pl.Expr:
    """The condition of an expression of SQL on metrics of these names; raises UnusableInput for no such one."""
    where, used, problem = f"--fail-if '{expression}'", list[str](), "is no condition on metrics"
    try:
        condition = pl.sql_expr(expression)
        used = condition.meta.root_names()
        fits = pl.DataFrame({name: [0.0] for name in used}).select(condition).dtypes == [pl.Boolean] and used
    except pl.exceptions.PolarsError as error:
        fits, problem = False, f"cannot be read ({str(error).splitlines()[0]})"
    if unknown := [name for name in used if name not in names]:
        raise UnusableInput(f"{where}: no metric '{unknown[0]}'{near(unknown[0], names)}; names: {', '.join(names)}")
    if not fits:
        fix = f"expected NAME OPERATOR NUMBER joined by and, or, e.g. p95_m>0.5; names: {', '.join(names)}"
        raise UnusableInput(f"{where}: {problem}; {fix}")
    return condition


def violation(evaluation: Evaluation, expression: str) -> str | None:
    """The condition and its metrics, None where it is false; raises UnusableInput for a metric without a value, too."""
    condition, overall = condition_of(expression, list(evaluation.overall)), evaluation.overall
    values = {name: overall[name] for name in condition.meta.root_names()}
    if lacking := [name for name, value in values.items() if value is None]:
        present = ", ".join(key for key, value in overall.items() if value is not None)
        words = f"'{lacking[0]}' has no value for these tracks; metrics with a value: {present}"
        raise UnusableInput(f"--fail-if '{expression}': {words}")
    if not pl.DataFrame([values]).select(condition).item():
        return None
    return f"{expression} ({', '.join(f'{name} is {value:.6g}' for name, value in values.items())})"
