"""`trackwright evaluate`."""

from __future__ import annotations

import dataclasses
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from experiments.cli.archives.folders import RECORDINGS, is_archive
from experiments.cli.arguments import File
from experiments.cli.console import read_with_notices, selection
from experiments.cli.evaluate_poses import PoseOptions, evaluate_poses
from experiments.text.tables import terminal_width
from trackers.core.errors import UnusableInput
from trackers.exchange.alignment import Alignment
from trackers.recordings.atomic import atomic_write
from trackers.recordings.tracks_table import EVALUATION, SOURCES, TRACKS, read_tracks, source_paths

if TYPE_CHECKING:
    from trackers.evaluation.evaluate import Evaluation
    from trackers.worksteps.tracks import WorkstepReport


def evaluate_tracks(
    folder: Annotated[Path, "FOLDER|FILE"],
    *,
    truth: Annotated[tuple[Path, ...], "FOLDER|FILE"] = (),
    tag: Annotated[tuple[str, ...], "TAG"] = (),
    from_: Annotated[float | None, "S"] = None,
    to: Annotated[float | None, "S"] = None,
    every: Annotated[float | None, "S"] = None,
    json: bool = False,
    fail_if: Annotated[str | None, "CONDITION"] = None,
    worksteps: File | None = None,
    tolerance: Annotated[float | None, "M"] = None,
    cluster: Annotated[str | None, "ADDRESS"] = None,
    align: Alignment | None = None,
    time_offset: Annotated[str | None, "S|auto"] = None,
    time_tolerance: Annotated[float | None, "S"] = None,
    rpe: Annotated[tuple[str, ...], "STEP"] = (),
    all_pairs: bool = False,
    out: Annotated[Path | None, "FOLDER"] = None,
) -> int:
    """Error metrics of estimates against truth; exit 1 by --fail-if.

    By track, by recording and overall; writes evaluation.json. Of a file of estimates (TUM, KITTI, EuRoC, or a table
    with t_s, x_m, y_m), and with --align and what follows it, also absolute and relative pose errors as in evo.

    Args:
        folder: the output folder of `track`, of one recording, several or an archive, or a file of estimates.
        truth: recordings whose truth tables are used, or a trajectory file, of the one tag that the estimates follow;
            default: the tracked recordings.
        tag: score these tags alone; the tag that a file of estimates follows.
        from_: score estimates from this time on.
        to: score estimates up to this time.
        every: score only the last estimate in each interval of so many seconds, so that tags weigh equally.
        json: print all metrics as JSON instead of a table.
        fail_if: exit with code 1 if this holds for the overall metrics, e.g. "p95_m>0.5" or "rmse_m>0.2 or lost_s>0".
        worksteps: a table of fastening points, name, x_m, y_m and optionally z_m; adds how often the tool is
            unlocked at the right one.
        tolerance: distance to a fastening point, m, up to which the tool is at it; default: half the smallest distance
            between two points.
        cluster: score each recording on a Dask cluster, tcp://HOST:8786, or in processes here, local:4.
        align: fit each track to its truth first: se3, sim3 (with scale), scale, se2 (in x and y), origin (first pose).
        time_offset: added to the times of the estimates; auto: the one that fits best.
        time_tolerance: largest distance in time between a pose and its true pose; default: 0.01.
        rpe: steps of the relative pose errors: 1m, 1s, 10f (rows); default: 1m 1s.
        all_pairs: relative pose errors from every pose, not from the end of the step before.
        out: a folder for the page, evaluation.json, the tracks as compared, and figures.
    """
    part = selection(tag, from_, to, every)
    if tolerance is not None and worksteps is None:
        raise UnusableInput(f"--tolerance {tolerance:g}: applies to fastening points; expected --worksteps POINTS too")
    if not folder.exists():
        raise UnusableInput(
            f"{folder}: no such file; expected a folder with tracks.parquet that `track` wrote, or a file of estimates"
        )
    options = PoseOptions(align, time_offset, time_tolerance, rpe, all_pairs, out)
    if is_archive(folder):
        if options.given or truth or worksteps is not None:
            raise UnusableInput(
                f"{folder}: is an archive; expected no --truth, --worksteps and trajectory options; "
                f"evaluate one of {folder / RECORDINGS}/*/*"
            )
        # jax takes a second to import, which the help and a refused folder need not wait for.
        from experiments.cli.archive import evaluate_archive

        return evaluate_archive(folder, part, every, cluster, json, fail_if)
    if (folder / RECORDINGS).is_dir() and not (folder / TRACKS).exists():
        raise UnusableInput(f"{folder}: an archive that was not tracked to its end; run the same `track` again")
    if folder.is_file() or options.given or not all(path.is_dir() for path in truth):
        if worksteps is not None or cluster is not None:
            raise UnusableInput(
                "--worksteps and --cluster: apply to a folder of `track`, without trajectory options and files"
            )
        known = truth if truth or folder.is_file() else sources(folder)
        return evaluate_poses(folder, known, options, part, json, fail_if)
    tracks = part.of_estimates(read_tracks(folder))
    folders = read_with_notices(truth or sources(folder))
    # jax takes a second to import, which the help and a refused folder need not wait for.
    from experiments.cli.fail_if import conditions, violation
    from experiments.jobs.executors import cluster_executor
    from experiments.pages.reports.worksteps_text import to_text as work_text
    from experiments.text.evaluation_text import to_json, to_text
    from trackers.evaluation.evaluate import evaluate, metric_names
    from trackers.worksteps.tracks import METRICS, workstep_report

    if fail_if is not None:
        conditions(fail_if, [*metric_names(tracks), *(METRICS if worksteps is not None else ())])
    with cluster_executor(cluster) if cluster else nullcontext() as executor:
        evaluation, work = evaluate(tracks, folders, every, executor), None
    if worksteps is not None:
        truths = {f.name: f.tables["truth"] for f in folders if "truth" in f.tables}
        work = workstep_report(tracks, truths, worksteps, tolerance, every)
        evaluation = with_work(evaluation, work)
    text = to_json(evaluation, None if work is None else work.plain())
    atomic_write(folder / EVALUATION, lambda path: path.write_text(text, encoding="utf-8"))
    print(
        text if json else to_text(evaluation, terminal_width()) + ("" if work is None else "\n" + work_text(work)),
        end="",
    )
    if fail_if is not None:
        why = violation(evaluation, fail_if)
        if why is not None:
            print(f"fails: {why}", file=sys.stderr)
            return 1
    return 0


def with_work(evaluation: Evaluation, work: WorkstepReport) -> Evaluation:
    """The evaluation with the fractions of right and wrong unlock decisions among its metrics."""
    recordings = [
        metrics | (work.metrics(metrics["recording"]) if metrics["recording"] in work.recordings else {})
        for metrics in evaluation.recordings
    ]
    return dataclasses.replace(evaluation, overall=evaluation.overall | work.metrics(), recordings=recordings)


def sources(folder: Path) -> tuple[Path, ...]:
    """The recordings tracked into an output folder; raises UnusableInput if it does not list them."""
    paths = source_paths(folder)
    if not paths:
        raise UnusableInput(
            f"{folder / SOURCES}: names no recording; expected a folder written by `track`; give --truth RECORDING"
        )
    return tuple(paths)
