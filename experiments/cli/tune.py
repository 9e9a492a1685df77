"""`trackwright tune`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from experiments.cli.console import Advance, notice, output_folder, progress
from experiments.cli.tuning_folder import Run, write_run
from experiments.cli.tuning_job import Job, anomalies, bounds_of, checked, job_of, only_group
from trackers.core.errors import UnusableInput
from tuning import FitResult, checkpoint, fit
from tuning.first_guess import first_guess
from tuning.intervals import require_possible
from tuning.optimisation import FitState, stored
from tuning.optimisers import LBFGS, AbstractOptimiser, Adam, GaussNewton
from tuning.parameters import flatten, select_parameters

EVERYTHING = "*.sigma_*"
INTERRUPTED = 130
"""The exit code of a command that Ctrl-C ended, as shells have it."""

OPTIMISERS: dict[str, Callable[[int], AbstractOptimiser | None]] = {
    "auto": lambda steps: None,
    "lbfgs": lambda steps: LBFGS(),
    "gauss-newton": lambda steps: GaussNewton(),
    "adam": Adam,
}


def tune(
    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    tracker: str | None = None,
    objective: str = "nll",
    tune: tuple[str, ...] = (EVERYTHING,),
    freeze: tuple[str, ...] = (),
    bound: tuple[str, ...] = (),
    prior: tuple[str, ...] = (),
    held_out: tuple[Path, ...] = (),
    start: Path | None = None,
    starts: int = 4,
    optimiser: Literal["auto", "lbfgs", "gauss-newton", "adam"] = "auto",
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
        objective: nll, the negative log-likelihood (needs no truth); rmse, the position error, state-nll, nees-shape
            (need truth); nis-shape; or a weighted sum, as 'nll+0.1*rmse'.
        tune: shell patterns of tunables, as 'motion.*' 'sensors.*.sigma_p'; 'tied:PATTERN' keeps all that match equal.
        freeze: patterns of tunables that stay as they are.
        bound: PATTERN=LOWEST:HIGHEST, physical bounds of tuned numbers.
        prior: PATTERN=0.2x2, known within a factor of 2, or of an offset PATTERN=0+-0.1; for nll.
        held_out: recordings that are not fitted, but decide which point is the best and when to stop; and are reported.
        start: a tuned.toml to start from.
        starts: how many starts are followed side by side: the given one, and the best of a guess from the data and of
            a coarse grid.
        optimiser: auto is lbfgs for a likelihood, adam for other objectives, minibatches and trackers that draw.
        steps: the most steps of a start.
        minibatch: trajectories per step, drawn anew for each; default all.
        intervals: how sure the numbers are: by curvature and scatter of the trajectories, by the profile of a
            likelihood, or by fits to trajectories drawn anew (needs five).
        resume: go on from the checkpoint in --out, with the same result to the bit.
        free_height: estimate the height of tags whose height the rig gives.
        piece_rows: long recordings are cut into pieces of about this many rows, which are fitted side by side.
    """
    started, clock = datetime.now(UTC), time.perf_counter()
    if steps < 1 or piece_rows < 10 or starts < 1 or (minibatch is not None and minibatch < 1):
        raise UnusableInput(
            f"--steps {steps} --piece-rows {piece_rows} --starts {starts} --minibatch {minibatch}: expected at least "
            "1, 10, 1 and 1"
        )
    name, group = only_group((*recordings, *held_out), tracker, start, free_height)
    job = job_of(group, objective, held_out, piece_rows)
    bounds = bounds_of(bound)
    priors = checked(job, tune, freeze, bounds, prior)
    require_possible(intervals, job.goal, len(job.training))
    if optimiser == "gauss-newton" and not job.goal.is_likelihood:
        raise UnusableInput(f"--optimiser gauss-newton: {objective} is no likelihood; expected lbfgs, adam or auto")
    for text in anomalies(job, tune, freeze):
        notice(f"notice: {text}")
    output_folder(out)
    options = {
        "tracker": name,
        "objective": objective,
        "tune": tune,
        "freeze": freeze,
        "bound": bound,
        "prior": prior,
        "held_out": held_out,
        "start": start,
        "starts": starts,
        "optimiser": optimiser,
        "steps": steps,
        "minibatch": minibatch,
        "intervals": intervals,
        "free_height": free_height,
        "piece_rows": piece_rows,
    }
    result = _fitted(job, out, options, bounds, priors, resume)
    run = Run(name, options, recordings, time.perf_counter() - clock, started, sys.argv)
    for line in write_run(out, job, result, run):
        print(line)
    if result.uncertainty is None:
        notice("stopped: tuned.toml holds the best so far; go on with the same command and --resume")
        return INTERRUPTED
    return 0


def _fitted(job: Job, out: Path, options: dict[str, Any], bounds: Any, priors: Any, resume: bool) -> FitResult:
    """The fit, with a checkpoint after every step; raises UnusableInput where it can't begin."""
    rows, judges = job.rows(), job.rows(held_out=True)
    # What is done with the result does not make another fit of it.
    config = {name: value for name, value in options.items() if name != "intervals"}
    mark = checkpoint.fingerprint(config, [*rows, *judges], flatten(select_parameters(job.tracker, "*")))
    kept = checkpoint.load(out, mark) if resume else None
    if resume and kept is None:
        notice(f"notice: {out}: no checkpoint there; the fit begins anew")
    steps, starts, freeze = options["steps"], options["starts"], options["freeze"]
    with progress("tuning", steps) as advance:
        advance(0, "(looking for starts)")
        try:
            result = fit(
                job.tracker,
                rows,
                job.goal,
                options["tune"],
                frozen=freeze,
                bounds=bounds,
                optimiser=OPTIMISERS[options["optimiser"]](steps),
                steps=steps,
                starts=starts,
                held_out=judges,
                minibatch=options["minibatch"],
                priors=priors,
                guesses=[first_guess(job.tracker, rows, freeze)] if starts > 1 and kept is None else [],
                resume=kept,
                report=lambda state: _after_step(out, mark, state, advance),
            )
        except FloatingPointError as error:
            raise UnusableInput(f"{error}; ask `trackwright check` about the recordings") from error
    if result.n_excluded == len(job.training):
        raise UnusableInput(
            f"at the best point met ({options['objective']} {result.value:.4g}) no piece of the recordings has finite "
            "derivatives: where readings repeat exactly the least noise is the likeliest; give --bound or --prior"
        )
    if result.n_excluded:
        notice(
            f"notice: {result.n_excluded} of {len(job.training)} pieces had no say: their figures were not finite, or "
            "depend on the tunables without measure"
        )
    return result


def _after_step(out: Path, mark: str, state: FitState, advance: Advance) -> None:
    checkpoint.save(out, stored(state), mark)
    best = int(state.best_scores.argmin())
    now = f"(objective {state.best_scores[best]:.5g}, gradient {state.past_norms[-1, best]:.2g})"
    advance(min(1, int(state.number)), now)
