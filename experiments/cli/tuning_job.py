"""What `trackwright tune` does with recordings that were read: the fit, its checkpoints and its files."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.console import output_folder
from experiments.cli.folders_in_turn import FoldersInTurn
from experiments.cli.tuning_cluster import data_in_turn, reported
from experiments.cli.tuning_folder import Run, write_run
from experiments.cli.tuning_options import checked_options, tracker_for_folders
from experiments.jobs.held_parts import FitWorkers, HeldParts
from experiments.pages.reports.recordings_compared import Compared, compare, tracked
from experiments.pages.reports.tracks_compared import MOST_PLANS, TrackChanges, track_changes
from experiments.pages.reports.tuning_collect import recording_names
from experiments.text.terminal import Advance, Begin, notice
from trackers.core.errors import UnusableInput, listed
from trackers.core.tunable import tunables
from trackers.evaluation.association import Association
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.named_tracker import NamedTracker
from tuning import FitResult, checkpoint, fit
from tuning.data import FitData, fit_data
from tuning.guessing import first_guess
from tuning.identifiability import cautions
from tuning.intervals import require_possible
from tuning.left_out import left_out_values
from tuning.optimisation import FitState
from tuning.optimisers import LBFGS, AbstractOptimiser, Adam
from tuning.parameters import flatten, select_parameters, tuned_by_default
from tuning.parts import LocalParts, Place
from tuning.tuned_file import Tuned

INTERRUPTED = 130
"""The exit code of a command that Ctrl-C ended, as shells have it."""

REFUSED = 1
"""The exit code where the values of a fit are not written."""

OPTIMISERS: dict[str, Callable[[int], AbstractOptimiser | None]] = {
    "auto": lambda steps: None,
    "lbfgs": lambda steps: LBFGS(),
    "adam": Adam,
}


@dataclass(frozen=True)
class Fitted:
    """A finished fit: the options with the tracker's name, the tracker, what was fitted to, and the result.

    `reported`: what the report is made of, on a cluster a part of the data. `shown`: the recordings whose errors are
    shown before and after: those held out, or else those fitted to; `others`: those fitted to if some were held out.
    """

    options: dict[str, Any]
    named: NamedTracker
    data: FitData
    result: FitResult
    reported: FitData
    shown: Sequence[RecordingFolder]
    others: Sequence[RecordingFolder]


def fit_folders(
    folders: list[RecordingFolder] | FoldersInTurn,
    count: int,
    out: Path,
    options: dict[str, Any],
    tuned: Tuned | None,
    values: Mapping[str, Any],
    resume: bool,
    begin: Begin,
    workers: FitWorkers | None = None,
) -> Fitted:
    """Fits the tracker to the first `count` recordings, the others held out; `begin` begins a stage.

    `tuned`: the content of the file to start from. `values`: to start from, by tunable or pattern. `workers`: that hold
    the rows of folders read in turn.
    """
    free_height = options["free_height"]
    first = folders if workers is None else folders[:1]
    named = tracker_for_folders(first, options["tracker"], options["start"], tuned, values, free_height)
    goal, priors_need = options["objective"], options["prior"] or options["intervals"] == "profile"
    goal = "nll" if goal is None and priors_need else goal
    how = (options["piece_rows"], options["dimensions"], options["weigh"])
    if workers is None:
        data = fit_data(named.only_batch(folders), goal, folders[count:], *how)
    else:
        data = data_in_turn(named, folders, count, workers.folder, goal, *how)
    by_default = goal is None
    tune, freeze = options["tune"], options["freeze"]
    tune = tuned_by_default(data.tracker, data.objective.needs_truth) if tune is None else tune
    options = options | {"tracker": named.name, "objective": data.named, "tune": tune}
    bounds, priors = checked_options(data, tune, freeze, options["bound"], options["prior"])
    require_possible(options["intervals"], data.objective, len(data.training))
    for text in cautions(data.tracker, select_parameters(data.tracker, tune, freeze), data.objective):
        notice(f"notice: {text}")
    output_folder(out)
    place = LocalParts if workers is None else partial(HeldParts, workers, named)
    result = _fitted(data, out, options, bounds, priors, resume, begin, by_default, place)
    if not isinstance(folders, FoldersInTurn):
        shown, others = (folders[count:], folders[:count]) if folders[count:] else (folders, [])
        return Fitted(options, named, data, result, data, shown, others)
    some = reported(data)
    fitted_to, apart = (folders.named(recording_names(part)) for part in (some.training, some.held_out))
    shown, others = (apart, fitted_to) if apart else (fitted_to, [])
    return Fitted(options, named, data, result, some, shown, others)


def finish(
    fitted: Fitted,
    recordings: Sequence[Path],
    out: Path,
    started: datetime,
    clock: float,
    begin: Begin,
    figures: str | None,
    report: bool,
) -> tuple[int, dict[str, Any]]:
    """Writes the files and prints the table; returns the exit code, and the content of tuned.toml.

    With the code `REFUSED` that file is not written, and the content has the reason as `refused`.

    `started`, `clock`: when the command began. `figures`: their ending, None for none. `report`: whether it is
    written.
    """
    left_out = {} if fitted.data.held_out else _left_out(fitted.result, begin)
    begin("comparing before and after")
    compared, plans = _compared(fitted, left_out, report)
    begin("report")
    result, name = fitted.result, fitted.options["tracker"]
    run = Run(
        name, fitted.options, recordings, time.perf_counter() - clock, started, sys.argv, figures, report
    )  # fmt: skip
    written = write_run(out, fitted.data, result, run, compared, plans, fitted.reported)
    for line in written.lines:
        print(line)
    if written.refused:
        notice(written.refused)
        return REFUSED, written.content | {"refused": written.refused}
    if result.uncertainty is None:
        notice("stopped: tuned.toml holds the best values so far; continue with the same command and --resume")
        return INTERRUPTED, written.content
    return 0, written.content


def _left_out(result: FitResult, begin: Begin) -> dict[str, dict[str, np.ndarray]]:
    count = len({name for name in result.recordings if name})
    if count > 1:
        begin(f"leaving out each of {count} recordings")
    return left_out_values(result)


def _compared(
    fitted: Fitted, left_out: Mapping[str, Mapping[str, np.ndarray]], report: bool
) -> tuple[Compared, TrackChanges | None]:
    """The recordings shown, tracked with the values before and after the fit; `report`: with plans, of others too.

    `left_out`: by recording, the values fitted to the others, with which the table shows it.
    """
    result = fitted.result

    def named(values: Mapping[str, np.ndarray]) -> NamedTracker:
        own = {name: values[p.label] for p in result.parameters for name in p.names}
        return fitted.named.with_values(own, "the fit")

    room = max(MOST_PLANS - len(fitted.shown), 0) if report else 0
    folders = [*fitted.shown, *fitted.others[:room]]
    before, after = (tracked(named(side), folders) for side in (result.starts[0][0].values, result.values))
    others = [tracked(named(left_out.get(own.name, result.values)), [own]) for own in fitted.shown if left_out]
    count = len({trajectory.folder.name for trajectory in fitted.data.training})
    part = f"{len(fitted.shown)} of {count} " if len(fitted.shown) < count else ""
    about = "held-out recordings" if fitted.data.held_out else f"{part}recordings tuned on"
    about += ", each with values fitted to the others" if left_out else ""
    held_out = {folder.name for folder in fitted.shown} if fitted.data.held_out else set()
    plans = track_changes(before, after, folders, held_out) if report else None
    judged = Association.joined(others) if left_out else after
    return compare((before, judged), fitted.shown, fitted.data.dimensions, about), plans


def _fitted(
    data: FitData,
    out: Path,
    options: dict[str, Any],
    bounds: Any,
    priors: Any,
    resume: bool,
    begin: Begin,
    by_default: bool,
    place: Place,
) -> FitResult:
    """The fit, with a checkpoint after every step; raises UnusableInput where the objective is never finite.

    `by_default`: whether the objective was chosen by the data. `place`: of the rows.
    """
    training, held_out = data.batches(), data.batches(held_out=True)
    # Intervals are computed from the result and don't change the fit, nor does the place where it is computed.
    config = {name: value for name, value in options.items() if name not in ("intervals", "cluster", "force")}
    fingerprint = checkpoint.fingerprint(
        config, [*training, *held_out], flatten(select_parameters(data.tracker, "*", thresholds=True))
    )
    saved = checkpoint.load(out, fingerprint) if resume else None
    if resume and saved is None:
        notice(f"notice: {out}: no checkpoint found; the fit starts from the beginning")
    if by_default:
        why = (
            "there is truth" if data.objective.needs_truth else "there is no truth that the estimates can be judged by"
        )
        notice(f"objective: {data.named}, since {why}; choose another with --objective")
    if data.unused:
        notice(f"notice: without truth, and not used: {listed(data.unused)}")
    steps, starts, freeze = options["steps"], options["starts"], options["freeze"]
    tuned = {name for p in select_parameters(data.tracker, options["tune"], freeze) for name in p.names}
    kept = [name for name in tunables(data.tracker) if name not in tuned]
    begin("searching for starts" if starts > 1 else "first evaluation")
    steps_done = _Steps(out, fingerprint, steps, begin)
    try:
        result = fit(
            data.tracker,
            data,
            data.objective,
            options["tune"],
            frozen=freeze,
            bounds=bounds,
            optimiser=OPTIMISERS[options["optimiser"]](steps),
            steps=steps,
            starts=starts,
            minibatch=options["minibatch"],
            priors=priors,
            guesses=[first_guess(data.tracker, training, kept)] if starts > 1 and saved is None else [],
            resume=saved,
            report=steps_done.report,
            stage=begin,
            place=place,
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


class _Steps:
    """The bar of the steps, which begins after the first evaluation, and the checkpoint after every step."""

    def __init__(self, out: Path, fingerprint: str, steps: int, begin: Begin) -> None:
        self.out, self.fingerprint, self.steps, self.begin = out, fingerprint, steps, begin
        self.advance: Advance | None = None

    def report(self, state: FitState) -> None:
        """Saves the state and advances the bar."""
        checkpoint.save(self.out, checkpoint.to_arrays(state), self.fingerprint)
        best, number = int(state.best_scores.argmin()), int(state.number)
        now = f"objective {state.best_scores[best]:.5g}, gradient {state.past_norms[-1, best]:.2g}"
        if self.advance is None:
            self.advance = self.begin("step", self.steps)
            self.advance(number, now)
        else:
            self.advance(1, now)
