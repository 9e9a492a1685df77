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
from experiments.cli.tuning_options import checked_options, tracker_and_folders
from trackers.core.errors import UnusableInput
from tuning import FitResult, checkpoint, fit
from tuning.data import FitData, fit_data
from tuning.guessing import first_guess
from tuning.identifiability import cautions
from tuning.intervals import require_possible
from tuning.optimisation import FitState, to_arrays
from tuning.optimisers import LBFGS, AbstractOptimiser, Adam
from tuning.parameters import flatten, select_parameters

EVERYTHING = "*.sigma_*"
INTERRUPTED = 130
"""The exit code of a command that Ctrl-C ended, as shells have it."""

OPTIMISERS: dict[str, Callable[[int], AbstractOptimiser | None]] = {
    "auto": lambda steps: None,
    "lbfgs": lambda steps: LBFGS(),
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
        objective: nll, the negative log-likelihood (needs no truth); rmse, the position error, state-nll, nees-shape
            (need truth); nis-shape; or a weighted sum, as 'nll+0.1*rmse'.
        tune: shell patterns of tunables, as 'motion.*' 'sensors.*.sigma_p'; 'tied:PATTERN' keeps all matches equal.
        freeze: patterns of tunables to keep.
        bound: PATTERN=LOWEST:HIGHEST, physical bounds of tuned numbers.
        prior: PATTERN=0.2x2 for a value known within a factor of 2, PATTERN=0+-0.1 for an offset; with nll only.
        held_out: recordings to validate on: not fitted, but they select the best point and end the fit.
        start: a tuned.toml to start from.
        starts: number of starts: the given values, then the best of a first guess from the data and a coarse grid.
        optimiser: auto is lbfgs for a likelihood, adam for other objectives, minibatches and particle filters.
        steps: maximum number of steps per start.
        minibatch: trajectories per step, drawn at random; default all.
        intervals: method of the 95 % intervals: curvature (with the scatter of the trajectories), profile likelihood,
            or bootstrap over trajectories (at least five).
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
    named, folders = tracker_and_folders((*recordings, *held_out), tracker, start, free_height)
    data = fit_data(named.only_batch(folders), objective, folders[len(recordings) :], piece_rows)
    bounds, priors = checked_options(data, tune, freeze, bound, prior)
    require_possible(intervals, data.objective, len(data.training))
    for text in cautions(data.tracker, select_parameters(data.tracker, tune, freeze), data.objective):
        notice(f"notice: {text}")
    output_folder(out)
    options = {
        "tracker": named.name,
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
    result = _fitted(data, out, options, bounds, priors, resume)
    run = Run(named.name, options, recordings, time.perf_counter() - clock, started, sys.argv)
    for line in write_run(out, data, result, run):
        print(line)
    if result.uncertainty is None:
        notice("stopped: tuned.toml holds the best values so far; continue with the same command and --resume")
        return INTERRUPTED
    return 0


def _fitted(data: FitData, out: Path, options: dict[str, Any], bounds: Any, priors: Any, resume: bool) -> FitResult:
    """The fit, with a checkpoint after every step; raises UnusableInput where the objective is never finite."""
    training, held_out = data.rows(), data.rows(held_out=True)
    # Intervals are computed from the result and don't change the fit.
    config = {name: value for name, value in options.items() if name != "intervals"}
    fingerprint = checkpoint.fingerprint(
        config, [*training, *held_out], flatten(select_parameters(data.tracker, "*", thresholds=True))
    )
    saved = checkpoint.load(out, fingerprint) if resume else None
    if resume and saved is None:
        notice(f"notice: {out}: no checkpoint found; the fit starts from the beginning")
    steps, starts, freeze = options["steps"], options["starts"], options["freeze"]
    with progress("tuning", steps) as advance:
        advance(0, "(evaluating starts)")
        try:
            result = fit(
                data.tracker,
                training,
                data.objective,
                options["tune"],
                frozen=freeze,
                bounds=bounds,
                optimiser=OPTIMISERS[options["optimiser"]](steps),
                steps=steps,
                starts=starts,
                held_out=held_out,
                minibatch=options["minibatch"],
                priors=priors,
                guesses=[first_guess(data.tracker, training, freeze)] if starts > 1 and saved is None else [],
                resume=saved,
                report=lambda state: _after_step(out, fingerprint, state, advance),
            )
        except FloatingPointError as error:
            raise UnusableInput(f"{error}; run `trackwright check` on the recordings") from error
    if result.n_excluded == len(data.training):
        raise UnusableInput(
            f"at the best point ({options['objective']} {result.value:.4g}) no segment of the recordings has finite "
            "gradients: repeated identical readings drive the noise to zero; give --bound or --prior"
        )
    if result.n_excluded:
        notice(
            f"notice: {result.n_excluded} of {len(data.training)} segments were excluded: non-finite likelihood, or "
            "gradients over 1000 x the median"
        )
    return result


def _after_step(out: Path, fingerprint: str, state: FitState, advance: Advance) -> None:
    checkpoint.save(out, to_arrays(state), fingerprint)
    best = int(state.best_scores.argmin())
    now = f"(objective {state.best_scores[best]:.5g}, gradient {state.past_norms[-1, best]:.2g})"
    advance(min(1, int(state.number)), now)
