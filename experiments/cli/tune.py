"""`trackwright tune`: its options; `tuning_job.py` does the work."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from experiments.cli.arguments import FigureFormat, File, Folder, Folders
from experiments.cli.console import ReadingOptions, json_alone, read_with_notices, require_output
from experiments.cli.folders_in_turn import FoldersInTurn
from experiments.cli.runtime import keep_programs
from experiments.text.terminal import stages
from trackers.core.errors import UnusableInput
from tuning.tuned_file import parse_values, read_tuned

LEAST = {"steps": 1, "starts": 1, "piece_rows": 10, "minibatch": 1, "repeats": 1}
"""The least value of each option that counts."""


def require_counts(options: Mapping[str, Any]) -> None:
    """Raises UnusableInput for the first option that is below its `LEAST` value."""
    for name, least in LEAST.items():
        value = options.get(name)
        if value is not None and value < least:
            raise UnusableInput(f"--{name.replace('_', '-')} {value}: expected at least {least}")


def tune(
    recordings: Folders,
    *,
    out: Folder,
    tracker: Annotated[str | None, "NAME"] = None,
    objective: Annotated[str | None, "NAME"] = None,
    tune: Annotated[tuple[str, ...] | None, "PATTERN"] = None,
    freeze: Annotated[tuple[str, ...], "PATTERN"] = (),
    bound: Annotated[tuple[str, ...], "PATTERN=LOW:HIGH"] = (),
    prior: Annotated[tuple[str, ...], "PATTERN=PRIOR"] = (),
    start: File | None = None,
    set_: Annotated[tuple[str, ...], "NAME=VALUE"] = (),
    held_out: Folders = (),
    used: ReadingOptions,
    dimensions: Literal[2, 3] | None = None,
    weigh: Literal["recordings", "rows"] = "recordings",
    starts: int = 4,
    optimiser: Literal["auto", "lbfgs", "adam"] = "auto",
    steps: int = 60,
    minibatch: int | None = None,
    intervals: Literal["curvature", "profile", "bootstrap"] = "curvature",
    resume: bool = False,
    cluster: Annotated[str | None, "ADDRESS"] = None,
    free_height: bool = False,
    piece_rows: int = 8000,
    force: bool = False,
    no_figures: bool = False,
    no_report: bool = False,
    format: FigureFormat = "png",
    json: bool = False,
) -> int:
    """Fit noise levels by gradient: values, intervals and a report.

    Writes tuned.toml, for `--noise` of `track`, report.html, trace.csv and a checkpoint. Other tunables than noise
    levels are fitted where --tune names them.

    Args:
        recordings: recording folders to fit to, all at once.
        out: the folder to write to.
        tracker: as in `track`; default: that of the file `--start`, else the one that fits the tables.
        objective: state-nll, the negative log density of the truth under the reported position and covariance; rmse,
            nees-shape (need truth as well); nll, the negative log-likelihood, nis-shape (need none); or a sum,
            e.g. state-nll+0.1*rmse. Default: state-nll where there is truth, else nll.
        tune: shell patterns of tunables, e.g. 'motion.*'; 'tied:PATTERN' keeps all matches equal. Default: the noise
            levels of motion and sensors, and with truth the latency of fixes.
        freeze: patterns of tunables to keep.
        bound: physical bounds of tuned numbers.
        prior: PATTERN=0.2x2 for a value known within a factor of 2, PATTERN=0+-0.1 for an offset; makes nll the
            default objective.
        start: a tuned.toml to start from.
        set_: values to start from, by tunable or pattern.
        held_out: recordings to validate on: not fitted, they select the best point and end the fit.
        dimensions: 2 to judge the horizontal position, 3 to judge an estimated height too. Default: 3 for state-nll, in
            which a height counts half a horizontal coordinate, where the truth has heights; else 2.
        weigh: recordings or rows: which of them have the same weight.
        starts: number of starts: the given values, then the best of a first guess from the data and a coarse grid.
        optimiser: auto: lbfgs for nll and state-nll, alone or in a sum; adam else, and for minibatches and particles.
        steps: maximum number of steps per start.
        minibatch: trajectories per step, drawn at random; default: all.
        intervals: method of the 95 % intervals: curvature (with the scatter of the trajectories), profile likelihood
            (makes nll the default objective), or bootstrap over trajectories.
        resume: continue from the checkpoint in --out, with bit-identical results.
        cluster: hold the rows on the workers of a Dask cluster, tcp://HOST:8786, or of processes here, local:4, which
            all see the folder --out; for recordings that no memory holds, with the same tuned.toml.
        free_height: estimate the height of tags whose height the rig gives.
        piece_rows: rows of the segments into which long recordings are cut.
        force: write tuned.toml even where a level collapsed, the fit ended before its optimum, or a recording gets
            worse: RMSE more than 5 % larger, covariances that held and do not, or a share inside the 95 % ellipse
            farther from 95 % by more than 5 %.
        no_figures: draw no figure.
        no_report: write no report.html.
        format: of the figure, tuning.png or tuning.pdf.
        json: print the content of tuned.toml as JSON instead of tables.
    """
    started, clock = datetime.now(UTC), time.perf_counter()
    values = parse_values(set_, "--set")
    options: dict[str, Any] = {
        "tracker": tracker, "objective": objective, "dimensions": dimensions, "weigh": weigh, "tune": tune,
        "freeze": freeze, "bound": bound, "prior": prior, "held_out": held_out, "start": start, "set": set_,
        "calibration": used.calibration, "part": dataclasses.asdict(used.part), "average": used.average,
        "starts": starts, "optimiser": optimiser, "steps": steps, "minibatch": minibatch, "intervals": intervals,
        "free_height": free_height, "piece_rows": piece_rows, "force": force,
        "cluster": cluster,
    }  # fmt: skip
    require_counts(options)
    require_output(out)
    tuned = None if start is None else read_tuned(start)
    with json_alone(json) as put, stages("tune") as begin:
        begin("reading")
        paths = (*recordings, *held_out)
        folders = read_with_notices(paths, used) if cluster is None else FoldersInTurn(paths, used)
        begin("preparing")
        keep_programs()
        # jax takes a second to import, which the help and a refused recording need not wait for.
        from experiments.cli.cross_calibrated import cross_calibrated
        from experiments.cli.tuning_cluster import fit_workers
        from experiments.cli.tuning_job import finish, fit_folders

        count = len(recordings)
        if used.calibration is not None and cluster is None:
            parts = cross_calibrated(folders, used.calibration)
            count, folders = sum(map(len, parts[:count])), [part for own in parts for part in own]
        with fit_workers(cluster, out) as workers:
            fitted = fit_folders(folders, count, out, options, tuned, values, resume, begin, workers)
            code, content = finish(
                fitted, recordings, out, started, clock, begin, None if no_figures else format, not no_report
            )
        put(content)
    return code
