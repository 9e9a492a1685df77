"""`trackwright tune`: its options; `tuning_job.py` does the work."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import tyro

from experiments.cli.console import progress, read_with_notices
from experiments.cli.runtime import keep_programs
from trackers.core.errors import UnusableInput

EVERYTHING = "*.sigma_*"


def tune(
    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    tracker: str | None = None,
    objective: str | None = None,
    dimensions: Literal[2, 3] = 2,
    weigh: Literal["recordings", "rows"] = "recordings",
    tune: tuple[str, ...] = (EVERYTHING,),
    freeze: tuple[str, ...] = (),
    bound: tuple[str, ...] = (),
    prior: tuple[str, ...] = (),
    held_out: tuple[Path, ...] = (),
    start: Path | None = None,
    calibration: Path | None = None,
    average: float | None = None,
    starts: int = 4,
    optimiser: Literal["auto", "lbfgs", "adam"] = "auto",
    steps: int = 60,
    minibatch: int | None = None,
    intervals: Literal["curvature", "profile", "bootstrap"] = "curvature",
    resume: bool = False,
    free_height: bool = False,
    piece_rows: int = 8000,
) -> int:
    """Fit noise levels (and other tunables) to recordings by gradient: writes tuned.toml, report.html, trace.csv.

    Args:
        recordings: recording folders to fit to, all at once.
        out: the folder to write to.
        tracker: as in `track`; default: what fits the tables.
        objective: state-nll, the negative log density of the truth under the reported position and covariance; rmse,
            the position error, nees-shape (need truth as well); nll, the negative log-likelihood, tempered-nll, the
            same with intervals that allow for correlated innovations, nis-shape (need none); or a weighted sum, as
            'state-nll+0.1*rmse'. Default: state-nll where there is truth, else nll.
        dimensions: 2 to judge the horizontal position, 3 to judge an estimated height too.
        weigh: what has the same say: each recording, or each row, so that long recordings decide.
        tune: shell patterns of tunables, as 'motion.*' 'sensors.*.sigma_p'; 'tied:PATTERN' keeps all matches equal.
        freeze: patterns of tunables to keep.
        bound: PATTERN=LOWEST:HIGHEST, physical bounds of tuned numbers.
        prior: PATTERN=0.2x2 for a value known within a factor of 2, PATTERN=0+-0.1 for an offset; with nll only, which
            it then makes the default.
        held_out: recordings to validate on: not fitted, but they select the best point and end the fit.
        start: a tuned.toml to start from.
        calibration: a calibration.toml of `trackwright calibrate` on other recordings of these stations or anchors.
        average: average the ranges, fixes and bearings of each tag and anchor or station over so many seconds;
        0: every reading; default: 0.5 for bearings that repeat.
        starts: number of starts: the given values, then the best of a first guess from the data and a coarse grid.
        optimiser: auto is lbfgs for a likelihood, adam for other objectives, minibatches and particle filters.
        steps: maximum number of steps per start.
        minibatch: trajectories per step, drawn at random; default all.
        intervals: method of the 95 % intervals: curvature (with the scatter of the trajectories), profile likelihood
            (makes nll the default), or bootstrap over trajectories (at least five).
        resume: continue from the checkpoint in --out, with bit-identical results.
        free_height: estimate the height of tags whose height the rig gives.
        piece_rows: long recordings are cut into segments of about this many rows, which are fitted side by side.
    """
    started, clock = datetime.now(UTC), time.perf_counter()
    if steps < 1 or piece_rows < 10 or starts < 1 or (minibatch is not None and minibatch < 1):
        raise UnusableInput(
            f"--steps {steps} --piece-rows {piece_rows} --starts {starts} --minibatch {minibatch}: expected at least "
            "1, 10, 1 and 1"
        )
    options = {
        "tracker": tracker,
        "objective": objective,
        "dimensions": dimensions,
        "weigh": weigh,
        "tune": tune,
        "freeze": freeze,
        "bound": bound,
        "prior": prior,
        "held_out": held_out,
        "start": start,
        "calibration": calibration,
        "average": average,
        "starts": starts,
        "optimiser": optimiser,
        "steps": steps,
        "minibatch": minibatch,
        "intervals": intervals,
        "free_height": free_height,
        "piece_rows": piece_rows,
    }
    with progress("tuning", steps) as advance:
        advance(0, "(reading)")
        folders = read_with_notices((*recordings, *held_out), calibration, average)
        advance(0, "(preparing)")
        keep_programs()
        # jax takes a second to import, which the help and a refused recording need not wait for.
        from experiments.cli.tuning_job import finish, fit_folders

        fitted = fit_folders(folders, len(recordings), out, options, resume, advance)
    return finish(fitted, recordings, out, started, clock)
