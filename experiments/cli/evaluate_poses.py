"""`trackwright evaluate` of a trajectory file, or with an alignment: all metrics, and pose errors as in evo."""

from __future__ import annotations

import dataclasses
import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import polars as pl

from experiments.cli.console import output_folder, read_with_notices, require_output
from experiments.text.tables import terminal_width
from experiments.text.terminal import notice
from trackers.core.errors import UnusableInput
from trackers.core.wording import counted
from trackers.exchange.alignment import Alignment
from trackers.exchange.estimate_files import assigned, read_estimates, read_truth
from trackers.exchange.tracks_compared import compare_tracks, pooled, pooled_names
from trackers.recordings.atomic import atomic_write, json_text
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.selection import Selection
from trackers.recordings.tracks_table import TRACKS, read_tracks, write_tracks

if TYPE_CHECKING:
    from trackers.evaluation.evaluate import Evaluation

DEFAULT_STEPS = ("1m", "1s")
DEFAULT_TOLERANCE = 0.01
FILE_TAG = "1"
"""Tag of a truth in a file that names none."""


@dataclass(frozen=True)
class PoseOptions:
    """The options of the comparison; None and empty where they were not given."""

    align: Alignment | None = None
    time_offset: str | None = None
    time_tolerance: float | None = None
    rpe: tuple[str, ...] = ()
    all_pairs: bool = False
    out: Path | None = None

    @property
    def given(self) -> bool:
        """Whether any was given."""
        return self != PoseOptions()

    @property
    def offset(self) -> float | Literal["auto"]:
        """The time offset, s; raises UnusableInput for another text."""
        if self.time_offset in (None, "auto"):
            return 0.0 if self.time_offset is None else "auto"
        try:
            seconds = float(self.time_offset or "")
        except ValueError:
            seconds = math.nan
        if not math.isfinite(seconds):
            raise UnusableInput(f"--time-offset {self.time_offset}: expected seconds, or auto")
        return seconds


def evaluate_poses(
    source: Path, truth: Sequence[Path], options: PoseOptions, part: Selection, json: bool, fail_if: str | None
) -> int:
    """Evaluates a file of estimates or a folder of `track`; prints the errors, and writes them with `--out`."""
    offset = options.offset
    if options.out is not None:
        require_output(options.out)
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
        read, notices = read_estimates(source)
        for line in notices:
            notice(f"notice: {source}: {line}")
        tracks = part.of_estimates(assigned(read, truths, tag, source))
    # jax takes a second to import, which a refused file need not wait for.
    from experiments.cli.fail_if import conditions, violation
    from experiments.pages.reports.trajectory_text import to_text as poses_text
    from experiments.text.evaluation_text import to_text
    from trackers.evaluation.evaluate import evaluate, metric_names

    steps = options.rpe or DEFAULT_STEPS
    if fail_if is not None:
        conditions(fail_if, [*metric_names(tracks), *pooled_names(steps)])
    align = options.align or "none"
    tolerance = DEFAULT_TOLERANCE if options.time_tolerance is None else options.time_tolerance
    moved, compared = compare_tracks(tracks, truths, align, offset, tolerance, steps, options.all_pairs)
    evaluation = evaluate(moved, folders, part.every)
    evaluation = dataclasses.replace(evaluation, overall=evaluation.overall | pooled(compared))
    content = {
        "kind": "position",
        "statements": evaluation.statements,
        "overall": evaluation.overall,
        "recordings": evaluation.recordings,
        "tracks": evaluation.tracks,
        "poses": {"align": align, "tracks": [track.to_dict() for track in compared]},
    }
    text = json_text(content)
    width = terminal_width()
    print(
        text if json else to_text(evaluation, width) + "\n" + poses_text(compared, align, width, offset == "auto"),
        end="",
    )
    if options.out is not None:
        written = _write(options.out, text, evaluation, moved, folders, truth, str(source))
        if not json:
            print(written)
    why = None if fail_if is None else violation(evaluation, fail_if)
    if why is not None:
        notice(f"fails: {why}")
    return int(why is not None)


def _read_truth(paths: Sequence[Path], tag: str | None, name: str | None) -> list[RecordingFolder]:
    """The recordings, or the one path of a trajectory file as that of a tag and a recording, where they are known."""
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
    folder = read_truth(files[0], tag or FILE_TAG)
    for line in folder.notices:
        notice(f"notice: {files[0]}: {line}")
    return [folder if name is None else dataclasses.replace(folder, name=name)]


def _write(
    out: Path,
    text: str,
    evaluation: Evaluation,
    tracks: pl.DataFrame,
    folders: Sequence[RecordingFolder],
    truth: Sequence[Path],
    source: str,
) -> str:
    """Writes the files of `--out`; returns in words which."""
    from experiments.pages.interactive.track_page import PAGE, run_data, write_track_page
    from experiments.pages.plots.track_folder import plot_tracks
    from experiments.pages.scored_tracks import ScoredTracks
    from trackers.evaluation.evaluate import associate

    output_folder(out)
    atomic_write(out / "evaluation.json", lambda path: path.write_text(text, encoding="utf-8"))
    atomic_write(out / TRACKS, lambda path: write_tracks(tracks, path))
    if all(path.is_dir() for path in truth):
        names = "".join(f"{path.resolve()}\n" for path in truth)
        atomic_write(out / "recordings.txt", lambda path: path.write_text(names, encoding="utf-8"))
    scored = ScoredTracks(associate(tracks, folders), folders, ())
    none = pl.DataFrame(schema={"recording": pl.String, "tag": pl.String, "t_s": pl.Float64, "event": pl.String})
    run = run_data(scored, none, evaluation, source, figures=True)
    write_track_page(out / PAGE, [run], shlex.join(["trackwright", *sys.argv[1:]]), "evaluate")
    drawn = plot_tracks(out, scored)
    figures = f"{counted(len(drawn), 'figure')}: {', '.join(drawn)}"
    return f"wrote {out}: {PAGE}, evaluation.json, {TRACKS} as compared, and {figures}"
