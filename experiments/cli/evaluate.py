"""`trackwright evaluate`."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import tyro

from experiments.cli.console import notice, read_all
from experiments.cli.fail_if import fails
from experiments.reports.evaluation_text import to_json, to_text
from experiments.reports.worksteps_text import to_text as work_text
from trackers.core.errors import UnusableInput
from trackers.evaluation import Evaluation, evaluate
from trackers.recordings.atomic import atomic_write
from trackers.recordings.truth import read_tracks
from trackers.worksteps.tracks import WorkReport, work_report

SOURCES = "recordings.txt"
"""In a run folder: the recording folders that were tracked, one a line."""


def evaluate_tracks(
    folder: Annotated[Path, tyro.conf.Positional],
    truth: tuple[Path, ...] = (),
    json: bool = False,
    fail_if: str | None = None,
    every_s: float | None = None,
    worksteps: Path | None = None,
    tolerance: float | None = None,
) -> int:
    """Error figures of tracks against truth, horizontal and 3-D, per recording, tag and overall. Exit 1 with --fail-if.

    Args:
        folder: what `track --out` wrote.
        truth: recordings whose truth table counts; default: those that were tracked.
        json: print every figure as JSON instead of a table.
        fail_if: exit 1 where this holds of the overall figures, as "p95_m>0.5" or "rmse_m>0.2 or lost_fraction>0".
        every_s: judge only the last estimate in every so many seconds, so that busy tags don't weigh more.
        worksteps: a table of points of work, name, x_m, y_m and optionally z_m: how often the right one is released.
        tolerance: how near to a point, m, the tool is at it; default: half the smallest distance between two points.
    """
    if every_s is not None and not (math.isfinite(every_s) and every_s > 0):
        raise UnusableInput(f"--every-s {every_s}: expected a number of seconds above 0")
    if tolerance is not None and worksteps is None:
        raise UnusableInput(f"--tolerance {tolerance:g}: is of points of work; expected --worksteps POINTS with it")
    tracks = read_tracks(folder)
    folders = read_all(truth or sources(folder))
    evaluation, work = evaluate(tracks, folders, every_s), None
    if worksteps is not None:
        truths = {f.name: f.tables["truth"] for f in folders if "truth" in f.tables}
        work = work_report(tracks, truths, worksteps, tolerance, every_s)
        evaluation = with_work(evaluation, work)
    text = to_json(evaluation, None if work is None else work.plain())
    atomic_write(folder / "evaluation.json", lambda path: path.write_text(text, encoding="utf-8"))
    print(text if json else to_text(evaluation) + ("" if work is None else "\n" + work_text(work)), end="")
    if fail_if is not None:
        why = fails(evaluation, fail_if)
        if why is not None:
            notice(f"fails: {why}")
            return 1
    return 0


def with_work(evaluation: Evaluation, work: WorkReport) -> Evaluation:
    """The evaluation with the shares of right and wrong releases among its figures, overall and by recording."""
    recordings = [
        figures | (work.figures(figures["recording"]) if figures["recording"] in work.recordings else {})
        for figures in evaluation.recordings
    ]
    return dataclasses.replace(evaluation, overall=evaluation.overall | work.figures(), recordings=recordings)


def sources(folder: Path) -> tuple[Path, ...]:
    """The recordings that a run folder was made from; raises UnusableInput where it doesn't say."""
    path = folder / SOURCES
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        lines = []
    if not any(lines):
        raise UnusableInput(f"{path}: names no recording; expected a folder written by `track`; give --truth RECORDING")
    return tuple(Path(line) for line in lines if line)
